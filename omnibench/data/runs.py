"""Runs of recordings: wheels in SI units and the robot's senses, references by the wheels' clock, cut where asked.

Everything is decided for all recordings together: ranges of counters, the clocks' coefficients, commands and splits. A
recording is cut at gaps, rests, events, windows and jumps of its reference.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omnibench.data import counters
from omnibench.data.clock_matching import SEARCH, Streams, match_clocks, usual_period
from omnibench.data.dataset import SPLITS, Dataset, Trajectory, every_second, make_dataset
from omnibench.data.finding import CounterRestart
from omnibench.data.recording import Event, Notes, PoseReadings, Recording, WheelReadings, scan_difference
from omnibench.data.recording_options import SECONDS, TURNS, quantity_of
from omnibench.data.recording_options import ReferenceOptions as Options
from omnibench.data.references import KINDS, LATE, TURN, UNITS, References
from omnibench.data.scans import Scans
from omnibench.data.scratch import Scratch
from omnibench.data.splits import complete, divided, remaining
from omnibench.data.spoiled_references import reference_jumps
from omnibench.errors import DataError
from omnibench.progress import tell_reading
from omnibench.robot.kinematics import Array, Robot, fastest_rates, in_the_middle, interpolated
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Samples, WheelLog
from omnibench.words import plural, some

_NUMBER = re.compile(r"(?:run|trial|exp(eriment)?|test|take|rep(etition)?|drive|log|bag|recording|traj(ectory)?)?\d*")
_KEPT = 0.5  # s of rest that are kept before and after a run (chosen)
# A robot rests while no wheel leaves a range of this angle (chosen, as that of the importer of bags) for this time
# (chosen; shorter than there, as no run is cut in two by it).
_LEAST_REST, _STILL = 0.3, 0.025  # s, rad
_SAME_TIME = 1e-6  # s; unix time in a double has steps of 0.2 us
_FAR = 100.0  # times; wheels' and poses' times that last so differently are in other units; chosen
_UNKNOWN = 5.0  # s, by which an offset is looked for where wheels and poses are of different epochs; chosen
_MOST_TOO_FAST = 0.05  # share of samples faster than any wheel turns; more mean a wrong unit
_WHOLE = 1e-6  # largest distance of whole numbers, which went through rad, from such
_SAME_SPAN = 1 + 1e-9  # times the range: a span within it, but for rounding
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
        ends, stamps = self.ends[part] - zero, stamps - zero
        return WheelLog(ends, self.rates[part], np.zeros(3), stamps, steering=steering, drive=drive)


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
        measured, stamps = self.measured, self.poses.times[:1]
        if measured is not None and not len(stamps):
            stamps = np.append(measured.t0, measured.t1)
        first = min(stamps[np.isfinite(stamps)], default=0.0)

        def moved(times: Array) -> Array:
            return times + (offset + drift * (np.where(np.isfinite(times), times, first) - first))

        if measured is not None:
            measured = replace(measured, t0=moved(measured.t0), t1=moved(measured.t1))
        return replace(self, poses=replace(self.poses, times=moved(self.poses.times)), measured=measured)


def _ranges(recordings: Sequence[Recording], options: Options, notes: Notes) -> list[float | None]:
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
    recording: Recording, ranges: Sequence[float | None], options: Options, notes: Notes
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
            notes.append(CounterRestart(f"{place}: {jump}"))
    if not recording.a_run and (held := counters.held_readings(values[used])).any():
        used[np.flatnonzero(used)[held]] = False
        holding = f"rows in which the wheels hold their last value left out: {1 - held.mean():.0%} are read"
        notes += [holding] if holding not in notes else []
    return values * options.wheel_factors(readings.unit), used


def _counted_on(recording: Recording, ranges: Sequence[float | None], options: Options, notes: Notes) -> Array:
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
        back = f"{plural(lost, 'step')} of wheel positions ran back by a register of {longest:.10g} ticks, read late"
        mended = f"{back}; they got a turn of it back (wraps_at=2^32 or never keeps them)"
        notes.append(CounterRestart(f"{recording.place}: {mended}"))
    return np.column_stack(columns)


def _wheel_samples(
    recording: Recording, values: Array, used: NDArray[np.bool_], options: Options, notes: Notes
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
        missing = f"wheel samples are missing {plural(int(gap.sum()), 'time')} while the wheels turned"
        notes.append(f"{place}: {missing}, up to {lengths[gap].max():.3g} s; runs end there")
    if count := int(restart.sum()):
        anew = f"the positions begin anew {plural(count, 'time')}, faster than any wheel turns"
        way = "if that is a counter that wraps, --set wraps_at=N"
        notes.append(CounterRestart(f"{place}: {anew} ({way}); runs end there"))
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


def _steering_angles(shown: Array, recording: Recording, options: Options) -> Array:
    """Steering angles (F, S), rad, of the readings. DataError: they are whole numbers beyond a turn, as ticks are."""
    stated = any(name.startswith("steering_") for name in options.model_fields_set - {"steering_columns"})
    as_they_are = recording.a_run and not stated
    unit, count = "rad" if as_they_are else options.steering_unit, len(options.robot.drive.steered)
    beyond = np.ptp(shown, axis=0) > TURNS.get(unit, np.inf)
    if (beyond & (shown == np.round(shown)).all(axis=0)).any():
        what = f"the steering angles, read in {unit}, are whole numbers from {shown.min():g} to {shown.max():g}"
        way = "--set steering_unit=ticks --set steering_ticks_per_turn=N, or another steering_unit"
        raise DataError(f"{recording.place}: {what}; {way}")
    if as_they_are:
        return shown
    turns = np.broadcast_to(options.steering_ticks_per_turn or TURNS.get(unit, 1.0), count)
    angles = np.column_stack([counters.about_zero(*pair) for pair in zip(shown.T, turns, strict=True)])
    angles *= 2 * np.pi / turns * np.array(options.steering_scale or 1.0) * np.array(options.steering_signs or 1.0)
    return angles + np.radians(options.steering_offsets_deg or 0.0)


def _misread(recording: Recording, rates: Array, durations: Array, options: Options) -> DataError:
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


def _aligned(recording: Recording, ranges: Sequence[float | None], options: Options, notes: Notes) -> AlignedRecording:
    """The recording in SI units and the robot's senses, its reference by its clock with the options' offset."""
    tell_reading(1, "run")
    samples = _wheel_samples(recording, *_readings(recording, ranges, options, notes), options, notes)
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
        turned = None if shown.covariances is None else shown.covariances * np.outer(factors, factors)
        poses = replace(shown, times=shown.times * second, poses=shown.poses * factors, covariances=turned)
        if options.heading_offset_deg:
            poses = replace(poses, poses=poses.poses + np.array([0.0, 0.0, np.radians(options.heading_offset_deg)]))
        if not recording.a_run and len(shown.times) > 1:
            poses = poses.only(~counters.held_readings(poses.poses))
    aligned = AlignedRecording(recording, samples, poses, measured)
    return aligned.later(options.pose_time_offset, options.pose_time_drift)


def measured_as(measured: References, options: Options, second: float = 1.0) -> References:
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


def _by_matched_clocks(aligned: Sequence[AlignedRecording], options: Options, notes: Notes) -> list[AlignedRecording]:
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
        way = "give --set pose_time_offset=SECONDS, or drive with more turns"
        notes.append(f"clocks not matched, as the motion is too short or too even: {some(unknown)}; {way}")
    return matched


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


def dataset_of(recordings: Sequence[Recording], options: Options, notes: Notes, *, simulated: bool = False) -> Dataset:
    """The data set of the runs of recordings. DataError in one line: no run is left, or a unit cannot be right.

    notes: what was left out, mended or decided is added; the data set's warnings hold it.
    """
    scratch = Scratch() if isinstance(recordings, Scratch) else None
    runs, cuts, referenced = list[MadeRun](), list[str](), True
    ranges = _ranges(recordings, options, notes)
    aligned: Iterable[AlignedRecording] = (_aligned(each, ranges, options, notes) for each in recordings)
    if options.clocks == "match":
        aligned = _by_matched_clocks(list(aligned), options, notes)
    for each in aligned:
        referenced &= each.recording.referenced
        made = cut_into_runs(each, options, cuts, alone=len(recordings) == 1)
        runs += made if scratch is None else [_in_file(run, scratch) for run in made]
    notes += cuts
    if not runs:
        raise DataError(f"{notes[-1] if notes else recordings[0].place}; nothing is left")
    trajectories = complete([run.trajectory for run in runs])
    trajectories = divided_runs(with_commands(trajectories, options, notes), runs, options, notes)
    scans = _scans_of(runs, {run.id for run in trajectories})
    period = options.sample_period or usual_period(run.times for run in trajectories)
    dataset = make_dataset(
        options.name, options.robot, period, trajectories,
        description=options.description, source=options.source, licence=options.licence,
        simulated=simulated, scans=scans,
    )  # fmt: skip
    if referenced:
        return replace(dataset, warnings=(*notes, *dataset.warnings))
    # In the place of poses that are yet to be made stands the design's odometry, from (0, 0, 0) on.
    logs = [run.log(run.pose_times) for run in dataset.trajectories]
    poses = OdometryModel.of_design(options.robot, "arc").poses(logs)
    placed = [replace(run, poses=driven) for run, driven in zip(dataset.trajectories, poses, strict=True)]
    return replace(dataset, trajectories=tuple(placed), referenced=False, warnings=tuple(notes))


def _in_file(run: MadeRun, scratch: Scratch) -> MadeRun:
    """The run with its wheel samples in a temporary file, and without the readings that it was made of."""
    held, recording = run.trajectory.samples, run.recording
    arrays = {name: None if array is None else scratch.stored(array) for name, array in held.contents().items()}
    trajectory = replace(run.trajectory, samples=Samples(arrays, (held.count, held.end)))
    none = WheelReadings(np.empty(0), np.empty((0, 0)), recording.wheels.unit)
    return replace(run, trajectory=trajectory, recording=replace(recording, wheels=none, poses=None, measured=None))


def cut_into_runs(aligned: AlignedRecording, options: Options, notes: Notes, *, alone: bool = True) -> list[MadeRun]:
    """The runs of a recording, cut as the options say; what is left out is added to ``notes``.

    alone: the recording is the only one. DataError: its wheels and poses share no time.
    """
    recording, samples, place = aligned.recording, aligned.samples, aligned.recording.place
    if (sensors := recording.sensors) is not None:
        sensors = sensors.without_bias(samples, options.least_rest, options.still, place)
        aligned = replace(aligned, recording=replace(recording, sensors=sensors))
    unmoved = recording.poses is not None and np.array_equal(aligned.poses.times, recording.poses.times)
    cut = options.longest_gap or options.jumps != "keep" or options.start_at_rest or options.cutting != "none"
    if recording.a_run and unmoved and not cut:  # as it was read
        made = _made(aligned, np.arange(len(samples.ends)), 0.0, aligned.poses)
        measured = None if aligned.measured is None else aligned.measured.of_run(0.0, float(samples.ends[-1]))
        stated: dict[str, Any] = {name: recording.attributes.numbers.get(name) for name in ("duration", "distance")}
        scans = np.arange(0 if recording.scans is None else len(recording.scans.times))
        return [replace(made, trajectory=replace(made.trajectory, references=measured, **stated), scans=scans)]
    uncut = [piece for part in samples.stretches() for piece in _pieces(aligned, part, options)]
    aligned, breaks = _without_lone_jumps(aligned, options, notes)
    pieces = [piece for each in uncut for piece in _unbroken(each, aligned, breaks, options)]
    several, runs, left_out = len(pieces) > 1, list[MadeRun](), Counter[str]()
    bare = f"with fewer than two {'poses' if recording.poses else 'references' if sensors else 'scans'}"
    for number, piece in enumerate(pieces, 1):
        if piece.span is None:
            left_out["that never rest (start_at_rest)"] += 1
        elif piece.moving < options.least_run and (piece.broken or options.cutting == "rests"):
            left_out[f"shorter than {options.least_run:g} s (least_run)"] += 1
        elif (run := _run(aligned, piece, piece.span, whole=not several and not piece.broken)) is None:
            left_out[bare] += 1
        else:
            runs.append(_called(run, samples, piece, number if several else None, len(runs) + 1, alone=alone))
    if len(pieces) > len(uncut) and runs:
        notes.append(f"{place}: cut into {plural(len(pieces), 'run')} where wheels or poses are missing or jump")
    if left_out:
        said = ", ".join(f"{count} {reason}" for reason, count in sorted(left_out.items()))
        notes.append(f"{place}: {left_out.total()} of {plural(len(pieces), 'run')} left out: {said}")
    if not pieces:
        what = "nothing of cut_topic was recorded while the wheels were"
        if options.cutting == "rests":
            what = f"the wheels rest all the time (less than {options.rest_rate:g} rad/s, rest_rate)"
        notes.append(f"{place}: {what}")
    if not runs and {*left_out} == {bare} and not recording.numbered:
        raise _apart(aligned, options.pose_time_offset)
    if alone and options.cutting == "rests" and runs and len(uncut) == len(list(samples.stretches())):
        advice = f"no rest of {options.least_rest:g} s cuts it; --set cut=topic or cut=windows for more runs"
        notes.append(f"{place}: {advice}")
    referenced = _with_references(runs, aligned, notes, whole=not several)
    if runs and not referenced and alone and sensors is None:
        raise _apart(aligned, options.pose_time_offset)
    return referenced


def _pieces(aligned: AlignedRecording, part: slice, options: Options) -> list[Piece]:
    """The pieces of an unbroken stretch: between rests, events or windows, or all of it."""
    times, angles = aligned.samples.edges(part)
    span, stamps = (float(times[0]), float(times[-1])), aligned.poses.times
    if options.cutting == "rests":
        rests = find_rests(times, angles, options.least_rest, options.still)
        return between_rests(part, span, rests, stamps)
    if options.cutting == "topic":
        return from_events(part, times, angles, aligned.recording.events, stamps, options.still)
    count = max(1, round((span[1] - span[0]) / options.window)) if options.window else 1
    edges = np.linspace(*span, count + 1).tolist()
    command = aligned.recording.attributes.command
    return [Piece(part, window, window[1] - window[0], command) for window in pairwise(edges)]


def find_rests(times: Array, angles: Array, least: float, turned: float) -> list[Span]:
    """Rests as (begin, end), s: no wheel's angle leaves a range of ``turned`` rad for at least ``least`` s.

    times (F + 1,): s. angles (F + 1, N): rad, at these times. The range is used and not the rate from sample to sample,
    because one encoder tick within a short sample is a high rate.
    """
    every, enough = np.arange(len(times)), least * (1 - 1e-9)
    padded, balance = np.vstack([angles, angles[-1:]]), np.zeros(len(times) + 1, dtype=int)
    # Indices of the shortest spans of that length from each time on, and up to each time.
    on, back = np.searchsorted(times, times + enough), np.searchsorted(times, times - enough, side="right") - 1
    for first, last in ((every[on < len(times)], on[on < len(times)]), (back[back >= 0], every[back >= 0])):
        # reduceat takes pairs (first, behind the last); every second result is that between two pairs.
        pairs = np.column_stack([first, last + 1]).ravel()
        quiet = np.ones(len(first), dtype=bool)
        for angle in padded.T if len(pairs) else ():
            quiet &= (np.maximum.reduceat(angle, pairs) - np.minimum.reduceat(angle, pairs))[::2] <= turned
        np.add.at(balance, first[quiet], 1)
        np.add.at(balance, last[quiet], -1)
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
    return float(inside[min(int(np.searchsorted(inside, target)), len(inside) - 1)])


def between_rests(part: slice, span: Span, rests: Sequence[Span], stamps: Array) -> list[Piece]:
    """The drives between rests, each with a little rest at both ends, from a reference pose to another.

    stamps (K,): stamps of the reference poses, s. Drives on either side of a rest share at most an instant of it.
    """
    (begin, end), pieces = span, []
    for before, after in pairwise([(begin, begin), *rests, (end, end)]):
        if after[0] > before[1]:  # no rest stands at the begin or the end
            first = departure(before, before[0] > begin, stamps)
            # The end at a reference pose of the rest, if it has one: a departure with the time reversed.
            last = -departure((-after[1], -after[0]), after[1] < end, -stamps[::-1])
            pieces.append(Piece(part, (first, last), after[0] - before[1]))
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
        start = max(stamps[(stamps <= begin) & (stamps >= times[0])], default=begin)
        inside = interpolated(np.array([start, begin]), times, angles)
        between = angles[(times >= start) & (times <= begin)]
        if (np.ptp(np.vstack([inside, between]), axis=0) > turned).any():
            start = begin
        pieces.append(Piece(part, (float(start), float(end)), float(end - begin), event.command if whole else None))
    return pieces


def _without_lone_jumps(aligned: AlignedRecording, options: Options, notes: Notes) -> tuple[AlignedRecording, Array]:
    """The recording without lone poses that jump, and the times (B, 2), s, of the poses before and after each break."""
    samples, poses = aligned.samples, aligned.poses
    lone, broken = np.zeros((2, len(poses.times)), dtype=bool)  # broken: after each pose
    if options.jumps != "keep" and aligned.recording.poses is not None:
        for part in samples.stretches():
            inside = (poses.times >= samples.begins[part][0]) & (poses.times <= samples.ends[part][-1])
            if (seen := np.flatnonzero(inside)).size:
                log = samples.log(options.robot, part, poses.times[seen])
                alone, shifts = reference_jumps(options.robot, log, poses.poses[seen])
                lone[seen[alone]] = True
                broken[seen[shifts]] = options.jumps == "cut"
        if lone.any():
            jump = f"{plural(int(lone.sum()), 'pose')} that jump and return left out (jumps={options.jumps})"
            notes.append(f"{aligned.recording.place}: {jump}")
            poses, broken = poses.only(~lone), broken[~lone]
    between = np.column_stack([poses.times[:-1], poses.times[1:]])
    gap = np.diff(poses.times) > (options.longest_gap or np.inf)
    return replace(aligned, poses=poses), between[broken[:-1] | gap]


def _unbroken(piece: Piece, aligned: AlignedRecording, breaks: Array, options: Options) -> Iterator[Piece]:
    """The parts of a piece without gaps and jumps, from rest on if wanted."""
    assert piece.span is not None  # it is not cut yet
    begin, end = piece.span
    spans = []
    for before, after in breaks.tolist():
        if begin - _SAME_TIME < before and after < end + _SAME_TIME:
            spans.append((begin, before))
            begin = after
    spans.append((begin, end))
    broken = len(spans) > 1
    for span in spans:
        begun: Span | None = span
        if options.start_at_rest:  # from the rest before its first drive on, at a pose
            times, angles = aligned.samples.edges(piece.part)
            within = (times > span[0] - _SAME_TIME) & (times < span[1] + _SAME_TIME)
            rests = find_rests(times[within], angles[within], _LEAST_REST, _STILL)
            rests = [rest for rest in rests if rest[1] < times[within][-1]]
            begun = (departure(rests[0], False, aligned.poses.times), span[1]) if rests else None
        moving = min(piece.moving, span[1] - span[0])
        yield Piece(piece.part, begun, moving, None if broken else piece.command, broken)


def _run(aligned: AlignedRecording, piece: Piece, span: Span, *, whole: bool) -> MadeRun | None:
    """The run of a piece; None if there are no samples, or not two poses.

    A recording that has references of other kinds, and a start pose at most, begins with its wheels.
    """
    samples, poses, (begin, end) = aligned.samples, aligned.poses, span
    within = (samples.begins[piece.part] < end - _SAME_TIME) & (samples.ends[piece.part] > begin + _SAME_TIME)
    rows = piece.part.start + np.flatnonzero(within)
    if not len(rows):
        return None
    first = float(samples.begins[rows[0]])
    measured = aligned.measured is not None or aligned.recording.sensors is not None
    if not len(poses.times) or (len(poses.times) == 1 and measured):
        start = poses.poses if len(poses.poses) else np.zeros((1, 3))
        return _made(aligned, rows, first, PoseReadings(np.zeros(1), start))
    if not whole:
        # From pose to pose where it was cut: one interpolated within a drive would be wrong by the path's bend.
        poses = poses.only((poses.times >= begin - _SAME_TIME) & (poses.times <= end + _SAME_TIME))
    if len(poses.times) < 2 or (placed := align(first, float(samples.ends[rows[-1]]), poses)) is None:
        return None
    zero, seen = placed
    return _made(aligned, rows[samples.ends[rows] > zero + _SAME_TIME], zero, seen)


def align(begin: float, end: float, poses: PoseReadings) -> tuple[float, PoseReadings] | None:
    """The time, s, that becomes t = 0, and the poses from then on, the first at t = 0; None: they lie apart.

    begin, end: of the wheel samples, s. All times are by one clock, in any epoch. t = 0 is the first pose after
    ``begin``, or ``begin`` itself where poses reach back before it: the start pose is then interpolated (heading the
    shortest way). Poses after the last wheel sample are left out, since no odometry predicts them.
    """
    zero, times = float(poses.times[0]), poses.times
    if zero < begin - _SAME_TIME:
        zero = begin
    shown = np.flatnonzero((times > zero + _SAME_TIME) & (times <= end + _SAME_TIME))
    if not len(shown) or end <= zero + _SAME_TIME:
        return None
    first = int(np.searchsorted(times, zero))
    start = poses.poses[first]
    if times[first] > zero + _SAME_TIME:
        before = poses.poses[first - 1]
        step = start - before
        step[2] -= TURN * np.round(step[2] / TURN)
        start = before + (zero - times[first - 1]) / (times[first] - times[first - 1]) * step
    seen = poses.only(np.append(first, shown))
    return zero, replace(seen, times=np.append(0.0, times[shown] - zero), poses=np.vstack([start, poses.poses[shown]]))


def _made(aligned: AlignedRecording, rows: NDArray[np.intp], zero: float, poses: PoseReadings) -> MadeRun:
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
        recording.name, said.split or "train", ends, samples.rates[rows], poses.times, poses.poses,
        duration=float(ends[-1]), pose_covariances=poses.covariances, sent=sent, **known,
    )  # fmt: skip
    scans = np.empty(0, dtype=np.intp)
    if recording.scans is not None:
        times = recording.scans.times - zero
        scans = np.flatnonzero((times >= -5e-10) & (times <= ends[-1] + 5e-10))
    return MadeRun(run, zero, recording, scans)


def _called(run: MadeRun, samples: WheelSamples, piece: Piece, number: int | None, nth: int, *, alone: bool) -> MadeRun:
    """A run with its name, session, start and command. number: of the piece, if several; nth: of the run."""
    recording, trajectory, first = run.recording, run.trajectory, float(samples.begins[0])
    changes: dict[str, Any] = {}
    if recording.numbered:
        stretch = 0
        if samples.angles is not None:  # which begin anew in each stretch
            stretch, first = int(samples.stretch[piece.part.start]), float(samples.begins[piece.part.start])
        name = f"{nth:03d}" + (f"-{piece.command}" if piece.command else "")
        changes = {"id": name if alone else f"{recording.name}/{name}", "command": piece.command}
        changes |= {"session": f"{recording.name}#{stretch + 1}" if stretch else recording.name, "started_at": 0.0}
    elif number is None:
        changes = {"distance": recording.attributes.numbers.get("distance")}
    else:
        changes = {"id": f"{recording.name}#{number}", "command": None if piece.broken else trajectory.command}
        if trajectory.session is None:
            changes |= {"session": recording.name, "started_at": 0.0}
    begun = changes.get("started_at", trajectory.started_at)
    if begun is not None:
        changes["started_at"] = begun + (run.zero - first)
    return replace(run, trajectory=replace(trajectory, **changes))


def _with_references(runs: Sequence[MadeRun], aligned: AlignedRecording, notes: Notes, *, whole: bool) -> list[MadeRun]:
    """The runs of a recording with those of its references that lie within them; the others are added to ``notes``.

    whole: the recording is one run, of whose start and end a reference without times tells. Runs without poses and
    references are left out.
    """
    measured, sensors, place = aligned.measured, aligned.recording.sensors, aligned.recording.place
    if measured is None and sensors is None:
        return list(runs)
    referenced, count = [], 0
    for run in runs:
        trajectory, references = run.trajectory, measured
        end = float(trajectory.times[-1])
        if references is not None:
            period = end / len(trajectory.times)
            begun = (references.t0 >= run.zero - period) | (np.isneginf(references.t0) & whole)
            ended = (references.t1 <= run.zero + end + LATE) | (np.isposinf(references.t1) & whole)
            known = trajectory.has_poses or (references.start_known and whole)
            references = references.only(begun & ended).of_run(run.zero, end)
            instant = references.t0 == references.t1
            near = np.abs(references.t0) <= period  # a stamp or two beside the first sample's begin is the start
            t0 = np.where(near & ~instant, 0.0, np.maximum(references.t0, 0.0))
            t1 = np.maximum(references.t1, t0)
            references = replace(references, t0=np.where(instant, t1, t0), t1=t1, start_known=known).by_time()
        elif sensors is not None:
            references = sensors.of_run(run.zero, end, start_known=trajectory.has_poses)
        if references or trajectory.has_poses:
            trajectory = replace(trajectory, references=references or None)
            poses = trajectory.poses if trajectory.start_known else np.zeros((1, 3))
            referenced.append(replace(run, trajectory=replace(trajectory, poses=poses)))
            count += len(references or ())
    if sensors is not None and len(referenced) < len(runs):
        notes.append(f"{place}: {plural(len(runs) - len(referenced), 'run')} without references left out")
    if measured is not None and count < len(measured):
        lost = f"{len(measured) - count} of {plural(len(measured), 'reference')} left out, outside of the wheels'"
        way = "if the clocks differ, set pose_time_unit or pose_time_offset"
        notes.append(f"{place}: {lost} samples or across a cut; {way}")
    return referenced


def _apart(aligned: AlignedRecording, offset: float) -> DataError:
    """The error of wheels and poses that share no time. offset: that was added to the poses' times, s."""
    samples, times, place = aligned.samples, aligned.poses.times, aligned.recording.place
    if len(times) < 2 and aligned.measured is not None:
        within = f"none of its references lies within its wheels' {samples.begins[0]:.10g} to {samples.ends[-1]:.10g} s"
        return DataError(f"{place}: {within}; by the wheels' clock: --set pose_time_unit=ms, pose_time_offset=S")
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


