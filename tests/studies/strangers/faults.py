"""What is odd in strangers' recordings: each function changes a log in place."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.random import Generator

from strangers.motion import TURN, Log, changed

TRAVEL = {"m": 1.0, "mm": 1e3, "in": 1 / 0.0254}  # units of a wheel's way, in a m


def counts(
    log: Log,
    _: Generator,
    per_turn: float,
    wraps: float = 0,
    first: Sequence[int] = (0,),
    signed: bool = False,
    degrees: bool = False,
) -> None:
    """Positions in whole counts that begin again after some, or the degrees of such an encoder."""
    for run in log.runs.values():
        ticks = np.floor(run.wheels / TURN * per_turn) + first
        ticks = ticks % wraps if wraps else ticks
        run.wheels = np.where(ticks >= wraps / 2, ticks - wraps, ticks) if signed else ticks
        run.wheels = run.wheels * (360 / per_turn if degrees else 1.0)


def one_channel(log: Log, _: Generator) -> None:
    """Counters without a direction: they go up whichever way a wheel turns."""
    for run in log.runs.values():
        run.wheels = run.wheels[:1] + np.cumsum(np.abs(np.diff(run.wheels, axis=0, prepend=run.wheels[:1])), axis=0)


def spikes(log: Log, rng: Generator, kind: str) -> None:
    """Two single readings of each wheel and run that are of the other sign, 0, or any number."""
    for run in log.runs.values():
        for wheel in run.wheels.T:
            rows = rng.choice(np.arange(20, len(wheel) - 20), 2, replace=False)
            wheel[rows] = {"sign": -wheel[rows], "zero": 0.0, "any": np.floor(rng.uniform(-3e4, 3e4, 2))}[kind]


def increments(log: Log, _: Generator, late: float = 0.0) -> None:
    """What was counted since the row before; every second row is stamped late."""
    for run in log.runs.values():
        run.wheels = np.diff(run.wheels, axis=0, prepend=run.wheels[:1])
        run.times = run.times + late * (np.arange(len(run.times)) % 2)


def rates(log: Log, _: Generator, scale: float = 1.0) -> None:
    """Mean rates since the row before, rad/s times a scale."""
    for run in log.runs.values():
        run.wheels = np.diff(run.wheels, axis=0) / np.diff(run.times)[:, None] * scale
        run.times, run.steering = run.times[1:], run.steering[1:]


def rpm(log: Log, rng: Generator) -> None:
    rates(log, rng, 60 / TURN)


def travel(log: Log, rng: Generator, unit: str) -> None:
    """The way that each wheel rolled, or its speed, by the drawn radius."""
    scale = log.robot["wheels"][0]["radius"] * TRAVEL.get(unit, 1.0)
    for run in log.runs.values():
        run.wheels = run.wheels * scale
    if unit == "m/s":
        rates(log, rng)


def negated(log: Log, _: Generator, *wheels: str) -> None:
    for run in log.runs.values():
        run.wheels = run.wheels * [-1.0 if name in wheels else 1.0 for name in log.wheels]


def swapped(log: Log, _: Generator, first: str, second: str) -> None:
    order = [log.wheels.index({first: second, second: first}.get(name, name)) for name in log.wheels]
    for run in log.runs.values():
        run.wheels = run.wheels[:, order]


def jumps(log: Log, rng: Generator, lone: float = 0.0, one_way: bool = False, shifts: float = 0.0) -> None:
    """The reference jumps by 1 m: in a share of single poses, and for good amid a share of the runs."""
    side = float(rng.uniform(-math.pi, math.pi))
    for run in log.runs.values():
        count = len(run.poses)
        run.poses = run.poses.copy()
        if rng.random() < shifts:
            angle = rng.uniform(-math.pi, math.pi)
            run.poses[int(rng.uniform(0.3, 0.7) * count) :, :2] += [math.cos(angle), math.sin(angle)]
        alone = rng.random(count) < lone
        angles = np.full(count, side) if one_way else rng.uniform(-math.pi, math.pi, count)
        run.poses[alone, :2] += np.column_stack([np.cos(angles), np.sin(angles)])[alone]


def reference(log: Log, _: Generator, *factors: float) -> None:
    """Positions and headings times factors."""
    for run in log.runs.values():
        run.poses = run.poses * factors


def late(log: Log, _: Generator, seconds: float) -> None:
    """Poses are stamped late."""
    for run in log.runs.values():
        run.pose_times = run.pose_times + seconds


def steering_off(log: Log, _: Generator, degrees: float) -> None:
    for run in log.runs.values():
        run.steering = run.steering + math.radians(degrees)


def drawn(log: Log, _: Generator, **factors: float) -> None:
    """robot.yaml has numbers that are so many times the right ones."""
    log.robot = changed(log.robot, factors)


def axles_turned(log: Log, _: Generator, degrees: float) -> None:
    log.robot["wheels"] = [wheel | {"angle_deg": wheel["angle_deg"] + degrees} for wheel in log.robot["wheels"]]


def axles_reversed(log: Log, _: Generator) -> None:
    angles = [wheel["angle_deg"] for wheel in reversed(log.robot["wheels"])]
    log.robot["wheels"] = [w | {"angle_deg": angle} for w, angle in zip(log.robot["wheels"], angles, strict=True)]


def other_rollers(log: Log, _: Generator) -> None:
    """robot.yaml has the rollers of an O, the robot those of an X."""
    log.robot["wheels"] = [w | {"roller_angle_deg": -45 if w["x"] * w["y"] > 0 else 45} for w in log.robot["wheels"]]


def renamed(log: Log, _: Generator, pattern: str) -> None:
    """Runs are driven in turns, one of each motion; pattern: of their names, {0}: number, {1}: motion."""
    turns = sorted(log.runs, key=lambda run: int(run.rpartition("_")[2]))
    log.runs = {pattern.format(n, run.rpartition("_")[0]): log.runs[run] for n, run in enumerate(turns, 1)}


FAULTS: dict[str, Callable[..., None]] = {
    fault.__name__: fault
    for fault in (
        counts, one_channel, spikes, increments, rates, rpm, travel, negated, swapped, jumps, reference, late,
        steering_off, drawn, axles_turned, axles_reversed, other_rollers, renamed,
    )
}  # fmt: skip


def spoil(log: Log, rng: Generator, faults: dict[str, Any]) -> None:
    """Faults by name with their arguments: a mapping, a list, or one."""
    for name, given in faults.items():
        if isinstance(given, dict):
            FAULTS[name](log, rng, **given)
        else:
            FAULTS[name](log, rng, *(given if isinstance(given, list) else [] if given is None else [given]))
