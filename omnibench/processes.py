"""The same work on many things, in processes with one thread each: results in order, Ctrl-C and crashes end cleanly."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from types import ModuleType
from typing import Any, TypeVar

from omnibench.errors import OmnibenchError
from omnibench.threads import one_thread

Job = TypeVar("Job")
Result = TypeVar("Result")

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS")
_AHEAD = 4  # results of each worker that may wait for one before them
_PATIENCE = 2.0  # s for a process to go by itself


def in_processes(
    work: Callable[[Job], Result], jobs: Iterable[Job], workers: int, preload: str | None = None
) -> Generator[Result, None, None]:
    """``work`` of every job, in the jobs' order; jobs are taken as they are needed.

    work: a function of a module; it, jobs and results are sent between processes. preload: the module that holds it.
    One worker: in this process. What ``work`` raises is raised here; OmnibenchError in one line when a process dies.
    """
    if workers <= 1:
        for job in jobs:
            with one_thread():
                result = work(job)
            yield result
        return
    waiting = enumerate(jobs)
    done: dict[int, Result] = {}
    following = 0
    with _workers(work, workers, preload) as idle:
        busy: dict[Connection, int] = {}
        while True:
            while idle and len(done) < _AHEAD * workers and (index := _send(idle[-1], waiting)) is not None:
                busy[idle.pop()] = index
            if not busy:
                return
            for connection in wait(list(busy)):
                assert isinstance(connection, Connection)
                done[busy.pop(connection)] = _receive(connection)
                idle.append(connection)
            while following in done:
                yield done.pop(following)
                following += 1


def _send(connection: Connection, waiting: Iterator[tuple[int, Job]]) -> int | None:
    """Give a worker the next job; its number, None if there is no more."""
    for index, job in waiting:
        with _death_in_words():
            connection.send(job)
        return index
    return None


def _receive(connection: Connection) -> Any:
    with _death_in_words():
        good, answer = connection.recv()
    if not good:
        raise answer
    return answer


@contextmanager
def _death_in_words() -> Iterator[None]:
    try:
        yield
    except (EOFError, OSError):
        raise OmnibenchError("a worker process died; is there too little memory? try again with one worker") from None


@contextmanager
def _workers(work: Callable[[Any], Any], count: int, preload: str | None) -> Iterator[list[Connection]]:
    processes, connections = [], []
    try:
        with one_thread_processes([preload] if preload else []) as context, main_module_hidden():
            for _ in range(count):
                ours, theirs = context.Pipe()
                process = context.Process(target=_serve, args=(theirs, work), daemon=True)
                process.start()
                theirs.close()
                processes.append(process)
                connections.append(ours)
        yield list(connections)
        for connection in connections:
            connection.close()
        for process in processes:
            process.join(_PATIENCE)
    finally:
        for process in processes:
            process.kill()
            process.join()
        for connection in connections:
            connection.close()


def _serve(connection: Connection, work: Callable[[Any], Any]) -> None:
    """The worker process: jobs come, results go, until the parent closes or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what Ctrl-C ends, from whatever thread it asked
    threading.Thread(target=end_with_parent, daemon=True).start()
    with suppress(EOFError, OSError), one_thread():
        while True:
            job = connection.recv()
            try:
                answer = (True, work(job))
            except Exception as error:
                answer = (False, error)
            connection.send(answer)


def end_with_parent() -> None:
    """End this worker when its parent dies, which it must not outlive."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # this is a worker
    with suppress(OSError):
        wait([parent.sentinel])
        os._exit(1)


@contextmanager
def one_thread_processes(preload: Sequence[str]) -> Iterator[Any]:
    """A context whose processes start fast, with one thread each: two at a time should not fight for the cores.

    preload: modules that they will need; those of the first who asks in a process are for all that follow.
    """
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, *preload])
    try:
        with _interrupts_ignored():  # the processes inherit this: the parent decides what Ctrl-C ends
            forkserver.ensure_running()
        yield context
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # others cannot, and need not
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def main_module_hidden() -> Iterator[None]:
    """A process started here does not run the user's script once more, which so needs no guard against that."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
