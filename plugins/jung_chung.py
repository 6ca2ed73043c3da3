"""Jung and Chung's calibration of a differential drive from the heading errors of closed squares driven both ways.

C. Jung, W. Chung, "Accurate calibration of two wheel differential mobile robots by using experimental heading errors",
IEEE International Conference on Robotics and Automation (ICRA), 4533-4538 (2012). It takes the squares of UMBmark, of
side L from a corner, clockwise (cw) and counter-clockwise (ccw), but the error e (rad) of the final heading, true less
that of the odometry, with the means e_cw and e_ccw. A wheelbase error turns the robot too little by alpha at each of
four corners, whichever way; unequal wheels turn it by beta along each of four sides, to the same side:

    alpha = (e_cw - e_ccw) / 8,    beta = (e_cw + e_ccw) / 8.                                         (1)

Unequal wheels also change the turn at a corner, along the way pi b_0 / 4 of each wheel, b_0 being the design wheelbase:

    gamma = pi b_0 beta / (4 L).                                                                      (2)

The true wheelbase b, and the ratio of the right wheel's diameter to the left one's, are

    E_b = (pi/2) / (pi/2 - (alpha + gamma)),    b = E_b b_0,                                          (3)
    R = (L/2) / sin(beta/2),    E_d = (R + b/2) / (R - b/2),                                          (4)

and with the mean diameter D kept, which squares do not show,

    D_right = 2 D / (1 + 1/E_d),    D_left = 2 D / (1 + E_d).                                         (5)

The article itself was not at hand. Formulas (1) to (5) are those that the authors of OptiOdom (J. Intell. Robot. Syst.
105:39, 2022) use for it. Two things are to be known about them.

- (2) is what a wrong right wheel beside a left one of design size makes. The correction (5) changes both and keeps
  their mean, which does not change a turn on the spot, so that (3) and (5) together make the wheelbase longer by the
  share (E_d - 1) / 2 than the headings say. It is kept as it is used; wheels that differ by 0.1 % make that 0.05 %.
- OptiOdom's program divides the mean angles e_cw and e_ccw by the number of runs once more, in its file
  computeEvaluationMeasures.m. Here they are the means, so that all of the heading errors is corrected, not a part.

Reconstructed here, and not the article's own:

- the odometry is that of the design matrix on the recorded wheel rates, and L a quarter of the way that it measures;
- where the wheels' design diameters differ, (5) multiplies each of them, and E_d is the ratio of these factors;
- a tracked point off the axle's middle is taken there by its design pose before anything is measured;
- a run counts as a square if its odometry stands at the corners of one after each quarter of its way.

It is for two measured wheels on one axle (m, rad, SI throughout), for runs of one session, and uses the squares among
these.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError, NotApplicableError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array, Mount, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.planar import compose, interpolated, relative, rotated
from omnibench.robot.robot_class import class_of
from omnibench.words import plural

_OFF_CORNER = 0.15  # share of the side: farthest of a square's odometry from its corners; a circle's is 1 (chosen)
_OFF_TURN = 0.5  # rad by which the odometry's whole turn may be off one (chosen: 7 degrees at each corner)


@dataclass(frozen=True)
class Square:
    """A square that was driven.

    side: m. way: 1 counter-clockwise, -1 clockwise. error (3,): true final pose less the odometry's, m, m, rad.
    """

    side: float
    way: int
    error: Array


@calibrators.register("jung_chung")
class JungChung(Calibrator):
    """Jung and Chung 2012: wheelbase and wheels from the final headings of squares driven both ways."""

    bounded = False
    as_is = True
    stochastic = False
    per_session = True
    only_for = "differential drives with two measured wheels"

    def applies(self, robot: Robot) -> bool:
        return class_of(robot) == "differential" and len(robot.measured) == 2

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Formulas (1) to (5). NotApplicableError: there are no squares, or they were driven one way only."""
        if problem.parameterisation.name != "matrix":
            raise ConfigError("jung_chung gives a matrix; say parameterisation: matrix")
        squares = squares_of(problem)
        clockwise = [square for square in squares if square.way < 0]
        counter = [square for square in squares if square.way > 0]
        if not clockwise or not counter:
            count = f"{plural(len(squares), 'square')} among {plural(len(problem.trajectories), 'run')}"
            which = (
                f"{count}, none clockwise" if counter else f"{count}, none counter-clockwise" if clockwise else "none"
            )
            raise NotApplicableError(f"it is for closed squares driven both ways from a corner (found: {which})")
        side = float(np.mean([square.side for square in squares]))
        axle = _axle(problem.robot)
        wheelbase, diameters = errors_of(self.mean_error(clockwise), self.mean_error(counter), side, axle)
        corrected = corrected_robot(problem.robot, wheelbase, diameters)
        left, right = _left_and_right(corrected)
        return Solution(
            corrected.inverse_kinematic_matrix.ravel(),
            f"wheelbase {1000 * _axle(corrected):.1f} mm (E_b {wheelbase:.4f}), radii {left} and {right} mm "
            f"(E_d {diameters:.4f}), from {len(clockwise)} clockwise and {len(counter)} counter-clockwise squares of "
            f"{side:.2f} m",
        )

    def mean_error(self, squares: Sequence[Square]) -> float:
        """Mean error of the final heading of squares one way, rad."""
        return float(np.mean([square.error[2] for square in squares]))


