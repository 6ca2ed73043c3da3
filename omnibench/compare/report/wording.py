"""Wording that the report's parts share: entries, costs, improvements, differences, units."""

from __future__ import annotations

import numpy as np

from omnibench.compare.plan import UNBOUNDED
from omnibench.compare.report.view import THEORETICAL_STYLE, DatasetView
from omnibench.compare.result import THEORETICAL_NAME, EntryStatistics, RunRecord
from omnibench.data.dataset import Split
from omnibench.fit.ratio_intervals import Interval
from omnibench.registry import costs
from omnibench.report.blocks import Cell
from omnibench.report.numbers import NOTHING, decimals_for, fixed, percent, significant, span
from omnibench.robot.kinematics import Array
from omnibench.words import plural

NO_INTERVAL = "no interval"


def improvement_in_words(entry: EntryStatistics, split: Split, decimals: int) -> tuple[str, str]:
    """An entry's improvement on a split and its interval, in per cent."""
    share = entry.improvement(split)
    if share is None:
        return NOTHING, ""
    if share.known is None:
        return percent(share.value, decimals), NO_INTERVAL
    return percent(share.value, decimals), f"{span(100 * share.known[0], 100 * share.known[1], 1)} %"


def interval_basis(view: DatasetView, split: Split) -> str:
    """The basis of a split's intervals, in words: ``bootstrap over 36 commands``."""
    return view.units[split].words


def interval_in_words(interval: Interval | None, decimals: int) -> str:
    """An interval; empty where there is no value."""
    if interval is None:
        return ""
    return NO_INTERVAL if interval.known is None else span(*interval.known, decimals)


def rivals_in_words(view: DatasetView) -> str:
    """Number of entries that are not told apart from the best, in words; empty where there are none."""
    others = len(view.not_told_apart) - 1
    return f"not told apart from {plural(others, 'other')}" if others > 0 else ""


def entry_cell(view: DatasetView, entry: EntryStatistics | None) -> Cell:
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


def on_bounds(record: RunRecord) -> list[str]:
    """Elements that the search moved to a bound; not those that the box holds at their start value."""
    return [name for name in record.at_bounds if name not in record.held]


def cost_in_words(view: DatasetView) -> str:
    """The cost's name and its summary, and the loss, if it is a robust one."""
    words = f"{view.config.cost.name}: {costs.entry(view.config.cost.name).summary.rstrip('.')}."
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
