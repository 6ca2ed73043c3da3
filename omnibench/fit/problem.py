"""The calibration problem: all that a calibrator is given, and the evaluation of candidates within a budget."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.data.stored import median_period
from omnibench.errors import DataError
from omnibench.fit.cost import Cost
from omnibench.fit.evaluator import RunsEvaluator
from omnibench.fit.geometry import GeometryLimits, Parameterisation, WheelGeometry
from omnibench.fit.loss import RobustCost, make_loss, with_ends_from_others, with_loss
from omnibench.fit.open_combinations import with_open_combinations
from omnibench.fit.parameterisation import Box, MatrixElements, ParameterisationName
from omnibench.fit.prior import MountChoice, default_mount
from omnibench.fit.reference_rows import ReferenceBatch
from omnibench.fit.settings import Budget as Budget
from omnibench.fit.settings import CompleteSettings
from omnibench.fit.span import DrivenSpan, Treatment, directions_kept, driven_span, unidentified_directions
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import costs
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration, OdometryBatch
from omnibench.robot.stored_odometry import StoredOdometry
from omnibench.words import plural

_PROGRESS_PERIOD = 0.1  # s, least time between two reports of progress: ten a second are all that a reader sees
_MOST_POSES = 4_000_000  # poses of candidates that are held together, 0.1 GB (chosen)
# Evaluations of one run of a calibrator, from which on building the fast evaluator saves time. Its costs are those of
# direct integration to 1e-11 m; half of this number and twice change no estimate (tests/studies/constants_fit.py).
_WORTH_BUILDING = 50
# The same for stored runs, which every direct integration reads from their files: building takes 19 us a sample, one
# evaluation 0.05 us (chosen).
_WORTH_BUILDING_OF_STORED = 400
_NAMED = 5  # runs that a sentence names
_ON_BOUND = 1e-6  # share of the box's width: an element closer than that to a bound lies on it
_ROUNDING = 1e-12  # share of a bound: an element beyond it by less lies in the box


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

    trajectories: the training runs; a calibrator cannot reach the validation runs. moved_ends: a sentence on those of
    which the start (or end) has jumped, and is taken from the poses beside it, as a robust loss does.
    start (n,): the vector of the design values; lower, upper (n,): its box; names: of its n elements. free (n,): True
    for elements that may be searched; the others keep their start values.
    objective: the Cost. cost(candidates): its values, counted against the budget and recorded; a search calls this.
    values(candidates): the same values, neither counted nor recorded; for judging an answer, not for searching.
    rng: the only source of randomness that a calibrator may use.
    budget: the limits of the run. evaluations: candidates that were evaluated. best_vector (n,), best_cost: the best
    candidate in the box so far; the start, and infinity, before the first. history: every improvement of the best cost.
    span: what the runs drive; default: computed when it is first asked for.
    watch: told the evaluations and the best cost so far, at most every 0.1 s.
    tolerance, mount: standard deviation of the design's elements, and whether the tracked point may stand elsewhere,
    for calibrators that weigh the design; None: as is usual for the robot's class.
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
        tolerance: float | None = None,
        mount: MountChoice | None = None,
        span: DrivenSpan | None = None,
        watch: Reporter = no_progress,
    ) -> None:
        if not trajectories:
            raise DataError("no trajectories; nothing can be calibrated")
        self.robot = robot
        self.trajectories = tuple(trajectories)
        self.moved_ends: tuple[str, ...] = ()
        if isinstance(cost, RobustCost):
            last, loss = cost.stamps == "final", make_loss(cost.loss.name, 3)
            self.trajectories, moved = with_ends_from_others(self.trajectories, robot, integration, loss, last=last)
            if moved:
                which = "start or end" if last else "start"
                named = f"{', '.join(moved[:_NAMED])}{' ...' if len(moved) > _NAMED else ''}"
                self.moved_ends = (
                    f"{plural(len(moved), 'run')} of {len(self.trajectories)} ({named}): the reference pose at the "
                    f"{which} is far from what the poses beside it say, which are used in its place",
                )
        self.objective = cost
        self.parameterisation = parameterisation
        self.tolerance, self.mount = tolerance, mount
        self.integration: Integration = integration
        self.seed = seed
        self.rng = np.random.default_rng(seed)
        self.odometry = cost.batch(self.trajectories, integration)
        # x, y and heading contiguous, the memory order in which the odometry returns poses.
        self.reference = _read_only(np.ascontiguousarray(cost.reference(self.trajectories).T)).T
        bounds, start, relevant = parameterisation.bounds, parameterisation.start, np.ones(1, dtype=bool)
        if isinstance(parameterisation, MatrixElements):  # elements that the cost depends on: of headings, row 3's
            relevant = np.repeat(parameterisation.rows.any(axis=0), len(robot.drive.names))
            if 0.0 in cost.coordinates or isinstance(self.odometry, ReferenceBatch):
                slopes = np.abs(self.odometry.jacobian(self.matrix(start))).max(axis=0).reshape(3, -1)
                relevant = relevant & (np.abs(cost.coordinates) @ slopes > 0)
        self.box = bounds.name
        self.names, self.start = parameterisation.names, _read_only(start)
        self.lower = _read_only(np.where(relevant, bounds.lower, start))
        self.upper = _read_only(np.where(relevant, bounds.upper, start))
        self.free: NDArray[np.bool_] = _read_only(self.upper > self.lower)
        self.budget, self.evaluations = budget, 0
        self.best_vector, self.best_cost = self.start, np.inf
        self.history: list[Improvement] = []
        self._watch, self._shown = watch, 0.0  # s after the begin when ``watch`` was last called
        self._began = time.perf_counter()  # s, of that clock
        self._span = span
        self._evaluator: RunsEvaluator | None = None
        self._evaluator_tried = False

    # The box.

    @property
    def size(self) -> int:
        """The length n of the vector."""
        return len(self.start)

    @property
    def held(self) -> tuple[str, ...]:
        """Names of the elements that keep their start value, since the box has no width or the cost ignores them."""
        return tuple(name for name, free in zip(self.names, self.free, strict=True) if not free)

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
        margin = _ON_BOUND * (self.upper - self.lower)
        touching = self.free & ((vector <= self.lower + margin) | (vector >= self.upper - margin))
        return tuple(name for name, touches in zip(self.names, touching, strict=True) if touches)

    # What the runs identify.

    @cached_property
    def span(self) -> DrivenSpan:
        """Directions of wheel rates that the runs drive."""
        return self._span or driven_span(self.trajectories)

    @cached_property
    def unidentified(self) -> Array:
        """Directions (q, M) of drive signals, orthonormal: undriven ones, and weak ones, which slip may explain."""
        return unidentified_directions(self.robot, self.span)

    @cached_property
    def left_open(self) -> Array | None:
        """Combinations (r, 3M) of the identified elements that references leave open; None where all have poses."""
        known = MatrixElements(self.robot, "row", self.unidentified, known_mount=False)
        return with_open_combinations(known, self.trajectories).open

    @property
    def sample_period(self) -> float:
        """The median time between wheel samples, s."""
        return median_period(self.trajectories)

    # What the run has spent and found.

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
        """Report the progress of a method that does not call ``cost``, which reports by itself."""
        if self.seconds - self._shown > _PROGRESS_PERIOD:
            self._shown = self.seconds
            self._watch(Progress("search", done, total, unit, best))

    def _check_budget(self) -> None:
        """Raise BudgetSpent if no evaluations or no seconds are left."""
        if self.remaining <= 0:
            raise BudgetSpent("budget", f"budget of {self.budget.evaluations} evaluations spent")
        if self.seconds_left < 0:
            raise BudgetSpent("time", f"time budget of {self.budget.seconds:g} s spent")

    # Costs of candidates.

    def cost(self, candidates: Array) -> Array:
        """Costs (P,) of candidates (P, n), counted against the budget.

        A candidate that cannot be evaluated costs NaN. BudgetSpent is raised when the budget is spent; of a population
        that is larger than the remaining budget the first candidates are evaluated, and count, before it is raised.
        Stored runs are evaluated in parts, so that the time budget ends them, too, unless a fast evaluator is built.
        """
        candidates = np.array(candidates, dtype=float, ndmin=2)
        if candidates.shape[1:] != self.start.shape:
            raise ValueError(f"candidates have shape {candidates.shape}, expected (P, {self.size})")
        self._check_budget()
        asked = len(candidates)
        candidates = candidates[: self.remaining]
        values, count = np.empty(len(candidates)), 0
        while count < len(candidates):
            if not self._evaluator_tried:
                # The fast evaluator saves time with many candidates; of stored runs it must be built in the time left
                coming, stored = self.evaluations + len(candidates) - count, isinstance(self.odometry, StoredOdometry)
                least = _WORTH_BUILDING_OF_STORED if stored else _WORTH_BUILDING
                if coming >= least and (not stored or (self.evaluations > 0 and self._part_size >= least)):
                    self.build_evaluator()
            part = candidates[count : count + self._part_size]
            of_part = self._costs(part, self._evaluator)
            values[count : count + len(part)] = of_part
            if (of_part < self.best_cost).any():
                eligible = np.where(np.isfinite(of_part) & self.inside(part), of_part, np.inf)
                running = np.minimum.accumulate(np.concatenate([[self.best_cost], eligible]))
                for index in np.flatnonzero(running[1:] < running[:-1]).tolist():
                    self.best_cost, self.best_vector = float(eligible[index]), _read_only(part[index])
                    self.history.append(Improvement(self.evaluations + index + 1, self.seconds, self.best_cost))
            count += len(part)
            self.evaluations += len(part)
            self.report(self.evaluations, self.budget.evaluations, "evaluation", self.best_cost)
            if count < asked:
                self._check_budget()
        return values

    def values(self, candidates: Array) -> Array:
        """Costs (P,) of candidates (P, n) by direct integration, not counted: for scoring an answer."""
        return self._costs(candidates, None)

    def answer_cost(self, vector: Array) -> float:
        """Cost of an answer (n,) by direct integration; it is no candidate, and not counted."""
        return float(self._costs(vector[None], None)[0])

    def build_evaluator(self) -> RunsEvaluator | None:
        """Build the fast evaluator, which ``cost`` then uses in the place of direct integration, and return it.

        None where direct integration is faster, or the runs have references other than poses. ``cost`` calls this when
        a search asks for many candidates. The costs of both ways are equal to 1e-11.
        """
        if not self._evaluator_tried and isinstance(self.odometry, OdometryBatch):
            logs = self.objective.logs(self.trajectories)
            box = self.parameterisation, self.lower, self.upper
            self._evaluator = RunsEvaluator.of(logs, self.integration, *box)
        self._evaluator_tried = True
        return self._evaluator

    def matrix(self, vector: Array) -> Array:
        """The inverse kinematic matrix (3, N) of one vector (n,)."""
        return self.parameterisation.matrices(vector[None])[0]

    def settled(self, vector: Array) -> Array:
        """The vector (n,) clipped to the box.

        Matrix elements are replaced by those of the matrix that they stand for, in which the directions that are not
        searched have the design values, unless these elements lie outside the box.
        """
        vector = np.clip(vector, self.lower, self.upper)
        if self.parameterisation.name != "matrix":
            return vector
        elements = self.matrix(vector).ravel()
        return elements if bool(self.inside(elements[None])[0]) else vector

    @property
    def _part_size(self) -> int:
        """Candidates evaluated between two checks of the time: all, or of stored runs as many as there is time for."""
        if self._evaluator or not isinstance(self.odometry, StoredOdometry):
            return self.budget.evaluations
        if not self.evaluations:
            return 1  # the first candidate tells the time that one takes
        return max(int(min(self.seconds_left / self.seconds * self.evaluations, self.budget.evaluations)), 1)

    def _costs(self, candidates: Array, evaluator: RunsEvaluator | None) -> Array:
        """Costs (P,) by the fast evaluator for candidates in its box, by direct integration for the others."""
        together = max(_MOST_POSES // max(len(self.odometry.trajectory), 1), 1)  # matrices whose poses are held at once
        values = []
        with np.errstate(all="ignore"):
            matrices = self.parameterisation.matrices(candidates)
            for first in range(0, max(len(matrices), 1), together):
                part = matrices[first : first + together]
                if evaluator is None:
                    values.append(self._costs_of_poses(self.odometry.poses(part)))
                    continue
                seen = evaluator.seen(part)
                covered = evaluator.covers(seen)
                if covered.all():
                    values.append(self._costs_of_poses(evaluator.poses(seen)))
                    continue
                values.append(np.empty(len(part)))
                values[-1][covered] = self._costs_of_poses(evaluator.poses(seen[covered]))
                values[-1][~covered] = self._costs_of_poses(self.odometry.poses(part[~covered]))
        return np.concatenate(values)

    def _costs_of_poses(self, poses: Array) -> Array:
        """Costs (P,) of poses (P, S, 3) at the cost's stamps; ``poses`` is overwritten."""
        poses -= self.reference
        return self.objective.combine(poses, self.odometry.trajectory)


