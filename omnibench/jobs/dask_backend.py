"""Backend of a Dask cluster: of this machine's processes, or one that an address joins.

Some quick jobs, or one that is not, are a task, and their ends its result. A worker has a task for each of its threads
and none that waits, so that a worker that is killed takes only jobs that it had begun. They are tried again like jobs
whose process was killed. (A scheduler that was not started here tries again by itself, by its own setting
``allowed-failures``.) Beneath a worker jobs run in processes of their own, so that limits, isolation and threads are
those of the processes of one machine, and results are equal to the bit. The software that results depend on is compared
before the first job.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import multiprocessing
import os
import pickle
import threading
import time
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar
from urllib.parse import urlsplit
from uuid import uuid4

import dask
import distributed
from distributed import KilledWorker
from distributed.client import FutureCancelledError
from distributed.comm.core import CommClosedError

from omnibench.errors import ConfigError, DataError, OmnibenchError, one_line
from omnibench.files import write_text
from omnibench.jobs.job import BackendError, Encode, Ends, Failure, Job, JobEnd, JobWatch, Numbered, TlsFiles, software
from omnibench.jobs.job_process import PackedJob, Packer, Processes
from omnibench.processes import interrupts_blocked, main_module_hidden
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import import_copies, loaded_plugin_files, plugin_text
from omnibench.words import plural

T = TypeVar("T")

_CLOSED = 5.0  # s in which a client or a cluster must have closed; chosen
_ANSWER = 10.0  # s in which a scheduler must answer; chosen
# s in which a worker must be there, or there again, and a scheduler at work must answer: workers of a batch system
# start with the first job (chosen).
WAIT = 60.0
_SETTINGS = {
    "distributed.scheduler.allowed-failures": 0,  # ``run_jobs`` tries again, after all other jobs
    "distributed.admin.large-graph-warning-threshold": "100 GB",  # data of jobs are kept by the scheduler on purpose
    "distributed.worker.memory.terminate": False,  # limits are those of jobs
    "distributed.worker.profile.enabled": False,  # nobody looks at it, and quick jobs pay for it
    "distributed.admin.low-level-log-length": 10,  # copies of messages, which nobody reads
    "distributed.admin.tick.interval": "500 ms",
    "distributed.comm.timeouts.connect": f"{WAIT} s",  # workers take long to join on a busy machine
    "distributed.deploy.lost-worker-timeout": f"{WAIT} s",  # a worker here that was killed is started again until then
}
_STARTS = 3  # tries to start a cluster here, as a worker may be killed while it starts; chosen
_LOOK = 1.0  # s between two looks at the scheduler and its workers; chosen
_BATCH, _LARGEST_BATCH = 0.5, 100  # s of work, and jobs, that travel together: a task costs 5 ms in all; chosen
_PROBE = 1_000_000  # bytes that a worker must be able to write: a plug-in's file and what a job notes down (chosen)

_preparing, _taking_slots = threading.Lock(), threading.Lock()


class UnfitWorkerError(BackendError):
    """A worker on which results could differ from the client's, or that cannot run jobs."""


class ClusterLostError(BackendError):
    """The scheduler does not answer any more, or no worker is left."""

    exit_code = 1


@contextmanager
def dask_client(address: str | None, workers: int, tls: TlsFiles | None) -> Iterator[Any]:
    """A client of the scheduler at ``address``, or of a cluster of so many processes that is started here.

    ConfigError: nobody answers there, or a scheduler of another version. ClusterLostError: no cluster starts here.
    """
    # What goes wrong is said once, in words. The client of a lost scheduler goes on complaining until the process ends.
    for name in [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)  # each has a level of its own
    with warnings.catch_warnings(), dask.config.set(_SETTINGS):
        warnings.filterwarnings("ignore", module="distributed")
        with _local_client(workers) if address is None else _closing(_joined(address, tls)) as client:
            yield client


@contextmanager
def _closing(opened: Any) -> Iterator[Any]:
    """Close a client or a cluster after the block, whose end counts: that they do not close in time is not told."""
    try:
        yield opened
    finally:
        with suppress(OSError):  # TimeoutError and CommClosedError are some
            opened.close(timeout=_CLOSED)


