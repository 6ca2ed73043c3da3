"""Clusters of Dask that an address joins: machines that differ, faults of scheduler and client, TLS."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.metadata import distribution, version
from pathlib import Path

import psutil
import pytest
from commands import (
    ENVIRONMENT,
    assert_refused,
    compared,
    omnibench,
    search,
    summary,
    without_seconds,
    write_config,
    write_plugin,
)  # fmt: skip
from dask_samples import certificates, program, refusal, scheduler, searched_first, worker
from job_samples import IMPORTING_THIS, Answer, Notes, jobs_of
from timing import PATIENCE, until

import omnibench as package
from omnibench.jobs import dask_backend
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import BackendError, JobWatch, ResultStore, TlsFiles, run_jobs
from omnibench.progress import Progress, Reporter

pytestmark = pytest.mark.slow
PACKAGE = Path(package.__file__).parent


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A scheduler that runs for all tests here."""
    with scheduler(tmp_path_factory.mktemp("scheduler")) as (place, _):
        yield place


def test_a_scheduler_without_tls_is_joined_with_a_warning_who_runs_code_there(address: str, tmp_path: Path) -> None:
    said: list[Progress] = []
    choice = BackendChoice(name=address)
    with worker(address, tmp_path / "worker"), open_backend(choice, report=said.append) as backend:
        assert isinstance(backend, dask_backend.DaskBackend)
        (of_worker,) = backend.client.nthreads()
        assert refusal(of_worker).startswith(f"{of_worker} is a worker of Dask")
    (line,) = [event.result for event in said if event.result.startswith("warning")]
    assert address in line
    assert "tls://HOST:PORT" in line


def test_a_worker_with_other_code_is_refused_before_the_first_job(address: str, tmp_path: Path) -> None:
    shutil.copytree(PACKAGE, tmp_path / "other" / "omnibench", ignore=shutil.ignore_patterns("__pycache__"))
    with (tmp_path / "other" / "omnibench" / "words.py").open("a") as file:
        file.write("# another version\n")
    with worker(address, tmp_path / "worker", environment=searched_first(tmp_path / "other")):
        run = omnibench("compare", write_config(tmp_path), "-o", tmp_path / "out", "--backend", address)
    assert_refused(run, "error: worker tcp://127.0.0.1:", " has omnibench's code ", "install the same on the worker")
    assert not list((tmp_path / "out").glob("runs/*"))


def pretended(folder: Path, name: str, number: str) -> Path:
    """A folder whose metadata say that a package has another version."""
    metadata = folder / f"{name}-{number}.dist-info"
    shutil.copytree(next(iter(Path(str(distribution(name).locate_file(""))).glob(f"{name}-*.dist-info"))), metadata)
    text = (metadata / "METADATA").read_text(encoding="utf-8")
    (metadata / "METADATA").write_text(text.replace(f"Version: {version(name)}\n", f"Version: {number}\n", 1))
    return folder


def test_a_worker_and_a_scheduler_with_another_version_of_a_package_are_refused(address: str, tmp_path: Path) -> None:
    for name in ("scipy", "dask"):
        environment = searched_first(pretended(tmp_path / name, name, "1.2.3"))
        with worker(address, tmp_path / f"{name}_worker", environment=environment):
            assert f"has {name} 1.2.3 (here: {version(name)})" in refusal(address)
    environment = searched_first(pretended(tmp_path / "other", "distributed", "2024.1.0"))
    with scheduler(tmp_path, environment=environment) as (place, _), worker(place, tmp_path / "worker"):
        assert f"scheduler {place} has distributed 2024.1.0 (here: {version('distributed')})" in refusal(place)


def test_a_full_disk_of_a_worker_is_one_line(address: str, tmp_path: Path) -> None:
    starts = "import resource as r; r.setrlimit(r.RLIMIT_FSIZE, (500_000, 500_000)); "
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "sitecustomize.py").write_text(starts)
    with worker(address, tmp_path / "worker", environment=searched_first(tmp_path / "full")):
        line = refusal(address)
    assert line.startswith("worker tcp://127.0.0.1:")
    assert str(tmp_path / "worker") in line
    assert "cannot be written: File too large; free space" in line


NEEDS = """
import only_here

@calibrators.register("needs")
class Needs(Calibrator):
    "Needs a package."

    def calibrate(self, problem):
        return Solution(problem.start, only_here.REASON)
"""


