"""The worker's side of the Dask backend: jobs run in processes of their own beneath the Dask worker.

So limits, isolation and threads are those of the processes of one machine, and results are equal to the bit.

The software that results depend on is compared before the first job.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import pickle
import platform
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.metadata import entry_points, version
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import distributed
from pydantic import TypeAdapter

from omnibench.config import NonNegative
from omnibench.errors import DataError
from omnibench.files import write_text
from omnibench.jobs.job import BackendError, Job, Store, code_digest
from omnibench.jobs.job_process import PRELOAD, JobEnd, JobProcess, process_for, release
from omnibench.processes import one_thread_processes
from omnibench.progress import Progress, Reporter
from omnibench.registry import REGISTRIES, PluginFailure, import_copies

_PACKAGES = (
    *("numpy", "scipy", "cvxpy", "clarabel", "nlopt", "cma", "polars", "numba", "pydantic", "shapely"),
    *("dask", "distributed"),
)
_PACKAGE = Path(__file__).parents[1]
_PERIOD = 0.2  # s between two reports of a job, and two looks whether it is still wanted; chosen
_TOGETHER, _MOST_TOGETHER = 0.1, 50  # s and ends that wait for each other; chosen
_LARGEST = 50_000  # bytes of an event, about: the scheduler keeps a thousand of them, and a run's result has 2 to 20 kB
_PROBE = 1_000_000  # bytes that a worker must be able to write: a plug-in's file and what a job notes down (chosen)

_preparing = threading.Lock()
_slot_freed = threading.Condition()
_busy_slots = 0  # of this worker
_idle: dict[bytes, list[JobProcess]] = {}  # processes that wait, by the requirements of the clients that they serve
_lasting = ExitStack()  # what is open for as long as this worker lives


@cache
def software() -> dict[str, str]:
    """Versions of Python and of packages, omnibench's code by its hash, and installed packages of plug-ins."""
    points = {point for registry in REGISTRIES for point in entry_points(group=registry.group)}
    return {
        "Python": platform.python_version(),
        "omnibench's code": code_digest(_PACKAGE, _PACKAGE.rglob("*.py"))[:10],
        **{package: version(package) for package in _PACKAGES},
        **{point.dist.name: point.dist.version for point in points if point.dist is not None},
    }


def differences(there: Mapping[str, str], here: Mapping[str, str]) -> list[str]:
    """What another machine has in the place of what is here, in words."""
    return [
        f"{name} {there.get(name, 'missing')} (here: {here.get(name, 'missing')})"
        for name in dict.fromkeys((*here, *there))
        if here.get(name) != there.get(name)
    ]


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
class Parcel:
    """Jobs that travel together, by their numbers: quick ones, each with a PackedJob without what it shares.

    names: of what they share. topic: of events, texts of ``events_text``.
    """

    topic: str
    run: int
    store: Store[Any]
    jobs: tuple[tuple[int, Job[Any]], ...]
    names: tuple[str, ...]


@dataclass(frozen=True)
class JobEvent:
    """Event of a job: it begins at a worker, reports, or ends.

    answer: content of its result. seconds: that it took. fetch: how it ended is in the result of the parcel's task.
    """

    number: int
    worker: str = ""
    progress: Progress | None = None
    answer: str | None = None
    seconds: NonNegative = 0.0
    fetch: bool = False


@dataclass(frozen=True)
class JobOutcome:
    """End of a job. seconds: that it took."""

    number: int
    end: JobEnd
    seconds: float


def events_text(run: int, events: Iterable[JobEvent]) -> str:
    """Events as JSON. Nobody unpickles events: whoever reaches the scheduler can send some."""
    return json.dumps([run, [asdict(event) for event in events]], default=str)  # a plug-in may report numpy's integers


def read_events(text: object) -> tuple[int, list[JobEvent]]:
    """The run and the events of a text; none of a text that ``events_text`` does not write."""
    try:
        return _EVENTS.validate_python(json.loads(text) if isinstance(text, str) else None)
    except (ValueError, RecursionError):  # ValueError: pydantic's errors, too
        return -1, []


_EVENTS = TypeAdapter(tuple[int, list[JobEvent]])


def content(data: bytes) -> bytes:
    """Task that holds data for jobs: where all workers that hold it are lost, the scheduler runs it again."""
    return data


def carry_out(parcel: Parcel, requirements: bytes, *shared: bytes) -> list[JobOutcome]:
    """Task of a parcel's jobs, one after the other; returns the ends that no event tells.

    UnfitWorkerError: this worker joined after the first job, and is not as it must be.
    """
    worker = distributed.get_worker()
    plugins, preload = prepare(requirements, worker), pickle.loads(requirements).preload
    sender = _EventSender(worker, parcel)
    idle = _idle.setdefault(requirements, [])
    data = dict(zip(parcel.names, shared, strict=True))
    timed = any(job.timed for _, job in parcel.jobs)
    with _slots(worker.state.nthreads if timed else 1, worker.state.nthreads):
        sender.begin([JobEvent(number, worker.address) for number, _ in parcel.jobs])
        for number, job in parcel.jobs:
            needed = {name: data[name] for name in job.argument.names}
            complete = replace(job, argument=replace(job.argument, shared=needed, plugins=plugins))
            began = time.monotonic()
            process = process_for(job, idle, _context(preload))
            try:
                process.give(complete, parcel.store.content)
                end = _follow(process, sender, number)
            except BaseException:
                process.end()
                raise
            if end is None:  # wanted no more
                process.end()
                break
            release(process, end, idle)
            sender.end(JobOutcome(number, end, time.monotonic() - began))
    return sender.close()


