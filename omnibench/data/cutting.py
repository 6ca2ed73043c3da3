"""Cutting of a recording into runs: at gaps, rests, events, windows and jumps of its reference."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omnibench.data.aligned import AlignedRecording, ReferenceStream, WheelSamples
from omnibench.data.clock_matching import align
from omnibench.data.dataset import Trajectory
from omnibench.data.jumps import reference_jumps
from omnibench.data.recording import Event, Recording, ReferenceOptions
from omnibench.data.references import References
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array, interpolated
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

_KEPT = 0.5  # s of rest that are kept before and after a run (chosen)
# A robot rests while no wheel leaves a range of this angle (chosen, as that of the importer of bags) for this time
# (chosen; shorter than there, as no run is cut in two by it).
_LEAST_REST, _STILL = 0.3, 0.025  # s, rad
_SAME_TIME = 1e-6  # s; unix time in a double has steps of 0.2 us
_LATE = 0.5  # s after the last wheel sample, as long as a data set takes a reference for one of the run
_FAR = 100.0  # times; wheels' and poses' times that last so differently are in other units; chosen
Span = tuple[float, float]
"""Begin and end, s."""


@dataclass(frozen=True)
class Piece:
    """A span of an unbroken part of the samples. moving: how long the robot drives or may drive, s.

    broken: a gap or a jump ended it, or the piece before. None as the span: it never rests.
    """

    part: slice
    span: Span | None
    moving: float
    command: str | None = None
    broken: bool = False


@dataclass(frozen=True, eq=False)
class MadeRun:
    """A run, the time of the recording that became its t = 0, s, and the indices of its scans (S,)."""

    trajectory: Trajectory
    zero: float
    recording: Recording
    scans: NDArray[np.intp]


def cut_into_runs(
    aligned: AlignedRecording, options: ReferenceOptions, notes: list[str], *, alone: bool = True
) -> list[MadeRun]:
    """The runs of a recording, cut as the options say; what is left out is added to ``notes``.

    alone: the recording is the only one. DataError: its wheels and poses share no time.
    """
    recording, samples, reference = aligned.recording, aligned.samples, aligned.reference
    sensors = recording.sensors
    if sensors is not None:
        sensors = sensors.without_bias(samples, options.least_rest, options.still, recording.place)
    unmoved = recording.poses is not None and np.array_equal(reference.times, recording.poses.times)
    if recording.a_run and not options.cuts and unmoved:
        return [_as_it_is(aligned)]
    uncut = [piece for part in samples.stretches() for piece in _pieces(aligned, part, options)]
    reference, breaks = _breaks(aligned, options, notes)
    pieces = [piece for each in uncut for piece in _parted(each, samples, reference, breaks, options)]
    named, runs, left_out = len(pieces) > 1, list[MadeRun](), Counter[str]()
    bare = f"with fewer than two {'poses' if recording.poses else 'references' if sensors else 'scans'}"
    for number, piece in enumerate(pieces, 1):
        if piece.span is None:
            left_out["that never rest (start_at_rest)"] += 1
        elif piece.moving < options.least_run and (piece.broken or options.cutting == "rests"):
            left_out[f"shorter than {options.least_run:g} s (least_run)"] += 1
        elif (run := _run(aligned, reference, piece, whole=not named and not piece.broken)) is None:
            left_out[bare] += 1
        else:
            runs.append(_called(run, samples, piece, number if named else None, len(runs) + 1, alone=alone))
    if len(pieces) > len(uncut) and runs:
        notes.append(
            f"{recording.place}: cut into {plural(len(pieces), 'run')} where wheels or poses are missing or jump"
        )
    if left_out:
        said = ", ".join(f"{count} {reason}" for reason, count in sorted(left_out.items()))
        notes.append(f"{recording.place}: {left_out.total()} of {plural(len(pieces), 'run')} left out: {said}")
    if not pieces:
        what = "nothing of cut_topic was recorded while the wheels were"
        if options.cutting == "rests":
            what = f"the wheels rest all the time (less than {options.rest_rate:g} rad/s, rest_rate)"
        notes.append(f"{recording.place}: {what}")
    if not runs and {*left_out} == {bare} and not recording.numbered:
        raise _apart(aligned, options.pose_time_offset)
    if alone and options.cutting == "rests" and runs and len(uncut) == len(list(samples.stretches())):
        advice = f"no rest of {options.least_rest:g} s cuts it; --set cut=topic or cut=windows for more runs"
        notes.append(f"{recording.place}: {advice}")
    measured = _with_measured(runs, reference.measured, sensors, notes, recording.place, whole=not named)
    if runs and not measured and alone and sensors is None:
        raise _apart(aligned, options.pose_time_offset)
    return measured


def _as_it_is(aligned: AlignedRecording) -> MadeRun:
    """The run of a recording that is one, with its wheels and references as they were read."""
    recording, samples, reference = aligned.recording, aligned.samples, aligned.reference
    made = _made(aligned, np.arange(len(samples.ends)), 0.0, reference.times, reference.poses, reference.covariances)
    numbers = recording.attributes.numbers
    measured = None if reference.measured is None else reference.measured.of_run(0.0, float(samples.ends[-1]))
    scans = np.arange(0 if recording.scans is None else len(recording.scans.times))
    duration, distance = numbers.get("duration"), numbers.get("distance")
    run = replace(made.trajectory, references=measured, duration=duration, distance=distance)
    return replace(made, trajectory=run, scans=scans)


def _pieces(aligned: AlignedRecording, part: slice, options: ReferenceOptions) -> list[Piece]:
    """The pieces of an unbroken stretch: between rests, events or windows, or all of it."""
    times, angles = aligned.samples.edges(part)
    span, stamps = (float(times[0]), float(times[-1])), aligned.reference.times
    if options.cutting == "rests":
        rests = find_rests(times, angles, options.least_rest, options.still)
        return between_rests(part, span, rests, stamps)
    if options.cutting == "topic":
        return from_events(part, times, angles, aligned.recording.events, stamps, options.still)
    count = max(1, round((span[1] - span[0]) / options.window)) if options.window else 1
    edges = np.linspace(*span, count + 1).tolist()
    return [
        Piece(part, window, window[1] - window[0], aligned.recording.attributes.command) for window in pairwise(edges)
    ]


def find_rests(times: Array, angles: Array, least: float, turned: float) -> list[Span]:
    """Rests as (begin, end), s: no wheel's angle leaves a range of ``turned`` rad for at least ``least`` s.

    times (F + 1,): s. angles (F + 1, N): rad, at these times. The range is used and not the rate from sample to sample,
    because one encoder tick within a short sample is a high rate.
    """
    # (first, last) indices of the shortest spans of that length from each time on, and up to each time.
    every, enough = np.arange(len(times)), least * (1 - 1e-9)
    on = np.column_stack([every, np.searchsorted(times, times + enough)])
    back = np.column_stack([np.searchsorted(times, times - enough, side="right") - 1, every])
    spans = np.vstack([on[on[:, 1] < len(times)], back[back[:, 0] >= 0]])
    if not len(spans):
        return []
    # reduceat takes pairs (first, behind the last); every second result is that between two pairs.
    pairs = (spans + np.array([0, 1])).ravel()
    padded = np.vstack([angles, angles[-1:]])
    ranges = np.maximum.reduceat(padded, pairs)[::2] - np.minimum.reduceat(padded, pairs)[::2]
    quiet = spans[(ranges <= turned).all(axis=1)]
    balance = np.zeros(len(times) + 1, dtype=int)
    np.add.at(balance, quiet[:, 0], 1)
    np.add.at(balance, quiet[:, 1], -1)
    resting = np.cumsum(balance)[:-1] > 0  # (T,): the sample that begins at each time is at rest
    steps = np.flatnonzero(np.diff(resting.astype(int), prepend=0, append=0))
    return [(float(times[begin]), float(times[end])) for begin, end in zip(steps[::2], steps[1::2], strict=True)]


def departure(rest: Span, shared: bool, stamps: Array) -> float:
    """Begin of the run after a rest, s: at a reference pose of the rest, if it has one."""
    begin, end = rest
    target = max(end - _KEPT, (begin + end) / 2 if shared else begin)
    inside = stamps[(stamps >= begin) & (stamps <= end)]
    if not len(inside):
        return target
    late = inside[inside >= target]
    return float(late[0] if len(late) else inside[-1])


def between_rests(part: slice, span: Span, rests: Sequence[Span], stamps: Array) -> list[Piece]:
    """The drives between rests, each with a little rest at both ends, from a reference pose to another.

    stamps (K,): stamps of the reference poses, s. Drives on either side of a rest share at most an instant of it.
    """
    edges = [(span[0], span[0]), *rests, (span[1], span[1])]
    if rests and rests[0][0] == span[0]:
        edges = edges[1:]
    if rests and rests[-1][1] == span[1]:
        edges = edges[:-1]
    pieces = []
    for before, after in pairwise(edges):
        begin = departure(before, before[0] > span[0], stamps)
        # The end at a reference pose of the rest, if it has one: a departure with the time reversed.
        end = -departure((-after[1], -after[0]), after[1] < span[1], -stamps[::-1])
        pieces.append(Piece(part, (begin, end), after[0] - before[1]))
    return pieces


def from_events(
    part: slice, times: Array, angles: Array, events: Sequence[Event], stamps: Array, turned: float
) -> list[Piece]:
    """The pieces of a stretch (times and angles as for ``find_rests``) from each event to the next.

    A piece begins at the last reference pose (``stamps``, s) before its event if the wheels stood since then, so that
    nothing of the drive is lost. It has the command's name only if the stretch holds the command from its begin.
    """
    pieces = []
    for event, following in pairwise([*events, Event(np.inf)]):
        begin, end = max(event.time, times[0]), min(following.time, times[-1])
        if end <= begin:
            continue
        whole = begin == event.time and (end == following.time or following.time == np.inf)
        earlier = stamps[(stamps <= begin) & (stamps >= times[0])]
        start = begin
        if len(earlier):
            inside = interpolated(np.array([earlier[-1], begin]), times, angles)
            between = angles[(times >= earlier[-1]) & (times <= begin)]
            if (np.ptp(np.vstack([inside, between]), axis=0) <= turned).all():
                start = earlier[-1]
        pieces.append(Piece(part, (float(start), float(end)), float(end - begin), event.command if whole else None))
    return pieces


def _breaks(aligned: AlignedRecording, options: ReferenceOptions, notes: list[str]) -> tuple[ReferenceStream, Array]:
    """The reference without lone poses that jump, and the times (B, 2), s, of the poses before and after each break."""
    samples, reference = aligned.samples, aligned.reference
    broken = np.zeros(len(reference.times), dtype=bool)  # after each pose
    if options.jumps != "keep" and aligned.recording.poses is not None:
        lone = broken.copy()
        for part in samples.stretches():
            inside = (reference.times >= samples.begins[part][0]) & (reference.times <= samples.ends[part][-1])
            if (seen := np.flatnonzero(inside)).size:
                log = samples.log(options.robot, part, reference.times[seen])
                (driven,) = OdometryModel.of_design(options.robot, "arc").poses([log])
                jumps = reference_jumps(options.robot, driven, reference.poses[seen])
                lone[seen[jumps.lone]] = True
                broken[seen[jumps.shifts]] = options.jumps == "cut"
        if lone.any():
            jump = f"{plural(int(lone.sum()), 'pose')} that jump and return left out (jumps={options.jumps})"
            notes.append(f"{aligned.recording.place}: {jump}")
            reference, broken = reference.only(~lone), broken[~lone]
    between = np.column_stack([reference.times[:-1], reference.times[1:]])
    gap = np.diff(reference.times) > (options.longest_gap or np.inf)
    return reference, between[broken[:-1] | gap]


def _parted(
    piece: Piece, samples: WheelSamples, reference: ReferenceStream, breaks: Array, options: ReferenceOptions
) -> Iterator[Piece]:
    """The parts of a piece without gaps and jumps, from rest on if wanted."""
    assert piece.span is not None  # it is not cut yet
    begin, end = piece.span
    spans = []
    for before, after in breaks.tolist():
        if begin - _SAME_TIME < before and after < end + _SAME_TIME:
            spans.append((begin, before))
            begin = after
    spans.append((begin, end))
    for span in spans:
        begun: Span | None = span
        if options.start_at_rest:  # from the rest before its first drive on, at a pose
            times, angles = samples.edges(piece.part)
            within = (times > span[0] - _SAME_TIME) & (times < span[1] + _SAME_TIME)
            rests = find_rests(times[within], angles[within], _LEAST_REST, _STILL)
            rests = [rest for rest in rests if rest[1] < times[within][-1]]
            begun = (departure(rests[0], False, reference.times), span[1]) if rests else None
        broken = len(spans) > 1
        moving = min(piece.moving, span[1] - span[0])
        yield Piece(piece.part, begun, moving, None if broken else piece.command, broken)


def _run(aligned: AlignedRecording, reference: ReferenceStream, piece: Piece, *, whole: bool) -> MadeRun | None:
    """The run of a piece; None if there are no samples, or not two poses.

    A recording that has references of other kinds, and a start pose at most, begins with its wheels.
    """
    recording, samples = aligned.recording, aligned.samples
    assert piece.span is not None  # it rests, if it must
    begin, end = piece.span
    within = (samples.begins[piece.part] < end - _SAME_TIME) & (samples.ends[piece.part] > begin + _SAME_TIME)
    rows = piece.part.start + np.flatnonzero(within)
    if not len(rows):
        return None
    first, measured = float(samples.begins[rows[0]]), recording.measured is not None or recording.sensors is not None
    if not len(reference.times) or (len(reference.times) == 1 and measured):
        start = reference.poses if len(reference.poses) else np.zeros((1, 3))
        return _made(aligned, rows, first, np.zeros(1), start)
    # From pose to pose where it was cut: one interpolated within a drive would be wrong by the path's bend.
    seen = np.ones(len(reference.times), dtype=bool)
    if not whole:
        seen = (reference.times >= begin - _SAME_TIME) & (reference.times <= end + _SAME_TIME)
    if seen.sum() < 2:
        return None
    placed = align(first, samples.ends[rows], reference.times[seen], reference.poses[seen])
    if placed is None:
        return None
    covariances = reference.covariances
    if covariances is not None:
        covariances = covariances[np.searchsorted(reference.times, placed.pose_times + (placed.zero - 5e-10))]
    return _made(aligned, rows[placed.after_start], placed.zero, placed.pose_times, placed.poses, covariances)


def _made(
    aligned: AlignedRecording,
    rows: NDArray[np.intp],
    zero: float,
    pose_times: Array,
    poses: Array,
    covariances: Array | None = None,
) -> MadeRun:
    """A run of some of the samples, from the time ``zero`` of the recording, s, with its poses and its scans."""
    recording, samples, said = aligned.recording, aligned.samples, aligned.recording.attributes
    ends, sent = samples.ends[rows] - zero, said.sent
    if sent is not None:
        sent = sent - np.array([zero, 0, 0, 0, 0])
        if zero or len(rows) < len(samples.ends):  # those that hold at some time of the run
            sent = sent[(sent[:, 0] > -sent[:, 4]) & (sent[:, 0] < ends[-1])]
    known: dict[str, Any] = {name: getattr(said, name) for name in ("command", "repetition", "session", "started_at")}
    known |= {name: value for name, value in said.numbers.items() if name not in ("duration", "distance")}
    for name, values in (("angles", samples.angles), ("steering", samples.steering)):
        known[name] = None if values is None else values[rows]
    known |= {name: np.asarray(values)[samples.rows[rows]] for name, values in recording.wheels.others.items()}
    run = Trajectory(
        recording.name, said.split or "train", ends, samples.rates[rows], pose_times, poses,
        duration=float(ends[-1]), pose_covariances=covariances, sent=sent, **known,
    )  # fmt: skip
    scans = np.empty(0, dtype=np.intp)
    if recording.scans is not None:
        times = recording.scans.times - zero
        scans = np.flatnonzero((times >= -5e-10) & (times <= ends[-1] + 5e-10))
    return MadeRun(run, zero, recording, scans)


def _called(
    run: MadeRun, samples: WheelSamples, piece: Piece, number: int | None, count: int, *, alone: bool
) -> MadeRun:
    """A run with its name, session, start and command. number: of the piece, if there are several; count: of runs."""
    recording, trajectory, first = run.recording, run.trajectory, float(samples.begins[0])
    changes: dict[str, Any] = {}
    if recording.numbered:
        stretch = 0
        if samples.angles is not None:  # which begin anew in each stretch
            stretch, first = int(samples.stretch[piece.part.start]), float(samples.begins[piece.part.start])
        name = f"{count:03d}" + (f"-{piece.command}" if piece.command else "")
        changes = {"id": name if alone else f"{recording.name}/{name}", "command": piece.command}
        changes |= {"session": f"{recording.name}#{stretch + 1}" if stretch else recording.name, "started_at": 0.0}
    elif number is None:
        changes = {"distance": recording.attributes.numbers.get("distance")}
    else:
        changes = {"id": f"{recording.name}#{number}", "command": None if piece.broken else trajectory.command}
        if trajectory.session is None:
            changes |= {"session": recording.name, "started_at": 0.0}
    trajectory = replace(trajectory, **changes)
    if trajectory.started_at is not None:
        trajectory = replace(trajectory, started_at=trajectory.started_at + (run.zero - first))
    return replace(run, trajectory=trajectory)


def _with_measured(
    runs: Sequence[MadeRun], measured: References | None, sensors: Any, notes: list[str], place: str, *, whole: bool
) -> list[MadeRun]:
    """The runs of a recording with those of its references that lie within them; the others are added to ``notes``.

    whole: the recording is one run, of whose start and end a reference without times tells. Runs without poses and
    references are left out.
    """
    if measured is None and sensors is None:
        return list(runs)
    given, kept = [], 0
    for run in runs:
        trajectory = run.trajectory
        if measured is not None:
            references = _within(measured, run, whole=whole)
        else:
            end = float(trajectory.times[-1])
            references = sensors.of_run(run.zero, end, start_known=trajectory.has_poses)
        kept += len(references or ())
        if references is not None or trajectory.has_poses:
            trajectory = replace(trajectory, references=references)
            poses = trajectory.poses if trajectory.start_known else np.zeros((1, 3))
            given.append(replace(run, trajectory=replace(trajectory, poses=poses)))
    if sensors is not None and len(given) < len(runs):
        notes.append(f"{place}: {plural(len(runs) - len(given), 'run')} without references left out")
    if measured is not None and kept < len(measured):
        notes.append(
            f"{place}: {len(measured) - kept} of {plural(len(measured), 'reference')} left out, outside of the wheels' "
            "samples or across a cut; if the clocks differ, set pose_time_unit or pose_time_offset"
        )
    return given


def _within(measured: References, run: MadeRun, *, whole: bool) -> References | None:
    """The references of a run, by its time; None if it has none."""
    trajectory, end = run.trajectory, float(run.trajectory.times[-1])
    period = end / len(trajectory.times)
    begun, ended = measured.t0 >= run.zero - period, measured.t1 <= run.zero + end + _LATE
    if whole:
        begun, ended = begun | np.isneginf(measured.t0), ended | np.isposinf(measured.t1)
    inside = begun & ended
    if not inside.any():
        return None
    of_run = measured.only(inside).of_run(run.zero, end)
    near = np.abs(of_run.t0) <= period  # a stamp or two beside the first sample's begin is the start
    t0 = np.where(near & (of_run.t0 != of_run.t1), 0.0, np.maximum(of_run.t0, 0.0))
    t1 = np.maximum(of_run.t1, t0)
    known = trajectory.has_poses or (measured.start_known and whole)
    return replace(of_run, t0=np.where(of_run.t0 == of_run.t1, t1, t0), t1=t1, start_known=known).by_time()


def _apart(aligned: AlignedRecording, offset: float) -> DataError:
    """The error of wheels and poses that share no time. offset: that was added to the poses' times, s."""
    samples, times, place = aligned.samples, aligned.reference.times, aligned.recording.place
    if len(times) < 2 and aligned.reference.measured is not None:
        return DataError(
            f"{place}: none of its references lies within its wheels' samples, {samples.begins[0]:.10g} to "
            f"{samples.ends[-1]:.10g} s; times count by the wheels' clock (--set pose_time_unit=ms, pose_time_offset=S)"
        )
    for what, count in (("poses", len(times)), ("wheels", len(samples.ends))):
        if count < 2:
            return DataError(f"{place}: {what}: has one row; two are needed, or the run is no run")
    spans = f"poses {times[0]:.10g} to {times[-1]:.10g} s, wheels {samples.begins[0]:.10g} to {samples.ends[-1]:.10g} s"
    share = (times[-1] - times[0]) / (samples.ends[-1] - samples.begins[0])
    later = offset + samples.begins[0] - times[0]
    way = f"of clocks apart that begin together: --set pose_time_offset={later:.10g} --set clocks=match"
    if share > _FAR:
        way = "the poses' times look like ms: --set pose_time_unit=ms (or us, ns)"
    elif share < 1 / _FAR:
        way = "the wheels' times look like ms: --set wheel_time_unit=ms (or us, ns)"
    return DataError(f"{place}: no two poses while the wheels were recorded ({spans}); {way}")
