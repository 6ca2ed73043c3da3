"""Backends on this machine: the calling process, and processes of its own."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import wait
from typing import Any, TypeVar

from omnibench.jobs.job import Backend, Ended, Job, JobWatch, Store
from omnibench.jobs.job_process import PRELOAD, JobEnd, JobProcess, Packer, in_job, process_for, raised, release
from omnibench.processes import one_thread, one_thread_processes

T = TypeVar("T")

_LONGEST = 3600.0  # s of one wait: the system takes no infinite time


def local_backend(workers: int, preload: Sequence[str] = ()) -> Backend:
    """This process for one worker, else that many processes; for jobs of our own code, which needs no isolation."""
    return InPlace() if workers <= 1 else Processes(workers, preload)


class InPlace:
    """Runs jobs one after the other in this process. Their limits are not enforced."""

    def run(self, jobs: Iterable[tuple[int, Job[T]]], store: Store[T], watch: JobWatch[T]) -> Iterator[Ended]:
        """Run the jobs, see Backend."""
        for number, job in jobs:
            watch.began(number)
            failure = None
            try:
                with one_thread():
                    job.run(store, partial(watch.moved, number))
            except (Exception, SystemExit) as error:
                failure = raised(job, error)
            yield Ended(number, job, failure)


@dataclass(frozen=True)
class Processes:
    """Runs jobs in processes of one thread, up to ``workers`` of them at a time.

    A job with a limit of time or memory, one that begins when a process is a second old, and one after a job that
    raised or left something behind (a working folder, threads, children) has a fresh process; quick jobs share one, and
    those of our own code share it for a minute.
    preload: modules that the processes share, so that they need not be imported for every job. Within a job there are
    no further processes: it runs its jobs itself. lasting: processes that have nothing to do wait for the next run,
    until ``close``.
    """

    workers: int
    preload: Sequence[str] = ()
    lasting: bool = False
    _idle: list[JobProcess] = field(default_factory=list, init=False, repr=False, compare=False)

    def run(self, jobs: Iterable[tuple[int, Job[T]]], store: Store[T], watch: JobWatch[T]) -> Iterator[Ended]:
        """Run the jobs, see Backend."""
        if in_job():
            yield from InPlace().run(jobs, store, watch)
            return
        waiting = iter(jobs)
        active: dict[JobProcess, tuple[int, Job[Any]]] = {}
        idle, packer = self._idle, Packer()
        with one_thread_processes((*PRELOAD, *self.preload)) as context:
            try:
                while True:
                    while len(active) < self.workers and (item := next(waiting, None)) is not None:
                        number, job = item
                        process = process_for(job, idle, context)
                        active[process] = item
                        process.give(packer.portable(job) if job.own and job.shared else job, store.keep)
                        watch.began(number)
                    if not active:
                        return
                    for process, end in _ends(active, watch):
                        number, job = active.pop(process)
                        if end.answer is not None:
                            store.put_content(job.key, end.answer)
                        release(process, end, idle)
                        yield Ended(number, job, end.failure(job))
            finally:
                for process in active:
                    process.end()
                if not self.lasting:
                    self.close()

    def close(self) -> None:
        """End the processes that wait."""
        while self._idle:
            self._idle.pop().end()


def _ends(active: dict[JobProcess, tuple[int, Job[Any]]], watch: JobWatch[Any]) -> list[tuple[JobProcess, JobEnd]]:
    """Wait until a job reports, ends or is over its time; reports are passed on. The jobs that have ended."""
    deadlines = [process.deadline for process in active if process.deadline is not None]
    wait(
        [sign for process in active for sign in process.signs],
        timeout=min(max(min(deadlines) - time.monotonic(), 0.0), _LONGEST) if deadlines else None,
    )
    ended = []
    for process, (number, _) in active.items():
        for event in process.events():
            if isinstance(event, JobEnd):
                ended.append((process, event))
                break
            watch.moved(number, event)
    return ended
