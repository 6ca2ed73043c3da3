"""The results on one data set as they are shown: what is best, how entries are drawn, and how its numbers are said."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from omnibench.compare import result as results
from omnibench.compare.config import THEORETICAL_NAME, CompareConfig, PublishedResult
from omnibench.data.dataset import Dataset, Split
from omnibench.fit.intervals import Clusters, Interval, units_of
from omnibench.fit.reference_rows import measured_parts
from omnibench.report.blocks import LegendItem
from omnibench.report.numbers import NOTHING, decimals_for, fixed, percent, significant, span
from omnibench.report.style import SYMBOLS, THEORETICAL, colours
from omnibench.robot.calibration import ModelExtension, extended_model
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

SPLIT_NAMES: Mapping[Split, str] = {"train": "training", "validation": "held-out"}
NO_INTERVAL = "no interval"
THEORETICAL_STYLE = LegendItem("theoretical", "design values", THEORETICAL, "dash")
# Colours by calibrator. The paper draws its non-parametric (genetic) result in magenta, the parametric one in brown.
_CUSTOMARY = {
    "closed_form": "#0072b2",
    "crs": "#e69f00",
    "genetic": "#aa3377",
    "isres": "#4fb0e8",
    "parametric": "#7b4b2a",
    "random_search": "#8a8f98",
}


def styles(result: results.ComparisonResult) -> Mapping[str, LegendItem]:
    """Colour, line and symbol of every entry by its label, the same in the whole report."""
    names = {run.fit.label: run.fit.settings.calibrator for run in result.runs}
    drawn = colours({label: _CUSTOMARY.get(name) for label, name in names.items() if name != THEORETICAL_NAME})
    of_label = {label: replace(THEORETICAL_STYLE, label=label) for label in names}
    for index, (label, (colour, dash)) in enumerate(drawn.items()):
        of_label[label] = LegendItem(f"entry-{index}", label, colour, dash, SYMBOLS[index % len(SYMBOLS)])
    return of_label


@dataclass(frozen=True, eq=False)
class DatasetView:
    """One data set of a comparison. styles: of entries by label."""

    result: results.ComparisonResult
    name: str
    styles: Mapping[str, LegendItem]

    @property
    def config(self) -> CompareConfig:
        """The effective config."""
        return self.result.config

    @property
    def dataset(self) -> Dataset:
        """The data set."""
        return self.result.datasets[self.name]

    @cached_property
    def runs(self) -> tuple[results.ScoredFit, ...]:
        """All fits to it."""
        return tuple(run for run in self.result.runs if run.record.dataset == self.name)

    @cached_property
    def statistics(self) -> tuple[results.EntryStatistics, ...]:
        """The statistics of its entries."""
        return tuple(entry for entry in self.result.statistics if entry.dataset == self.name)

    @property
    def design_costs(self) -> Mapping[Split, Interval]:
        """The mean cost of the design values on each split that has trajectories."""
        return self.result.design_costs.get(self.name, {})

    @cached_property
    def design_errors(self) -> Mapping[Split, Array]:
        """Final pose errors (Z, 3) of the design matrix on each split that has trajectories, m, m, rad."""
        return {split: self._told(score.errors, split) for split, score in self.runs[0].design.items()}

    def errors(self, entry: results.EntryStatistics | None, split: Split) -> Array | None:
        """Final pose errors (Z, 3) of an entry's typical answer, m, m, rad; NaN where the references do not tell them.

        None without an answer, or without such a split.
        """
        run = None if entry is None else entry.typical
        return self._told(run.scores[split].errors, split) if run is not None and split in run.scores else None

    def _told(self, errors: Array, split: Split) -> Array:
        placed, turned = measured_parts(self.dataset.split(split))
        return np.where(np.column_stack([placed, placed, turned]), errors, np.nan)

    def units(self, split: Split) -> Clusters:
        """The draws that a split's intervals rest on."""
        return units_of(self.dataset.split(split), self.config.bootstrap.unit)

    @property
    def splits(self) -> tuple[Split, ...]:
        """The splits that have trajectories, the scored one first."""
        return tuple(sorted(self.design_errors, key=lambda split: split != self.scored))

    @property
    def scored(self) -> Split:
        """The split that the verdict is about: validation where there is one."""
        return "validation" if "validation" in self.design_errors else "train"

    def runs_in_words(self, split: Split) -> str:
        """The number of runs of a split."""
        return plural(len(self.dataset.split(split)), f"{SPLIT_NAMES[split]} run")

    @property
    def best(self) -> results.EntryStatistics | None:
        """The best entry, unless nothing gave an answer."""
        return next((entry for entry in self.statistics if entry.is_best and entry.typical is not None), None)

    @property
    def rivals(self) -> list[results.EntryStatistics]:
        """Entries whose difference from the best may be chance.

        The design values are none, where the best one's improvement on them is more than chance.
        """
        gained = None if self.best is None else self.best.improvement(self.scored)
        better = gained is not None and gained.known is not None and not gained.holds(0.0)
        return [
            entry
            for entry in self.statistics
            if entry.practically_equal and not entry.is_best and not (better and entry.calibrator == THEORETICAL_NAME)
        ]

    @property
    def undecided(self) -> bool:
        """True if some entries cannot be compared with the best: there is no interval."""
        return any(entry.practically_equal is None and entry.answers for entry in self.statistics)

    @property
    def calibrated(self) -> list[tuple[results.EntryStatistics, results.ScoredFit]]:
        """Entries with an answer, and their typical run; without the design values."""
        return [
            (entry, entry.typical)
            for entry in self.statistics
            if entry.typical is not None and entry.calibrator != THEORETICAL_NAME
        ]

    @property
    def published_entries(self) -> list[tuple[PublishedResult, results.EntryStatistics, results.ScoredFit]]:
        """Published results whose method is an entry here that gave an answer, with that entry and its typical run."""
        answers = {entry.label: (entry, run) for entry, run in self.calibrated if run.matrix is not None}
        return [(result, *answers[result.entry]) for result in self.config.published_results if result.entry in answers]

    @property
    def without_poses(self) -> bool:
        """True if the runs that are scored have distances, turns and the like, and none has poses."""
        return not any(run.has_poses for run in self.dataset.split(self.scored))

    def model(self, matrix: Array | None = None, extension: ModelExtension | None = None) -> OdometryModel:
        """The odometry that the comparison used, with another matrix than the design's, and with what extends it."""
        robot = self.dataset.robot
        matrix = robot.inverse_kinematic_matrix if matrix is None else matrix
        return extended_model(robot, matrix, self.config.integration, self.dataset.sample_period, extension)

    @property
    def cost_decimals(self) -> int:
        """Decimals of costs: four as in the paper, more where that leaves the lowest too few digits."""
        values = [cost.value for entry in self.statistics for cost in entry.costs.values()]
        return min(7, max(4, decimals_for(min(values, default=None), 3)))