def with_commands(runs: Sequence[Trajectory], options: Options, notes: Notes) -> list[Trajectory]:
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


def divided_runs(runs: Sequence[Trajectory], made: list[MadeRun], options: Options, notes: Notes) -> list[Trajectory]:
    """The runs with their splits and the numbers of their repetitions, without those that are left out.

    Without patterns and without splits in the source every second run of a command validates, and of runs without a
    command every second one that moves alike: to the same side, ahead or back.
    """
    source = {run.trajectory.id: run for run in made}
    if options.leave_out:
        names = remaining([run.id for run in runs], options.leave_out, "run")
        runs = [run for run in runs if run.id in names]
    motions = {run.id: motion_of(options.robot, run) for run in runs}
    splits = [run.split for run in runs]
    if not any(source[run.id].recording.attributes.split for run in runs):
        counts = Counter(run.command for run in runs)
        groups: list[str | None] = []
        for run in runs:
            # A command by sent twists or names that was driven once leaves no repetition to validate on.
            stated = run.command and (counts[run.command] > 1 or source[run.id].trajectory.command)
            groups.append(run.command if stated else motions[run.id])
        splits = every_second(groups)
    parted = divided(runs, options.train, options.validation, otherwise=splits)
    train, validation = ({motions[run.id] for run in parted if run.split == side} for side in SPLITS)
    if train and (missing := sorted(validation - train)):
        notes.append(f"validation holds runs that go {' and '.join(missing)}; divide anew, as no training run does so")
    for index, run in enumerate(parted):
        recording = source[run.id].recording
        if recording.a_run or recording.attributes.repetition is not None:
            parted[index] = replace(run, repetition=recording.attributes.repetition)
    return parted


