"""Scans of a bag, read on demand, and the frames that its transforms place: the scanner's and the robot's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from omnibench.config import validate
from omnibench.data.importers.rosbag.bag import Bag, Topic, open_bag
from omnibench.data.importers.rosbag.message_streams import MessageFilter, PoseStream, Stamps, read_poses, stamp_of
from omnibench.data.scans import Mount, Ranges, Scanner, Scans, TrajectoryScans
from omnibench.errors import ConfigError, DataError, nearest
from omnibench.robot.kinematics import Array, compose, interpolated
from omnibench.words import plural

_BASES = ("base_link", "base_footprint", "base")  # REP-105; with or without the robot's namespace
_LARGEST_TILT = math.radians(20)  # rad; a scanner with a larger tilt does not scan parallel to the floor (chosen)


@dataclass(frozen=True)
class ScannerMounting:
    """A scanner's mount. upside_down: its counter-clockwise rays run clockwise in the robot's frame."""

    mount: Mount
    upside_down: bool = False


def scanner_mounting(bag: Bag, frame: str) -> ScannerMounting | None:
    """Mounting of the scanner with a frame; None if the bag has no transform to it. DataError: it is tilted."""
    parents = fixed_transforms(bag)
    child, whole = frame.strip("/"), np.eye(4)
    for _ in range(len(parents) + 1):
        if child.rpartition("/")[2] in _BASES:
            tilt = math.acos(np.clip(whole[2, 2], -1.0, 1.0))
            upside_down = tilt > math.pi / 2
            if min(tilt, math.pi - tilt) > _LARGEST_TILT:
                raise DataError(
                    f"{bag.path}: the scanner's frame {frame} is tilted by {math.degrees(tilt):.0f} degrees, so that "
                    "it does not scan the plane of the floor; if it does, set scanner_mount; scans=false leaves the "
                    "scans out"
                )
            yaw = math.atan2(whole[1, 0], whole[0, 0])
            return ScannerMounting(Mount(x=float(whole[0, 3]), y=float(whole[1, 3]), yaw=yaw), upside_down)
        if child not in parents:
            return None
        child, step = parents[child]
        whole = step @ whole
    return None  # a ring of frames


def fixed_transforms(bag: Bag) -> dict[str, tuple[str, Array]]:
    """Parent of every frame, and the transform (4, 4) from the frame to its parent."""
    from scipy.spatial.transform import Rotation  # slow to import, and needed by bags with transforms alone

    parents: dict[str, tuple[str, Array]] = {}
    for topic in bag.topics:
        if topic.type != "tf2_msgs/msg/TFMessage" or not topic.name.endswith("tf_static"):
            continue
        for record in bag.records(topic):
            for stamped in getattr(record.message, "transforms", ()):
                turn, place = stamped.transform.rotation, stamped.transform.translation
                matrix = np.eye(4)
                try:
                    matrix[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
                except ValueError:  # all zeros: no rotation, and so no transform
                    continue
                matrix[:3, 3] = place.x, place.y, place.z
                if np.isfinite(matrix).all():
                    parents[stamped.child_frame_id.strip("/")] = stamped.header.frame_id.strip("/"), matrix
    return parents


_SAME = 1e-5  # rad over the whole scan, m; differences of geometry within one scanner: messages are in single precision
_SAME_INCREMENT = 0.1  # relative difference of the time between rays, which some drivers measure anew for every scan
_WAY_OUT = "scans=false leaves the scans out"


@dataclass(frozen=True, eq=False)
class ScanStream:
    """Usable scans of a bag's topic.

    stamps (S,): stamps of the first rays, ns, increasing. logged (S,): times of recording, ns.
    """

    path: Path
    topic: Topic
    scanner: Scanner
    stamps: Stamps
    logged: Stamps

    @property
    def place(self) -> str:
        """Bag and topic, for messages."""
        return f"{self.path}: topic {self.topic.name}"

    def between(self, zero: float, end: float, origin: int) -> RunScans | None:
        """The scans of a run from ``zero`` to ``end`` (s since ``origin``, ns); None when there is none."""
        times = (self.stamps - origin) / 1e9 - zero
        inside = np.flatnonzero((times >= -0.5e-9) & (times <= end - zero + 0.5e-9))
        if not len(inside):
            return None
        part = replace(self, stamps=self.stamps[inside], logged=self.logged[inside])
        return RunScans(part, np.maximum(times[inside], 0.0))


@dataclass(frozen=True, eq=False)
class RunScans:
    """The scans of a run, still in their bag, and their times (S,) in the run, s."""

    stream: ScanStream
    times: Array

    def read(self) -> TrajectoryScans:
        """Read the scans. DataError: the bag has changed since it was opened."""
        stream = self.stream
        keys = zip(stream.logged.tolist(), stream.stamps.tolist(), strict=True)
        places = {key: index for index, key in enumerate(keys)}
        ranges = np.empty((len(self.times), stream.scanner.rays), np.float32)
        with open_bag(stream.path, [stream.topic.name] if stream.topic.recorded else []) as bag:
            topic = bag.topic(stream.topic.name, "scan_topic")
            for record in bag.records(topic, int(stream.logged.min()), int(stream.logged.max())):
                place = places.pop((record.logged, stamp_of(topic, record, record.message)), None)
                if place is not None and len(record.message.ranges) == stream.scanner.rays:
                    ranges[place] = _measured(record.message)
        if places:
            raise DataError(f"{stream.place}: the bag has changed since it was opened; import it again")
        return TrajectoryScans(self.times, ranges)


class BagScans(Scans):
    """Scans of a data set that is being imported; they are read from their bag one run at a time."""

    def __init__(self, scanner: Scanner, runs: Mapping[str, RunScans]) -> None:
        self.scanner = scanner
        self._runs = dict(runs)

    @property
    def trajectories(self) -> tuple[str, ...]:
        return tuple(self._runs)

    def times(self, trajectory: str) -> Array:
        return self._of(trajectory).times

    def of(self, trajectory: str) -> TrajectoryScans:
        return self._of(trajectory).read()

    def _of(self, trajectory: str) -> RunScans:
        if trajectory not in self._runs:
            raise DataError(f"trajectory {trajectory} has no scans")
        return self._runs[trajectory]


def gather_scans(runs: Mapping[str, RunScans]) -> BagScans | None:
    """The scans of all runs, None without any. DataError: the bags have different scanners."""
    if not runs:
        return None
    first, *others = {id(run.stream.scanner): run.stream for run in runs.values()}.values()
    for other in others:
        difference = _difference(_Shape.of_scanner(first.scanner), _Shape.of_scanner(other.scanner))
        if not difference and first.scanner.mount != other.scanner.mount:
            difference = f"the mount is {other.scanner.mount}, expected {first.scanner.mount}"
        if difference:
            raise DataError(f"{other.place}: {difference} as in {first.path}; import the bags apart; {_WAY_OUT}")
    return BagScans(first.scanner, runs)


def read_scans(bag: Bag, topic: Topic, mount: Mount | None, warnings: list[str]) -> ScanStream:
    """Check every scan of a topic; what is left out is added to ``warnings``. DataError.

    mount: pose of the scanner on the robot; None: as in /tf_static, or else the middle of the robot, with a warning.
    """
    messages, place = MessageFilter(bag, topic), f"{bag.path}: topic {topic.name}"
    shape, frame, scan_time = None, "", 0.0
    rows: list[tuple[int, int, int, bool, float]] = []
    for record, stamp, (scan_shape, increment, seen) in messages.decoded(_laser_scan):
        if shape is None:
            shape, frame, scan_time = scan_shape, record.message.header.frame_id, float(record.message.scan_time)
        difference = _difference(shape, scan_shape)
        if difference:
            raise DataError(
                f"{place}, message {record.number}: {difference} as in the messages before; all scans must be of one "
                f"scanner, of one number of rays; {_WAY_OUT}"
            )
        rows.append((record.number, stamp, record.logged, seen, increment))
    numbers, stamps, logged = (np.array([row[column] for row in rows], dtype=np.int64) for column in range(3))
    if shape is not None:
        empty = f"without a range from {shape.range_min:g} to {shape.range_max:g} m"
        good = messages.keep(np.array([row[3] for row in rows]), numbers, empty)
        order = good[messages.in_order(stamps[good], numbers[good])]
    try:
        messages.require(len(order) if shape else 0)
    except DataError as error:
        raise DataError(f"{error}; {_WAY_OUT}") from None
    assert shape is not None  # else nothing is left
    warnings.extend(messages.warnings())
    # The scanner's time between rays, s: the median of its scans.
    increments = [row[4] for row in rows]
    increment = float(np.median(increments))
    if np.abs(np.array(increments) - increment).max() > _SAME_INCREMENT * abs(increment):
        low, high = min(increments), max(increments)
        warnings.append(
            f"{place}: time_increment varies from {low:.3g} to {high:.3g} s; its median, {increment:.3g} s, is taken"
        )
    if increment == 0 and scan_time > 0:
        warnings.append(
            f"{place}: time_increment is 0, so that each scan counts as taken at one instant, though scan_time is "
            f"{scan_time:.3g} s"
        )
    scanner = _scanner(shape, increment, _mounting(bag, frame, mount, place, warnings), topic, place)
    return ScanStream(bag.path, topic, scanner, stamps[order], logged[order])


@dataclass(frozen=True)
class _Shape:
    """Geometry that the scans of one scanner share: rays, rad, m."""

    rays: int
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float

    @classmethod
    def of_scanner(cls, scanner: Scanner) -> _Shape:
        return cls(scanner.rays, scanner.angle_min, scanner.angle_increment, scanner.range_min, scanner.range_max)


def _laser_scan(message: Any) -> tuple[_Shape, float, bool]:
    """The shape of a scan, the time between its rays (s), and True if any range is a measurement."""
    ranges, range_max = message.ranges, float(message.range_max)
    if not np.isfinite(range_max):  # some drivers give no limit
        range_max = float(np.finfo(np.float32).max)
    shape = _Shape(
        len(ranges), float(message.angle_min), float(message.angle_increment), float(message.range_min), range_max
    )
    return shape, float(message.time_increment), bool(np.isfinite(_measured(message)).any())


def _measured(message: Any) -> Ranges:
    """The ranges of a scan (R,), m; inf for NaN, 0 and values out of the scanner's range, which are no measurements."""
    ranges = np.asarray(message.ranges, dtype=np.float32)
    good = (ranges >= message.range_min) & (ranges <= message.range_max) & (ranges > 0)  # False for NaN
    return np.where(good, ranges, np.float32(np.inf))


