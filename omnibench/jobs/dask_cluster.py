"""Clusters of Dask: one of this machine's processes, or one that an address joins; its workers checked."""

from __future__ import annotations

import asyncio
import logging
import pickle
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib.util import find_spec
from multiprocessing import resource_tracker
from typing import Any

import dask
import distributed
from distributed.comm.core import CommClosedError, connect

from omnibench.errors import ConfigError, one_line
from omnibench.jobs.dask_worker import Requirements, UnfitWorkerError, check
from omnibench.jobs.job import BackendError
from omnibench.jobs.scheduler_tls import TlsFiles
from omnibench.jobs.software import software
from omnibench.processes import interrupts_blocked, main_module_hidden
from omnibench.progress import Progress, Reporter
from omnibench.registry import loaded_plugin_files, plugin_text
from omnibench.words import plural

_ANSWER = 10.0  # s in which a scheduler must answer; chosen
_WORKER = 60.0  # s in which a worker must have joined: those of a batch system start with the first job (chosen)
_SETTINGS = {
    "distributed.scheduler.allowed-failures": 0,  # the backend tries again: it knows which jobs had begun
    "distributed.admin.large-graph-warning-threshold": "100 GB",  # data of jobs are kept by the scheduler on purpose
    "distributed.worker.memory.terminate": False,  # limits are those of jobs
    "distributed.worker.profile.enabled": False,  # nobody looks at it, and quick jobs pay for it
    "distributed.admin.low-level-log-length": 10,  # copies of messages, which nobody reads
    "distributed.admin.tick.interval": "500 ms",
    "distributed.comm.timeouts.connect": f"{_ANSWER} s",
}


class SchedulerLostError(BackendError):
    """The scheduler does not answer any more."""

    exit_code = 1


def lost(client: Any) -> SchedulerLostError:
    """The error of a client whose scheduler does not answer any more."""
    return SchedulerLostError(f"the Dask scheduler {client.scheduler.address} is lost")


@contextmanager
def lost_if_closed(client: Any) -> Iterator[None]:
    """Turn the end of the connection, at whatever question it is seen, into SchedulerLostError."""
    try:
        yield
    except CommClosedError:
        raise lost(client) from None


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
        if address is None:
            with _local_cluster(workers) as cluster, distributed.Client(cluster, set_as_default=False) as client:
                yield client
        else:
            client = _joined(address, tls)
            try:
                with lost_if_closed(client):
                    _check_scheduler(client, address)
                    _wait_for_worker(client, address, report)
                    yield client
            finally:
                client.close(timeout=1)


@contextmanager
def _local_cluster(workers: int) -> Iterator[Any]:
    """A cluster of this machine's processes, which leave Ctrl-C to this one."""
    resource_tracker.ensure_running()  # the first worker would start it, and unblock what is blocked
    with main_module_hidden():  # a worker that died is started again at any time
        with interrupts_blocked():
            cluster = distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                memory_limit=None,
                dashboard_address="127.0.0.1:8787",
                silence_logs=logging.CRITICAL,
            )
        try:
            yield cluster
        finally:
            cluster.close(timeout=5)


def _joined(address: str, tls: TlsFiles | None) -> Any:
    security = None
    if tls is not None:
        security = distributed.Security(
            tls_ca_file=str(tls.ca), tls_client_cert=str(tls.cert), tls_client_key=str(tls.key), require_encryption=True
        )
    try:
        with ThreadPoolExecutor(1) as thread:  # a notebook has a loop of its own in this one
            thread.submit(asyncio.run, _ask(address, security)).result()
        return distributed.Client(address, timeout=_ANSWER, set_as_default=False, security=security)
    except Exception as error:  # sockets, TLS and the protocol of another version raise what they like
        reason = one_line(str(error) or f"whoever listens there says nothing that Dask knows within {_ANSWER:g} s")
        raise ConfigError(
            f"no Dask scheduler answers at {address} ({reason}); start one (dask scheduler), or correct the address"
        ) from None


async def _ask(address: str, security: Any) -> None:
    """Shake hands with a scheduler. A client waits without end for one that is none, such as a web server."""
    arguments = {} if security is None else security.get_connection_args("client")
    comm = await asyncio.wait_for(connect(address, timeout=_ANSWER, **arguments), _ANSWER + 1)
    await comm.close()


def _check_scheduler(client: Any, address: str) -> None:
    """ConfigError: the scheduler has another version of Dask."""
    there = client.get_versions()["scheduler"]["packages"]
    here = software()
    if wrong := [
        f"{name} {there.get(name, 'missing')} (here: {here[name]})"
        for name in ("dask", "distributed")
        if there.get(name) != here[name]
    ]:
        raise ConfigError(f"scheduler {address} has {', '.join(wrong)}; install the same on both sides")


def _wait_for_worker(client: Any, address: str, report: Reporter) -> None:
    if client.nthreads():
        return
    report(Progress("waiting for a worker"))
    try:
        client.wait_for_workers(1, timeout=_WORKER)
    except TimeoutError:
        raise ConfigError(
            f"no worker has joined the scheduler {address} for {_WORKER:g} s; start some (dask worker {address})"
        ) from None
    report(Progress("waiting for a worker", result=""))


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
    answers = client.run(check, requirements, on_error="return")
    for worker, answer in answers.items():
        if isinstance(answer, BaseException):  # another Python, or no omnibench
            reason = one_line(f"{type(answer).__name__}: {answer}")
            raise UnfitWorkerError(f"worker {worker} cannot run omnibench's jobs ({reason}); install the same there")
        if answer is not None:
            raise UnfitWorkerError(answer)
    return requirements
