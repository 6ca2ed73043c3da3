"""Reading of bags (MCAP, rosbag2 and ROS 1) with the library rosbags; every fault is one line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omnibench.config import read_yaml
from omnibench.errors import ConfigError, DataError, UnknownNameError
from omnibench.files import check_file
from omnibench.words import plural

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_SUFFIXES = (".mcap", ".db3", ".bag")
_METADATA = "metadata.yaml"
_REPAIR = {
    ".mcap": "if the recording broke off, `mcap recover` saves what is there",
    ".bag": "if the recording broke off, `rosbag reindex` saves what is there",
}


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


@dataclass(frozen=True)
class Record:
    """A recorded message. number: in its topic, from 1. logged: time of recording, ns. message: None if undecodable."""

    number: int
    logged: int
    message: Any


class Bag:
    """An open bag; see :func:`open_bag`."""

    def __init__(self, path: Path, reader: AnyReader, recorded: Sequence[str] = ()) -> None:
        self.path = path
        self._reader = reader
        counts: Counter[tuple[str, str]] = Counter()
        for connection in reader.connections:
            counts[connection.topic, _full_type(connection.msgtype)] += connection.msgcount
        self.topics = tuple(Topic(*names, count) for names, count in sorted(counts.items()))
        unstamped = {self.topic(name, "recorded_stamps").name for name in recorded}
        self.topics = tuple(replace(topic, recorded=topic.name in unstamped) for topic in self.topics)

    def topic(self, name: str, key: str) -> Topic:
        """The topic that the option ``key`` names, with or without its leading slash. UnknownNameError, DataError."""
        wanted = "/" + name.strip("/")
        named = [topic for topic in self.topics if "/" + topic.name.strip("/") == wanted]
        if not named:
            raise UnknownNameError("topic", name, {topic.name for topic in self.topics}, f"{self.path}: {key}")
        chosen = max(named, key=lambda topic: topic.messages)
        if chosen.messages == 0:
            raise DataError(f"{self.path}: {key}: topic {chosen.name} has no messages; record it, or name another one")
        return chosen

    def records(self, topic: Topic, first: int | None = None, last: int | None = None) -> Iterator[Record]:
        """The messages of a topic in the order in which they were recorded. DataError: the bag is damaged.

        first, last: times of recording, ns, between which messages are read; numbers then count from the first of
        these.
        """
        connections = [
            connection
            for connection in self._reader.connections
            if (connection.topic, _full_type(connection.msgtype)) == (topic.name, topic.type)
        ]
        number = 0
        with _damage_as_error(self.path):
            stop = None if last is None else last + 1
            for number, (connection, logged, data) in enumerate(self._reader.messages(connections, first, stop), 1):
                yield Record(number, logged, self._decoded(data, _full_type(connection.msgtype)))
        if first is None and last is None and number < topic.messages:  # an MCAP without its message indexes
            raise DataError(
                f"{self.path}: only {number} of {plural(topic.messages, 'message')} on {topic.name} can be found; "
                f"its index is damaged; {_repair(self.path)}"
            )

    def _decoded(self, data: bytes, kind: str) -> Any | None:
        try:
            return self._reader.deserialize(data, kind)
        except Exception:  # garbage fails in many ways
            return None


@contextmanager
def open_bag(path: Path, recorded: Sequence[str] = ()) -> Iterator[Bag]:
    """Open a bag for reading. DataError in one line: it is no bag, it is cut off, or it is damaged.

    recorded: names of topics of which the times of recording count. UnknownNameError: there is no such topic.
    """
    # Imported here, since they load slowly and `omnibench list` does without.
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if path.is_dir() and (path / _METADATA).exists():
        try:
            read_yaml(path / _METADATA)  # within limits, which rosbags has not
        except ConfigError as error:
            raise DataError(str(error)) from None
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if not file.is_dir():
            check_file(file)
    with _damage_as_error(path):
        # Bags before ROS 2 Iron do not hold the definitions of their types; those used here never changed.
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    try:
        yield Bag(path, reader, recorded)
    finally:
        reader.close()


def find_bags(source: Path) -> dict[str, Path]:
    """Bags by name: the file or rosbag2 folder ``source``, or all bags below the folder ``source``. DataError."""
    if source.is_file() or (source / _METADATA).is_file():
        return {source.resolve().stem if source.is_file() else source.resolve().name: source}
    if not source.is_dir():
        raise DataError(f"{source}: no such file or folder")
    folders = [file.parent for file in source.rglob(_METADATA)]
    files = [file for file in source.rglob("*") if file.suffix in _SUFFIXES and file.is_file()]
    bags = [*folders, *(file for file in files if not any(file.is_relative_to(folder) for folder in folders))]
    if not bags:
        raise DataError(f"{source}: no bag below it; name an .mcap or .bag file, or the folder of a rosbag2 recording")
    return {_name(path, source): path for path in sorted(bags)}


def _name(path: Path, source: Path) -> str:
    relative = path.relative_to(source)
    return (relative if path.is_dir() else relative.with_suffix("")).as_posix()


def _full_type(name: str) -> str:
    package, _, rest = name.partition("/")
    return f"{package}/msg/{rest}" if rest and "/" not in rest else name


def _repair(path: Path) -> str:
    return _REPAIR.get(path.suffix, "if the recording broke off, `ros2 bag reindex` may repair it")


@contextmanager
def _damage_as_error(path: Path) -> Iterator[None]:
    """Turn any error of rosbags on a file that is no bag, or a damaged one, into a DataError."""
    try:
        yield
    except PermissionError:
        raise DataError(f"{path}: cannot be read: permission denied") from None
    except Exception as error:  # struct.error, TypeError, KeyError, ...: rosbags trusts what it reads
        reason = str(error) if type(error).__module__.startswith("rosbags.") else f"{type(error).__name__}: {error}"
        raise DataError(f"{path}: cannot be read as a bag: {reason.rstrip('.')}; {_repair(path)}") from None
