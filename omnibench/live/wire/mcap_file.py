"""An MCAP file of ROS 2 messages that can be read at any time, even if its writer was killed or the disk was full.

Each ``flush`` writes a chunk followed by the end of a file without an index, in one call; the next chunk overwrites
that end. The file is therefore valid after each flush, and rosbags, mcap and Foxglove open it whatever happens to the
writer. ``complete`` adds the index.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, Writer

from omnibench.errors import DataError
from omnibench.live.wire.messages import MessageType


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
            self._channels[name] = self._writer.register_channel(name, "cdr", self._schema(kind))
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

    def _schema(self, kind: MessageType[Any]) -> int:
        if kind.name not in self._schemas:
            self._schemas[kind.name] = self._writer.register_schema(kind.name, "ros2msg", kind.definition.encode())
        return self._schemas[kind.name]


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