class TestPlugins:
    @pytest.fixture
    def config(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        """A comparison with a plug-in that imports a package which only this machine has."""
        (tmp_path / "packages").mkdir()
        (tmp_path / "packages" / "only_here.py").write_text("REASON = 'from a package'\n")
        monkeypatch.setitem(ENVIRONMENT, "PYTHONPATH", searched_first(tmp_path / "packages")["PYTHONPATH"])
        plugins = write_plugin(tmp_path / "plugins", "needs", NEEDS)
        return write_config(tmp_path, plugins=[str(plugins)], calibrators=["theoretical", "needs"])

    def test_a_package_that_a_worker_lacks_is_named_first(self, config: Path, address: str, tmp_path: Path) -> None:
        with worker(address, tmp_path / "worker"):
            run = omnibench("compare", config, "-o", tmp_path / "out", "--backend", address)
        assert_refused(run, "needs.py cannot be imported there: ModuleNotFoundError: No module named 'only_here'")
        assert not list((tmp_path / "out").glob("runs/*"))

    def test_a_plugin_file_travels_to_a_machine_without_it(self, config: Path, address: str, tmp_path: Path) -> None:
        hidden = tmp_path / "elsewhere"
        with worker(address, tmp_path / "worker", environment=searched_first(tmp_path / "packages")):
            process = subprocess.Popen(
                [sys.executable, "-c", MOVES, str(config), str(tmp_path / "out"), address, str(hidden)], env=ENVIRONMENT
            )
            assert process.wait(timeout=PATIENCE) == 0
        (row,) = [run for run in summary(tmp_path / "out")["runs"] if run["calibrator"] == "needs"]
        assert (row["outcome"], row["reason"]) == ("converged", "from a package")


MOVES = """
import sys
from pathlib import Path
import omnibench
from omnibench.compare.config import read_compare_config

config = read_compare_config(sys.argv[1]).model_copy(update={"backend": sys.argv[3]})

def move(event):  # once the client has read it, no machine has the file where it was
    if event.task.endswith("needs seed 1") and config.plugins[0].exists():
        config.plugins[0].rename(sys.argv[4])

omnibench.run_comparison(config, Path(sys.argv[2]), move)
"""


def slow(number: int, _: Reporter) -> Answer:
    time.sleep(0.5)
    return Answer(number)


def test_a_worker_that_joins_later_is_checked(address: str, tmp_path: Path) -> None:
    environment = searched_first(pretended(tmp_path / "other", "polars", "0.1"))
    with (
        worker(address, tmp_path / "first"),
        program(tmp_path / "log", "worker", address, "--nthreads", "1", environment=environment) as late,
        open_backend(BackendChoice(name=address)) as backend,
    ):
        assert late.poll() is None  # it takes longer to start than the check of those that are there
        with pytest.raises(BackendError, match=r"has polars 0.1 \(here: "):
            run_jobs(jobs_of(slow, range(100)), ResultStore(tmp_path / "results", Answer), backend, Notes())


CLIENT = """
import sys
from pathlib import Path
from job_samples import Answer, Notes, jobs_of
from test_dask_clusters import sleeping
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import BackendError, run_jobs
from omnibench.jobs.job import ResultStore
try:
    with open_backend(BackendChoice(name=sys.argv[1])) as backend:
        folder = Path(sys.argv[2])
        run_jobs(jobs_of(sleeping, [folder] * 5), ResultStore(folder / "store", Answer), backend, Notes())
except BackendError as error:
    sys.exit(str(error))
except KeyboardInterrupt:
    sys.exit("interrupted")
"""


def sleeping(folder: Path, _: Reporter) -> Answer:
    while not (folder / "go_on").exists():
        (folder / "alive").touch()
        time.sleep(0.05)
    return Answer(1)


def test_when_the_client_is_killed_its_jobs_end_and_it_goes_on_when_started_again(address: str, tmp_path: Path) -> None:
    command = [sys.executable, "-c", CLIENT, address, str(tmp_path)]
    with worker(address, tmp_path / "worker"):
        client = subprocess.Popen(command, env=IMPORTING_THIS)
        until((tmp_path / "alive").exists, "the jobs to begin")
        client.kill()
        client.wait()
        until(lambda: time.time() - (tmp_path / "alive").stat().st_mtime > 1, "the jobs to end")
        (tmp_path / "go_on").touch()
        subprocess.run(command, env=IMPORTING_THIS, check=True, timeout=PATIENCE)
    assert len(list((tmp_path / "store").glob("*.json"))) == 5


def test_ctrl_c_in_a_terminal_is_left_to_the_client(tmp_path: Path) -> None:
    command = [sys.executable, "-c", CLIENT, "dask", str(tmp_path)]
    client = subprocess.Popen(command, env=IMPORTING_THIS, stderr=subprocess.PIPE, text=True, start_new_session=True)
    until((tmp_path / "alive").exists, "the jobs to begin")
    os.killpg(client.pid, signal.SIGINT)  # a terminal sends it to all of its processes
    assert client.communicate(timeout=PATIENCE)[1] == "interrupted\n"


def test_a_scheduler_that_is_killed_is_one_line(tmp_path: Path) -> None:
    with scheduler(tmp_path) as (place, process), worker(place, tmp_path / "worker"):
        command = [sys.executable, "-c", CLIENT, place, str(tmp_path)]
        client = subprocess.Popen(command, env=IMPORTING_THIS, stderr=subprocess.PIPE, text=True)
        until((tmp_path / "alive").exists, "the jobs to begin")
        process.kill()
        told = client.communicate(timeout=PATIENCE)[1]
    assert told == f"the Dask scheduler {place} is lost; start it again, then the same command\n"


def test_a_scheduler_that_freezes_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_backend, "WAIT", 3.0)
    with scheduler(tmp_path) as (place, process), worker(place, tmp_path / "worker"):
        store, choice = ResultStore(tmp_path / "results", Answer), BackendChoice(name=place)
        with pytest.raises(BackendError, match="is lost; start it again"), open_backend(choice) as backend:
            run_jobs(jobs_of(slow, range(100)), store, backend, Freezing(process))
        process.send_signal(signal.SIGCONT)


