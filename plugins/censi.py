"""Simultaneous calibration of a differential drive and of its sensor's mount in closed form, after Censi et al.

A. Censi, A. Franchi, L. Marchionni, G. Oriolo, "Simultaneous calibration of odometry and sensor parameters for mobile
robots", IEEE Transactions on Robotics 29:475-492 (2013). Wheels of radius r_L and r_R on an axle b turn at the rates
omega_L and omega_R; the sensor stands at the pose l = (l_x, l_y, l_theta) in the frame in the axle's middle. Of the six
parameters only the wheel rates and the sensor's own motion s = (s_x, s_y, s_theta) in each of many intervals are needed:

    J_21 = -r_L / b,    J_22 = r_R / b.                                                                   (1)

1. The sensor turns as the robot does. With the angles phi_L, phi_R by which the wheels turn in an interval,

    s_theta = J_21 phi_L + J_22 phi_R                                                                   (2)

   is linear, and least squares over the intervals give J_21 and J_22.
2. These give the turn within each interval, and thereby the robot's displacement b (c_x, c_y), which the odometry
   measures with an axle of length 1. As the sensor goes along, l + R(l_theta) s = b c + R(s_theta) l, with R(a) the turn
   by a; for theta = J_21 phi_L + J_22 phi_R these are two equations Q p = 0 of an interval in
   p = (b, l_x, l_y, cos l_theta, sin l_theta),

    Q = [ -c_x   1 - cos theta   sin theta       s_x   -s_y ]
        [ -c_y   -sin theta      1 - cos theta   s_y    s_x ].                                          (3)

   The sum M (5, 5) of Q^T Q over the intervals has the blocks A (3, 3), B (3, 2) and D (2, 2). The minimum of p^T M p
   with cos^2 + sin^2 = 1 has the last two elements in the direction of the eigenvector of

    D - B^T A^-1 B                                                                                      (4)

   with the smaller eigenvalue, and the others are -A^-1 B times these; of the two signs that one counts which makes
   b > 0. That is the article's solution by a Lagrange multiplier, the root of a quadratic equation.

The answer is the matrix of the tracked point at l. Where the problem holds the tracked point at its design place (mount:
known, the default for this class of robot), only what such a point can do is kept of it, and the reason names l.

From the article's public program (AndreaCensi/calibration) are (2) and (3). Different here:

- an interval lasts a fixed time between reference poses, and all count the same; the article weights by the covariances
  of scan matching, which reference poses do not have. The scan's own motion was measured apart for each interval there;
  neighbouring intervals share a pose here, so that the covariance of the article is not that of these data;
- the article's trimming of outliers is left out: its share was not at hand.

Noise of s is in Q, too, and biases (4) where it is large beside the motion in an interval (chosen: 2 s). It is for two
measured wheels on one axle, for runs on any paths that hold turns both to and fro and driving; m, rad, SI throughout.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError, NotApplicableError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.kinematics import Array, Mount, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.planar import relative, rotated
from omnibench.robot.robot_class import class_of
from omnibench.words import plural

_WORST_CONDITION = (
    1e10  # of the normal equations, in units of their diagonals: rounding would be seen above it (chosen)
)


class CensiOptions(Options):
    """How runs are cut into intervals."""

    interval: float = Field(2.0, gt=0, description="least length of an interval between two reference poses, s")


@calibrators.register("censi")
class Censi(Calibrator):
    """Censi et al. 2013: radii, axle and the tracked point's mount in closed form, from motions in short intervals."""

    Options = CensiOptions
    options: CensiOptions
    bounded = False
    stochastic = False
    only_for = "differential drives with two measured wheels"

    def applies(self, robot: Robot) -> bool:
        return class_of(robot) == "differential" and len(robot.measured) == 2

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Steps 1 and 2. NotApplicableError: the runs leave some of the six parameters open."""
        if problem.parameterisation.name != "matrix":
            raise ConfigError("censi gives a matrix; say parameterisation: matrix")
        ends = [_ends(run, self.options.interval) for run in problem.trajectories if run.has_poses]
        cut = [run for run in problem.trajectories if run.has_poses]
        turned = np.concatenate([np.diff(_angles(run)[kept], axis=0) for run, kept in zip(cut, ends, strict=True)])
        sensor = np.concatenate([_motions(run.poses[kept]) for run, kept in zip(cut, ends, strict=True)])
        rates = _solved(turned.T @ turned, turned.T @ sensor[:, 2], "turns of the robot")  # Eq. (2)
        unit = _unit_axle(problem.robot, rates)
        logs = [run.log(run.pose_times[kept]) for run, kept in zip(cut, ends, strict=True)]
        paths = OdometryModel(problem.robot, unit, problem.integration).poses(logs)
        robot = np.concatenate([_motions(path) for path in paths])
        axle, mount = _axle_and_mount(robot, sensor)
        matrix = mount.twist @ (unit * [[axle], [axle], [1.0]])
        signs = _signs(problem.robot)
        radii = ", ".join(
            f"{name} {1000 * axle * abs(rate):.3f}" for name, rate in zip(problem.robot.wheel_names, rates, strict=True)
        )
        if not (rates * signs > 0).all():
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
    solved = _solved(a, b, "driving and turns together")
    direction = np.linalg.eigh(d - b.T @ solved)[1][:, 0]  # Eq. (4): the smaller eigenvalue is first
    axle, l_x, l_y = -solved @ direction
    if axle < 0:
        axle, l_x, l_y, direction = -axle, -l_x, -l_y, -direction
    return float(axle), Mount(x=float(l_x), y=float(l_y), yaw=math.atan2(direction[1], direction[0]))


def _solved(squares: Array, right: Array, what: str) -> Array:
    """Solution of normal equations. NotApplicableError names what the runs lack if they leave it open."""
    scale = np.sqrt(np.diag(squares))
    if not (scale > 0).all() or np.linalg.cond(squares / np.outer(scale, scale)) > _WORST_CONDITION:
        raise NotApplicableError(f"it needs runs on curves of several kinds, and these leave it open ({what})")
    solution: Array = np.linalg.solve(squares, right)
    return solution


def _ends(run: Trajectory, interval: float) -> list[int]:
    """Indices of the reference poses that bound intervals no shorter than ``interval`` (s)."""
    kept = [0]
    for index, time in enumerate(run.pose_times):
        if time - run.pose_times[kept[-1]] >= interval * (1 - 1e-9):
            kept.append(index)
    return kept


def _angles(run: Trajectory) -> Array:
    """Angles (K, 2) by which the wheels have turned at each reference pose, rad."""
    return run.angles_at_poses


def _motions(poses: Array) -> Array:
    """Motions (K - 1, 3) between neighbouring poses (K, 3), each in the frame of the first of the two."""
    return relative(poses[:-1], poses[1:])


def _signs(robot: Robot) -> Array:
    """The signs (2,) of the wheels' parts in the rate of turn: 1 for the right wheel, -1 for the left one."""
    return np.sign(robot.inverse_kinematic_matrix[2])


def _unit_axle(robot: Robot, rates: Array) -> Array:
    """The matrix (3, 2) of the axle's middle for an axle of length 1 and given row 3, Eq. (1)."""
    ahead = np.abs(rates) / 2 * np.sign(rates * _signs(robot))
    return np.array([ahead, np.zeros(2), rates])
