"""Results of many jobs of one function, in memory: for work that needs them all at once and keeps none on the way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from omnibench.errors import DataError
from omnibench.jobs.job import Backend, Failure, Job, JobWatch, run_jobs
from omnibench.jobs.result_store import ResultStore
from omnibench.progress import Reporter, no_progress, tell_reading

T = TypeVar("T")


def gathered(
    backend: Backend | None,
    function: Callable[[Any, Reporter], T],
    arguments: Sequence[Any],
    kind: type[T],
    shared: tuple[Any, ...] = (),
) -> list[T]:
    """Results of ``function`` (from the top of a module) for every argument, in their order; None: without jobs.

    kind, shared: see ResultStore and Job. DataError, or what the function raised: one of them has no result.
    """
    if backend is None:
        return [function(argument, no_progress) for argument in arguments]
    results: _Results[T] = _Results()
    with TemporaryDirectory(prefix="omnibench-") as folder:
        jobs = (Job(str(number), function, argument, shared=shared) for number, argument in enumerate(arguments))
        run_jobs(jobs, ResultStore(Path(folder), kind), backend, results)
    return [results.found[number] for number in range(len(arguments))]


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
