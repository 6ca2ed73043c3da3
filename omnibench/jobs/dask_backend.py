"""Backend of a Dask cluster, of this machine's processes or one that an address joins, with its workers checked.

Results come back to the client, which alone writes the store. A job's begin, its reports and its end are events from
its worker, in JSON; the future tells that it is lost, and holds what is pickled, errors and results that are no text,
or too large for an event. A worker that is killed takes its jobs with it, and they are given to another. Their begins
are counted here, since the scheduler also counts jobs that only waited there. (A scheduler that was not started here
tries again by itself, by its own setting ``allowed-failures``: it may begin a job a fourth time before this hears of
it.)
"""

from __future__ import annotations

import asyncio
import logging
import pickle
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from errno import EDQUOT, ENOSPC
from importlib.util import find_spec
from itertools import count, islice
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

from omnibench.errors import ConfigError, DataError, OmnibenchError, one_line
from omnibench.jobs import dask_worker
from omnibench.jobs.job import TRIES, BackendError, Ended, Failure, Job, JobWatch, Store, TlsFiles
from omnibench.jobs.job_process import JobEnd, Packer
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
    "distributed.comm.timeouts.connect": f"{_ANSWER} s",
    "distributed.deploy.lost-worker-timeout": f"{WAIT} s",  # a worker here that was killed is started again until then
}


class ClusterLostError(BackendError):
    """The scheduler does not answer any more, or no worker is left."""

    exit_code = 1


def lost(client: Any) -> ClusterLostError:
    """The error of a client whose scheduler does not answer any more."""
    return ClusterLostError(
        f"the Dask scheduler {client.scheduler.address} is lost; start it again, then the same command"
    )


@contextmanager
def lost_if_closed(client: Any) -> Iterator[None]:
    """Turn the end of the connection, at whatever question it is seen, into ClusterLostError."""
    try:
        yield
    except CommClosedError:
        raise lost(client) from None


def count_slots(client: Any) -> int:
    """Threads of all workers. ClusterLostError: the scheduler does not answer."""
    if client.status != "running":
        raise lost(client)
    try:
        threads: dict[str, int] = client.sync(client.scheduler.ncores, callback_timeout=WAIT)
    except TimeoutError:  # it is frozen, or its machine is gone
        raise lost(client) from None
    return sum(threads.values())


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
        with interrupts_blocked():
            cluster = distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                security=True,  # certificates of its own: other users of this machine cannot join
                memory_limit=None,
                dashboard_address="127.0.0.1:8787",
                silence_logs=logging.CRITICAL,
            )
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
    with _closing(joined, _CLIENT_CLOSED) as client, lost_if_closed(client):
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


def say_cluster(client: Any, report: Reporter) -> None:
    """Report how many workers there are, and the page on which they can be watched."""
    page = client.dashboard_link
    if find_spec("bokeh") is None:  # which the dashboard needs; these pages do not
        page = page.replace("/status", "/info/main/workers.html")
    report(Progress("dask", result=f"{plural(len(client.nthreads()), 'worker')} of Dask, dashboard {page}"))


def checked_requirements(client: Any, preload: Sequence[str]) -> bytes:
    """What workers must have, after a check of those that are there. UnfitWorkerError in one line."""
    plugins = loaded_plugin_files()
    requirements = pickle.dumps(
        dask_worker.Requirements(
            software=dask_worker.software(),
            plugins={path: plugin_text(path) for path in plugins},
            failing=frozenset(failure.origin for failure in plugins.values() if failure is not None),
            preload=tuple(preload),
        )
    )
    answers = client.run(dask_worker.prepare, requirements, on_error="return")
    for worker, answer in answers.items():
        if isinstance(answer, dask_worker.UnfitWorkerError):
            raise answer
        if isinstance(answer, BaseException):  # another Python, or no omnibench
            reason = one_line(f"{type(answer).__name__}: {answer}")
            raise dask_worker.UnfitWorkerError(
                f"worker {worker} cannot run omnibench's jobs ({reason}); install the same there"
            )
    return requirements


_AHEAD = 2  # jobs a slot that are with the cluster: one at work, one that waits for it (chosen)
_FULL = (ENOSPC, EDQUOT)
_LOOK = 1.0  # s between two looks at the scheduler and its workers; chosen
_PARCEL = 0.2  # s of work that travel together: a task costs scheduler, client and worker 5 ms in all, 3 % of that
_LARGEST_PARCEL = 50  # jobs; chosen
_WEIGHT = 0.1  # weight of the latest job's time in the running mean; chosen
_WAITING = "waiting for a worker"
_SUBMISSIONS = 10  # times that a job is sent whose workers die before it begins: chosen, as it is no fault of its own


