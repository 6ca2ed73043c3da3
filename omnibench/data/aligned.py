"""Recordings in SI units and the robot's senses, by one clock: wheel samples in unbroken stretches, and references.

Everything is decided for all recordings together: ranges of counters and the clocks' coefficients.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from omnibench.data.clock_matching import Streams, match_clocks, usual_period
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
from omnibench.data.finding import FindingWarning
from omnibench.data.recording import SECONDS, TURNS, Recording, ReferenceOptions, WheelReadings, quantity_of
from omnibench.data.references import KINDS, UNITS, References
from omnibench.errors import DataError
from omnibench.progress import tell_reading
from omnibench.robot.kinematics import Array, Robot, in_the_middle, interpolated
from omnibench.robot.odometry import WheelLog
from omnibench.words import plural, some

_UNKNOWN = 5.0  # s, by which an offset is looked for where wheels and poses are of different epochs; chosen
_MOST_TOO_FAST = 0.05  # share of samples faster than any wheel turns; more mean a wrong unit
_WHOLE = 1e-6  # largest distance of whole numbers, which went through rad, from such


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

    def later(self, offset: float, drift: float) -> ReferenceStream:
        """The stream with times that are later by offset (s) and by drift (s per s since its first finite time)."""
        if not offset and not drift:
            return self
        measured, known = self.measured, self.times[:1]
        if measured is not None and not len(known):
            known = np.append(measured.t0, measured.t1)
        first = min(known[np.isfinite(known)], default=0.0)

        def moved(times: Array) -> Array:
            moved: Array = times + (offset + drift * (np.where(np.isfinite(times), times, first) - first))
            return moved

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


def aligned_recordings(
    recordings: Sequence[Recording], options: ReferenceOptions, notes: list[str]
) -> Iterator[AlignedRecording]:
    """The recordings in SI units, by one clock, which is matched if the options say so. DataError in one line.

    notes: what was left out, mended or decided is added, at the end.
    """
    ranges: Sequence[float | None] = [None] * len(options.robot.wheel_names)
    if options.wraps_at != "never":
        read = (recording.wheels for recording in recordings)  # of which the positions alone are held
        positions = [(wheels.values, wheels.unit) for wheels in read if quantity_of(wheels.unit) == "positions"]
        if positions:
            ranges = _ranges([values for values, _ in positions], positions[0][1], options, notes)
            del positions
    of_counters, of_samples = list[str](), list[str]()

    def in_si(recording: Recording) -> AlignedRecording:
        tell_reading(1, "run")
        values, used = _counted(recording, ranges, options, of_counters)
        samples = _wheel_samples(recording, values, used, options, of_samples)
        return AlignedRecording(recording, samples, _reference_stream(recording, options))

    aligned = map(in_si, recordings)
    if options.clocks == "same":
        yield from aligned
        notes += [*of_counters, *of_samples]
    else:
        together = list(aligned)
        notes += [*of_counters, *of_samples]
        yield from _by_matched_clocks(together, options, notes)


def _ranges(positions: Sequence[Array], unit: str, options: ReferenceOptions, notes: list[str]) -> list[float | None]:
    """The range of each wheel's counter, by its positions (F, N) in all recordings, or the one that is given."""
    count = len(options.robot.wheel_names)
    if isinstance(options.wraps_at, float):
        return [options.wraps_at] * count
    turns = np.broadcast_to(options.ticks_per_turn or TURNS.get(unit, np.inf), count).tolist()
    ranges = [
        counter_range([values[:, index] for values in positions], turn, unit == "ticks")
        for index, turn in enumerate(turns)
    ]
    # Wheels that never reach the end of their range have that of the others, if they keep within it.
    recognised = {wrap for wrap in ranges if wrap is not None}
    if len(recognised) == 1:
        (wrap,) = recognised
        spans = [max(float(np.ptp(values[:, index])) for values in positions) for index in range(count)]
        ranges = [wrap if span <= wrap else None for span in spans]
    for wrap in sorted(recognised):
        again = f"wheel positions begin again after {wrap:.10g} {unit}"
        notes.append(f"{again} and were counted on (wraps_at={wrap:.10g} says so)")
    return ranges


def _counted(
    recording: Recording, ranges: Sequence[float | None], options: ReferenceOptions, notes: list[str]
) -> tuple[Array, NDArray[np.bool_]]:
    """Angles (F, N), rad, that count on, or rates, rad/s, in the robot's sense; and the readings that are used (F,).

    DataError: counters count beyond ``wraps_at``.
    """
    readings, place = recording.wheels, recording.place
    values, used, quantity = readings.values, np.ones(len(readings.times), dtype=bool), quantity_of(readings.unit)
    if quantity == "increments":
        values = np.cumsum(values, axis=0)
    elif quantity == "positions":
        values = _counted_on(recording, ranges, options, notes)
    values = _at_the_rows(values, readings, slice(values.shape[1]))
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
        holding = f"rows in which the wheels hold their last value left out: {1 - held.mean():.0%} are read"
        notes += [holding] if holding not in notes else []
    return values * options.wheel_factors(readings.unit), used


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


