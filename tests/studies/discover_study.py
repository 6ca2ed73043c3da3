"""The exam of ``omnibench discover``: how often it names a hidden effect, on sets made without its code.

    python tests/studies/discover_study.py --out exam [--seeds 20] [--only single --only null] [--quick] [--table]

Every set is a job in the store --out, under its task and the code that discovers: run again, it goes on where it was,
and does anew what other code has done. --table prints the tables of what is there; --any-code takes results of other
code, too, and says so. Seeds from 1000 on are for tuning; those below are the exam.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

from hidden.figures import Row, effect_lines, further_table, issue_table
from hidden.sets import LEVELS
from hidden.tasks import GROUPS, Result, Task, carry_out, tasks

import omnibench
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import Failure, Job, JobWatch, ResultStore, code_digest, content_key, run_jobs

ROOMS = ("data", "discover", "fit", "robot")  # the code that a result depends on, beside the makers of sets


def main() -> None:
    """Make the sets that are missing, then print the tables."""
    arguments = _arguments()
    store = ResultStore(arguments.out, Result)
    wanted = _wanted(arguments)
    if not arguments.table:
        carry_out_all(wanted, store, arguments.jobs, arguments.backend)
    results = every_result(store) if arguments.any_code else results_of(wanted, store)
    print_tables([each for each in results if _matches(each.task, arguments.only)], other_code=arguments.any_code)


def carry_out_all(wanted: Sequence[Task], store: ResultStore[Result], workers: int, backend: str = "processes") -> None:
    """Carry out the tasks that have no result by this code yet."""
    choice = BackendChoice(name=backend, workers=workers)
    with open_backend(choice, ("hidden.tasks",)) as opened:
        run_jobs([_job(task) for task in wanted], store, opened, _Said(wanted))


def results_of(wanted: Iterable[Task], store: ResultStore[Result]) -> list[Result]:
    """The results by this code that are there."""
    found = (store.get(_job(task).key) for task in wanted)
    return [result for result in found if result is not None]


def every_result(store: ResultStore[Result]) -> list[Result]:
    """All results that are there, the latest of each task."""
    latest: dict[str, Result] = {}
    for file in sorted(store.folder.glob("*.json"), key=lambda path: path.stat().st_mtime):
        result = store.get(file.stem)
        if result is not None:
            latest[result.task.key] = result
    return list(latest.values())


def print_tables(results: Sequence[Result], *, other_code: bool = False) -> None:
    """Print the answers for every effect, then the main table, then further figures."""
    print("Simulated recordings, 180 + 180 runs each. Rates with their 95 % intervals (Wilson).")
    print("Results of other versions of the code are among them.\n" if other_code else "")
    print("\n".join(effect_lines(results)), "\n")
    _print_rows("issue 20", issue_table(results))
    _print_rows("beside it", further_table(results))


class _Said(JobWatch[Result]):
    """A line for every set that ends."""

    def __init__(self, wanted: Sequence[Task]) -> None:
        self._wanted, self._ended = wanted, 0

    def ended(self, number: int, ending: Result | Failure, reused: bool) -> None:
        self._ended += 1
        if isinstance(ending, Failure):
            said = ending.reason
        else:
            said = ending.judgement.outcome if ending.judgement else ending.failure
        if not reused:
            print(f"{self._ended}/{len(self._wanted)} {self._wanted[number].key}: {said}", flush=True)


def _job(task: Task) -> Job[Result]:
    return Job(content_key({"task": task, "code": discovering_code()}), carry_out, task)


@cache
def discovering_code() -> str:
    """A hash of the code that discovers and of that which hides."""
    package = Path(omnibench.__file__).parent
    makers = Path(__file__).parent
    rooms = (file for room in ROOMS for file in (package / room).rglob("*.py") if "report" not in file.parts)
    return code_digest(package, rooms) + code_digest(
        makers, [*makers.glob("hidden/*.py"), *makers.glob("foreign/*.py")]
    )


def _print_rows(title: str, rows: Sequence[Row]) -> None:
    print(f"{title:62}{'asked':>9} {'aim':>9}  seen")
    for row in rows:
        print(f"{row.figure:62}{row.least:>9} {row.aim:>9}  {row.seen}")
    print()


def _wanted(arguments: argparse.Namespace) -> list[Task]:
    count, levels = arguments.seeds, tuple(LEVELS[name] for name in arguments.levels)
    seeds = range(arguments.first_seed, arguments.first_seed + count)
    return [task for task in tasks(seeds, levels, GROUPS) if _matches(task, arguments.only)]


def _matches(task: Task, only: Sequence[str]) -> bool:
    return not only or bool({task.group, *task.effects} & set(only))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of results, a file a set")
    parser.add_argument("--only", action="append", default=[], metavar="NAME", help=f"{', '.join(GROUPS)} or an effect")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--levels", nargs="+", choices=list(LEVELS), default=list(LEVELS))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--backend", default="processes", help="processes, dask, or a scheduler's tcp://HOST:PORT")
    parser.add_argument("--table", action="store_true", help="print the tables of what is there")
    parser.add_argument("--any-code", action="store_true", help="take results of other versions of the code, too")
    parser.add_argument("--quick", action="store_true", help="one seed, strong effects only")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.seeds, arguments.levels = 1, ["strong"]
    return arguments


if __name__ == "__main__":
    main()
