"""Backend of a Dask cluster: of this machine's processes, or one that an address joins, with its workers checked.

Each job is a task, and its end is the task's result. That it begins and moves are events from its worker, in JSON. A
worker that is killed takes its jobs with it, and they are given to others. Their begins are counted here, since the
scheduler also counts jobs that only waited there. (A scheduler that was not started here tries again by itself, by its
own setting ``allowed-failures``, before this hears of it.)
"""

from __future__ import annotations

import asyncio
import json
import logging
import pickle
import time
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
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
from pydantic import TypeAdapter

from omnibench.errors import ConfigError, OmnibenchError, one_line
from omnibench.jobs import dask_worker
from omnibench.jobs.job import TRIES, BackendError, Failure, Job, JobEnd, JobWatch, TlsFiles
from omnibench.jobs.job_process import Packer
from omnibench.processes import interrupts_blocked, main_module_hidden
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import loaded_plugin_files, plugin_text
from omnibench.words import plural

T = TypeVar("T")

_CLIENT_CLOSED, _CLUSTER_CLOSED = 1.0, 5.0  # s in which they must have closed; chosen
_ANSWER = 10.0  # s in which a scheduler must answer; chosen
# s in which a worker must have joined, or be there again, and a scheduler at work must answer: workers of a batch
# system start with the first job (chosen).
WAIT = 60.0
_SETTINGS = {
    "distributed.scheduler.allowed-failures": 0,  # the backend tries again: it knows which jobs had begun
    "distributed.admin.large-graph-warning-threshold": "100 GB",  # data of jobs are kept by the scheduler on purpose
    "distributed.worker.memory.terminate": False,  # limits are those of jobs
    "distributed.worker.profile.enabled": False,  # nobody looks at it, and quick jobs pay for it
    "distributed.admin.low-level-log-length": 10,  # copies of messages, which nobody reads
    "distributed.admin.tick.interval": "500 ms",
    "distributed.comm.timeouts.connect": f"{WAIT} s",  # workers of a busy machine take long to join
    "distributed.deploy.lost-worker-timeout": f"{WAIT} s",  # a worker here that was killed is started again until then
}
_STARTS = 3  # tries to start a cluster: a worker may be killed as it starts; chosen
_AHEAD = 2  # jobs a slot that are with the cluster: one at work, one that waits for it (chosen)
_LOOK = 1.0  # s between two looks at the scheduler and its workers; chosen
_BATCH, _LARGEST_BATCH = 0.2, 50  # s of work, and jobs, that travel together: a task costs 5 ms in all; chosen
_WEIGHT = 0.1  # weight of the latest job's time in the running mean; chosen
_SUBMISSIONS = 10  # times that a job is sent whose workers die before it begins: chosen, as it is no fault of its own


class ClusterLostError(BackendError):
    """The scheduler does not answer any more, or no worker is left."""

    exit_code = 1


@contextmanager
def _lost_if_closed(client: Any) -> Iterator[None]:
    """Turn the end of the connection, at whatever question it is seen, into ClusterLostError."""
    try:
        yield
    except (CommClosedError, FutureCancelledError, TimeoutError):  # TimeoutError: it is frozen, or its machine is gone
        raise ClusterLostError(
            f"the Dask scheduler {client.scheduler.address} is lost; start it again, then the same command"
        ) from None


class _PackedClient(distributed.Client):
    """Client that leaves packed what others publish at the scheduler: distributed's own unpickles it, thus runs it."""

    async def _ensure_connected(self, timeout: Any = None) -> None:
        parent: Any = super()  # without types
        await parent._ensure_connected(timeout)
        if self.scheduler_comm is not None:
            self.scheduler_comm.comm.deserialize = False

    def _handle_task_erred(self, key: Any = None, exception: Any = None, traceback: Any = None) -> None:
        if key in self.futures:  # a task of this client
            parent: Any = super()
            parent._handle_task_erred(key, *_protocol.loads(_protocol.dumps([exception, traceback])))


_Client: Any = _PackedClient
_protocol: Any = distributed.protocol


