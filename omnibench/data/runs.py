"""Runs of recordings: wheels in SI units and the robot's senses, references by the wheels' clock, cut where asked.

Everything is decided for all recordings together: ranges of counters, the clocks' coefficients, commands and splits.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omnibench.data.clock_matching import Streams, align, match_clocks, usual_period
from omnibench.data.counters import (
    POWERS_OF_TWO,
    about_zero,
    counted_on,
    counter_range,
    held_readings,
    jumping_readings,
    lost_register,
    repeated_readings,
    turns_restored,
)
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.finding import FindingWarning
from omnibench.data.jumps import reference_jumps
from omnibench.data.recording import (
    SECONDS,
    TURNS,
    Event,
    Recording,
    ReferenceOptions,
    ScanReadings,
    WheelReadings,
    quantity_of,
    scan_difference,
)
from omnibench.data.references import KINDS, UNITS, References
from omnibench.data.scans import Scans, TrajectoryScans
from omnibench.data.splits import complete, divided, every_second, remaining
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array, Robot, in_the_middle, interpolated
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.words import plural, some

_KEPT = 0.5  # s of rest that are kept before and after a run (chosen)
# A robot rests while no wheel leaves a range of this angle (chosen, as that of the importer of bags) for this time
# (chosen; shorter than there, as no run is cut in two by it).
LEAST_REST, STILL = 0.3, 0.025  # s, rad
_SAME_TIME = 1e-6  # s; unix time in a double has steps of 0.2 us
_SHORTEST = 1.0  # s, of a run between two gaps or jumps; chosen: the odometry of a shorter one shows noise only
_LATE = 0.5  # s after the last wheel sample, as long as a data set takes a reference for one of the run
_UNKNOWN = 5.0  # s, by which an offset is looked for where wheels and poses are of different epochs; chosen
_MOST_TOO_FAST = 0.05  # share of samples faster than any wheel turns; more mean a wrong unit
_WHOLE = 1e-6  # largest distance of whole numbers, which went through rad, from such
_FAR = 100.0  # times; wheels' and poses' times that last so differently are in other units; chosen
_NUMBER = re.compile(
    r"(?:run|trial|exp|experiment|test|take|rep|repetition|drive|log|bag|recording|traj|trajectory)?\d*"
)
Span = tuple[float, float]
"""Begin and end, s."""


@dataclass(frozen=True, eq=False)
class WheelSamples:
    """Wheel samples from begins (F,) to ends (F,), s; none spans a gap.

    rates (F, N): rad/s. angles (F, N) and steering (F, S): at the ends, rad, or None. stretch (F,): number of the
    unbroken stretch that a sample belongs to; angles are continuous within a stretch only. rows (F,): of the readings.
    """

    begins: Array
    ends: Array
    rates: Array
    angles: Array | None
    steering: Array | None
    stretch: NDArray[np.intp]
    rows: NDArray[np.intp]

    def stretches(self) -> Iterator[slice]:
        """The samples of each unbroken stretch."""
        edges = np.flatnonzero(np.diff(self.stretch, prepend=-1, append=-1))
        for first, last in pairwise(edges.tolist()):
            yield slice(first, last)

    def edges(self, part: slice) -> tuple[Array, Array]:
        """Times (F + 1,) and the angles driven until then (F + 1, N), from 0, of an unbroken part."""
        driven = self.rates[part] * (self.ends[part] - self.begins[part])[:, None]
        times = np.append(self.begins[part.start], self.ends[part])
        return times, np.vstack([np.zeros(driven.shape[1]), np.cumsum(driven, axis=0)])

    def log(self, robot: Robot, part: slice, stamps: Array) -> WheelLog:
        """The log of a part, from t = 0 at its begin, with poses wanted at ``stamps`` (K,), s of the recording."""
        zero, drive = float(self.begins[part][0]), None if robot.drive.direct else robot.drive
        steering = None if self.steering is None else self.steering[part]
        return WheelLog(
            self.ends[part] - zero, self.rates[part], np.zeros(3), stamps - zero, steering=steering, drive=drive
        )


@dataclass(frozen=True, eq=False)
class ReferenceStream:
    """Reference poses (K, 3), m, m, rad, at times (K,), s, by the wheels' clock; covariances (K, 3, 3) or None.

    measured: distances, turns, positions and the like, by the same clock, which may be there in the place of poses.
    """

    times: Array
    poses: Array
    covariances: Array | None = None
    measured: References | None = None

    @property
    def begin(self) -> float:
        """Time of the first pose, without poses of the first reference that has a time, s; 0 if none has."""
        if len(self.times):
            return float(self.times[0])
        known = np.empty(0) if self.measured is None else np.concatenate([self.measured.t0, self.measured.t1])
        known = known[np.isfinite(known)]
        return float(known.min()) if len(known) else 0.0

    def later(self, offset: float, drift: float) -> ReferenceStream:
        """The stream with times that are later by offset (s) and by drift (s per s since its begin)."""
        if not offset and not drift:
            return self
        first, measured = self.begin, self.measured

        def moved(times: Array) -> Array:
            known = np.where(np.isfinite(times), times, first)
            return np.where(np.isfinite(times), times + (offset + drift * (known - first)), times)

        if measured is not None:
            measured = replace(measured, t0=moved(measured.t0), t1=moved(measured.t1))
        return replace(self, times=moved(self.times), measured=measured)

    def only(self, kept: NDArray[np.bool_]) -> ReferenceStream:
        """The stream with some of its poses."""
        covariances = None if self.covariances is None else self.covariances[kept]
        return replace(self, times=self.times[kept], poses=self.poses[kept], covariances=covariances)


@dataclass(frozen=True, eq=False)
class AlignedRecording:
    """A recording in SI units and the robot's senses, with its reference by the wheels' clock."""

    recording: Recording
    samples: WheelSamples
    reference: ReferenceStream


@dataclass(frozen=True, eq=False)
class MadeRun:
    """A run, the time of the recording that became its t = 0, s, and the indices of its scans (S,)."""

    trajectory: Trajectory
    zero: float
    recording: Recording
    scans: NDArray[np.intp] | None = None


def dataset_of(
    recordings: Sequence[Recording], options: ReferenceOptions, notes: list[str], *, simulated: bool = False
) -> Dataset:
    """The data set of the runs of recordings. DataError in one line: no run is left, or a unit cannot be right.

    notes: what was left out, mended or decided is added; the data set's warnings hold it.
    """
    aligned = aligned_recordings(recordings, options, notes)
    runs = [run for each in aligned for run in cut_into_runs(each, options, notes, alone=len(aligned) == 1)]
    if not runs:
        raise DataError(f"{notes[-1] if notes else recordings[0].place}; nothing is left")
    trajectories = complete([run.trajectory for run in runs])
    trajectories = divided_runs(with_commands(trajectories, options, notes), runs, options, notes)
    scans = scans_of({run.id for run in trajectories}, runs)
    period = options.sample_period or usual_period([run.times for run in trajectories])
    dataset = make_dataset(
        options.name, options.robot, period, trajectories,
        description=options.description, source=options.source, licence=options.licence,
        simulated=simulated, scans=scans,
    )  # fmt: skip
    if all(recording.referenced for recording in recordings):
        return replace(dataset, warnings=(*notes, *dataset.warnings))
    # In the place of poses that are yet to be made stands the design's odometry, from (0, 0, 0) on.
    poses = OdometryModel.of_design(options.robot, "arc").poses(
        [run.log(run.pose_times) for run in dataset.trajectories]
    )
    placed = [replace(run, poses=driven) for run, driven in zip(dataset.trajectories, poses, strict=True)]
    return replace(dataset, trajectories=tuple(placed), referenced=False, warnings=tuple(notes))


def aligned_recordings(
    recordings: Sequence[Recording], options: ReferenceOptions, notes: list[str]
) -> list[AlignedRecording]:
    """The recordings in SI units, by one clock, which is matched if the options say so. notes: see ``dataset_of``."""
    angles = counted_angles(recordings, options, notes)
    samples = [wheel_samples(*pair, options, notes) for pair in zip(recordings, angles, strict=True)]
    aligned = [
        AlignedRecording(*pair, reference_stream(pair[0], options)) for pair in zip(recordings, samples, strict=True)
    ]
    return aligned if options.clocks == "same" else _by_matched_clocks(aligned, options, notes)


@dataclass(frozen=True, eq=False)
class _Counted:
    """Angles (F, N), rad, that count on, or rates (F, N), rad/s; and the readings that are used (F,)."""

    values: Array
    used: NDArray[np.bool_]


def counted_angles(recordings: Sequence[Recording], options: ReferenceOptions, notes: list[str]) -> list[_Counted]:
    """Angles that wheels turned by, or their rates, in rad and the robot's sense, of every recording.

    Where counters begin again is decided for each wheel by all recordings. DataError: they count beyond ``wraps_at``.
    """
    wheels = options.robot.wheel_names
    positions = [each.wheels for each in recordings if quantity_of(each.wheels.unit) == "positions"]
    certain = options.wraps_at == "never" or not positions
    ranges = [None] * len(wheels) if certain else _ranges(positions, options, notes)
    counted = []
    for recording in recordings:
        readings, place = recording.wheels, recording.place
        values, used, quantity = readings.values, np.ones(len(readings.times), dtype=bool), quantity_of(readings.unit)
        if quantity == "increments":
            values = np.cumsum(values, axis=0)
        elif quantity == "positions":
            values = _counted_on(recording, ranges, options, notes)
        values = _at_the_rows(values, readings, slice(len(wheels)))
        if quantity != "rates":
            used = ~repeated_readings(readings.times, values, readings.steering)
            if count := int((~used).sum()):
                repeats = "that repeats the one before" if count == 1 else "that repeat the ones before"
                notes.append(f"{place}: {plural(count, 'reading')} {repeats} while the wheels turn left out")
        if quantity == "positions" and options.wraps_at != "never":
            rows = np.flatnonzero(used)
            jumping = [jumping_readings(column, readings.times[rows]) for column in values[rows].T]
            used[rows[np.any(jumping, axis=0)]] = False
            if count := int(np.sum(jumping)):
                jump = f"{plural(count, 'reading')} of wheel positions that jump and return left out"
                notes.append(FindingWarning.of_restart(f"{place}: {jump}"))
        if not recording.a_run and (held := held_readings(values[used])).any():
            used[np.flatnonzero(used)[held]] = False
            _note(f"rows in which the wheels hold their last value left out: {1 - held.mean():.0%} are read", notes)
        counted.append(_Counted(values * options.wheel_factors(readings.unit), used))
    return counted


def _ranges(wheels: Sequence[WheelReadings], options: ReferenceOptions, notes: list[str]) -> list[float | None]:
    """The range of each wheel's counter, by all recordings, or the one that is given."""
    unit, names = wheels[0].unit, options.robot.wheel_names
    if isinstance(options.wraps_at, float):
        return [options.wraps_at] * len(names)
    turns = np.broadcast_to(options.ticks_per_turn or TURNS.get(unit, np.inf), len(names)).tolist()
    ranges = [
        counter_range([readings.values[:, index] for readings in wheels], turn, unit == "ticks")
        for index, turn in enumerate(turns)
    ]
    # Wheels that never reach the end of their range have that of the others, if they keep within it.
    recognised = {wrap for wrap in ranges if wrap is not None}
    if len(recognised) == 1:
        (wrap,) = recognised
        spans = [max(float(np.ptp(each.values[:, index])) for each in wheels) for index in range(len(names))]
        ranges = [wrap if span <= wrap else None for span in spans]
    for wrap in sorted(recognised):
        again = f"wheel positions begin again after {wrap:.10g} {unit}"
        _note(f"{again} and were counted on (wraps_at={wrap:.10g} says so)", notes)
    return ranges


