"""Many independent jobs: results as files, limits, workers that die, and clear ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from timing import PATIENCE

from omnibench.errors import DataError
from omnibench.jobs.job import Backend, Failure, Job, JobWatch, run_jobs
from omnibench.jobs.local_backends import InPlace, Processes, local_backend
from omnibench.jobs.result_store import ResultStore, content_key
from omnibench.progress import Progress, Reporter
from omnibench.robot.kinematics import JsonArray


@dataclass(frozen=True)
class Answer:
    """Result of the jobs here."""

    number: int
    process: int = 0
    threads: str | None = None


class Notes(JobWatch[Answer]):
    """Notes what a backend says."""

    def __init__(self) -> None:
        self.began_numbers: list[int] = []
        self.moves: list[tuple[int, Progress]] = []
        self.endings: dict[int, Answer | Failure] = {}
        self.reused: set[int] = set()

    def began(self, number: int) -> None:
        self.began_numbers.append(number)

    def moved(self, number: int, event: Progress) -> None:
        self.moves.append((number, event))

    def ended(self, number: int, ending: Answer | Failure, reused: bool) -> None:
        assert number not in self.endings
        self.endings[number] = ending
        self.reused |= {number} if reused else set()

    def answers(self) -> dict[int, int]:
        """The numbers of the answers; a failure shows itself."""
        return {number: getattr(ending, "number", ending) for number, ending in sorted(self.endings.items())}  # type: ignore[misc]

    def reason(self, number: int = 0) -> str:
        failure = self.endings[number]
        assert isinstance(failure, Failure)
        return failure.reason


def run(folder: Path, jobs: Iterable[Job[Answer]], backend: Backend) -> Notes:
    """Run jobs with the store ``folder``. No process is left behind."""
    notes = Notes()
    run_jobs(jobs, ResultStore(folder, Answer), backend, notes)
    assert not multiprocessing.active_children()
    return notes


def jobs_of(function: Any, arguments: Iterable[Any], **limits: float) -> list[Job[Answer]]:
    return [Job(f"job-{number}", function, argument, **limits) for number, argument in enumerate(arguments)]


def tried(folder: Path, name: str) -> int:
    """Note that the job ``name`` is tried; how many times it has been, this one included."""
    with (folder / name).open("a") as file:
        file.write(".")
    return (folder / name).stat().st_size


def squared(number: int, report: Reporter) -> Answer:
    report(Progress("squaring", number))
    return Answer(number * number, os.getpid(), os.environ.get("OPENBLAS_NUM_THREADS"))


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


def killed_after_writing(folder: Path, _: Reporter) -> Answer:
    ResultStore(folder, Answer).put("job-0", Answer(7))
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


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


# For programs that import this file.
IMPORTING_THIS = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
BACKENDS = [InPlace(), Processes(1), Processes(3)]


@pytest.mark.parametrize("backend", BACKENDS, ids=("in place", "one process", "three processes"))
class TestEveryBackend:
    def test_gives_the_result_of_every_job(self, backend: Backend, tmp_path: Path) -> None:
        notes = run(tmp_path, jobs_of(squared, range(7)), backend)
        assert notes.answers() == {number: number**2 for number in range(7)}
        assert sorted(notes.began_numbers) == list(range(7))
        assert dict(notes.moves) == {number: Progress("squaring", number) for number in range(7)}
        assert {file.name for file in tmp_path.iterdir()} == {f"job-{number}.json" for number in range(7)}

    def test_says_what_a_job_raised_and_runs_the_others(self, backend: Backend, tmp_path: Path) -> None:
        notes = run(tmp_path, jobs_of(two_is_wrong, range(4)), backend)
        failure = notes.endings.pop(2)
        assert isinstance(failure, Failure)
        assert isinstance(failure.error, DataError)
        assert (failure.reason, failure.over_time, failure.killed) == ("DataError: two is wrong", False, False)
        assert notes.answers() == {0: 0, 1: 1, 3: 3}

    def test_says_what_a_job_raised_where_no_other_process_could_raise_it_again(
        self, backend: Backend, tmp_path: Path
    ) -> None:
        notes = run(tmp_path, jobs_of(wrong_in_two_parts, [0]), backend)
        assert notes.reason() == "TwoPartError: one and another"

    def test_tells_a_job_that_waited_in_vain_from_one_over_its_time(self, backend: Backend, tmp_path: Path) -> None:
        failure = run(tmp_path, jobs_of(out_of_its_own_time, [0], seconds=60.0), backend).endings[0]
        assert isinstance(failure, Failure)
        assert failure.reason == "TimeoutError: the map's server does not answer"
        assert not failure.over_time

    def test_does_not_run_a_job_whose_result_is_there(self, backend: Backend, tmp_path: Path) -> None:
        run(tmp_path, jobs_of(squared, range(3)), backend)
        (tmp_path / "job-1.json").write_text('{"number": 1')
        again = run(tmp_path, jobs_of(squared, [5, 5, 5, 5]), backend)
        assert again.answers() == {0: 0, 1: 25, 2: 4, 3: 25}  # of a damaged file nothing is believed
        assert (again.reused, sorted(again.began_numbers)) == ({0, 2}, [1, 3])

    def test_takes_jobs_as_they_are_needed(self, backend: Backend, tmp_path: Path) -> None:
        class Impatient(Notes):
            def ended(self, number: int, ending: Answer | Failure, reused: bool) -> None:
                super().ended(number, ending, reused)
                raise KeyboardInterrupt

        taken = []

        def jobs() -> Iterator[Job[Answer]]:
            for job in jobs_of(squared, range(50)):
                taken.append(job)
                yield job

        with pytest.raises(KeyboardInterrupt):
            run_jobs(jobs(), ResultStore(tmp_path, Answer), backend, Impatient())
        assert len(taken) <= 3
        assert not multiprocessing.active_children()

    def test_has_nothing_to_do_without_jobs(self, backend: Backend, tmp_path: Path) -> None:
        assert run(tmp_path, [], backend).endings == {}

    def test_leaves_the_environment_of_this_process(
        self, backend: Backend, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("OMP_NUM_THREADS", "7")
        monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
        run(tmp_path, jobs_of(squared, range(3)), backend)
        assert os.environ["OMP_NUM_THREADS"] == "7"
        assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_a_job_may_change_its_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other").mkdir()
    assert run(Path("results"), jobs_of(elsewhere, [tmp_path / "other"]), Processes(1)).answers() == {0: 3}


def test_every_job_has_a_process_of_one_thread(tmp_path: Path) -> None:
    answers = run(tmp_path, jobs_of(squared, range(4)), Processes(2)).endings.values()
    processes = {answer.process for answer in answers if isinstance(answer, Answer)}
    assert len(processes) == 4
    assert os.getpid() not in processes
    assert {answer.threads for answer in answers if isinstance(answer, Answer)} == {"1"}


def test_one_worker_is_this_process_where_no_isolation_is_needed(tmp_path: Path) -> None:
    (answer,) = run(tmp_path, jobs_of(squared, [3]), local_backend(1)).endings.values()
    assert isinstance(answer, Answer)
    assert answer.process == os.getpid()


class TestWorkersThatDie:
    @pytest.mark.parametrize("by", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP], ids=str)
    def test_a_job_that_is_killed_is_tried_three_times(self, by: signal.Signals, tmp_path: Path) -> None:
        jobs = [*jobs_of(killed, [(tmp_path, by)]), Job("other", squared, 3)]
        notes = run(tmp_path / "results", jobs, Processes(2))
        assert notes.reason() == f"the process died without an answer (killed by {by.name}) in each of 3 tries"
        assert (tmp_path / "killed").stat().st_size == 3
        assert notes.endings[1] == ResultStore(tmp_path / "results", Answer).get("other")

    def test_a_job_that_is_killed_once_has_a_result(self, tmp_path: Path) -> None:
        assert run(tmp_path / "results", jobs_of(killed_once, [tmp_path]), Processes(1)).answers() == {0: 2}

    def test_a_worker_that_is_killed_after_writing_has_done_its_job(self, tmp_path: Path) -> None:
        assert run(tmp_path, jobs_of(killed_after_writing, [tmp_path]), Processes(1)).answers() == {0: 7}

    @pytest.mark.parametrize("code", [0, 3])
    def test_a_job_that_ends_its_process_is_named_with_the_exit_code(self, code: int, tmp_path: Path) -> None:
        notes = run(tmp_path, jobs_of(ended_with, [code]), Processes(1))
        assert notes.reason() == f"the process died without an answer (exit code {code})"

    def test_a_job_that_crashes_is_not_tried_again(self, tmp_path: Path) -> None:
        notes = run(tmp_path / "results", jobs_of(crashed, [tmp_path]), Processes(1))
        assert notes.reason() == "the process died without an answer (killed by SIGABRT)"
        assert (tmp_path / "crashed").stat().st_size == 1


class TestLimits:
    def test_a_job_over_its_memory_is_ended_and_not_tried_again(self, tmp_path: Path) -> None:
        jobs = [
            Job("one", one_large_array, tmp_path, memory_mb=400),
            Job("many", many_small_objects, tmp_path, memory_mb=400),
            Job("little", little_memory, tmp_path, memory_mb=400),
        ]
        notes = run(tmp_path / "results", jobs, Processes(2))
        assert {notes.reason(0), notes.reason(1)} == {"out of memory (limit 400 MB)"}
        assert notes.endings[2] == Answer(10**6)
        assert {(tmp_path / name).stat().st_size for name in ("one_large_array", "many_small_objects")} == {1}

    def test_a_job_over_its_time_is_ended_and_not_tried_again(self, tmp_path: Path) -> None:
        jobs = [Job(work.__name__, work, None, seconds=1.0) for work in (asleep, deaf)]
        notes = run(tmp_path, [*jobs, Job("other", squared, 2)], Processes(3))
        over_time = Failure("over time (limit 1 s)", over_time=True)
        assert (notes.endings[0], notes.endings[1]) == (over_time, over_time)
        assert sorted(notes.began_numbers) == [0, 1, 2]


def test_within_a_job_there_are_no_further_processes(tmp_path: Path) -> None:
    (answer,) = run(tmp_path, jobs_of(with_jobs_of_its_own, [tmp_path]), Processes(2)).endings.values()
    assert isinstance(answer, Answer)
    assert answer.number == 3
    assert str(answer.process) == answer.threads  # its own


def test_whatever_the_watch_raises_ends_the_workers(tmp_path: Path) -> None:
    class Interrupts(Notes):
        def ended(self, number: int, ending: Answer | Failure, reused: bool) -> None:
            super().ended(number, ending, reused)
            raise KeyboardInterrupt

    store, notes = ResultStore(tmp_path, Answer), Interrupts()
    with pytest.raises(KeyboardInterrupt):
        run_jobs([*jobs_of(asleep, [None]), Job("quick", squared, 3)], store, Processes(2), notes)
    assert not multiprocessing.active_children()
    assert notes.endings[1] == store.get("quick")


OUT_OF_MEMORY = """
import os, sys
from pathlib import Path
from test_jobs import *
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
    wait_for(lambda: not (group / "cgroup.procs").read_text())
    group.rmdir()


