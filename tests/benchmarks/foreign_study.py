"""Study of ``omnibench discover`` on recordings by simulators that share no code with it (``foreign``).

    python tests/benchmarks/foreign_study.py --out foreign --seeds 9000 9001 [--only belt_ripple] [--table]

Every recording is a job in the store --out, under the code that discovers: run again, it goes on where it was. What
these simulators hide is in no catalogue: a confident name is a wrong one.
"""

from __future__ import annotations

import argparse
import importlib
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from discover_study import discovering_code
from scipy.stats import binomtest

from omnibench import discover_effects, load_dataset
from omnibench.config import Model
from omnibench.discover.result import Discovery
from omnibench.jobs.job import Failure, Job, JobWatch, run_jobs
from omnibench.jobs.local_backends import local_backend
from omnibench.jobs.result_store import ResultStore, content_key
from omnibench.processes import one_thread
from omnibench.progress import Reporter

KINDS = ("cross_wheel_coupling", "slippery_patch", "belt_ripple", "swinging_payload", "tether_pull")
CONFIDENT = 0.95  # a name's weight from which on the verdict may be "named"


class Result(Model):
    """What came of a recording. where: the covariates named, the most probable first.

    closed_chi2, closed_eq6: share of the gap to the validation session that is closed; None: no gap beyond two standard
    errors, or a failure of the workflow, whose reason is then in ``failure``.
    """

    kind: str
    seed: int
    noncentrality: float
    covariates: tuple[str, ...]
    verdict: str = ""
    names: tuple[tuple[str, float], ...] = ()
    where: tuple[str, ...] = ()
    closed_chi2: float | None = None
    closed_eq6: float | None = None
    seconds: float = 0.0
    failure: str = ""

    @property
    def flagged(self) -> bool:
        """Something is said to be there that no name explains."""
        return self.verdict in ("unknown", "incomplete")

    @property
    def located(self) -> bool:
        """A right covariate is among the two most probable."""
        return bool(set(self.where[:2]) & set(self.covariates))

    @property
    def misnamed(self) -> bool:
        return any(weight >= CONFIDENT for _, weight in self.names)


def main() -> None:
    """Make and judge the recordings that are missing, then print the table."""
    arguments = _arguments()
    store = ResultStore(arguments.out, Result)
    jobs = [_job(kind, seed) for seed in arguments.seeds for kind in arguments.only or KINDS]
    if not arguments.table:
        run_jobs(jobs, store, local_backend(arguments.jobs), _Said())
    print("\n".join(table([result for job in jobs if (result := store.get(job.key)) is not None])))


class _Said(JobWatch[Result]):
    """A line for every recording that ends."""

    def ended(self, number: int, ending: Result | Failure, reused: bool) -> None:  # noqa: ARG002
        if not reused:
            print(ending.reason if isinstance(ending, Failure) else ending.model_dump_json(), flush=True)


def _job(kind: str, seed: int) -> Job[Result]:
    return Job(content_key({"kind": kind, "seed": seed, "code": discovering_code()}), _carry_out, (kind, seed))


def _carry_out(recording: tuple[str, int], _: Reporter) -> Result:
    """Make a recording, let the workflow discover, judge. Whatever the workflow raises is a failure."""
    kind, seed = recording
    with one_thread(), tempfile.TemporaryDirectory() as folder:
        truth = importlib.import_module(f"foreign.{kind}").make(Path(folder), seed)
        hidden = {"seed": seed} | {key: truth[key] for key in ("kind", "covariates", "noncentrality")}
        began = time.perf_counter()
        try:
            return judged(hidden, discover_effects(load_dataset(folder), seed=seed), time.perf_counter() - began)
        except Exception as error:  # the study goes on, and the table says so
            return Result(**hidden, failure=f"{type(error).__name__}: {error}")


def judged(hidden: dict[str, object], discovery: Discovery, seconds: float) -> Result:
    """The answer beside what is hidden."""
    probable = sorted(discovery.where, key=lambda each: -each.weight)
    session = next((each for each in discovery.held_out if each.data == "session"), None)
    return Result(
        **hidden,
        verdict=discovery.verdict,
        names=tuple((each.name, each.weight) for each in discovery.effects),
        where=tuple(dict.fromkeys(each.covariate for each in probable)),
        closed_chi2=session.chi2.closed if session else None,
        closed_eq6=session.eq6.closed if session else None,
        seconds=seconds,
    )


def table(results: Sequence[Result]) -> list[str]:
    """One line for each kind, and one for all: rates with the 95 % intervals of Wilson, medians of the gap closed."""
    lines = [f"{'kind':22}{'sets':>5} {'flagged':26}{'flagged, right place':26}{'confident wrong name':26}closed"]
    for kind in (*KINDS, "all"):
        members = [each for each in results if kind in (each.kind, "all")]
        if members:
            tests: tuple[Callable[[Result], bool], ...] = (
                lambda each: each.flagged,
                lambda each: each.flagged and each.located,
                lambda each: each.misnamed,
            )
            rates = "".join(f"{_rate([test(each) for each in members]):26}" for test in tests)
            lines.append(f"{kind:22}{len(members):5} {rates}{_closed(members)}")
    return [*lines, f"failures of the workflow: {sum(bool(each.failure) for each in results)}"]


def _rate(hits: Sequence[bool]) -> str:
    interval = binomtest(sum(hits), len(hits)).proportion_ci(0.95, "wilson")
    return f"{np.mean(hits):.1%} ({interval.low:.1%} to {interval.high:.1%})"


def _closed(members: Sequence[Result]) -> str:
    """Medians of both metrics where there was a gap to close, and how many had one."""
    told = []
    for metric in ("chi2", "eq6"):
        known = [share for each in members if (share := getattr(each, f"closed_{metric}")) is not None]
        told.append(f"{metric} {np.median(known):.0%} of {len(known)}" if known else f"{metric} -")
    return ", ".join(told)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of results, a file a recording")
    parser.add_argument("--seeds", type=int, nargs="+", default=[])
    parser.add_argument("--only", action="append", choices=KINDS, help="one kind; may be given again")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--table", action="store_true", help="print the table of what is there")
    return parser.parse_args()


if __name__ == "__main__":
    main()