def _counted_on(
    recording: Recording, ranges: Sequence[float | None], options: ReferenceOptions, notes: list[str]
) -> Array:
    """Positions (F, N) that count on where their counters begin again, with the turns that a register lost."""
    readings, lost, register = recording.wheels, 0, 0.0
    on, seconds = readings.values.astype(float), readings.times * SECONDS[options.wheel_time_unit]
    given = options.wraps_at if isinstance(options.wraps_at, float) else None
    possible = (given,) if given else POWERS_OF_TWO if readings.unit == "ticks" and options.wraps_at != "never" else ()
    for index, wrap in enumerate(ranges):
        spread = float(np.ptp(on[:, index]))
        if wrap is not None and spread <= wrap * (1 + 1e-9):
            on[:, index] = counted_on(on[:, index], wrap)
        short = lost_register(on[:, index], seconds, possible)
        if given and spread > given * (1 + 1e-9) and short is None:
            span = f"positions span {spread:.10g} {readings.unit}"
            raise DataError(f"{recording.place}: wraps_at is {given:.10g}, but {span}; correct it")
        if short is not None:
            before, register = on[:, index].copy(), max(register, short)
            while not np.array_equal(again := turns_restored(on[:, index], seconds, short), on[:, index]):
                on[:, index] = again
            lost += int((np.round((np.diff(on[:, index]) - np.diff(before)) / short) != 0).sum())
    if lost:
        back = (
            f"{plural(lost, 'step')} of wheel positions ran back while the wheel turned on, as in a register of "
            f"{register:.10g} ticks that was read late; they got a turn of it back (wraps_at=2^32 or never keeps them)"
        )
        notes.append(FindingWarning.of_restart(f"{recording.place}: {back}"))
    return on


