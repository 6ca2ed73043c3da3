"""The backends by their names: processes of this machine, or workers of Dask."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from urllib.parse import urlsplit

from omnibench.config import Model
from omnibench.errors import ConfigError, nearest
from omnibench.jobs.job import Backend
from omnibench.jobs.local_backends import Processes
from omnibench.jobs.scheduler_tls import TlsFiles
from omnibench.progress import Reporter, no_progress

_NAMES = ("processes", "dask")
_SCHEMES = ("tcp", "tls")


class BackendChoice(Model):
    """Where many jobs are run. name: processes, dask (workers started here), or the address of a scheduler of Dask.

    workers: processes, or Dask workers where these are started.
    """

    name: str = "processes"
    workers: int = 2
    tls: TlsFiles | None = None


def check_backend(name: str, tls: TlsFiles | None = None) -> None:
    """ConfigError in one line: no such backend, Dask is not installed, or files of TLS are missing or of no use."""
    scheme, _, place = name.partition("://")
    if name not in _NAMES and not (scheme in _SCHEMES and _has_port(place)):
        raise ConfigError(
            f"unknown backend {name!r}; {nearest(name, _NAMES)}known: processes, dask, tcp://HOST:PORT, tls://HOST:PORT"
        )
    if (scheme == "tls") != (tls is not None):
        raise ConfigError(
            f"backend {name}: name the files of TLS, ca, cert and key (--tls-ca, --tls-cert, --tls-key)"
            if tls is None
            else f"backend {name}: files of TLS are for a scheduler at tls://HOST:PORT; leave them out"
        )
    for file in () if tls is None else (tls.ca, tls.cert, tls.key):
        if not file.is_file():
            raise ConfigError(f"backend {name}: {file}: no such file")
    if name != "processes" and find_spec("distributed") is None:
        raise ConfigError(f'backend {name}: Dask is not installed; pip install "omnibench[dask]"')


@contextmanager
def open_backend(
    choice: BackendChoice, preload: Sequence[str] = (), report: Reporter = no_progress
) -> Iterator[Backend]:
    """The backend, ready for jobs; a cluster's workers are checked, and one that was started here ends with the block.

    preload: modules that jobs need, which their processes share. ConfigError or UnfitWorkerError in one line.
    """
    check_backend(choice.name, choice.tls)
    if choice.name == "processes":
        processes = Processes(choice.workers, preload, lasting=True)
        try:
            yield processes
        finally:
            processes.close()
        return
    from omnibench.jobs.dask_backend import DaskBackend
    from omnibench.jobs.dask_cluster import checked_requirements, dask_client, say_cluster

    address = None if choice.name == "dask" else choice.name
    with dask_client(address, choice.workers, choice.tls, report) as client:
        backend = DaskBackend(client, checked_requirements(client, preload))
        say_cluster(client, report)
        yield backend


def _has_port(place: str) -> bool:
    try:
        return urlsplit(f"//{place}").port is not None
    except ValueError:
        return False
