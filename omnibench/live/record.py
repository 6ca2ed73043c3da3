"""Live topics for other programs: recorded into an MCAP file that Foxglove, rosbags and mcap-ros2-support open.

`McapFile` can be read at any time, even if its writer was killed or the disk was full. Each ``flush`` writes a chunk
followed by the end of a file without an index, in one call; the next chunk overwrites that end. The file is therefore
valid after each flush, and rosbags, mcap and Foxglove open it whatever happens to the writer. ``complete`` adds the
index.

`FoxgloveServer` serves the same topics to the Foxglove application (foxglove-sdk, the extra ``foxglove``).
"""

from __future__ import annotations

import errno
import itertools
import logging
import os
import socket
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, Final

import zenoh
from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, Writer

from omnibench.errors import ConfigError, DataError
from omnibench.live.stopping import Closing
from omnibench.live.topics import TOPICS, Arrival, KeySpace, TopicListener
from omnibench.live.wire import MessageError, MessageType

if TYPE_CHECKING:
    from foxglove import Channel


class McapFile:
    """Writes ``path``, which must not exist yet. DataError: it exists or cannot be made.

    OSError from the other methods: writing failed (disk full or removed); what was flushed before stays readable.
    """

    def __init__(self, path: Path) -> None:
        self._stream = _Stream(path)
        stream: Any = self._stream
        self._writer = Writer(stream)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._writer.start(profile="ros2", library="omnibench")

    @property
    def size(self) -> int:
        """Size of the file, bytes."""
        return self._stream.size

    def write(self, name: str, kind: MessageType[Any], payload: bytes, *, log_time: int, publish_time: int) -> None:
        """Add a message of the ROS topic ``name`` in CDR. Times in ns, >= 0; log_time must not decrease."""
        if name not in self._channels:
            if kind.name not in self._schemas:
                self._schemas[kind.name] = self._writer.register_schema(kind.name, "ros2msg", kind.definition.encode())
            self._channels[name] = self._writer.register_channel(name, "cdr", self._schemas[kind.name])
        self._writer.add_message(self._channels[name], log_time, payload, publish_time)
        if self._stream.waiting:  # a chunk was full
            self._writer.flush()

    def flush(self) -> None:
        """Bring all messages so far into the file, which is valid then."""
        self._writer.flush()

    def complete(self) -> None:
        """Finish the file with its index, and close it."""
        try:
            self._writer.flush()
            self._writer.finish()
            self._stream.put(ending=b"")
        finally:
            self._stream.close()

    def close(self) -> None:
        """Close the file as the last flush left it, without an index."""
        self._stream.close()


def _ending() -> bytes:
    """The bytes at the end of a file without an index."""
    records = RecordBuilder()
    DataEnd(0).write(records)
    Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(records)
    return records.end() + MCAP0_MAGIC


_ENDING: Final = _ending()


class _Stream:
    """The stream that mcap's Writer writes to; holds data back until ``flush`` or ``put``."""

    def __init__(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        except FileExistsError:
            where = path if path.exists() else path.parent
            raise DataError(f"{where}: exists already; name another file or remove it") from None
        except OSError as error:
            raise DataError(f"{path}: cannot be written: {error.strerror or error}; choose another folder") from None
        self.waiting = bytearray()  # data that is not in the file yet
        self._end = 0  # position in the file at which its ending begins
        self.size = 0

    def write(self, data: bytes) -> int:
        self.waiting += data
        return len(data)

    def tell(self) -> int:
        return self._end + len(self.waiting)

    def flush(self) -> None:
        self.put(_ENDING)

    def put(self, ending: bytes) -> None:
        """Write the waiting data and an ending after it; if that fails (OSError), the file is as before."""
        try:
            self._write_at(self._end, bytes(self.waiting) + ending)
        except OSError:
            with suppress(OSError):
                self._write_at(self._end, _ENDING)
                os.ftruncate(self._file, self._end + len(_ENDING))
            raise
        self._end += len(self.waiting)
        self.waiting.clear()
        self.size = self._end + len(ending)

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _write_at(self, position: int, data: bytes) -> None:
        os.lseek(self._file, position, os.SEEK_SET)
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(self._file, rest) :]


