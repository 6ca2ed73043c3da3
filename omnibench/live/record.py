"""Robots' topics recorded into an MCAP file, which Foxglove, rosbags and mcap-ros2-support open."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Event, Thread
from typing import Any, Final

import zenoh
from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, Writer

from omnibench.errors import DataError
from omnibench.live.stopping import Closing
from omnibench.live.topics import TOPICS, Arrival, KeySpace, TopicListener
from omnibench.live.wire import MessageError, MessageType

_FLUSH_PERIOD: Final = 1.0  # s between two flushes; at most so much is lost when the process is killed
_POLL_PERIOD: Final = 0.02  # s between two looks at the queue; waking up for each message costs four times as much
_BATCH: Final = 16  # messages, about 0.2 ms, written before the thread lets others run
_LONGEST_QUEUE: Final = 200_000  # messages, about 150 MB, that wait while the disk does not write

_log = logging.getLogger(__name__)


class QueuedListener(Closing):
    """A topic listener whose messages wait for a thread that iterates over them; None after each batch.

    The iteration ends after ``close``, with what has arrived until then. lost: messages dropped because the queue was
    full. missed: messages that were published and never came, by ROS topic. closed: set when the iteration is to end.
    Errors: as of `TopicListener`.
    """

    def __init__(
        self, session: zenoh.Session, keys: KeySpace, robots: Sequence[str], topics: Sequence[str] = tuple(TOPICS)
    ) -> None:
        self.lost = 0
        self._waiting: SimpleQueue[Arrival] = SimpleQueue()
        self.closed = Event()
        self._listener = TopicListener(session, keys, robots, topics, self._take)

    @property
    def missed(self) -> dict[str, int]:
        return self._listener.missed

    def __iter__(self) -> Iterator[Arrival | None]:
        closed = False
        while not closed:
            closed = self.closed.wait(_POLL_PERIOD)
            with suppress(Empty):
                while True:
                    for _ in range(_BATCH):
                        yield self._waiting.get_nowait()
                    time.sleep(0)  # lets the node's other threads run
            yield None

    def close(self) -> None:
        self._listener.close()
        self.closed.set()

    def _take(self, arrival: Arrival) -> None:
        if self._waiting.qsize() >= _LONGEST_QUEUE:
            self.lost += 1
        elif not self.closed.is_set():
            self._waiting.put(arrival)


class _McapFile:
    """An MCAP file that is valid after each ``flush``, whatever happens to its writer; it must not exist yet.

    mcap's writer writes to this object, which holds its data back. A flush writes them with the end of a file without
    an index behind them, which the next flush overwrites: rosbags refuses a file without an end. DataError: the file
    exists or cannot be made. OSError from ``flush``: the disk is full or gone; the file is as the flush before left it.
    """

    def __init__(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("xb", buffering=0)
        except FileExistsError:
            where = path if path.exists() else path.parent
            raise DataError(f"{where}: exists already; name another file or remove it") from None
        except OSError as error:
            raise DataError(f"{path}: cannot be written: {error.strerror or error}; choose another folder") from None
        ending = RecordBuilder()
        DataEnd(0).write(ending)
        Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(ending)
        self._ending = ending.end() + MCAP0_MAGIC
        self._waiting = bytearray()  # data that are not in the file yet
        self._end = 0  # bytes in the file, without its ending
        self.size = 0  # with it
        stream: Any = self
        self.mcap = Writer(stream)
        self.mcap.start(profile="ros2", library="omnibench")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def add(self, name: str, kind: MessageType[Any], payload: bytes, log_time: int, publish_time: int) -> None:
        """Add a message of the ROS topic ``name`` in CDR. Times in ns, >= 0."""
        if name not in self._channels:
            if kind.name not in self._schemas:
                self._schemas[kind.name] = self.mcap.register_schema(kind.name, "ros2msg", kind.definition.encode())
            self._channels[name] = self.mcap.register_channel(name, "cdr", self._schemas[kind.name])
        self.mcap.add_message(self._channels[name], log_time, payload, publish_time)

    @property
    def chunk_complete(self) -> bool:
        """True if data wait for a flush."""
        return bool(self._waiting)

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self._end + len(self._waiting)

    def flush(self, *, complete: bool = False) -> None:
        """Bring the chunks that are complete into the file."""
        try:
            self._put(bytes(self._waiting) + (b"" if complete else self._ending))
        except OSError:
            with suppress(OSError):
                self._put(self._ending)
                self._file.truncate()
            raise
        self._end += len(self._waiting)
        self._waiting.clear()

    def complete(self) -> None:
        """Write what waits and then the index, by which readers find their way in a large file."""
        self.mcap.flush()
        self.mcap.finish()
        self.flush(complete=True)

    def close(self) -> None:
        self._file.close()

    def _put(self, data: bytes) -> None:
        self._file.seek(self._end)
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]
        self.size = self._file.tell()


class Recorder(Closing):
    """Records the robots' topics from its construction to ``close``; payloads are not changed.

    Log times are times of arrival, publish times the stamps in the messages' headers. If writing fails, only the
    recording ends: ``failure`` and ``on_failure`` (by default the log) get one line, and what was recorded stays
    readable.

    counts: messages written, by ROS topic. undecodable: payloads that are not of their topic's type and were left out,
    by ROS topic. missed: messages that were published and never came, by ROS topic. lost: messages dropped because the
    queue was full while the disk did not write.

    ConfigError: a robot's name or a topic is not valid. DataError: ``path`` exists already or cannot be written.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: KeySpace,
        robots: Sequence[str],
        path: Path,
        topics: Sequence[str] = tuple(TOPICS),
        on_failure: Callable[[str], object] = _log.error,
    ) -> None:
        self.path = path
        self.counts: Counter[str] = Counter()
        self.undecodable: Counter[str] = Counter()
        self.failure: str | None = None
        self._on_failure = on_failure
        self._robots = robots
        self._listener = QueuedListener(session, keys, robots, topics)
        try:
            self._file = _McapFile(path)
        except DataError:
            self._listener.close()
            raise
        self._thread = Thread(target=self._run, name="omnibench-recorder", daemon=True)
        self._thread.start()

    @property
    def messages(self) -> int:
        """Messages written."""
        return self.counts.total()

    @property
    def lost(self) -> int:
        """Messages dropped because the queue was full."""
        return self._listener.lost

    @property
    def missed(self) -> Counter[str]:
        """Messages that were published and never came, by ROS topic."""
        return Counter(self._listener.missed)

    @property
    def silent_robots(self) -> list[str]:
        """The robots from which nothing has arrived yet."""
        names = self.counts.keys() | self.undecodable.keys()
        return [robot for robot in self._robots if not any(name.startswith(f"/{robot}/") for name in names)]

    @property
    def bytes(self) -> int:
        """The file's size so far."""
        return self._file.size

    def close(self) -> None:
        """Write what has arrived, and complete the file. Closing twice does no harm."""
        self._listener.close()
        self._thread.join()

    def _run(self) -> None:
        file, flush_at = self._file, time.monotonic() + _FLUSH_PERIOD
        try:
            file.mcap.flush()  # an empty file is valid too
            for arrival in self._listener:
                if arrival is not None:
                    self._add(arrival)
                if file.chunk_complete or time.monotonic() >= flush_at:
                    file.mcap.flush()
                    flush_at = time.monotonic() + _FLUSH_PERIOD
            file.complete()
        except OSError as error:
            self._listener.closed.set()
            reason = error.strerror or str(error)
            self.failure = (
                f"{self.path}: cannot be written: {reason}; the recording ends here, and what it holds can be read"
            )
            self._on_failure(self.failure)
        finally:
            file.close()

    def _add(self, arrival: Arrival) -> None:
        """Add a message; its publish time is the stamp in its header, or else the time of its arrival."""
        kind, stamp = TOPICS[arrival.topic], -1
        try:
            content = kind.parse(arrival.payload)
        except MessageError:
            self.undecodable[arrival.name] += 1
            return
        if arrival.topic == "tf":
            content = content.transforms[0] if content.transforms else None
        if content is not None:
            stamp = int(content.header.stamp.sec) * 1_000_000_000 + int(content.header.stamp.nanosec)
        published = arrival.time if stamp < 0 else stamp
        self._file.add(arrival.name, kind, arrival.payload, arrival.time, published)
        self.counts[arrival.name] += 1


def free_path(path: Path) -> Path:
    """``path`` or, if it exists, a path with the time added to its name, so that a restarted node records too."""
    if not path.exists():
        return path
    return path.with_name(f"{path.stem}-{time.strftime('%Y%m%d-%H%M%S')}{path.suffix}")
