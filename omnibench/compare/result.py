"""The result of a comparison: every fit with its scores, statistics of entries, and cells of several robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import field_serializer

from omnibench.compare.config import AS_RECORDED, CompareConfig
from omnibench.compare.plan import ComparedRobot, PlannedFit
from omnibench.compare.ratios import CellRatio, Pairs, cell_ratio
from omnibench.config import Model
from omnibench.data.dataset import Dataset, Split
from omnibench.environment import Environment
from omnibench.fit.calibrator import Outcome, RunResult
from omnibench.fit.intervals import Clusters, Interval
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.registry import calibrators
from omnibench.robot.calibration import HeldOutVerdict, Row
from omnibench.robot.kinematics import Array
from omnibench.robot.physical import PhysicalParameter
from omnibench.views import Shown


class RunRecord(Model):
    """One run as a flat row of summary.json. Costs and matrix are None where the run gave no answer.

    held: elements that keep their start value, because the box or the cost leaves no choice. gap: train_cost divided by
    that of closed_form in the box ``gap_box``, minus 1. proven_gap: the share of train_cost
    that a matrix of the box could save at most, by proof. reference_seconds: one evaluation of the start's cost on the
    run's machine took so long; None where seconds are not to be compared.
    """

    dataset: str
    label: str
    calibrator: str
    parameterisation: ParameterisationName
    box: str
    seed: int
    options: dict[str, Any]
    outcome: Outcome
    reason: str
    train_cost: float | None
    validation_cost: float | None
    theoretical_train_cost: float
    theoretical_validation_cost: float | None
    train_improvement: float | None
    validation_improvement: float | None
    train_position_m: float | None
    train_heading_rad: float | None
    validation_position_m: float | None
    validation_heading_rad: float | None
    evaluations: int
    seconds: float
    reference_seconds: float | None = None
    machine: str | None = None
    matrix: tuple[Row, Row, Row] | None
    parameters: tuple[PhysicalParameter, ...] | None
    at_bounds: tuple[str, ...]
    held: tuple[str, ...]
    gap: float | None = None
    gap_box: str | None = None
    proven_gap: float | None = None

    @field_serializer("parameters")
    def _with_deviations(self, parameters: tuple[PhysicalParameter, ...] | None) -> list[dict[str, Any]] | None:
        deviations = ("deviation", "deviation_percent")  # follow from value and design
        if parameters is None:
            return None
        rows = [each.model_dump(exclude={"low", "high"}) for each in parameters]
        return [
            row | {name: getattr(each, name) for name in deviations} for row, each in zip(rows, parameters, strict=True)
        ]


class BoxCertificate(Model):
    """Proof that no matrix of a box has a training cost below ``lower_bound``.

    best_cost: the lowest training cost known in the box. gap: 1 - lower_bound / best_cost. parts: how many parts of the
    box were examined. finished: False when the config's time or parts ran out before its gap was reached.
    """

    dataset: str
    box: str
    lower_bound: float
    best_cost: float
    gap: float
    parts: int
    seconds: float
    finished: bool


@dataclass(frozen=True, eq=False)
class SplitScore:
    """Costs and errors of a matrix on one split.

    costs (Z,): the cost of each trajectory. errors (Z, 3): odometry minus reference at the last reference pose of each
    trajectory, m, m, rad. units: what intervals of the costs rest on. rounding: costs that are not above it are that.
    """

    cost: float
    costs: Array
    errors: Array
    units: Clusters
    rounding: float


@dataclass(frozen=True, eq=False)
class ScoredFit:
    """A fit with its result and scores.

    errors (Z, 3): of its answer on all runs of the robot, m, m, rad; None without one. record: the row of a fit to a
    data set. scores: by split of a data set, those with trajectories; empty without an answer. design: scores of the
    design values, by split.
    """

    fit: PlannedFit
    result: RunResult
    errors: Array | None
    row: RunRecord | None
    scores: Mapping[Split, SplitScore]
    design: Mapping[Split, SplitScore]

    @property
    def record(self) -> RunRecord:
        """The row of a fit to a data set."""
        assert self.row is not None  # it is one
        return self.row

    @property
    def matrix(self) -> Array | None:
        """The inverse kinematic matrix (3, N) of its answer."""
        return self.result.matrix


@dataclass(frozen=True)
class EntryStatistics:
    """One entry of the comparison (calibrator, parameterisation, box) on one data set, over its seeds.

    typical: the run of median training cost, to which intervals and differences refer. train_spread: interquartile
    range of the training cost over seeds. costs, improvements: of the typical run by split; empty without an answer; an
    improvement is the share of the design values' cost that is gone, None where that cost is zero. difference: paired
    mean difference in validation cost (training cost where there is no validation split) from the best entry.
    practically_equal: None where the difference has no interval. reference_evaluations_median: time in evaluations of
    the start's cost on the machine of each run, which machines of different speed have in common; None if not known.
    """

    dataset: str
    label: str
    calibrator: str
    parameterisation: ParameterisationName
    box: str
    runs: int
    answers: int
    typical: ScoredFit | None
    train_median: float | None
    train_spread: float | None
    costs: Mapping[Split, Interval]
    improvements: Mapping[Split, Interval | None]
    difference: Interval | None
    practically_equal: bool | None
    is_best: bool
    gap_median: float | None
    proven_gap_median: float | None
    evaluations_median: float | None
    seconds_median: float | None
    reference_evaluations_median: float | None

    def cost(self, split: Split) -> Interval | None:
        """The typical run's mean cost on a split; None without an answer, or without such runs."""
        return self.costs.get(split)

    def improvement(self, split: Split) -> Interval | None:
        """The share of the design values' cost that is gone on a split; None where it is not known."""
        return self.improvements.get(split)


