"""Other readings of a recording: it is read anew by its importer, and kept where that makes sense of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from omnibench.data.checks.finding import Finding, FindingWarning
from omnibench.data.checks.misread_search import UNRELATED, Explained, search
from omnibench.fit.check.fixes import CannotBeTypedError, mended_options
from omnibench.fit.check.recording_source import RecordingSource, attempt, odd_times, other_times, recorded

_QUANTITIES = {"": "positions", "/sample": "increments since the row before", "/s": "rates"}


def read_otherwise(read: RecordingSource, explained: Explained) -> RecordingSource | None:
    """The recording by other units, with the findings that say so; None where none makes more sense of it.

    explained: what the search for misreadings tells of it. Tried are the units that reading it warned of, where the
    search tells something else, and wheels that count positions in the place of rates or increments, and the like,
    where no matrix explains the motion, with other units of time where the times are odd.
    """
    if not read.readable:
        return None
    warned = _warned(read)
    if {finding.kind for finding in warned} - {mistake.kind for mistake in explained.mistakes}:
        other = _mended(read, warned)
        return None if other is None or _warned(other) or search(recorded(other.dataset)).mistakes else other
    senseless = explained.unexplained > UNRELATED or (not explained.told and odd_times(read.dataset))
    if senseless and not any(finding.kind == "wheel_unit" for finding in read.findings):
        return next(filter(None, (_mended(read, findings) for findings in _other_units(read))), None)
    return None


def _other_units(read: RecordingSource) -> Iterator[list[Finding]]:
    """Findings that another quantity of the wheels would mend, each with another unit of times that are odd."""
    odd = odd_times(read.dataset)
    times = [[finding] for finding in other_times(read.importer, read.options)] if odd else [[]]
    return ([*time, quantity] for time in times for quantity in _other_quantities(read))


def _warned(read: RecordingSource) -> list[Finding]:
    """The findings of units that reading the recording warned of."""
    return [each.finding for each in read.dataset.warnings if isinstance(each, FindingWarning) and each.unit]


def _mended(read: RecordingSource, findings: list[Finding]) -> RecordingSource | None:
    """The recording read anew without the mistakes of findings, old and new; None if it makes no sense then."""
    found = (*read.findings, *findings)
    try:
        options = mended_options(read, read.importer, read.options, [finding.changes for finding in found])
    except CannotBeTypedError:
        return None
    dataset = attempt(read.importer, read.source, options)
    return None if dataset is None else replace(read, dataset=dataset, findings=found)


def _other_quantities(read: RecordingSource) -> Iterator[Finding]:
    present = str(read.options.get("wheel_unit", "rad/s"))
    unit, _, per = present.partition("/")
    for ending, quantity in _QUANTITIES.items():
        if unit != "rpm" and ending.lstrip("/") != per:
            yield Finding(
                kind="wheel_unit",
                what=f"the wheels look like {quantity} ({unit}{ending}); they are read as "
                f"{_QUANTITIES[present.removeprefix(unit)]} ({present})",
                where="all wheels",
                severity="error",
                changes={"wheel_quantity": f"{unit}{ending}"},
            )
