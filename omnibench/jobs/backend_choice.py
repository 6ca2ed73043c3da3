"""The backends by their names: processes of this machine, or workers of Dask."""

from __future__ import annotations

import re
import ssl
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from importlib.util import find_spec

from omnibench.config import Model
from omnibench.errors import ConfigError, nearest
from omnibench.jobs.job import Backend, TlsFiles
from omnibench.jobs.job_process import Processes
from omnibench.progress import Progress, Reporter, no_progress

_NAMES = ("processes", "dask")
_ADDRESS = re.compile(r"(tcp|tls)://(\[[^/\]]+\]|[^/:\s]+):(?P<port>\d{1,5})", re.ASCII)


class BackendChoice(Model):
    """Where many jobs are run. name: processes, dask (workers started here), or the address of a scheduler of Dask.

    workers: processes, or Dask workers where these are started.
    """

    name: str = "processes"
    workers: int = 2
    tls: TlsFiles | None = None


def name_flaw(name: str) -> str:
    """What is wrong with the name of a backend; empty if nothing is."""
    if name in _NAMES or ((address := _ADDRESS.fullmatch(name)) and int(address["port"]) < 2**16):
        return ""
    return f"unknown backend {name!r}; {nearest(name, _NAMES)}known: processes, dask, tcp://HOST:PORT, tls://HOST:PORT"


def check_backend(name: str, tls: TlsFiles | None = None) -> None:
    """ConfigError in one line: no such backend, Dask is not installed, or files of TLS are missing or of no use."""
    if flaw := name_flaw(name):
        raise ConfigError(flaw)
    if tls is None and name.startswith("tls:"):
        raise ConfigError(f"backend {name}: name the files of TLS, ca, cert and key (--tls-ca, --tls-cert, --tls-key)")
    if tls is not None:
        if not name.startswith("tls:"):
            raise ConfigError(f"backend {name}: files of TLS are for a scheduler at tls://HOST:PORT; leave them out")
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        what = f"ca: {tls.ca}: is no file of certificates in PEM"
        try:
            context.load_verify_locations(tls.ca)
            what = f"cert and key: {tls.cert}, {tls.key}: are no files of a certificate in PEM and its key"
            context.load_cert_chain(tls.cert, tls.key)
        except OSError as error:  # ssl.SSLError is one
            raise ConfigError(f"backend {name}: {what} ({error})") from None
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
        with closing(Processes(choice.workers, preload, lasting=True)) as processes:
            yield processes
        return
    from omnibench.jobs.dask_backend import DaskBackend, dask_client

    with dask_client(None if choice.name == "dask" else choice.name, choice.workers, choice.tls) as client:
        backend = DaskBackend(client, preload, report)
        if choice.name.startswith("tcp:"):
            risk = f"whoever reaches {choice.name} runs code on its workers and here"
            way_out = "with tls://HOST:PORT it asks for certificates (omnibench guide scale)"
            report(Progress("tcp", result=f"warning: {risk}; {way_out}"))
        yield backend