@dataclass(frozen=True)
class EntryVerdict:
    """The verdict of held-out runs on an entry."""

    label: str
    verdict: HeldOutVerdict


Measure = Literal["cost", "position", "heading"]
MEASURES: tuple[Measure, ...] = ("cost", "position", "heading")


@dataclass(frozen=True)
class CellKey:
    """Name of a cell. fitted: the judged runs are those that trained: training errors, which no verdict rests on."""

    robot: str
    training: str
    regime: str
    judged: str
    fitted: bool

    @property
    def within_robot(self) -> str:
        """Training and judged runs: ``circular → square``."""
        return f"{self.training} → {self.judged}{' (training errors)' if self.fitted else ''}"


@dataclass(frozen=True, eq=False)
class MethodInCell:
    """One method in a cell. errors: by measure, (n,) of each pair, means over seeds; the design's where it has none.

    fits, answers: how many were asked for and answered; outcomes: how many ended so. reason: of the first without an
    answer. seconds: median of a fit; numbers: what the method says of its first answer, matrix (3, M): that answer's.
    cost, unidentified: what was minimised, and what became of motions that were hardly driven; empty where it was never
    asked.
    """

    method: str
    family: str
    fits: int
    outcomes: Mapping[str, int]
    reason: str
    errors: Mapping[Measure, Array] | None
    seconds: float | None
    numbers: str
    answers: int
    cost: str = ""
    unidentified: str = ""
    matrix: Array | None = None

    def mean(self, measure: Measure) -> float | None:
        """Mean error over the pairs: Eq. (6), m, or rad."""
        return None if self.errors is None else float(self.errors[measure].mean())

    @property
    def status(self) -> str:
        """``answered``, or the commonest reason in a word why not; in how many fits, where these differ."""
        if self.answers == self.fits:
            return "answered"
        if self.answers:
            return f"answered in {self.answers} of {self.fits}"
        return max(self.outcomes, key=lambda outcome: self.outcomes[outcome])


@dataclass(frozen=True, eq=False)
class Cell:
    """A cell: its pairs, the design values' errors and the methods by name."""

    key: CellKey
    pairs: Pairs
    design: Mapping[Measure, Array]
    methods: Mapping[str, MethodInCell]

    def mean(self, method: str) -> float | None:
        """A method's mean error, Eq. (6); None where it was not asked, or has no answer."""
        return self.methods[method].mean("cost") if method in self.methods else None

    def share(self, method: str) -> float | None:
        """A method's mean error, Eq. (6), as a share of the design values'; None without an answer."""
        ratio = self.ratio(method)
        return None if ratio is None else ratio.value

    def ratio(self, method: str, other: str = "", cells: int = 1) -> CellRatio | None:
        """A method's mean error, Eq. (6), as a ratio to another's, or to the design values'; None without an answer.

        cells: how many are judged together.
        """
        one = self.methods[method].errors if method in self.methods else None
        two = self.methods[other].errors if other else self.design
        return None if one is None or two is None else cell_ratio(one["cost"], two["cost"], self.pairs, cells)


