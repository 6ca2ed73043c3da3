"""Objects that do not fit in memory together, in a temporary file that goes with the last of them."""

from __future__ import annotations

import pickle
import weakref
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np

from omnibench.errors import DataError


def temporary_file(ending: str) -> Any:
    """A new file in the folder of temporary files, which is removed with the object, or when Python ends. DataError."""
    try:
        file = NamedTemporaryFile(prefix="omnibench-", suffix=ending, delete=False)  # noqa: SIM115 (it outlives this)
    except OSError as error:
        raise DataError(f"no temporary file can be made: {error.strerror or error}; set TMPDIR to a folder") from None
    weakref.finalize(file, Path(file.name).unlink, missing_ok=True)
    return file


class Scratch(Sequence[Any]):
    """A temporary file that objects are appended to, each of which is read whenever it is asked for.

    path: of the file in another process, which only reads it.
    """

    def __init__(self, path: Path | None = None) -> None:
        if path is None:
            self._file = temporary_file(".scratch")
        self._path, self._offsets = path or Path(self._file.name), list[int]()

    def __reduce__(self) -> tuple[Any, ...]:
        return Scratch, (self._path,)

    def __getitem__(self, index: Any) -> Any:
        return self._read(self._offsets[index])

    def __len__(self) -> int:
        return len(self._offsets)

    def stored(self, value: Any) -> Callable[[], Any]:
        """A function that reads the value, which from now on lies in the file. DataError: the disk refuses."""
        self._offsets.append(self._file.tell())
        try:
            pickle.dump(value, self._file, protocol=pickle.HIGHEST_PROTOCOL)
            self._file.flush()
        except OSError as error:
            way = "set TMPDIR to a folder with more space"
            raise DataError(f"{self._path}: cannot be written: {error.strerror or error}; {way}") from None
        return partial(self._read, self._offsets[-1])

    def _read(self, offset: int) -> Any:
        """The object at an offset. DataError: the file is gone."""
        try:
            with self._path.open("rb") as file:
                file.seek(offset)
                value = pickle.load(file)
        except OSError as error:
            way = "the process that imports it has ended: save the data set, and load that"
            raise DataError(f"{self._path}: cannot be read: {error.strerror or error}; {way}") from None
        if isinstance(value, np.ndarray):  # with NumPy's own object for its type, so that asarray passes it on
            return value.view(np.dtype(value.dtype.str))
        return value

    def sequence(self, values: Iterable[Any]) -> Scratch:
        """The values, of which one is in memory at a time."""
        for value in values:
            self.stored(value)
        return self
