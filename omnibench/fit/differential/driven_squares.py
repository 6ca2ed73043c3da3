"""Closed squares that a differential drive has driven, which UMBmark and its successors calibrate by."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.errors import NotApplicableError
from omnibench.fit.calibrator import Solution
from omnibench.fit.differential.axle import axle_length, left_and_right, poses_of_axle, with_diameter_ratio
from omnibench.fit.problem import CalibrationProblem
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.planar import interpolated, relative
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


@dataclass(frozen=True)
class SquaresBothWays:
    """Squares that were driven clockwise and counter-clockwise; at least one each."""

    clockwise: tuple[Square, ...]
    counter: tuple[Square, ...]

    @property
    def side(self) -> float:
        """Mean side, m."""
        return float(np.mean([square.side for square in (*self.clockwise, *self.counter)]))

    @property
    def words(self) -> str:
        """Numbers and side in words."""
        return f"{len(self.clockwise)} clockwise and {len(self.counter)} counter-clockwise squares of {self.side:.2f} m"

    def solution(self, robot: Robot, wheelbase: float, diameters: float) -> Solution:
        """The robot with the wheelbase times a factor E_b and the wheels' diameters in a ratio E_d, right to left."""
        corrected = with_diameter_ratio(robot, diameters, wheelbase)
        left, right = left_and_right(corrected)
        return Solution(
            corrected.inverse_kinematic_matrix.ravel(),
            f"wheelbase {1000 * axle_length(corrected):.1f} mm (E_b {wheelbase:.4f}), radii {left} and {right} mm "
            f"(E_d {diameters:.4f}), from {self.words}",
        )


def squares_both_ways(problem: CalibrationProblem) -> SquaresBothWays:
    """The closed squares among the training runs, by the odometry of the design.

    NotApplicableError: there are none, or they were driven one way only.
    """
    runs = [run for run in problem.trajectories if run.has_poses]
    stamps = [np.append(run.times[run.times < run.end], run.end) for run in runs]
    model = OdometryModel.of_design(problem.robot, problem.integration)
    paths = model.poses([run.log(np.append(0.0, times)) for run, times in zip(runs, stamps, strict=True)])
    found = [_square(problem.robot, run, path) for run, path in zip(runs, paths, strict=True)]
    squares = [square for square in found if square is not None]
    clockwise = tuple(square for square in squares if square.way < 0)
    counter = tuple(square for square in squares if square.way > 0)
    if not clockwise or not counter:
        count = f"{plural(len(squares), 'square')} among {plural(len(problem.trajectories), 'run')}"
        which = f"{count}, none clockwise" if counter else f"{count}, none counter-clockwise" if clockwise else "none"
        raise NotApplicableError(f"it is for closed squares driven both ways from a corner (found: {which})")
    return SquaresBothWays(clockwise, counter)


def _square(robot: Robot, run: Trajectory, path: Array) -> Square | None:
    """A run as a square; None if its odometry (K, 3) from the start to the last reference pose is none."""
    odometry = poses_of_axle(robot, path)
    odometry = relative(odometry[0], odometry)
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(odometry[:, :2], axis=0).T)))
    side, way = driven[-1] / 4, int(np.sign(odometry[-1, 2]))
    corners = np.array([[1.0, 0.0], [1.0, way], [0.0, way], [0.0, 0.0]])
    off = interpolated(side * np.arange(1, 5), driven, odometry[:, :2]) - side * corners
    if np.hypot(*off.T).max() > _OFF_CORNER * side or abs(abs(odometry[-1, 2]) - 2 * math.pi) > _OFF_TURN:
        return None
    truth = poses_of_axle(robot, run.poses[[0, -1]])
    return Square(float(side), way, relative(truth[0], truth[1]) - odometry[-1])
