"""The runs of one recording: of its unbroken stretches, windows, and what gaps, jumps and rests leave of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.data.importers.runs.cut_run import CutRun, cut_run
from omnibench.data.importers.runs.measured_runs import with_measured
from omnibench.data.importers.runs.reference_options import ReferenceOptions
from omnibench.data.importers.runs.reference_stream import ReferenceStream
from omnibench.data.importers.runs.run_spans import Span, breaks, from_rest, parted
from omnibench.data.importers.wheel_samples import WheelSamples
from omnibench.words import plural

_SAME_TIME = 1e-6  # s; unix time in a double has steps of 0.2 us
_SHORTEST = 1.0  # s, of a run between two gaps or jumps; chosen: the odometry of a shorter one shows noise only


@dataclass(frozen=True)
class _Piece:
    """A span of an unbroken part of the samples. broken: a gap or a jump ended it, or the piece before."""

    part: slice
    span: Span
    broken: bool = False


def recording_runs(
    whole: Trajectory,
    samples: WheelSamples,
    reference: ReferenceStream,
    options: ReferenceOptions,
    notes: list[str],
    place: str,
    window: float | None = None,
) -> list[CutRun]:
    """The runs of a recording, called ``<recording>#1`` ... where there are several; empty if none has two poses.

    whole: the recording as a run, see ``cut_run``. place: for messages. window: s; cuts into runs this long. What is
    left out is added to ``notes``.
    """
    uncut = list(_pieces(samples, window))
    pieces = _cut(uncut, samples, reference, options)
    standing = sum(piece is None for piece in pieces)
    named = len(pieces) > 1
    if named and whole.session is None:
        whole = replace(whole, session=whole.id, started_at=0.0)
    runs, bare, short = [], 0, 0
    for number, piece in enumerate(pieces, 1):
        if piece is None:
            continue
        if piece.broken and piece.span[1] - piece.span[0] < _SHORTEST:
            short += 1
            continue
        # From pose to pose where it was cut: one interpolated within a drive would be wrong by the path's bend.
        untouched = not named and piece == uncut[0]
        run = _run(whole, samples, reference, piece, slice(None) if untouched else _seen(reference, piece.span))
        if run is None:
            bare += 1
        elif named:
            command = None if piece.broken else whole.command
            runs.append(replace(run, trajectory=replace(run.trajectory, id=f"{whole.id}#{number}", command=command)))
        else:
            runs.append(run)
    if len(pieces) > len(uncut) and runs:
        notes.append(f"{place}: cut into {plural(len(pieces), 'run')} where wheels or poses are missing or jump")
    reasons = {"too few poses": bare, f"shorter than {_SHORTEST:g} s": short, "never at rest (start_at_rest)": standing}
    if runs and any(reasons.values()):
        said = ", ".join(reason for reason, count in reasons.items() if count)
        notes.append(f"{place}: {sum(reasons.values())} of {plural(len(pieces), 'run')} left out: {said}")
    return with_measured(runs, reference.measured, notes, place, whole=not named)


def _pieces(samples: WheelSamples, window: float | None) -> Iterator[_Piece]:
    """The unbroken stretches of the samples, in windows if wanted."""
    for part in samples.stretches():
        begin, end = float(samples.begins[part][0]), float(samples.ends[part][-1])
        count = max(1, round((end - begin) / window)) if window else 1
        for span in pairwise(np.linspace(begin, end, count + 1).tolist()):
            yield _Piece(part, span)


def _cut(
    pieces: list[_Piece], samples: WheelSamples, reference: ReferenceStream, options: ReferenceOptions
) -> list[_Piece | None]:
    """The pieces without gaps and jumps, from rest on if wanted; None for those that never rest."""
    if not options.cuts:
        return list(pieces)
    at = breaks(samples, reference, options)
    cut: list[_Piece | None] = []
    for piece in pieces:
        spans = list(parted(piece.span, at))
        for span in spans:
            begun = from_rest(samples, piece.part, span, reference.times) if options.start_at_rest else span
            cut.append(None if begun is None else _Piece(piece.part, begun, len(spans) > 1))
    return cut


def _seen(reference: ReferenceStream, span: Span) -> slice:
    return slice(*np.searchsorted(reference.times, (span[0] - _SAME_TIME, span[1] + _SAME_TIME)).tolist())


def _run(
    whole: Trajectory, samples: WheelSamples, reference: ReferenceStream, piece: _Piece, seen: slice
) -> CutRun | None:
    part, (begin, end) = piece.part, piece.span
    within = (samples.begins[part] < end - _SAME_TIME) & (samples.ends[part] > begin + _SAME_TIME)
    run = cut_run(whole, samples, part.start + np.flatnonzero(within), reference, seen)
    if run is None or whole.started_at is None:
        return run
    started = whole.started_at + (run.zero - float(samples.begins[0]))
    return replace(run, trajectory=replace(run.trajectory, started_at=started))
