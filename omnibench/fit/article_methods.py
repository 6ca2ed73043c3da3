"""What calibrators of published articles share: answers that stand as they are, segments of paths, and driven squares.

Methods for two wheels on one axle share its middle, its length, and robots that differ in both; those for the squares
that such a robot drives both ways share these.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from omnibench.data.dataset import Trajectory
from omnibench.errors import NotApplicableError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options
from omnibench.robot.kinematics import Array, Mount, Robot, class_of, compose, interpolated, relative, rotated
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

TWO_WHEELS = "differential drives with two measured wheels"
_OFF_CORNER = 0.15  # share of the side: farthest of a square's odometry from its corners; a circle's is 1 (chosen)
_OFF_TURN = 0.5  # rad by which the odometry's whole turn may be off one (chosen: 7 degrees at each corner)
_ROUNDING = 1e-9  # share of a segment's length


class ArticleMethod(Calibrator):
    """A method whose matrix is the answer of an article's formulas: no box, no seed, no shrinking to the design."""

    bounded = False
    as_is = True
    stochastic = False


class SegmentOptions(Options):
    """Segments of the paths."""

    segment: float = Field(0.5, gt=0, description="a segment ends after every such length of the path, m")


class SegmentMethod(ArticleMethod):
    """A method that compares the odometry with reference poses at the ends of segments of the path."""

    Options = SegmentOptions

    def runs_with_paths(self, problem: CalibrationProblem, of_what: str = "poses") -> list[Trajectory]:
        """The runs with more than one pose. NotApplicableError: there are none. of_what: poses or positions."""
        self.needs_matrix(problem)
        runs = [run for run in problem.trajectories if run.has_poses and len(run.pose_times) > 1]
        if not runs:
            raise NotApplicableError(f"it fits reference {of_what} along the path, and no run has more than one")
        return runs


def segment_ends(run: Trajectory, design: Array, length: float) -> NDArray[np.intp]:
    """Indices (S,) of the reference poses at which the segments of a run end; the last one ends with the run.

    design (3, M): the matrix that measures the path. length: of a segment, m, at least.
    """
    steps = np.hypot(*(design[:2] @ run.signals.T)) * np.diff(run.times, prepend=0.0)
    at_poses = np.interp(run.pose_times, np.append(0.0, run.times), np.append(0.0, np.cumsum(steps)))
    ends, begun, last = list[int](), 0.0, len(at_poses) - 1
    for index, driven in enumerate(at_poses):
        if driven - begun >= length * (1 - _ROUNDING):
            ends.append(index)
            begun = driven
    return np.array(ends if ends and ends[-1] == last else [*ends, last])


def has_two_wheels(robot: Robot) -> bool:
    """True for a differential drive with two measured wheels."""
    return class_of(robot) == "differential" and len(robot.measured) == 2


class TwoWheelMethod(ArticleMethod):
    """An article's method for a differential drive with two measured wheels."""

    only_for = TWO_WHEELS

    def applies(self, robot: Robot) -> bool:
        """True for a differential drive with two measured wheels."""
        return has_two_wheels(robot)


def middle_of_axle(robot: Robot) -> Array:
    """Pose (3,) of the axle's middle in the robot's frame, looking ahead; m, m, rad."""
    ahead = robot.motions[0]
    places = np.mean([wheel.position for wheel in robot.measured], axis=0)
    return np.array([*places, math.atan2(ahead[1], ahead[0])])


def poses_of_axle(robot: Robot, poses: Array) -> Array:
    """Poses (K, 3) of the axle's middle, from those of the tracked point."""
    mount = robot.mount or Mount()
    return compose(poses, relative(np.array([mount.x, mount.y, mount.yaw]), middle_of_axle(robot)))


def sides_of_axle(robot: Robot) -> dict[str, float]:
    """Distance of each measured wheel to the left of the axle's middle, m."""
    middle = middle_of_axle(robot)
    return {
        wheel.name: float(rotated(np.array(wheel.position) - middle[:2], -middle[2])[1]) for wheel in robot.measured
    }


def axle_length(robot: Robot) -> float:
    """Distance of the two wheels, m."""
    return sum(abs(side) for side in sides_of_axle(robot).values())


