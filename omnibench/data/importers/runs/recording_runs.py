"""Wheels and reference of one recording, the matching of their clocks, and the runs that it is cut into.

Runs are made of unbroken stretches and windows, and of what gaps, jumps and rests leave of them.

Distances, turns, positions and the like are given to the runs that the recording is cut into. A data set's runs can be
read anew by other options.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from omnibench.data.checks.stream_faults import reference_jumps
from omnibench.data.clock_matching import Streams, align, match_clocks
from omnibench.data.dataset import Trajectory
from omnibench.data.importers.recording_options import ReferenceOptions, units_of
from omnibench.data.importers.wheel_samples import EncoderOptions, WheelSamples
from omnibench.data.references import KINDS, UNITS, References
from omnibench.data.scans import Scans, ScansInMemory, TrajectoryScans
from omnibench.errors import ConfigError, nearest
from omnibench.robot.kinematics import Array, Robot, in_the_middle
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.words import plural, some


def measured_as(measured: References, options: ReferenceOptions, radian: float) -> References:
    """References in SI units and in the robot's senses. radian: unit of the angles as recorded.

    The signs of the poses hold for x and y of positions and displacements, and for turns and headings; distances have
    none. Headings in a fixed frame are turned by ``heading_offset_deg``.
    """
    x, y, heading = units_of(options, radian)
    angles = np.isin(measured.kinds, [kind for kind in KINDS if UNITS[kind] == "rad"])
    first = np.where(angles, heading, np.where(measured.planar, x, abs(x)))
    factors = np.column_stack([first, np.full(len(first), y)])
    values = measured.values * factors
    fixed = measured.fixed_frame & angles
    values[fixed, 0] += np.radians(options.heading_offset_deg)
    return replace(
        measured,
        values=values,
        sigmas=measured.sigmas * np.abs(factors),
        rate_sigma=measured.rate_sigma * abs(heading),
    )


def measured_later(measured: References, offset: float, drift: float, first: float) -> References:
    """References that are later by offset, s, and by drift, s per s since the time ``first``."""

    def later(times: Array) -> Array:
        known = np.where(np.isfinite(times), times, first)
        return np.where(np.isfinite(times), times + (offset + drift * (known - first)), times)

    return replace(measured, t0=later(measured.t0), t1=later(measured.t1))


@dataclass(frozen=True, eq=False)
class ReferenceStream:
    """Reference poses (K, 3), m, m, rad, at times (K,), s, of any epoch; covariances (K, 3, 3) where there are any.

    measured: distances, turns, positions and the like, by the same clock, which may be there in the place of poses.
    """

    times: Array
    poses: Array
    covariances: Array | None = None
    measured: References | None = None

    @classmethod
    def without_poses(cls, measured: References | None = None) -> ReferenceStream:
        """A stream of references of other kinds alone."""
        return cls(np.empty(0), np.empty((0, 3)), measured=measured)

    def read_as(
        self, options: ReferenceOptions, radian: float = 1.0, measured_radian: float | None = None
    ) -> ReferenceStream:
        """The stream in SI units and in the robot's senses, by its clock.

        radian: unit of the headings as recorded. measured_radian: of measured turns and headings, if it is another.
        """
        factors = np.array(units_of(options, radian))
        times, poses, covariances = self.times, self.poses, self.covariances
        if (factors != 1.0).any():
            poses = poses * factors
            covariances = None if covariances is None else covariances * np.outer(factors, factors)
        if options.heading_offset_deg:
            poses = poses + np.array([0.0, 0.0, np.radians(options.heading_offset_deg)])
        measured = None if self.measured is None else measured_as(self.measured, options, measured_radian or radian)
        stream = ReferenceStream(times, poses, covariances, measured)
        return stream.by_clock(options.pose_time_offset, options.pose_time_drift)

    def by_clock(self, offset: float, drift: float) -> ReferenceStream:
        """The stream with times that are later by offset (s) and by drift (s per s since its begin)."""
        if not offset and not drift:
            return self
        first = self.begin
        measured = None if self.measured is None else measured_later(self.measured, offset, drift, first)
        return replace(self, times=self.times + (offset + drift * (self.times - first)), measured=measured)

    @property
    def begin(self) -> float:
        """Time of the first pose, without poses of the first reference that has a time, s; 0 if none has."""
        if len(self.times):
            return float(self.times[0])
        known = np.empty(0) if self.measured is None else np.concatenate([self.measured.t0, self.measured.t1])
        return float(known[np.isfinite(known)].min(initial=np.inf)) if np.isfinite(known).any() else 0.0


_UNKNOWN = 5.0  # s, by which an offset is looked for where wheels and poses are of different epochs; chosen


@dataclass(frozen=True, eq=False)
class RecordedStreams:
    """A recording: its wheel samples and its reference. name: of the recording. place: its file, for messages."""

    name: str
    place: str
    samples: WheelSamples
    reference: ReferenceStream


def by_one_clock(
    recordings: Sequence[RecordedStreams], options: ReferenceOptions, notes: list[str]
) -> list[RecordedStreams]:
    """The recordings with poses by the wheels' clock, which is matched if the options say so, and said then."""
    if options.clocks == "same":
        return list(recordings)
    posed = [recording for recording in recordings if len(recording.reference.times) > 1]
    begun = [_begun_together(recording) for recording in posed]
    search = {} if begun == posed else {"search": _UNKNOWN}
    matches = match_clocks(options.robot, [_clock_streams(options.robot, each) for each in begun], **search)
    matched, said, unknown = [], [], []
    for given, recording, match in zip(posed, begun, matches, strict=True):
        if match is None:
            matched.append(given)
            unknown.append(given.name)
            continue
        moved = replace(recording, reference=recording.reference.by_clock(match.offset, match.drift))
        matched.append(moved)
        offset = moved.reference.times[0] - given.reference.times[0]
        drift = f" and {60e3 * match.drift:+.1f} ms a minute" if match.drift else ""
        said.append(f"{given.name} {offset:+.3f} s{drift}")
    if said:
        notes.append(f"clocks matched, added to the times of the poses: {some(said)}")
    if unknown:
        notes.append(
            f"clocks not matched, as the motion is too short or too even: {some(unknown)}; give "
            "--set pose_time_offset=SECONDS, or drive with more turns"
        )
    by_name = {recording.name: recording for recording in matched}
    return [by_name.get(recording.name, recording) for recording in recordings]