def division_in_words(robot: Robot, runs: Sequence[Trajectory], options: Mapping[str, Any]) -> str:
    """How imported runs of a robot are divided, and by what: ``training 8 runs of 4 commands, validation ...``.

    options: the importer's, with patterns under ``train`` and ``validation`` where these were given.
    """
    parts, splits, commands = [], [run.split for run in runs], [run.command for run in runs]
    for split, name in zip(SPLITS, ("training", "validation"), strict=True):
        members = [run for run in runs if run.split == split]
        driven = {run.command for run in members if run.command is not None}
        of_commands = f" of {plural(len(driven), 'command')}" if driven else ""
        parts.append(f"{name} {plural(len(members), 'run')}{of_commands}")
    alike = [c if c and commands.count(c) > 1 else motion_of(robot, run) for c, run in zip(commands, runs, strict=True)]
    rule = "as the source or its importer says"
    if given := [f"{side}={options[side]}" for side in SPLITS if options.get(side)]:
        rule = f"by {', '.join(given)}"
    elif splits == every_second(commands):
        rule = "every second run of a command validates"
    elif splits == every_second(alike):
        rule = "every second run of a command, or of those that move alike by their wheels, validates"
    return f"{', '.join(parts)}, {rule}"


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


def _scans_of(runs: Sequence[MadeRun], ids: Collection[str]) -> Scans | None:
    """The scans of some runs, still in their recordings; None without any. DataError: of different scanners."""
    scans, read = [], {}
    for run in runs:
        if (recorded := run.recording.scans) is not None and len(run.scans) and run.trajectory.id in ids:
            scans.append(recorded)
            times = np.maximum(recorded.times[run.scans] - run.zero, 0.0)
            read[run.trajectory.id] = times, partial(recorded.read, run.scans)
    for other in scans[1:]:
        if difference := scan_difference(scans[0].scanner, other.scanner):
            raise DataError(f"{other.place}: {difference} as in {scans[0].place}; import them apart, or without scans")
    return Scans(scans[0].scanner, read) if scans else None
