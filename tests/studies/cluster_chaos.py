"""A study on a Dask cluster whose workers, client and scheduler are killed: every row must be there, and be the same.

    python tests/studies/cluster_chaos.py [--minutes 20] [--workers 2] [--seconds 1.0] [--every 20]

Jobs of --seconds each fill the minutes. Every --every seconds one worker is killed (its nanny starts another), after a
third and two thirds of the time the client, after half of it the scheduler; what was killed is started again, as a
user would. Each client goes on from the store. At the end the store is compared with what a calm run gives.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import psutil
from busy_jobs import Drawn, draw

from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import BackendError, Failure, Job, JobWatch, ResultStore, run_jobs

_HERE = Path(__file__).parent  # workers import the jobs from here


class _Rows(JobWatch[Drawn]):
    """A line for every failed row."""

    def ended(self, number: int, ending: Drawn | Failure, reused: bool) -> None:  # noqa: ARG002
        if isinstance(ending, Failure):
            print(f"row {number}: {ending.reason}", flush=True)


def jobs_of(count: int, seconds: float) -> list[Job[Drawn]]:
    """The study: every job draws from the same data, by a seed of its own."""
    data = np.random.default_rng(0).normal(size=200_000)
    return [Job(f"row-{number}", draw, (number, seconds, data), shared=(data,)) for number in range(count)]


def client(arguments: argparse.Namespace) -> int:
    """One life of the client: 0 when all rows are there, else the error's line is printed."""
    try:
        with open_backend(BackendChoice(name=arguments.address), ("busy_jobs",)) as backend:
            run_jobs(jobs_of(arguments.jobs, arguments.seconds), ResultStore(arguments.store, Drawn), backend, _Rows())
    except BackendError as error:
        kept = len(list(arguments.store.glob("*.json")))
        print(f"{error}; {kept} of {arguments.jobs} rows are kept in {arguments.store}", flush=True)
        return 3
    return 0


def chaos(arguments: argparse.Namespace) -> None:
    """Run the study while its parts are killed, and compare."""
    count = int(60 * arguments.minutes * arguments.workers / arguments.seconds)
    folder = Path(tempfile.mkdtemp(prefix="omnibench-chaos-"))
    store, port = folder / "store", _free_port()
    address = f"tcp://127.0.0.1:{port}"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(_HERE), *sys.path]), "OMP_NUM_THREADS": "1"}

    def started(*command: str, log: str) -> subprocess.Popen[bytes]:
        with (folder / log).open("ab") as output:
            return subprocess.Popen(
                [sys.executable, *command], stdout=output, stderr=output, env=environment, cwd=folder
            )

    def scheduler() -> subprocess.Popen[bytes]:
        kind = ("--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
        return started("-m", "dask", "scheduler", *kind, log="scheduler.log")

    def worker() -> subprocess.Popen[bytes]:
        kind = ("--nthreads", "1", "--no-dashboard", "--local-directory", str(folder), "--death-timeout", "3600")
        return started("-m", "dask", "worker", address, *kind, log="workers.log")

    own = (__file__, "--client", "--address", address, "--store", str(store), "--jobs", str(count))

    def study() -> subprocess.Popen[bytes]:
        return started(*own, "--seconds", str(arguments.seconds), log="client.log")

    print(f"{count} jobs of {arguments.seconds:g} s on {arguments.workers} workers in {folder}", flush=True)
    killed, rng, began = Counter[str](), random.Random(1), time.monotonic()
    parts = {"scheduler": scheduler(), "client": study()}
    nannies = [worker() for _ in range(arguments.workers)]
    whole = 60 * arguments.minutes
    plan = sorted(
        [(whole / 3, "client"), (2 * whole / 3, "client"), (whole / 2, "scheduler")]
        + [(float(at), "worker") for at in range(arguments.every, int(3 * whole), arguments.every)]
    )
    while (code := parts["client"].poll()) != 0:
        if code is not None:  # it ended with a line, as without a scheduler: a person starts it again
            killed[f"client ended with code {code}"] += 1
            time.sleep(2)
            parts["client"] = study()
        if plan and time.monotonic() - began > plan[0][0]:
            _, what = plan.pop(0)
            killed[what] += 1
            if what == "worker":
                _kill_a_worker(rng.choice(nannies))
            else:
                parts[what].kill()
                parts[what].wait()
                time.sleep(1)
                parts[what] = scheduler() if what == "scheduler" else study()
        nannies = [each if each.poll() is None else worker() for each in nannies]
        if time.monotonic() - began > 4 * whole + 120:
            sys.exit(f"not done after {time.monotonic() - began:.0f} s; see {folder}")
        time.sleep(0.1)
    wall = time.monotonic() - began
    for process in (*nannies, parts["scheduler"]):
        process.terminate()
        process.wait()
    results = ResultStore(store, Drawn)
    jobs = jobs_of(count, 0.0)
    wrong = [job.key for job in jobs if results.get(job.key) != job.function(job.argument, lambda _: None)]
    print(f"{wall:.0f} s; killed or ended: {dict(killed)}; rows missing or other than in a calm run: {wrong or 'none'}")
    print((folder / "client.log").read_text(), end="")


def _kill_a_worker(nanny: subprocess.Popen[bytes]) -> None:
    """Kill the worker beneath a nanny."""
    try:
        for child in psutil.Process(nanny.pid).children():
            if "spawn_main" in " ".join(child.cmdline()):
                child.send_signal(signal.SIGKILL)
    except psutil.NoSuchProcess:
        return


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def main() -> None:
    """Run the study, or be its client."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--every", type=int, default=20)
    for name, kind in (("--address", str), ("--store", Path), ("--jobs", int)):
        parser.add_argument(name, type=kind, help=argparse.SUPPRESS)
    parser.add_argument("--client", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.client:
        sys.exit(client(arguments))
    chaos(arguments)


if __name__ == "__main__":
    main()
