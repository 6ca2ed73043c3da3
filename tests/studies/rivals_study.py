"""Study of ``omnibench discover`` and its rivals on the same hidden sets (needs the extra ``studies``).

    python tests/studies/rivals_study.py --out rivals --sets 300 --first-seed 0 [--only discover] [--table]

Sets are, by turns, of textbook, second and third forms, from outside the catalogue, and empty. Every set is a job in
the store --out, under its task, the rivals asked and the code: run again, it goes on where it was. Seeds from 1000 on
are for settings; those below are the exam.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from discover_study import discovering_code
from hidden.forms import FORMS
from hidden.sets import LEVELS, UNHEARD
from hidden.tasks import Group, Task
from rivals.judging import CONFIDENT, RIVALS, Figures, Result, carry_out

from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import Failure, Job, JobWatch, ResultStore, code_digest, content_key, run_jobs

_GROUPS: tuple[Group, ...] = ("matched", "single", "third", "outside", "null")
_SMALL = "small_sessions"  # 70 runs to fit, of 14 commands in three sessions: a fifth of the time
_STRIDES = 7  # from one effect to the next, prime to the numbers of effects: few sets have many of them
HEAD = (
    "method", "right name", "or class", "right, sure", "wrong, sure", "says none: null", "no sure name: outside",
    "place (F1)", "closed", "closed, new kind", "worse than plain", "parameter error", "s",
)  # fmt: skip


def main() -> None:
    """Ask the rivals on the sets that are missing, then print the table."""
    arguments = _arguments()
    store, names = ResultStore(arguments.out, Result), tuple(arguments.only or RIVALS)
    every = arguments.kinds_every
    jobs = [
        _job(task, names, kinds=bool(every) and number % every == 0, design=_SMALL if arguments.small else None)
        for number, task in enumerate(sets(arguments.sets, arguments.first_seed))
    ]
    if not arguments.table:
        choice = BackendChoice(name=arguments.backend, workers=arguments.jobs)
        with open_backend(choice, ("rivals.judging",)) as backend:
            run_jobs(jobs, store, backend, _Said())
    results = [result for job in jobs if (result := store.get(job.key)) is not None]
    print("\n".join([*(table(results, names)), "", *(lines(results, names) if arguments.each else ())]))


def sets(count: int, first_seed: int) -> Iterator[Task]:
    """So many sets, group by group in turn, strong and medium effects."""
    for number in range(count):
        group, index = _GROUPS[number % len(_GROUPS)], number // len(_GROUPS)
        known = list(UNHEARD if group == "outside" else FORMS)
        chosen = known[(_STRIDES * index + 5 * (number % len(_GROUPS))) % len(known)]
        level = LEVELS["strong" if index % 2 == 0 else "medium"]
        empty = group == "null"
        effects = () if empty else (chosen,)
        yield Task(group=group, effects=effects, level=0.0 if empty else level, seed=first_seed + number)


def table(results: Sequence[Result], names: Sequence[str]) -> list[str]:
    """The table of all rivals, in Markdown; sets whose effect would have to be implausibly large are left out."""
    rows = ["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
    for name in names:
        members = [(each.task, each.figures[name]) for each in results if each.reachable and name in each.figures]
        answered = [(task, each) for task, each in members if not each.failure]
        named = [each for task, each in answered if task.group in ("matched", "single", "third")]
        outside = [each for task, each in answered if task.group == "outside"]
        null = [each for task, each in answered if task.group == "null"]
        some = [*named, *outside]
        cells = [
            RIVALS[name].label,
            _rate(named, lambda each: each.right),
            _rate(named, lambda each: each.right or each.in_class),
            _rate(named, lambda each: each.right and each.names[0][1] >= CONFIDENT),
            _rate([each for _, each in answered], lambda each: each.wrong),
            _rate(null, lambda each: not each.says_something),
            _rate(outside, lambda each: each.says_something and not each.wrong),
            _mean(each.place for each in some),
            _median((each.closed for each in some), "{:.0%}"),
            _median((each.closed_kind for each in some), "{:.0%}"),
            _rate([each for each in some if each.closed is not None], lambda each: (each.closed or 0.0) < 0),
            _median((each.parameter_error for each in named), "{:.0%}"),
            _median((each.seconds for _, each in answered), "{:.1f}"),
        ]
        rows.append("| " + " | ".join(cells) + " |")
        if len(answered) < len(members):
            reasons = {each.failure for _, each in members if each.failure}
            rows.append(f"{name}: {len(members) - len(answered)} failures: {'; '.join(sorted(reasons))}")
    return rows


def lines(results: Sequence[Result], names: Sequence[str]) -> Iterator[str]:
    """What each rival answered on each set."""
    for result in results:
        yield f"{result.task.key}{'' if result.reachable else ' (not reachable)'}"
        for name in names:
            figures = result.figures[name]
            said = ", ".join(f"{effect} {confidence:.2f}" for effect, confidence in figures.names)
            closed = "/".join("-" if each is None else f"{each:.2f}" for each in (figures.closed, figures.closed_kind))
            yield (
                f"    {name:12}{'unnamed ' if figures.unnamed else ''}{said or '-'} [{', '.join(figures.covariates)}] "
                f"closed {closed} {figures.seconds:.1f} s {figures.failure}"
            )


def _rate(members: Sequence[Figures], test: Callable[[Figures], bool]) -> str:
    return f"{sum(map(test, members))}/{len(members)}" if members else "-"


def _mean(values: Iterable[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.2f}" if known else "-"


def _median(values: Iterable[float | None], form: str) -> str:
    known = [value for value in values if value is not None]
    return form.format(float(np.median(known))) if known else "-"


class _Said(JobWatch[Result]):
    """A line for every set that ends."""

    def ended(self, number: int, ending: Result | Failure, reused: bool) -> None:
        if not reused:
            said = ending.reason if isinstance(ending, Failure) else ending.task.key
            print(f"{number + 1}: {said}", flush=True)


def _job(task: Task, names: tuple[str, ...], *, kinds: bool, design: str | None) -> Job[Result]:
    folder = Path(__file__).parent
    code = discovering_code() + code_digest(folder, folder.glob("rivals/*.py"))
    facts = {"task": task, "rivals": names, "kinds": kinds, "design": design, "code": code}
    return Job(content_key(facts), carry_out, (task, names, kinds, design))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of results, a file a set")
    parser.add_argument("--sets", type=int, default=24)
    parser.add_argument("--only", action="append", choices=list(RIVALS), help="one rival; may be given again")
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument(
        "--kinds-every", type=int, default=1, help="ask again without a kind of motion on every so manyth set; 0: none"
    )
    parser.add_argument("--small", action="store_true", help="sets of 70 + 70 runs, for settings")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--backend", default="processes", help="processes, dask, or a scheduler's tcp://HOST:PORT")
    parser.add_argument("--table", action="store_true", help="print the table of what is there")
    parser.add_argument("--each", action="store_true", help="print each answer, too")
    return parser.parse_args()


if __name__ == "__main__":
    main()