class Freezing(JobWatch[Answer]):
    """Stops a process when the first job has begun."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    def began(self, number: int) -> None:  # noqa: ARG002
        self._process.send_signal(signal.SIGSTOP)


def test_that_no_worker_is_left_is_said(address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_backend, "WAIT", 3.0)
    said: list[Progress] = []
    store = ResultStore(tmp_path / "results", Answer)
    with worker(address, tmp_path / "w") as only, open_backend(BackendChoice(name=address), report=said.append) as on:
        only.terminate()
        with pytest.raises(BackendError, match=r"no worker has been left at .*; start some \(dask worker tcp://"):
            run_jobs(jobs_of(slow, range(100)), store, on, Notes())
    assert Progress("waiting for a worker") in said


def test_a_comparison_over_tls_equals_one_by_processes(tmp_path: Path) -> None:
    ca, cert, key = certificates(tmp_path)
    tls = ("--tls-ca-file", str(ca), "--tls-cert", str(cert), "--tls-key", str(key))
    config = write_config(tmp_path, calibrators=["theoretical", "closed_form", search(candidates=100)])
    with scheduler(tmp_path, *tls) as (place, _), worker(place, tmp_path / "worker", *tls):
        assert place.startswith("tls://")
        files = ("--tls-ca", ca, "--tls-cert", cert, "--tls-key", key)
        compared(config, tmp_path / "tls", "--backend", place, *files)
        other = certificates(tmp_path / "other")
        line = refusal(place, tls=TlsFiles(ca=other[0], cert=other[1], key=other[2]))
        assert line.startswith(f"no Dask scheduler answers at {place} (")
    compared(config, tmp_path / "processes")
    assert without_seconds(tmp_path / "tls") == without_seconds(tmp_path / "processes")


@pytest.mark.parametrize("kills", [1, 1000])
def test_a_worker_that_is_killed_as_it_starts_is_started_again_or_one_line_says_what_to_do(
    kills: int, tmp_path: Path
) -> None:
    (tmp_path / "go_on").touch()
    command = [sys.executable, "-c", CLIENT, "dask", str(tmp_path)]
    client = subprocess.Popen(command, env=IMPORTING_THIS, stderr=subprocess.PIPE, text=True)
    killed: set[int] = set()
    while client.poll() is None:
        with contextlib.suppress(psutil.NoSuchProcess):
            for process in psutil.Process(client.pid).children(recursive=True):
                if "spawn_main" in " ".join(process.cmdline()) and len(killed) < kills:
                    process.kill()
                    killed.add(process.pid)
    told = client.communicate()[1]
    assert killed
    if kills == 1:
        assert (client.returncode, told) == (0, "")
        assert len(list((tmp_path / "store").glob("*.json"))) == 5
    else:
        assert told.startswith("no workers of Dask start here (")
        assert told.endswith("take fewer workers, then the same command\n")


def test_a_comparison_on_dask_goes_on_beside_four_busy_programs(tmp_path: Path) -> None:
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(4)]
    try:
        compared(write_config(tmp_path), tmp_path / "out", "--backend", "dask")
    finally:
        for process in busy:
            process.kill()
            process.wait()