def views(result: results.ComparisonResult) -> list[DatasetView]:
    """The data sets of a comparison, in the config's order; none of robots."""
    drawn = styles(result)
    return [DatasetView(result, name, drawn) for name in result.datasets if result.config.datasets]


def improvement_cells(share: Interval | None, decimals: int) -> tuple[str, str]:
    """An improvement and its interval, in per cent."""
    if share is None:
        return NOTHING, ""
    if share.known is None:
        return percent(share.value, decimals), NO_INTERVAL
    low, high = share.known
    return percent(share.value, decimals), f"{span(100 * low, 100 * high, 1)} %"


def interval_cell(interval: Interval | None, decimals: int) -> str:
    """An interval; empty where there is no value."""
    if interval is None:
        return ""
    return NO_INTERVAL if interval.known is None else span(*interval.known, decimals)


def difference_cells(difference: Interval) -> tuple[str, str]:
    """A difference and its interval, with decimals that show two digits of the larger end."""
    low, high = difference.known or (difference.value, difference.value)
    largest = max(abs(low), abs(high))
    digits = max(4, decimals_for(largest, 2))
    value, low_end, high_end = (
        significant(each, 2, signed=True) if 0 < largest < 1e-5 else fixed(each, digits, signed=True)
        for each in (difference.value, low, high)
    )
    return value, NO_INTERVAL if difference.known is None else f"{low_end} to {high_end}"


def position_unit(*errors: float) -> tuple[float, str, int]:
    """Factor from m, unit and decimals in which these errors (m) are shown: mm below a metre."""
    return (1.0, "m", 3) if any(error >= 1.0 for error in errors) else (1e3, "mm", 1)


def mean_and_worst(values: Array) -> tuple[float, float]:
    """Mean and largest of the values (n,) that are known; NaN where none is."""
    known = values[np.isfinite(values)]
    return (float(known.mean()), float(known.max())) if len(known) else (np.nan, np.nan)