def _at_the_rows(values: Array, readings: WheelReadings, columns: slice) -> Array:
    """Values (F, n) at the times of the readings, where they were read at times of their own."""
    if readings.read_at is None:
        return values
    read_at = readings.read_at[:, columns]
    shown = [np.interp(readings.times, *pair) for pair in zip(read_at.T, values.T, strict=True)]
    return np.column_stack(shown)


def wheel_samples(recording: Recording, counted: _Counted, options: ReferenceOptions, notes: list[str]) -> WheelSamples:
    """The wheel samples of a recording, in stretches without gaps and restarts.

    A gap is longer than ``longest_gap``, with wheels that turn in it, since a constant twist does not describe it. A
    position that changes faster than ``fastest`` has started again. DataError: so many samples are faster that the unit
    must be another, or there are too few.
    """
    readings, place, quantity = recording.wheels, recording.place, quantity_of(recording.wheels.unit)
    rows = np.flatnonzero(counted.used)
    second = SECONDS[options.wheel_time_unit]
    times, values = readings.times[rows] * second, counted.values[rows]
    if len(times) < 2 and quantity != "rates":
        raise DataError(f"{place}: positions and increments need two rows or more")
    if len(times) < 2 and not options.sample_period and readings.begin is None:
        raise DataError(f"{place}: wheels: has one row; two are needed, or --set sample_period=S")
    period = options.sample_period or (usual_period([times]) if len(times) > 1 else float(times[0]))
    if quantity == "rates":
        begin = times[0] - period if readings.begin is None else readings.begin * second
        begins, ends, rates, angles = np.append(begin, times[:-1]), times, values, None
        moved: NDArray[np.bool_] = np.ones(len(times), dtype=bool)
    else:
        begins, ends, rows = times[:-1], times[1:], rows[1:]
        driven = np.diff(values, axis=0)
        rates, angles = driven / (ends - begins)[:, None], values[1:] if quantity == "positions" else None
        moved = np.any(np.abs(driven) >= (options.still if recording.numbered else 0.0), axis=1)
    lengths = ends - begins
    gap = (lengths > (options.longest_gap or readings.longest_gap * second)) & moved
    rushed = np.abs(rates) * np.minimum(lengths / period, 1.0)[:, None]  # stamps may bunch
    too_fast = (rushed > options.fastest_rates).any(axis=1) & ~gap
    if too_fast.mean() > _MOST_TOO_FAST:
        raise _misread(recording, rates, lengths, options)
    restart = too_fast & (quantity == "positions")
    if gap.any() and recording.numbered:
        notes.append(
            f"{place}: wheel samples are missing {plural(int(gap.sum()), 'time')} while the wheels turned, up to "
            f"{lengths[gap].max():.3g} s; runs end there"
        )
    if count := int(restart.sum()):
        anew = f"the positions begin anew {plural(count, 'time')}, faster than any wheel turns"
        way = "if that is a counter that wraps, --set wraps_at=N"
        notes.append(FindingWarning.of_restart(f"{place}: {anew} ({way}); runs end there"))
    lost = gap | restart
    kept = ~lost
    steering = None
    if readings.steering is not None:
        steering = _steering_angles(recording, options)
        steering = _at_the_rows(steering, readings, slice(readings.values.shape[1], None))
        stamps = readings.times * second
        steering = (
            interpolated(ends - options.steering_lag, stamps, steering) if options.steering_lag else steering[rows]
        )
    return WheelSamples(
        begins[kept],
        ends[kept],
        rates[kept],
        _of(angles, kept),
        _of(steering, kept),
        np.cumsum(lost, dtype=np.intp)[kept],
        rows[kept],
    )


