"""OptiOdom after Sousa et al.: a length and the wheels' diameters by resilient propagation on positions.

R. B. Sousa, M. R. Petry, P. G. Costa, A. P. Moreira, "OptiOdom: a generic approach for odometry calibration of wheeled
mobile robots", J. Intell. Robot. Syst. 105:39 (2022), doi 10.1007/s10846-022-01630-3, and the authors' program.

For differential drives, tricycles, omni robots with three wheels and mecanum bases with four, on any paths that turn.
The parameters p (n,) are a length l, m (the distance between the wheels of a differential drive, of the wheel from the
axle of a tricycle, else the mean lever arm of the wheels), the diameters D_i, m, and of a tricycle the steering offset
a, rad. With l0, D0_i and C (3, M) as designed, and T (3, 3) the place of the tracked point, the matrix is

    K = T diag(1, 1, l0/l) C diag(D_1/D0_1, D_2/D0_2, ...),                                           (1)
    K = T diag(1, 1, l0/l) C (D/D0) [[cos a, -sin a], [sin a, cos a]]   of a tricycle.                  (2)

Every run is cut into path segments that begin at its start and end after every 0.5 m of the path that the design
drives, and at its end. With z(s) the position x + i y by odometry at the end s of a segment, and g(s) that of the
reference, the objective is

    E = sum_s |z(s) - g(s)|^2,                                                                       (3)

without headings. Let d(k) (M,) be the angles driven in sample k, rad, c(k) those driven up to its middle, v = (K1 + i
K2) . d, h = K3 . d / 2 and f = sin(h)/h exp(i K3 . c), so that odometry adds up steps v f; and e(k) the sum of the
errors z(s) - g(s) at all s of the run from sample k on. Then

    dE/dK1 = 2 sum_k Re(e* f) d,    dE/dK2 = -2 sum_k Im(e* f) d,                                     (4)
    dE/dK3 = 2 sum_k (-Im(e* v f) c + Re(e* v exp(i K3 . c)) d(sin(h)/h)/dh d / 2).                    (5)

iRprop- (Igel and Huesken) changes each parameter by a step of its own against the sign of its derivative. The step
grows by a factor of 1.005 while the sign stays, and is halved when it turns, after which the parameter rests once. The
smallest and largest steps and the rule that ends the search are the authors' for each robot. The first steps are the
smallest ones.

Differences from the authors' program. The odometry is the one that judges the outcome, while the authors turn every
step of an omni robot, an exact arc already, by another half of the sample's turn; the steering angle is that in the
middle of a sample, not at its end; the answer is the best of all steps, not the last; a mecanum base has one length,
(l1 + l2) / 2, in the place of two with the same derivatives. Where the rule ends the search before the minimum, such
details count: on OptiOdom's tricycle the search rests at 72 mm rms, the minimum has 54 mm, and the angle at the end
alone changes the mean final error by 4 %. On its omni robot the authors' step changes it by 2 % (m) and 5 % (deg).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from omnibench.data.dataset import Trajectory
from omnibench.errors import NotApplicableError
from omnibench.fit.article_methods import SegmentMethod, SegmentOptions, segment_ends
from omnibench.fit.calibrator import Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array, Robot, RobotClass, class_of
from omnibench.robot.odometry import Integration, chord_shares
from omnibench.words import plural

_GROWTH, _CUT = 1.005, 0.5  # factors on a step when the derivative keeps its sign, and when it does not
_TURNED = 0.2  # rad: least turn of a run away from its start; chosen, to tell a length from diameters at all
_SMALL = 1e-3  # rad: below it the slope of sin(h)/h is -h/3 to rounding of what it is used for


class Rule(NamedTuple):
    """The authors' settings for a robot: smallest and largest steps (m; of the offset rad), and the end of the search.

    It ends, after ``least`` steps, when the mean objective of the last ``window`` steps differs from that of the
    ``window`` steps before by less than the share ``change``.
    """

    smallest: tuple[float, float, float]  # length, diameters, offset
    largest: tuple[float, float, float]
    least: int
    window: int
    change: float


_WHEELS: dict[RobotClass, int] = {"differential": 2, "tricycle": 1, "omni": 3, "mecanum": 4}
_OMNI = Rule((1e-5, 1e-5, 0.0), (2.5e-4, 2.5e-4, 0.0), 50, 20, 1e-4)
_RULES: dict[RobotClass, Rule] = {
    "differential": Rule((1e-5, 1e-5, 0.0), (2.5e-4, 2.5e-4, 0.0), 30, 10, 1e-3),
    "tricycle": Rule((1e-5, 1e-4, 1e-3), (2.5e-4, 2.5e-3, 2.5e-2), 30, 10, 1e-3),
    "omni": _OMNI,
    "mecanum": _OMNI,
}


class OptiOdomOptions(SegmentOptions):
    """Segments of the paths, and the limit of the search."""

    steps: int = Field(1000, gt=0, description="most steps")


@calibrators.register("optiodom")
class OptiOdom(SegmentMethod):
    """A length and the wheels' diameters by resilient propagation on positions (Sousa et al. 2022)."""

    Options = OptiOdomOptions
    options: OptiOdomOptions
    only_for = "differential drives, tricycles, omni robots with three wheels and mecanum bases with four"

    def applies(self, robot: Robot) -> bool:
        return _WHEELS.get(class_of(robot)) == len(robot.measured)

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Step until the objective of Eq. (3) rests."""
        runs = self.runs_with_paths(problem, "positions")
        if all(np.abs(run.poses[:, 2] - run.start[2]).max() < _TURNED for run in runs):
            raise NotApplicableError("it is for paths that turn, and these are straight")
        geometry, rule = Geometry.of(problem.robot), _RULES[class_of(problem.robot)]
        segments = Segments(runs, geometry.design, self.options.segment, problem.integration)
        search = Rprop(geometry.spread(rule.smallest), geometry.spread(rule.largest))
        parameters, costs, best = geometry.start, list[float](), (math.inf, geometry.start)
        end, converged = "", False
        while not end:
            matrix, slopes = geometry.matrix(parameters)
            cost, gradient = segments.cost(matrix)
            costs.append(cost)
            best = min(best, (cost, parameters), key=lambda pair: pair[0])
            problem.report(len(costs), self.options.steps, "step", math.sqrt(best[0] / len(segments)))
            if converged := _rests(costs, rule):
                end = f"at rest after {len(costs)} steps"
            elif problem.seconds_left <= 0:
                end = f"time budget of {problem.budget.seconds:g} s spent after {plural(len(costs), 'step')}"
            elif len(costs) == self.options.steps:
                end = f"not at rest after {plural(len(costs), 'step')}"
            parameters = search.step(parameters, np.tensordot(slopes, gradient, 2))
        reason = f"{end}, {1e3 * math.sqrt(best[0] / len(segments)):.1f} mm rms: {geometry.in_words(best[1])}"
        return Solution(geometry.matrix(best[1])[0].ravel(), reason, converged)


class Rprop:
    """iRprop-: a step of its own for each parameter, by the sign of its derivative."""

    def __init__(self, smallest: Array, largest: Array) -> None:
        self._smallest, self._largest = smallest, largest
        self._steps, self._before = smallest, np.zeros(len(smallest))

    def step(self, parameters: Array, derivatives: Array) -> Array:
        """The parameters (n,) after a step against the signs of the objective's derivatives (n,) by them."""
        agreement = derivatives * self._before
        grown = np.minimum(self._steps * _GROWTH, self._largest)
        cut = np.maximum(self._steps * _CUT, self._smallest)
        self._steps = np.where(agreement > 0, grown, np.where(agreement < 0, cut, self._steps))
        self._before = np.where(agreement < 0, 0.0, derivatives)
        return parameters - np.sign(self._before) * self._steps