@contextmanager
def _local_client(workers: int) -> Iterator[Any]:
    """A client of a cluster of this machine's processes, which leave Ctrl-C to this one."""
    resource_tracker.ensure_running()  # the first worker would start it, and unblock what is blocked
    # The cluster has certificates of its own: other users of this machine cannot join.
    options = {"threads_per_worker": 1, "memory_limit": None, "security": True, "dashboard_address": "127.0.0.1:8787"}
    with main_module_hidden():  # a worker that died is started again at any time
        for _ in range(_STARTS):
            try:
                with interrupts_blocked():
                    cluster = distributed.LocalCluster(workers, silence_logs=logging.CRITICAL, **options)
                break
            except (RuntimeError, OSError) as error:
                reason = one_line(str(error))
        else:
            raise ClusterLostError(
                f"no workers of Dask start here ({reason}), in {_STARTS} tries; results so far are kept: free memory "
                "or take fewer workers, then the same command"
            )
        with _closing(cluster), _closing(distributed.Client(cluster, set_as_default=False)) as client:
            yield client


def _joined(address: str, tls: TlsFiles | None) -> Any:
    """A client of a scheduler that runs already."""
    files = {} if tls is None else {"ca_file": tls.ca, "client_cert": tls.cert, "client_key": tls.key}
    options = {f"tls_{part}": str(file) for part, file in files.items()}
    security = distributed.Security(**options, require_encryption=tls is not None)
    arguments = security.get_connection_args("client")

    async def listener() -> tuple[str, str]:
        """Who listens and, of a scheduler, the version. A client would wait without end for what is none."""
        place = urlsplit(address)
        await asyncio.get_running_loop().getaddrinfo(place.hostname, place.port)  # an unknown host is said at once
        async with asyncio.timeout(_ANSWER + 1), distributed.rpc(address, None, True, _ANSWER, arguments) as asked:
            kind = (await asked.identity())["type"]
            return kind, (await asked.versions())["packages"]["distributed"] if kind == "Scheduler" else ""

    here = software()["distributed"]
    try:
        with ThreadPoolExecutor(1) as thread:  # a notebook has a loop of its own in this one
            kind, there = thread.submit(asyncio.run, listener()).result()
        if kind == "Scheduler" and there == here:
            return distributed.Client(address, timeout=_ANSWER, set_as_default=False, security=security)
    except Exception as error:  # sockets, TLS and the protocol of another version raise what they like
        reason = one_line(str(error) or f"whoever listens there says nothing that Dask knows within {_ANSWER:g} s")
        raise ConfigError(
            f"no Dask scheduler answers at {address} ({reason}); start one (dask scheduler), or correct the address"
        ) from None
    if kind == "Scheduler":
        raise ConfigError(f"scheduler {address} has distributed {there} (here: {here}); install the same")
    raise ConfigError(f"{address} is a {kind.lower()} of Dask; give the address of its scheduler")


