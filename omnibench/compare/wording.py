"""Statistics as the report words them: which figure of an entry counts on a split, intervals, units."""

from __future__ import annotations

from omnibench.compare.results import EntryStatistics, Interval
from omnibench.data.dataset import Split
from omnibench.report.numbers import decimals_for, fixed, span


def improvement(entry: EntryStatistics, split: Split) -> Interval | None:
    """The share by which an entry's cost lies below that of the design values."""
    return entry.train_improvement if split == "train" else entry.validation_improvement


def cost(entry: EntryStatistics, split: Split) -> Interval | None:
    """An entry's cost on a split."""
    return entry.train if split == "train" else entry.validation


def interval_in_percent(interval: Interval) -> str:
    """``80.9 to 82.5 %``."""
    return f"{span(100 * interval.low, 100 * interval.high, 1)} %"


def position_unit(*errors: float) -> tuple[float, str, int]:
    """Factor, unit and decimals in which these lengths (m) are best read: mm below a metre."""
    return (1e3, "mm", 1) if max(errors, default=0.0) < 1.0 else (1.0, "m", 3)


def difference_in_words(difference: Interval) -> tuple[str, str]:
    """A difference and its interval, to two digits of the larger end."""
    digits = max(4, decimals_for(max(abs(difference.low), abs(difference.high)), 2))
    return fixed(difference.value, digits, signed=True), span(difference.low, difference.high, digits, signed=True)
