"""The exam as a whole: its cases, the results on disk, and the tables."""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from check_exam.faults import MAKERS
from check_exam.judging import applies, table
from check_exam.motion import misfit
from check_exam.recordings import DATA, NAMES, Recording, recording
from check_exam.sitting import UNTOUCHED, Result, chosen_runs, generator, sit, sit_untouched
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import Failure, Job, JobWatch, ResultStore, run_jobs
from omnibench.progress import Reporter

QUICK = (
    ("omni3", "wheels_swapped"), ("diff", "wheel_negated"), ("omni4", "wheel_scale"), ("tricyc", "steering_zero"),
    ("robotino", "heading_unit"), ("diff", "reference_jump"),
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A case. kind: of the fault, or untouched; part: of the untouched recording."""

    robot: str
    kind: str
    seed: int
    part: str = ""

    @property
    def key(self) -> str:
        return f"{self.robot} {self.kind} {self.seed} {self.part}".strip()


def cases(robots: Sequence[str], kinds: Sequence[str], seeds: Sequence[int]) -> Iterator[Case]:
    """All cells that apply, a case a seed; and the untouched recordings: whole, each shape and session, parts."""
    for seed in seeds:
        for kind in (kind for kind in MAKERS if kind in kinds):
            yield from (Case(robot, kind, seed) for robot in robots if applies(kind, robot))
    if UNTOUCHED not in kinds:
        return
    for robot in robots:
        whole = recording(robot)
        sessions = sorted({run.session for run in whole.runs})
        shapes = sorted({session.split("_")[0] for session in sessions})
        for part in dict.fromkeys(["whole", *shapes, *sessions]):
            yield Case(robot, UNTOUCHED, 0, part)
        for seed in seeds:
            yield from (Case(robot, UNTOUCHED, seed, f"half {number}") for number in (1, 2))
            yield from (Case(robot, UNTOUCHED, seed, f"third {number}") for number in (1, 2, 3))


def part_of(case: Case) -> Recording:
    """The part of an untouched recording that a case names; of a single drive, parts of its time."""
    whole = recording(case.robot)
    if case.part == "whole":
        return whole
    word, _, number = case.part.partition(" ")
    if word not in ("half", "third"):
        runs = [run for run in whole.runs if run.session == word or run.session.startswith(f"{word}_")]
        return whole.of(runs)
    pieces, index = {"half": 2, "third": 3}[word], int(number) - 1
    order = generator(case.robot, word, case.seed).permutation(len(whole.runs))
    chosen = set(np.array_split(order, pieces)[index].tolist())
    return whole.of([run for position, run in enumerate(whole.runs) if position in chosen] or list(whole.runs))


def sit_case(case: Case, scratch: Path) -> Result:
    if case.kind == UNTOUCHED:
        return sit_untouched(case.part, part_of(case), case.seed, scratch)
    return sit(case.robot, case.kind, case.seed, scratch)


def sit_job(order: tuple[Case, Path], _: Reporter) -> Result:
    case, scratch = order
    return sit_case(case, scratch)


class _Sat(JobWatch[Result]):
    """Adds the results, in memory and as lines of the output, as cases end."""

    def __init__(self, cases: Sequence[Case], results: dict[str, Result], output: Path) -> None:
        self._cases, self._results, self._output, self._ended = cases, results, output, 0

    def ended(self, number: int, ending: Result | Failure, reused: bool) -> None:  # noqa: ARG002
        self._ended += 1
        case = self._cases[number]
        if isinstance(ending, Failure):
            ending = Result(case.robot, case.kind, case.seed, reason=ending.reason)
        self._results[case.key] = ending
        with self._output.open("a") as file:
            file.write(json.dumps({"case": case.key} | asdict(ending)) + "\n")
        state = "passed" if ending.passed else f"FAILED {ending.reason}"
        print(f"[{self._ended}/{len(self._cases)}] {case.key} ({ending.seconds:g} s): {state[:200]}", flush=True)


def read_results(file: Path) -> dict[str, Result]:
    """Results of an earlier run by their cases."""
    lines = file.read_text().splitlines() if file.is_file() else []
    stored = [json.loads(line) for line in lines if line.strip()]
    return {each["case"]: Result(**{key: value for key, value in each.items() if key != "case"}) for each in stored}


def wilson(hits: int, count: int) -> tuple[float, float]:
    """The 95 % interval of a share."""
    if not count:
        return 0.0, 1.0
    z, share = 1.96, hits / count
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return middle - half, middle + half


def shown(results: Sequence[Result]) -> str:
    """The tables: passed, found and sat of each cell; failures; shares."""
    faults = [result for result in results if result.kind != UNTOUCHED]
    lines = [f"{'passed/found/sat':24}" + "".join(f"{robot[:12]:>13}" for robot in NAMES)]
    for kind in table()["kinds"]:
        cells = []
        for robot in NAMES:
            sat = [result for result in faults if (result.kind, result.robot) == (kind, robot)]
            counts = f"{sum(r.passed for r in sat)}/{sum(r.found for r in sat)}/{len(sat)}"
            cells.append(counts if sat else "." if applies(kind, robot) else "-")
        lines.append(f"{kind:24}" + "".join(f"{cell:>13}" for cell in cells))
    lines.append("")
    for result in results:
        case = f"{result.robot} {result.kind} {result.seed} [{result.form}] {result.detail}"
        if not result.passed:
            lines.append(f"{'FALSE' if result.kind == UNTOUCHED else 'FAILED'} {case}: {result.reason}")
    untouched = [result for result in results if result.kind == UNTOUCHED]
    shares = (
        ("right finding", sum(r.found for r in faults), len(faults)),
        ("right finding and working fix", sum(r.passed for r in faults), len(faults)),
        ("untouched recordings with a false finding", sum(not r.found for r in untouched), len(untouched)),
        ("false findings", sum(len(r.beside) for r in untouched), len(untouched) * len(table()["kinds"])),
        ("faults with another finding beside", sum(bool(r.beside) for r in faults), len(faults)),
    )
    for name, hits, count in shares:
        low, high = wilson(hits, count)
        share = 100 * hits / count if count else math.nan
        lines.append(f"{name}: {hits} of {count}, {share:.1f} % ({100 * low:.1f} to {100 * high:.1f})")
    return "\n".join(lines)


def dry_run(chosen: Sequence[Case]) -> None:
    """Make the faults and say how far the design's odometry misses the reference with them, and without."""
    for case in chosen:
        if case.kind == UNTOUCHED:
            continue
        rng = generator(case.robot, case.kind, case.seed)
        damage = MAKERS[case.kind](chosen_runs(case.robot, case.kind, rng), rng)
        runs = f"{len(damage.recording.runs)} of {len(damage.sound.runs)} runs"
        figures = f"{misfit(damage.sound):.3f} -> {misfit(damage.recording):.3f}"
        print(f"{case.robot:17}{case.kind:22}{case.seed} {runs:18} misfit {figures:16} {damage.detail}", flush=True)


def main(description: str | None) -> int:
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--robots", nargs="+", default=list(NAMES), choices=NAMES)
    parser.add_argument("--kinds", nargs="+", default=[*MAKERS, UNTOUCHED], choices=[*MAKERS, UNTOUCHED])
    parser.add_argument("--quick", action="store_true", help="a few cases only")
    parser.add_argument("--makers", action="store_true", help="make the faults only")
    parser.add_argument("--again", action="store_true", help="sit cases again that have results")
    parser.add_argument("--failed", action="store_true", help="sit cases again that failed")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--backend", default="processes", help="processes, dask, or a scheduler's tcp://HOST:PORT")
    parser.add_argument("--output", type=Path, default=Path(tempfile.gettempdir()) / "check_exam.jsonl")
    given = parser.parse_args()
    if not DATA.is_dir():
        parser.error(f"the recordings are not at {DATA}")
    chosen = list(cases(given.robots, given.kinds, given.seeds))
    if given.quick:
        chosen = [Case(robot, kind, given.seeds[0]) for robot, kind in QUICK]
    if given.makers:
        dry_run(chosen)
        return 0
    results = {} if given.again else read_results(given.output)
    waiting = [case for case in chosen if case.key not in results or (given.failed and not results[case.key].passed)]
    scratch = given.output.with_suffix(".files")
    choice = BackendChoice(name=given.backend, workers=given.jobs)
    with tempfile.TemporaryDirectory() as folder, open_backend(choice, (__name__,)) as backend:
        jobs = [Job(str(number), sit_job, (case, scratch)) for number, case in enumerate(waiting)]
        run_jobs(jobs, ResultStore(Path(folder), Result), backend, _Sat(waiting, results, given.output))
    print(shown([results[case.key] for case in chosen if case.key in results]))
    return 0
