"""The result of a comparison: a record of every run, its scores on each split, and statistics of every entry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, PlainSerializer

from omnibench.compare.config import CompareConfig
from omnibench.compare.plan import SearchSpace
from omnibench.config import Model
from omnibench.data.dataset import Dataset, Split
from omnibench.environment import Environment
from omnibench.fit.calibrator import Outcome
from omnibench.fit.intervals import Clusters, Interval
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.fit.problem import Improvement
from omnibench.fit.uncertainty import Uncertainty
from omnibench.registry import calibrators
from omnibench.robot.calibration import HeldOutVerdict, ModelExtension, Noise, Row
from omnibench.robot.kinematics import Array
from omnibench.robot.physical import PhysicalParameter
from omnibench.views import Shown

THEORETICAL_NAME = "theoretical"  # the calibrator that leaves the design values


_DEVIATIONS = ("deviation", "deviation_percent")  # keys of summary.json that follow from value and design


def _row(parameter: PhysicalParameter) -> dict[str, Any]:
    """A number of a searched geometry as summary.json has it."""
    of_search = parameter.model_dump(exclude={"low", "high"})
    return of_search | {name: getattr(parameter, name) for name in _DEVIATIONS}


def _from_row(row: Any) -> Any:
    return {name: row[name] for name in row if name not in _DEVIATIONS} if isinstance(row, dict) else row


SearchedParameter = Annotated[PhysicalParameter, BeforeValidator(_from_row), PlainSerializer(_row)]


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
    parameters: tuple[SearchedParameter, ...] | None
    at_bounds: tuple[str, ...]
    held: tuple[str, ...]
    gap: float | None
    gap_box: str | None
    proven_gap: float | None


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
class ScoredRun:
    """A run with its scores.

    history: the best cost so far. scores: by split, those with trajectories; empty without an answer. design: scores of
    the design values, by split. extension, noise: as in RunResult.
    """

    record: RunRecord
    search_space: SearchSpace
    history: tuple[Improvement, ...]
    scores: Mapping[Split, SplitScore]
    design: Mapping[Split, SplitScore]
    extension: ModelExtension | None = None
    noise: Noise | None = None

    @property
    def matrix(self) -> Array | None:
        """The inverse kinematic matrix (3, N)."""
        return None if self.record.matrix is None else np.array(self.record.matrix)


@dataclass(frozen=True)
class SplitStatistics:
    """Statistics of an entry's typical run on one split.

    improvement: share of the design values' cost that is gone; None where that cost is zero.
    """

    cost: Interval
    improvement: Interval | None


@dataclass(frozen=True)
class EntryStatistics:
    """One entry of the comparison (calibrator, parameterisation, box) on one data set, over its seeds.

    typical: the run of median training cost, to which intervals and differences refer. train_spread: interquartile
    range of the training cost over seeds. splits: the typical run by split; empty without an answer. difference: paired
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
    typical: ScoredRun | None
    train_median: float | None
    train_spread: float | None
    splits: Mapping[Split, SplitStatistics]
    difference: Interval | None
    practically_equal: bool | None
    is_best: bool
    gap_median: float | None
    proven_gap_median: float | None
    evaluations_median: float | None
    seconds_median: float | None
    reference_evaluations_median: float | None

    def cost(self, split: Split) -> Interval | None:
        """The mean cost on a split; None without an answer, or without such a split."""
        return self.splits[split].cost if split in self.splits else None

    def improvement(self, split: Split) -> Interval | None:
        """The share by which the cost on a split lies below that of the design values; None where not known."""
        return self.splits[split].improvement if split in self.splits else None


@dataclass(frozen=True)
class EntryVerdict:
    """The verdict of held-out runs on an entry."""

    label: str
    verdict: HeldOutVerdict


@dataclass(frozen=True, eq=False)
class TypicalAnswer:
    """The answer of an entry's typical run.

    uncertainty: None where it is no minimum, or is not fitted. parameters: the physical ones that it means.
    """

    uncertainty: Uncertainty | None
    parameters: tuple[PhysicalParameter, ...]


@dataclass(frozen=True, eq=False, repr=False)
class ComparisonResult(Shown):
    """Everything that the report shows.

    design_costs: mean cost of the design values, by data set and split. typical: of the entries' typical runs, by data
    set and label. held_out: the verdict on the best calibration of each data set that has one. sessions: by data
    set, sentences on sessions that differ from the others or could not be compared.
    """

    config: CompareConfig
    output: Path
    datasets: dict[str, Dataset]
    runs: tuple[ScoredRun, ...]
    statistics: tuple[EntryStatistics, ...]
    design_costs: Mapping[str, Mapping[Split, Interval]]
    certificates: tuple[BoxCertificate, ...]
    typical: Mapping[tuple[str, str], TypicalAnswer]
    held_out: Mapping[str, EntryVerdict]
    environment: Environment
    warnings: tuple[str, ...]
    sessions: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def every_search_failed(self) -> bool:
        """True if none of the calibrators that fit to data, or none of all if there are no such, gave an answer."""
        fitted = [run for run in self.runs if calibrators.entry(run.record.calibrator).cls.fitted]
        return all(run.matrix is None for run in fitted or self.runs)

    @property
    def failures(self) -> list[str]:
        """A line for every run without an answer: data set, entry, seed, outcome and reason."""
        return [
            f"{record.dataset} {record.label} seed {record.seed}: {record.outcome}: {record.reason}"
            for record in (run.record for run in self.runs)
            if record.matrix is None
        ]
