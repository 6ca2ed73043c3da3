"""Backend of a Dask cluster: of this machine's processes, or one that an address joins.

Some quick jobs, or one that is not, are a task, and their ends its result. A worker has a task for each of its threads
and none that waits, so that a worker that is killed takes only jobs that it had begun. They are tried again like jobs
whose process was killed. (A scheduler that was not started here tries again by itself, by its own setting
``allowed-failures``.)
"""

from __future__ import annotations

import asyncio
import logging
import pickle
import time
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from itertools import islice
from multiprocessing import resource_tracker
from queue import Empty, SimpleQueue
from typing import Any, TypeVar
from urllib.parse import urlsplit
from uuid import uuid4

import dask
import distributed
from distributed import KilledWorker
from distributed.client import FutureCancelledError
from distributed.comm.core import CommClosedError, connect
from distributed.core import send_recv

from omnibench.errors import ConfigError, OmnibenchError, one_line
from omnibench.jobs import dask_worker
from omnibench.jobs.job import BackendError, Encode, Ends, Failure, Job, JobEnd, JobWatch, Numbered, TlsFiles
from omnibench.jobs.job_process import Packer
from omnibench.processes import interrupts_blocked, main_module_hidden
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import loaded_plugin_files, plugin_text
from omnibench.words import plural

T = TypeVar("T")

_CLIENT_CLOSED, _CLUSTER_CLOSED = 1.0, 5.0  # s in which they must have closed; chosen
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
        with _local_client(workers) if address is None else _closing(_joined(address, tls), _CLIENT_CLOSED) as client:
            yield client


@contextmanager
def _closing(opened: Any, seconds: float) -> Iterator[Any]:
    """Close a client or a cluster after the block, whose end counts: that they do not close in time is not told."""
    try:
        yield opened
    finally:
        with suppress(OSError):  # TimeoutError and CommClosedError are some
            opened.close(timeout=seconds)


@contextmanager
def _local_client(workers: int) -> Iterator[Any]:
    """A client of a cluster of this machine's processes, which leave Ctrl-C to this one."""
    resource_tracker.ensure_running()  # the first worker would start it, and unblock what is blocked
    # The cluster has certificates of its own: other users of this machine cannot join.
    options = {"n_workers": workers, "threads_per_worker": 1, "memory_limit": None, "security": True}
    with main_module_hidden():  # a worker that died is started again at any time
        for tried in range(1, _STARTS + 1):
            try:
                with interrupts_blocked():
                    cluster = distributed.LocalCluster(
                        **options, dashboard_address="127.0.0.1:8787", silence_logs=logging.CRITICAL
                    )
                break
            except (RuntimeError, OSError) as error:
                if tried == _STARTS:
                    raise ClusterLostError(
                        f"no workers of Dask start here ({one_line(str(error))}), in {_STARTS} tries; results so "
                        "far are kept: free memory or take fewer workers, then the same command"
                    ) from None
        with (
            _closing(cluster, _CLUSTER_CLOSED),
            _closing(distributed.Client(cluster, set_as_default=False), _CLIENT_CLOSED) as client,
        ):
            yield client


def _joined(address: str, tls: TlsFiles | None) -> Any:
    """A client of a scheduler that runs already."""
    security = None
    if tls is not None:
        security = distributed.Security(
            tls_ca_file=str(tls.ca), tls_client_cert=str(tls.cert), tls_client_key=str(tls.key), require_encryption=True
        )
    try:
        with ThreadPoolExecutor(1) as thread:  # a notebook has a loop of its own in this one
            kind = thread.submit(asyncio.run, _kind(address, security)).result()
        if kind != "Scheduler":
            raise ConfigError(f"{address} is a {kind.lower()} of Dask; give the address of its scheduler")
        client: Any = distributed.Client(address, timeout=_ANSWER, set_as_default=False, security=security)
        there, here = (
            client.get_versions()["scheduler"]["packages"]["distributed"],
            dask_worker.software()["distributed"],
        )
        if there != here:
            client.close(timeout=_CLIENT_CLOSED)
            raise ConfigError(f"scheduler {address} has distributed {there} (here: {here}); install the same")
    except ConfigError:
        raise
    except Exception as error:  # sockets, TLS and the protocol of another version raise what they like
        reason = one_line(str(error) or f"whoever listens there says nothing that Dask knows within {_ANSWER:g} s")
        raise ConfigError(
            f"no Dask scheduler answers at {address} ({reason}); start one (dask scheduler), or correct the address"
        ) from None
    return client