def _begun_together(recording: RecordedStreams) -> RecordedStreams:
    """The recording; where wheels and poses share no time, with poses that begin with the wheels."""
    samples, reference = recording.samples, recording.reference
    if reference.times[0] < samples.ends[-1] and reference.times[-1] > samples.begins[0]:
        return recording
    return replace(recording, reference=reference.by_clock(float(samples.begins[0] - reference.times[0]), 0.0))


def _clock_streams(robot: Robot, recording: RecordedStreams) -> Streams:
    """The streams from the begin of the wheels on; samples that are missing count as standing."""
    samples, zero = recording.samples, float(recording.samples.begins[0])
    steering = None if samples.steering is None else in_the_middle(samples.steering)
    driven = robot.drive.signals(samples.rates, steering) * (samples.ends - samples.begins)[:, None]
    counted = np.vstack([np.zeros(driven.shape[1]), np.cumsum(driven, axis=0)])
    edges = np.append(samples.begins[0], samples.ends) - zero
    poses = recording.reference.poses.copy()
    poses[:, 2] = np.unwrap(poses[:, 2])
    return Streams(edges, counted, recording.reference.times - zero, poses)


_KEPT = 0.5  # s of rest that are kept before and after a run (chosen)


def find_rests(times: Array, angles: Array, least: float, turned: float) -> list[tuple[float, float]]:
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


def departure(rest: tuple[float, float], shared: bool, stamps: Array) -> float:
    """Begin of the run after a rest, s: at a reference pose of the rest, if it has one."""
    begin, end = rest
    target = max(end - _KEPT, (begin + end) / 2 if shared else begin)
    inside = stamps[(stamps >= begin) & (stamps <= end)]
    if not len(inside):
        return target
    late = inside[inside >= target]
    return float(late[0] if len(late) else inside[-1])