def with_axle(robot: Robot, radii: Mapping[str, float], length: float) -> Robot:
    """The robot with the radii of its measured wheels, by name, and the length of its axle times factors."""
    middle = middle_of_axle(robot)[:2]
    wheels = []
    for wheel in robot.wheels:
        if wheel.name in radii:
            x, y = (middle + length * (np.array(wheel.position) - middle)).tolist()
            wheel = wheel.model_copy(update={"radius": float(wheel.radius * radii[wheel.name]), "x": x, "y": y})
        wheels.append(wheel)
    return robot.model_copy(update={"wheels": tuple(wheels)})


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

    def solution(self, robot: Robot, wheelbase: float, diameters: float) -> Solution:
        """The robot with the wheelbase times a factor E_b and the wheels' diameters in a ratio E_d, right to left.

        With the mean D of the diameters, D_right = 2 D / (1 + 1/E_d) and D_left = 2 D / (1 + E_d) (Borenstein and Feng,
        IEEE T-RA 12:869, 1996); where the design's differ, each is multiplied.
        """
        sides = sides_of_axle(robot)
        factors = {name: 2 / (1 + diameters ** float(np.sign(side))) for name, side in sides.items()}
        corrected = with_axle(robot, factors, wheelbase)
        sides = sides_of_axle(corrected)
        wheels = sorted(corrected.measured, key=lambda wheel: -sides[wheel.name])
        left, right = (f"{wheel.name} {1000 * wheel.radius:.3f}" for wheel in wheels)
        return Solution(
            corrected.inverse_kinematic_matrix.ravel(),
            f"wheelbase {1000 * axle_length(corrected):.1f} mm (E_b {wheelbase:.4f}), radii {left} and {right} mm "
            f"(E_d {diameters:.4f}), from {len(self.clockwise)} clockwise and {len(self.counter)} counter-clockwise "
            f"squares of {self.side:.2f} m",
        )


def squares_both_ways(problem: CalibrationProblem) -> SquaresBothWays:
    """The closed squares among the training runs, by the odometry of the design.

    NotApplicableError: there are none, or they were driven one way only.
    """
    runs = [run for run in problem.trajectories if run.has_poses]
    stamps = [np.append(run.times[run.times < run.end], run.end) for run in runs]
    robot, squares = problem.robot, list[Square]()
    model = OdometryModel.of_design(robot, problem.integration)
    paths = model.poses([run.log(np.append(0.0, times)) for run, times in zip(runs, stamps, strict=True)])
    for run, path in zip(runs, paths, strict=True):
        odometry = poses_of_axle(robot, path)
        odometry = relative(odometry[0], odometry)
        driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(odometry[:, :2], axis=0).T)))
        side, way = float(driven[-1] / 4), int(np.sign(odometry[-1, 2]))
        corners = np.array([[1.0, 0.0], [1.0, way], [0.0, way], [0.0, 0.0]])
        off = interpolated(side * np.arange(1, 5), driven, odometry[:, :2]) - side * corners
        if np.hypot(*off.T).max() <= _OFF_CORNER * side and abs(abs(odometry[-1, 2]) - 2 * math.pi) <= _OFF_TURN:
            truth = poses_of_axle(robot, run.poses[[0, -1]])
            squares.append(Square(side, way, relative(truth[0], truth[1]) - odometry[-1]))
    clockwise = tuple(square for square in squares if square.way < 0)
    counter = tuple(square for square in squares if square.way > 0)
    if not clockwise or not counter:
        count = f"{plural(len(squares), 'square')} among {plural(len(problem.trajectories), 'run')}"
        which = f"{count}, none clockwise" if counter else f"{count}, none counter-clockwise" if clockwise else "none"
        raise NotApplicableError(f"it is for closed squares driven both ways from a corner (found: {which})")
    return SquaresBothWays(clockwise, counter)


class SquaresMethod(TwoWheelMethod):
    """A method that finds wheelbase and wheels from the mean errors of squares driven both ways, within one session.

    coordinate: of a square's error that it reads: 0 along the first side, m, 2 the final heading, rad.
    """

    per_session = True
    coordinate: ClassVar[int]

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Apply the article's formulas. NotApplicableError: there are no squares, or they were driven one way only."""
        self.needs_matrix(problem)
        squares = squares_both_ways(problem)
        clockwise, counter = self.mean_error(squares.clockwise), self.mean_error(squares.counter)
        factors = self.factors(clockwise, counter, squares.side, axle_length(problem.robot))
        return squares.solution(problem.robot, *factors)

    def mean_error(self, squares: Sequence[Square]) -> float:
        """Mean error of squares that were driven one way."""
        return float(np.mean([square.error[self.coordinate] for square in squares]))

    @abstractmethod
    def factors(self, clockwise: float, counter: float, side: float, axle: float) -> tuple[float, float]:
        """E_b and E_d of the mean errors each way, for squares of a side (m) and the design wheelbase (m)."""
