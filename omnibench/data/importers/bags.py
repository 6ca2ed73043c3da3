"""Messages of bags (MCAP, rosbag2 and ROS 1), read with rosbags: values by field path, transforms, and scans on demand.

Every fault of a file is one line. Messages that cannot be used are left out and counted, late ones are sorted.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import reduce
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from omnibench.config import read_yaml, validate
from omnibench.data.importers.tum import planar_headings
from omnibench.data.recording import Notes, ScanReadings, ScanShape, scan_difference
from omnibench.data.scans import Mount, Ranges, Scanner
from omnibench.errors import ConfigError, DataError, OmnibenchError, UnknownNameError, nearest
from omnibench.files import check_file, read_text
from omnibench.robot.kinematics import Array
from omnibench.words import plural

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

Stamps = NDArray[np.int64]
Reader = Callable[[Any], Any]  # of a message
TRANSFORMS = "tf2_msgs/msg/TFMessage"
FIX, IMU, SCAN = (f"sensor_msgs/msg/{name}" for name in ("NavSatFix", "Imu", "LaserScan"))
SECOND = 1_000_000_000  # ns
LARGEST = 1e9  # m, rad or rad/s; a larger value is garbage
_MOST_SET_BACK = 20  # messages that may come over a second late; more mean a clock that was set back (chosen)
_NO_STAMP = "without a header stamp (it is 0)"
_SUFFIXES, _METADATA = (".mcap", ".db3", ".bag"), "metadata.yaml"
_REPAIR = {".mcap": "`mcap recover` saves what is there", ".bag": "`rosbag reindex` saves what is there"}
_BASES = ("base_link", "base_footprint", "base")  # REP-105; with or without the robot's namespace
_LARGEST_TILT = math.radians(20)  # rad; a scanner with a larger tilt does not scan parallel to the floor (chosen)
_SAME_INCREMENT = 0.1  # relative difference of the time between rays, which some drivers measure anew for every scan
_NO_VALUES = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "string", "wstring")


@dataclass(frozen=True)
class Topic:
    """A topic of a bag. type: as ``sensor_msgs/msg/JointState``, also where the bag writes it shorter.

    recorded: the times of recording count, not the stamps of the headers.
    """

    name: str
    type: str
    messages: int
    recorded: bool = False

    def __str__(self) -> str:
        return f"{self.name} ({self.type}, {plural(self.messages, 'message')})"

    @property
    def namespace(self) -> str:
        """The part of the name before the last slash."""
        return self.name.strip("/").rpartition("/")[0]

    def stamp(self, message: Any, otherwise: int) -> int:
        """The stamp of a message's header, ns; ``otherwise`` without one, or where the times of recording count."""
        header = None if self.recorded else getattr(message, "header", None)
        return otherwise if header is None else int(header.stamp.sec) * SECOND + int(header.stamp.nanosec)