@dataclass(eq=False)
class _Pending:
    """A job that is with the cluster, in a parcel: the key of its task."""

    number: int
    job: Job[Any]
    parcel: str = ""
    submissions: int = 0
    begins: int = 0
    worker: str = "-"


@dataclass
class DaskBackend:
    """Runs jobs on the workers of a cluster. requirements: see ``checked_requirements``. report: told of waiting."""

    client: Any
    requirements: bytes
    report: Reporter = no_progress
    packer: Packer = field(default_factory=Packer)
    topic: str = field(default_factory=lambda: f"omnibench-{uuid4().hex[:12]}")
    events: SimpleQueue[object] = field(default_factory=SimpleQueue)
    _data: dict[str, Any] = field(default_factory=dict)
    _runs: Iterator[int] = field(default_factory=count)

    def __post_init__(self) -> None:
        put = self.events.put  # the client keeps what handles a topic, even when it is heard no more
        self.client.subscribe_topic(self.topic, lambda event: put(event[1]))

    def run(self, jobs: Iterable[tuple[int, Job[T]]], store: Store[T], watch: JobWatch[T]) -> Iterator[Ended]:
        """Run the jobs, see Backend. ClusterLostError, or UnfitWorkerError of a worker that joined later."""
        waiting = iter(jobs)
        with lost_if_closed(self.client):
            run = _Run(self, next(self._runs), store, watch)
            try:
                while True:
                    while run.room and (items := [_Pending(*item) for item in islice(waiting, run.parcel_size)]):
                        run.submit(items)
                    if not run.pending:
                        return
                    yield from run.ends()
            finally:
                run.close()

    def data(self, name: str, value: bytes) -> Any:
        """The future of data, which go to the scheduler once, and from there to each worker that needs them."""
        if name not in self._data or self._data[name].status == "error":  # workers were killed that were to hold them
            self._data[name] = self.client.submit(
                dask_worker.content, value, key=f"omnibench-data-{name}-{uuid4().hex[:8]}"
            )
        return self._data[name]


