"""Dask as a backend: a cluster of this machine keeps what every backend promises, and workers may be killed."""

import gc
import http.server
import os
import signal
import threading
import time
import weakref
from collections.abc import Iterator
from multiprocessing import parent_process
from pathlib import Path

import numpy as np
import pytest
from commands import ENVIRONMENT, Command, assert_refused, python, refused, write_config
from dask_samples import certificates, refusal
from job_samples import Answer, Notes, jobs_of, run, squared, tried
from test_jobs import EveryBackend, EveryProcess
from timing import PATIENCE, until

from omnibench.errors import ConfigError
from omnibench.jobs.backend_choice import BackendChoice, check_backend, open_backend
from omnibench.jobs.dask_backend import DaskBackend
from omnibench.jobs.job import Job, ResultStore, TlsFiles, gathered, run_jobs
from omnibench.jobs.job_process import Packer
from omnibench.progress import Progress, Reporter


@pytest.fixture(scope="module")
def dask() -> Iterator[DaskBackend]:
    said: list[Progress] = []
    with open_backend(BackendChoice(name="dask", workers=2), report=said.append) as backend:
        (result,) = (event.result for event in said if event.result)
        assert result.startswith("2 workers of Dask, dashboard http://")
        assert isinstance(backend, DaskBackend)
        yield backend


class TestDask(EveryBackend, EveryProcess):
    ahead = 3  # one for each worker, and the next

    @pytest.fixture
    def backend(self, dask: DaskBackend) -> DaskBackend:
        return dask


def of_size(size: int, _: Reporter) -> bytes:
    return bytes(size)


def trims_memory(_: int, __: Reporter) -> bool:
    """Workers of Dask would give memory back all the time."""
    return "MALLOC_TRIM_THRESHOLD_" in os.environ


def test_results_arrive_whatever_their_sizes_and_memory_is_not_trimmed(dask: DaskBackend) -> None:
    assert gathered(dask, trims_memory, [0]) == [False]
    sizes = [10, 1_000_000] * 5
    assert [len(result) for result in gathered(dask, of_size, sizes)] == sizes


def test_results_of_ended_calls_are_not_held(dask: DaskBackend) -> None:
    results = gathered(dask, many_objects, [0, 1])
    kept = [weakref.ref(result) for result in results]
    del results
    gc.collect()
    assert [reference() for reference in kept] == [None, None]


class Many:
    """A result that can be told to be gone."""


def many_objects(_: int, __: Reporter) -> Many:
    return Many()


def total(shared: tuple[int, np.ndarray], _: Reporter) -> Answer:
    return Answer(shared[0] + int(shared[1].sum()))


def test_data_that_jobs_share_are_pickled_once_and_go_with_none_of_them(dask: DaskBackend, tmp_path: Path) -> None:
    data = np.ones(1_000_000)
    jobs = [Job(f"job-{number}", total, (number, data), shared=(data,)) for number in range(30)]
    assert run(tmp_path, jobs, dask).answers() == {number: 1_000_000 + number for number in range(30)}
    packer = Packer()
    packed = [packer.pack(job) for job in jobs]
    assert max(len(job.content) for job in packed) < 200
    assert len({id(content) for job in packed for content in job.shared.values()}) == 1


@pytest.mark.slow
def test_a_worker_that_is_killed_loses_nothing(dask: DaskBackend, tmp_path: Path) -> None:
    jobs = [Job("always", kills_its_worker, (tmp_path, 9)), Job("once", kills_its_worker, (tmp_path / "once", 1))]
    (tmp_path / "once").mkdir()
    notes, store = Notes(), ResultStore(tmp_path / "results", Answer)
    # Without a look at processes that are left: workers are started again.
    run_jobs([*jobs, *jobs_of(squared, range(20))], store, dask, notes)
    assert notes.reason(0).startswith("its worker tls://127.0.0.1:")
    assert notes.reason(0).endswith(" was killed in each of 3 tries")
    assert (tmp_path / "kills").stat().st_size == 3
    assert [notes.answers()[number] for number in range(1, 22)] == [2, *(number**2 for number in range(20))]


def kills_its_worker(order: tuple[Path, int], _: Reporter) -> Answer:
    """Kill the Dask worker above, so many times."""
    folder, times = order
    count = tried(folder, "kills")
    if count <= times:
        parent = parent_process()
        os.kill(parent.pid, signal.SIGKILL)
        time.sleep(60)
    return Answer(count)


