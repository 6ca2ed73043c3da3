"""The commanded motions of runs, as figures tell them apart: direction, speed and rate of turn, with a colour each."""

from __future__ import annotations

import math
from collections.abc import Sequence

from omnibench.data.dataset import Trajectory
from omnibench.report.blocks import LegendItem
from omnibench.report.numbers import fixed

# Colours of motions, from the most negative to the most positive rate of turn.
_COLOURS = ("#0072b2", "#5b6772", "#d97706", "#aa3377", "#4fb0e8", "#7b4b2a", "#8f8f1f")
MOST_MOTIONS = len(_COLOURS)
Motion = tuple[float, float]  # speed, m/s, and rate of turn, rad/s


def motion_of(run: Trajectory) -> Motion:
    """Speed and rate of turn of a command, rounded so that repetitions of a measured command agree."""
    return round(run.v or 0.0, 2), round(run.omega or 0.0, 2)


def direction_of(run: Trajectory) -> float:
    """Commanded direction in the robot's frame, deg, from 0 to 360."""
    return round(math.degrees(run.alpha or 0.0), 3) % 360


def motion_in_words(name: str, speed: float | None, direction: float | None, turn_rate: float | None) -> str:
    """A command as ``0.2 m/s at 30°, −0.35 rad/s``; its name if speed, m/s, direction, rad, or rate are not known."""
    if speed is None or direction is None or turn_rate is None:
        return name
    turn = f"{turn_rate:.3g} rad/s".replace("-", "−")
    if speed == 0:
        return f"on the spot, {turn}"
    return f"{speed:.3g} m/s at {fixed(math.degrees(direction) % 360, 0)}°, {turn if turn_rate else 'straight'}"


def moves(run: Trajectory) -> bool:
    """True unless the command is known to turn the robot on the spot."""
    return run.v is None or run.v > 0


def motion_items(motions: Sequence[Motion]) -> list[LegendItem]:
    """The legend of at most seven motions; it gives speeds where they differ."""
    several = len({speed for speed, _ in motions}) > 1
    names = [
        f"ω = {fixed(rate, 2)} rad/s" + (f", v = {fixed(speed, 2)} m/s" if several else "") for speed, rate in motions
    ]
    return [
        LegendItem(f"turn-{i}", name, colour) for i, (name, colour) in enumerate(zip(names, _COLOURS, strict=False))
    ]