class Bag:
    """An open bag; see :func:`open_bag`.

    recorded: names of topics of which the times of recording count. notes: what was left out of its messages.
    clock_topic, clock_stamps, clock_logged: of the wheels' messages, once these are read, stamps (F,) and times of
    recording (F,), ns; the first stamp is t = 0.
    """

    clock_topic: str
    clock_stamps: Stamps
    clock_logged: Stamps

    def __init__(
        self, path: Path, reader: AnyReader, recorded: Sequence[str], definitions: Sequence[Path], notes: Notes
    ) -> None:
        self.path, self.definitions, self.notes, self._reader = path, definitions, notes, reader
        self._connections: dict[tuple[str, str], list[Any]] = defaultdict(list)
        for connection in reader.connections:
            kind = connection.msgtype
            kind = kind.replace("/", "/msg/") if kind.count("/") == 1 else kind
            self._connections[connection.topic, kind].append(connection)
        counts = {key: sum(each.msgcount for each in of_topic) for key, of_topic in self._connections.items()}
        self.topics = [Topic(*key, count) for key, count in sorted(counts.items())]
        unstamped = {self.topic(name, "recorded_stamps").name for name in recorded}
        self.topics = [replace(topic, recorded=topic.name in unstamped) for topic in self.topics]

    def of_type(self, *types: str) -> list[Topic]:
        """The topics of some types on which something was recorded."""
        return [topic for topic in self.topics if topic.type in types and topic.messages]

    def topic(self, name: str, key: str) -> Topic:
        """The topic that the option ``key`` names, with or without its leading slash. UnknownNameError, DataError."""
        named = [topic for topic in self.topics if topic.name.strip("/") == name.strip("/")]
        if not named:
            raise UnknownNameError("topic", name, {topic.name for topic in self.topics}, f"{self.path}: {key}")
        chosen = max(named, key=lambda topic: topic.messages)
        if chosen.messages == 0:
            raise DataError(f"{self.path}: {key}: topic {chosen.name} has no messages; record it, or name another one")
        return chosen

    def records(self, topic: Topic, between: tuple[int, int] | None = None) -> Iterator[tuple[int, int, Any]]:
        """The messages of a topic in the order in which they were recorded. DataError: the bag is damaged.

        Each is given with its number in its topic, from 1, and the time of recording, ns, and is None if it cannot be
        decoded. between: times of recording, ns, of the first and the last message that are read; numbers count from
        the first of these.
        """
        number, (first, stop) = 0, (between[0], between[1] + 1) if between else (None, None)
        with _damage_as_error(self.path):
            messages = self._reader.messages(self._connections[topic.name, topic.type], first, stop)
            for number, (_, logged, data) in enumerate(messages, 1):
                try:
                    message = self._reader.deserialize(data, topic.type)
                except Exception:  # garbage fails in many ways
                    message = None
                yield number, logged, message
        if first is None and number < topic.messages:  # an MCAP without its message indexes
            found = f"only {number} of {plural(topic.messages, 'message')} on {topic.name} can be found"
            raise DataError(f"{self.path}: {found}; its index is damaged; {_repair(self.path)}")

    def seconds(self, stamps: Stamps, topic: Topic | None = None) -> Array:
        """Times, s since the wheels' first message; exact to the nanosecond, which a double of unix time is not.

        DataError: they are of a topic of which no two messages are within the wheels' recording.
        """
        wheels = self.clock_stamps
        if topic is not None and ((stamps >= wheels[0]) & (stamps <= wheels[-1])).sum() < 2:
            spans = [f"{span[0] / SECOND:.3f} to {span[-1] / SECOND:.3f} s" for span in (stamps, wheels)]
            what = f"no two messages of {topic.name} while the wheels were recorded, by the stamps of their headers"
            shown = f"{topic.name} {spans[0]}, {self.clock_topic} {spans[1]}"
            way = f"set recorded_stamps=[{self.clock_topic},{topic.name}] to take the times of recording"
            raise DataError(f"{self.path}: {what} ({shown}); both must be stamped by one clock, or {way}")
        return np.asarray((stamps - wheels[0]) / SECOND)

    def timed(self, topic: Topic) -> list[tuple[float, Any]]:
        """Times, s, by the wheels' clock, and messages of a topic, in this order.

        A time is that of a header, or by when the message was recorded, as the wheels' messages have both.
        """
        order = np.argsort(self.clock_logged, kind="stable")
        logged, wheels = self.clock_logged[order], np.maximum.accumulate(self.clock_stamps[order])
        records = list(self.records(topic))
        stamps = np.array([topic.stamp(message, 0) for _, _, message in records], dtype=np.int64)
        recorded = np.array([when for _, when, _ in records], dtype=np.int64)
        by_recording = np.interp(recorded - logged[0], logged - logged[0], self.seconds(wheels))
        times = np.where(stamps != 0, self.seconds(stamps), by_recording)
        return [(float(times[row]), records[row][2]) for row in np.argsort(times, kind="stable")]

    def fields(self, kind: str, before: str = "") -> dict[str, str]:
        """Types of the numbers and messages within a type by their paths; of arrays the first element's."""
        types: dict[str, str] = {}
        definitions: Any = self._reader.typestore.fielddefs
        for name, (sort, detail) in definitions.get(kind, ((), ()))[1]:
            path = before + name
            if sort.name in ("ARRAY", "SEQUENCE"):
                path, (sort, detail) = f"{path}.0", detail[0]
            inner = detail if sort.name == "NAME" else detail[0]
            if inner not in _NO_VALUES:
                types |= {path: inner, **self.fields(inner, f"{path}.")}
        return types

    def numbers(self, topic: Topic) -> list[str]:
        """Paths of the numbers in a topic's messages."""
        return [path for path, kind in self.fields(topic.type).items() if "/" not in kind and kind != "bool"]

    def require_fields(self, topic: Topic, paths: Sequence[str], key: str) -> None:
        """ConfigError: the messages of a topic do not have the fields that the option ``key`` names."""
        fields, place = self.fields(topic.type), f"{self.path}: {key}: {topic.name} ({topic.type})"
        if topic.type not in self._reader.typestore.fielddefs:
            way = "give .msg files, or the folder of their package: --set message_definitions=FOLDER"
            raise ConfigError(f"{place}: the bag does not define its messages; {way}")
        for path in paths:
            if re.sub(r"\.\d+", ".0", path) not in fields:
                numbers = ", ".join(self.numbers(topic)) or "none"
                raise ConfigError(f"{place} has no field {path!r}; {nearest(path, fields)}its numbers: {numbers}")

    def transforms(self, topic: Topic) -> Iterator[tuple[str, str, Any]]:
        """Frame, parent and transform from the frame to its parent, of all messages of a topic."""
        for _, _, message in self.records(topic):
            for each in getattr(message, "transforms", ()):
                yield each.child_frame_id.strip("/"), each.header.frame_id.strip("/"), each.transform

    def fixed_transforms(self) -> dict[str, tuple[str, Array]]:
        """Parent of every frame of /tf_static, and the transform (4, 4) from the frame to its parent."""
        from scipy.spatial.transform import RigidTransform, Rotation  # slow, and needed by bags with transforms alone

        parents: dict[str, tuple[str, Array]] = {}
        for topic in self.of_type(TRANSFORMS):
            for child, parent, transform in self.transforms(topic) if topic.name.endswith("tf_static") else ():
                turn, place = transform.rotation, transform.translation
                try:
                    rotation = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
                except ValueError:  # all zeros: no rotation, and so no transform
                    continue
                matrix = RigidTransform.from_components([place.x, place.y, place.z], rotation).as_matrix()
                if np.isfinite(matrix).all():
                    parents[child] = parent, matrix
        return parents