SECOND_USER = """
import asyncio, ssl, sys
from distributed.comm.core import connect
from distributed.core import send_recv

trusting = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE

async def ask(address):
    try:
        comm = await connect(address, timeout=3, ssl_context=trusting, require_encryption=False)
        return await asyncio.wait_for(send_recv(comm, op="identity", reply=True), 3)
    except Exception as error:
        return type(error).__name__

for place in sys.argv[1:]:
    for scheme in ("tcp", "tls"):
        print(asyncio.run(ask(f"{scheme}://{place}")))
"""


@pytest.mark.slow
def test_a_process_without_the_certificate_reaches_no_part_of_a_cluster_of_this_machine(dask: DaskBackend) -> None:
    dask.client.wait_for_workers(2, timeout=PATIENCE)
    workers = dask.client.scheduler_info(n_workers=-1)["workers"]
    addresses = [dask.client.scheduler.address, *workers, *(worker["nanny"] for worker in workers.values())]
    places = [address.partition("://")[2] for address in addresses]
    answers = python(SECOND_USER, *places).stdout.splitlines()
    assert len(answers) == 2 * len(places) == 10
    assert set(answers) <= {"OSError", "CommClosedError", "TimeoutError"}


def noting(folder: Path, _: Reporter) -> Answer:
    (folder / str(os.getpid())).touch()
    time.sleep(60)
    raise AssertionError


@pytest.mark.slow
def test_ctrl_c_ends_what_is_at_work_and_what_waits(dask: DaskBackend, tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    notes.mkdir()

    def interrupt() -> None:
        until(lambda: len(list(notes.iterdir())) == 2, "two jobs to begin")
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "results", jobs_of(noting, [notes] * 10), dask)
    until(lambda: not any(Path("/proc", file.name).exists() for file in notes.iterdir()), "the jobs' processes to end")
    assert len(list(notes.iterdir())) == 2
    assert run(tmp_path, jobs_of(squared, range(3)), dask).answers() == {0: 0, 1: 1, 2: 4}


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("dusk", ("'dusk'", "did you mean 'dask'?", "processes, dask, tcp://HOST:PORT, tls://HOST:PORT")),
        ("tcp://127.0.0.1", ("unknown backend 'tcp://127.0.0.1'",)),
        ("tcp://:8786", ("unknown backend 'tcp://:8786'",)),
        ("tls://127.0.0.1:8786", ("--tls-ca, --tls-cert, --tls-key",)),
    ],
)
def test_a_wrong_backend_is_named(name: str, parts: tuple[str, ...]) -> None:
    with refused(ConfigError, *parts):
        check_backend(name)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("omnibench.jobs.dask_backend._ANSWER", 1.0)


@pytest.mark.usefixtures("impatient")
def test_a_scheduler_that_nobody_started_is_one_line(command: Command, tmp_path: Path) -> None:
    run = command("compare", write_config(tmp_path), "-o", tmp_path / "out", "--backend", "tcp://127.0.0.1:9")
    assert_refused(run, "tcp://127.0.0.1:9", "dask scheduler")


def test_without_dask_one_line_names_the_extra(tmp_path: Path) -> None:
    without = "import sys; sys.modules['distributed'] = None; from omnibench.__main__ import main; main()"
    run = python(without, "compare", write_config(tmp_path), "--backend", "dask", env=ENVIRONMENT, cwd=tmp_path)
    assert_refused(run, 'pip install "omnibench[dask]"')


def test_dask_is_imported_only_where_it_is_asked_for() -> None:
    program = "import sys, omnibench.compare.run, omnibench.cli.app; print('distributed' in sys.modules)"
    assert python(program, env=ENVIRONMENT).stdout == "False\n"


@pytest.mark.usefixtures("impatient")
def test_a_web_server_is_no_scheduler() -> None:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), http.server.SimpleHTTPRequestHandler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    place = f"tcp://127.0.0.1:{server.server_port}"
    try:
        assert refusal(place).startswith(f"no Dask scheduler answers at {place}")
    finally:
        server.shutdown()


def test_a_file_of_tls_that_is_none_is_named(tmp_path: Path) -> None:
    ca, cert, key = certificates(tmp_path)
    text = tmp_path / "text"
    text.write_text("no certificate")
    place = "tls://127.0.0.1:1"
    for files, line in (
        (TlsFiles(ca=text, cert=cert, key=key), f"ca: {text}: "),
        (TlsFiles(ca=ca, cert=cert, key=text), f"cert and key: {cert}, {text}: "),
        (TlsFiles(ca=ca, cert=tmp_path, key=key), f"cert and key: {tmp_path}, {key}: "),
    ):
        assert refusal(place, tls=files).startswith(f"backend {place}: {line}")