_FLUSH_PERIOD: Final = 1.0  # s between two flushes; at most so much is lost when the process is killed
_POLL_PERIOD: Final = 0.02  # s between two looks at the queue; waking up for each message costs four times as much
_BATCH: Final = 16  # messages, about 0.2 ms, written before the thread lets others run
_LONGEST_QUEUE: Final = 200_000  # messages, about 150 MB, that wait while the disk does not write

_log = logging.getLogger(__name__)


class Recorder:
    """Records the robots' topics from ``start`` to ``stop`` (or as a context manager); payloads are not changed.

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
        self._on_failure = on_failure
        self.counts: Counter[str] = Counter()
        self.undecodable: Counter[str] = Counter()
        self.lost = 0
        self.failure: str | None = None
        self._session, self._keys = session, keys
        self._robots, self._topics = tuple(robots), tuple(topics)
        self._waiting: SimpleQueue[Arrival] = SimpleQueue()
        self._stopping = Event()
        self._file: McapFile | None = None
        self._listener: TopicListener | None = None
        self._thread = Thread(target=self._run, name="omnibench-recorder", daemon=True)

    @property
    def messages(self) -> int:
        """Messages written."""
        return self.counts.total()

    @property
    def missed(self) -> Counter[str]:
        """Messages that were published and never came, by ROS topic."""
        return Counter(self._listener.missed if self._listener else {})

    @property
    def silent_robots(self) -> list[str]:
        """The robots from which nothing has arrived yet."""
        names = self.counts.keys() | self.undecodable.keys()
        return [robot for robot in self._robots if not any(name.startswith(f"/{robot}/") for name in names)]

    @property
    def bytes(self) -> int:
        """The file's size so far."""
        return self._file.size if self._file else 0

    def start(self) -> None:
        """Begin to record."""
        listener = TopicListener(self._session, self._keys, self._robots, self._topics, self._take)
        try:
            self._file = McapFile(self.path)
        except DataError:
            listener.close()
            raise
        self._listener = listener
        self._thread.start()

    def stop(self) -> None:
        """Write what has arrived, and complete the file. Stopping twice does no harm."""
        if self._listener is None:
            return
        self._listener.close()
        self._stopping.set()
        self._thread.join()

    def __enter__(self) -> Recorder:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _take(self, arrival: Arrival) -> None:
        if self.failure is not None:
            return
        if self._waiting.qsize() < _LONGEST_QUEUE:
            self._waiting.put(arrival)
        else:
            self.lost += 1

    def _run(self) -> None:
        assert self._file is not None
        try:
            self._write(self._file)
            self._file.complete()
        except OSError as error:
            reason = error.strerror or str(error)
            self.failure = (
                f"{self.path}: cannot be written: {reason}; the recording ends here, and what it holds can be read"
            )
            self._file.close()
            self._on_failure(self.failure)

    def _write(self, file: McapFile) -> None:
        file.flush()
        flush_at = time.monotonic() + _FLUSH_PERIOD
        stopping = False
        while not stopping:
            stopping = self._stopping.wait(_POLL_PERIOD)
            for count in itertools.count(1):
                try:
                    arrival = self._waiting.get_nowait()
                except Empty:
                    break
                self._add(file, arrival)
                if count % _BATCH == 0:
                    time.sleep(0)  # lets the node's other threads run
            if time.monotonic() >= flush_at:
                file.flush()
                flush_at = time.monotonic() + _FLUSH_PERIOD

    def _add(self, file: McapFile, arrival: Arrival) -> None:
        kind = TOPICS[arrival.topic]
        try:
            stamp = _stamp(kind, arrival.payload)
        except MessageError:
            self.undecodable[arrival.name] += 1
            return
        file.write(
            arrival.name,
            kind,
            arrival.payload,
            log_time=arrival.time,
            publish_time=arrival.time if stamp is None or stamp < 0 else stamp,
        )
        self.counts[arrival.name] += 1


