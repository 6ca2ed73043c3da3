"""Work in processes: in order, as it is needed, and with clear ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator

import pytest

from omnibench.errors import DataError, OmnibenchError
from omnibench.processes import in_processes


def squared_later(number: int) -> int:
    time.sleep(0.1 if number == 0 else 0.0)
    return number * number


def refused(number: int) -> int:
    if number == 2:
        raise DataError("two is wrong")
    return number


def died(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def threads(_: int) -> tuple[int, str | None]:
    return os.getpid(), os.environ.get("OPENBLAS_NUM_THREADS")


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_results_come_in_the_order_of_the_jobs(workers: int) -> None:
    assert list(in_processes(squared_later, range(7), workers)) == [0, 1, 4, 9, 16, 25, 36]


@pytest.mark.parametrize("workers", [1, 2])
def test_what_the_work_raises_is_raised_here(workers: int) -> None:
    with pytest.raises(DataError, match="two is wrong"):
        list(in_processes(refused, range(9), workers))
    assert not multiprocessing.active_children()


def test_a_worker_that_dies_is_one_line() -> None:
    with pytest.raises(OmnibenchError, match="a worker process died"):
        list(in_processes(died, range(4), 2))
    assert not multiprocessing.active_children()


def test_jobs_are_taken_as_they_are_needed() -> None:
    taken = []

    def jobs() -> Iterator[int]:
        for number in range(50):
            taken.append(number)
            yield number

    results = in_processes(squared_later, jobs(), 2)
    next(results)
    assert len(taken) < 20  # though the first result came last
    results.close()
    assert not multiprocessing.active_children()


def test_workers_are_others_with_one_thread_each() -> None:
    found = set(in_processes(threads, range(6), 2))
    assert os.getpid() not in {process for process, _ in found}
    assert {count for _, count in found} == {"1"}


def test_this_process_keeps_its_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    assert list(in_processes(squared_later, range(3), 2)) == [0, 1, 4]
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_no_jobs_no_results() -> None:
    assert list(in_processes(squared_later, [], 2)) == []