def way_up(frame: str, parents: Mapping[str, str], ends: Callable[[str], bool]) -> list[str] | None:
    """Frames from one up to below the first that ``ends`` the way; None if none does."""
    links: list[str] = []
    while not ends(frame):
        if frame not in parents or frame in links:
            return None
        links.append(frame)
        frame = parents[frame]
    return links


@contextmanager
def open_bag(path: Path, notes: Notes, recorded: Sequence[str] = (), definitions: Sequence[Path] = ()) -> Iterator[Bag]:
    """Open a bag for reading. DataError in one line: it is no bag, it is cut off, or it is damaged.

    notes, recorded: as for ``Bag``. definitions: files or folders of .msg files, of types that the bag does not define.
    """
    # Imported here, since they load slowly and `omnibench list` does without.
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    # Bags before ROS 2 Iron do not hold the definitions of their types; those of ROS itself hardly ever changed.
    store, given = get_typestore(Stores.ROS2_HUMBLE), dict[str, Any]()
    for place in definitions:
        for file in sorted(place.rglob("*.msg")) if place.is_dir() else [place]:
            # PACKAGE/msg/NAME.msg or PACKAGE/NAME.msg
            folder, text = file.resolve().parent, read_text(file)
            package = folder.parent.name if folder.name == "msg" else folder.name
            try:
                given |= get_types_from_msg(text, f"{package}/msg/{file.stem}")
            except Exception as error:  # rosbags' parser raises several types
                raise DataError(f"{file}: cannot be read as the definition of a message: {error}") from None
    store.fielddefs |= given
    with _damage_as_error(path):
        for file in sorted(path.iterdir()) if path.is_dir() else [path]:
            if file.name == _METADATA:
                read_yaml(file)  # within limits, which rosbags has not
            elif not file.is_dir():
                check_file(file)
        reader = AnyReader([path], default_typestore=store)
        reader.open()
        if given:  # and types of ROS that they are made of
            read = reader.typestore.fielddefs
            reader.typestore.register({name: fields for name, fields in store.fielddefs.items() if name not in read})
    try:
        yield Bag(path, reader, recorded, definitions, notes)
    finally:
        reader.close()