def _difference(expected: _Shape, given: _Shape) -> str:
    """The first difference between two scans, as ``range_max is 12, expected 30``; empty if there is none."""
    if given.rays != expected.rays:
        return f"a scan has {plural(given.rays, 'range')}, expected {expected.rays}"
    for name, tolerance in (
        ("angle_min", _SAME),
        ("angle_increment", _SAME / max(expected.rays, 1)),
        ("range_min", _SAME),
        ("range_max", _SAME * max(1.0, abs(expected.range_max))),
    ):
        ours, theirs = getattr(expected, name), getattr(given, name)
        if not abs(ours - theirs) <= tolerance:
            return f"{name} is {theirs:g}, expected {ours:g}"
    return ""


def _mounting(bag: Bag, frame: str, mount: Mount | None, place: str, warnings: list[str]) -> ScannerMounting:
    if mount is not None:
        return ScannerMounting(mount)
    mounting = scanner_mounting(bag, frame)
    if mounting is None:
        warnings.append(
            f"{place}: it is unknown where the scanner ({frame or 'a frame without a name'}) is mounted (no /tf_static "
            "from base_link); the robot's middle is taken; --set 'scanner_mount={x: 0.1, y: 0, yaw: 0}' (m, rad)"
        )
    return mounting or ScannerMounting(Mount())


