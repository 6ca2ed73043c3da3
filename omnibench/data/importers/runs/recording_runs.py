"""The runs of one recording: of its unbroken stretches, windows, and what gaps, jumps and rests leave of them.

Distances, turns, positions and the like of a recording, given to the runs that it is cut into.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.data.importers.runs.cut_run import CutRun, cut_run
from omnibench.data.importers.runs.reference_options import ReferenceOptions
from omnibench.data.importers.runs.reference_stream import ReferenceStream
from omnibench.data.importers.runs.run_spans import Span, breaks, from_rest, parted
from omnibench.data.importers.wheel_samples import WheelSamples
from omnibench.data.references.run_references import References
from omnibench.words import plural

_LATE = 0.5  # s after the last wheel sample, as long as a data set takes a reference for one of the run


def with_measured(
    runs: Sequence[CutRun], measured: References | None, notes: list[str], place: str, *, whole: bool
) -> list[CutRun]:
    """The runs of a recording with those of its references that lie within them; the others are added to ``notes``.

    whole: the recording is one run, of whose start and end a reference without times tells. Runs without poses and
    references are left out.
    """
    if measured is None:
        return list(runs)
    given, kept = [], 0
    for run in runs:
        references = _within(measured, run, whole=whole)
        kept += 0 if references is None else len(references)
        if references is not None or run.trajectory.has_poses:
            known = run.trajectory.has_poses or (references is not None and references.start_known)
            poses = run.trajectory.poses if known else np.zeros((1, 3))
            given.append(replace(run, trajectory=replace(run.trajectory, references=references, poses=poses)))
    if kept < len(measured):
        notes.append(
            f"{place}: {len(measured) - kept} of {plural(len(measured), 'reference')} left out, outside of the wheels' "
            "samples or across a cut; if the clocks differ, set pose_time_unit or pose_time_offset"
        )
    return given


def _within(measured: References, run: CutRun, *, whole: bool) -> References | None:
    """The references of a run, by its time; None if it has none."""
    trajectory = run.trajectory
    end, period = float(trajectory.times[-1]), float(trajectory.times[-1]) / len(trajectory.times)
    begun, ended = measured.t0 >= run.zero - period, measured.t1 <= run.zero + end + _LATE
    if whole:
        begun, ended = begun | np.isneginf(measured.t0), ended | np.isposinf(measured.t1)
    inside = begun & ended
    if not inside.any():
        return None
    of_run = measured.of_run(run.zero, end, inside)
    near = np.abs(of_run.t0) <= period  # a stamp or two beside the first sample's begin is the start
    t0 = np.where(near & (of_run.t0 != of_run.t1), 0.0, np.maximum(of_run.t0, 0.0))
    t1 = np.maximum(of_run.t1, t0)
    known = trajectory.has_poses or (measured.start_known and whole)
    return replace(of_run, t0=np.where(of_run.t0 == of_run.t1, t1, t0), t1=t1, start_known=known).by_time()


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
