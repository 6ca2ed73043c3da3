"""The worker's side of the Dask backend: jobs run in processes of their own beneath the Dask worker.

So limits, isolation and threads are those of the processes of one machine, and results are equal to the bit.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import pickle
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import distributed

from omnibench.errors import DataError
from omnibench.files import write_text
from omnibench.jobs.job import BackendError, Job
from omnibench.jobs.job_process import JobEnd, JobProcess
from omnibench.jobs.packing import PackedJob
from omnibench.jobs.result_store import ResultStore
from omnibench.jobs.software import differences, software
from omnibench.processes import one_thread_processes
from omnibench.progress import Progress, Reporter
from omnibench.registry import PluginFailure, import_copies

_PERIOD = 0.2  # s between two reports of a job, and two looks whether it is still wanted; chosen
_LARGEST = 200_000  # bytes of an event: the scheduler keeps a thousand of them, and a run's result has 2 to 50 kB
_PROBE = 1_000_000  # bytes that a worker must be able to write: a plug-in's file and what a job notes down (chosen)


class UnfitWorkerError(BackendError):
    """A worker on which results could differ from the client's, or that cannot run jobs."""


@dataclass(frozen=True)
class Requirements:
    """What a worker must have. software: the client's. plugins: text of its plug-in files by path, and which fail."""

    software: Mapping[str, str]
    plugins: Mapping[Path, str]
    failing: frozenset[str]
    preload: tuple[str, ...]


@dataclass(frozen=True)
class Order:
    """A job as it travels. topic: of the events that tell of it. content: see ``Packer``; names: of what it shares."""

    topic: str
    number: int
    job: Job[Any]
    store: ResultStore[Any]
    content: bytes
    names: tuple[str, ...]


@dataclass(frozen=True)
class Told:
    """Event of a job: it begins (neither progress nor end), reports, or ends, perhaps with a last report."""

    number: int
    worker: str
    progress: Progress | None = None
    end: JobEnd | None = None


def content(data: bytes) -> bytes:
    """Task that holds data for jobs: where all workers that hold it are lost, the scheduler runs it again."""
    return data


def carry_out(order: Order, requirements: bytes, *shared: bytes) -> Told | None:
    """Task of one job. All that is told goes to the order's topic; a large end is returned."""
    worker = distributed.get_worker()
    plugins = prepare(requirements, worker)
    packed = PackedJob(order.content, dict(zip(order.names, shared, strict=True)), plugins)
    job = replace(order.job, argument=packed)
    with _slots(worker.state.nthreads if job.timed else 1, worker.state.nthreads):
        _tell(worker, order, Told(order.number, worker.address))
        process = _process_for(job, pickle.loads(requirements).preload)
        process.give(job, order.store.content)
        try:
            progress, end = _follow(process, worker, order)
        except BaseException:
            process.end()
            raise
        if end is None or not end.reusable:
            process.end()
        else:
            _idle.append(process)
    ended = Told(order.number, worker.address, progress, end)
    return ended if end is None or not _tell(worker, order, ended) else None


def prepare(requirements: bytes, worker: Any) -> dict[Path, Path]:
    """Check a worker, once for the same requirements: copies of plug-in files there. UnfitWorkerError in one line."""
    with _preparing:
        return _prepared(requirements, worker.address, Path(worker.local_directory))


def check(requirements: bytes, dask_worker: Any) -> str | None:
    """Why a worker is unfit; None if it is fit."""
    try:
        prepare(requirements, dask_worker)
    except UnfitWorkerError as error:
        return str(error)
    return None


_preparing = threading.Lock()
_free = threading.Condition()
_taken = 0  # slots of this worker
_idle: list[JobProcess] = []
_open = ExitStack()


@cache
def _prepared(requirements: bytes, address: str, folder: Path) -> dict[Path, Path]:
    wanted: Requirements = pickle.loads(requirements)
    if wrong := differences(software(), wanted.software):
        raise UnfitWorkerError(
            f"worker {address} has {', '.join(wrong)}: results could differ; install the same on the worker, or work "
            "with workers that have it"
        )
    copies = folder / f"omnibench-{hashlib.sha256(requirements).hexdigest()[:10]}"
    plugins = {path: copies / str(number) / path.name for number, path in enumerate(wanted.plugins)}
    try:
        write_text(copies / "probe", " " * _PROBE)
        (copies / "probe").unlink()
        for path, copy in plugins.items():
            write_text(copy, wanted.plugins[path])
    except (OSError, DataError) as error:
        raise UnfitWorkerError(f"worker {address}: {error}") from None
    if plugins:
        failures = _failures(plugins, wanted.preload)
        for failure in failures:
            if failure.origin not in wanted.failing:
                raise UnfitWorkerError(
                    f"worker {address}: plug-in {failure.origin} cannot be imported there: {failure.error}; install "
                    "on the worker what it needs"
                )
    return plugins


def _failures(plugins: Mapping[Path, Path], preload: tuple[str, ...]) -> list[PluginFailure]:
    """Plug-ins that cannot be imported here, by a process of jobs."""
    process = JobProcess(_context(preload))
    process.give(Job("plug-ins", _import_all, plugins), _as_it_is)
    wait(process.signs)
    end = process.receive()
    process.end()
    assert isinstance(end, JobEnd)
    return end.answer or []


def _import_all(plugins: Mapping[Path, Path], _: Reporter) -> list[PluginFailure]:
    return import_copies(plugins)


def _as_it_is(_: str, result: Any) -> Any:
    return result


def _follow(process: JobProcess, worker: Any, order: Order) -> tuple[Progress | None, JobEnd | None]:
    """Wait for a job's end, and report: the last report not yet told, and the end; None if it is wanted no more."""
    key, told, last = worker.get_current_task(), time.monotonic(), None
    while True:
        wait(process.signs, timeout=_PERIOD)
        while (event := process.receive()) is not None:
            if isinstance(event, JobEnd):
                return last, event
            last = event
        if time.monotonic() - told >= _PERIOD:
            told = time.monotonic()
            if last is not None:
                _tell(worker, order, Told(order.number, worker.address, last))
                last = None
            task = worker.state.tasks.get(key)
            if task is None or task.state == "cancelled":
                return None, None


def _tell(worker: Any, order: Order, event: Told) -> bool:
    """Send an event to the client by way of the scheduler, which keeps the latest; False where it is too large."""
    packed = pickle.dumps(event)
    if len(packed) > _LARGEST:
        return False
    worker.log_event(order.topic, packed)
    return True


@contextmanager
def _slots(wanted: int, all_slots: int) -> Iterator[None]:
    """Wait for free slots of this worker, all of them for a job that is timed, and take them."""
    global _taken
    with _free:
        _free.wait_for(lambda: _taken + wanted <= all_slots)
        _taken += wanted
    try:
        yield
    finally:
        with _free:
            _taken -= wanted
            _free.notify_all()


def _process_for(job: Job[Any], preload: tuple[str, ...]) -> JobProcess:
    while _idle:
        process = _idle.pop()
        if process.takes(job):
            return process
        process.end()
    return JobProcess(_context(preload))


@cache
def _context(preload: tuple[str, ...]) -> Any:
    """The context of processes of jobs, for as long as this worker lives."""
    multiprocessing.current_process().daemon = False  # a nanny's workers may not start processes otherwise
    return _open.enter_context(one_thread_processes((JobProcess.__module__, __name__, *preload)))