def errors_of(turn_clockwise: float, turn_counter: float, side: float, axle: float) -> tuple[float, float]:
    """E_b and E_d of the mean heading errors (rad) of squares of a side (m) and the design wheelbase (m)."""
    alpha, beta = (turn_clockwise - turn_counter) / 8, (turn_clockwise + turn_counter) / 8  # Eq. (1)
    gamma = math.pi * axle * beta / (4 * side)  # Eq. (2)
    wheelbase = (math.pi / 2) / (math.pi / 2 - (alpha + gamma))  # Eq. (3)
    bend = wheelbase * axle * math.sin(beta / 2) / side  # b/2 over R, which is infinite where beta is 0
    return wheelbase, (1 + bend) / (1 - bend)  # Eq. (4)


def corrected_robot(robot: Robot, wheelbase: float, diameters: float) -> Robot:
    """The robot with its axle E_b times as long and wheels of the diameter ratio E_d, Eq. (5)."""
    sides = _sides(robot)
    middle = _middle(robot)[:2]
    share = {wheel.name: 2 / (1 + diameters ** np.sign(sides[wheel.name])) for wheel in robot.measured}
    wheels = []
    for wheel in robot.wheels:
        if wheel.name not in share:
            wheels.append(wheel)
            continue
        x, y = (middle + wheelbase * (np.array(wheel.position) - middle)).tolist()
        wheels.append(wheel.model_copy(update={"radius": float(wheel.radius * share[wheel.name]), "x": x, "y": y}))
    return robot.model_copy(update={"wheels": tuple(wheels)})


def squares_of(problem: CalibrationProblem) -> list[Square]:
    """The closed squares among the training runs, by the odometry of the design."""
    runs = [run for run in problem.trajectories if run.has_poses]
    stamps = [np.append(run.times[run.times < run.end], run.end) for run in runs]
    model = OdometryModel.of_design(problem.robot, problem.integration)
    paths = model.poses([run.log(np.append(0.0, times)) for run, times in zip(runs, stamps, strict=True)])
    squares = [_square(problem.robot, run, path) for run, path in zip(runs, paths, strict=True)]
    return [square for square in squares if square is not None]


def _square(robot: Robot, run: Trajectory, path: Array) -> Square | None:
    """A run as a square; None if its odometry (K, 3) from the start to the last reference pose is none."""
    odometry = _of_axle(robot, path)
    odometry = relative(odometry[0], odometry)
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(odometry[:, :2], axis=0).T)))
    side, way = driven[-1] / 4, int(np.sign(odometry[-1, 2]))
    corners = np.array([[1.0, 0.0], [1.0, way], [0.0, way], [0.0, 0.0]])
    off = interpolated(side * np.arange(1, 5), driven, odometry[:, :2]) - side * corners
    if np.hypot(*off.T).max() > _OFF_CORNER * side or abs(abs(odometry[-1, 2]) - 2 * math.pi) > _OFF_TURN:
        return None
    truth = _of_axle(robot, run.poses[[0, -1]])
    return Square(float(side), way, relative(truth[0], truth[1]) - odometry[-1])


def _middle(robot: Robot) -> Array:
    """Pose (3,) of the axle's middle in the robot's frame, looking ahead; m, m, rad."""
    ahead = robot.motions[0]
    places = np.mean([wheel.position for wheel in robot.measured], axis=0)
    return np.array([*places, math.atan2(ahead[1], ahead[0])])


def _of_axle(robot: Robot, poses: Array) -> Array:
    """Poses (K, 3) of the axle's middle, from those of the tracked point."""
    mount = robot.mount or Mount()
    return compose(poses, relative(np.array([mount.x, mount.y, mount.yaw]), _middle(robot)))


def _sides(robot: Robot) -> dict[str, float]:
    """Distance of each measured wheel to the left of the axle's middle, m."""
    middle = _middle(robot)
    return {
        wheel.name: float(rotated(np.array(wheel.position) - middle[:2], -middle[2])[1]) for wheel in robot.measured
    }


def _axle(robot: Robot) -> float:
    """Distance of the two wheels, m."""
    return sum(abs(side) for side in _sides(robot).values())


def _left_and_right(robot: Robot) -> tuple[str, str]:
    """Name and radius, mm, of the left wheel and of the right one."""
    sides = _sides(robot)
    left, right = sorted(robot.measured, key=lambda wheel: -sides[wheel.name])
    return f"{left.name} {1000 * left.radius:.3f}", f"{right.name} {1000 * right.radius:.3f}"
