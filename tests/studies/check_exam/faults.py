"""Makers of faults: each takes a sound recording and gives one with a fault of its kind, drawn by a generator."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from check_exam.motion import drive_signals
from check_exam.recordings import TURN, Array, Recording, Run, commanded

TABLES, POSITIONS, RADIANS, ONE_TABLE, DATASET = "rates", "ticks", "radians", "one table", "data set"
_EVERY_FORM = (TABLES, POSITIONS, ONE_TABLE, DATASET)
_OWN_CLOCKS = (TABLES, POSITIONS, DATASET)
_OWN_COUNTS = (TABLES, POSITIONS, ONE_TABLE)


@dataclass(frozen=True, eq=False)
class Damage:
    """A recording with a fault. detail: what was done, in words. sound: the same runs without it.

    named: what the finding must name, each one of them. forms: in which it can be written. lost: rows (F,) of wheel
    rates that are not written, by run. factors of the stamps of wheels and poses.
    """

    recording: Recording
    sound: Recording
    detail: str
    named: tuple[str, ...] = ()
    forms: tuple[str, ...] = _EVERY_FORM
    lost: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    wheel_stamps: float = 1.0
    pose_stamps: float = 1.0


def _each(recording: Recording, change: Callable[[Run], Run]) -> Recording:
    return recording.of([change(run) for run in recording.runs])


def _some(recording: Recording, chosen: set[str], change: Callable[[Run], Run]) -> Recording:
    return _each(recording, lambda run: change(run) if run.name in chosen else run)


def _turning(run: Run, angle: float) -> Run:
    poses = run.poses.copy()
    poses[:, 2] += angle
    return replace(run, poses=poses)


def _drawn_runs(recording: Recording, rng: Generator, most: int, seconds: float = 8.0) -> list[Run]:
    """One to ``most`` runs, long enough."""
    long = [run for run in recording.runs if run.seconds >= seconds]
    count = int(rng.integers(1, min(most, len(long)) + 1))
    return [long[index] for index in sorted(rng.choice(len(long), count, replace=False))]


def _speed(recording: Recording, run: Run, times: Array, span: float = 0.5) -> Array:
    """Rates (n,) of the fastest wheel about some times."""
    angles = run.counts * (TURN / recording.ticks)
    late, early = (
        np.column_stack([np.interp(times + side, run.times, column) for column in angles.T])
        for side in (span / 2, -span / 2)
    )
    fastest: Array = np.abs(late - early).max(axis=1) / span
    return fastest


def _driven_block(
    recording: Recording, run: Run, rng: Generator, shortest: float, longest: float
) -> tuple[float, float]:
    """Begin and end of a block during which the robot drives all the time, amid a run, s."""
    length = float(rng.uniform(shortest, longest))
    top = np.percentile(_speed(recording, run, run.times), 80)
    for _ in range(200):
        begin = float(rng.uniform(run.times[0] + 1.5, run.times[-1] - length - 1.5))
        if (_speed(recording, run, np.arange(begin, begin + length, 0.1)) > 0.4 * top).all():
            break
    return begin, begin + length


def wheels_swapped(sound: Recording, rng: Generator) -> Damage:
    first, second = sorted(rng.choice(len(sound.wheels), 2, replace=False).tolist())
    order = list(range(len(sound.wheels)))
    order[first], order[second] = second, first
    damaged = _each(sound, lambda run: replace(run, counts=run.counts[:, order]))
    return Damage(damaged, sound, f"wheels {sound.wheels[first]} and {sound.wheels[second]} exchanged")


def wheel_negated(sound: Recording, rng: Generator) -> Damage:
    wheel = int(rng.integers(len(sound.wheels)))
    signs = np.where(np.arange(len(sound.wheels)) == wheel, -1.0, 1.0)
    damaged = _each(sound, lambda run: replace(run, counts=run.counts * signs))
    return Damage(damaged, sound, f"wheel {sound.wheels[wheel]} negated", (sound.wheels[wheel],))


def wheels_negated(sound: Recording, rng: Generator) -> Damage:
    del rng
    return Damage(_each(sound, lambda run: replace(run, counts=-run.counts)), sound, "all wheels negated")


def wheel_scale(sound: Recording, rng: Generator) -> Damage:
    factor = float(rng.choice([2, 4, 0.5, 0.25, round(float(rng.uniform(3, 30)), 1)]))
    count = len(sound.wheels)
    one = count > 1 and bool(rng.integers(2))
    wheel = int(rng.integers(count))
    factors = np.where(np.arange(count) == wheel, factor, 1.0) if one else np.full(count, factor)
    damaged = _each(sound, lambda run: replace(run, counts=run.counts * factors))
    which = f"wheel {sound.wheels[wheel]}" if one else "all wheels"
    return Damage(damaged, sound, f"counts of {which} times {factor:g}", (sound.wheels[wheel],) if one else ())


def wheel_unit(sound: Recording, rng: Generator) -> Damage:
    units = {"rpm": 60 / TURN, "deg/s": 360 / TURN, "rev/s": 1 / TURN, "ticks/s": sound.ticks / TURN}
    form = (TABLES, RADIANS, DATASET)[int(rng.integers(3))]
    if form == RADIANS:
        units = {"deg": 360 / TURN, "rev": 1 / TURN, "ticks": sound.ticks / TURN}
    unit = str(rng.choice(list(units)))
    damaged = _each(sound, lambda run: replace(run, counts=run.counts * units[unit]))
    return Damage(damaged, sound, f"wheels in {unit}, read as rad", forms=(form,))


def steering_unit(sound: Recording, rng: Generator) -> Damage:
    del rng
    damaged = _each(sound, lambda run: replace(run, steering=np.degrees(run.steering)))
    return Damage(damaged, sound, "steering in degrees")


def steering_sign(sound: Recording, rng: Generator) -> Damage:
    del rng
    return Damage(_each(sound, lambda run: replace(run, steering=-run.steering)), sound, "steering clockwise")


def steering_zero(sound: Recording, rng: Generator) -> Damage:
    degrees = float(rng.choice([-1, 1]) * rng.uniform(8, 25))
    damaged = _each(sound, lambda run: replace(run, steering=run.steering + math.radians(degrees)))
    return Damage(damaged, sound, f"steering {degrees:+.1f} deg")


def steering_frozen(sound: Recording, rng: Generator) -> Damage:
    value = float(rng.choice([0.0, round(float(rng.uniform(-0.3, 0.3)), 3)]))
    damaged = _each(sound, lambda run: replace(run, steering=np.full_like(run.steering, value)))
    return Damage(damaged, sound, f"steering is {value:g} throughout", sound.steered)


def heading_unit(sound: Recording, rng: Generator) -> Damage:
    way = int(rng.integers(3))

    def change(run: Run) -> Run:
        degrees = np.degrees(run.poses[:, 2])
        degrees = [degrees, (degrees + 180) % 360 - 180, degrees % 360][way]
        return replace(run, poses=np.column_stack([run.poses[:, :2], degrees]))

    words = ("continuous", "within +-180", "within 0 to 360")[way]
    return Damage(_each(sound, change), sound, f"headings in degrees, {words}")


def position_unit(sound: Recording, rng: Generator) -> Damage:
    unit, factor = (("mm", 1000.0), ("cm", 100.0))[int(rng.integers(2))]
    damaged = _each(sound, lambda run: replace(run, poses=run.poses * (factor, factor, 1.0)))
    return Damage(damaged, sound, f"positions in {unit}")


def reference_mirrored(sound: Recording, rng: Generator) -> Damage:
    ways = ["y", "y and heading", "x and y exchanged"] + (["heading"] if sound.robot != "robotino" else [])
    way = str(rng.choice(ways))
    order = [1, 0, 2] if "exchanged" in way else [0, 1, 2]
    signs = (1.0, -1.0 if way.startswith("y") else 1.0, -1.0 if "heading" in way else 1.0)
    damaged = _each(sound, lambda run: replace(run, poses=run.poses[:, order] * signs))
    return Damage(damaged, sound, f"reference: {way}" + ("" if "exchanged" in way else " negated"))


def reference_turned(sound: Recording, rng: Generator) -> Damage:
    degrees = float(rng.choice([180.0, 90.0, -90.0, *(rng.choice([-1, 1], 3) * rng.uniform(15, 90, 3))]))
    damaged = _each(sound, lambda run: _turning(run, math.radians(degrees)))
    return Damage(damaged, sound, f"headings {degrees:+.1f} deg")


def time_unit(sound: Recording, rng: Generator) -> Damage:
    unit, factor = (("ms", 1e3), ("us", 1e6))[int(rng.integers(2))]
    if rng.integers(2):
        forms = (TABLES, POSITIONS)
        return Damage(sound, sound, f"stamps of the poses in {unit}", forms=forms, pose_stamps=factor)
    return Damage(sound, sound, f"all stamps in {unit}", wheel_stamps=factor, pose_stamps=factor)


def clock_offset(sound: Recording, rng: Generator) -> Damage:
    offset = float(rng.choice([-1, 1]) * rng.uniform(0.25, 1.0))
    damaged = _each(sound, lambda run: replace(run, pose_times=run.pose_times + offset))
    return Damage(damaged, sound, f"poses stamped {offset:+.2f} s late", forms=_OWN_CLOCKS)


def clock_drift(sound: Recording, rng: Generator) -> Damage:
    long = sound.of([run for run in sound.runs if run.seconds >= 15.0])
    shortest = min(run.seconds for run in long.runs)
    drift = float(rng.choice([-1, 1]) * max(rng.uniform(0.003, 0.02), 0.3 / shortest))

    def change(run: Run) -> Run:
        zero = run.pose_times[0]
        return replace(run, pose_times=zero + (run.pose_times - zero) * (1 + drift))

    return Damage(_each(long, change), long, f"the poses' clock {100 * drift:+.2f} % fast", forms=_OWN_CLOCKS)


def wheel_dropout(sound: Recording, rng: Generator) -> Damage:
    chosen = _drawn_runs(sound, rng, 3)
    lost = {}
    for run in chosen:
        begin, end = _driven_block(sound, run, rng, 0.8, 3.0)
        lost[run.name] = (run.times > begin) & (run.times < end)
    return Damage(
        sound, sound, f"wheel rates missing in {', '.join(lost)}", tuple(lost), forms=(TABLES, DATASET), lost=lost
    )


def reference_dropout(sound: Recording, rng: Generator) -> Damage:
    chosen = {run.name: _driven_block(sound, run, rng, 1.0, 4.0) for run in _drawn_runs(sound, rng, 3)}

    def change(run: Run) -> Run:
        begin, end = chosen[run.name]
        kept = (run.pose_times < begin) | (run.pose_times > end)
        return replace(run, pose_times=run.pose_times[kept], poses=run.poses[kept])

    return Damage(_some(sound, set(chosen), change), sound, f"poses missing in {', '.join(chosen)}", tuple(chosen))


def reference_jump(sound: Recording, rng: Generator) -> Damage:
    chosen = {run.name: _driven_block(sound, run, rng, 0.0, 0.0)[0] for run in _drawn_runs(sound, rng, 2)}
    direction = float(rng.uniform(0, TURN))
    step = rng.uniform(0.25, 1.0) * np.array([math.cos(direction), math.sin(direction), 0.0])
    words = f"{np.hypot(*step[:2]):.2f} m"
    if rng.integers(3) == 0:
        degrees = float(rng.choice([-1, 1]) * rng.uniform(20, 90))
        step, words = np.array([0.0, 0.0, math.radians(degrees)]), f"{degrees:+.0f} deg"

    def change(run: Run) -> Run:
        after = run.pose_times >= chosen[run.name]
        pivot = run.poses[np.argmax(after), :2]
        cos, sin = math.cos(step[2]), math.sin(step[2])
        moved = run.poses + step
        moved[:, :2] = (run.poses[:, :2] - pivot) @ np.array([[cos, sin], [-sin, cos]]) + pivot + step[:2]
        return replace(run, poses=np.where(after[:, None], moved, run.poses))

    detail = f"the reference jumps by {words} in {', '.join(chosen)}"
    return Damage(_some(sound, set(chosen), change), sound, detail, tuple(chosen))


def counter_restart(sound: Recording, rng: Generator) -> Damage:
    chosen = {run.name: _driven_block(sound, run, rng, 0.0, 0.0)[0] for run in _drawn_runs(sound, rng, 2)}

    def change(run: Run) -> Run:
        anew = run.times >= chosen[run.name]
        counts = run.counts - run.counts[0]
        return replace(run, counts=np.where(anew[:, None], counts - counts[np.argmax(anew)], counts))

    detail = f"positions begin again in {', '.join(chosen)}"
    return Damage(_some(sound, set(chosen), change), sound, detail, tuple(chosen), forms=(POSITIONS,))


def wheel_dead(sound: Recording, rng: Generator) -> Damage:
    wheel = int(rng.integers(len(sound.wheels)))

    def change(run: Run) -> Run:
        counts = run.counts.copy()
        counts[:, wheel] = counts[0, wheel]
        return replace(run, counts=counts)

    name = sound.wheels[wheel]
    turned = [run for run in sound.runs if np.ptp(run.counts[:, wheel]) * TURN / sound.ticks > 10.0]
    if rng.integers(2) and turned and len(sound.runs) > 1:
        run = turned[int(rng.integers(len(turned)))]
        damaged = _some(sound, {run.name}, change)
        return Damage(damaged, sound, f"wheel {name} stands still in {run.name}", (run.name, name))
    return Damage(_each(sound, change), sound, f"wheel {name} stands still in all runs", (name,))


def reference_frozen(sound: Recording, rng: Generator) -> Damage:
    if rng.integers(2) or len(sound.runs) == 1:
        still = _each(sound, lambda run: replace(run, poses=np.tile(run.poses[:1], (len(run.poses), 1))))
        return Damage(still, sound, "the reference stands still in all runs")
    run = _drawn_runs(sound, rng, 1)[0]
    begin = _driven_block(sound, run, rng, 0.0, 0.0)[0]
    begin = min(begin, run.pose_times[0] + 0.6 * run.seconds)

    def change(run: Run) -> Run:
        frozen = run.pose_times >= begin
        return replace(run, poses=np.where(frozen[:, None], run.poses[np.argmax(frozen)], run.poses))

    detail = f"the reference of {run.name} stands still from {begin - run.times[0]:.1f} s on"
    return Damage(_some(sound, {run.name}, change), sound, detail, (run.name,))


def not_at_rest(sound: Recording, rng: Generator) -> Damage:
    wanted = float(rng.uniform(1.5, 3.0))
    cut = []
    for run in sound.runs:
        if run.seconds < wanted + 4.0:
            continue
        speeds = _speed(sound, run, run.times)
        driving = (run.times >= run.times[0] + wanted) & (speeds > 0.5 * np.percentile(speeds, 80))
        begin = run.times[np.argmax(driving)]
        if driving.any() and begin < run.times[-1] - 3.0:
            cut.append(shortened(run, begin, math.inf))
    runs = sound.of(cut)
    return Damage(runs, runs, f"the first {wanted:.1f} s of every run cut off")


def shortened(run: Run, begin: float, end: float) -> Run:
    """The part of a run between two times."""
    driven = (run.times >= begin) & (run.times <= end)
    shown = (run.pose_times >= begin) & (run.pose_times <= end)
    return replace(
        run,
        times=run.times[driven],
        counts=run.counts[driven],
        steering=run.steering[driven],
        pose_times=run.pose_times[shown],
        poses=run.poses[shown],
    )


def motion_missing(sound: Recording, rng: Generator) -> Damage:
    tolerance, pieces = math.radians(2.5), []
    for run in sound.runs:
        first = 0
        heading = np.unwrap(run.poses[:, 2])
        number = 0
        while first < len(heading) - 1:
            turned = np.abs(heading[first:] - heading[first]) > tolerance
            last = first + (int(np.argmax(turned)) if turned.any() else len(turned)) - 1
            begin, end = run.pose_times[[first, last]]
            way = np.hypot(*(run.poses[last, :2] - run.poses[first, :2]))
            if end - begin > 2.0 and way > 0.15:
                number += 1
                piece = shortened(run, begin + 0.2, end - 0.2)
                pieces.append(replace(piece, name=f"{run.name}p{number}", command=f"{run.command}p{number}"))
            first = max(last, first) + 1
    kept = sorted(rng.choice(len(pieces), min(24, len(pieces)), replace=False).tolist())
    runs = commanded(sound.of([pieces[index] for index in kept]))
    return Damage(runs, runs, f"{len(kept)} stretches without turning")


def few_repetitions(sound: Recording, rng: Generator) -> Damage:
    by_command: dict[str, list[Run]] = {}
    for run in sound.runs:
        by_command.setdefault(run.command, []).append(run)
    kept = {runs[int(rng.integers(len(runs)))].name for runs in by_command.values()}
    runs = sound.of([run for run in sound.runs if run.name in kept])
    return Damage(runs, runs, f"{len(kept)} commands, one run each")


def few_runs(sound: Recording, rng: Generator) -> Damage:
    runs = sound.of(_drawn_runs(sound, rng, 2))
    return Damage(runs, runs, f"{len(runs.runs)} of the runs only")


def reference_is_odometry(sound: Recording, rng: Generator) -> Damage:
    matrix = sound.forward * rng.normal(1.0, 0.02, sound.forward.shape) * rng.normal(1.0, 0.02)

    def change(run: Run) -> Run:
        return replace(run, pose_times=run.times.copy(), poses=np.round(odometry(sound, run, matrix), 4))

    return Damage(_each(sound, change), sound, "poses by odometry")


def odometry(recording: Recording, run: Run, matrix: Array) -> Array:
    """Poses (F, 3) from the first pose on, each step along an arc."""
    steps = np.diff(drive_signals(recording, run), axis=0) @ matrix.T
    heading = run.poses[0, 2] + np.append(0.0, np.cumsum(steps[:, 2]))
    half = steps[:, 2] / 2
    chord = np.sinc(half / math.pi)
    middle = heading[:-1] + half
    x = chord * (np.cos(middle) * steps[:, 0] - np.sin(middle) * steps[:, 1])
    y = chord * (np.sin(middle) * steps[:, 0] + np.cos(middle) * steps[:, 1])
    return np.column_stack(
        [run.poses[0, 0] + np.append(0.0, np.cumsum(x)), run.poses[0, 1] + np.append(0.0, np.cumsum(y)), heading]
    )


def copies(sound: Recording, rng: Generator) -> Damage:
    chosen = _drawn_runs(sound, rng, 3)
    epoch, cut = rng.integers(2, size=2)
    doubles = []
    for run in chosen:
        end = run.times[-1] - (0.1 * run.seconds if cut else 0.0)
        double = shortened(run, run.times[0], end)
        late = 1000.0 * epoch
        doubles.append(
            replace(double, name=f"{run.name}x", times=double.times + late, pose_times=double.pose_times + late)
        )
    words = ", ".join(run.name for run in chosen) + (", with cut ends" if cut else "")
    return Damage(sound.of([*sound.runs, *doubles]), sound, f"copies of {words}", tuple(run.name for run in chosen))


MAKERS: dict[str, Callable[[Recording, Generator], Damage]] = {
    maker.__name__: maker
    for maker in (
        wheels_swapped, wheel_negated, wheels_negated, wheel_scale, wheel_unit, steering_unit, steering_sign,
        steering_zero, steering_frozen, heading_unit, position_unit, reference_mirrored, reference_turned, time_unit,
        clock_offset, clock_drift, wheel_dropout, reference_dropout, reference_jump, counter_restart, wheel_dead,
        reference_frozen, not_at_rest, motion_missing, few_repetitions, few_runs, reference_is_odometry, copies,
    )
}  # fmt: skip
"""The makers by the kind of their fault."""
