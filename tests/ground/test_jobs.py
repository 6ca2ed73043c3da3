"""Many independent jobs: what every backend promises, limits, workers that die, and clear ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from job_samples import Answer, Notes, jobs_of, run, squared, tried
from timing import PATIENCE

import omnibench.jobs.job_process as job_process
from omnibench.errors import DataError
from omnibench.jobs.job import Backend, Failure, Job, ResultStore, run_jobs
from omnibench.jobs.local_backends import InPlace, Processes, local_backend
from omnibench.progress import Progress, Reporter


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


BACKENDS = [InPlace(), Processes(2)]


@pytest.mark.parametrize("backend", BACKENDS, ids=("in place", "processes"))
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

    def test_says_what_a_job_raised_where_no_other_process_could_raise_it_again_and_when_it_waited_in_vain(
        self, backend: Backend, tmp_path: Path
    ) -> None:
        jobs = [Job("two", wrong_in_two_parts, 0), Job("time", out_of_its_own_time, 0, seconds=60.0)]
        notes = run(tmp_path, jobs, backend)
        assert notes.reason(0) == "TwoPartError: one and another"
        failure = notes.endings[1]
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

    def test_leaves_the_environment_of_this_process(
        self, backend: Backend, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("OMP_NUM_THREADS", "7")
        monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
        assert run(tmp_path, [], backend).endings == {}
        run(tmp_path, jobs_of(squared, range(3)), backend)
        assert os.environ["OMP_NUM_THREADS"] == "7"
        assert "OPENBLAS_NUM_THREADS" not in os.environ


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


@pytest.mark.parametrize("end", ["answer", *(pytest.param(end, marks=pytest.mark.slow) for end in ("crash", "hang"))])
def test_what_a_job_started_ends_with_it(end: str, tmp_path: Path) -> None:
    file, seconds = tmp_path / "pid", 1.0
    while not file.exists() or not file.read_text():  # a busy machine may end the job before it started anything
        seconds *= 2
        assert seconds < PATIENCE
        job, notes = Job("job", leaving, (file, end), seconds=seconds if end == "hang" else None), Notes()
        run_jobs([job], ResultStore(tmp_path / "store", Answer), Processes(1), notes)
        assert isinstance(notes.endings[0], Answer) == (end == "answer")
    state = Path(f"/proc/{file.read_text()}/stat")
    deadline = time.monotonic() + PATIENCE
    while state.exists() and " Z " not in state.read_text():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def processes_of(notes: Notes) -> list[int]:
    answers = [notes.endings[number] for number in sorted(notes.endings)]
    return [answer.process for answer in answers if isinstance(answer, Answer)]


@pytest.mark.parametrize("limit", ["seconds", "memory_mb"])
def test_a_job_with_a_limit_has_a_process_of_one_thread_for_itself(limit: str, tmp_path: Path) -> None:
    notes = run(tmp_path, jobs_of(squared, range(4), **{limit: 1000.0}), Processes(2))
    assert len(set(processes_of(notes))) == 4
    assert os.getpid() not in processes_of(notes)
    assert {answer.threads for answer in notes.endings.values() if isinstance(answer, Answer)} == {"1"}


def test_quick_jobs_share_a_process_while_it_is_young(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert processes_of(run(tmp_path / "here", jobs_of(squared, [3]), local_backend(1))) == [os.getpid()]
    slow = run(tmp_path / "slow", jobs_of(slowly, [1.2] * 2), Processes(1))
    assert len(set(processes_of(slow))) == 2
    monkeypatch.setattr(job_process, "_YOUNG", PATIENCE)  # a busy machine takes long over a quick job, too
    assert len(set(processes_of(run(tmp_path, jobs_of(squared, range(9)), Processes(2))))) == 2


def slowly(seconds: float, _: Reporter) -> Answer:
    time.sleep(seconds)
    return Answer(0, os.getpid())


def leaves_behind(what: str, _: Reporter) -> Answer:
    if what == "variable":
        os.environ["LEFT"] = "behind"
    elif what == "handler":
        signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    elif what == "thread":
        threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
    elif what == "child":
        subprocess.Popen(["sleep", "60"])
    elif what == "folder":
        os.chdir("/")
    elif what == "error":
        raise DataError("wrong")
    return Answer(0, os.getpid())


@pytest.mark.parametrize("what", ["variable", "handler", "thread", "child", "folder", "error", "nothing"])
def test_a_job_that_leaves_something_behind_shares_its_process_with_no_later_one(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job_process, "_YOUNG", PATIENCE)
    first = Job("first", leaves_behind, what)
    processes = processes_of(run(tmp_path, [Job("before", squared, 1), first, Job("after", squared, 2)], Processes(1)))
    assert (processes[0] == processes[-1]) == (what == "nothing")


class TestWorkersThatDie:
    @pytest.mark.parametrize(
        "by", [signal.SIGKILL, *(pytest.param(by, marks=pytest.mark.slow) for by in (signal.SIGTERM, signal.SIGHUP))]
    )
    def test_a_job_that_is_killed_is_tried_three_times(self, by: signal.Signals, tmp_path: Path) -> None:
        jobs = [*jobs_of(killed, [(tmp_path, by)]), Job("other", squared, 3)]
        notes = run(tmp_path / "results", jobs, Processes(2))
        # Of other tests' processes some are killed for lack of memory, which the system counts for all.
        reason = notes.reason().replace(": the system was out of memory", "")
        assert reason == f"the process died without an answer (killed by {by.name}) in each of 3 tries"
        assert (tmp_path / "killed").stat().st_size == 3
        assert notes.endings[1] == ResultStore(tmp_path / "results", Answer).get("other")

    def test_a_job_that_is_killed_once_or_after_writing_has_a_result(self, tmp_path: Path) -> None:
        assert run(tmp_path / "once", jobs_of(killed_once, [tmp_path]), Processes(1)).answers() == {0: 2}
        written = tmp_path / "written"
        assert run(written, jobs_of(killed_after_writing, [written]), Processes(1)).answers() == {0: 7}

    def test_a_job_that_ends_its_process_is_named_with_the_exit_code(self, tmp_path: Path) -> None:
        notes = run(tmp_path, jobs_of(ended_with, [0, 3]), Processes(1))
        assert "(exit code 0)" in notes.reason(0)
        assert "(exit code 3)" in notes.reason(1)

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