Span = tuple[float, float]
"""Begin and end, s."""

# A robot rests while no wheel leaves a range of this angle (chosen, as that of the importer of bags) for this time
# (chosen; shorter than there, as no run is cut in two by it).
LEAST_REST, STILL = 0.3, 0.025  # s, rad
_SAME_TIME = 1e-6  # s; unix time in a double has steps of 0.2 us


def breaks(samples: WheelSamples, reference: ReferenceStream, options: ReferenceOptions) -> list[Span]:
    """From the last pose before to the first pose after each gap and each jump of the reference, where these cut."""
    times = reference.times
    found: set[int] = set()
    if options.longest_gap is not None:
        found |= set(np.flatnonzero(np.diff(times) > options.longest_gap).tolist())
    if options.jumps == "cut":
        for part in samples.stretches():
            seen = np.flatnonzero((times >= samples.begins[part][0]) & (times <= samples.ends[part][-1]))
            if len(seen):
                # The log of the part, from t = 0 at its begin.
                zero, robot = float(samples.begins[part][0]), options.robot
                steering = None if samples.steering is None else samples.steering[part]
                drive = None if robot.drive.direct else robot.drive
                log = WheelLog(
                    samples.ends[part] - zero,
                    samples.rates[part],
                    np.zeros(3),
                    times[seen] - zero,
                    steering=steering,
                    drive=drive,
                )
                (driven,) = OdometryModel.of_design(robot, "arc").poses([log])
                found |= set(seen[reference_jumps(options.robot, driven, reference.poses[seen])].tolist())
    return [(float(times[index]), float(times[index + 1])) for index in sorted(found)]


def parted(span: Span, breaks: Sequence[Span]) -> Iterator[Span]:
    """The parts of a span between the breaks within it."""
    begin, end = span
    for before, after in breaks:
        if begin - _SAME_TIME < before and after < end + _SAME_TIME:
            yield begin, before
            begin = after
    yield begin, end


def from_rest(samples: WheelSamples, part: slice, span: Span, stamps: Array) -> Span | None:
    """The span from the rest before its first drive on, at one of the poses at stamps (K,), s; None without a rest."""
    times, angles = samples.edges(part)
    within = (times > span[0] - _SAME_TIME) & (times < span[1] + _SAME_TIME)
    rests = find_rests(times[within], angles[within], LEAST_REST, STILL)
    rests = [rest for rest in rests if rest[1] < times[within][-1]]
    return (departure(rests[0], False, stamps), span[1]) if rests else None


_RESOLUTION = 1e-9  # s, the resolution of stamps


@dataclass(frozen=True, eq=False)
class CutRun:
    """A run from t = 0 on, and the time of the recording that became its t = 0, s. rows: its wheel samples' indices."""

    trajectory: Trajectory
    zero: float
    rows: NDArray[np.intp]


def cut_run(
    whole: Trajectory,
    samples: WheelSamples,
    chosen: NDArray[np.intp],
    reference: ReferenceStream,
    seen: NDArray[np.bool_] | slice,
) -> CutRun | None:
    """The run of the chosen samples and the poses that were seen then; None if there are no samples or not two poses.

    whole: the recording as a run, whose id, split and command are taken over; its arrays are replaced. A recording that
    has references of other kinds, and a start pose at most, begins with its wheels.
    """
    if not len(chosen):
        return None
    if not len(reference.times) or (len(reference.times) == 1 and reference.measured is not None):
        # The run of the chosen samples, from the one pose there is or from the origin of a frame of its own.
        zero = float(samples.begins[chosen[0]])
        start = reference.poses if len(reference.poses) else np.zeros((1, 3))
        return CutRun(
            replace(_sampled(whole, samples, chosen, zero), pose_times=np.zeros(1), poses=start, pose_covariances=None),
            zero,
            chosen,
        )
    times, poses = reference.times[seen], reference.poses[seen]
    if len(times) < 2:
        return None
    aligned = align(float(samples.begins[chosen[0]]), samples.ends[chosen], times, poses)
    if aligned is None:
        return None
    rows = chosen[aligned.after_start]
    shown = np.searchsorted(reference.times, aligned.pose_times + (aligned.zero - _RESOLUTION / 2))
    trajectory = replace(
        _sampled(whole, samples, rows, aligned.zero),
        pose_times=aligned.pose_times,
        poses=aligned.poses,
        pose_covariances=None if reference.covariances is None else reference.covariances[shown],
    )
    return CutRun(trajectory, aligned.zero, rows)