class DaskBackend:
    """Runs jobs on the workers of a cluster, after a check of those that are there. UnfitWorkerError in one line.

    preload: modules that jobs need. report: told how many workers there are, where the page is on which they can be
    watched, and of waiting.
    """

    def __init__(self, client: Any, preload: Sequence[str], report: Reporter = no_progress) -> None:
        self.client, self._report = client, report
        self._packer = Packer()
        self._data: dict[str, Any] = {}  # futures, by name
        self._missing, self._since = False, 0.0  # whether there is no worker, and the time since which it is so
        plugins = loaded_plugin_files()
        texts = {path: plugin_text(path) for path in plugins}
        failing = {failure.origin for failure in plugins.values() if failure is not None}  # and may fail there, too
        self._requirements = pickle.dumps((software(), texts, failing, tuple(preload)))
        answers = client.run(prepare, self._requirements, on_error="return")
        for worker, answer in answers.items():
            if isinstance(answer, OmnibenchError):
                raise answer
            if isinstance(answer, BaseException):  # another Python, or no omnibench
                reason = one_line(f"worker {worker} cannot run omnibench's jobs ({type(answer).__name__}: {answer})")
                raise UnfitWorkerError(f"{reason}; install the same there")
        page = client.dashboard_link
        if find_spec("bokeh") is None:  # which the dashboard needs; these pages do not
            page = page.replace("/status", "/info/main/workers.html")
        report(Progress("dask", result=f"{plural(len(answers), 'worker')} of Dask, dashboard {page}"))

    def run(self, jobs: Iterable[Numbered[T]], encode: Encode, watch: JobWatch[T]) -> Ends[T]:
        """Run the jobs, see Backend. ClusterLostError, or UnfitWorkerError of a worker that joined later."""
        waiting, batch = iter(jobs), dict[int, Job[T]]()
        alone: list[dict[int, Job[T]]] = []  # jobs of batches whose worker was killed
        active: dict[Any, tuple[dict[int, Job[T]], str]] = {}  # jobs and their worker, by their task's future
        done: SimpleQueue[Any] = SimpleQueue()  # futures
        free: list[str] = []  # a worker for each of its free threads
        looked, size = 0.0, 1
        try:
            while True:
                if time.monotonic() - looked >= _LOOK:
                    free, looked = self._free(worker for _, worker in active.values()), time.monotonic()
                batch = batch or (alone.pop() if alone else dict(islice(waiting, size)))
                if batch and free:
                    future = self._submit(batch, encode, free[-1])
                    active[future] = batch, free.pop()
                    future.add_done_callback(done.put)
                    for number in batch:
                        watch.began(number)
                    batch = {}
                    continue
                if not batch and not active:
                    return
                try:
                    future = done.get(timeout=_LOOK)
                except Empty:
                    continue
                ended, worker = active.pop(future)
                error = future.exception() if future.status == "error" else None
                if isinstance(error, KilledWorker):
                    looked = 0.0
                    # A scheduler that was not started here has tried again by itself.
                    tries = f" in each of {error.allowed_failures + 1} tries" if error.allowed_failures else ""
                    failure = Failure(f"its worker {error.last_worker.address} was killed{tries}", killed=not tries)
                    if len(ended) > 1:
                        alone += [{number: job} for number, job in ended.items()]
                    else:
                        ((number, job),) = ended.items()
                        yield number, job, JobEnd(failure=failure)
                elif error is not None:
                    reason = one_line(f"{type(error).__name__}: {error}")
                    failed = BackendError(f"a Dask worker failed ({reason}); start it again")
                    raise error if isinstance(error, OmnibenchError) else failed  # a worker joined later and is unfit
                else:
                    ends, spent = future.result()
                    free.append(worker)
                    size = max(min(2 * size, _LARGEST_BATCH, int(_BATCH * len(ended) / spent)), 1)
                    for number, end in ends:
                        yield number, ended[number], end
        except (CommClosedError, FutureCancelledError, TimeoutError):  # TimeoutError: it is frozen, or its machine gone
            address = self.client.scheduler.address
            raise ClusterLostError(
                f"the Dask scheduler {address} is lost; start it again, then the same command"
            ) from None
        finally:
            if self.client.status == "running" and active:
                with suppress(OSError):  # a scheduler that does not answer in time
                    self.client.cancel([*active], force=True)

    def _submit(self, batch: dict[int, Job[T]], encode: Encode, worker: str) -> Any:
        """The future of a batch's task, for another worker if this one is gone."""
        packed = {number: self._packer.pack(job) for number, job in batch.items()}
        needed = {name: content for job in packed.values() for name, content in job.shared.items()}
        needed["requirements"] = self._requirements
        for name, content in needed.items():  # which goes to the scheduler once, and from there to workers that need it
            if name not in self._data or self._data[name].status == "error":  # workers were killed that were to hold it
                key = f"omnibench-data-{name}-{uuid4().hex[:8]}"
                self._data[name] = self.client.submit(held, content, key=key)
        light = [(number, replace(job, shared=dict.fromkeys(job.shared, b""))) for number, job in packed.items()]
        timed, data = any(job.timed for job in batch.values()), {name: self._data[name] for name in needed}
        options = {"workers": [worker], "allow_other_workers": True, "pure": False}
        return self.client.submit(carry_out, light, encode, timed, data, **options)

    def _free(self, busy: Iterable[str]) -> list[str]:
        """A worker for each of its threads that is not ``busy``. ClusterLostError: no worker for long."""
        if self.client.status != "running":
            raise CommClosedError
        threads = Counter[str](self.client.sync(self.client.scheduler.ncores, callback_timeout=WAIT))
        if (missing := not threads) != self._missing:
            self._missing, self._since = missing, time.monotonic()
            self._report(Progress("waiting for a worker", result=None if missing else ""))
        if missing and time.monotonic() - self._since > WAIT:
            address = self.client.scheduler.address
            raise ClusterLostError(
                f"no worker has been left at the Dask scheduler {address} for {WAIT:g} s; start some "
                f"(dask worker {address}), then the same command"
            )
        return [*(threads - Counter(busy)).elements()]


