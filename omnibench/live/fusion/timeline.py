"""Timeline of a robot's last seconds: its motions, the poses after them, and poses measured in between, corrected."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, replace

import numpy as np

from omnibench.live.estimation.live_odometry import Motion, RobotCentre, carried
from omnibench.robot.effects.effect import ReferenceEffect, Values
from omnibench.robot.kinematics import Array, Mount
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import advance

_SECOND = 1e9  # ns
_MOST_A_SECOND = 2000  # samples that are kept, whatever the stamps say, so that wrong ones cannot fill the memory


@dataclass(frozen=True, slots=True, eq=False)
class PoseMeasurement:
    """Measurement of a pose (3,) in the map, m, m, rad, at ``stamp`` (ns), with its covariance (3, 3).

    arrival: s, monotonic. absolute: it replaces the filter's pose instead of correcting it. heading_stamp: when its
    heading was measured (ns), if that is another time. mount: the point of the robot that it is of; None: its centre.
    """

    stamp: int
    pose: Array
    covariance: Array
    arrival: float = 0.0
    absolute: bool = False
    heading_stamp: int | None = None
    mount: Mount | None = None

    @property
    def latest(self) -> int:
        """The later of its two times, ns: from there on odometry is known for all of it."""
        return self.stamp if self.heading_stamp is None else max(self.stamp, self.heading_stamp)

    @property
    def earliest(self) -> int:
        """The earlier of its two times, ns."""
        return self.stamp if self.heading_stamp is None else min(self.stamp, self.heading_stamp)


@dataclass(slots=True, eq=False)
class Entry:
    """One wheel sample: the motion up to it, and after it odometry's pose (3,), the filter's pose and covariance.

    measurements: poses whose time lies within the motion, in the order of time.
    """

    stamp: int
    motion: Motion
    odometry: Array
    pose: Array
    covariance: Array
    measurements: tuple[PoseMeasurement, ...] = ()


class Timeline:
    """Entries of at least the last ``seconds`` (up to 2 kHz), by stamp; one at least, once one was added."""

    def __init__(self, seconds: float) -> None:
        self._length = int(seconds * _SECOND)
        self._most = int(seconds * _MOST_A_SECOND)
        self.entries: list[Entry] = []
        self._stamps: list[int] = []

    @property
    def oldest(self) -> int:
        return self._stamps[0]

    @property
    def newest(self) -> int:
        return self._stamps[-1]

    def append(self, entry: Entry) -> None:
        """Add the newest entry and forget what is too old."""
        self.entries.append(entry)
        self._stamps.append(entry.stamp)
        first = 0
        if self._stamps[0] < entry.stamp - 2 * self._length:  # seldom, and then many at once, which is fast
            first = bisect_left(self._stamps, entry.stamp - self._length) - 1
        elif len(self._stamps) > 2 * self._most:
            first = self._most
        if first > 0:
            del self.entries[:first], self._stamps[:first]

    def restart(self, stamp: int) -> None:
        """Keep the newest entry alone, at another stamp: the clock jumped, and the times before have no meaning."""
        newest = self.entries[-1]
        newest.stamp, newest.measurements = stamp, ()
        self.entries, self._stamps = [newest], [stamp]

    def index(self, stamp: int) -> int:
        """The first entry at or after ``stamp``; as many as there are entries where there is none."""
        return bisect_left(self._stamps, stamp)

    def share(self, index: int, stamp: int) -> float:
        """Share (0 to 1) of an entry's motion that lies before ``stamp``."""
        begin, end = self._stamps[index - 1], self._stamps[index]
        return (stamp - begin) / (end - begin)

    def odometry_at(self, stamp: int) -> Array | None:
        """Odometry's pose (3,) at a time (ns), between samples at constant twist; None outside the timeline."""
        index = self.index(stamp)
        if not self.entries or index == len(self.entries) or stamp < self.oldest:
            return None
        entry = self.entries[index]
        if entry.stamp == stamp:
            return np.array(entry.odometry)
        part = entry.motion.part(self.share(index, stamp))
        return advance(self.entries[index - 1].odometry, part.moved, part.integration)


class ReferenceCorrection:
    """Undoes a model's effects of the reference.

    start: the first pose of a run, from which some effects act on; None: the next pose that comes.
    """

    def __init__(self, model: OdometryModel, start: PoseMeasurement | None = None) -> None:
        self._mount = model.robot.mount
        self._terms: list[tuple[ReferenceEffect, Values]] = [
            (term.effect, term.values) for term in model.reference_terms if isinstance(term.effect, ReferenceEffect)
        ]
        self._start = start

    def continued(self, model: OdometryModel) -> ReferenceCorrection:
        """The correction by another model, from the same start on."""
        return ReferenceCorrection(model, self._start)

    def restart(self) -> None:
        """The next pose is the first of another run."""
        self._start = None

    def corrected(self, measurement: PoseMeasurement) -> PoseMeasurement:
        """The tracked point's true pose when its position was measured; its heading may be of another time."""
        if self._start is None:
            self._start = measurement
        if self._mount is not None:
            measurement = replace(measurement, mount=self._mount)
        if not self._terms:
            return measurement
        stamps = np.array([(measurement.stamp - self._start.stamp) / _SECOND])
        delays = [effect.delays(stamps, values) for effect, values in self._terms]
        of_position, of_heading = (sum(float(delay[kind][0]) for delay in delays) for kind in range(2))
        poses = measurement.pose[None]
        for effect, values in reversed(self._terms):
            poses = effect.corrected(poses, self._start.pose, values)
        return replace(
            measurement,
            stamp=measurement.stamp - round(_SECOND * of_position),
            heading_stamp=measurement.stamp - round(_SECOND * of_heading),
            pose=np.array(poses[0]),
        )


def turned(measurement: PoseMeasurement, before: Array, after: Array) -> PoseMeasurement:
    """A pose whose heading was measured at another time, with its heading turned to the time of the position.

    before, after: odometry's poses (3,) at the time of the heading and at that of the position.
    """
    pose: Array = measurement.pose + np.array([0.0, 0.0, after[2] - before[2]])
    return replace(measurement, pose=pose, heading_stamp=None)


def of_centre(measurement: PoseMeasurement) -> PoseMeasurement:
    """The pose of the robot's centre, from that of a point of the robot."""
    if measurement.mount is None:
        return measurement
    pose = RobotCentre(measurement.mount).pose(measurement.pose)
    covariance = carried(measurement.covariance, (pose - measurement.pose)[:2])
    return replace(measurement, pose=pose, covariance=covariance, mount=None)