def _steering_angles(recording: Recording, options: ReferenceOptions) -> Array:
    """Steering angles (F, S), rad. DataError: they are whole numbers beyond a turn, as ticks are."""
    shown = recording.wheels.steering
    assert shown is not None  # the robot steers
    if options.steering_as_read:
        options = options.model_copy(update={"steering_unit": "rad"}) if recording.a_run else options
    unit, count = options.steering_unit, len(options.robot.drive.steered)
    beyond = np.ptp(shown, axis=0) > TURNS.get(unit, np.inf)
    if (beyond & (shown == np.round(shown)).all(axis=0)).any():
        raise DataError(
            f"{recording.place}: the steering angles, read in {unit}, are whole numbers from {shown.min():g} to "
            f"{shown.max():g}; --set steering_unit=ticks --set steering_ticks_per_turn=N, or another steering_unit"
        )
    if recording.a_run and options.steering_as_read:
        return shown

    def per_axle(values: Sequence[float], default: float) -> Array:
        return np.broadcast_to(np.array(values or default), count)

    turns = per_axle(options.steering_ticks_per_turn, TURNS.get(unit, 1.0))
    angles = np.column_stack([about_zero(*pair) for pair in zip(shown.T, turns, strict=True)])
    angles *= 2 * np.pi / turns * per_axle(options.steering_scale, 1.0) * per_axle(options.steering_signs, 1.0)
    return angles + np.radians(per_axle(options.steering_offsets_deg, 0.0))


def _misread(recording: Recording, rates: Array, durations: Array, options: ReferenceOptions) -> DataError:
    """The error of mean rates (F, N), rad/s, over durations (F,), s, that are too fast to be in the unit."""
    unit = recording.wheels.unit
    counts = rates * durations[:, None] / options.wheel_factors(unit)
    what = f"{recording.place}: the wheels, read in {unit}, turn at up to {np.abs(rates).max():.3g} rad/s"
    whole = (np.abs(counts - np.round(counts)) < _WHOLE).all(axis=0)
    if whole.any() and unit == "rad":  # of other wheels they may be interpolated
        return DataError(f"{what}; positions are whole numbers: --set wheel_unit=ticks --set ticks_per_turn=N")
    first = "ticks_per_turn=N" if "ticks" in unit else "wheel_unit=UNIT (rad, deg, rev, ticks, m, rad/s, rpm ...)"
    others = "wraps_at where positions begin again, or fastest if the wheels are that fast"
    return DataError(f"{what}; --set {first}, gear_ratio=N (turns of the motor for one of the wheel), {others}")


def reference_stream(recording: Recording, options: ReferenceOptions) -> ReferenceStream:
    """The reference of a recording in SI units and the robot's senses, by its clock with the options' offset."""
    factors, poses = options.pose_factors, recording.poses
    second = SECONDS[options.pose_time_unit or (options.wheel_time_unit if recording.one_table else "s")]
    if not recording.referenced:  # poses are to be made of its scans, at their times
        times = np.empty(0) if recording.scans is None else recording.scans.times
        return ReferenceStream(times, np.zeros((len(times), 3)))
    measured = None if recording.measured is None else measured_as(recording.measured, options, second)
    stream = ReferenceStream(np.empty(0), np.empty((0, 3)), measured=measured)
    if poses is not None:
        if poses.radians:
            factors = factors * np.array([1.0, 1.0, 1.0 if options.heading_unit == "rad" else np.degrees(1.0)])
        covariances = poses.covariances
        shown = poses.poses
        if (factors != 1.0).any():
            shown = shown * factors
            covariances = None if covariances is None else covariances * np.outer(factors, factors)
        if options.heading_offset_deg:
            shown = shown + np.array([0.0, 0.0, np.radians(options.heading_offset_deg)])
        stream = ReferenceStream(poses.times * second if second != 1.0 else poses.times, shown, covariances, measured)
        if not recording.a_run and len(shown) > 1 and (held := held_readings(shown)).any():
            stream = stream.only(~held)
    return stream.later(options.pose_time_offset, options.pose_time_drift)


