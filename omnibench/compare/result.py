"""What a comparison yields: a record of every run, its errors, and statistics of every entry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from omnibench.compare.config import CompareConfig
from omnibench.config import Model
from omnibench.data.dataset import Dataset
from omnibench.environment import Environment
from omnibench.fit.calibrator import Outcome
from omnibench.fit.parameterisation import FittedParameter, ParameterisationName
from omnibench.fit.problem import Improvement
from omnibench.fit.uncertainty.uncertainty import Uncertainty
from omnibench.robot.calibration import Row
from omnibench.robot.kinematics import Array


class RunRecord(Model):
    """One run: a row of the results. Costs and matrix are None where the run gave no answer."""

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
    matrix: tuple[Row, Row, Row] | None
    parameters: tuple[FittedParameter, ...] | None
    at_bounds: tuple[str, ...]
    held: tuple[str, ...]  # elements that keep their start value: the box or the cost leaves no choice
    gap: float | None  # train_cost / exact optimum in the box ``gap_box`` - 1
    gap_box: str | None
    proven_gap: float | None  # the share of train_cost that any matrix of the box could save at most


class BoxCertificate(Model):
    """No matrix of a box has a training cost below ``lower_bound``.

    best_cost: the lowest one known. gap: 1 - lower_bound / best_cost. parts: of the box that were looked at. finished:
    False when the config's seconds came before its gap.
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
class ScoredRun:
    """A run with what its pictures need.

    history: the best cost so far. train_errors, validation_errors (Z, 3): odometry minus reference at the last
    reference pose of each trajectory of the split (m, m, rad). train_costs, validation_costs (Z,): the cost of each
    trajectory; None where there is no answer, or no such split. theoretical_*_costs (Z,): the same of the design.
    """

    record: RunRecord
    history: tuple[Improvement, ...]
    train_errors: Array | None
    train_costs: Array | None
    validation_errors: Array | None
    validation_costs: Array | None
    theoretical_train_costs: Array
    theoretical_validation_costs: Array | None

    @property
    def matrix(self) -> Array | None:
        """The inverse kinematic matrix (3, N)."""
        return None if self.record.matrix is None else np.array(self.record.matrix)


@dataclass(frozen=True)
class Interval:
    """A value with its 95 % bootstrap interval over trajectories."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class EntryStatistics:
    """One entry of the comparison (calibrator, parameterisation, box) on one data set, over its seeds.

    ``typical`` is the run of median training cost; intervals and differences are of that run.
    spread: interquartile range of the training cost over seeds. difference: paired mean difference in validation
    cost (training cost where there is no validation split) against the best entry.
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
    train: Interval | None
    train_improvement: Interval | None
    validation: Interval | None
    validation_improvement: Interval | None
    difference: Interval | None
    practically_equal: bool | None
    is_best: bool
    gap_median: float | None
    proven_gap_median: float | None
    evaluations_median: float | None
    seconds_median: float | None


@dataclass(frozen=True, eq=False)
class ComparisonResult:
    """Everything that the report shows. uncertainties: of the entries' typical runs, by data set and label."""

    config: CompareConfig
    output: Path
    datasets: dict[str, Dataset]
    runs: tuple[ScoredRun, ...]
    statistics: tuple[EntryStatistics, ...]
    certificates: tuple[BoxCertificate, ...]
    uncertainties: Mapping[tuple[str, str], Uncertainty]
    environment: Environment
    warnings: tuple[str, ...]
