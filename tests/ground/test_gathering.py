"""Results of many jobs in memory and in files, and Ctrl-C while processes start."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from job_samples import Answer, wait_for

import omnibench.jobs.job_process as packing
from omnibench.errors import DataError
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import Backend, Failure, Job, JobWatch, ResultStore, content_key, gathered, run_jobs
from omnibench.processes import one_thread_processes
from omnibench.progress import Progress, Reporter
from omnibench.robot.kinematics import JsonArray


@pytest.fixture
def one_process() -> Iterator[Backend]:
    with open_backend(BackendChoice(workers=1)) as backend:
        yield backend
    assert not multiprocessing.active_children()


def total(order: tuple[int, np.ndarray], _: Reporter) -> tuple[float, int, int]:
    number, shared = order
    return number + float(shared.sum()), os.getpid(), len(packing._KEPT)


def test_results_are_those_of_the_function_in_their_order(one_process: Backend) -> None:
    data = np.arange(5.0)
    orders = [(number, data) for number in range(7)]
    by_jobs = gathered(one_process, total, orders, shared=(data,))
    assert [result for result, *_ in by_jobs] == [result for result, *_ in gathered(None, total, orders)]


def test_calls_share_a_process_which_keeps_no_more_than_the_last_jobs_share(one_process: Backend) -> None:
    found = []
    for size in range(1, 5):
        data = np.ones(size)
        found += gathered(one_process, total, [(0, data), (1, data)], shared=(data,))
    assert [result for result, *_ in found] == [1, 2, 2, 3, 3, 4, 4, 5]
    assert {kept for *_, kept in found} == {1}
    assert len({process for _, process, _ in found}) == 1


def nothing_of_it(number: int, _: Reporter) -> int:
    return number


def test_what_no_argument_holds_may_be_shared(one_process: Backend) -> None:
    other = np.ones(3)
    found = gathered(one_process, total, [(0, other), (1, np.zeros(2)), (2, other)], shared=(other,))
    assert [result for result, *_ in found] == [3, 1, 5]
    assert gathered(one_process, nothing_of_it, [4, 5], shared=(other,)) == [4, 5]


def test_a_waiting_process_that_is_killed_costs_no_job_a_try(one_process: Backend) -> None:
    data = np.ones(3)
    ((_, process, _),) = gathered(one_process, total, [(0, data)], shared=(data,))
    os.kill(process, signal.SIGKILL)
    wait_for(lambda: not psutil.pid_exists(process) or psutil.Process(process).status() == psutil.STATUS_ZOMBIE)
    ((result, other, _),) = gathered(one_process, total, [(1, data)], shared=(data,))
    assert result == 4
    assert other != process


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


class TestStore:
    def test_gives_arrays_back_to_the_last_bit(self, tmp_path: Path) -> None:
        values = np.random.default_rng(5).normal(size=(4, 3, 3)) * 10.0 ** np.arange(-150, 150, 100)
        values[0, 0] = [np.nan, np.inf, -0.0]
        store = ResultStore(tmp_path, Table)
        store.put("key", Table(values))
        table = store.get("key")
        assert table.values.tobytes() == values.tobytes()
        assert table.empty is None

    def test_refuses_what_it_could_not_give_back(self, tmp_path: Path) -> None:
        store = ResultStore(tmp_path, Answer)
        three: Any = "three"  # on purpose not the whole number that an answer takes
        with pytest.raises(ValueError, match="number"):
            store.put("key", Answer(three))
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
