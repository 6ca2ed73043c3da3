"""Off-line calibration of a differential drive after Ivanjko, Komsic and Petrovic, from lines and turns on the spot.

E. Ivanjko, I. Komsic, I. Petrovic, "Simple off-line odometry calibration of differential drive mobile robots", 16th
International Workshop on Robotics in Alpe-Adria-Danube Region (RAAD 2007). The variant with three parameters: factors
k_L and k_R of the wheels' design radii and k_b of the design wheelbase,

    v = (k_R r_R omega_R + k_L r_L omega_L) / 2,    w = (k_R r_R omega_R - k_L r_L omega_L) / (k_b b).          (1)

They are found in two steps that are repeated until no factor changes by more than a tolerance.

1. On straight lines the factors of the wheels minimise the squared distances of the odometry's ends p_i from the true
   ones q_i, with the wheelbase kept:

    (k_L, k_R) = argmin sum_i |p_i(k_L, k_R) - q_i|^2.                                                       (2)

2. On turns on the spot the factor of the wheelbase minimises the squared errors of the headings at the ends, with the
   wheels kept. The odometry turns by theta_i / k where it turned by theta_i before, and in truth by t_i, so that

    k = sum_i theta_i^2 / sum_i theta_i t_i,    k_b = (k of clockwise turns + k of the others) / 2.             (3)

The article itself was not at hand, only its abstract, which names the experiments, the optimisation and variants with
two and three parameters. The steps are as the authors of OptiOdom (J. Intell. Robot. Syst. 105:39, 2022) take them, who
stop at a change of 0.001. Reconstructed here:

- the least squares of (2) go by SciPy's Levenberg-Marquardt method over the x and y of the ends;
- a tracked point off the middle of the axle is at its design pose there;
- the odometry tells what a run is: a straight line goes as far from its start as its length and keeps its heading; a
  turn on the spot stays near its start and turns by a quarter turn or more. Other runs are not used.

It is for two measured wheels on one axle (m, rad, SI throughout) and for runs of one session.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy
from pydantic import Field

from omnibench.data.dataset import Trajectory
from omnibench.errors import NotApplicableError
from omnibench.fit.article_methods import TwoWheelMethod, axle_length, with_axle
from omnibench.fit.calibrator import Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration
from omnibench.words import plural

_STRAIGHT = 0.95  # share of its length that a straight line goes from its start (chosen)
_KEPT = 0.35  # rad that a straight line's heading may change by, 20 degrees (chosen)
_LENGTH = 2.0  # axles: length of the shortest straight line (chosen)
_ON_THE_SPOT = 0.25  # axles: farthest that a turn on the spot goes from its start (chosen)
_QUARTER = math.pi / 2 - 0.1  # rad of the smallest turn on the spot (chosen)
_SCALE = 0.01  # share by which factors change at first, for the least squares to scale by (chosen)


class IvanjkoOptions(Options):
    """Stopping rule."""

    tolerance: float = Field(1e-6, gt=0, description="stop when no factor changes by more than this share")
    rounds: int = Field(50, gt=0, description="most repetitions of the two steps")


@calibrators.register("ivanjko")
class Ivanjko(TwoWheelMethod):
    """Ivanjko et al. 2007: radii from straight lines, wheelbase from turns on the spot, in turns."""

    Options = IvanjkoOptions
    options: IvanjkoOptions
    per_session = True

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Repeat steps 1 and 2. NotApplicableError: no straight line, or no turn on the spot, left or right."""
        self.needs_matrix(problem)
        lines, lefts, rights = _paths(problem)
        radii, wheelbase, change, count = np.ones(2), 1.0, np.inf, 0
        while change > self.options.tolerance and count < self.options.rounds:
            robot = _changed(problem.robot, radii, wheelbase)
            of_radii = _step_1(robot, lines, problem.integration)
            radii = radii * of_radii
            robot = _changed(problem.robot, radii, wheelbase)
            of_wheelbase = float(np.mean([_step_2(robot, turns, problem.integration) for turns in (rights, lefts)]))
            wheelbase *= of_wheelbase
            change, count = float(np.abs(np.append(of_radii, of_wheelbase) - 1).max()), count + 1
            problem.report(count, self.options.rounds, "round")
        robot = _changed(problem.robot, radii, wheelbase)
        wheels = ", ".join(f"{wheel.name} {1000 * wheel.radius:.3f}" for wheel in robot.measured)
        return Solution(
            robot.inverse_kinematic_matrix.ravel(),
            f"radii {wheels} mm, wheelbase {1000 * axle_length(robot):.1f} mm, "
            f"from {plural(len(lines), 'straight line')}, {plural(len(lefts), 'turn')} to the left and "
            f"{len(rights)} to the right, after {plural(count, 'round')}",
            converged=change <= self.options.tolerance,
        )