def _scanner(shape: _Shape, increment: float, mounting: ScannerMounting, topic: Topic, place: str) -> Scanner:
    sign = -1.0 if mounting.upside_down else 1.0
    try:
        return validate(
            Scanner,
            {
                "name": topic.name,
                "rays": shape.rays,
                "angle_min": sign * shape.angle_min,
                "angle_increment": sign * shape.angle_increment,
                "time_increment": increment,
                "range_min": shape.range_min,
                "range_max": shape.range_max,
                "mount": mounting.mount,
            },
            place,
        )
    except ConfigError as error:
        raise DataError(f"{error}; {_WAY_OUT}") from None


def read_transforms(bag: Bag, topic: Topic, frames: Sequence[str], warnings: list[str]) -> PoseStream:
    """Poses of the second of two frames in the first, at the stamps of the rarest transform between them.

    Transforms between are composed in the plane. ConfigError: no frames are given, or nothing leads from one to the
    other. DataError as for ``read_poses``.
    """
    # The parent of every frame that moves.
    moving = {
        stamped.child_frame_id.strip("/"): stamped.header.frame_id.strip("/")
        for record in bag.records(topic)
        for stamped in getattr(record.message, "transforms", ())
    }
    fixed = fixed_transforms(bag)
    parents = moving | {child: parent for child, (parent, _) in fixed.items()}
    shown = ", ".join(f"{parent} > {child}" for child, parent in parents.items()) or "none"
    place = f"{bag.path}: topic {topic.name}"
    if not frames:
        raise ConfigError(f"{place}: set pose_frames=[world, robot] to the frames of the reference; found: {shown}")
    world, child = (frame.strip("/") for frame in frames)
    links: list[str] = []
    while child != world:
        if child not in parents or child in links:
            known = {*parents, *parents.values()}
            hint = nearest(child if links else frames[1], known) if child not in known else ""
            raise ConfigError(
                f"{place}: pose_frames: no transforms lead from {world} to {frames[1]}; {hint}found: {shown}"
            )
        links.append(child)
        child = parents[child]
    streams = {link: read_poses(bag, topic, warnings, partial(_transform, link)) for link in links if link in moving}
    if not streams:
        raise ConfigError(f"{place}: pose_frames: {frames[1]} does not move in {world}; found: {shown}")
    stamps = min(streams.values(), key=lambda stream: len(stream.stamps)).stamps
    begin, end = max(each.stamps[0] for each in streams.values()), min(each.stamps[-1] for each in streams.values())
    stamps = stamps[(stamps >= begin) & (stamps <= end)]
    poses: Array = np.zeros((len(stamps), 3))
    for link in reversed(links):
        poses = compose(
            poses,
            _at(streams[link], stamps) if link in streams else np.broadcast_to(_in_plane(fixed[link][1]), poses.shape),
        )
    return PoseStream(stamps, poses, None)


def _transform(child: str, message: Any) -> Any:
    """The transform of a frame in a message of transforms; None if it is not in it."""
    return next((each for each in message.transforms if each.child_frame_id.strip("/") == child), None)


def _at(stream: PoseStream, stamps: Any) -> Array:
    """Poses (K, 3) at stamps (K,), by straight lines between those of a stream."""
    poses = np.column_stack([stream.poses[:, :2], np.unwrap(stream.poses[:, 2])])
    return interpolated((stamps - stream.stamps[0]) / 1e9, (stream.stamps - stream.stamps[0]) / 1e9, poses)


def _in_plane(transform: Array) -> Array:
    return np.array([*transform[:2, 3], np.arctan2(transform[1, 0], transform[0, 0])])
