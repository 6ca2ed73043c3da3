"""Statistics as the report words them: which figure of an entry counts on a split, intervals, units."""

from __future__ import annotations

from omnibench.compare.report.view import DatasetView
from omnibench.compare.result import EntryStatistics, Interval
from omnibench.data.dataset import Split
from omnibench.report.numbers import NOTHING, decimals_for, fixed, percent, significant, span


def improvement(entry: EntryStatistics, split: Split) -> Interval | None:
    """The share by which an entry's cost lies below that of the design values."""
    return entry.train_improvement if split == "train" else entry.validation_improvement


def improvement_in_words(entry: EntryStatistics, split: Split, decimals: int) -> tuple[str, str]:
    """An improvement and its interval, in per cent."""
    found = improvement(entry, split)
    if found is None:
        return NOTHING, ""
    return percent(found.value, decimals), f"{span(100 * found.low, 100 * found.high, 1)} %"


def level_in_words(view: DatasetView) -> str:
    """That others are practically equal to the best, if so."""
    return f"of {len(view.level)} that are level" if len(view.level) > 1 else ""


def cost(entry: EntryStatistics, split: Split) -> Interval | None:
    """An entry's cost on a split."""
    return entry.train if split == "train" else entry.validation


def cost_decimals(view: DatasetView) -> int:
    """Decimals of a data set's costs: four as in the paper, more where that leaves the lowest too few digits."""
    costs = [interval.value for entry in view.statistics for interval in (entry.train, entry.validation) if interval]
    return min(7, max(4, decimals_for(min(costs, default=None), 3)))


def position_unit(*errors: float) -> tuple[float, str, int]:
    """Factor, unit and decimals in which these lengths (m) are best read: mm below a metre."""
    return (1e3, "mm", 1) if max(errors, default=0.0) < 1.0 else (1.0, "m", 3)


def difference_in_words(difference: Interval) -> tuple[str, str]:
    """A difference and its interval, to two digits of the larger end."""
    largest = max(abs(difference.low), abs(difference.high))
    if 0 < largest < 1e-5:
        value, low, high = (significant(v, 2, signed=True) for v in (difference.value, difference.low, difference.high))
        return value, f"{low} to {high}"
    digits = max(4, decimals_for(largest, 2))
    return fixed(difference.value, digits, signed=True), span(difference.low, difference.high, digits, signed=True)