def prepare(requirements: bytes, dask_worker: Any) -> tuple[dict[Path, Path], tuple[str, ...]]:
    """Check a worker, once for the same requirements: copies of plug-in files there, and modules to preload.

    UnfitWorkerError in one line: results could differ there, or it cannot run jobs.
    """
    with _preparing:
        return _prepared(requirements, dask_worker.address, Path(dask_worker.local_directory))


@cache
def _prepared(requirements: bytes, address: str, folder: Path) -> tuple[dict[Path, Path], tuple[str, ...]]:
    os.environ.pop("MALLOC_TRIM_THRESHOLD_", None)  # a nanny's: with it arrays take half as long again as at home
    multiprocessing.current_process().daemon = False  # a nanny's workers may not start processes otherwise
    here, texts, failing, preload = pickle.loads(requirements)
    there = software()
    names = [name for name in here | there if here.get(name) != there.get(name)]
    if wrong := [f"{name} {there.get(name, 'missing')} (here: {here.get(name, 'missing')})" for name in names]:
        raise UnfitWorkerError(
            f"worker {address} has {', '.join(wrong)}: results could differ; install the same on the worker, or work "
            "with workers that have it"
        )
    copies = folder / f"omnibench-{hashlib.sha256(requirements).hexdigest()[:10]}"
    plugins = {path: copies / str(number) / path.name for number, path in enumerate(texts)}
    try:
        write_text(copies / "probe", " " * _PROBE)
        (copies / "probe").unlink()
        for path, copy in plugins.items():
            write_text(copy, texts[path])
    except (OSError, DataError) as error:
        raise UnfitWorkerError(f"worker {address}: {error}") from None
    jobs = [(0, Job("plug-ins", _import_all, (plugins, failing)))] if plugins else []
    for _, _, end in Processes(1, preload).run(jobs, list, JobWatch()):  # in a process, which they may crash
        crash = end.failure and f"its plug-ins cannot be imported there: {end.failure.reason}"
        if flaws := [crash] if crash else end.encoded:
            raise UnfitWorkerError(f"worker {address}: {flaws[0]}")
    return plugins, preload


def _import_all(order: tuple[Mapping[Path, Path], set[str]], _: Reporter) -> list[str]:
    plugins, failing = order
    what = "plug-in {0.origin} cannot be imported there: {0.error}; install on the worker what it needs"
    return [what.format(failure) for failure in import_copies(plugins) if failure.origin not in failing]


def held(data: bytes) -> bytes:
    """Task that holds data for jobs: where all workers that hold it are lost, the scheduler runs it again."""
    return data


def carry_out(
    jobs: Sequence[tuple[int, PackedJob]], encode: Encode, timed: bool, data: Mapping[str, bytes]
) -> tuple[list[tuple[int, JobEnd]], float]:
    """Task of some jobs, one after the other: their ends, and the seconds that they took.

    timed: they have the worker to themselves. data: requirements, and contents of what the jobs share.
    UnfitWorkerError: this worker joined after the first job, and is not as it must be.
    """
    worker: Any = distributed.get_worker()
    key, (plugins, preload) = worker.get_current_task(), prepare(data["requirements"], worker)
    pool = _processes(threading.get_ident(), preload)
    whole = [(number, replace(job, shared={name: data[name] for name in job.shared})) for number, job in jobs]
    slots, taken = _slots(worker.state.nthreads), worker.state.nthreads if timed else 1

    def wanted() -> bool:
        task = worker.state.tasks.get(key)  # none once the client is gone
        return task is not None and task.state != "cancelled"

    with _taking_slots:  # one after the other, or two that need several would wait for each other
        for _ in range(taken):
            slots.acquire()
    try:
        began = time.monotonic()
        ends = [
            (number, replace(end, failure=end.failure and replace(end.failure, worker=worker.address)))
            for number, _, end in pool.run(whole, encode, JobWatch(), plugins, wanted)
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