def prepare(requirements: bytes, dask_worker: Any) -> dict[Path, Path]:
    """Check a worker, once for the same requirements: copies of plug-in files there. UnfitWorkerError in one line."""
    with _preparing:
        return _prepared(requirements, dask_worker.address, Path(dask_worker.local_directory))


@cache
def _prepared(requirements: bytes, address: str, folder: Path) -> dict[Path, Path]:
    client: Requirements = pickle.loads(requirements)
    if wrong := differences(software(), client.software):
        raise UnfitWorkerError(
            f"worker {address} has {', '.join(wrong)}: results could differ; install the same on the worker, or work "
            "with workers that have it"
        )
    copies = folder / f"omnibench-{hashlib.sha256(requirements).hexdigest()[:10]}"
    plugins = {path: copies / str(number) / path.name for number, path in enumerate(client.plugins)}
    try:
        write_text(copies / "probe", " " * _PROBE)
        (copies / "probe").unlink()
        for path, copy in plugins.items():
            write_text(copy, client.plugins[path])
    except (OSError, DataError) as error:
        raise UnfitWorkerError(f"worker {address}: {error}") from None
    if plugins:
        # A process of jobs imports them, as it may crash.
        process, job = JobProcess(_context(client.preload)), Job("plug-ins", _import_all, plugins)
        process.give(job, _as_it_is)
        wait(process.signs)
        end = process.receive()
        process.end()
        assert isinstance(end, JobEnd)
        if (lost := end.failure(job)) is not None:
            raise UnfitWorkerError(f"worker {address}: its plug-ins cannot be imported there: {lost.reason}")
        for failure in end.answer:
            if failure.origin not in client.failing:
                raise UnfitWorkerError(
                    f"worker {address}: plug-in {failure.origin} cannot be imported there: {failure.error}; install "
                    "on the worker what it needs"
                )
    return plugins


def _import_all(plugins: Mapping[Path, Path], _: Reporter) -> list[PluginFailure]:
    return import_copies(plugins)


def _as_it_is(_: str, result: Any) -> Any:
    return result


def _follow(process: JobProcess, sender: _EventSender, number: int) -> JobEnd | None:
    """Wait for a job's end, and report; None if it is wanted no more."""
    reported_at, latest = time.monotonic(), None
    while True:
        wait(process.signs, timeout=_PERIOD)
        end = None
        for event in process.events():
            if isinstance(event, JobEnd):
                end = event
                break
            latest = JobEvent(number, progress=event)
        if latest is not None and (end or time.monotonic() - reported_at >= _PERIOD):
            sender.send(latest, at_once=end is None)
            reported_at, latest = time.monotonic(), None
        if end or sender.cancelled:
            return end


class _EventSender:
    """Tells the client of a parcel's jobs by events, which go by way of the scheduler."""

    def __init__(self, worker: Any, parcel: Parcel) -> None:
        self.worker = worker
        self._topic, self._run = parcel.topic, parcel.run
        self._key = worker.get_current_task()
        self._waiting: list[JobEvent] = []
        self._size = 0  # bytes of those that wait
        self._to_fetch: list[JobOutcome] = []
        self._sent_at = time.monotonic()

    @property
    def cancelled(self) -> bool:
        """True once the client has cancelled the parcel, or is gone."""
        task = self.worker.state.tasks.get(self._key)
        return task is None or task.state == "cancelled"

    def begin(self, events: Iterable[JobEvent]) -> None:
        """Send begins, and wait until the scheduler has them: one that died with its worker would not be counted."""
        log_event = self.worker.scheduler.log_event
        distributed.utils.sync(self.worker.loop, log_event, topic=self._topic, msg=events_text(self._run, events))

    def send(self, event: JobEvent, *, at_once: bool = False) -> None:
        """Send an event, with others that wait unless ``at_once``."""
        size = len(event.answer or "")
        if self._size + size > _LARGEST:
            self._flush()
        self._waiting.append(event)
        self._size += size
        if at_once or time.monotonic() - self._sent_at > _TOGETHER or len(self._waiting) >= _MOST_TOGETHER:
            self._flush()

    def end(self, outcome: JobOutcome) -> None:
        """Send an end soon, if it is a result in text that is not too large for an event."""
        answer = outcome.end.answer
        if isinstance(answer, str) and len(answer) <= _LARGEST:
            self.send(JobEvent(outcome.number, answer=answer, seconds=outcome.seconds))
        else:
            self._to_fetch.append(outcome)

    def close(self) -> list[JobOutcome]:
        """Send what is left; the ends that are no events."""
        for outcome in self._to_fetch:
            self.send(JobEvent(outcome.number, fetch=True))
        self._flush()
        return self._to_fetch

    def _flush(self) -> None:
        if self._waiting:
            self.worker.log_event(self._topic, events_text(self._run, self._waiting))
        self._waiting, self._size, self._sent_at = [], 0, time.monotonic()


@contextmanager
def _slots(needed: int, all_slots: int) -> Iterator[None]:
    """Wait for free slots of this worker, all of them for a job that is timed, and take them."""
    global _busy_slots
    with _slot_freed:
        _slot_freed.wait_for(lambda: _busy_slots + needed <= all_slots)
        _busy_slots += needed
    try:
        yield
    finally:
        with _slot_freed:
            _busy_slots -= needed
            _slot_freed.notify_all()


@cache
def _context(preload: tuple[str, ...]) -> Any:
    """The context of processes of jobs, for as long as this worker lives."""
    os.environ.pop("MALLOC_TRIM_THRESHOLD_", None)  # a nanny's: with it arrays take half as long again as at home
    multiprocessing.current_process().daemon = False  # a nanny's workers may not start processes otherwise
    return _lasting.enter_context(one_thread_processes((*PRELOAD, __name__, *preload)))
