"""The protocol of many independent jobs: a picklable specification in, a result file out.

A job's result is what stands in the store, and nothing else: the file that its worker wrote, or that the client wrote
for a worker on another machine. So a job whose file is there is not run again, whatever became of the parent, and a
worker that dies after writing has done its work. A backend only runs jobs and says which ended how.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from omnibench.errors import OmnibenchError
from omnibench.jobs.result_store import Store
from omnibench.progress import Progress, Reporter

T = TypeVar("T")

TRIES = 3  # how often a job whose worker is killed is begun: two chances that memory is free again; chosen


@dataclass(frozen=True)
class Job(Generic[T]):
    """Specification of a job, which can be pickled.

    key: names everything that the result depends on, see ``content_key``. function: from the top of a module; called
    with the argument and a function that reports progress. seconds, memory_mb: limits of its wall time and of its
    process's memory (10^6 bytes), None for no limit. timed: its seconds are compared, so that on another machine it has
    the worker to itself. shared: objects within the argument that other jobs hold, too; to another machine each travels
    once. own: it runs omnibench's own code alone, which leaves nothing behind: such jobs have a process together for
    longer, and within it what they share.
    """

    key: str
    function: Callable[[Any, Reporter], T]
    argument: Any
    seconds: float | None = None
    memory_mb: float | None = None
    timed: bool = False
    shared: tuple[Any, ...] = ()
    own: bool = False

    def run(self, store: Store[T], report: Reporter) -> None:
        """Do the work here and write the result's file."""
        store.put(self.key, self.function(self.argument, report))


class BackendError(OmnibenchError):
    """The machines that run jobs are lost, or one of them is unfit; results so far are in the store."""


@dataclass(frozen=True)
class Failure:
    """Reason, in words, why a job has no result.

    error: what its function raised. over_time: it was ended at its time limit. killed: its worker was killed, not by
    a fault of its own as far as can be known.
    """

    reason: str
    error: BaseException | None = None
    over_time: bool = False
    killed: bool = False


class Ended(NamedTuple):
    """A job that a backend has run, by its number; failure: None where it ended by itself without an error."""

    number: int
    job: Job[Any]
    failure: Failure | None


class JobWatch(Generic[T]):
    """Callbacks about jobs, by their numbers in the order in which they were given; these do nothing."""

    def began(self, number: int) -> None:
        """A worker has begun the job, perhaps not for the first time."""

    def moved(self, number: int, event: Progress) -> None:
        """The job reports progress."""

    def ended(self, number: int, ending: T | Failure, reused: bool) -> None:
        """The job has ended, or its result was there already (``reused``)."""


class Backend(Protocol):
    """Place where jobs are run: this process, processes of this machine, or other machines."""

    def run(self, jobs: Iterable[tuple[int, Job[T]]], store: Store[T], watch: JobWatch[T]) -> Iterator[Ended]:
        """Run jobs, which are taken as workers become free, and yield them as they end.

        When the iterator is closed or interrupted, workers are ended at once.
        """


def run_jobs(jobs: Iterable[Job[T]], store: Store[T], backend: Backend, watch: JobWatch[T]) -> None:
    """Run the jobs whose results are not in the store; ``watch`` hears of every end, results come from the store.

    A job whose worker was killed is tried again after all others, at most three times in all: what killed it (the
    system, which lacked memory; a person) may be gone by then. A job that raised, was over its time or memory limit, or
    crashed would do so again. Whatever ``watch`` raises ends the work.
    """
    store = store.anchored()
    waiting = _not_stored(jobs, store, watch)
    for tried in range(1, TRIES + 1):
        killed: list[tuple[int, Job[T]]] = []
        for number, job, failure in backend.run(waiting, store, watch):
            result = store.get(job.key)
            if result is not None:
                watch.ended(number, result, reused=False)
            elif failure is None:
                watch.ended(number, Failure(f"its result cannot be read: {store.file(job.key)}"), reused=False)
            elif failure.killed and tried < TRIES:
                killed.append((number, job))
            else:
                watch.ended(number, _after(failure, tried), reused=False)
        if not killed:
            return
        waiting = iter(killed)


def _not_stored(jobs: Iterable[Job[T]], store: Store[T], watch: JobWatch[T]) -> Iterator[tuple[int, Job[T]]]:
    """The jobs that have to be run, with their numbers."""
    for number, job in enumerate(jobs):
        result = store.get(job.key)
        if result is None:
            yield number, job
        else:
            watch.ended(number, result, reused=True)


def _after(failure: Failure, tries: int) -> Failure:
    return failure if tries == 1 else replace(failure, reason=f"{failure.reason} in each of {tries} tries")