def test_a_job_that_the_system_kills_for_lack_of_memory_says_so(tmp_path: Path, little_memory_group: Path) -> None:
    command = [sys.executable, "-c", OUT_OF_MEMORY, str(tmp_path), str(little_memory_group)]
    done = subprocess.run(command, env=IMPORTING_THIS, capture_output=True, text=True, check=True)
    how = "killed by SIGKILL: the system was out of memory"
    assert done.stdout == f"the process died without an answer ({how}) in each of 3 tries\n"
    assert (tmp_path / "other.json").exists()


PROGRAM = """
import sys
from pathlib import Path
from test_jobs import *
folder = Path(sys.argv[1])
jobs = [Job("first", squared, 2), Job("second", squared, 3), Job("waits", until_told, folder), Job("third", squared, 4)]
print(run(folder / "results", jobs, Processes(2)).answers(), flush=True)
"""


def until_told(folder: Path, _: Reporter) -> Answer:
    count = tried(folder, "waits")
    while not (folder / "go_on").exists():
        time.sleep(0.05)
    return Answer(count)


def wait_for(happened: Any) -> None:
    """Wait for an event."""
    deadline = time.monotonic() + PATIENCE
    while not happened():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.05)


def alive(session: int) -> list[str]:
    """Commands of the processes of a session that have not ended."""
    listed = subprocess.run(
        ["ps", "-o", "stat=,args=", "-s", str(session)], capture_output=True, text=True, check=False
    )
    return [line for line in listed.stdout.splitlines() if not line.startswith("Z")]