def _rests(costs: list[float], rule: Rule) -> bool:
    """True if the mean objective does not change any more."""
    if len(costs) < rule.least:
        return False
    last, earlier = sum(costs[-rule.window :]), sum(costs[-2 * rule.window : -rule.window])
    return abs(last - earlier) <= rule.change * earlier


@dataclass(frozen=True)
class Geometry:
    """The parameters of a robot, and its matrix by Eq. (1) or (2).

    start (n,): their values as designed. diameters: number of these. steered: True if an offset is the last parameter.
    """

    robot: Robot
    start: Array
    diameters: int
    steered: bool

    @classmethod
    def of(cls, robot: Robot) -> Geometry:
        """The design of a robot."""
        levers = np.array([wheel.lever for wheel in robot.measured])
        steered = class_of(robot) == "tricycle"
        length = float(np.abs(levers).mean())
        if steered:
            length = float(robot.radii[0] / np.hypot(*robot.centre_matrix[2]))
        elif class_of(robot) == "differential":
            length = float(np.ptp(levers))
        start = np.array([length, *(2 * robot.radii), *([0.0] if steered else [])])
        return cls(robot, start, len(robot.radii), steered)

    @property
    def design(self) -> Array:
        """The matrix (3, M) as designed."""
        return self.robot.inverse_kinematic_matrix

    def spread(self, values: tuple[float, float, float]) -> Array:
        """Values of a length, a diameter and an offset as those (n,) of all parameters."""
        return np.array([values[0], *[values[1]] * self.diameters, *[values[2]] * self.steered])

    def matrix(self, parameters: Array) -> tuple[Array, Array]:
        """The matrix (3, M) of parameters (n,), and its derivatives (n, 3, M) by them."""
        place = np.eye(3) if self.robot.mount is None else self.robot.mount.twist
        length, ratios = parameters[0], parameters[1 : 1 + self.diameters] / self.start[1 : 1 + self.diameters]
        centre = self.robot.centre_matrix * np.array([[1.0], [1.0], [self.start[0] / length]]) * ratios
        bend = np.zeros((3, 3))
        bend[2, 2] = -1 / length
        if not self.steered:
            columns = np.eye(self.diameters)[:, None, :] / parameters[1:, None, None]
            return place @ centre, np.concatenate([[place @ bend @ centre], place @ centre * columns])
        cosine, sine = math.cos(parameters[2]), math.sin(parameters[2])
        turned = centre @ np.array([[cosine, -sine], [sine, cosine]])
        by_offset = centre @ np.array([[-sine, -cosine], [cosine, -sine]])
        return place @ turned, np.array([place @ bend @ turned, place @ turned / parameters[1], place @ by_offset])

    def in_words(self, parameters: Array) -> str:
        """The parameters with their names, in mm and degrees."""
        diameters = zip(self.robot.wheel_names, 1e3 * parameters[1:], strict=False)
        words = f"length {1e3 * parameters[0]:.2f} mm, diameters {', '.join(f'{n} {d:.2f} mm' for n, d in diameters)}"
        return words + (f", steering offset {math.degrees(parameters[2]):+.2f} deg" if self.steered else "")


