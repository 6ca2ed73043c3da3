"""Clusters of Dask: one of this machine's processes, or one that an address joins; its workers checked."""

from __future__ import annotations

import asyncio
import logging
import pickle
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from multiprocessing import resource_tracker
from typing import Any
from urllib.parse import urlsplit

import dask
import distributed
from distributed.comm.core import CommClosedError, connect
from distributed.core import send_recv

from omnibench.errors import ConfigError, one_line
from omnibench.jobs.dask_worker import Requirements, UnfitWorkerError, differences, prepare, software
from omnibench.jobs.job import BackendError, TlsFiles
from omnibench.processes import interrupts_blocked, main_module_hidden
from omnibench.progress import Progress, Reporter
from omnibench.registry import loaded_plugin_files, plugin_text
from omnibench.words import plural

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
            for versions in (packages, software())
        )
        if wrong := differences(there, here):
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
        Requirements(
            software=software(),
            plugins={path: plugin_text(path) for path in plugins},
            failing=frozenset(failure.origin for failure in plugins.values() if failure is not None),
            preload=tuple(preload),
        )
    )
    answers = client.run(prepare, requirements, on_error="return")
    for worker, answer in answers.items():
        if isinstance(answer, UnfitWorkerError):
            raise answer
        if isinstance(answer, BaseException):  # another Python, or no omnibench
            reason = one_line(f"{type(answer).__name__}: {answer}")
            raise UnfitWorkerError(f"worker {worker} cannot run omnibench's jobs ({reason}); install the same there")
    return requirements
