"""Motions of a recording: speeds, directions and rates of turn, how long each was driven, and which are missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.fit.check.motion_kinds import SHARE, motion_kinds, turning
from omnibench.report.blocks import Cell, Column, Figure, FigureGrid, LegendItem, Row, Table
from omnibench.report.numbers import NOTHING, fixed, listing, percent, significant
from omnibench.report.recording.scan_points import evenly
from omnibench.report.style import INK, PALETTE, plot
from omnibench.report.traces import marks
from omnibench.robot.kinematics import Array, Robot

_BLOCK = 0.5  # s: motions are means over so long, which smooths encoder ticks (chosen)
_RESTS = 0.05  # share of the fastest motion below which the robot stands (chosen)
_DRAWN = 2500  # dots of a figure
_LEFT = LegendItem("left", "turning left", PALETTE[0])
_STRAIGHT_ON = LegendItem("straight", "straight", "#5b6772")
_RIGHT = LegendItem("right", "turning right", PALETTE[1])


@dataclass(frozen=True, eq=False)
class DrivenMotion:
    """One kind of motion: its share of the time in motion, and its twists (n, 3) in m/s, m/s, rad/s."""

    name: str
    share: float
    twists: Array

    @property
    def driven(self) -> bool:
        """True if it was driven for longer than by chance."""
        return self.share >= SHARE


def driven_motions(runs: Sequence[Trajectory], robot: Robot) -> list[DrivenMotion]:
    """Every kind of motion that the robot can drive, by the design values, with what was driven of it."""
    twists, seconds = _twists(runs, robot)
    total = float(seconds.sum()) or 1.0
    return [
        DrivenMotion(name, float(seconds[chosen].sum()) / total, twists[chosen])
        for name, chosen in motion_kinds(twists, robot).items()
    ]


def missing_in_words(motions: Sequence[DrivenMotion]) -> str:
    """The motions that were not driven, in words; empty where none is missing."""
    names = [motion.name.replace("curves to", "in curves to") for motion in motions if not motion.driven]
    for both in ("on the spot", "sideways"):
        if {f"{both} to the left", f"{both} to the right"} <= set(names):
            names[names.index(f"{both} to the left")] = both
            names.remove(f"{both} to the right")
    return listing(names, last="or")


def _twists(runs: Sequence[Trajectory], robot: Robot) -> tuple[Array, Array]:
    """Mean twists (n, 3) of blocks in motion, by the design values, and the blocks' durations (n,), s."""
    means, durations = [np.empty((0, 3))], [np.empty(0)]
    for run in runs:
        steps = np.diff(run.times, prepend=0.0)
        starts = np.flatnonzero(np.diff(run.times // _BLOCK, prepend=-1.0))
        lengths = np.add.reduceat(steps, starts)
        moved = np.add.reduceat(run.signals @ robot.inverse_kinematic_matrix.T * steps[:, None], starts)
        means.append(moved / lengths[:, None])
        durations.append(lengths)
    twists, seconds = np.concatenate(means), np.concatenate(durations)
    size = np.hypot(twists[:, 0], twists[:, 1]) + robot.reach * np.abs(twists[:, 2])
    moving = size > _RESTS * float(size.max(initial=0.0))
    return twists[moving], seconds[moving]


def motion_table(motions: Sequence[DrivenMotion]) -> Table:
    """How long each motion was driven, at which speeds and rates of turn."""
    rows = []
    for motion in motions:
        if not motion.driven:
            rows.append(Row.of(motion.name, Cell("not driven"), NOTHING, NOTHING, role="failed"))
            continue
        speeds = np.hypot(motion.twists[:, 0], motion.twists[:, 1])
        rates = np.degrees(np.abs(motion.twists[:, 2]))
        rows.append(Row.of(motion.name, percent(motion.share, 0), _range(speeds, 2), _range(rates, 0)))
    return Table(
        "Motions driven",
        (
            Column("Motion", numeric=False),
            Column("Share of the time in motion"),
            Column("Speed", "m/s"),
            Column("Rate of turn", "°/s"),
        ),
        tuple(rows),
        "By the design values, as means over 0.5 s; ranges hold nine tenths. A motion counts as straight or curved and "
        "as forward, backward or sideways (within 30°), so that shares add up to more than 100 %.",
    )


def _range(values: Array, decimals: int) -> str:
    low, high = np.quantile(values, [0.05, 0.95])
    least = 10.0 ** -(decimals + 1)  # less is rounding, and is shown as 0
    low, high = (value if value >= least else 0.0 for value in (low, high))
    shown = [fixed(value, decimals) if value > 10.0**-decimals else significant(value, 1) for value in (low, high)]
    return shown[0] if shown[0] == shown[1] else f"{shown[0]} to {shown[1]}"


def motion_figures(runs: Sequence[Trajectory], robot: Robot) -> FigureGrid:
    """Velocities seen from above, and speeds against rates of turn, a dot for every half second."""
    twists, _ = _twists(runs, robot)
    twists = twists[evenly(len(twists), _DRAWN)] if len(twists) else twists
    kinds = motion_kinds(twists, robot)
    left, right = turning(kinds, "left"), turning(kinds, "right")
    of_kinds = ((_LEFT, left), (_STRAIGHT_ON, ~left & ~right), (_RIGHT, right))
    groups = [(item, chosen) for item, chosen in of_kinds if chosen.any()]
    above, beside = [], []
    for item, chosen in groups:
        ahead, aside, rate = twists[chosen].T
        words = f"{item.label}<br>%{{y:.2f}} m/s ahead, %{{x:.2f}} m/s to the left"
        above.append(marks(item, 5, aside, ahead, hover=words, marker_opacity=0.6))
        speeds, degrees = np.hypot(ahead, aside), np.degrees(rate)
        beside.append(marks(item, 5, degrees, speeds, hover="%{x:.0f}°/s, %{y:.2f} m/s", marker_opacity=0.6))
    middle = marks(LegendItem("", "", INK, symbol="cross-thin-open"), 10, [0.0], [0.0])
    velocity = plot(*above, middle, x_title="to the left (m/s)", y_title="ahead (m/s)")
    reach = 1.1 * max(float(np.abs(twists[:, :2]).max(initial=0.0)), 0.01)
    velocity.update_layout(
        xaxis={"range": [reach, -reach], "scaleanchor": "y"}, yaxis={"range": [-reach, reach], "scaleratio": 1}
    )
    rates = plot(*beside, x_title="rate of turn, to the left (°/s)", y_title="speed (m/s)")
    rates.update_xaxes(autorange="reversed")
    rates.update_yaxes(rangemode="tozero")
    return FigureGrid(
        (
            Figure("Velocities, seen from above", velocity, "Velocity ahead against velocity to the left, m/s", 360),
            Figure("Speeds and rates of turn", rates, "Speed in m/s against the rate of turn in degrees a second", 360),
        ),
        tuple(item for item, _ in groups),
        2,
        "A dot is half a second, by the design values.",
        "motions-driven",
    )
