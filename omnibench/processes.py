"""Worker processes that start fast and use one thread each, and limits of threads in this process."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import wait
from types import ModuleType
from typing import Any

from threadpoolctl import ThreadpoolController

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS")


def one_thread() -> AbstractContextManager[object]:
    """Limit NumPy's and SciPy's matrix products to the caller's thread while the block is open.

    On small matrices more threads only wait for each other when the machine is busy.
    """
    limiter: AbstractContextManager[object] = _controller().limit(limits=1)
    return limiter


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController().select(user_api="blas")


def end_with_parent() -> None:
    """Wait for the parent to die, then end this worker process."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # this is a worker
    with suppress(OSError):
        wait([parent.sentinel])
        if os.getpgrp() == os.getpid():
            os.killpg(0, signal.SIGKILL)  # with all processes that it started
        os._exit(1)


@contextmanager
def interrupts_not_in_callbacks() -> Iterator[None]:
    """Within it JAX's callback of the garbage collector is off: for a process that waits for others.

    CVXPY imports JAX where it is there. What is raised in such a callback is printed and forgotten, Ctrl-C among it.
    """
    callbacks = [callback for callback in gc.callbacks if getattr(callback, "__name__", "") == "_xla_gc_callback"]
    for callback in callbacks:
        gc.callbacks.remove(callback)
    try:
        yield
    finally:
        gc.callbacks.extend(callbacks)


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
        resource_tracker.ensure_running()  # the fork server would start it, and unblock what is blocked
        with interrupts_deferred(), interrupts_blocked():  # processes inherit the block: the parent ends them
            forkserver.ensure_running()
        yield context
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Keep Ctrl-C from this thread, and from threads and processes that start in the block for as long as they live."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM act at the end of the block: a process whose start they cut short prints a traceback."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        for number in before:
            signal.signal(number, lambda signalled, _: came.append(signalled))
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for signalled in came[:1]:
            signal.raise_signal(signalled)


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
