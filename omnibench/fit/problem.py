"""The calibration problem: all that a calibrator is given, and the evaluation of candidates within a budget."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from omnibench.config import Model
from omnibench.data.dataset import Trajectory
from omnibench.data.stored_rows import median_period
from omnibench.errors import DataError
from omnibench.fit.cost import Cost
from omnibench.fit.evaluator import (
    DrivenFrame,
    ElementBox,
    PartedEvaluator,
    PoseEvaluator,
    make_evaluator,
    make_parted_evaluator,
)
from omnibench.fit.geometry import GeometryLimits, WheelGeometry
from omnibench.fit.loss import RobustCost, moved_ends_in_words, norms_of, with_ends_from_others
from omnibench.fit.open_combinations import with_open_combinations
from omnibench.fit.parameterisation import (
    Box,
    MatrixElements,
    Parameterisation,
    ParameterisationName,
)
from omnibench.fit.prior import MountChoice, default_mount
from omnibench.fit.reference_rows import ReferenceBatch
from omnibench.fit.span import Unidentified, directions_kept, driven_span
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration, OdometryBatch
from omnibench.robot.stored_odometry import StoredOdometry

_PROGRESS_PERIOD = 0.1  # s, least time between two reports of progress: ten a second are all that a reader sees
_MOST_POSES = 4_000_000  # poses of candidates that are held together, 0.1 GB (chosen)
# Evaluations from which on the fast evaluator repays the time it takes to build. Both ways give the same costs to 1e-11
# m; half of it and twice change no estimate (tests/studies/constants_fit.py).
_WORTH_BUILDING = 50
# Of runs that are read where they are used: building takes 19 us a sample, one evaluation 0.05 us (chosen).
_WORTH_BUILDING_OF_STORED = 400
_ON_BOUND = 1e-6  # share of the box's width: an element closer than that to a bound lies on it
_ROUNDING = 1e-12  # share of a bound: an element beyond it by less lies in the box


class Budget(Model):
    """Limits of one run of a calibrator."""

    evaluations: int = Field(60_000, gt=0, description="candidates that may be evaluated")
    seconds: float = Field(600.0, gt=0, description="wall time, s")


class BudgetSpent(Exception):  # noqa: N818 (not an error: the run is over)
    """Raised by ``problem.cost`` when the budget is spent; calibrators let it pass.

    kind: ``budget`` (evaluations) or ``time``.
    """

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind


@dataclass(frozen=True)
class Improvement:
    """A new best cost, and after how many evaluations and seconds it was found."""

    evaluations: int
    seconds: float
    cost: float


class CalibrationProblem:
    """Training trajectories, a start, a box, a budget and a cost to be minimised.

    trajectories: the training runs; a calibrator cannot reach the validation runs. ends_moved: names of those whose
    start (or end) has jumped, and is taken from the poses beside it, as a robust loss does (fit/loss.py).
    start (n,): the vector of the design values; lower, upper (n,): its box; names: of its n elements.
    free (n,): True for elements that may be searched; the others keep their start values.
    objective: the Cost. cost(candidates): its values, counted against the budget and recorded; a search calls this.
    values(candidates): the same values, neither counted nor recorded; for judging an answer, not for searching.
    rng: the only source of randomness that a calibrator may use.
    best_vector, best_cost: the best candidate in the box so far; the start and infinity before the first.
    history: every improvement of the best cost.
    watch: told the evaluations and the best cost so far, at most every 0.1 s.
    shrinks: True if the answer is shrunk to the design afterwards (shrinkage.py).
    """

    def __init__(
        self,
        robot: Robot,
        trajectories: Sequence[Trajectory],
        cost: Cost,
        parameterisation: Parameterisation,
        *,
        integration: Integration,
        budget: Budget,
        seed: int,
        shrinks: bool = False,
        watch: Reporter = no_progress,
    ) -> None:
        if not trajectories:
            raise DataError("no trajectories; nothing can be calibrated")
        self.robot = robot
        self.trajectories = tuple(trajectories)
        self.ends_moved: tuple[str, ...] = ()
        if isinstance(cost, RobustCost):
            self.trajectories, self.ends_moved = with_ends_from_others(
                self.trajectories, robot, integration, cost.of_poses, last=cost.stamps == "final"
            )
        self.objective = cost
        self.parameterisation = parameterisation
        self.shrinks = shrinks
        self.integration: Integration = integration
        self.budget = budget
        self.seed = seed
        self.rng = np.random.default_rng(seed)
        bounds = parameterisation.bounds
        self.box = bounds.name
        self.names = parameterisation.names
        self.odometry = cost.batch(self.trajectories, integration)
        # x, y and heading contiguous, the memory order in which the odometry returns poses.
        self.reference = _frozen(np.ascontiguousarray(cost.reference(self.trajectories).T)).T
        self.start = _frozen(parameterisation.start)
        relevant = self._relevant()
        self.lower = _frozen(np.where(relevant, bounds.lower, self.start))
        self.upper = _frozen(np.where(relevant, bounds.upper, self.start))
        self.free: NDArray[np.bool_] = _frozen(self.upper > self.lower)
        self.evaluations = 0
        self.best_vector = self.start
        self.best_cost = np.inf
        self.history: list[Improvement] = []
        self._evaluator: PoseEvaluator | PartedEvaluator | None = None
        self._frame: DrivenFrame | None = None  # of the evaluator's matrices, where directions are kept
        self._evaluator_tried = False
        self._watch = watch
        self._began = time.perf_counter()  # s, of that clock, when the problem was made
        self._shown = 0.0  # s after that when ``watch`` was last called

    @property
    def size(self) -> int:
        """The length n of the vector."""
        return len(self.start)

    @property
    def sample_period(self) -> float:
        """The median time between wheel samples, s."""
        return median_period(self.trajectories)

    @property
    def moved_ends(self) -> tuple[str, ...]:
        """A sentence on the runs whose start or end has jumped; none where none has."""
        last = self.objective.stamps == "final"
        return moved_ends_in_words(self.ends_moved, len(self.trajectories), last=last)

    @property
    def remaining(self) -> int:
        """Evaluations that the budget still allows."""
        return self.budget.evaluations - self.evaluations

    @property
    def seconds(self) -> float:
        """Wall time since the problem was made."""
        return time.perf_counter() - self._began

    @property
    def seconds_left(self) -> float:
        """Wall time that the budget still allows, s; for methods that ask for no costs."""
        return self.budget.seconds - self.seconds

    def report(self, done: int, total: int, unit: str, best: float | None = None) -> None:
        """Report the progress of a method that asks for no costs, which are reported by themselves."""
        if self.seconds - self._shown > _PROGRESS_PERIOD:
            self._shown = self.seconds
            self._watch(Progress("search", done, total, unit, best))

    def cost(self, candidates: Array) -> Array:
        """Costs (P,) of candidates (P, n), counted against the budget.

        A candidate that cannot be evaluated costs NaN. BudgetSpent is raised when the budget is spent; of a population
        that is larger than the remaining budget the first candidates are evaluated, and count, before it is raised.
        Where runs are read from files, and no fast evaluator is built, that holds for the time, too.
        """
        candidates = np.array(candidates, dtype=float, ndmin=2)
        if candidates.shape[1:] != self.start.shape:
            raise ValueError(f"candidates have shape {candidates.shape}, expected (P, {self.size})")
        self._check_budget()
        asked = len(candidates)
        candidates = candidates[: self.remaining]
        values, count = np.empty(len(candidates)), 0
        while count < len(candidates):
            if not self._evaluator_tried and self._repays_building(len(candidates) - count):
                self.build_evaluator()
            part = candidates[count : count + self._in_time]
            costs = self._fast_values(part, self._evaluator) if self._evaluator else self.values(part)
            values[count : count + len(part)] = costs
            self._record(part, costs)
            count += len(part)
            if count < asked:
                self._check_budget()
        return values

    def values(self, candidates: Array) -> Array:
        """Costs (P,) of candidates (P, n) by direct integration, not counted: for scoring an answer."""
        with np.errstate(all="ignore"):
            matrices = self.parameterisation.matrices(candidates)
            return np.concatenate([self._costs_of_poses(self.odometry.poses(part)) for part in self._parts(matrices)])

    def build_evaluator(self) -> PoseEvaluator | PartedEvaluator | None:
        """The fast evaluator, which ``cost`` uses from now on; None where direct integration is faster.

        There is none for references other than poses either.

        ``cost`` builds it by itself when a search asks for many candidates. Both ways give the same costs to 1e-11.
        """
        if not self._evaluator_tried and isinstance(self.odometry, OdometryBatch):
            logs, odometry, searched = self.objective.logs(self.trajectories), self.odometry, self.parameterisation
            if isinstance(searched, MatrixElements) and len(searched.null):
                self._frame = DrivenFrame.of(searched)
            box = ElementBox.of(self._frame or searched, self.lower, self.upper)
            if isinstance(odometry, StoredOdometry):
                self._evaluator = make_parted_evaluator(logs, self.integration, box, self._frame)
            else:
                if self._frame is not None:
                    logs = self._frame.logs(logs)
                    odometry = OdometryBatch(logs, self.integration)
                self._evaluator = make_evaluator(odometry, logs, self.integration, box)
        self._evaluator_tried = True
        return self._evaluator

    def to_unit(self, vectors: Array) -> Array:
        """Vectors (P, n) as points (P, f) of the unit cube over the f free elements, clipped to it."""
        free = self.free
        points = (np.atleast_2d(vectors)[:, free] - self.lower[free]) / (self.upper - self.lower)[free]
        return np.clip(points, 0.0, 1.0)

    def from_unit(self, points: Array) -> Array:
        """Points (P, f) of the unit cube over the free elements as vectors (P, n), clipped to the box."""
        points = np.atleast_2d(points)
        vectors = np.empty((len(points), self.size))
        vectors[:] = self.start
        low, high = self.lower[self.free], self.upper[self.free]
        vectors[:, self.free] = np.minimum(np.maximum(low + points * (high - low), low), high)
        return vectors

    def inside(self, vectors: Array) -> NDArray[np.bool_]:
        """True (P,) for the vectors (P, n) that lie in the box, up to rounding."""
        slack = _ROUNDING * np.maximum(np.abs(self.lower), np.abs(self.upper))
        within = (vectors >= self.lower - slack) & (vectors <= self.upper + slack)
        return np.asarray(within.all(axis=-1))

    def at_bounds(self, vector: Array) -> tuple[str, ...]:
        """Names of the free elements that lie on a bound of the box."""
        return tuple(name for name, touching in zip(self.names, self.on_bounds(vector), strict=True) if touching)

    def on_bounds(self, vectors: Array) -> NDArray[np.bool_]:
        """True (..., n) for the free elements of vectors (..., n) that lie on a bound of the box."""
        margin = _ON_BOUND * (self.upper - self.lower)
        return np.asarray(self.free & ((vectors <= self.lower + margin) | (vectors >= self.upper - margin)))

    def without_interval(self, at_bounds: tuple[str, ...]) -> NDArray[np.bool_]:
        """True (n,) for the elements that the fit could not move both ways: on a bound of the box, or held by it."""
        return np.asarray(np.isin(self.names, (*at_bounds, *self.held)))

    @property
    def held(self) -> tuple[str, ...]:
        """Names of the elements that keep their start value, since the box has no width or the cost ignores them."""
        return tuple(name for name, free in zip(self.names, self.free, strict=True) if not free)

    def matrix(self, vector: Array) -> Array:
        """The inverse kinematic matrix (3, N) of one vector (n,)."""
        return self.parameterisation.matrices(vector[None])[0]

    def settled(self, vector: Array) -> Array:
        """The clipped vector (n,); for matrix elements those of its matrix, unless these leave the box."""
        vector = np.clip(vector, self.lower, self.upper)
        if self.parameterisation.name != "matrix":
            return vector
        elements = self.matrix(vector).ravel()
        return elements if bool(self.inside(elements[None])[0]) else vector

    def _repays_building(self, asked: int) -> bool:
        """True if the fast evaluator saves time, with ``asked`` candidates more, and can be built in the time left."""
        if not isinstance(self.odometry, StoredOdometry):
            return self.evaluations + asked >= _WORTH_BUILDING
        worth = _WORTH_BUILDING_OF_STORED
        return self.evaluations > 0 and self.evaluations + asked >= worth and self._in_time >= worth

    @property
    def _in_time(self) -> int:
        """Candidates that are evaluated together: of runs in memory all, of others as many as the time left allows."""
        if self._evaluator or not isinstance(self.odometry, StoredOdometry):
            return self.budget.evaluations
        if not self.evaluations:
            return 1  # the first candidate tells the time that one takes
        left = self.budget.seconds - self.seconds
        return max(int(min(left / self.seconds * self.evaluations, self.budget.evaluations)), 1)

    def _fast_values(self, candidates: Array, evaluator: PoseEvaluator | PartedEvaluator) -> Array:
        """Costs (P,) by the fast evaluator for candidates in its box, by direct integration for the others."""
        with np.errstate(all="ignore"):
            matrices = self.parameterisation.matrices(candidates)
            return np.concatenate([self._fast_costs(part, evaluator) for part in self._parts(matrices)])

    def _fast_costs(self, matrices: Array, evaluator: PoseEvaluator | PartedEvaluator) -> Array:
        seen = matrices if self._frame is None else self._frame.seen(matrices)
        covered = evaluator.covers(seen)
        if covered.all():
            return self._costs_of_poses(evaluator.poses(seen))
        values = np.empty(len(matrices))
        values[covered] = self._costs_of_poses(evaluator.poses(seen[covered]))
        values[~covered] = self._costs_of_poses(self.odometry.poses(matrices[~covered]))
        return values

    def _parts(self, matrices: Array) -> list[Array]:
        """Matrices in parts, whose poses are held together."""
        count = max(_MOST_POSES // max(len(self.odometry.trajectory), 1), 1)
        return [matrices[first : first + count] for first in range(0, max(len(matrices), 1), count)]

    def _costs_of_poses(self, poses: Array) -> Array:
        """Costs (P,) of poses (P, S, 3) at the cost's stamps; ``poses`` is overwritten."""
        poses -= self.reference
        return self.objective.combine(poses, self.odometry.trajectory)

    def _relevant(self) -> NDArray[np.bool_]:
        """True (n,) for elements that the cost depends on: for headings alone those of row 3."""
        cost = norms_of(self.objective)
        if not isinstance(self.parameterisation, MatrixElements):
            return np.ones(len(self.start), dtype=bool)
        used = np.repeat(self.parameterisation.rows.any(axis=0), len(self.robot.drive.names))
        if (cost is None or 0.0 not in cost.weights) and not isinstance(self.odometry, ReferenceBatch):
            return used
        slopes: Array = np.abs(self.odometry.jacobian(self.matrix(self.start))).max(axis=0)  # (3, 3, N)
        weights = (1.0, 1.0, 1.0) if cost is None else cost.weights
        return np.asarray(used & ((np.abs(weights) @ slopes.reshape(3, -1)) > 0))

    def _check_budget(self) -> None:
        """Raise BudgetSpent if no evaluations or no seconds are left."""
        if self.remaining <= 0:
            raise BudgetSpent("budget", f"budget of {self.budget.evaluations} evaluations spent")
        if self.seconds > self.budget.seconds:
            raise BudgetSpent("time", f"time budget of {self.budget.seconds:g} s spent")

    def _record(self, candidates: Array, values: Array) -> None:
        """Count evaluated candidates (P, n) with their costs (P,), keep the best one and report progress."""
        self._note_improvements(candidates, values)
        self.evaluations += len(candidates)
        self.report(self.evaluations, self.budget.evaluations, "evaluation", self.best_cost)

    def _note_improvements(self, candidates: Array, values: Array) -> None:
        """Append to the history every candidate in the box that is better than all before it."""
        if not (values < self.best_cost).any():
            return
        eligible = np.where(np.isfinite(values) & self.inside(candidates), values, np.inf)
        running = np.minimum.accumulate(np.concatenate([[self.best_cost], eligible]))
        for index in np.flatnonzero(running[1:] < running[:-1]):
            self.best_cost = float(eligible[index])
            self.best_vector = _frozen(candidates[index])
            self.history.append(Improvement(self.evaluations + int(index) + 1, self.seconds, self.best_cost))


def make_parameterisation(
    name: ParameterisationName,
    robot: Robot,
    trajectories: Sequence[Trajectory],
    *,
    box: Box = "row",
    limits: GeometryLimits | None = None,
    unidentified: Unidentified = "keep",
    mount: MountChoice | None = None,
    tolerance: float | None = None,
) -> Parameterisation:
    """The parameterisation called ``name``. ConfigError when its box excludes the start.

    unidentified: for directions of wheel rates that the trajectories drive so little that slip alone may explain it,
    ``keep`` and ``shrink`` hold the matrix at the design values along them, ``fit`` fits it. The geometry always fits
    them: it cannot hold values along a direction. mount: whether the tracked point of a robot that cannot slide is
    where the robot says, or fitted; default: see ``default_mount``. tolerance: of the design, see prior.py.
    """
    mount = mount or default_mount(robot)
    if name == "geometry":
        return WheelGeometry(robot, limits, mount == "fit", tolerance)
    null = directions_kept(robot, driven_span(trajectories), unidentified)
    searched = MatrixElements(robot, box, null, mount == "known", tolerance)
    return searched if unidentified == "shrink" else with_open_combinations(searched, trajectories)


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    """A read-only copy."""
    array = np.array(array)
    array.flags.writeable = False
    return array