def _sampled(whole: Trajectory, samples: WheelSamples, rows: NDArray[np.intp], zero: float) -> Trajectory:
    """The recording's run with some rows of its wheel samples; zero: time of the recording that becomes t = 0, s."""
    ends = samples.ends[rows] - zero
    return replace(
        whole,
        times=ends,
        rates=samples.rates[rows],
        duration=float(ends[-1]),
        angles=None if samples.angles is None else samples.angles[rows],
        steering=None if samples.steering is None else samples.steering[rows],
    )


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
        run = _run(
            whole,
            samples,
            reference,
            piece,
            slice(None)
            if untouched
            else slice(
                *np.searchsorted(reference.times, (piece.span[0] - _SAME_TIME, piece.span[1] + _SAME_TIME)).tolist()
            ),
        )
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


@dataclass(frozen=True)
class Columns:
    """Indices of the columns of the wheels and of the steering angles in the order of the robot that is wanted."""

    wheels: tuple[int, ...]
    steering: tuple[int, ...]

    @classmethod
    def of(cls, recorded: Robot, options: EncoderOptions, wheels: Sequence[str], steering: Sequence[str]) -> Columns:
        """The columns of a recorded robot that are named, or those called like the wheels. ConfigError names others."""
        robot = options.robot
        return cls(
            _indices(wheels or robot.wheel_names, recorded.wheel_names, "omega_", "wheel_columns"),
            _indices(steering or robot.drive.steered, recorded.drive.steered, "steer_", "steering_columns"),
        )

    def read(self, run: Trajectory, options: EncoderOptions) -> Trajectory:
        """A run with wheels in the robot's order and senses, rad/s, and its steering angles, rad."""
        order = list(self.wheels)
        factors, signs = options.wheel_radians, np.array(options.signs or 1)
        steering = None
        if run.steering is not None and self.steering:
            steering = run.steering[:, list(self.steering)]
            if options.steers_otherwise:
                steering = options.steering_angles(steering, f"trajectory {run.id}")
        return replace(
            run,
            rates=run.rates[:, order] * factors,
            angles=None if run.angles is None else run.angles[:, order] * factors,
            targets=None if run.targets is None else run.targets[:, order] * signs,
            steering=steering,
            drive=None,
        )


def in_seconds(run: Trajectory, wheels: float, poses: float) -> Trajectory:
    """A run whose wheels' and whose poses' times were recorded in units of so many seconds."""
    if wheels == poses == 1.0:
        return run
    duration = None if run.duration is None else run.duration * wheels
    times, references = run.times * wheels, run.references
    if references is not None:
        given = references.open_ended(float(run.times[-1]))
        references = replace(given, t0=given.t0 * poses, t1=given.t1 * poses).of_run(0.0, float(times[-1]))
    sent = None if run.sent is None else run.sent * [wheels, 1, 1, 1, wheels]
    recorded = replace(run, times=times, pose_times=run.pose_times * poses, sent=sent)
    return replace(recorded, duration=duration, references=references)


def _indices(names: Sequence[str], known: Sequence[str], prefix: str, option: str) -> tuple[int, ...]:
    bare = [name.removeprefix(prefix) for name in names]
    for name in bare:
        if name not in known:
            shown = ", ".join(known) or "none"
            raise ConfigError(f"the data set has no wheel {name!r}; {nearest(name, known)}found: {shown}; set {option}")
    if len(set(bare)) < len(bare):
        raise ConfigError(f"{option} names one wheel twice: {', '.join(names)}; name each once")
    return tuple(known.index(name) for name in bare)


@dataclass(frozen=True, eq=False)
class Part:
    """A run that was made of the run ``old``, whose time ``zero`` became its t = 0, s. whole: nothing was cut off."""

    run: Trajectory
    old: str
    zero: float
    whole: bool


