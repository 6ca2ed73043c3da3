"""CalibrationProblem: what every calibrator is given, and all it is given."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from omnibench.config import Model
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.errors import DataError
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.evaluator.element_box import ElementBox
from omnibench.fit.evaluator.evaluator import PoseEvaluator, make_evaluator
from omnibench.fit.parameterisation import (
    Box,
    GeometryLimits,
    MatrixElements,
    Parameterisation,
    ParameterisationName,
    WheelGeometry,
)
from omnibench.fit.span import Unidentified, directions_kept, driven_span
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration

_PROGRESS_PERIOD = 0.1  # s
# From so many evaluations on the fast evaluator is worth the time that it takes to build.
_WORTH_BUILDING = 50


class Budget(Model):
    """What one run may spend."""

    evaluations: int = Field(60_000, gt=0, description="candidates that may be evaluated")
    seconds: float = Field(600.0, gt=0, description="wall time, s")


class BudgetSpent(Exception):  # noqa: N818 (not an error: the run is over)
    """Raised by ``problem.cost`` when nothing is left; calibrators let it pass."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind


@dataclass(frozen=True)
class Improvement:
    """The best cost so far, and when it was found."""

    evaluations: int
    seconds: float
    cost: float


class CalibrationProblem:
    """Training trajectories, a start, a box, a budget and a cost to be minimised.

    trajectories: the training data; the validation data are nowhere in reach.
    start, lower, upper (n,): the vector that is searched and its box. names: what its numbers are.
    cost(candidates): what is minimised. rng: the only source of randomness a calibrator may use.
    best_vector, best_cost: the best candidate in the box so far; the start and infinity before the first.
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
        watch: Callable[[int, float], None] | None = None,
    ) -> None:
        if not trajectories:
            raise DataError("no trajectories; nothing can be calibrated")
        self.robot = robot
        self.trajectories = tuple(trajectories)
        self.objective = cost
        self.parameterisation = parameterisation
        self.integration: Integration = integration
        self.budget = budget
        self.seed = seed
        self.rng = np.random.default_rng(seed)
        bounds = parameterisation.bounds
        self.box = bounds.name
        self.names = parameterisation.names
        self.odometry = cost.batch(self.trajectories, integration)
        self.reference = _frozen(
            np.ascontiguousarray(cost.reference(self.trajectories).T)
        ).T  # components apart, as poses have them
        self.start = _frozen(parameterisation.start)
        matters = self._matters()
        self.lower = _frozen(np.where(matters, bounds.lower, self.start))
        self.upper = _frozen(np.where(matters, bounds.upper, self.start))
        self.free: NDArray[np.bool_] = _frozen(self.upper > self.lower)
        self.evaluations = 0
        self.best_vector = self.start
        self.best_cost = np.inf
        self.history: list[Improvement] = []
        self._evaluator: PoseEvaluator | None = None
        self._evaluator_tried = False
        self._watch = watch
        self._began = time.perf_counter()
        self._shown = 0.0

    @property
    def size(self) -> int:
        """The number n of values that are searched."""
        return len(self.start)

    @property
    def remaining(self) -> int:
        """Evaluations that the budget still allows."""
        return self.budget.evaluations - self.evaluations

    @property
    def is_fast(self) -> bool:
        """Whether ``cost`` uses the fast evaluator by now."""
        return self._evaluator is not None

    @property
    def seconds(self) -> float:
        """Wall time since the problem was made."""
        return time.perf_counter() - self._began

    def cost(self, candidates: Array) -> Array:
        """Costs (P,) of candidates (P, n), counted against the budget.

        A candidate that cannot be evaluated costs NaN. Raises BudgetSpent when the budget is spent; a population
        that is larger than what remains is evaluated as far as it goes.
        """
        candidates = np.array(candidates, dtype=float, ndmin=2)
        if candidates.shape[1:] != self.start.shape:
            raise ValueError(f"candidates have shape {candidates.shape}, expected (P, {self.size})")
        self._check_budget()
        asked = len(candidates)
        candidates = candidates[: self.remaining]
        if self.evaluations + len(candidates) >= _WORTH_BUILDING and not self._evaluator_tried:
            self.build_evaluator()
        values = self._fast_values(candidates) if self._evaluator else self.values(candidates)
        self._record(candidates, values)
        if len(candidates) < asked:
            self._check_budget()
        return values

    def values(self, candidates: Array) -> Array:
        """Costs (P,) of candidates (P, n), uncounted and by direct integration: for the verdict on a run."""
        with np.errstate(all="ignore"):
            return self._combined(self.odometry.poses(self.parameterisation.matrices(candidates)))

    def build_evaluator(self) -> PoseEvaluator | None:
        """The fast evaluator that ``cost`` uses from now on; None where direct integration is the faster way.

        ``cost`` builds it by itself when a search asks for many candidates. Both ways give the same costs to 1e-11.
        """
        if not self._evaluator_tried:
            self._evaluator_tried = True
            box = ElementBox.of(self.parameterisation, self.lower, self.upper)
            logs = self.objective.logs(self.trajectories)
            self._evaluator = make_evaluator(self.odometry, logs, self.integration, box)
        return self._evaluator

    def to_unit(self, vectors: Array) -> Array:
        """Vectors (P, n) as points (P, free) of the unit cube over the free elements; never outside it."""
        free = self.free
        points = (np.atleast_2d(vectors)[:, free] - self.lower[free]) / (self.upper - self.lower)[free]
        return np.clip(points, 0.0, 1.0)

    def from_unit(self, points: Array) -> Array:
        """Vectors (P, n) of points (P, free) of the unit cube; never outside the box."""
        points = np.atleast_2d(points)
        vectors = np.empty((len(points), self.size))
        vectors[:] = self.start
        low, high = self.lower[self.free], self.upper[self.free]
        vectors[:, self.free] = np.minimum(np.maximum(low + points * (high - low), low), high)
        return vectors

    def inside(self, vectors: Array) -> NDArray[np.bool_]:
        """Which vectors (P, n) lie in the box, up to rounding: (P,) of bool."""
        slack = 1e-12 * np.maximum(np.abs(self.lower), np.abs(self.upper))
        within = (vectors >= self.lower - slack) & (vectors <= self.upper + slack)
        return np.asarray(within.all(axis=-1))

    def at_bounds(self, vector: Array) -> tuple[str, ...]:
        """Names of the free elements that lie on a bound of the box."""
        margin = 1e-6 * (self.upper - self.lower)
        on_bound = self.free & ((vector <= self.lower + margin) | (vector >= self.upper - margin))
        return tuple(name for name, touching in zip(self.names, on_bound, strict=True) if touching)

    @property
    def held(self) -> tuple[str, ...]:
        """Names of the elements that keep their start value: the box leaves no width, or the cost does not see them."""
        return tuple(name for name, free in zip(self.names, self.free, strict=True) if not free)

    def matrix(self, vector: Array) -> Array:
        """The inverse kinematic matrix (3, N) of one vector (n,)."""
        return self.parameterisation.matrices(vector[None])[0]

    def _fast_values(self, candidates: Array) -> Array:
        """Costs (P,) by the evaluator in its box, and by direct integration outside it."""
        assert self._evaluator is not None  # cost asks only then
        with np.errstate(all="ignore"):
            matrices = self.parameterisation.matrices(candidates)
            covered = self._evaluator.covers(matrices)
            if covered.all():
                return self._combined(self._evaluator.poses(matrices))
            values = np.empty(len(candidates))
            values[covered] = self._combined(self._evaluator.poses(matrices[covered]))
            values[~covered] = self._combined(self.odometry.poses(matrices[~covered]))
            return values

    def _combined(self, poses: Array) -> Array:
        poses -= self.reference
        return self.objective.combine(poses, self.odometry.trajectory)

    def _matters(self) -> NDArray[np.bool_]:
        """Which elements (n,) the cost depends on: a cost of headings alone sees row 3 of the matrix only."""
        cost = self.objective
        if not (
            isinstance(cost, SumOfNorms) and 0.0 in cost.weights and isinstance(self.parameterisation, MatrixElements)
        ):
            return np.ones(len(self.start), dtype=bool)
        slopes: Array = np.abs(self.odometry.jacobian(self.matrix(self.start))).max(axis=0)  # (3, 3, N)
        return np.asarray((np.abs(cost.weights) @ slopes.reshape(3, -1)) > 0)

    def _check_budget(self) -> None:
        if self.remaining <= 0:
            raise BudgetSpent("budget", f"budget of {self.budget.evaluations} evaluations spent")
        if self.seconds > self.budget.seconds:
            raise BudgetSpent("time", f"time budget of {self.budget.seconds:g} s spent")

    def _record(self, candidates: Array, values: Array) -> None:
        self._note_improvements(candidates, values)
        self.evaluations += len(candidates)
        if self._watch and self.seconds - self._shown > _PROGRESS_PERIOD:
            self._shown = self.seconds
            self._watch(self.evaluations, self.best_cost)

    def _note_improvements(self, candidates: Array, values: Array) -> None:
        if not (values < self.best_cost).any():
            return
        eligible = np.where(np.isfinite(values) & self.inside(candidates), values, np.inf)
        running = np.minimum.accumulate(np.concatenate([[self.best_cost], eligible]))
        for index in np.flatnonzero(running[1:] < running[:-1]):
            self.best_cost = float(eligible[index])
            self.best_vector = _frozen(candidates[index])
            self.history.append(Improvement(self.evaluations + int(index) + 1, self.seconds, self.best_cost))


def training_split(dataset: Dataset) -> tuple[Trajectory, ...]:
    """The training trajectories; DataError when there are none."""
    trajectories = dataset.split("train")
    if not trajectories:
        raise DataError(
            f"data set {dataset.name}: the training split is empty; set split to train for some trajectories"
        )
    return trajectories


def make_parameterisation(
    name: ParameterisationName,
    robot: Robot,
    trajectories: Sequence[Trajectory],
    *,
    box: Box = "row",
    limits: GeometryLimits | None = None,
    unidentified: Unidentified = "keep",
) -> Parameterisation:
    """The parameterisation called ``name``. ConfigError when its box excludes the start.

    unidentified: what becomes of the directions of wheel rates that the trajectories drive so little that slip alone
    may have done it. Matrix elements keep the design values there, or (fit) are fitted to what there is. The geometry
    cannot keep values along a direction, and fits them.
    """
    if name == "geometry":
        return WheelGeometry(robot, limits)
    return MatrixElements(robot, box, directions_kept(robot, driven_span(trajectories), unidentified))


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    array = np.array(array)
    array.flags.writeable = False
    return array
