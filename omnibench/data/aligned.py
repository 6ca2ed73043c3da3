"""Recordings in SI units and the robot's senses, by one clock: wheel samples in unbroken stretches, and references.

Everything is decided for all recordings together: ranges of counters and the clocks' coefficients.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from omnibench.data import counters
from omnibench.data.clock_matching import SEARCH, Streams, match_clocks, usual_period
from omnibench.data.finding import FindingWarning
from omnibench.data.recording import SECONDS, TURNS, PoseReadings, Recording, ReferenceOptions, quantity_of
from omnibench.data.references import KINDS, UNITS, References
from omnibench.errors import DataError
from omnibench.progress import tell_reading
from omnibench.robot.kinematics import Array, Robot, fastest_rates, in_the_middle, interpolated
from omnibench.robot.odometry import WheelLog
from omnibench.words import plural, some

_UNKNOWN = 5.0  # s, by which an offset is looked for where wheels and poses are of different epochs; chosen
_MOST_TOO_FAST = 0.05  # share of samples faster than any wheel turns; more mean a wrong unit
_WHOLE = 1e-6  # largest distance of whole numbers, which went through rad, from such
_SAME_SPAN = 1 + 1e-9  # times the range: a span within it, but for rounding


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
class AlignedRecording:
    """A recording in SI units and the robot's senses, with its reference by the wheels' clock.

    recording: as it was read. poses: m, m, rad, s; none of a recording without. measured: references of other kinds.
    """

    recording: Recording
    samples: WheelSamples
    poses: PoseReadings
    measured: References | None = None

    def later(self, offset: float, drift: float) -> AlignedRecording:
        """With a reference that is later by offset (s) and by drift (s per s since its first finite time)."""
        if not offset and not drift:
            return self
        measured, stamps = self.measured, self.poses.times[:1]
        if measured is not None and not len(stamps):
            stamps = np.append(measured.t0, measured.t1)
        first = min(stamps[np.isfinite(stamps)], default=0.0)

        def moved(times: Array) -> Array:
            moved: Array = times + (offset + drift * (np.where(np.isfinite(times), times, first) - first))
            return moved

        if measured is not None:
            measured = replace(measured, t0=moved(measured.t0), t1=moved(measured.t1))
        return replace(self, poses=replace(self.poses, times=moved(self.poses.times)), measured=measured)


def aligned_recordings(
    recordings: Sequence[Recording], options: ReferenceOptions, notes: list[str]
) -> Iterator[AlignedRecording]:
    """The recordings in SI units, by one clock, which is matched if the options say so. DataError in one line.

    notes: what was left out, mended or decided is added, at the end.
    """
    ranges = _ranges(recordings, options, notes)

    def in_si(recording: Recording) -> AlignedRecording:
        tell_reading(1, "run")
        values, used = _readings(recording, ranges, options, notes)
        samples = _wheel_samples(recording, values, used, options, notes)
        return _with_reference(recording, samples, options)

    aligned = map(in_si, recordings)
    yield from aligned if options.clocks == "same" else _by_matched_clocks(list(aligned), options, notes)


def _ranges(recordings: Sequence[Recording], options: ReferenceOptions, notes: list[str]) -> list[float | None]:
    """The range of each wheel's counter, by all recordings, or the one that the options say; None if it has none."""
    count, unit = len(options.robot.wheel_names), ""
    by_wheel: list[list[Array]] = [[] for _ in range(count)]  # counts of every recording, without lone readings
    for wheels in (each.wheels for each in recordings if options.wraps_at == "auto"):
        if quantity_of(wheels.unit) == "positions":
            unit = wheels.unit
            lone = counters.jumping_readings(wheels.values, wheels.times)
            for counts, column, jumping in zip(by_wheel, wheels.values.T, lone.T, strict=True):
                counts.append(column[~jumping])
    if isinstance(options.wraps_at, float):
        return [options.wraps_at] * count
    if not unit:
        return [None] * count
    turns = np.broadcast_to(options.ticks_per_turn or TURNS.get(unit, np.inf), count).tolist()
    ranges = [counters.counter_range(*pair, unit == "ticks") for pair in zip(by_wheel, turns, strict=True)]
    recognised = sorted({wrap for wrap in ranges if wrap is not None})
    if len(recognised) == 1:
        # Wheels that never reach the end of their range have that of the others, if they keep within it.
        ranges = [recognised[0] if max(map(np.ptp, counts)) <= recognised[0] else None for counts in by_wheel]
    for wrap in recognised:
        again = f"wheel positions begin again after {wrap:.10g} {unit}"
        notes.append(f"{again} and were counted on (wraps_at={wrap:.10g} says so)")
    return ranges