def test_when_the_parent_is_killed_no_worker_is_left_and_nothing_that_ended_is_run_again(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    parent = subprocess.Popen(command, env=IMPORTING_THIS, start_new_session=True)
    results = tmp_path / "results"
    wait_for(lambda: len(list(results.glob("*.json"))) == 3 and (tmp_path / "waits").exists())
    parent.kill()
    parent.wait()
    wait_for(lambda: not alive(parent.pid))
    before = {file.name: file.stat().st_mtime_ns for file in results.iterdir()}
    assert set(before) == {"first.json", "second.json", "third.json"}
    (tmp_path / "go_on").touch()
    again = subprocess.run(command, env=IMPORTING_THIS, capture_output=True, text=True, check=True)
    assert again.stdout == "{0: 4, 1: 9, 2: 2, 3: 16}\n"  # the job that waited is in its second try
    assert before.items() <= {file.name: file.stat().st_mtime_ns for file in results.iterdir()}.items()


@dataclass(frozen=True, eq=False)
class Table:
    """A result with arrays."""

    values: JsonArray
    empty: JsonArray | None = None


class TestStore:
    def test_gives_arrays_back_to_the_last_bit(self, tmp_path: Path) -> None:
        values = np.random.default_rng(5).normal(size=(4, 3, 3)) * 10.0 ** np.arange(-150, 150, 100)
        values[0, 0] = [np.nan, np.inf, -0.0]
        store = ResultStore(tmp_path, Table)
        store.put("key", Table(values))
        table = store.get("key")
        assert table is not None
        assert table.values.tobytes() == values.tobytes()
        assert table.empty is None

    def test_refuses_what_it_could_not_give_back(self, tmp_path: Path) -> None:
        store = ResultStore(tmp_path, Answer)
        with pytest.raises(ValueError, match="number"):
            store.put("key", Answer("three"))  # type: ignore[arg-type]
        assert list(tmp_path.iterdir()) == []

    def test_removes_its_files_and_no_others(self, tmp_path: Path) -> None:
        store = ResultStore(tmp_path / "results", Answer)
        store.put("key", Answer(1))
        (tmp_path / "results" / "notes.txt").touch()
        store.remove()
        assert [file.name for file in (tmp_path / "results").iterdir()] == ["notes.txt"]

    def test_a_key_changes_with_every_bit_of_what_it_is_made_of(self) -> None:
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
