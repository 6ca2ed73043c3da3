"""Results of many jobs of one function, in memory: for work that needs them all at once and keeps none on the way."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

from omnibench.errors import DataError
from omnibench.jobs.job import Backend, Failure, Job, JobWatch, run_jobs
from omnibench.progress import Reporter, expect_reading, no_progress, tell_reading

T = TypeVar("T")


def gathered(
    backend: Backend | None,
    function: Callable[[Any, Reporter], T],
    arguments: Sequence[Any],
    shared: tuple[Any, ...] = (),
) -> list[T]:
    """Results of ``function`` (from the top of a module) for every argument, in their order; None: without jobs.

    Its results are not None. shared: see Job. DataError, or what the function raised: one of them has no result.
    """
    if backend is None:
        return [function(argument, no_progress) for argument in arguments]
    results: _Results[T] = _Results()
    expect_reading(len(arguments), "part")
    jobs = (Job(str(number), function, argument, shared=shared, own=True) for number, argument in enumerate(arguments))
    run_jobs(jobs, _InMemory[T](), backend, results)
    return [results.found[number] for number in range(len(arguments))]


class _InMemory(Generic[T]):
    """Results in memory, pickled until they are asked for, which is once."""

    def __init__(self) -> None:
        self._contents: dict[str, bytes] = {}

    def __reduce__(self) -> tuple[type[Self], tuple[()]]:
        return type(self), ()  # where results are made nobody needs the others

    def anchored(self) -> Self:
        return self

    def get(self, key: str) -> T | None:
        content = self._contents.pop(key, None)
        return pickle.loads(content) if isinstance(content, bytes) else None  # no text, which events may bring

    def keep(self, key: str, result: T) -> bytes:
        return self.content(key, result)

    def content(self, _: str, result: T) -> bytes:
        return pickle.dumps(result, pickle.HIGHEST_PROTOCOL)

    def put(self, key: str, result: T) -> None:
        self.put_content(key, self.content(key, result))

    def put_content(self, key: str, content: bytes) -> None:
        self._contents[key] = content

    def file(self, key: str) -> Path:
        return Path(key)


class _Results(JobWatch[T]):
    """The results, by number. The first failure ends the work."""

    def __init__(self) -> None:
        self.found: dict[int, T] = {}

    def ended(self, number: int, ending: T | Failure, reused: bool) -> None:  # noqa: ARG002
        if not isinstance(ending, Failure):
            self.found[number] = ending
            tell_reading(1, "part")
        elif ending.error is not None:
            raise ending.error
        else:
            raise DataError(f"one of many jobs has no result: {ending.reason}; run again")
