"""The report's view of one data set: its results, how entries are drawn, and how its numbers are said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.compare import result as results
from omnibench.compare.config import THEORETICAL_NAME, CompareConfig, PublishedResult
from omnibench.compare.plan import UNBOUNDED
from omnibench.data.dataset import SPLITS, Dataset, Split, Trajectory
from omnibench.fit.evaluate import final_errors
from omnibench.fit.intervals import Clusters, Interval, units_of
from omnibench.fit.reference_rows import measured_parts
from omnibench.registry import calibrators, costs
from omnibench.report.blocks import Cell, LegendItem
from omnibench.report.numbers import NOTHING, count, decimals_for, fixed, percent, seconds, significant, span
from omnibench.report.style import REFERENCE, SYMBOLS, THEORETICAL, colours
from omnibench.robot.calibration import ModelExtension, extended_model
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

SPLIT_NAMES: Mapping[Split, str] = {"train": "training", "validation": "held-out"}

# Colours by calibrator. The paper draws its non-parametric (genetic) result in magenta, the parametric one in brown.
_CUSTOMARY = {
    "closed_form": "#0072b2",
    "crs": "#e69f00",
    "genetic": "#aa3377",
    "isres": "#4fb0e8",
    "parametric": "#7b4b2a",
    "random_search": "#8a8f98",
}


REFERENCE_STYLE = LegendItem("reference", "reference", REFERENCE)
THEORETICAL_STYLE = LegendItem("theoretical", "design values", THEORETICAL, "dash")


@dataclass(frozen=True, eq=False)
class DatasetView:
    """One data set of the comparison.

    warnings: warnings of the whole comparison. styles: styles by label, the same in the whole report. design_costs:
    mean cost of the design values on each split that has trajectories. design_errors: final pose errors (Z, 3) of the
    design matrix on each such split, m, m, rad. units: what the intervals of each such split rest on. held_out: what
    held-out runs say of the best calibration, if there is one. sessions: sentences on those that differ.
    """

    name: str
    config: CompareConfig
    dataset: Dataset
    runs: tuple[results.ScoredFit, ...]
    statistics: tuple[results.EntryStatistics, ...]
    certificates: tuple[results.BoxCertificate, ...]
    warnings: tuple[str, ...]
    styles: Mapping[str, LegendItem]
    design_costs: Mapping[Split, Interval]
    design_errors: Mapping[Split, Array]
    units: Mapping[Split, Clusters]
    held_out: results.EntryVerdict | None
    sessions: tuple[str, ...]

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
    def not_told_apart(self) -> list[results.EntryStatistics]:
        """Entries whose difference from the best may be chance, itself among them.

        The design values are not, where the best one's improvement on them is more than chance.
        """
        gained = None if self.best is None else self.best.improvement(self.scored)
        better = gained is not None and gained.known is not None and not gained.holds(0.0)
        return [
            entry
            for entry in self.statistics
            if entry.is_best or (entry.practically_equal and not (better and entry.calibrator == THEORETICAL_NAME))
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
    def typical_runs(self) -> list[results.ScoredFit]:
        """The run of each entry with the median training cost; its first where none gave an answer."""
        first = {run.record.label: run for run in reversed(self.runs)}
        return [entry.typical or first[entry.label] for entry in self.statistics]

    @property
    def reference_entry(self) -> tuple[results.EntryStatistics, results.ScoredFit] | None:
        """The entry that matrices are compared with: closed_form's, else the best calibration."""
        exact = [pair for pair in self.calibrated if calibrators.entry(pair[0].calibrator).cls.exact]
        best = [pair for pair in self.calibrated if pair[0].is_best]
        return next(iter(exact + best + self.calibrated), None)

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
        return _told(run.scores[split].errors, self.dataset.split(split)) if split in run.scores else None

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


def views(result: results.ComparisonResult) -> list[DatasetView]:
    """The data sets of a comparison, in the config's order."""
    # A style for each label; the design values have theirs
    names = {entry.label: entry.calibrator for entry in result.statistics}
    names |= {run.record.label: run.record.calibrator for run in result.runs}
    searches = {label: name for label, name in names.items() if name != THEORETICAL_NAME}
    drawn = colours({label: _CUSTOMARY.get(name) for label, name in searches.items()})
    by_label = {
        label: LegendItem(f"entry-{index}", label, colour, dash, SYMBOLS[index % len(SYMBOLS)])
        for index, (label, (colour, dash)) in enumerate(drawn.items())
    }
    styles = {label: by_label.get(label, THEORETICAL_STYLE) for label in names}
    return [_view(result, name, styles) for name in result.datasets]