def _paths(problem: CalibrationProblem) -> tuple[list[Trajectory], list[Trajectory], list[Trajectory]]:
    """The straight lines, turns to the left and turns to the right among the runs. NotApplicableError names missing."""
    lines, lefts, rights = list[Trajectory](), list[Trajectory](), list[Trajectory]()
    runs = [run for run in problem.trajectories if run.has_poses]
    stamps = [np.append(0.0, run.times[run.times <= run.end]) for run in runs]
    model, axle = OdometryModel.of_design(_on_its_axle(problem.robot), problem.integration), axle_length(problem.robot)
    paths = model.poses([run.log(times) for run, times in zip(runs, stamps, strict=True)])
    for run, path in zip(runs, paths, strict=True):
        length = float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum())
        far = float(np.hypot(*(path[:, :2] - path[0, :2]).T).max())
        turn = float(path[-1, 2] - path[0, 2])
        if length >= _LENGTH * axle and far >= _STRAIGHT * length and np.ptp(path[:, 2]) <= _KEPT:
            lines.append(run)
        elif far <= _ON_THE_SPOT * axle and abs(turn) >= _QUARTER:
            (lefts if turn > 0 else rights).append(run)
    found = {"straight lines": lines, "turns on the spot to the left": lefts, "turns on the spot to the right": rights}
    if missing := [name for name, runs_of in found.items() if not runs_of]:
        raise NotApplicableError(
            f"it is for straight lines and turns on the spot both ways; among "
            f"{plural(len(problem.trajectories), 'run')} there are no {' and no '.join(missing)}"
        )
    return lines, lefts, rights


def _step_1(robot: Robot, lines: Sequence[Trajectory], integration: Integration) -> Array:
    """Factors (2,) of the measured wheels' radii, Eq. (2)."""
    truth = np.array([run.final_pose[:2] for run in lines])

    def errors(factors: Array) -> Array:
        return (_ends(_changed(robot, factors, 1.0), lines, integration)[:, :2] - truth).ravel()

    found: Array = scipy.optimize.least_squares(
        errors, np.ones(2), method="lm", x_scale=_SCALE, xtol=1e-12, ftol=1e-12
    ).x
    return found


def _step_2(robot: Robot, turns: Sequence[Trajectory], integration: Integration) -> float:
    """Factor of the wheelbase from turns one way, Eq. (3)."""
    starts = np.array([run.start[2] for run in turns])
    turned = _ends(robot, turns, integration)[:, 2] - starts
    truth = np.array([run.final_pose[2] for run in turns]) - starts
    return float(turned @ turned / (turned @ truth))


def _ends(robot: Robot, runs: Sequence[Trajectory], integration: Integration) -> Array:
    """Final poses (n, 3) of runs by the odometry of a robot."""
    return np.concatenate(OdometryModel.of_design(robot, integration).poses([run.final_log for run in runs]))


def _changed(robot: Robot, radii: Array, wheelbase: float) -> Robot:
    """The robot with the radii (2,) of its measured wheels, and their distance, times factors."""
    return with_axle(robot, dict(zip(robot.wheel_names, radii.tolist(), strict=True)), wheelbase)


def _on_its_axle(robot: Robot) -> Robot:
    """The robot with the middle of its axle as its centre and tracked point."""
    left, right = (wheel.position for wheel in robot.measured)
    x, y = (left[0] + right[0]) / 2, (left[1] + right[1]) / 2
    wheels = [
        wheel.model_copy(update={"x": wheel.position[0] - x, "y": wheel.position[1] - y})
        if wheel.kind == "fixed"
        else wheel
        for wheel in robot.wheels
    ]
    return robot.model_copy(update={"wheels": tuple(wheels), "mount": None})