def find_bags(source: Path) -> dict[str, Path]:
    """Bags by name: the file or rosbag2 folder ``source``, or all bags below the folder ``source``. DataError."""
    if source.is_file() or (source / _METADATA).is_file():
        return {source.resolve().stem if source.is_file() else source.resolve().name: source}
    folders = [file.parent for file in source.rglob(_METADATA)]
    files = [file for file in source.rglob("*") if file.suffix in _SUFFIXES and file.is_file()]
    bags = [*folders, *(file for file in files if not any(file.is_relative_to(folder) for folder in folders))]
    if not bags:
        raise DataError(f"{source}: no bag below it; name an .mcap or .bag file, or the folder of a rosbag2 recording")
    names = {bag: bag if bag.is_dir() else bag.with_suffix("") for bag in sorted(bags)}
    return {name.relative_to(source).as_posix(): bag for bag, name in names.items()}


def _repair(path: Path) -> str:
    return f"if the recording broke off, {_REPAIR.get(path.suffix, '`ros2 bag reindex` may repair it')}"


@contextmanager
def _damage_as_error(path: Path) -> Iterator[None]:
    """Turn any error of rosbags on a file that is no bag, or a damaged one, into a DataError."""
    try:
        yield
    except OmnibenchError as error:
        raise DataError(str(error)) from None
    except PermissionError:
        raise DataError(f"{path}: cannot be read: permission denied") from None
    except Exception as error:  # struct.error, TypeError, KeyError, ...: rosbags trusts what it reads
        reason = str(error) if type(error).__module__.startswith("rosbags.") else f"{type(error).__name__}: {error}"
        raise DataError(f"{path}: cannot be read as a bag: {reason.rstrip('.')}; {_repair(path)}") from None


def reader_of(paths: Sequence[str]) -> Callable[[Any], list[float]]:
    """A function that gives the numbers at dotted paths in a message, such as ``status.wheels.0.angle``."""
    parts = [re.split(r"\.(?=\d)|(?<=\d)\.", path) for path in paths]
    steps = [[itemgetter(int(part)) if part.isdecimal() else attrgetter(part) for part in path] for path in parts]
    return lambda message: [float(reduce(lambda value, step: step(value), path, message)) for path in steps]


