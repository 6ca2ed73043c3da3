"""Backends on this machine: the calling process, and a fresh process for every job, by pebble."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent import futures
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from signal import SIG_DFL, SIGABRT, SIGHUP, SIGINT, SIGKILL, SIGSEGV, SIGTERM, Signals, signal
from typing import Any, TypeVar

from pebble import ProcessExpired
from pebble.concurrent import process as in_process

from omnibench.errors import one_line
from omnibench.jobs.job import Backend, Ended, Failure, Job, JobWatch
from omnibench.jobs.memory import limited_memory, oom_kills
from omnibench.jobs.result_store import ResultStore
from omnibench.processes import (
    end_with_parent,
    interrupts_deferred,
    main_module_hidden,
    one_thread,
    one_thread_processes,
)
from omnibench.progress import Progress

T = TypeVar("T")

_PERIOD = 0.2  # s between two looks at jobs that report nothing; chosen
_FROM_OUTSIDE = (SIGKILL, SIGTERM, SIGHUP, SIGINT)  # signals by which people and the system end processes


def local_backend(workers: int, preload: Sequence[str] = ()) -> Backend:
    """This process for one worker, else that many processes; for jobs of our own code, which needs no isolation."""
    return InPlace() if workers <= 1 else Processes(workers, preload)


class InPlace:
    """Runs jobs one after the other in this process. Their limits are not enforced."""

    def run(self, jobs: Iterable[tuple[int, Job[T]]], store: ResultStore[T], watch: JobWatch[T]) -> Iterator[Ended]:
        """Run the jobs, see Backend."""
        for number, job in jobs:
            watch.began(number)
            failure = None
            try:
                with one_thread():
                    job.run(store, partial(watch.moved, number))
            except (Exception, SystemExit) as error:
                failure = _raised(job, error)
            yield Ended(number, job, failure)


@dataclass(frozen=True)
class Processes:
    """Runs every job in a fresh process of one thread, up to ``workers`` of them at a time.

    preload: modules that the processes share, so that they need not be imported for every job. Within a job there are
    no further processes: it runs its jobs itself.
    """

    workers: int
    preload: Sequence[str] = ()

    def run(self, jobs: Iterable[tuple[int, Job[T]]], store: ResultStore[T], watch: JobWatch[T]) -> Iterator[Ended]:
        """Run the jobs, see Backend."""
        if _in_job:
            yield from InPlace().run(jobs, store, watch)
            return
        waiting = iter(jobs)
        active: list[_Active] = []
        title = f"omnibench jobs {id(active)}"
        with one_thread_processes((__name__, *self.preload)) as context:
            try:
                while True:
                    while len(active) < self.workers and (item := next(waiting, None)) is not None:
                        active.append(_start(*item, store, context, title))
                        watch.began(item[0])
                    if not active:
                        return
                    for ended in _wait(active, watch):
                        active.remove(ended)
                        yield ended.ending()
            finally:
                _end(title)
                for left in active:
                    left.end_group()


@dataclass(eq=False)
class _Active:
    """A job that is under way. future: its end. progress: its reports, None once they have ended.

    group: id of its process's group, in which all processes are that the job starts; None until that is known.
    """

    number: int
    job: Job[Any]
    future: futures.Future[None]
    progress: Connection | None
    kills: int
    group: int | None = None

    def receive(self, watch: JobWatch[Any]) -> None:
        """Pass one report on. At the end of all reports the job is about to end, too, which is waited for."""
        assert self.progress is not None
        try:
            event = self.progress.recv()
        except (EOFError, OSError):
            self.progress.close()
            self.progress = None
            futures.wait([self.future], timeout=_PERIOD)
        else:
            if isinstance(event, int):
                self.group = event
            else:
                watch.moved(self.number, event)

    def ending(self) -> Ended:
        """The job's end: with a result, an error, over its time or with its process."""
        self.end_group()
        if self.progress is not None:
            self.progress.close()
        error = self.future.exception()
        if error is None:
            return Ended(self.number, self.job, None)
        if isinstance(error, ProcessExpired):
            return Ended(self.number, self.job, _death(self.job, error.exitcode or 0, self.kills))
        if isinstance(error, TimeoutError) and error.args[1:] == (self.job.seconds,):  # pebble's, not the job's own
            return Ended(self.number, self.job, Failure(f"over time (limit {self.job.seconds:g} s)", over_time=True))
        return Ended(self.number, self.job, _raised(self.job, error))

    def end_group(self) -> None:
        """End the processes that the job left behind."""
        while self.group is None and self.progress is not None and self.progress.poll():
            try:
                first = self.progress.recv()
            except (EOFError, OSError):
                break
            self.group = first if isinstance(first, int) else None
        if self.group is not None:
            with suppress(OSError):  # there is none
                os.killpg(self.group, SIGKILL)