class Segments:
    """The segments of all runs, and the objective over them. Each run is in the frame of its own start pose."""

    def __init__(self, runs: list[Trajectory], design: Array, length: float, integration: Integration) -> None:
        self._arc = integration == "arc"
        cut = [_cut(run, design, length) for run in runs]
        self._driven = np.concatenate([driven for driven, _, _ in cut])  # d (F, M)
        before = np.concatenate([np.cumsum(driven, axis=0) - driven for driven, _, _ in cut])
        self._up_to = before + self._driven / 2 if self._arc else before  # c (F, M)
        self._samples = np.concatenate([samples for _, samples, _ in cut])  # of each segment's last piece, (S,)
        self._first = np.cumsum(self._samples) - self._samples
        edges = np.cumsum([0, *(len(samples) for _, samples, _ in cut)])
        self._begin, self._last = (np.repeat(edge, np.diff(edges)) for edge in (edges[:-1], edges[1:] - 1))
        self._reference = np.concatenate([moved for _, _, moved in cut])  # g (S,)

    def __len__(self) -> int:
        return len(self._reference)

    def cost(self, matrix: Array) -> tuple[float, Array]:
        """The objective of Eq. (3), m2, and its derivatives (3, M) by the elements of a matrix (3, M)."""
        speed = self._driven @ matrix[0] + 1j * (self._driven @ matrix[1])
        direction, half = self._up_to @ matrix[2], self._driven @ matrix[2] / 2
        turn = np.cos(direction) + 1j * np.sin(direction)
        share = chord_shares(half) if self._arc else np.ones(len(half))
        moved = np.add.reduceat(speed * turn * share, self._first)
        errors = self._summed(moved) - self._reference
        sums = self._summed(errors)
        tails = sums[self._last] - sums + errors  # e of each segment
        pulled = np.repeat(tails.conj(), self._samples) * turn  # e* exp(i K3 . c)
        by_position = (pulled * share) @ self._driven  # Eq. (4)
        pulled *= speed
        by_heading = -(pulled.imag * share) @ self._up_to  # Eq. (5)
        if self._arc:
            small = np.abs(half) < _SMALL
            slope = np.where(small, -half / 3, (np.cos(half) - share) / np.where(small, 1.0, half))
            by_heading += (pulled.real * slope) @ self._driven / 2
        gradient = 2 * np.array([by_position.real, -by_position.imag, by_heading])
        return float((errors.real**2 + errors.imag**2).sum()), gradient

    def _summed(self, values: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Sums (S,) of values (S,) from the first segment of each run on."""
        sums = np.cumsum(values)
        summed: NDArray[np.complex128] = sums - np.append(0.0, sums)[self._begin]
        return summed


def _cut(run: Trajectory, design: Array, length: float) -> tuple[Array, NDArray[np.intp], NDArray[np.complex128]]:
    """A run as pieces of constant rates: their angles (F, M), pieces in each segment (S,), positions (S,) at the ends.

    Samples are cut at the ends of the segments. Pieces in which no wheel turns are left out.
    """
    knots = np.append(0.0, run.times)
    driven = np.cumsum(run.signals * np.diff(knots)[:, None], axis=0)
    driven = np.vstack([np.zeros(driven.shape[1]), driven])
    ends = segment_ends(run, design, length)
    stamps = run.pose_times[ends]
    grid = np.union1d(run.times[run.times < stamps[-1]], stamps)
    at_grid = np.stack([np.interp(grid, knots, column) for column in driven.T], axis=1)
    pieces = np.diff(at_grid, axis=0, prepend=0.0)
    kept = pieces.any(axis=1) | np.isin(grid, stamps)
    samples = np.diff(np.searchsorted(grid[kept], stamps, side="right"), prepend=0)
    moved = run.poses[ends, :2] - run.start[:2]
    return pieces[kept], samples, (moved[:, 0] + 1j * moved[:, 1]) * np.exp(-1j * run.start[2])
