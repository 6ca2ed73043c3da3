"""The worker's side of the Dask backend: jobs run in processes of their own beneath the Dask worker.

So limits, isolation and threads are those of the processes of one machine, and results are equal to the bit. The
software that results depend on is compared before the first job.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import pickle
import platform
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import Any

import distributed

from omnibench.errors import DataError
from omnibench.files import write_text
from omnibench.jobs.job import BackendError, Encode, Job, JobEnd, code_digest
from omnibench.jobs.job_process import PackedJob, Packer, Processes
from omnibench.progress import Reporter
from omnibench.registry import REGISTRIES, PluginFailure, import_copies

_PACKAGES = (
    *("numpy", "scipy", "cvxpy", "clarabel", "nlopt", "cma", "polars", "numba", "pydantic", "shapely"),
    *("dask", "distributed"),
)
_PACKAGE = Path(__file__).parents[1]
_PROBE = 1_000_000  # bytes that a worker must be able to write: a plug-in's file and what a job notes down (chosen)

_preparing, _taking_slots = threading.Lock(), threading.Lock()


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


class UnfitWorkerError(BackendError):
    """A worker on which results could differ from the client's, or that cannot run jobs."""


@dataclass(frozen=True)
class Requirements:
    """What a worker must have. software: the client's. plugins: text of its plug-in files by path, and which fail."""

    software: dict[str, str]
    plugins: Mapping[Path, str]
    failing: frozenset[str]
    preload: tuple[str, ...]


def prepare(requirements: bytes, dask_worker: Any) -> dict[Path, Path]:
    """Check a worker, once for the same requirements: copies of plug-in files there. UnfitWorkerError in one line."""
    with _preparing:
        return _prepared(requirements, dask_worker.address, Path(dask_worker.local_directory))


@cache
def _prepared(requirements: bytes, address: str, folder: Path) -> dict[Path, Path]:
    os.environ.pop("MALLOC_TRIM_THRESHOLD_", None)  # a nanny's: with it arrays take half as long again as at home
    multiprocessing.current_process().daemon = False  # a nanny's workers may not start processes otherwise
    client: Requirements = pickle.loads(requirements)
    there, here = software(), client.software
    names = [name for name in here | there if here.get(name) != there.get(name)]
    if wrong := [f"{name} {there.get(name, 'missing')} (here: {here.get(name, 'missing')})" for name in names]:
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
    if plugins:  # imported in a process, which they may crash
        job = Packer().pack(Job("plug-ins", _import_all, plugins))
        ((_, end),) = Processes(1, client.preload).events([(0, job)], {}, list)
        assert isinstance(end, JobEnd)  # it does not report
        if end.failure is not None:
            raise UnfitWorkerError(f"worker {address}: its plug-ins cannot be imported there: {end.failure.reason}")
        for failure in end.encoded:
            if failure.origin not in client.failing:
                raise UnfitWorkerError(
                    f"worker {address}: plug-in {failure.origin} cannot be imported there: {failure.error}; install "
                    "on the worker what it needs"
                )
    return plugins


def _import_all(plugins: Mapping[Path, Path], _: Reporter) -> list[PluginFailure]:
    return import_copies(plugins)


def content(data: bytes) -> bytes:
    """Task that holds data for jobs: where all workers that hold it are lost, the scheduler runs it again."""
    return data


def carry_out(
    jobs: Sequence[tuple[int, PackedJob]], names: Sequence[str], encode: Encode, timed: bool, *data: bytes
) -> tuple[list[tuple[int, JobEnd]], float]:
    """Task of some jobs, one after the other: their ends, and the seconds that they took.

    timed: they have the worker to themselves. data: requirements, and contents of what the jobs share, whose names are
    ``names``. UnfitWorkerError: this worker joined after the first job, and is not as it must be.
    """
    worker: Any = distributed.get_worker()
    key, plugins = worker.get_current_task(), prepare(data[0], worker)
    pool = _processes(threading.get_ident(), pickle.loads(data[0]).preload)
    slots, taken = _slots(worker.state.nthreads), worker.state.nthreads if timed else 1

    def wanted() -> bool:
        task = worker.state.tasks.get(key)  # none once the client is gone
        return task is not None and task.state != "cancelled"

    with _taking_slots:  # one after the other, or two that need several would wait for each other
        for _ in range(taken):
            slots.acquire()
    try:
        began = time.monotonic()
        events = pool.events(jobs, dict(zip(names, data[1:], strict=True)), encode, plugins, wanted)
        ends = [
            (number, replace(end, failure=end.failure and replace(end.failure, worker=worker.address)))
            for number, end in events
            if isinstance(end, JobEnd)
        ]
        return ends, time.monotonic() - began
    finally:
        slots.release(taken)


@cache
def _processes(thread: int, preload: tuple[str, ...]) -> Processes:  # noqa: ARG001 (each thread has its own)
    return Processes(1, (__name__, *preload), lasting=True)


@cache
def _slots(count: int) -> threading.Semaphore:
    return threading.Semaphore(count)
