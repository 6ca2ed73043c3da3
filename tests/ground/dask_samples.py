"""Schedulers and workers of Dask as processes of their own, as on a cluster."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest
from job_samples import IMPORTING_THIS
from timing import until

from omnibench.errors import OmnibenchError
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.live.keys import make_keys


@contextmanager
def program(
    log: Path, *arguments: str, environment: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """A command of Dask that runs while the block is open, its output in ``log``."""
    with log.open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "dask", *arguments],
            stdout=output,
            stderr=output,
            env={**IMPORTING_THIS, **(environment or {})},
            cwd=log.parent,  # not where omnibench lies
            start_new_session=True,
        )
    try:
        yield process
    finally:
        for end in (process.terminate, process.kill):
            end()
            try:
                process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                continue


@contextmanager
def scheduler(
    folder: Path, *arguments: str, environment: Mapping[str, str] | None = None
) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A scheduler's address and process."""
    log = folder / "scheduler.log"
    host = ("--host", "tls://127.0.0.1") if "--tls-ca-file" in arguments else ("--host", "127.0.0.1")
    started = program(log, "scheduler", *host, "--port", "0", "--no-dashboard", *arguments, environment=environment)
    with started as process:
        until(lambda: re.search(r"Scheduler at: +(\S+)", log.read_text()), "the scheduler")
        found = re.search(r"Scheduler at: +(\S+)", log.read_text())
        yield found[1], process


@contextmanager
def worker(
    address: str, folder: Path, *arguments: str, environment: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """A worker of one thread, with its nanny, that has joined."""
    folder.mkdir(exist_ok=True)
    log, kind = folder / "worker.log", ("--nthreads", "1", "--no-dashboard", "--local-directory", str(folder))
    with program(log, "worker", address, *kind, *arguments, environment=environment) as process:
        until(lambda: "Registered to:" in log.read_text(), "the worker to join")
        yield process


def searched_first(*folders: Path) -> dict[str, str]:
    """The environment of a program that imports from these folders before all others."""
    return {"PYTHONPATH": os.pathsep.join([*map(str, folders), IMPORTING_THIS["PYTHONPATH"]])}


def refusal(name: str, **others: object) -> str:
    """The one line of a backend that cannot be opened."""
    with pytest.raises(OmnibenchError) as refused, open_backend(BackendChoice(name=name, **others)):
        pass
    assert refused.value.exit_code == 2
    return str(refused.value)


def certificates(folder: Path) -> tuple[Path, Path, Path]:
    """An authority's certificate, and one of its own with the key, for scheduler, workers and client."""
    make_keys(folder, ["cluster"], router="cluster")  # which may serve and be a client
    return folder / "ca.pem", folder / "cluster.pem", folder / "cluster.key"
