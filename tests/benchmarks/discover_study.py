"""Study of ``omnibench discover``: how often it names a hidden effect, on sets made without its code.

    python tests/benchmarks/discover_study.py --out study.jsonl [--seeds 20] [--only single --only null] [--quick]

One line of JSON a set, added as it comes: run again with the same file, and it goes on where it was. With --table the
tables are printed from what is there. Seeds from 1000 on are for tuning; those below are the exam.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from hidden.figures import Row, effect_lines, further_table, issue_table
from hidden.sets import LEVELS
from hidden.tasks import GROUPS, Result, Task, carry_out, tasks


def main() -> None:
    """Make the sets that are missing, then print the tables."""
    arguments = _arguments()
    results = read_results(arguments.out)
    if not arguments.table:
        done = {each.task.key for each in results}
        missing = [task for task in _wanted(arguments) if task.key not in done]
        results += carry_out_all(missing, arguments.out, arguments.jobs)
    print_tables([each for each in results if _matches(each.task, arguments.only)])


def read_results(path: Path) -> list[Result]:
    """The results of a file, none if it is not there. A last line that was cut off is left out."""
    if not path.exists():
        return []
    lines = path.read_text().split("\n")
    return [Result.model_validate_json(line) for line in lines[:-1]]


def carry_out_all(missing: Sequence[Task], path: Path, jobs: int) -> list[Result]:
    """Carry out tasks and add each result to the file at once."""
    found = []
    _end_at_a_whole_line(path)
    with ProcessPoolExecutor(jobs) as pool, path.open("a") as file:
        for number, future in enumerate(as_completed([pool.submit(carry_out, task) for task in missing]), 1):
            result = future.result()
            file.write(result.model_dump_json() + "\n")
            file.flush()
            found.append(result)
            said = result.judgement.outcome if result.judgement else result.failure
            print(f"{number}/{len(missing)} {result.task.key}: {said}", flush=True)
    return found


def _end_at_a_whole_line(path: Path) -> None:
    """Remove a last line that was cut off when a study was stopped."""
    if path.exists():
        written = path.read_bytes()
        with path.open("r+b") as file:
            file.truncate(written.rfind(b"\n") + 1)


def print_tables(results: Sequence[Result]) -> None:
    """Print the answers for every effect, then the main table, then further figures."""
    print("Simulated recordings, 180 + 180 runs each. Rates with their 95 % intervals (Wilson).\n")
    print("\n".join(effect_lines(results)), "\n")
    _print_rows("issue 5", issue_table(results))
    _print_rows("beside it", further_table(results))


def _print_rows(title: str, rows: Sequence[Row]) -> None:
    print(f"{title:46}{'asked':>9} {'aim':>9}  seen")
    for row in rows:
        print(f"{row.figure:46}{row.least:>9} {row.aim:>9}  {row.seen}")
    print()


def _wanted(arguments: argparse.Namespace) -> list[Task]:
    count, levels = arguments.seeds, tuple(LEVELS[name] for name in arguments.levels)
    seeds = range(arguments.first_seed, arguments.first_seed + count)
    return [task for task in tasks(seeds, levels, GROUPS) if _matches(task, arguments.only)]


def _matches(task: Task, only: Sequence[str]) -> bool:
    return not only or bool({task.group, *task.effects} & set(only))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="file of results, one line of JSON a set")
    parser.add_argument("--only", action="append", default=[], metavar="NAME", help=f"{', '.join(GROUPS)} or an effect")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--levels", nargs="+", choices=list(LEVELS), default=list(LEVELS))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--table", action="store_true", help="print the tables of what is there")
    parser.add_argument("--quick", action="store_true", help="one seed, strong effects only")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.seeds, arguments.levels = 1, ["strong"]
    return arguments


if __name__ == "__main__":
    main()