async def _kind(address: str, security: Any) -> str:
    """The kind of who listens. A client waits without end where it is no scheduler, but a web server or a worker."""
    place = urlsplit(address)
    await asyncio.get_running_loop().getaddrinfo(place.hostname, place.port)  # an unknown host is said at once
    arguments = {} if security is None else security.get_connection_args("client")
    comm = await asyncio.wait_for(connect(address, timeout=_ANSWER, **arguments), _ANSWER + 1)
    try:
        identity = await asyncio.wait_for(send_recv(comm, op="identity", reply=True), _ANSWER)
    finally:
        comm.abort()
    return str(identity["type"])


class DaskBackend:
    """Runs jobs on the workers of a cluster, after a check of those that are there. UnfitWorkerError in one line.

    preload: modules that jobs need. report: told how many workers there are, where the page is on which they can be
    watched, and of waiting.
    """

    def __init__(self, client: Any, preload: Sequence[str], report: Reporter = no_progress) -> None:
        self.client, self._report = client, report
        self._packer = Packer()
        self._data: dict[str, Any] = {}  # futures, by name
        self._without: float | None = None  # time since which there has been no worker
        plugins = loaded_plugin_files()
        self._requirements = pickle.dumps(
            dask_worker.Requirements(
                software=dask_worker.software(),
                plugins={path: plugin_text(path) for path in plugins},
                failing=frozenset(failure.origin for failure in plugins.values() if failure is not None),
                preload=tuple(preload),
            )
        )
        answers = client.run(dask_worker.prepare, self._requirements, on_error="return")
        for worker, answer in answers.items():
            if isinstance(answer, OmnibenchError):
                raise answer
            if isinstance(answer, BaseException):  # another Python, or no omnibench
                reason = one_line(f"worker {worker} cannot run omnibench's jobs ({type(answer).__name__}: {answer})")
                raise dask_worker.UnfitWorkerError(f"{reason}; install the same there")
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
                elif isinstance(error, OmnibenchError):
                    raise error  # a worker joined later and is unfit
                elif error is not None:
                    reason = one_line(f"{type(error).__name__}: {error}")
                    raise BackendError(f"a Dask worker failed ({reason}); start it again")
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
        packed = tuple((number, self._packer.pack(job)) for number, job in batch.items())
        names = tuple({name: None for _, job in packed for name in job.names})
        timed = any(job.timed for job in batch.values())
        needed = {"requirements": self._requirements} | {name: self._packer.shared[name] for name in names}
        for name, content in needed.items():  # which goes to the scheduler once, and from there to workers that need it
            if name not in self._data or self._data[name].status == "error":  # workers were killed that were to hold it
                key = f"omnibench-data-{name}-{uuid4().hex[:8]}"
                self._data[name] = self.client.submit(dask_worker.content, content, key=key)
        data = [self._data[name] for name in needed]
        options = {"workers": [worker], "allow_other_workers": True, "pure": False}
        return self.client.submit(dask_worker.carry_out, packed, names, encode, timed, *data, **options)

    def _free(self, busy: Iterable[str]) -> list[str]:
        """A worker for each of its threads that is not ``busy``. ClusterLostError: no worker for long."""
        if self.client.status != "running":
            raise CommClosedError
        threads = Counter[str](self.client.sync(self.client.scheduler.ncores, callback_timeout=WAIT))
        if threads:
            if self._without is not None:
                self._report(Progress("waiting for a worker", result=""))
            self._without = None
        elif self._without is None:
            self._without = time.monotonic()
            self._report(Progress("waiting for a worker"))
        elif time.monotonic() - self._without > WAIT:
            address = self.client.scheduler.address
            raise ClusterLostError(
                f"no worker has been left at the Dask scheduler {address} for {WAIT:g} s; start some "
                f"(dask worker {address}), then the same command"
            )
        return [*(threads - Counter(busy)).elements()]