class TopicMessages:
    """The messages of a topic. Useless ones are left out and counted by reason, the others sorted by their stamps.

    contents: what ``read`` gives of each part of a message, by default the whole; None is of something else. numbers,
    stamps, logged (K,): from 1, and ns. rows: indices of the messages that remain. Messages without a header, and those
    of topics for which it is asked, have the times of recording as stamps.
    """

    def __init__(self, bag: Bag, topic: Topic, read: Reader, parts: Reader = lambda message: [message]) -> None:
        self.place = f"{bag.path}: topic {topic.name}"
        self.contents: list[Any] = []
        self._bag, self._topic, self._headless = bag, topic, False
        self._left_out: dict[str, list[int]] = defaultdict(list)  # numbers of messages, by why
        stamped = []
        for number, logged, message in bag.records(topic):
            try:
                for part in parts(message):
                    content, stamp = read(part), topic.stamp(part, logged)
                    if content is not None and stamp > 0:
                        self.contents.append(content)
                        stamped.append((number, stamp, logged))
                        self._headless |= not hasattr(part, "header")
                    elif content is not None:
                        self._left_out[_NO_STAMP].append(number)
            except (AttributeError, IndexError, TypeError, ValueError):  # garbage, or a type that is defined otherwise
                self._left_out["that cannot be decoded"].append(number)
        self.numbers, self.stamps, self.logged = np.array(stamped, dtype=np.int64).reshape(-1, 3).T
        self.rows = np.arange(len(stamped))

    def table(self, columns: int) -> Array:
        """The contents as numbers (K, columns)."""
        return np.array(self.contents, dtype=float).reshape(-1, columns)

    def keep(self, good: NDArray[np.bool_], reason: str) -> None:
        """Drop the messages that are not good (K,) for ``reason``."""
        if len(dropped := self.numbers[self.rows[~good[self.rows]]]):
            self._left_out[reason] += dropped.tolist()
        self.rows = self.rows[good[self.rows]]

    def keep_planar(self, quaternions: Array) -> Array:
        """Headings (K,), rad, of the quaternions (K, 4) of all messages, of which those that are flawed are dropped."""
        orientations = planar_headings(quaternions)
        flawed = self.rows[orientations.flawed[self.rows]]
        flaw = f", as {orientations.flaw(int(flawed[0]))}" if len(flawed) else ""
        self.keep(~orientations.flawed, f"with a wrong orientation{flaw}")
        return orientations.headings

    def in_order(self, way_out: str = "") -> NDArray[np.intp]:
        """Indices of the messages that remain, sorted by stamp, without repeated stamps.

        The bag's notes tell what is left out. DataError: the clock was set back, more messages were dropped than
        remain, or fewer than two remain. way_out: what to do where these have stamps.
        """
        stamps = self.stamps[self.rows]
        behind = np.maximum.accumulate(stamps) - stamps
        if (behind > SECOND).sum() > _MOST_SET_BACK:
            first = int(np.argmax(behind > SECOND))
            back = f"the stamps go back by {behind[first] / SECOND:.3g} s and stay behind"
            why = "the clock was set back, or two recordings share the bag; split it there"
            raise DataError(f"{self.place}, message {self.numbers[self.rows[first]]}: {back}: {why}")
        self.rows = self.rows[np.argsort(stamps, kind="stable")]
        fresh = np.zeros(len(self.contents), dtype=bool)
        fresh[self.rows] = np.diff(self.stamps[self.rows], prepend=-1) > 0
        self.keep(fresh, "with a repeated stamp")
        total, count = plural(self._topic.messages, "message"), sum(map(len, self._left_out.values()))
        reasons = [f"{len(each)} {reason} (first: message {each[0]})" for reason, each in self._left_out.items()]
        words = [f"{count} of {total} left out: {', '.join(reasons)}"] if count else []
        if len(self.rows) < max(2, count):
            if _NO_STAMP in self._left_out:
                topics = ",".join(each.name for each in self._bag.topics if each.recorded or each == self._topic)
                anew = "record it anew: the publisher must fill header.stamp"
                way_out = f"set recorded_stamps=[{topics}] to take the times of recording, or {anew}"
            problem = words[0] if count else f"it has {total}, too few"
            raise DataError(f"{self.place}: {problem}{'; ' if way_out else ''}{way_out}")
        if self._headless:
            words.append("its messages have no stamps; they have the times of recording")
        if late := int(np.count_nonzero(behind)):
            words.append(f"{plural(late, 'message')} recorded late, and sorted by stamp")
        notes = self._bag.notes
        notes += [note for note in (f"{self.place}: {word}" for word in words) if note not in notes]
        return self.rows


def possible(values: Array, largest: float = LARGEST) -> NDArray[np.bool_]:
    """True for rows of values (F, n) that are finite, and smaller than anything real."""
    return np.asarray((np.abs(values) < largest).all(axis=1))