def _view(result: results.ComparisonResult, name: str, styles: Mapping[str, LegendItem]) -> DatasetView:
    dataset = result.datasets[name]
    design = OdometryModel.of_design(dataset.robot, result.config.integration)
    return DatasetView(
        name=name,
        config=result.config,
        dataset=dataset,
        runs=tuple(run for run in result.runs if run.record.dataset == name),
        statistics=tuple(entry for entry in result.statistics if entry.dataset == name),
        certificates=tuple(certificate for certificate in result.certificates if certificate.dataset == name),
        warnings=result.warnings,
        styles=styles,
        design_costs=result.design_costs.get(name, {}),
        design_errors={
            split: _told(final_errors(design, dataset.split(split)), dataset.split(split))
            for split in SPLITS
            if dataset.split(split)
        },
        units={
            split: units_of(dataset.split(split), result.config.bootstrap.unit)
            for split in SPLITS
            if dataset.split(split)
        },
        held_out=result.held_out.get(name),
        sessions=result.sessions.get(name, ()),
    )


def _told(errors: Array, runs: Sequence[Trajectory]) -> Array:
    """Final errors (Z, 3), NaN for positions and for headings of runs whose references tell no lengths or no angles."""
    placed, turned = measured_parts(runs)
    told: Array = np.where(np.column_stack([placed, placed, turned]), errors, np.nan)
    return told


NO_INTERVAL = "no interval"


def improvement_in_words(entry: results.EntryStatistics, split: Split, decimals: int) -> tuple[str, str]:
    """An entry's improvement on a split and its interval, in per cent."""
    share = entry.improvement(split)
    if share is None:
        return NOTHING, ""
    if share.known is None:
        return percent(share.value, decimals), NO_INTERVAL
    return percent(share.value, decimals), f"{span(100 * share.known[0], 100 * share.known[1], 1)} %"


def interval_basis(view: DatasetView, split: Split) -> str:
    """The basis of a split's intervals, in words: ``bootstrap over 36 commands``."""
    return view.units[split].ratio_words


def interval_in_words(interval: Interval | None, decimals: int) -> str:
    """An interval; empty where there is no value."""
    if interval is None:
        return ""
    return NO_INTERVAL if interval.known is None else span(*interval.known, decimals)


def rivals_in_words(view: DatasetView) -> str:
    """Number of entries that are not told apart from the best, in words; empty where there are none."""
    others = len(view.not_told_apart) - 1
    return f"not told apart from {plural(others, 'other')}" if others > 0 else ""


def entry_cell(view: DatasetView, entry: results.EntryStatistics | None) -> Cell:
    """An entry's name with its colour; None stands for the design values."""
    if entry is None:
        return Cell(THEORETICAL_NAME, "design values", THEORETICAL_STYLE.colour)
    if entry.calibrator == THEORETICAL_NAME:
        note = "design values"
    elif entry.box == UNBOUNDED:
        note = f"{entry.parameterisation}, as given"
    else:
        note = "geometry within limits" if entry.parameterisation == "geometry" else f"matrix, box {entry.box}"
    return Cell(entry.label, note, view.styles[entry.label].colour)


def on_bounds(record: results.RunRecord) -> list[str]:
    """Elements that the search moved to a bound; not those that the box holds at their start value."""
    return [name for name in record.at_bounds if name not in record.held]


def cost_in_words(view: DatasetView) -> str:
    """The cost's name and its summary, and the loss, if it is a robust one."""
    words = f"{view.config.cost_name}: {costs.entry(view.config.cost_name).summary.rstrip('.')}."
    if view.config.loss == "squares":
        return words
    return f"{words} It was fitted with the loss {view.config.loss}; figures here are without it."


def cost_decimals(view: DatasetView) -> int:
    """Decimals of a data set's costs: four as in the paper, more where that leaves the lowest too few digits."""
    values = [of_split.cost.value for entry in view.statistics for of_split in entry.splits.values()]
    return min(7, max(4, decimals_for(min(values, default=None), 3)))


def position_unit(*errors: float) -> tuple[float, str, int]:
    """Factor from m, unit and decimals in which these errors (m) are shown: mm below a metre."""
    return (1.0, "m", 3) if any(error >= 1.0 for error in errors) else (1e3, "mm", 1)


def mean_and_worst(values: Array) -> tuple[float, float]:
    """Mean and largest of the values (n,) that are known; NaN where none is."""
    known = values[np.isfinite(values)]
    return (float(known.mean()), float(known.max())) if len(known) else (np.nan, np.nan)


def difference_in_words(difference: Interval) -> tuple[str, str]:
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