def free_path(path: Path) -> Path:
    """``path`` or, if it exists, a path with the time added to its name, so that a restarted node records too."""
    if not path.exists():
        return path
    return path.with_name(f"{path.stem}-{time.strftime('%Y%m%d-%H%M%S')}{path.suffix}")


def _stamp(kind: MessageType[Any], payload: bytes) -> int | None:
    """The stamp in a payload's header, ns; None if it has none. MessageError: the payload is not of this type."""
    content = kind.parse(payload)
    if kind is TOPICS["tf"]:
        if not content.transforms:
            return None
        content = content.transforms[0]
    stamp = content.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


PORT: Final = 8765  # the application's default
STOPPING_S: Final = 5.0  # how long ``close`` waits for its port; without load it is free after some milliseconds


class FoxgloveServer(Closing):
    """Serves the topics given to ``forward`` on ``host`` and ``port`` (0: any free port), until ``close``.

    By default only programs on this machine can connect, because the protocol has no password. A client that is too
    slow loses messages and delays no other.

    ConfigError: foxglove-sdk is not installed, the port is in use, or the host is not an address of this machine.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = PORT) -> None:
        try:
            import foxglove
        except ImportError:
            raise ConfigError(
                'the Foxglove server needs the package foxglove-sdk: pip install "foxglove-sdk"'
            ) from None
        if not 0 <= port <= 65535:
            raise ConfigError(f"Foxglove server: port {port}: expected 0 to 65535")
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(name="omnibench", host=host, port=port, context=self._context)
        except (RuntimeError, OSError) as error:
            reason = str(error).removeprefix("FoxgloveError: ")
            raise ConfigError(
                f"Foxglove server on {host}:{port}: {reason}; close what uses it or choose another host or port"
            ) from None
        self._host, self._port = host, int(self._server.port)
        self.address = f"ws://{host}:{self._port}"
        self._channels: dict[str, Channel] = {}
        self._listeners: list[TopicListener] = []

    def forward(
        self, session: zenoh.Session, keys: KeySpace, robots: Sequence[str], topics: Sequence[str] = tuple(TOPICS)
    ) -> None:
        """Serve the robots' topics from now on, payloads unchanged. ConfigError: no such topic."""
        import foxglove

        listener = TopicListener(session, keys, robots, topics, self._forward)
        for name, topic in listener.topics.items():
            kind = TOPICS[topic]
            schema = foxglove.Schema(name=kind.name, encoding="ros2msg", data=kind.definition.encode())
            self._channels[name] = foxglove.Channel(name, schema=schema, message_encoding="cdr", context=self._context)
        self._listeners.append(listener)

    @property
    def missed(self) -> int:
        """Messages that were published and never came here, so that no client got them."""
        return sum(sum(listener.missed.values()) for listener in self._listeners)

    def close(self) -> None:
        """Stop serving, and return when another server can have the port."""
        for listener in self._listeners:
            listener.close()
        self._server.stop()  # asks the server's threads to stop, and does not wait for them
        end = time.monotonic() + STOPPING_S
        while _in_use(self._host, self._port) and time.monotonic() < end:
            time.sleep(0.002)

    def _forward(self, arrival: Arrival) -> None:
        channel = self._channels.get(arrival.name)
        if channel is not None:
            channel.log(arrival.payload, log_time=arrival.time)


def _in_use(host: str, port: int) -> bool:
    """True if a program listens there, whatever the state of the connections that it had."""
    try:
        socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError as error:
        return error.errno == errno.EADDRINUSE
    return False