def read_scans(bag: Bag, topic: Topic, mount: Mount | None) -> ScanReadings:
    """Check every scan of a topic. DataError, or ConfigError: it is no scanner.

    mount: of the scanner; None: by /tf_static. The stamp of a scan is that of its first ray.
    """
    messages, notes = TopicMessages(bag, topic, _laser_scan), bag.notes
    place, scans = messages.place, messages.contents
    shape = scans[0][0] if scans else ScanShape(0, 0, 0, 0, 0)
    for number, (other, *_) in zip(messages.numbers, scans, strict=True):
        if difference := scan_difference(shape, other):
            alike = "all scans must be of one scanner, of one number of rays"
            raise DataError(f"{place}, message {number}: {difference} as in the messages before; {alike}")
    empty = f"without a range from {shape.range_min:g} to {shape.range_max:g} m"
    messages.keep(np.array([seen for _, seen, *_ in scans], dtype=bool), empty)
    rows = messages.in_order()
    _, _, frame, _, scan_time = scans[0]
    # The scanner's time between rays, s: the median of its scans.
    increments = np.array([increment for _, _, _, increment, _ in scans])
    increment = float(np.median(increments))
    if np.abs(increments - increment).max() > _SAME_INCREMENT * abs(increment):
        varies = f"time_increment varies from {increments.min():.3g} to {increments.max():.3g} s"
        notes.append(f"{place}: {varies}; its median, {increment:.3g} s, is taken")
    if increment == 0 and scan_time > 0:
        instant = "time_increment is 0, so that each scan counts as taken at one instant"
        notes.append(f"{place}: {instant}, though scan_time is {scan_time:.3g} s")
    mount, sense = (mount, 1) if mount else _mounting(bag, frame, place)
    angles = {"angle_min": sense * shape.angle_min, "angle_increment": sense * shape.angle_increment}
    content = {"name": topic.name, "time_increment": increment, "mount": mount, **shape._asdict(), **angles}
    scanner = validate(Scanner, content, place)
    stamps, logged = messages.stamps[rows], messages.logged[rows]

    def read(chosen: NDArray[np.intp]) -> Ranges:
        """The ranges of some scans. DataError: the bag has changed since it was opened."""
        keys = zip(logged[chosen].tolist(), stamps[chosen].tolist(), strict=True)
        places = {key: index for index, key in enumerate(keys)}
        ranges = np.empty((len(chosen), scanner.rays), np.float32)
        with open_bag(bag.path, [], [topic.name] if topic.recorded else [], bag.definitions) as again:
            between = int(logged[chosen].min()), int(logged[chosen].max())
            for _, when, message in again.records(again.topic(topic.name, "scan_topic"), between):
                index = places.pop((when, topic.stamp(message, when)), None)
                if index is not None and len(message.ranges) == scanner.rays:
                    ranges[index] = _measured(message)
        if places:
            raise DataError(f"{place}: the bag has changed since it was opened; import it again")
        return ranges

    return ScanReadings(scanner, place, bag.seconds(stamps, topic), read)


def _laser_scan(message: Any) -> tuple[ScanShape, bool, str, float, float]:
    """Shape of a scan, whether any range is a measurement, its frame, time between its rays (s), its duration (s)."""
    range_max = float(message.range_max)
    if not np.isfinite(range_max):  # some drivers give no limit
        range_max = float(np.finfo(np.float32).max)
    angles = float(message.angle_min), float(message.angle_increment)
    shape = ScanShape(len(message.ranges), *angles, float(message.range_min), range_max)
    seen = bool(np.isfinite(_measured(message)).any())
    return shape, seen, message.header.frame_id, float(message.time_increment), float(message.scan_time)


def _measured(message: Any) -> Ranges:
    """The ranges of a scan (R,), m; inf for NaN, 0 and values out of the scanner's range, which are no measurements."""
    ranges = np.asarray(message.ranges, dtype=np.float32)
    good = (ranges >= message.range_min) & (ranges <= message.range_max) & (ranges > 0)  # False for NaN
    return np.where(good, ranges, np.float32(np.inf))


def _mounting(bag: Bag, frame: str, place: str) -> tuple[Mount, int]:
    """The mount of a scanner by /tf_static, or the robot's middle; and -1 if it hangs upside down, else 1.

    Counter-clockwise rays of one that hangs upside down run clockwise in the robot's frame. DataError: it is tilted.
    """
    fixed, whole = bag.fixed_transforms(), np.eye(4)
    parents = {child: parent for child, (parent, _) in fixed.items()}
    links = way_up(frame.strip("/"), parents, lambda child: child.rpartition("/")[2] in _BASES)
    if links is None:
        unknown = f"it is unknown where the scanner ({frame or 'a frame without a name'}) is mounted"
        way = "--set 'scanner_mount={x: 0.1, y: 0, yaw: 0}' (m, rad)"
        bag.notes.append(f"{place}: {unknown} (no /tf_static from base_link); the robot's middle is taken; {way}")
        return Mount(), 1
    for link in links:
        whole = fixed[link][1] @ whole
    tilt = math.acos(np.clip(whole[2, 2], -1.0, 1.0))
    if min(tilt, math.pi - tilt) > _LARGEST_TILT:
        tilted = f"the scanner's frame {frame} is tilted by {math.degrees(tilt):.0f} degrees, so that it does not scan"
        raise DataError(f"{bag.path}: {tilted} the plane of the floor; if it does, set scanner_mount")
    yaw = math.atan2(whole[1, 0], whole[0, 0])
    return Mount(x=float(whole[0, 3]), y=float(whole[1, 3]), yaw=yaw), -1 if tilt > math.pi / 2 else 1