def _wheel_samples(
    recording: Recording, values: Array, used: NDArray[np.bool_], options: ReferenceOptions, notes: list[str]
) -> WheelSamples:
    """The wheel samples of a recording, in stretches without gaps and restarts. values, used: see ``_counted``.

    A gap is longer than ``longest_gap``, with wheels that turn in it, since a constant twist does not describe it. A
    position that changes faster than ``fastest`` has started again. DataError: so many samples are faster that the unit
    must be another, or there are too few.
    """
    readings, place, quantity = recording.wheels, recording.place, quantity_of(recording.wheels.unit)
    rows, second = np.flatnonzero(used), SECONDS[options.wheel_time_unit]
    times, values = readings.times[rows] * second, values[rows]
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
    steering, kept = None, ~(gap | restart)
    if readings.steering is not None:
        steering = _steering_angles(readings.steering, recording, options)
        steering = _at_the_rows(steering, readings, slice(readings.values.shape[1], None))
        late = options.steering_lag
        steering = interpolated(ends - late, readings.times * second, steering) if late else steering[rows]
    stretch = np.cumsum(~kept, dtype=np.intp)
    angles, steering = (None if array is None else array[kept] for array in (angles, steering))
    return WheelSamples(begins[kept], ends[kept], rates[kept], angles, steering, stretch[kept], rows[kept])


def _steering_angles(shown: Array, recording: Recording, options: ReferenceOptions) -> Array:
    """Steering angles (F, S), rad, of the readings. DataError: they are whole numbers beyond a turn, as ticks are."""
    as_they_are = recording.a_run and options.steering_as_read
    unit, count = "rad" if as_they_are else options.steering_unit, len(options.robot.drive.steered)
    beyond = np.ptp(shown, axis=0) > TURNS.get(unit, np.inf)
    if (beyond & (shown == np.round(shown)).all(axis=0)).any():
        raise DataError(
            f"{recording.place}: the steering angles, read in {unit}, are whole numbers from {shown.min():g} to "
            f"{shown.max():g}; --set steering_unit=ticks --set steering_ticks_per_turn=N, or another steering_unit"
        )
    if as_they_are:
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


def _reference_stream(recording: Recording, options: ReferenceOptions) -> ReferenceStream:
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
        shown, covariances = poses.poses, poses.covariances
        if (factors != 1.0).any():
            shown = shown * factors
            covariances = None if covariances is None else covariances * np.outer(factors, factors)
        if options.heading_offset_deg:
            shown = shown + np.array([0.0, 0.0, np.radians(options.heading_offset_deg)])
        stream = ReferenceStream(poses.times * second, shown, covariances, measured)
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
    values[measured.fixed_frame & angles, 0] += np.radians(options.heading_offset_deg)
    t0, t1, sigmas = measured.t0 * second, measured.t1 * second, measured.sigmas * np.abs(factors)
    return replace(measured, t0=t0, t1=t1, values=values, sigmas=sigmas, rate_sigma=measured.rate_sigma * abs(heading))


def _by_matched_clocks(
    aligned: Sequence[AlignedRecording], options: ReferenceOptions, notes: list[str]
) -> list[AlignedRecording]:
    """The recordings with poses by the wheels' clock, as matched, which ``notes`` tells."""
    posed = [
        index
        for index, each in enumerate(aligned)
        if each.recording.poses and len(each.reference.times) > 1 and len(each.samples.ends)
    ]
    begun, streams, apart = [], [], False
    for index in posed:
        samples, reference = aligned[index].samples, aligned[index].reference
        zero = float(samples.begins[0])
        if reference.times[0] >= samples.ends[-1] or reference.times[-1] <= samples.begins[0]:
            # Where wheels and poses share no time, the poses begin with the wheels.
            reference, apart = reference.later(zero - float(reference.times[0]), 0.0), True
        begun.append(reference)
        # From the begin of the wheels on; samples that are missing count as standing.
        steering = None if samples.steering is None else in_the_middle(samples.steering)
        driven = options.robot.drive.signals(samples.rates, steering) * (samples.ends - samples.begins)[:, None]
        counted = np.vstack([np.zeros(driven.shape[1]), np.cumsum(driven, axis=0)])
        poses = reference.poses.copy()
        poses[:, 2] = np.unwrap(poses[:, 2])
        streams.append(Streams(np.append(zero, samples.ends) - zero, counted, reference.times - zero, poses))
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
