"""Jobs that the system ends for lack of memory, and jobs whose parent is killed."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from job_samples import IMPORTING_THIS, Answer, tried, wait_for

from omnibench.progress import Reporter

OUT_OF_MEMORY = """
import os, sys
from pathlib import Path
from job_samples import jobs_of, run, squared
from test_jobs_killed_from_outside import fills_memory
from omnibench.jobs.job import Job
from omnibench.jobs.local_backends import Processes
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
from test_jobs_killed_from_outside import until_told
from omnibench.jobs.job import Job
from omnibench.jobs.local_backends import Processes
folder = Path(sys.argv[1])
jobs = [Job("first", squared, 2), Job("second", squared, 3), Job("waits", until_told, folder), Job("third", squared, 4)]
print(run(folder / "results", jobs, Processes(2)).answers(), flush=True)
"""


def until_told(folder: Path, _: Reporter) -> Answer:
    count = tried(folder, "waits")
    while not (folder / "go_on").exists():
        time.sleep(0.05)
    return Answer(count)


def alive(session: int) -> list[str]:
    """Commands of the processes of a session that have not ended."""
    listed = subprocess.run(
        ["ps", "-o", "stat=,args=", "-s", str(session)], capture_output=True, text=True, check=False
    )
    return [line for line in listed.stdout.splitlines() if not line.startswith("Z")]


@pytest.mark.slow
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
