"""The results on one data set as they are shown: what is best, how entries are drawn, and how its numbers are said."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from omnibench.compare import result as results
from omnibench.compare.config import THEORETICAL_NAME, CompareConfig, PublishedResult
from omnibench.compare.plan import UNBOUNDED
from omnibench.data.dataset import SPLITS, Dataset, Split
from omnibench.fit.evaluate import final_errors
from omnibench.fit.intervals import Clusters, Interval, units_of
from omnibench.fit.reference_rows import measured_parts
from omnibench.registry import calibrators
from omnibench.report.blocks import Cell, LegendItem
from omnibench.report.numbers import NOTHING, count, decimals_for, fixed, percent, seconds, significant, span
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


@dataclass(frozen=True, eq=False)
class DatasetView:
    """One data set of a comparison. styles: by label, the same in the whole report."""

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
    def certificates(self) -> tuple[results.BoxCertificate, ...]:
        """What is proven of its boxes."""
        return tuple(each for each in self.result.certificates if each.dataset == self.name)

    @property
    def held_out(self) -> results.EntryVerdict | None:
        """What held-out runs say of the best calibration, if there is one."""
        return self.result.held_out.get(self.name)

    @property
    def design_costs(self) -> Mapping[Split, Interval]:
        """The mean cost of the design values on each split that has trajectories."""
        return self.result.design_costs.get(self.name, {})

    @cached_property
    def design_errors(self) -> Mapping[Split, Array]:
        """Final pose errors (Z, 3) of the design matrix on each split that has trajectories, m, m, rad."""
        design = OdometryModel.of_design(self.dataset.robot, self.config.integration)
        splits = [split for split in SPLITS if self.dataset.split(split)]
        return {split: self._told(final_errors(design, self.dataset.split(split)), split) for split in splits}

    def units(self, split: Split) -> Clusters:
        """The draws that a split's intervals rest on."""
        return units_of(self.dataset.split(split), self.config.bootstrap.unit)

    @property
    def times_compare(self) -> bool:
        """True if the seconds of runs may be compared: the config times them, and on one machine."""
        return self.config.timing and len({run.record.machine for run in self.runs if run.record.machine}) < 2

    def time_in_words(self, spent: float | None, references: float | None) -> str:
        """A time in s; where machines differ, in evaluations of the start's cost there; none of untimed runs."""
        if not self.config.timing:
            return NOTHING
        if self.times_compare:
            return seconds(spent)
        return NOTHING if references is None else f"{count(references)} of the start"

    @property
    def splits(self) -> tuple[Split, ...]:
        """The splits that have trajectories."""
        return tuple(self.design_errors)

    @property
    def scored(self) -> Split:
        """The split that the verdict is about: validation where there is one."""
        return "validation" if "validation" in self.design_errors else "train"

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
    def of_the_paper(self) -> bool:
        """True if the paper's figures are set beside these: only then is the paper spoken of."""
        return bool(self.config.published_results)

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
    def reference_entry(self) -> results.EntryStatistics | None:
        """The entry that matrices are compared with: closed_form's, else the best calibration."""
        entries = [entry for entry, _ in self.calibrated]
        exact = [entry for entry in entries if calibrators.entry(entry.calibrator).cls.exact]
        return next(iter([*exact, *(entry for entry in entries if entry.is_best), *entries]), None)

    @property
    def published_entries(self) -> list[tuple[PublishedResult, results.EntryStatistics, results.ScoredFit]]:
        """Published results whose method is an entry here that gave an answer, with that entry and its typical run."""
        answers = {entry.label: (entry, run) for entry, run in self.calibrated if run.matrix is not None}
        return [(result, *answers[result.entry]) for result in self.config.published_results if result.entry in answers]

    def theoretical_cost(self, split: Split) -> float | None:
        """The cost of the design values on a split; None where there is no run, or no such split."""
        return self.runs[0].design[split].cost if self.runs and split in self.runs[0].design else None

    def errors(self, run: results.ScoredFit, split: Split) -> Array | None:
        """Final pose errors (Z, 3) of a run's answer, m, m, rad; NaN where the references do not tell them."""
        return self._told(run.scores[split].errors, split) if split in run.scores else None

    def _told(self, errors: Array, split: Split) -> Array:
        """Final errors (Z, 3), NaN where a run's references tell no lengths or no angles."""
        placed, turned = measured_parts(self.dataset.split(split))
        told: Array = np.where(np.column_stack([placed, placed, turned]), errors, np.nan)
        return told

    @property
    def without_poses(self) -> bool:
        """True if the runs that are scored have distances, turns and the like, and none has poses."""
        return not any(run.has_poses for run in self.dataset.split(self.scored))

    def model(self, matrix: Array, extension: ModelExtension | None = None) -> OdometryModel:
        """The odometry that the comparison used, with another matrix, and with what extends it."""
        robot, integration = self.dataset.robot, self.config.integration
        return extended_model(robot, matrix, integration, self.dataset.sample_period, extension)

    @property
    def design_matrix(self) -> Array:
        """The design matrix (3, M)."""
        return self.dataset.robot.inverse_kinematic_matrix

    @property
    def cost_decimals(self) -> int:
        """Decimals of costs: four as in the paper, more where that leaves the lowest too few digits."""
        values = [of_split.cost.value for entry in self.statistics for of_split in entry.splits.values()]
        return min(7, max(4, decimals_for(min(values, default=None), 3)))

    def entry_cell(self, entry: results.EntryStatistics | None) -> Cell:
        """An entry's name with its colour; None stands for the design values."""
        if entry is None or entry.calibrator == THEORETICAL_NAME:
            label = THEORETICAL_NAME if entry is None else entry.label
            return Cell(label, "design values", THEORETICAL_STYLE.colour)
        note = "geometry within limits" if entry.parameterisation == "geometry" else f"matrix, box {entry.box}"
        if entry.box == UNBOUNDED:
            note = f"{entry.parameterisation}, as given"
        return Cell(entry.label, note, self.styles[entry.label].colour)