def _start(number: int, job: Job[T], store: ResultStore[T], context: Any, title: str) -> _Active:
    reader, writer = context.Pipe(duplex=False)
    kills = oom_kills()
    options: dict[str, Any] = {"name": title, "timeout": job.seconds, "context": context}
    work: Any = in_process(**options)
    with interrupts_deferred(), main_module_hidden():
        future = work(_work)(job, store, writer)
    writer.close()
    return _Active(number, job, future, reader, kills)


def _wait(active: Sequence[_Active], watch: JobWatch[Any]) -> list[_Active]:
    """Wait a moment for reports, which are passed on; the jobs that have ended."""
    reporting = {item.progress: item for item in active if item.progress is not None}
    for progress in wait(list(reporting), timeout=_PERIOD):
        assert isinstance(progress, Connection)
        reporting[progress].receive(watch)
    ended = [item for item in active if item.future.done()]
    for item in ended:
        while item.progress is not None and item.progress.poll():  # reports sent before its end
            item.receive(watch)
    return ended


def _end(title: str) -> None:
    """End the workers of this name, and pebble's threads, which bear it, too, and see their workers die."""
    for process in multiprocessing.active_children():
        if process.name == title:
            process.kill()
    for thread in threading.enumerate():
        if thread.name == title:
            thread.join()


_in_job = False  # True in a worker process


def _work(job: Job[T], store: ResultStore[T], progress: Connection) -> None:
    """Do a job in a worker process."""
    global _in_job
    _in_job = True
    signal(SIGTERM, SIG_DFL)  # end at once: Python's handlers would wait for compiled code
    os.setpgid(0, 0)  # all that a plug-in starts can be ended with the job
    process = os.getpid()
    progress.send(process)
    threading.Thread(target=end_with_parent, daemon=True).start()

    def report(event: Progress) -> None:
        with suppress(OSError):  # a plug-in may have closed it
            progress.send(event)

    try:
        with one_thread(), limited_memory(job.memory_mb):
            result = job.function(job.argument, report)
            if os.getpid() != process:  # a plug-in forked: its copy of this process has no answer to give
                os._exit(0)
            store.put(job.key, result)
    except Exception as error:
        if os.getpid() != process:
            os._exit(1)
        raise _sendable(error) from error


class _InWordsError(Exception):
    """An error in words, in the place of one that cannot be pickled."""


def _sendable(error: Exception) -> Exception:
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # whatever the error's class raises
        return _InWordsError(_in_words(error))
    return error


def _raised(job: Job[Any], error: BaseException) -> Failure:
    if isinstance(error, MemoryError):
        return Failure(
            "out of memory" if job.memory_mb is None else f"out of memory (limit {job.memory_mb:g} MB)", error
        )
    return Failure(str(error) if isinstance(error, _InWordsError) else _in_words(error), error)


def _in_words(error: BaseException) -> str:
    return one_line(f"{type(error).__name__}: {error}")


def _death(job: Job[Any], code: int, kills: int) -> Failure:
    """A worker died: by exit code, by a signal of a crash, or by one that came from outside.

    The system kills by SIGKILL when memory runs out, and counts that; kills: the count before the job.
    """
    how = f"exit code {code}" if code >= 0 else f"killed by {Signals(-code).name}"
    if code == -SIGKILL and oom_kills() > kills:
        how += ": the system was out of memory"
    elif code in (-SIGABRT, -SIGSEGV) and job.memory_mb is not None:  # compiled code may end so without memory
        how += f"; its memory was limited to {job.memory_mb:g} MB"
    return Failure(f"the process died without an answer ({how})", killed=-code in _FROM_OUTSIDE)