def _readings(
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
    values = readings.at_the_rows(values, slice(values.shape[1]))
    if quantity != "rates":
        used = ~counters.repeated_readings(readings.times, values, readings.steering)
        if count := int((~used).sum()):
            repeats = "that repeats the one before" if count == 1 else "that repeat the ones before"
            notes.append(f"{place}: {plural(count, 'reading')} {repeats} while the wheels turn left out")
    if quantity == "positions" and options.wraps_at != "never":
        rows = np.flatnonzero(used)
        jumping = counters.jumping_readings(values[rows], readings.times[rows])
        used[rows[jumping.any(axis=1)]] = False
        if count := int(jumping.sum()):
            jump = f"{plural(count, 'single reading')} of wheel positions that jump and return left out"
            notes.append(FindingWarning.of_restart(f"{place}: {jump}"))
    if not recording.a_run and (held := counters.held_readings(values[used])).any():
        used[np.flatnonzero(used)[held]] = False
        holding = f"rows in which the wheels hold their last value left out: {1 - held.mean():.0%} are read"
        notes += [holding] if holding not in notes else []
    return values * options.wheel_factors(readings.unit), used


def _counted_on(
    recording: Recording, ranges: Sequence[float | None], options: ReferenceOptions, notes: list[str]
) -> Array:
    """Positions (F, N) that count on where their counters begin again, with the turns that a register lost."""
    readings, lost, longest = recording.wheels, 0, 0.0
    seconds, columns = readings.times * SECONDS[options.wheel_time_unit], []
    stated = options.wraps_at if isinstance(options.wraps_at, float) else None
    ticks = readings.unit == "ticks" and options.wraps_at != "never"
    possible = (stated,) if stated else counters.POWERS_OF_TWO if ticks else ()
    for counts, wrap in zip(readings.values.astype(float).T, ranges, strict=True):
        spread = float(np.ptp(counts))
        on = counters.counted_on(counts, wrap) if wrap is not None and spread <= wrap * _SAME_SPAN else counts
        register = counters.lost_register(on, seconds, possible)
        if register is not None:  # lone readings that jump may have feigned it
            usual = ~counters.jumping_readings(on[:, None], seconds)[:, 0]
            register = counters.lost_register(on[usual], seconds[usual], possible)
        if register is None and stated and spread > stated * _SAME_SPAN:
            span = f"positions span {spread:.10g} {readings.unit}"
            raise DataError(f"{recording.place}: wraps_at is {stated:.10g}, but {span}; correct it")
        restored = on if register is None else counters.turns_restored(on, seconds, register)
        if register is not None:
            longest = max(longest, register)
            lost += int((np.round((np.diff(restored) - np.diff(on)) / register) != 0).sum())
        columns.append(restored)
    if lost:
        back = (
            f"{plural(lost, 'step')} of wheel positions ran back while the wheel turned on, as in a register of "
            f"{longest:.10g} ticks that was read late; they got a turn of it back (wraps_at=2^32 or never keeps them)"
        )
        notes.append(FindingWarning.of_restart(f"{recording.place}: {back}"))
    return np.column_stack(columns)


def _wheel_samples(
    recording: Recording, values: Array, used: NDArray[np.bool_], options: ReferenceOptions, notes: list[str]
) -> WheelSamples:
    """The wheel samples of a recording, in stretches without gaps and restarts. values, used: see ``_readings``.

    A gap is longer than ``longest_gap``, with wheels that turn in it, since a constant twist does not describe it. A
    position that changes faster than ``fastest`` has started again. DataError: so many samples are faster that the unit
    must be another, or there are too few.
    """
    readings, quantity = recording.wheels, quantity_of(recording.wheels.unit)
    place = readings.place or recording.place
    rows, second = np.flatnonzero(used), SECONDS[options.wheel_time_unit]
    times, values = readings.times[rows] * second, values[rows]
    if len(times) < 2 and quantity != "rates":
        raise DataError(f"{place}: positions and increments need two rows or more")
    if len(times) < 2 and not options.sample_period and readings.begin is None:
        raise DataError(f"{place}: wheels: has one row; two are needed, or --set sample_period=S")
    period = options.sample_period or (usual_period([times]) if len(times) > 1 else float(times[0]))
    angles: Array | None = None
    if quantity == "rates":
        begin = times[0] - period if readings.begin is None else readings.begin * second
        begins, ends, rates, turning = np.append(begin, times[:-1]), times, values, True
    else:
        begins, ends, rows = times[:-1], times[1:], rows[1:]
        driven = np.diff(values, axis=0)
        rates, angles = driven / (ends - begins)[:, None], values[1:] if quantity == "positions" else None
        turning = np.any(np.abs(driven) >= (options.still if recording.numbered else 0.0), axis=1)
    lengths = ends - begins
    gap = (lengths > (options.longest_gap or readings.longest_gap * second)) & turning
    rushed = np.abs(rates) * np.minimum(lengths / period, 1.0)[:, None]  # stamps may bunch
    too_fast = (rushed > (options.fastest or fastest_rates(options.robot.radii))).any(axis=1) & ~gap
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
    steering: Array | None = None
    if readings.steering is not None:
        steering = _steering_angles(readings.steering, recording, options)
        steering = readings.at_the_rows(steering, slice(values.shape[1], None))
        late = options.steering_lag
        steering = interpolated(ends - late, readings.times * second, steering) if late else steering[rows]
    whole = ~(gap | restart)
    angles, steering = (None if array is None else array[whole] for array in (angles, steering))
    stretch = np.cumsum(~whole, dtype=np.intp)[whole]
    return WheelSamples(begins[whole], ends[whole], rates[whole], angles, steering, stretch, rows[whole])


def _steering_angles(shown: Array, recording: Recording, options: ReferenceOptions) -> Array:
    """Steering angles (F, S), rad, of the readings. DataError: they are whole numbers beyond a turn, as ticks are."""
    stated = any(name.startswith("steering_") for name in options.model_fields_set - {"steering_columns"})
    as_they_are = recording.a_run and not stated
    unit, count = "rad" if as_they_are else options.steering_unit, len(options.robot.drive.steered)
    beyond = np.ptp(shown, axis=0) > TURNS.get(unit, np.inf)
    if (beyond & (shown == np.round(shown)).all(axis=0)).any():
        raise DataError(
            f"{recording.place}: the steering angles, read in {unit}, are whole numbers from {shown.min():g} to "
            f"{shown.max():g}; --set steering_unit=ticks --set steering_ticks_per_turn=N, or another steering_unit"
        )
    if as_they_are:
        return shown
    turns = np.broadcast_to(options.steering_ticks_per_turn or TURNS.get(unit, 1.0), count)
    angles = np.column_stack([counters.about_zero(*pair) for pair in zip(shown.T, turns, strict=True)])
    angles *= 2 * np.pi / turns * np.array(options.steering_scale or 1.0) * np.array(options.steering_signs or 1.0)
    return angles + np.radians(options.steering_offsets_deg or 0.0)


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


def _with_reference(recording: Recording, samples: WheelSamples, options: ReferenceOptions) -> AlignedRecording:
    """The recording with its reference in SI units and the robot's senses, by its clock with the options' offset."""
    second = SECONDS[options.pose_time_unit or (options.wheel_time_unit if recording.one_table else "s")]
    if not recording.referenced:  # poses are to be made of its scans, at their times
        times = np.empty(0) if recording.scans is None else recording.scans.times
        return AlignedRecording(recording, samples, PoseReadings(times, np.zeros((len(times), 3))))
    measured = None if recording.measured is None else measured_as(recording.measured, options, second)
    poses = PoseReadings(np.empty(0), np.empty((0, 3)))
    if (shown := recording.poses) is not None:
        factors = options.pose_factors
        if shown.radians and options.heading_unit == "deg":
            factors = factors * np.array([1.0, 1.0, np.degrees(1.0)])
        poses = replace(shown, times=shown.times * second)
        if (factors != 1.0).any():
            turned = None if shown.covariances is None else shown.covariances * np.outer(factors, factors)
            poses = replace(poses, poses=shown.poses * factors, covariances=turned)
        if options.heading_offset_deg:
            poses = replace(poses, poses=poses.poses + np.array([0.0, 0.0, np.radians(options.heading_offset_deg)]))
        if not recording.a_run and len(shown.times) > 1:
            poses = poses.only(~counters.held_readings(poses.poses))
    aligned = AlignedRecording(recording, samples, poses, measured)
    return aligned.later(options.pose_time_offset, options.pose_time_drift)


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
    matched, begun, streams, search = list(aligned), dict[int, AlignedRecording](), [], SEARCH
    for index, each in enumerate(aligned):
        samples, stamps = each.samples, each.poses.times
        if each.recording.poses is None or len(stamps) < 2 or not len(samples.ends):
            continue
        zero = float(samples.begins[0])
        if stamps[0] >= samples.ends[-1] or stamps[-1] <= zero:
            # Where wheels and poses share no time, the poses begin with the wheels.
            each, search = each.later(zero - float(stamps[0]), 0.0), _UNKNOWN
        begun[index] = each
        # From the begin of the wheels on; samples that are missing count as standing.
        steering = None if samples.steering is None else in_the_middle(samples.steering)
        driven = options.robot.drive.signals(samples.rates, steering) * (samples.ends - samples.begins)[:, None]
        counted = np.vstack([np.zeros(driven.shape[1]), np.cumsum(driven, axis=0)])
        poses = np.column_stack([each.poses.poses[:, :2], np.unwrap(each.poses.poses[:, 2])])
        streams.append(Streams(np.append(zero, samples.ends) - zero, counted, each.poses.times - zero, poses))
    said, unknown = [], []
    for (index, each), match in zip(begun.items(), match_clocks(options.robot, streams, search), strict=True):
        name = each.recording.name
        if match is None:
            unknown.append(name)
            continue
        matched[index] = each.later(match.offset, match.drift)
        offset = matched[index].poses.times[0] - aligned[index].poses.times[0]
        said.append(f"{name} {offset:+.3f} s" + (f" and {60e3 * match.drift:+.1f} ms a minute" if match.drift else ""))
    if said:
        notes.append(f"clocks matched, added to the times of the poses: {some(said)}")
    if unknown:
        notes.append(
            f"clocks not matched, as the motion is too short or too even: {some(unknown)}; give "
            "--set pose_time_offset=SECONDS, or drive with more turns"
        )
    return matched