def measured_as(measured: References, options: ReferenceOptions, second: float = 1.0) -> References:
    """References in SI units and in the robot's senses. second: unit of their times, s.

    The signs of the poses hold for x and y of positions and displacements, and for turns and headings; distances have
    none. Headings in a fixed frame are turned by ``heading_offset_deg``.
    """
    x, y, heading = options.pose_factors
    angles = np.isin(measured.kinds, [kind for kind in KINDS if UNITS[kind] == "rad"])
    first = np.where(angles, heading, np.where(measured.planar, x, abs(x)))
    factors = np.column_stack([first, np.full(len(first), y)])
    values = measured.values * factors
    fixed = measured.fixed_frame & angles
    values[fixed, 0] += np.radians(options.heading_offset_deg)
    return replace(
        measured,
        t0=measured.t0 * second,
        t1=measured.t1 * second,
        values=values,
        sigmas=measured.sigmas * np.abs(factors),
        rate_sigma=measured.rate_sigma * abs(heading),
    )


def _by_matched_clocks(
    aligned: Sequence[AlignedRecording], options: ReferenceOptions, notes: list[str]
) -> list[AlignedRecording]:
    """The recordings with poses by the wheels' clock, as matched, which ``notes`` tells."""
    posed = [index for index, each in enumerate(aligned) if each.recording.poses and len(each.reference.times) > 1]
    begun, apart = [], False
    for index in posed:
        samples, reference = aligned[index].samples, aligned[index].reference
        if reference.times[0] >= samples.ends[-1] or reference.times[-1] <= samples.begins[0]:
            # Where wheels and poses share no time, the poses begin with the wheels.
            reference, apart = reference.later(float(samples.begins[0] - reference.times[0]), 0.0), True
        begun.append(reference)
    streams = [
        _clock_streams(options.robot, aligned[index].samples, each) for index, each in zip(posed, begun, strict=True)
    ]
    matches = match_clocks(options.robot, streams, **({"search": _UNKNOWN} if apart else {}))
    moved, said, unknown = list(aligned), [], []
    for index, reference, match in zip(posed, begun, matches, strict=True):
        name = aligned[index].recording.name
        if match is None:
            unknown.append(name)
            continue
        moved[index] = replace(aligned[index], reference=reference.later(match.offset, match.drift))
        offset = moved[index].reference.times[0] - aligned[index].reference.times[0]
        said.append(f"{name} {offset:+.3f} s" + (f" and {60e3 * match.drift:+.1f} ms a minute" if match.drift else ""))
    if said:
        notes.append(f"clocks matched, added to the times of the poses: {some(said)}")
    if unknown:
        notes.append(
            f"clocks not matched, as the motion is too short or too even: {some(unknown)}; give "
            "--set pose_time_offset=SECONDS, or drive with more turns"
        )
    return moved


def _clock_streams(robot: Robot, samples: WheelSamples, reference: ReferenceStream) -> Streams:
    """The streams from the begin of the wheels on; samples that are missing count as standing."""
    zero = float(samples.begins[0])
    steering = None if samples.steering is None else in_the_middle(samples.steering)
    driven = robot.drive.signals(samples.rates, steering) * (samples.ends - samples.begins)[:, None]
    counted = np.vstack([np.zeros(driven.shape[1]), np.cumsum(driven, axis=0)])
    poses = reference.poses.copy()
    poses[:, 2] = np.unwrap(poses[:, 2])
    return Streams(np.append(samples.begins[0], samples.ends) - zero, counted, reference.times - zero, poses)


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
    if recording.a_run and not options.cuts and reference.times is (recording.poses and recording.poses.times):
        return [_as_it_is(aligned)]
    uncut = [piece for part in samples.stretches() for piece in _pieces(aligned, part, options)]
    reference, at = _breaks(aligned, options, notes)
    pieces = [piece for each in uncut for piece in _parted(each, samples, reference, at, options)]
    named, runs = len(pieces) > 1, list[MadeRun]()
    bare = short = standing = 0
    for number, piece in enumerate(pieces, 1):
        if piece.span is None:
            standing += 1
        elif piece.moving < options.least_run and (piece.broken or options.cutting == "rests"):
            short += 1
        elif (run := _run(aligned, reference, piece, whole=not named and not piece.broken)) is None:
            bare += 1
        else:
            runs.append(_called(run, samples, piece, number if named else None, len(runs) + 1, alone=alone))
    if len(pieces) > len(uncut) and runs:
        notes.append(
            f"{recording.place}: cut into {plural(len(pieces), 'run')} where wheels or poses are missing or jump"
        )
    posed = "poses" if recording.poses else "references" if sensors else "scans"
    reasons = {
        f"shorter than {options.least_run:g} s (least_run)": short,
        f"with fewer than two {posed}": bare,
        "that never rest (start_at_rest)": standing,
    }
    if any(reasons.values()):
        said = ", ".join(f"{count} {reason}" for reason, count in reasons.items() if count)
        notes.append(f"{recording.place}: {sum(reasons.values())} of {plural(len(pieces), 'run')} left out: {said}")
    if not pieces:
        what = "nothing of cut_topic was recorded while the wheels were"
        if options.cutting == "rests":
            what = f"the wheels rest all the time (less than {options.rest_rate:g} rad/s, rest_rate)"
        notes.append(f"{recording.place}: {what}")
    if not runs and bare and not short and not standing and not recording.numbered:
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
    times = samples.ends
    measured = None if reference.measured is None else reference.measured.of_run(0.0, float(times[-1]))
    posed = len(reference.times) > 0
    run = _trajectory(recording, samples, np.arange(len(times)), 0.0)
    run = replace(
        run,
        pose_times=reference.times if posed else np.zeros(1),
        poses=reference.poses if posed else np.zeros((1, 3)),
        pose_covariances=reference.covariances,
        references=measured,
        duration=recording.attributes.numbers.get("duration"),
        distance=recording.attributes.numbers.get("distance"),
    )
    return MadeRun(run, 0.0, recording, None if recording.scans is None else np.arange(len(recording.scans.times)))


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
    for event, following in zip(events, [*events[1:], None], strict=True):
        begin, end = max(event.time, times[0]), min(following.time, times[-1]) if following else times[-1]
        if end <= begin:
            continue
        whole = begin == event.time and (following is None or end == following.time)
        earlier = stamps[(stamps <= begin) & (stamps >= times[0])]
        start = begin
        if len(earlier):
            inside = interpolated(np.array([earlier[-1], begin]), times, angles)
            between = angles[(times >= earlier[-1]) & (times <= begin)]
            if (np.ptp(np.vstack([inside, between]), axis=0) <= turned).all():
                start = earlier[-1]
        pieces.append(Piece(part, (float(start), float(end)), float(end - begin), event.command if whole else None))
    return pieces