class _Run:
    """The jobs of one call of ``run``. number: of the call. pending: those with the cluster, by their numbers."""

    def __init__(self, backend: DaskBackend, number: int, store: Store[Any], watch: JobWatch[Any]) -> None:
        self.pending: dict[int, _Pending] = {}
        self._number = number
        self._backend, self._client, self._store, self._watch = backend, backend.client, store, watch
        self._futures: dict[str, Any] = {}
        self._numbers: dict[str, set[int]] = {}  # jobs of each parcel that have not ended
        self._seconds = _PARCEL  # a job takes about so long
        self._slots = max(count_slots(self._client), 1)
        self._without: float | None = None  # time since which there has been no worker
        self._looked = time.monotonic()

    @property
    def room(self) -> bool:
        """True if the cluster is to be given more."""
        return len(self._futures) < _AHEAD * self._slots

    @property
    def parcel_size(self) -> int:
        """Number of jobs that travel together, by the time that those before took."""
        return min(max(int(_PARCEL / max(self._seconds, 1e-6)), 1), _LARGEST_PARCEL)

    def submit(self, items: Sequence[_Pending]) -> None:
        """Give jobs to the cluster, in one parcel."""
        jobs: list[tuple[int, Job[Any]]] = []
        shared: dict[str, bytes] = {}
        key = f"{self._backend.topic}-{uuid4().hex[:12]}"
        for item in items:
            job = self._backend.packer.portable(item.job)
            shared |= job.argument.shared
            jobs.append((item.number, replace(job, argument=replace(job.argument, shared={}))))
            item.parcel = key
            item.submissions += 1
            self.pending[item.number] = item
        self._numbers[key] = {item.number for item in items}
        self._futures[key] = self._client.submit(
            dask_worker.carry_out,
            dask_worker.Parcel(self._backend.topic, self._number, self._store, tuple(jobs), tuple(shared)),
            self._backend.data("requirements", self._backend.requirements),
            *(self._backend.data(name, value) for name, value in shared.items()),
            key=key,
            pure=False,
        )

    def ends(self) -> Iterator[Ended]:
        """Wait a moment for events, which are passed on; the jobs that have ended."""
        texts: list[object] = []
        with suppress(Empty):
            texts.append(self._backend.events.get(timeout=_LOOK))
            while True:
                texts.append(self._backend.events.get_nowait())
        for text in texts:
            number, events = dask_worker.read_events(text)
            for event in events if number == self._number else ():  # others are of a call that was interrupted
                if (item := self.pending.get(event.number)) is not None:
                    yield from self._heard(item, event)
        if time.monotonic() - self._looked >= _LOOK:
            self._look()
            for key in [*self._futures]:
                yield from self._lost(key)

    def close(self) -> None:
        """Cancel what is left."""
        if self._client.status == "running" and self._futures:
            with suppress(OSError):  # a scheduler that does not answer in time
                self._client.cancel([*self._futures.values()], force=True)

    def _heard(self, item: _Pending, event: dask_worker.JobEvent) -> Iterator[Ended]:
        if event.progress is not None:
            self._watch.moved(item.number, event.progress)
        if event.fetch:
            with suppress(KilledWorker):  # ``_lost`` tells of such jobs
                try:
                    outcomes = self._futures[item.parcel].result()
                except FutureCancelledError:
                    raise lost(self._client) from None
                for outcome in outcomes:
                    if (fetched := self.pending.get(outcome.number)) is not None:
                        yield self._ended(fetched, outcome)
        elif event.answer is not None:
            yield self._ended(item, dask_worker.JobOutcome(item.number, JobEnd(event.answer), event.seconds))
        elif event.progress is None:
            item.begins += 1
            if item.begins > TRIES:
                yield self._given_up(item)
            else:
                item.worker = event.worker
                self._watch.began(item.number)

    def _ended(self, item: _Pending, outcome: dask_worker.JobOutcome) -> Ended:
        self._forget(item)
        self._seconds += _WEIGHT * (outcome.seconds - self._seconds)
        failure = outcome.end.failure(item.job)
        if failure is None:
            self._store.put_content(item.job.key, outcome.end.answer)
        elif isinstance(failure.error, OSError) and failure.error.errno in _FULL:
            raise DataError(f"worker {item.worker}: {failure.error}; free space there")
        elif item.job.own and isinstance(failure.error, DataError):
            raise DataError(f"worker {item.worker}: {failure.error} (workers must see the files of a large data set)")
        return Ended(item.number, item.job, failure)

    def _given_up(self, item: _Pending) -> Ended:
        """The end of a job whose workers were killed too often."""
        self._forget(item)
        tries = f"in each of {TRIES} tries" if item.begins >= TRIES else "each time before it began"
        return Ended(item.number, item.job, Failure(f"its worker was killed {tries} (the last: {item.worker})"))

    def _forget(self, item: _Pending) -> None:
        """The job is with the cluster no more; nor is its parcel, if it was the last."""
        del self.pending[item.number]
        numbers = self._numbers.get(item.parcel, set())  # none: the parcel is lost
        numbers.discard(item.number)
        if not numbers:
            self._close_parcel(item.parcel)

    def _close_parcel(self, key: str) -> None:
        self._numbers.pop(key, None)
        future = self._futures.pop(key, None)
        if future is not None and not future.done():  # it would go on with what was given up
            future.cancel()

    def _lost(self, key: str) -> Iterator[Ended]:
        """Look whether a parcel's workers were killed so often that the scheduler gave up; its jobs then go alone."""
        future = self._futures.get(key)
        if future is None or future.status in ("pending", "finished"):  # whose ends are under way
            return
        if future.status != "error":
            raise lost(self._client)
        error = future.exception()
        if isinstance(error, OmnibenchError):
            raise error  # a worker joined later and is unfit
        if not isinstance(error, KilledWorker):
            raise BackendError(f"a Dask worker failed ({one_line(f'{type(error).__name__}: {error}')}); start it again")
        items = [self.pending[number] for number in sorted(self._numbers[key])]
        self._close_parcel(key)
        for item in items:
            if item.begins >= TRIES or item.submissions >= _SUBMISSIONS:
                yield self._given_up(item)
            else:
                self.submit([item])

    def _look(self) -> None:
        """Count the slots. ClusterLostError: the scheduler is lost, or there has been no worker for long."""
        slots, self._looked = count_slots(self._client), time.monotonic()
        self._slots = max(slots, 1)
        if slots:
            if self._without is not None:
                self._backend.report(Progress(_WAITING, result=""))
            self._without = None
        elif self._without is None:
            self._without = self._looked
            self._backend.report(Progress(_WAITING))
        elif self._looked - self._without > WAIT:
            address = self._client.scheduler.address
            raise ClusterLostError(
                f"no worker has been left at the Dask scheduler {address} for {WAIT:g} s; start some "
                f"(dask worker {address}), then the same command"
            )
