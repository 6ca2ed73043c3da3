"""Results of a study in a file, a line of JSON each: run again with the same file, the study goes on where it was."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import TypeAdapter

from omnibench.processes import one_thread

T = TypeVar("T")


class ResultsFile(Generic[T]):
    """The results that are there, and those that are added. A last line that was cut off is left out.

    path: None for results that are not kept. kind: their class, a dataclass or a document.
    """

    def __init__(self, path: Path | None, kind: type[T]) -> None:
        self._path, self._adapter = path, TypeAdapter(kind)
        written = path.read_bytes() if path is not None and path.exists() else b""
        whole = written[: written.rfind(b"\n") + 1]
        if path is not None and whole != written:
            path.write_bytes(whole)
        self.results = [self._adapter.validate_json(line) for line in whole.splitlines()]

    def add(self, result: T) -> None:
        """Add a result, at once to the file, too."""
        self.results.append(result)
        if self._path is not None:
            with self._path.open("a") as file:
                file.write(json.dumps(self._adapter.dump_python(result, mode="json")) + "\n")


def in_processes(function: Callable[..., T], tasks: Iterable[tuple[Any, ...]], jobs: int) -> Iterator[T]:
    """The results of a function for each tuple of arguments, as they come."""
    with one_thread(), ProcessPoolExecutor(jobs) as pool:
        for done in as_completed([pool.submit(function, *task) for task in tasks]):
            yield done.result()