def _breaks(
    aligned: AlignedRecording, options: ReferenceOptions, notes: list[str]
) -> tuple[ReferenceStream, list[Span]]:
    """The reference without lone poses that jump, and spans, s, from the last pose before each break to the next."""
    recording, samples, reference = aligned.recording, aligned.samples, aligned.reference
    broken = set[int]()
    if options.jumps != "keep" and recording.poses is not None:
        lone, shifted = np.zeros(len(reference.times), dtype=bool), set[float]()
        for part in samples.stretches():
            inside = (reference.times >= samples.begins[part][0]) & (reference.times <= samples.ends[part][-1])
            if (seen := np.flatnonzero(inside)).size:
                log = samples.log(options.robot, part, reference.times[seen])
                (driven,) = OdometryModel.of_design(options.robot, "arc").poses([log])
                jumps = reference_jumps(options.robot, driven, reference.poses[seen])
                lone[seen[jumps.lone]] = True
                shifted |= set(reference.times[seen[jumps.shifts]].tolist())
        if lone.any():
            jump = f"{plural(int(lone.sum()), 'pose')} that jump and return left out (jumps={options.jumps})"
            notes.append(f"{recording.place}: {jump}")
            reference = reference.only(~lone)
        if options.jumps == "cut":
            broken |= {int(np.searchsorted(reference.times, time)) for time in shifted}
    times = reference.times
    if options.longest_gap is not None:
        broken |= set(np.flatnonzero(np.diff(times) > options.longest_gap).tolist())
    return reference, [
        (float(times[index]), float(times[index + 1])) for index in sorted(broken) if index + 1 < len(times)
    ]


def _parted(
    piece: Piece, samples: WheelSamples, reference: ReferenceStream, at: Sequence[Span], options: ReferenceOptions
) -> Iterator[Piece]:
    """The parts of a piece without gaps and jumps, from rest on if wanted."""
    assert piece.span is not None  # it is not cut yet
    begin, end = piece.span
    spans = []
    for before, after in at:
        if begin - _SAME_TIME < before and after < end + _SAME_TIME:
            spans.append((begin, before))
            begin = after
    spans.append((begin, end))
    for span in spans:
        begun: Span | None = span
        if options.start_at_rest:  # from the rest before its first drive on, at a pose
            times, angles = samples.edges(piece.part)
            within = (times > span[0] - _SAME_TIME) & (times < span[1] + _SAME_TIME)
            rests = find_rests(times[within], angles[within], LEAST_REST, STILL)
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
        run = replace(_trajectory(recording, samples, rows, first), pose_times=np.zeros(1), poses=start)
        return MadeRun(run, first, recording, _scans(recording, first, float(run.times[-1])))
    # From pose to pose where it was cut: one interpolated within a drive would be wrong by the path's bend.
    seen = np.ones(len(reference.times), dtype=bool)
    if not whole:
        seen = (reference.times >= begin - _SAME_TIME) & (reference.times <= end + _SAME_TIME)
    if seen.sum() < 2:
        return None
    placed = align(first, samples.ends[rows], reference.times[seen], reference.poses[seen])
    if placed is None:
        return None
    zero = placed.zero
    run = _trajectory(recording, samples, rows[placed.after_start], zero)
    covariances = reference.covariances
    if covariances is not None:
        covariances = covariances[np.searchsorted(reference.times, placed.pose_times + (zero - 5e-10))]
    run = replace(run, pose_times=placed.pose_times, poses=placed.poses, pose_covariances=covariances)
    return MadeRun(run, zero, recording, _scans(recording, zero, float(run.times[-1])))


