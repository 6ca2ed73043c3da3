"""Many independent jobs: what every backend promises, limits, workers that die, and clear ends."""

import contextlib
import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from commands import alive
from job_samples import IMPORTING_THIS, Answer, Notes, jobs_of, run, squared, tried
from lanes import slow
from timing import PATIENCE, until

from omnibench.errors import DataError
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import Backend, Failure, Job, JobWatch, ResultStore, content_key, gathered, run_jobs
from omnibench.jobs.job_process import InPlace, Processes, local_backend
from omnibench.processes import one_thread_processes
from omnibench.progress import Progress, Reporter
from omnibench.robot.kinematics import JsonArray


def two_is_wrong(number: int, _: Reporter) -> Answer:
    if number == 2:
        raise DataError("two is wrong")
    return Answer(number)


def killed(order: tuple[Path, signal.Signals], _: Reporter) -> Answer:
    folder, by = order
    tried(folder, "killed")
    if by != signal.SIGKILL:
        signal.signal(by, signal.SIG_DFL)  # nohup has its programs ignore SIGHUP
    os.kill(os.getpid(), by)
    raise AssertionError


def elsewhere(folder: Path, _: Reporter) -> Answer:
    os.chdir(folder)
    return Answer(3)


def out_of_its_own_time(_: Any, __: Reporter) -> Answer:
    raise TimeoutError("the map's server does not answer")


class TwoPartError(Exception):
    """An error that cannot be made again from its message, as unpickling does."""

    def __init__(self, part: str, other: str) -> None:
        super().__init__(f"{part} and {other}")


def wrong_in_two_parts(_: Any, __: Reporter) -> Answer:
    raise TwoPartError("one", "another")


def killed_once(folder: Path, _: Reporter) -> Answer:
    count = tried(folder, "killed_once")
    if count == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return Answer(count)


def ended_with(code: int, _: Reporter) -> Answer:
    os._exit(code)


def crashed(folder: Path, _: Reporter) -> Answer:
    tried(folder, "crashed")
    os.abort()


def one_large_array(folder: Path, _: Reporter) -> Answer:
    tried(folder, "one_large_array")
    return Answer(len(np.ones(10**9)))


def many_small_objects(folder: Path, _: Reporter) -> Answer:
    tried(folder, "many_small_objects")
    held = []
    while True:
        held.append([0.0] * 1000)


def little_memory(_: Path, __: Reporter) -> Answer:
    return Answer(int(np.ones(10**6).sum()))


def asleep(_: object, __: Reporter) -> Answer:
    time.sleep(3600)
    raise AssertionError


def deaf(_: object, __: Reporter) -> Answer:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(3600)
    raise AssertionError


def with_jobs_of_its_own(folder: Path, _: Reporter) -> Answer:
    notes = run(folder / "inner", jobs_of(squared, range(3)), Processes(2))
    (process,) = {answer.process for answer in notes.endings.values() if isinstance(answer, Answer)}
    return Answer(len(notes.endings), process, str(os.getpid()))


class Interrupts(Notes):
    """Interrupts when the first job has ended."""

    def ended(self, number: int, ending: Answer | Failure, reused: bool) -> None:
        super().ended(number, ending, reused)
        raise KeyboardInterrupt


