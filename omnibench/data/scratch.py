"""Objects that do not fit in memory together, in a temporary file that goes with the last of them."""

from __future__ import annotations

import pickle
import weakref
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any, Generic, TypeVar, overload

import numpy as np

from omnibench.errors import DataError

T = TypeVar("T")


def temporary_file(ending: str) -> Any:
    """A new file in the folder of temporary files, which is removed with the object, or when Python ends. DataError."""
    try:
        file = NamedTemporaryFile(prefix="omnibench-", suffix=ending, delete=False)  # noqa: SIM115 (it outlives this)
    except OSError as error:
        raise DataError(f"no temporary file can be made: {error.strerror or error}; set TMPDIR to a folder") from None
    weakref.finalize(file, Path(file.name).unlink, missing_ok=True)
    return file


class Scratch:
    """A temporary file that objects are appended to."""

    def __init__(self) -> None:
        self._file = temporary_file(".scratch")

    def stored(self, value: T) -> Stored[T]:
        """The value, which from now on lies in the file. DataError: the disk refuses."""
        path, offset = Path(self._file.name), self._file.tell()
        try:
            pickle.dump(value, self._file, protocol=pickle.HIGHEST_PROTOCOL)
            self._file.flush()
        except OSError as error:
            way = "set TMPDIR to a folder with more space"
            raise DataError(f"{path}: cannot be written: {error.strerror or error}; {way}") from None
        return Stored(path, offset, self)

    def sequence(self, values: Iterable[T]) -> StoredSequence[T]:
        """The values, of which one is in memory at a time."""
        return StoredSequence(tuple(self.stored(value) for value in values))


@dataclass(frozen=True)
class Stored(Generic[T]):
    """An object in a temporary file, which a call reads. scratch: keeps the file, in the process that made it."""

    path: Path
    offset: int
    scratch: Scratch | None = field(default=None, repr=False, compare=False)

    def __call__(self) -> T:
        """The object. DataError: the file is gone."""
        try:
            with self.path.open("rb") as file:
                file.seek(self.offset)
                value: T = pickle.load(file)
        except OSError as error:
            way = "the process that imports it has ended: save the data set, and load that"
            raise DataError(f"{self.path}: cannot be read: {error.strerror or error}; {way}") from None
        if isinstance(value, np.ndarray):  # with NumPy's own object for its type, so that asarray passes it on
            return value.view(np.dtype(value.dtype.str))
        return value

    def __reduce__(self) -> tuple[Any, ...]:
        return Stored, (self.path, self.offset)


@dataclass(frozen=True)
class StoredSequence(Sequence[T]):
    """Objects in a temporary file, each of which is read whenever it is asked for."""

    items: tuple[Stored[T], ...]

    @overload
    def __getitem__(self, index: int) -> T: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[T]: ...

    def __getitem__(self, index: int | slice) -> T | Sequence[T]:
        return StoredSequence(self.items[index]) if isinstance(index, slice) else self.items[index]()

    def __len__(self) -> int:
        return len(self.items)