def _trajectory(recording: Recording, samples: WheelSamples, rows: NDArray[np.intp], zero: float) -> Trajectory:
    """A run with some of the samples, from the time ``zero`` of the recording, s; its poses are to be filled in."""
    ends, said = samples.ends[rows] - zero, recording.attributes
    others: dict[str, Any] = {
        key: np.asarray(values)[samples.rows[rows]] for key, values in recording.wheels.others.items()
    }
    angles = _of(samples.angles, rows) if "angles" not in others else others.pop("angles")
    sent = said.sent
    if sent is not None:  # those that hold at some time of the run
        sent = sent - np.array([zero, 0, 0, 0, 0])
        sent = (
            sent[(sent[:, 0] > -sent[:, 4]) & (sent[:, 0] < ends[-1])]
            if zero or len(rows) < len(samples.ends)
            else sent
        )
    others |= {key: value for key, value in said.numbers.items() if key not in ("duration", "distance")}
    return Trajectory(
        id=recording.name,
        split=said.split or "train",
        times=ends,
        rates=samples.rates[rows],
        pose_times=np.zeros(1),
        poses=np.zeros((1, 3)),
        command=said.command,
        repetition=said.repetition,
        session=said.session,
        started_at=said.started_at,
        duration=float(ends[-1]),
        angles=angles,
        steering=_of(samples.steering, rows),
        sent=sent,
        **others,
    )


def _called(
    run: MadeRun, samples: WheelSamples, piece: Piece, number: int | None, count: int, *, alone: bool
) -> MadeRun:
    """A run with its name, session, start and command. number: of the piece, if there are several; count: of runs."""
    recording, trajectory = run.recording, run.trajectory
    first = float(samples.begins[0])
    if recording.numbered:
        stretch = int(samples.stretch[piece.part.start])
        anew = samples.angles is not None and stretch > 0
        begin = float(samples.begins[piece.part.start]) if samples.angles is not None else first
        name = f"{count:03d}" + (f"-{piece.command}" if piece.command else "")
        trajectory = replace(
            trajectory,
            id=name if alone else f"{recording.name}/{name}",
            session=f"{recording.name}#{stretch + 1}" if anew else recording.name,
            started_at=run.zero - begin,
            command=piece.command,
        )
    else:
        session, started = trajectory.session, trajectory.started_at
        if number is not None:
            trajectory = replace(
                trajectory, id=f"{recording.name}#{number}", command=None if piece.broken else trajectory.command
            )
            if session is None:
                session, started = recording.name, 0.0
        if started is not None:
            started += run.zero - first
        distance = recording.attributes.numbers.get("distance") if number is None else None
        trajectory = replace(trajectory, session=session, started_at=started, distance=distance)
    return replace(run, trajectory=trajectory)


def _scans(recording: Recording, zero: float, end: float) -> NDArray[np.intp] | None:
    """Indices of the scans of a run that began at ``zero`` and lasted ``end`` s; None without scans."""
    if recording.scans is None:
        return None
    times = recording.scans.times - zero
    return np.flatnonzero((times >= -5e-10) & (times <= end + 5e-10))


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
        kept += 0 if references is None else len(references)
        if references is not None or trajectory.has_poses:
            known = trajectory.has_poses or (references is not None and references.start_known)
            poses = trajectory.poses if known else np.zeros((1, 3))
            given.append(replace(run, trajectory=replace(trajectory, references=references, poses=poses)))
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
    way = f"--set pose_time_offset={offset + samples.begins[0] - times[0]:.10g} --set clocks=match"
    way = f"of clocks apart that begin together: {way}"
    if share > _FAR:
        way = "the poses' times look like ms: --set pose_time_unit=ms (or us, ns)"
    elif share < 1 / _FAR:
        way = "the wheels' times look like ms: --set wheel_time_unit=ms (or us, ns)"
    return DataError(f"{place}: no two poses while the wheels were recorded ({spans}); {way}")


def with_commands(runs: Sequence[Trajectory], options: ReferenceOptions, notes: list[str]) -> list[Trajectory]:
    """The runs with the commands that their names say, by ``command_pattern`` or by the words before their numbers."""
    if options.command_pattern:
        matches = [re.search(options.command_pattern, run.id.partition("#")[0]) for run in runs]
        return [replace(run, command=match[1]) if match else run for run, match in zip(runs, matches, strict=True)]
    if any(run.command for run in runs):
        return list(runs)
    if options.cutting == "rests" and any(sent := [_sent_command(run) for run in runs]):
        notes.append(f"commands by the twists that were sent (cmd_vel): {some(sorted(set(filter(None, sent))))}")
        return [replace(run, command=command) for run, command in zip(runs, sent, strict=True)]
    words = [_command_in(run.id.partition("#")[0]) for run in runs]
    counts = Counter(words)
    if "" in counts or len(counts) < 2 or min(counts.values()) < 2:
        return list(runs)
    notes.append(f"commands by the names of the runs: {some(list(counts))} (other: --set command_pattern=PATTERN)")
    return [replace(run, command=word) for run, word in zip(runs, words, strict=True)]


def _sent_command(run: Trajectory) -> str | None:
    """The twist that was sent for most of the time in which any was, as ``v0.3_w0.6``; None without such a one."""
    spans: Counter[str] = Counter()
    for begin, v, alpha, turn, valid in () if run.sent is None else run.sent.tolist():
        x, y, w = (round(value, 2) + 0.0 for value in (v * np.cos(alpha), v * np.sin(alpha), turn))
        if x or y or w:
            command = f"v{x:g}{f'_y{y:g}' if y else ''}_w{w:g}"
            spans[command] += max(min(begin + valid, float(run.times[-1])) - max(begin, 0.0), 0.0)
    command, longest = max(spans.items(), key=lambda pair: pair[1], default=("", 0.0))
    return command if longest > spans.total() / 2 else None