def reread_runs(
    runs: Sequence[Trajectory], options: ReferenceOptions, columns: Sequence[int], radian: float, notes: list[str]
) -> list[Part]:
    """The runs with references, clocks and cuts as the options say.

    columns: of x, y and heading. radian: unit of the headings. Distances, turns and the like are read alike; a run that
    is cut keeps those that lie within one of its parts.
    """
    streams = by_one_clock([_streams(run, options, columns, radian) for run in runs], options, notes)
    parts, bare = [], []
    for run, stream in zip(runs, streams, strict=True):
        made = _parts(run, stream, options, notes)
        parts += made
        bare += [] if made else [run.id]
    if bare:
        rest = " or never stand still before they drive (start_at_rest)" if options.start_at_rest else ""
        notes.append(f"{plural(len(bare), 'run')} left out that have too few poses{rest}: {some(bare)}")
    return parts


def _streams(run: Trajectory, options: ReferenceOptions, columns: Sequence[int], radian: float) -> RecordedStreams:
    begins = np.append(0.0, run.times[:-1])
    lost = np.zeros(len(begins), dtype=bool)
    if options.longest_gap is not None:
        lost = run.times - begins > options.longest_gap
    kept = ~lost
    angles, steering = (None if each is None else each[kept] for each in (run.angles, run.steering))
    stretch = np.cumsum(lost, dtype=np.intp)[kept]
    samples = WheelSamples(begins[kept], run.times[kept], run.rates[kept], angles, steering, stretch)
    covariances = run.pose_covariances
    if list(columns) != [0, 1, 2]:
        covariances = None if covariances is None else covariances[:, columns][:, :, columns]
        reference = ReferenceStream(run.pose_times, run.poses[:, columns], covariances)
    else:
        reference = ReferenceStream(run.pose_times, run.poses, covariances)
    if run.references is not None:
        reference = replace(reference, measured=run.references.open_ended(float(run.times[-1])))
    return RecordedStreams(run.id, f"trajectory {run.id}", samples, reference.read_as(options, radian))


def _parts(run: Trajectory, streams: RecordedStreams, options: ReferenceOptions, notes: list[str]) -> list[Part]:
    reference = streams.reference
    if not options.cuts and reference.times is run.pose_times:
        poses = reference.poses if run.start_known else run.poses
        measured = None if reference.measured is None else reference.measured.of_run(0.0, float(run.times[-1]))
        read = replace(run, poses=poses, pose_covariances=reference.covariances, references=measured)
        return [Part(read, run.id, 0.0, whole=True)]
    parts = []
    recorded = np.searchsorted(run.times, streams.samples.ends)
    for cut in recording_runs(run, streams.samples, reference, options, notes, streams.place):
        rows = recorded[cut.rows]
        targets, odometry = (None if array is None else array[rows] for array in (run.targets, run.odometry))
        sent = None if run.sent is None else run.sent - np.array([cut.zero, 0, 0, 0, 0])
        if sent is not None:  # those that hold at some time of the part
            sent = sent[(sent[:, 0] > -sent[:, 4]) & (sent[:, 0] < cut.trajectory.times[-1])]
        whole = cut.zero == 0 and len(cut.rows) == len(run.times)
        distance = run.distance if whole else None
        made = replace(cut.trajectory, targets=targets, odometry=odometry, sent=sent, distance=distance)
        parts.append(Part(replace(made, duration=run.duration) if whole else made, run.id, cut.zero, whole))
    return parts


def scans_of(scans: Scans, parts: Sequence[Part]) -> Scans:
    """The scans of the parts of runs, by their times."""
    if all(part.whole for part in parts):
        return scans
    recorded = set(scans.trajectories)
    cut = {}
    for part in parts:
        if part.old not in recorded:
            continue
        of_run = scans.of(part.old)
        times = of_run.times - part.zero
        seen = (times >= 0) & (times <= part.run.times[-1])
        if seen.any():
            cut[part.run.id] = TrajectoryScans(times[seen], of_run.ranges[seen])
    return ScansInMemory(scans.scanner, cut)
