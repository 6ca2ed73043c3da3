"""Many independent jobs in worker processes of one thread each: results in order, a clean end on Ctrl-C or a crash."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from types import ModuleType
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

from omnibench.errors import OmnibenchError

Job = TypeVar("Job")
Result = TypeVar("Result")

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS")
_AHEAD = 4  # results a worker may be ahead of the one that is yielded next (chosen)
_PATIENCE = 2.0  # s that a process is given to end by itself (chosen)


def one_thread() -> AbstractContextManager[object]:
    """Limit NumPy's and SciPy's matrix products to the caller's thread while the block is open.

    On small matrices more threads only wait for each other when the machine is busy.
    """
    limiter: AbstractContextManager[object] = _controller().limit(limits=1)
    return limiter


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController().select(user_api="blas")


def in_processes(
    work: Callable[[Job], Result], jobs: Iterable[Job], workers: int, preload: str | None = None
) -> Generator[Result, None, None]:
    """Yield ``work(job)`` for every job, in the jobs' order; jobs are taken from the iterable as they are needed.

    work: a function at the top of a module; it, jobs and results are pickled. preload: name of the module that holds
    it. workers: processes; with one, the work is done in this process. An error of ``work`` is raised here;
    OmnibenchError in one line when a process dies.
    """
    if workers <= 1:
        for job in jobs:
            with one_thread():
                result = work(job)
            yield result
        return
    waiting = enumerate(jobs)
    done: dict[int, Result] = {}
    next_index = 0
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
            while next_index in done:
                yield done.pop(next_index)
                next_index += 1


def _send(connection: Connection, waiting: Iterator[tuple[int, Job]]) -> int | None:
    """Give a worker the next job and return the job's number; None if there are no more jobs."""
    for index, job in waiting:
        with _death_as_error():
            connection.send(job)
        return index
    return None


def _receive(connection: Connection) -> Any:
    with _death_as_error():
        good, answer = connection.recv()
    if not good:
        raise answer
    return answer


@contextmanager
def _death_as_error() -> Iterator[None]:
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
    """The loop of a worker process: receive a job, send its result, until the parent closes the pipe or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what Ctrl-C ends
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
    """Wait for the parent to die, then end this worker process."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # this is a worker
    with suppress(OSError):
        wait([parent.sentinel])
        os._exit(1)


@contextmanager
def one_thread_processes(preload: Sequence[str]) -> Iterator[Any]:
    """A multiprocessing context (forkserver) whose processes start fast and use one thread each.

    preload: modules that the processes will need. The fork server is started once a process, so that the first
    caller's modules count for all that follow.
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
    if threading.current_thread() is not threading.main_thread():  # signal handlers belong to the main thread
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def main_module_hidden() -> Iterator[None]:
    """Keep processes that start in the block from running the user's script again.

    So a script that calls omnibench needs no ``if __name__ == "__main__"``.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
