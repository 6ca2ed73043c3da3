"""Dask as a backend: what every backend promises, workers and schedulers that die, and machines that differ."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from job_samples import Answer, Notes, jobs_of, run, squared, tried
from test_jobs import (
    asleep,
    ended_with,
    killed,
    killed_once,
    many_small_objects,
    two_is_wrong,
    with_jobs_of_its_own,
    wrong_in_two_parts,
)

from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import Backend, Job, run_jobs
from omnibench.jobs.result_store import ResultStore
from omnibench.progress import Progress


@pytest.fixture(scope="module")
def dask() -> Iterator[Backend]:
    with open_backend(BackendChoice(name="dask", workers=2)) as backend:
        yield backend


def run(folder: Path, jobs, backend) -> Notes:
    notes = Notes()
    run_jobs(jobs, ResultStore(folder, Answer), backend, notes)
    return notes


def test_gives(dask, tmp_path):
    notes = run(tmp_path, jobs_of(squared, range(7)), dask)
    assert notes.answers() == {number: number**2 for number in range(7)}
    assert sorted(notes.began_numbers) == list(range(7))
    assert dict(notes.moves) == {number: Progress("squaring", number) for number in range(7)}
    assert {file.name for file in tmp_path.iterdir()} == {f"job-{number}.json" for number in range(7)}
    assert {a.threads for a in notes.endings.values()} == {"1"}


def test_raise(dask, tmp_path):
    notes = run(tmp_path, jobs_of(two_is_wrong, range(4)), dask)
    assert notes.reason(2) == "DataError: two is wrong"
    assert run(tmp_path / "b", jobs_of(wrong_in_two_parts, [0]), dask).reason() == "TwoPartError: one and another"
    notes = run(tmp_path, jobs_of(ended_with, [3]), dask)
    print(notes.endings)
    notes = run(tmp_path / "k", jobs_of(killed_once, [tmp_path]), dask)
    print(notes.endings)
    notes = run(tmp_path / "kk", jobs_of(killed, [(tmp_path, signal.SIGKILL)]), dask)
    print(notes.endings)
    notes = run(
        tmp_path / "kkk",
        [Job("x", asleep, 0, seconds=1.0), Job("y", many_small_objects, tmp_path, memory_mb=400)],
        dask,
    )
    print(notes.endings)
    notes = run(tmp_path / "kkkk", jobs_of(with_jobs_of_its_own, [tmp_path]), dask)
    print(notes.endings)


def kills_worker(folder, _):
    if tried(folder, "n") < 3:
        os.kill(os.getppid(), 0)
        import psutil

        psutil.Process().parent().parent().kill()
        time.sleep(10)
    return Answer(1)


def kills_worker_always(folder, _):
    tried(folder, "m")
    import psutil

    psutil.Process().parent().parent().kill()
    time.sleep(10)


def test_kill(dask, tmp_path):
    notes = run(tmp_path / "k", [Job("x", kills_worker, tmp_path), *jobs_of(squared, range(20))], dask)
    print(notes.endings)
    notes = run(tmp_path / "kz", [Job("x", kills_worker_always, tmp_path), *jobs_of(squared, range(20))], dask)
    print(notes.endings[0], (tmp_path / "m").stat())