def views(result: results.ComparisonResult) -> list[DatasetView]:
    """The data sets of a comparison, in the config's order."""
    names = {run.record.label: run.record.calibrator for run in result.runs}
    names |= {entry.label: entry.calibrator for entry in result.statistics}
    drawn = colours({label: _CUSTOMARY.get(name) for label, name in names.items() if name != THEORETICAL_NAME})
    by_label = {
        label: LegendItem(f"entry-{index}", label, colour, dash, SYMBOLS[index % len(SYMBOLS)])
        for index, (label, (colour, dash)) in enumerate(drawn.items())
    }
    styles = {label: by_label.get(label, THEORETICAL_STYLE) for label in names}
    return [DatasetView(result, name, styles) for name in result.datasets]


def improvement_cells(entry: results.EntryStatistics, split: Split, decimals: int) -> tuple[str, str]:
    """An entry's improvement on a split and its interval, in per cent."""
    share = entry.improvement(split)
    if share is None:
        return NOTHING, ""
    known = share.known
    interval = NO_INTERVAL if known is None else f"{span(100 * known[0], 100 * known[1], 1)} %"
    return percent(share.value, decimals), interval


def interval_cell(interval: Interval | None, decimals: int) -> str:
    """An interval; empty where there is no value."""
    if interval is None:
        return ""
    return NO_INTERVAL if interval.known is None else span(*interval.known, decimals)


def difference_cells(difference: Interval) -> tuple[str, str]:
    """A difference and its interval, with decimals that show two digits of the larger end."""
    low, high = difference.known or (difference.value, difference.value)
    largest = max(abs(low), abs(high))
    if 0 < largest < 1e-5:
        value, *ends = (significant(each, 2, signed=True) for each in (difference.value, low, high))
        between = " to ".join(ends)
    else:
        digits = max(4, decimals_for(largest, 2))
        value, between = fixed(difference.value, digits, signed=True), span(low, high, digits, signed=True)
    return value, NO_INTERVAL if difference.known is None else between


def rivals_cell(view: DatasetView) -> str:
    """The number of entries that are not told apart from the best; empty where there are none."""
    return f"not told apart from {plural(len(view.rivals), 'other')}" if view.rivals else ""


def position_unit(*errors: float) -> tuple[float, str, int]:
    """Factor from m, unit and decimals in which these errors (m) are shown: mm below a metre."""
    return (1.0, "m", 3) if any(error >= 1.0 for error in errors) else (1e3, "mm", 1)


def mean_and_worst(values: Array) -> tuple[float, float]:
    """Mean and largest of the values (n,) that are known; NaN where none is."""
    known = values[np.isfinite(values)]
    return (float(known.mean()), float(known.max())) if len(known) else (np.nan, np.nan)
