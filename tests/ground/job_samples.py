"""Jobs, and a watch that notes what becomes of them."""

import multiprocessing
import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omnibench.jobs.job import Backend, Failure, Job, JobWatch, ResultStore, run_jobs
from omnibench.progress import Progress, Reporter


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

    def answers(self) -> dict[int, int | Failure]:
        """The numbers of the answers; a failure shows itself."""
        return {
            number: ending.number if isinstance(ending, Answer) else ending
            for number, ending in sorted(self.endings.items())
        }

    def reason(self, number: int = 0) -> str:
        failure = self.endings[number]
        return failure.reason


def run(folder: Path, jobs: Iterable[Job[Answer]], backend: Backend) -> Notes:
    """Run jobs with the store ``folder``. No process is left behind."""
    notes, before = Notes(), set(multiprocessing.active_children())
    run_jobs(jobs, ResultStore(folder, Answer), backend, notes)
    assert set(multiprocessing.active_children()) <= before
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


# For programs that import the modules here.
IMPORTING_THIS = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
