"""The robots of the OptiOdom recordings: what their files hold, and how omnibench has them.

Kinematics of the authors with wheel angles d (m): diff v = (dR + dL)/2, w = (dR - dL)/L; tricyc v = d cos phi,
w = d sin phi / L; omni3 vx = (-d0 + d1)/sqrt(3), vy = (-d0 - d1 + 2 d2)/3, w = -(d0 + d1 + d2)/(3 L); omni4
v = (d0 - d1 + d2 - d3)/4, vn = (-d0 - d1 + d2 + d3)/4, w = -(d0 + d1 + d2 + d3)/(2 (L1 + L2)).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from omnibench.robot.kinematics import Wheel


@dataclass(frozen=True)
class Geometry:
    """Design values by a session's metadata, m. lengths: L, or L1 and L2. diameters: of the wheels."""

    lengths: tuple[float, ...]
    diameters: tuple[float, ...]

    def __str__(self) -> str:
        return f"L {_listed(self.lengths)} m, D {_listed(self.diameters)} m"


@dataclass(frozen=True)
class LogFormat:
    """Columns of a robot's own log, counted from 0, the time.

    ticks: of each wheel; signs: to its sense in omnibench. commands: v, vn (if any) and omega; none: they are not
    logged. in_ticks: they are in ticks and rad a cycle, not in m/s and rad/s.
    """

    fields: int
    ticks: tuple[int, ...]
    signs: tuple[int, ...]
    commands: tuple[int, ...] = ()
    in_ticks: bool = False


@dataclass(frozen=True)
class Kind:
    """A robot. columns: of its run files after the pose, ticks first; signs: to the wheels' sense in omnibench."""

    title: str
    columns: tuple[str, ...]
    signs: tuple[int, ...]
    lengths: int
    diameters: int
    log: LogFormat
    wheels: Callable[[Geometry], tuple[Wheel, ...]]

    @property
    def ticks(self) -> tuple[str, ...]:
        """The columns with ticks, one for each wheel with a measured rate."""
        return self.columns[: len(self.signs)]


def _listed(values: tuple[float, ...]) -> str:
    return f"{values[0]:g}" if len(set(values)) == 1 else ", ".join(f"{value:g}" for value in values)


def _diff(geometry: Geometry) -> tuple[Wheel, ...]:
    half = geometry.lengths[0] / 2
    right, left = (diameter / 2 for diameter in geometry.diameters)
    return (
        Wheel(name="right", type="fixed", radius=right, x=0.0, y=-half),
        Wheel(name="left", type="fixed", radius=left, x=0.0, y=half),
    )


def _tricyc(geometry: Geometry) -> tuple[Wheel, ...]:
    (length,), (diameter,) = geometry.lengths, geometry.diameters
    rear = (("rear_left", 1), ("rear_right", -1))  # their radius and distance apart are not known and do not count
    return (
        Wheel(name="front", type="steered", radius=diameter / 2, x=length, y=0.0),
        *(
            Wheel(name=name, type="fixed", radius=diameter / 2, x=0.0, y=side * length / 2, measured=False)
            for name, side in rear
        ),
    )


def _omni3(geometry: Geometry) -> tuple[Wheel, ...]:
    return tuple(
        Wheel(
            name=str(index),
            radius=diameter / 2,
            distance=geometry.lengths[0],
            angle=math.radians(axle),
            roller_angle=0.0,
        )
        for index, (diameter, axle) in enumerate(zip(geometry.diameters, (300, 60, 180), strict=True))
    )


def _omni4(geometry: Geometry) -> tuple[Wheel, ...]:
    x, y = (length / 2 for length in geometry.lengths)
    corners = (("front_left", 1, 1), ("front_right", 1, -1), ("rear_left", -1, 1), ("rear_right", -1, -1))
    return tuple(
        Wheel(
            name=name,
            type="mecanum",
            radius=diameter / 2,
            x=ahead * x,
            y=side * y,
            roller_angle=ahead * side * math.pi / 4,
        )
        for (name, ahead, side), diameter in zip(corners, geometry.diameters, strict=True)
    )


KINDS = {
    "diff": Kind(
        "differential drive, encoders at 20 Hz",
        ("ticks_right", "ticks_left"),
        (1, 1),
        1,
        2,
        LogFormat(8, (2, 1), (1, 1), (6, 7), in_ticks=True),
        _diff,
    ),
    "omni3": Kind(
        "three-wheeled omnidirectional robot, encoders at 25 Hz",
        ("ticks_0", "ticks_1", "ticks_2"),
        (-1, -1, -1),
        1,
        3,
        LogFormat(10, (1, 2, 3), (1, 1, 1), (7, 8, 9)),
        _omni3,
    ),
    "omni4": Kind(
        "mecanum base, encoders at 100 Hz",
        ("turns_0", "turns_1", "turns_2", "turns_3"),
        (1, -1, 1, -1),
        2,
        4,
        LogFormat(11, (1, 2, 3, 4), (-1, 1, -1, 1), (8, 9, 10)),
        _omni4,
    ),
    "tricyc": Kind(
        "tricycle with a driven and steered front wheel, encoders at 20 Hz",
        ("ticks", "steering"),
        (1,),
        1,
        1,
        LogFormat(3, (1,), (1,)),
        _tricyc,
    ),
}
"""The robots by their type in the metadata."""
