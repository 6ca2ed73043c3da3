"""Simultaneous calibration of a differential drive and of its sensor's mount in closed form, after Censi et al.

A. Censi, A. Franchi, L. Marchionni, G. Oriolo, "Simultaneous calibration of odometry and sensor parameters for mobile
robots", IEEE Transactions on Robotics 29:475-492 (2013). Wheels of radius r_L and r_R on an axle b turn at the rates
omega_L and omega_R; the sensor stands at the pose l = (l_x, l_y, l_theta) in the frame in the axle's middle. These six
parameters follow from the wheel rates and the sensor's own motions s = (s_x, s_y, s_theta) in many intervals of time:

    J_21 = -r_L / b,    J_22 = r_R / b.                                                                   (1)

1. The sensor turns as the robot does. With the angles phi_L, phi_R by which the wheels turn in an interval,

    s_theta = J_21 phi_L + J_22 phi_R                                                                   (2)

   is linear, and least squares over the intervals give J_21 and J_22.
2. These give the turn theta = J_21 phi_L + J_22 phi_R within each interval, and thereby the robot's displacement
   b (c_x, c_y), which the odometry measures with an axle of length 1. The sensor goes along, so that
   l + R(l_theta) s = b c + R(theta) l, with R(a) the turn by a. These are two equations Q p = 0 of an interval in
   p = (b, l_x, l_y, cos l_theta, sin l_theta),

    Q = [ -c_x   1 - cos theta   sin theta       s_x   -s_y ]
        [ -c_y   -sin theta      1 - cos theta   s_y    s_x ].                                          (3)

   The sum M (5, 5) of Q^T Q over the intervals has the blocks A (3, 3), B (3, 2) and D (2, 2). The minimum of p^T M p
   with cos^2 + sin^2 = 1 has the last two elements in the direction of the eigenvector of

    D - B^T A^-1 B                                                                                      (4)

   with the smaller eigenvalue, and the others are -A^-1 B times these; of the two signs that one counts which makes
   b > 0. That is the article's solution by a Lagrange multiplier, the root of a quadratic equation.

The answer is the matrix of the tracked point at l. Where the problem holds the tracked point at its design place
(mount: known, the default for this class of robot), what such a point cannot do is taken from it; the reason names l.

From the article's public program (AndreaCensi/calibration) are (2) and (3). Different here:

- an interval lasts a fixed time between reference poses, and all count the same; the article weights by the covariances
  of scan matching, which reference poses do not have. The scan's own motion was measured apart for each interval there;
  neighbouring intervals share a pose here, so that the covariance of the article is not that of these data;
- the article's trimming of outliers is left out: its share was not at hand.

Noise of s is in Q, too, and biases (4) where it is large beside the motion in an interval. Of intervals of 2 to 16 s on
OptiOdom's circles all give the same errors of the final poses within 2 %, of 0.5 s errors larger by a third. It is for
two measured wheels on one axle, for runs on any paths that both drive and turn; m, rad, SI throughout.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from omnibench.data.dataset import Trajectory
from omnibench.errors import NotApplicableError
from omnibench.fit.article_methods import TwoWheelMethod
from omnibench.fit.calibrator import Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.kinematics import Array, Mount, Robot, relative
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

# Of the normal equations, in units of their diagonals: rounding would be seen above it (chosen).
_WORST_CONDITION = 1e10
_WORST_SPREAD = 0.1  # share of the axle: a tape measure does better than a larger standard error (chosen)
_LACKING = "it needs runs that both drive and turn, and these leave parameters open"


class CensiOptions(Options):
    """How runs are cut into intervals."""

    interval: float = Field(2.0, gt=0, description="least length of an interval between two reference poses, s")


@calibrators.register("censi")
class Censi(TwoWheelMethod):
    """Censi et al. 2013: radii, axle and the tracked point's mount in closed form, from motions in short intervals."""

    Options = CensiOptions
    options: CensiOptions

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Steps 1 and 2. NotApplicableError: the runs leave some of the six parameters open."""
        self.needs_matrix(problem)
        runs = [run for run in problem.trajectories if run.has_poses]
        if not runs:
            raise NotApplicableError("it needs reference poses, and these runs have none after the start")
        ends = [_ends(run, self.options.interval) for run in runs]
        turned = np.concatenate(
            [np.diff(run.angles_at_poses[kept], axis=0) for run, kept in zip(runs, ends, strict=True)]
        )
        sensor = np.concatenate([_motions(run.poses[kept]) for run, kept in zip(runs, ends, strict=True)])
        rates = _solved(turned.T @ turned, turned.T @ sensor[:, 2], "the two wheels")  # Eq. (2)
        unit = _unit_axle(problem.robot, rates)
        logs = [run.log(run.pose_times[kept]) for run, kept in zip(runs, ends, strict=True)]
        paths = OdometryModel(problem.robot, unit, problem.integration).poses(logs)
        robot = np.concatenate([_motions(path) for path in paths])
        axle, mount = _axle_and_mount(robot, sensor)
        matrix = mount.twist @ (unit * [[axle], [axle], [1.0]])
        radii = ", ".join(
            f"{name} {1000 * axle * abs(rate):.3f}" for name, rate in zip(problem.robot.wheel_names, rates, strict=True)
        )
        if not (rates * problem.robot.centre_matrix[2] > 0).all():
            raise NotApplicableError(f"the wheels turn the robot the wrong way (radii {radii} mm); check the recording")
        return Solution(
            matrix.ravel(),
            f"radii {radii} mm, axle {1000 * axle:.1f} mm, tracked point {1000 * mount.x:.1f} mm ahead and "
            f"{1000 * mount.y:.1f} mm to the left of its middle, turned by {math.degrees(mount.yaw):.2f} deg, from "
            f"{plural(len(sensor), 'interval')}",
        )


def _axle_and_mount(robot: Array, sensor: Array) -> tuple[float, Mount]:
    """b and l from motions (n, 3) of the robot with an axle of length 1 and of the sensor, Eq. (3) and (4)."""
    (x, y, turn), (s_x, s_y, _) = robot.T, sensor.T
    stays, sine = 1 - np.cos(turn), np.sin(turn)
    equations = np.vstack(
        [np.column_stack([-x, stays, sine, s_x, -s_y]), np.column_stack([-y, -sine, stays, s_y, s_x])]
    )
    squares = equations.T @ equations
    a, b, d = squares[:3, :3], squares[:3, 3:], squares[3:, 3:]
    solved = _solved(a, b, "the axle and the mount")
    direction = np.linalg.eigh(d - b.T @ solved)[1][:, 0]  # Eq. (4): the smaller eigenvalue is first
    axle, l_x, l_y = -solved @ direction
    if axle < 0:
        axle, l_x, l_y, direction = -axle, -l_x, -l_y, -direction
    residuals = equations @ [axle, l_x, l_y, *direction]
    spread = math.sqrt(residuals @ residuals / max(len(residuals) - 4, 1) * np.linalg.inv(a)[0, 0])
    if spread > _WORST_SPREAD * axle:
        raise NotApplicableError(f"{_LACKING} (the axle's standard error is {100 * spread / axle:.0f} %)")
    return float(axle), Mount(x=float(l_x), y=float(l_y), yaw=math.atan2(direction[1], direction[0]))


def _solved(squares: Array, right: Array, what: str) -> Array:
    """Solution of normal equations. NotApplicableError names what the runs lack if they leave it open."""
    scale = np.sqrt(np.diag(squares))
    if not (scale > 0).all() or np.linalg.cond(squares / np.outer(scale, scale)) > _WORST_CONDITION:
        raise NotApplicableError(f"{_LACKING} ({what} cannot be told apart)")
    solution: Array = np.linalg.solve(squares, right)
    return solution


def _ends(run: Trajectory, interval: float) -> list[int]:
    """Indices of the reference poses that bound intervals of ``interval`` (s) or more; the last ends with the run."""
    kept = [0]
    for index, time in enumerate(run.pose_times):
        if time - run.pose_times[kept[-1]] >= interval * (1 - 1e-9):
            kept.append(index)
    return [*(kept[:-1] if len(kept) > 1 else kept), len(run.pose_times) - 1]


def _motions(poses: Array) -> Array:
    """Motions (K - 1, 3) between neighbouring poses (K, 3), each in the frame of the first of the two."""
    return relative(poses[:-1], poses[1:])


def _unit_axle(robot: Robot, rates: Array) -> Array:
    """The matrix (3, 2) of the axle's middle for an axle of length 1 and the row 3 of Eq. (1)."""
    ahead = np.sign(robot.motions[0][:2] @ robot.centre_matrix[:2])  # 1: a positive rate of the wheel drives ahead
    return np.array([ahead * np.abs(rates) / 2, np.zeros(2), rates])