@dataclass(frozen=True, eq=False)
class AgainstBest:
    """The reference method beside the published method of least mean error in a cell, Eq. (6)."""

    cell: Cell
    best: str
    ratio: CellRatio


@dataclass(frozen=True, eq=False, repr=False)
class ComparisonResult(Shown):
    """Everything that the report shows.

    broken: why recordings could not be read, by robot. Of data sets alone: statistics of every entry; design_costs,
    mean cost of the design values, by data set and split;
    held_out, the verdict on the best calibration of each that has one; sessions, sentences on those that differ from
    the others or could not be compared.
    """

    config: CompareConfig
    output: Path
    robots: tuple[ComparedRobot, ...]
    broken: Mapping[str, str]
    runs: tuple[ScoredFit, ...]
    cells: tuple[Cell, ...]
    statistics: tuple[EntryStatistics, ...]
    design_costs: Mapping[str, Mapping[Split, Interval]]
    certificates: tuple[BoxCertificate, ...]
    held_out: Mapping[str, EntryVerdict]
    sessions: Mapping[str, tuple[str, ...]]
    environment: Environment
    warnings: tuple[str, ...]

    @property
    def datasets(self) -> dict[str, Dataset]:
        """The data sets, or the robots' recordings, by name."""
        return {robot.name: robot.dataset for robot in self.robots}

    @property
    def nothing_answered(self) -> bool:
        """True if no calibrator that fits to data, or none of all if there are no such, gave an answer anywhere."""
        fitted = [run for run in self.runs if calibrators.entry(run.fit.entry.name).cls.fitted]
        return not any(run.errors is not None for run in fitted or self.runs)

    @property
    def failures(self) -> tuple[str, ...]:
        """A line for every fit that ought to have an answer and has none, with outcome and reason."""
        silent = [run for run in self.runs if run.errors is None]
        if self.config.robots:  # a method that is not for a robot is none
            silent = [run for run in silent if run.result.outcome in (Outcome.FAILED, Outcome.INVALID)]
        return tuple(f"{run.fit.title}: {run.result.outcome}: {run.result.reason}" for run in silent)

    @property
    def judged_cells(self) -> tuple[Cell, ...]:
        """Cells of recorded training runs that other runs judge: what verdicts, ranks and profiles rest on."""
        return tuple(cell for cell in self.cells if not cell.key.fitted and cell.key.regime == AS_RECORDED)

    def recorded_cells(self, robot: str) -> tuple[Cell, ...]:
        """The cells of a robot's recorded training runs: those that other runs judge, then training errors."""
        mine = [cell for cell in self.cells if cell.key.robot == robot and cell.key.regime == AS_RECORDED]
        return tuple(sorted(mine, key=lambda cell: cell.key.fitted))

    @cached_property
    def against_best(self) -> tuple[AgainstBest, ...]:
        """The reference method against the best published one, in every judged cell that has both."""
        name = self.config.reference or ""
        compared = []
        for cell in self.judged_cells if name else ():
            published = [
                each for each in cell.methods.values() if each.family == "published" and each.errors is not None
            ]
            if published and cell.mean(name) is not None:
                compared.append((cell, min(published, key=lambda each: each.mean("cost") or 0.0).method))
        found = []
        for cell, best in compared:
            ratio = cell.ratio(name, best, len(compared))
            assert ratio is not None  # both have answers
            found.append(AgainstBest(cell, best, ratio))
        return tuple(found)

    @property
    def geometric_mean(self) -> float | None:
        """Geometric mean over cells of the reference's error as a ratio to the best published one's."""
        return mean_ratio([each.ratio.value for each in self.against_best])


def mean_ratio(ratios: Sequence[float]) -> float | None:
    """The geometric mean of some ratios; None of none, or where one is 0."""
    return float(np.exp(np.mean(np.log(ratios)))) if ratios and min(ratios) > 0 else None