def make_problem(
    settings: CompleteSettings, robot: Robot, runs: Sequence[Trajectory], watch: Reporter = no_progress
) -> CalibrationProblem:
    """The problem of fitting some runs. ConfigError: the box excludes the start. DataError: there are no runs."""
    span = driven_span(runs)
    searched = make_parameterisation(
        settings.parameterisation,
        robot,
        runs,
        box=settings.box,
        limits=settings.limits,
        unidentified=settings.unidentified,
        mount=settings.mount,
        span=span,
    )
    return CalibrationProblem(
        robot,
        runs,
        with_loss(costs.create(settings.cost.name, settings.cost.options), settings.loss),
        searched,
        integration=settings.integration,
        budget=settings.budget,
        seed=settings.seed,
        tolerance=settings.tolerance,
        mount=settings.mount,
        span=span,
        watch=watch,
    )


def make_parameterisation(
    name: ParameterisationName,
    robot: Robot,
    trajectories: Sequence[Trajectory],
    *,
    box: Box = "row",
    limits: GeometryLimits | None = None,
    unidentified: Treatment = "keep",
    mount: MountChoice | None = None,
    span: DrivenSpan | None = None,
) -> Parameterisation:
    """The parameterisation called ``name``. ConfigError when its box excludes the start.

    unidentified: for directions of wheel rates that the trajectories drive so little that slip alone may explain it,
    ``keep`` holds the matrix at the design values along them, ``fit`` fits it, and ``weigh`` leaves what to do there,
    and about combinations that references leave open, to the calibrator. The geometry always fits
    them: it cannot hold values along a direction. mount: whether the tracked point of a robot that cannot slide is
    where the robot says, or fitted; default: see ``default_mount``. span: what
    the trajectories drive; default: computed here.
    """
    mount = mount or default_mount(robot)
    if name == "geometry":
        return WheelGeometry(robot, limits, mount == "fit")
    null = directions_kept(robot, span or driven_span(trajectories), unidentified)
    searched = MatrixElements(robot, box, null, mount == "known")
    return searched if unidentified == "weigh" else with_open_combinations(searched, trajectories)


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    """A read-only copy."""
    array = np.array(array)
    array.flags.writeable = False
    return array
