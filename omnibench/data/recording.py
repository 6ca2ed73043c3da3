"""Recordings as their readers give them, nothing judged: each stream by its own clock and in its reader's unit.

Streams are readings of wheels and of steering axles, reference poses, measured distances and turns, events, and scans.
``omnibench.data.runs`` makes runs of them, as the options of ``omnibench.data.recording_options`` say.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Split
from omnibench.data.references import References
from omnibench.data.scans import Ranges, Scanner
from omnibench.robot.kinematics import Array
from omnibench.views import Brief
from omnibench.words import plural

Notes = list[str]
"""What was left out, mended or decided on reading, which the warnings of the data set hold."""
_SAME_SHAPE = 1e-5  # rad over the whole scan, m; differences within one scanner: messages are in single precision


@dataclass(frozen=True, eq=False)
class WheelReadings:
    """Readings of wheels at times (F,), increasing, by their clock, in the time unit of the recording.

    values (F, N): of the robot's wheels in its order, in ``unit``. steering (F, S): angles in the option's
    ``steering_unit``. columns, steering_columns: names in the source, in the same order. begin: of the first sample of
    rates or increments; None: a usual period before the first reading. longest_gap: s; a longer one between readings of
    a robot that drives ends a stretch. read_at (F, N + S): when each value was read, if not at the times, which it is
    interpolated at. others: further columns (F, n) that runs keep: angles, targets, odometry. place: their file, if it
    is not the recording's.
    """

    times: Array
    values: Array
    unit: str
    steering: Array | None = None
    columns: tuple[str, ...] = ()
    steering_columns: tuple[str, ...] = ()
    begin: float | None = None
    longest_gap: float = math.inf
    read_at: Array | None = None
    others: Mapping[str, Array] = field(default_factory=dict)
    place: str = ""

    def at_the_rows(self, values: Array, columns: slice) -> Array:
        """Values (F, n) of some columns at the times of the readings, where they were read at times of their own."""
        if self.read_at is None:
            return values
        read = zip(self.read_at[:, columns].T, values.T, strict=True)
        return np.column_stack([np.interp(self.times, *pair) for pair in read])


@dataclass(frozen=True, eq=False, repr=False)
class PoseReadings(Brief):
    """Reference poses (K, 3) as recorded at times (K,), by their clock; covariances (K, 3, 3) where all have one.

    radians: the headings are in rad, whatever the option says. doubtful: name of what may be the robot's own odometry.
    """

    times: Array
    poses: Array
    covariances: Array | None = None
    radians: bool = False
    doubtful: str = ""

    def only(self, chosen: NDArray[Any]) -> PoseReadings:
        """Some of the poses, by their indices, or by True (K,)."""
        covariances = None if self.covariances is None else self.covariances[chosen]
        return replace(self, times=self.times[chosen], poses=self.poses[chosen], covariances=covariances)


@dataclass(frozen=True)
class Event:
    """An instant (s) by the wheels' clock at which a run begins, and the command that is driven from then on."""

    time: float
    command: str | None = None


@dataclass(frozen=True)
class RunAttributes:
    """What a source says of a run; None where it says nothing.

    numbers: v, alpha, omega, duration, distance (SI). sent: commands (C, 5) by the wheels' clock, as in Trajectory.
    """

    command: str | None = None
    repetition: int | None = None
    split: Split | None = None
    session: str | None = None
    started_at: float | None = None
    numbers: Mapping[str, float | None] = field(default_factory=dict)
    sent: Array | None = None


class ScanShape(NamedTuple):
    """Geometry that the scans of one scanner share: rays, rad, m; see ``Scanner``."""

    rays: int
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float


def scan_difference(expected: ScanShape | Scanner, other: ScanShape | Scanner) -> str:
    """The first difference between two scanners, as ``range_max is 12, expected 30``; empty if there is none."""
    if other.rays != expected.rays:
        return f"a scan has {plural(other.rays, 'range')}, expected {expected.rays}"
    for name in ScanShape._fields[1:]:
        was, now = getattr(expected, name), getattr(other, name)
        same = _SAME_SHAPE * max(1.0, abs(was)) / (expected.rays or 1 if name == "angle_increment" else 1)
        if not abs(now - was) <= same:
            return f"{name} is {now:g}, expected {was:g}"
    mounts = [each.mount if isinstance(each, Scanner) else None for each in (expected, other)]
    return "" if mounts[0] == mounts[1] else f"the mount is {mounts[1]}, expected {mounts[0]}"


@dataclass(frozen=True, eq=False)
class ScanReadings:
    """Scans at times (S,), s by the wheels' clock. read: the ranges (n, R) of chosen ones, by their indices."""

    scanner: Scanner
    place: str
    times: Array
    read: Callable[[Any], Ranges]


class Sensors(Protocol):
    """Sensors that give references to the runs of a recording: a gyro, a receiver of satellites."""

    def without_bias(self, samples: Any, least_rest: float, still: float, place: str) -> Sensors:
        """The sensors with offsets as they show while the wheels of ``samples`` rest. DataError: nothing tells them."""

    def of_run(self, zero: float, end: float, *, start_known: bool) -> References | None:
        """The references of a run from the time ``zero`` of the recording on, for ``end`` s; None if there are none."""


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording: its streams, and where it is from.

    place: its file or topic, for messages. measured: distances, turns, positions and the like, by the poses' clock, in
    the units of the poses. sensors: others that give each run its references. numbered: its runs are called by numbers.
    a_run: it is a run already, which begins at 0. one_table: poses stand in the rows of the wheels.
    """

    name: str
    place: str
    wheels: WheelReadings
    poses: PoseReadings | None = None
    measured: References | None = None
    events: tuple[Event, ...] = ()
    attributes: RunAttributes = RunAttributes()
    scans: ScanReadings | None = None
    sensors: Sensors | None = None
    numbered: bool = False
    a_run: bool = False
    one_table: bool = False

    @property
    def referenced(self) -> bool:
        """True if anything tells how the robot moved, but for scans and wheels."""
        return self.poses is not None or self.measured is not None or self.sensors is not None