class EveryBackend:
    """What every backend promises. ahead: jobs that it takes at most before the first has ended."""

    ahead = 3

    def test_gives_the_result_of_every_job(self, backend: Backend, tmp_path: Path) -> None:
        notes = run(tmp_path, jobs_of(squared, range(7)), backend)
        assert notes.answers() == {number: number**2 for number in range(7)}
        assert sorted(notes.began_numbers) == list(range(7))
        assert dict(notes.moves) == {number: Progress("squaring", number) for number in range(7)}
        assert {file.name for file in tmp_path.iterdir()} == {f"job-{number}.json" for number in range(7)}

    def test_says_what_a_job_raised_and_runs_the_others(self, backend: Backend, tmp_path: Path) -> None:
        notes = run(tmp_path, jobs_of(two_is_wrong, range(4)), backend)
        failure = notes.endings.pop(2)
        assert isinstance(failure.error, DataError)
        assert (failure.reason, failure.over_time, failure.killed) == ("DataError: two is wrong", False, False)
        assert notes.answers() == {0: 0, 1: 1, 3: 3}

    def test_says_what_cannot_be_raised_again_and_who_waited_in_vain(self, backend: Backend, tmp_path: Path) -> None:
        jobs = [Job("two", wrong_in_two_parts, 0), Job("time", out_of_its_own_time, 0, seconds=60.0)]
        notes = run(tmp_path, jobs, backend)
        assert notes.reason(0) == "TwoPartError: one and another"
        failure = notes.endings[1]
        assert failure.reason == "TimeoutError: the map's server does not answer"
        assert not failure.over_time

    def test_does_not_run_a_job_whose_result_is_there(self, backend: Backend, tmp_path: Path) -> None:
        run(tmp_path, jobs_of(squared, range(3)), backend)
        (tmp_path / "job-1.json").write_text('{"number": 1')
        again = run(tmp_path, jobs_of(squared, [5, 5, 5, 5]), backend)
        assert again.answers() == {0: 0, 1: 25, 2: 4, 3: 25}  # of a damaged file nothing is believed
        assert (again.reused, sorted(again.began_numbers)) == ({0, 2}, [1, 3])

    def test_takes_jobs_as_they_are_needed(self, backend: Backend, tmp_path: Path) -> None:
        taken, before = [], set(multiprocessing.active_children())

        def jobs() -> Iterator[Job[Answer]]:
            for job in jobs_of(squared, range(50)):
                taken.append(job)
                yield job

        with pytest.raises(KeyboardInterrupt):
            run_jobs(jobs(), ResultStore(tmp_path, Answer), backend, Interrupts())
        assert len(taken) <= self.ahead
        assert set(multiprocessing.active_children()) <= before

    def test_leaves_the_environment(self, backend: Backend, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("OMP_NUM_THREADS", "7")
        monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
        assert run(tmp_path, [], backend).endings == {}
        run(tmp_path, jobs_of(squared, range(3)), backend)
        assert os.environ["OMP_NUM_THREADS"] == "7"
        assert "OPENBLAS_NUM_THREADS" not in os.environ


class EveryProcess:
    """What every backend promises whose jobs have processes of their own."""

    @pytest.mark.parametrize("by", [signal.SIGKILL, *slow(signal.SIGTERM, signal.SIGHUP)])
    def test_tries_a_job_that_is_killed_three_times(self, by: signal.Signals, backend: Backend, tmp_path: Path) -> None:
        jobs = [Job("always", killed, (tmp_path, by)), Job("once", killed_once, tmp_path), Job("other", squared, 3)]
        notes = run(tmp_path / "results", jobs, backend)
        # Of other tests' processes some are killed for lack of memory, which the system counts for all.
        reason = notes.reason().replace(": the system was out of memory", "")
        assert reason == f"the process died without an answer (killed by {by.name}) in each of 3 tries"
        assert (tmp_path / "killed").stat().st_size == 3
        assert (notes.answers()[1], notes.answers()[2]) == (2, 9)

    def test_names_how_a_process_ended_and_does_not_try_its_job_again(self, backend: Backend, tmp_path: Path) -> None:
        jobs = [*jobs_of(ended_with, [0, 3]), Job("crash", crashed, tmp_path)]
        notes = run(tmp_path / "results", jobs, backend)
        assert [notes.reason(code) for code in range(3)] == [
            f"the process died without an answer ({how})" for how in ("exit code 0", "exit code 3", "killed by SIGABRT")
        ]
        assert (tmp_path / "crashed").stat().st_size == 1

    def test_ends_a_job_over_its_memory_and_does_not_try_it_again(self, backend: Backend, tmp_path: Path) -> None:
        works = (one_large_array, many_small_objects, little_memory)
        notes = run(
            tmp_path / "results", [Job(work.__name__, work, tmp_path, memory_mb=400) for work in works], backend
        )
        assert {notes.reason(0), notes.reason(1)} == {"out of memory (limit 400 MB)"}
        assert notes.endings[2] == Answer(10**6)
        assert {(tmp_path / work.__name__).stat().st_size for work in works[:2]} == {1}

    def test_ends_a_job_over_its_time_and_does_not_try_it_again(self, backend: Backend, tmp_path: Path) -> None:
        jobs = [Job(work.__name__, work, None, seconds=1.0) for work in (asleep, deaf)]
        notes = run(tmp_path, [*jobs, Job("other", squared, 2)], backend)
        over_time = Failure("over time (limit 1 s)", over_time=True)
        assert (notes.endings[0], notes.endings[1]) == (over_time, over_time)
        assert sorted(notes.began_numbers) == [0, 1, 2]

    def test_has_one_thread_and_no_further_processes_within_a_job(self, backend: Backend, tmp_path: Path) -> None:
        jobs = [Job("inner", with_jobs_of_its_own, tmp_path), Job("other", squared, 2)]
        notes = run(tmp_path / "results", jobs, backend)
        assert (notes.endings[0].number, str(notes.endings[0].process)) == (3, notes.endings[0].threads)  # its own
        assert notes.endings[1].threads == "1"


@pytest.mark.parametrize("backend", [InPlace(), Processes(2)], ids=("in place", "processes"))
class TestLocalBackends(EveryBackend):
    """Without Dask."""


@pytest.mark.parametrize("backend", [Processes(2)], ids=["processes"])
class TestProcesses(EveryProcess):
    """Without Dask."""


def test_a_job_may_change_its_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other").mkdir()
    assert run(Path("results"), jobs_of(elsewhere, [tmp_path / "other"]), Processes(1)).answers() == {0: 3}


def leaving(order: tuple[Path, str], _: Reporter) -> Answer:
    file, end = order
    file.write_text(str(subprocess.Popen(["sleep", "10000"]).pid))
    if end == "crash":
        os._exit(3)
    if end == "hang":
        time.sleep(10_000)
    return Answer(1)


@pytest.mark.parametrize("end", ["answer", *slow("crash", "hang")])
def test_what_a_job_started_ends_with_it(end: str, tmp_path: Path) -> None:
    file, seconds = tmp_path / "pid", 1.0
    while not file.exists() or not file.read_text():  # a busy machine may end the job before it started anything
        seconds *= 2
        assert seconds < PATIENCE
        job, notes = Job("job", leaving, (file, end), seconds=seconds if end == "hang" else None), Notes()
        run_jobs([job], ResultStore(tmp_path / "store", Answer), Processes(1), notes)
        assert isinstance(notes.endings[0], Answer) == (end == "answer")
    state = Path(f"/proc/{file.read_text()}/stat")
    until(lambda: not state.exists() or " Z " in state.read_text(), "what the job started to end")


def processes_of(notes: Notes) -> list[int]:
    answers = [notes.endings[number] for number in sorted(notes.endings)]
    return [answer.process for answer in answers if isinstance(answer, Answer)]


@pytest.mark.parametrize("limit", ["seconds", "memory_mb"])
def test_a_job_with_a_limit_has_a_process_of_one_thread_for_itself(limit: str, tmp_path: Path) -> None:
    notes = run(tmp_path, jobs_of(squared, range(4), **{limit: 1000.0}), Processes(2))
    assert len(set(processes_of(notes))) == 4
    assert os.getpid() not in processes_of(notes)
    assert {answer.threads for answer in notes.endings.values() if isinstance(answer, Answer)} == {"1"}


def test_jobs_without_limits_share_processes_and_one_worker_needs_none(tmp_path: Path) -> None:
    assert processes_of(run(tmp_path / "here", jobs_of(squared, [3]), local_backend(1))) == [os.getpid()]
    assert len(set(processes_of(run(tmp_path, jobs_of(squared, range(9)), Processes(2))))) <= 2


def test_whatever_the_watch_raises_ends_the_workers(tmp_path: Path) -> None:
    store, notes = ResultStore(tmp_path, Answer), Interrupts()
    with pytest.raises(KeyboardInterrupt):
        run_jobs([*jobs_of(asleep, [None]), Job("quick", squared, 3)], store, Processes(2), notes)
    assert not multiprocessing.active_children()
    assert notes.endings[1] == store.get("quick")


@pytest.fixture
def one_process() -> Iterator[Backend]:
    with open_backend(BackendChoice(workers=1)) as backend:
        yield backend
    assert not multiprocessing.active_children()


class Data:
    """What jobs share."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values


def total(order: tuple[int, Data], _: Reporter) -> tuple[float, int, int]:
    number, shared = order
    held = sum(isinstance(value, Data) for value in gc.get_objects())
    return number + float(shared.values.sum()), os.getpid(), held


def test_results_are_those_of_the_function_in_their_order(one_process: Backend) -> None:
    data = Data(np.arange(5.0))
    orders = [(number, data) for number in range(7)]
    by_jobs = gathered(one_process, total, orders, shared=(data,))
    assert [result for result, *_ in by_jobs] == [result for result, *_ in gathered(None, total, orders)]


def test_calls_share_a_process_which_keeps_no_more_than_the_last_jobs_share(one_process: Backend) -> None:
    found = []
    for size in range(1, 5):
        data = Data(np.ones(size))
        found += gathered(one_process, total, [(0, data), (1, data)], shared=(data,))
    assert [result for result, *_ in found] == [1, 2, 2, 3, 3, 4, 4, 5]
    assert {held for *_, held in found} == {1}
    assert len({process for _, process, _ in found}) == 1


def nothing_of_it(number: int, _: Reporter) -> int:
    return number


def test_what_no_argument_holds_may_be_shared(one_process: Backend) -> None:
    other = Data(np.ones(3))
    found = gathered(one_process, total, [(0, other), (1, Data(np.zeros(2))), (2, other)], shared=(other,))
    assert [result for result, *_ in found] == [3, 1, 5]
    assert gathered(one_process, nothing_of_it, [4, 5], shared=(other,)) == [4, 5]


def test_a_waiting_process_that_is_killed_costs_no_job_a_try(one_process: Backend) -> None:
    data = Data(np.ones(3))
    ((_, process, _),) = gathered(one_process, total, [(0, data)], shared=(data,))
    os.kill(process, signal.SIGKILL)
    with contextlib.suppress(psutil.NoSuchProcess):  # which it may be at any time from now on
        until(lambda: psutil.Process(process).status() == psutil.STATUS_ZOMBIE, "its end")
    ((result, other, _),) = gathered(one_process, total, [(1, data)], shared=(data,))
    assert result == 4
    assert other != process


def surroundings(_: object, __: Reporter) -> list[str]:
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS")
    return [*map(os.environ.__getitem__, names), signal.getsignal(signal.SIGINT).name]


def test_a_job_has_one_thread_and_leaves_ctrl_c_to_its_parent(one_process: Backend) -> None:
    assert gathered(one_process, surroundings, [0]) == [["1", "1", "1", "1", "SIG_IGN"]]


def wrong(number: int, _: Reporter) -> int:
    raise DataError(f"{number} is wrong")


def test_the_error_of_a_job_is_raised(one_process: Backend) -> None:
    with pytest.raises(DataError, match=r"^3 is wrong$"):
        gathered(one_process, wrong, [3])


def reporting_without_pause(_: object, report: Reporter) -> int:
    began = time.monotonic()
    while time.monotonic() - began < 30:
        report(Progress("flood"))
    return 0


class Ending(JobWatch[int]):
    ending: int | Failure | None = None

    def ended(self, number: int, ending: int | Failure, reused: bool) -> None:  # noqa: ARG002
        self.ending = ending


def test_a_job_that_reports_without_pause_ends_at_its_limit(one_process: Backend, tmp_path: Path) -> None:
    watch, began = Ending(), time.monotonic()
    job = Job("flood", reporting_without_pause, None, seconds=0.5)
    run_jobs([job], ResultStore(tmp_path, int), one_process, watch)
    assert watch.ending == Failure("over time (limit 0.5 s)", over_time=True)
    assert time.monotonic() - began < 15


@dataclass(frozen=True, eq=False)
class Table:
    """A result with arrays."""

    values: JsonArray
    empty: JsonArray | None = None


def test_a_store_gives_arrays_back_to_the_last_bit(tmp_path: Path) -> None:
    values = np.random.default_rng(5).normal(size=(4, 3, 3)) * 10.0 ** np.arange(-150, 150, 100)
    values[0, 0] = [np.nan, np.inf, -0.0]
    store = ResultStore(tmp_path, Table)
    store.put("key", Table(values))
    table = store.get("key")
    assert table.values.tobytes() == values.tobytes()
    assert table.empty is None


def test_a_store_refuses_what_it_could_not_give_back(tmp_path: Path) -> None:
    store = ResultStore(tmp_path, Answer)
    three: Any = "three"  # on purpose not the whole number that an answer takes
    with pytest.raises(ValueError, match="number"):
        store.put("key", Answer(three))
    assert list(tmp_path.iterdir()) == []


def test_a_store_removes_its_files_and_no_others(tmp_path: Path) -> None:
    store = ResultStore(tmp_path / "results", Answer)
    store.put("key", Answer(1))
    (tmp_path / "results" / "notes.txt").touch()
    store.remove()
    assert [file.name for file in (tmp_path / "results").iterdir()] == ["notes.txt"]


def test_a_key_changes_with_every_bit_of_what_it_is_made_of() -> None:
    values = np.arange(6.0)
    keys = [
        content_key({"table": Table(values), "number": 1}),
        content_key({"table": Table(np.nextafter(values, 9.0)), "number": 1}),
        content_key({"table": Table(values.reshape(2, 3)), "number": 1}),
        content_key({"table": Table(values, values), "number": 1}),
        content_key({"table": Table(values), "number": 2}),
    ]
    assert len(set(keys)) == len(keys)
    assert keys[0] == content_key({"number": 1, "table": Table(values.copy())})


def test_ctrl_c_while_the_fork_server_starts_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    started = []

    def interrupted() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        started.append(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()))

    monkeypatch.setattr(forkserver, "ensure_running", interrupted)
    with pytest.raises(KeyboardInterrupt), one_thread_processes(()):
        pytest.fail("the interrupt was lost")
    assert started == [True]
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_processes_of_the_fork_server_leave_ctrl_c_to_their_parent() -> None:
    with one_thread_processes(()) as context, context.Pool(1) as pool:
        blocked = pool.apply(signal.pthread_sigmask, (signal.SIG_BLOCK, ()))
    assert signal.SIGINT in blocked


OUT_OF_MEMORY = """
import os, sys
from pathlib import Path
from job_samples import jobs_of, run, squared
from test_jobs import fills_memory
from omnibench.jobs.job import Job
from omnibench.jobs.job_process import Processes
Path(sys.argv[2], "cgroup.procs").write_text(str(os.getpid()))
jobs = [*jobs_of(fills_memory, [None]), Job("other", squared, 3)]
print(run(Path(sys.argv[1]), jobs, Processes(1)).reason(), flush=True)
"""


def fills_memory(_: object, __: Reporter) -> Answer:
    return Answer(sum(len(block) for block in [b"x" * 10**7 for _ in range(1000)]))


@pytest.fixture
def little_memory_group() -> Iterator[Path]:
    """A control group of 500 MB for processes."""
    group, limit = Path("/sys/fs/cgroup/memory/omnibench-test"), "memory.limit_in_bytes"
    try:
        group.mkdir(exist_ok=True)
        (group / limit).write_text(str(500 * 10**6))
    except OSError:
        pytest.skip("needs the right to make a control group (version 1)")
    yield group
    until(lambda: not (group / "cgroup.procs").read_text(), "the processes of the group to end")
    group.rmdir()


@pytest.mark.slow
def test_a_job_that_the_system_kills_for_lack_of_memory_says_so(tmp_path: Path, little_memory_group: Path) -> None:
    command = [sys.executable, "-c", OUT_OF_MEMORY, str(tmp_path), str(little_memory_group)]
    done = subprocess.run(command, env=IMPORTING_THIS, capture_output=True, text=True, check=True)
    how = "killed by SIGKILL: the system was out of memory"
    assert done.stdout == f"the process died without an answer ({how}) in each of 3 tries\n"
    assert (tmp_path / "other.json").exists()


PROGRAM = """
import sys
from pathlib import Path
from job_samples import run, squared
from test_jobs import until_told
from omnibench.jobs.job import Job
from omnibench.jobs.job_process import Processes
folder = Path(sys.argv[1])
jobs = [Job("first", squared, 2), Job("second", squared, 3), Job("waits", until_told, folder), Job("third", squared, 4)]
print(run(folder / "results", jobs, Processes(2)).answers(), flush=True)
"""


def until_told(folder: Path, _: Reporter) -> Answer:
    count = tried(folder, "waits")
    while not (folder / "go_on").exists():
        time.sleep(0.05)
    return Answer(count)


@pytest.mark.slow
def test_when_the_parent_is_killed_no_worker_is_left_and_nothing_that_ended_is_run_again(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    parent = subprocess.Popen(command, env=IMPORTING_THIS, start_new_session=True)
    results = tmp_path / "results"
    until(lambda: len(list(results.glob("*.json"))) == 3 and (tmp_path / "waits").exists(), "three jobs to end")
    parent.kill()
    parent.wait()
    until(lambda: not alive(parent.pid), "the workers to end")
    before = {file.name: file.stat().st_mtime_ns for file in results.iterdir()}
    assert set(before) == {"first.json", "second.json", "third.json"}
    (tmp_path / "go_on").touch()
    again = subprocess.run(command, env=IMPORTING_THIS, capture_output=True, text=True, check=True)
    assert again.stdout == "{0: 4, 1: 9, 2: 2, 3: 16}\n"  # the job that waited is in its second try
    assert before.items() <= {file.name: file.stat().st_mtime_ns for file in results.iterdir()}.items()