def _command_in(name: str) -> str:
    """The words of a run's name that are no numbers: ``circleL`` of ``run03_circleL``, ``left`` of ``day1/left_2``."""
    parts = [
        [word for word in re.split(r"[-_ .]+", part) if not _NUMBER.fullmatch(word.lower())] for part in name.split("/")
    ]
    return "_".join(next((words for words in reversed(parts) if words), []))


def divided_runs(
    runs: Sequence[Trajectory], made: Sequence[MadeRun], options: ReferenceOptions, notes: list[str]
) -> list[Trajectory]:
    """The runs with their splits and the numbers of their repetitions, without those that are left out.

    Without patterns and without splits in the source every second run of a command validates, and of runs without a
    command every second one that moves alike: to the same side, ahead or back.
    """
    said = {run.trajectory.id: run.recording for run in made}
    if options.leave_out:
        names = remaining([run.id for run in runs], options.leave_out, "run")
        runs = [run for run in runs if run.id in names]
    motions = [motion_of(options.robot, run) for run in runs]
    stated = any(said[run.id].attributes.split for run in runs)
    # Commands by sent twists that were driven once leave no repetition to validate on.
    counts = Counter(run.command for run in runs)
    stated_commands = {run.trajectory.id for run in made if run.trajectory.command}
    alike = [
        run.command if run.command and (counts[run.command] > 1 or run.id in stated_commands) else motion
        for run, motion in zip(runs, motions, strict=True)
    ]
    parted = divided(
        runs, options.train, options.validation,
        otherwise=[run.split for run in runs] if stated else every_second(alike),
    )  # fmt: skip
    moved = {run.id: motion for run, motion in zip(runs, motions, strict=True)}
    sides = {side: {moved[run.id] for run in parted if run.split == side} for side in ("train", "validation")}
    if missing := sorted(sides["validation"] - sides["train"]) if sides["train"] else []:
        notes.append(
            f"validation holds runs that go {' and '.join(missing)}, as no training run does; divide them anew"
        )
    numbered = []
    for run in parted:
        recording = said[run.id]
        repetition = recording.attributes.repetition
        stays = recording.a_run or repetition is not None
        numbered.append(replace(run, repetition=repetition) if stays else run)
    return numbered


def motion_of(robot: Robot, run: Trajectory) -> str:
    """The motion of a run by its wheels and the design, in words: ``ahead, turning left``."""
    run = run if robot.drive.direct else replace(run, drive=robot.drive)
    twists = (run.signals @ robot.inverse_kinematic_matrix.T) * np.diff(run.times, prepend=0.0)[:, None]
    x, y, turn = twists.sum(axis=0)
    way, turned = np.abs(twists[:, :2]).sum(), np.abs(twists[:, 2]).sum() * robot.reach
    words = []
    if way > 0.2 * turned:
        ahead = "ahead" if x > 0 else "back"
        words.append(ahead if abs(x) >= abs(y) else "left" if y > 0 else "right")
    if abs(turn) * robot.reach > 0.1 * way and abs(turn) > 0.2:
        words.append(f"turning {'left' if turn > 0 else 'right'}")
    return ", ".join(words) or "nowhere"


class _RunScans(Scans):
    """Scans of runs, still in their recordings; they are read one run at a time."""

    def __init__(self, runs: Mapping[str, MadeRun], scanner: Any) -> None:
        self.scanner, self._runs = scanner, runs

    @property
    def trajectories(self) -> tuple[str, ...]:
        return tuple(self._runs)

    def times(self, trajectory: str) -> Array:
        scans, chosen, zero = self._of(trajectory)
        return np.maximum(scans.times[chosen] - zero, 0.0)

    def of(self, trajectory: str) -> TrajectoryScans:
        scans, chosen, _ = self._of(trajectory)
        return TrajectoryScans(self.times(trajectory), scans.read(chosen))

    def _of(self, trajectory: str) -> tuple[ScanReadings, NDArray[np.intp], float]:
        if trajectory not in self._runs:
            raise DataError(f"trajectory {trajectory} has no scans")
        run = self._runs[trajectory]
        assert run.recording.scans is not None  # only such runs are held
        assert run.scans is not None
        return run.recording.scans, run.scans, run.zero


def scans_of(names: set[str], runs: Sequence[MadeRun]) -> Scans | None:
    """The scans of the runs that are kept; None without any. DataError: recordings have different scanners."""
    held = {
        run.trajectory.id: run
        for run in runs
        if run.trajectory.id in names and run.scans is not None and len(run.scans)
    }
    scans = [run.recording.scans for run in held.values() if run.recording.scans is not None]
    if not scans:
        return None
    for other in scans[1:]:
        if difference := scan_difference(scans[0].scanner, other.scanner):
            raise DataError(f"{other.place}: {difference} as in {scans[0].place}; import them apart, or without scans")
    return _RunScans(held, scans[0].scanner)


def _of(values: Array | None, chosen: Any) -> Array | None:
    return None if values is None else values[chosen]


def _note(sentence: str, notes: list[str]) -> None:
    """Add a sentence to the notes, once."""
    notes += [sentence] if sentence not in notes else []