@contextmanager
def dask_client(address: str | None, workers: int, tls: TlsFiles | None, report: Reporter) -> Iterator[Any]:
    """A client of the scheduler at ``address``, or of a cluster of so many processes that is started here.

    Its workers are not checked yet. ConfigError: nobody answers there, or a scheduler of another version.
    """
    # What goes wrong is said once, in words. The client of a lost scheduler goes on complaining until the process ends.
    for name in [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)  # each has a level of its own
    with warnings.catch_warnings(), dask.config.set(_SETTINGS):
        warnings.filterwarnings("ignore", module="distributed")
        with _local_client(workers) if address is None else _joined_client(address, tls, report) as client:
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
    with main_module_hidden():  # a worker that died is started again at any time
        cluster = None
        for tried in range(1, _STARTS + 1):
            try:
                with interrupts_blocked():
                    cluster = distributed.LocalCluster(
                        n_workers=workers,
                        threads_per_worker=1,
                        security=True,  # certificates of its own: other users of this machine cannot join
                        memory_limit=None,
                        dashboard_address="127.0.0.1:8787",
                        silence_logs=logging.CRITICAL,
                    )
                break
            except (RuntimeError, OSError) as error:
                if tried == _STARTS:
                    raise ClusterLostError(
                        f"the workers of Dask here do not start ({one_line(str(error))}), in {_STARTS} tries; free "
                        "memory or take fewer --workers, then the same command"
                    ) from None
        with (
            _closing(cluster, _CLUSTER_CLOSED),
            _closing(_Client(cluster, set_as_default=False), _CLIENT_CLOSED) as client,
        ):
            yield client


@contextmanager
def _joined_client(address: str, tls: TlsFiles | None, report: Reporter) -> Iterator[Any]:
    """A client of a scheduler that runs already, once it has a worker."""
    security = None
    if tls is not None:
        security = distributed.Security(
            tls_ca_file=str(tls.ca), tls_client_cert=str(tls.cert), tls_client_key=str(tls.key), require_encryption=True
        )
    try:
        with ThreadPoolExecutor(1) as thread:  # a notebook has a loop of its own in this one
            thread.submit(asyncio.run, _ask(address, security)).result()
        joined = _Client(address, timeout=_ANSWER, set_as_default=False, security=security)
    except ConfigError:
        raise
    except Exception as error:  # sockets, TLS and the protocol of another version raise what they like
        reason = one_line(str(error) or f"whoever listens there says nothing that Dask knows within {_ANSWER:g} s")
        raise ConfigError(
            f"no Dask scheduler answers at {address} ({reason}); start one (dask scheduler), or correct the address"
        ) from None
    with _closing(joined, _CLIENT_CLOSED) as client, _lost_if_closed(client):
        packages = client.get_versions()["scheduler"]["packages"]
        there, here = (
            {name: versions[name] for name in ("dask", "distributed") if name in versions}
            for versions in (packages, dask_worker.software())
        )
        if wrong := dask_worker.differences(there, here):
            raise ConfigError(f"scheduler {address} has {', '.join(wrong)}; install the same on both sides")
        if not client.nthreads():
            report(Progress("waiting for a worker"))
            try:
                client.wait_for_workers(1, timeout=WAIT)
            except TimeoutError:
                raise ConfigError(
                    f"no worker has joined the scheduler {address} for {WAIT:g} s; start some (dask worker {address})"
                ) from None
            report(Progress("waiting for a worker", result=""))
        yield client


async def _ask(address: str, security: Any) -> None:
    """Ask who listens. A client waits without end where it is no scheduler, but a web server or a worker.

    ConfigError: a worker, or another part of Dask.
    """
    place = urlsplit(address)
    await asyncio.get_running_loop().getaddrinfo(place.hostname, place.port)  # an unknown host is said at once
    arguments = {} if security is None else security.get_connection_args("client")
    comm = await asyncio.wait_for(connect(address, timeout=_ANSWER, **arguments), _ANSWER + 1)
    try:
        identity = await asyncio.wait_for(send_recv(comm, op="identity", reply=True), _ANSWER)
    finally:
        comm.abort()
    if (kind := identity["type"]) != "Scheduler":
        raise ConfigError(f"{address} is a {kind.lower()} of Dask; give the address of its scheduler")


class DaskBackend:
    """Runs jobs on the workers of a cluster, after a check of those that are there. UnfitWorkerError in one line.

    preload: modules that jobs need. report: told how many workers there are, where the page is on which they can be
    watched, and of waiting.
    """

    def __init__(self, client: Any, preload: Sequence[str], report: Reporter = no_progress) -> None:
        self.client, self._report = client, report
        self.topic = f"omnibench-{uuid4().hex[:12]}"
        self.news: SimpleQueue[object] = SimpleQueue()  # texts of events, and futures that are done
        self._packer = Packer()
        self._data: dict[str, Any] = {}
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
            if isinstance(answer, dask_worker.UnfitWorkerError):
                raise answer
            if isinstance(answer, BaseException):  # another Python, or no omnibench
                reason = one_line(f"{type(answer).__name__}: {answer}")
                raise dask_worker.UnfitWorkerError(
                    f"worker {worker} cannot run omnibench's jobs ({reason}); install the same there"
                )
        put = self.news.put  # the client keeps what handles a topic, even when it is heard no more
        client.subscribe_topic(self.topic, lambda event: put(event[1]))
        page = client.dashboard_link
        if find_spec("bokeh") is None:  # which the dashboard needs; these pages do not
            page = page.replace("/status", "/info/main/workers.html")
        report(Progress("dask", result=f"{plural(len(answers), 'worker')} of Dask, dashboard {page}"))

    def run(
        self, jobs: Iterable[tuple[int, Job[T]]], encode: Callable[[T], Any], watch: JobWatch[T]
    ) -> Generator[tuple[int, Job[T], JobEnd], None, None]:
        """Run the jobs, see Backend. ClusterLostError, or UnfitWorkerError of a worker that joined later."""
        waiting = iter(jobs)
        active: dict[str, tuple[Any, dict[int, Job[T]]]] = {}  # by the key of the task: its future and jobs
        begins, submissions = Counter[int](), Counter[int]()
        seconds = _BATCH  # a job takes about so long

        def submit(batch: dict[int, Job[T]]) -> None:
            submissions.update(list(batch))
            packed = tuple((number, self._packer.pack(job)) for number, job in batch.items())
            names = tuple({name: None for _, job in packed for name in job.names})
            timed = any(job.timed for job in batch.values())
            future = self.client.submit(
                dask_worker.carry_out,
                dask_worker.Batch(packed, names, encode, timed, self.topic),
                self._content("requirements", self._requirements),
                *(self._content(name, self._packer.shared[name]) for name in names),
                key=f"{self.topic}-{uuid4().hex[:12]}",
                pure=False,
            )
            active[future.key] = future, batch
            future.add_done_callback(self.news.put)

        with _lost_if_closed(self.client):
            slots, looked = self._slots(), time.monotonic()
            try:
                while True:
                    size = min(max(int(_BATCH / max(seconds, 1e-6)), 1), _LARGEST_BATCH)
                    while len(active) < _AHEAD * slots and (batch := dict(islice(waiting, size))):
                        submit(batch)
                    if not active:
                        return
                    if time.monotonic() - looked >= _LOOK:
                        slots, looked = self._slots(), time.monotonic()
                    try:
                        news = self.news.get(timeout=_LOOK)
                    except Empty:
                        continue
                    if not isinstance(news, distributed.Future):
                        key, number, event = _read_event(news)
                        _, batch = active.get(key, (None, {}))  # none: of a call that was interrupted
                        if event is None:
                            begins.update(list(batch))
                            for number in batch:
                                watch.began(number)
                        elif number in batch:
                            watch.moved(number, event)
                    elif str(news.key) in active:
                        future, batch = active.pop(str(news.key))
                        if (error := _error(future)) is None:
                            ends, spent = future.result()
                            seconds += _WEIGHT * (spent / len(batch) - seconds)
                            for number, end in ends:
                                yield number, batch[number], end
                            continue
                        for number, job in batch.items():
                            if begins[number] < TRIES and submissions[number] < _SUBMISSIONS:
                                submit({number: job})
                            else:
                                tries = f"in each of {begins[number]} tries" if begins[number] else "before it began"
                                reason = f"its worker was killed {tries} (the last: {error.last_worker.address})"
                                yield number, job, JobEnd(failure=Failure(reason))
            finally:
                if self.client.status == "running" and active:
                    with suppress(OSError):  # a scheduler that does not answer in time
                        self.client.cancel([future for future, _ in active.values()], force=True)

    def _content(self, name: str, value: bytes) -> Any:
        """The future of data, which go to the scheduler once, and from there to each worker that needs them."""
        if name not in self._data or self._data[name].status == "error":  # workers were killed that were to hold them
            key = f"omnibench-data-{name}-{uuid4().hex[:8]}"
            self._data[name] = self.client.submit(dask_worker.content, value, key=key)
        return self._data[name]

    def _slots(self) -> int:
        """Threads of all workers, 1 without any. ClusterLostError: there has been no worker for long."""
        if self.client.status != "running":
            raise CommClosedError
        slots = sum(self.client.sync(self.client.scheduler.ncores, callback_timeout=WAIT).values())
        if slots:
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
        return max(slots, 1)


def _error(future: Any) -> KilledWorker | None:
    """Why the workers of a task that is done were killed; None if it has ended well. BackendError for all else."""
    if future.status == "finished":
        return None
    if future.status != "error":  # the scheduler is gone
        raise CommClosedError
    error = future.exception()
    if isinstance(error, KilledWorker):
        return error
    if isinstance(error, OmnibenchError):
        raise error  # a worker joined later and is unfit
    raise BackendError(f"a Dask worker failed ({one_line(f'{type(error).__name__}: {error}')}); start it again")


def _read_event(text: object) -> tuple[str, int, Progress | None]:
    """Key of a task, number of a job and its progress (None: all begin); no key for what our workers do not write."""
    try:
        return _EVENT.validate_python(json.loads(text) if isinstance(text, str) else None)
    except (ValueError, RecursionError):  # ValueError: pydantic's errors, too
        return "", 0, None


_EVENT = TypeAdapter(tuple[str, int, Progress | None])
