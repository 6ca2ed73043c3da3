"""Study of ``omnibench discover`` on recordings by simulators that share no code with it (``foreign``).

    python tests/studies/foreign_study.py --out foreign --seeds 9000 9001 [--only belt_ripple] [--table]

Every recording is a job in the store --out, under the code that discovers: run again, it goes on where it was. What
these simulators hide follows no formula of the catalogue; where its cause has a name there, that name is right, and any
other confident name is a wrong one.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from discover_study import discovering_code
from foreign_judging import Result, carry_out
from scipy.stats import binomtest

from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import Failure, Job, JobWatch, ResultStore, content_key, run_jobs

KINDS = (
    "cross_wheel_coupling",
    "slippery_patch",
    "belt_ripple",
    "swinging_payload",
    "tether_pull",
    "turn_slip",
    "understeer",
    "skid_icr",
)


def main() -> None:
    """Make and judge the recordings that are missing, then print the table."""
    arguments = _arguments()
    store = ResultStore(arguments.out, Result)
    jobs = [_job(kind, seed) for seed in arguments.seeds for kind in arguments.only or KINDS]
    if not arguments.table:
        choice = BackendChoice(name=arguments.backend, workers=arguments.jobs)
        with open_backend(choice, ("foreign_judging",)) as backend:
            run_jobs(jobs, store, backend, _Said())
    print("\n".join(table([result for job in jobs if (result := store.get(job.key)) is not None])))


class _Said(JobWatch[Result]):
    """A line for every recording that ends."""

    def ended(self, number: int, ending: Result | Failure, reused: bool) -> None:  # noqa: ARG002
        if not reused:
            print(ending.reason if isinstance(ending, Failure) else ending.model_dump_json(), flush=True)


def _job(kind: str, seed: int) -> Job[Result]:
    return Job(content_key({"kind": kind, "seed": seed, "code": discovering_code()}), carry_out, (kind, seed))


def table(results: Sequence[Result]) -> list[str]:
    """One line for each kind, and one for all: rates with the 95 % intervals of Wilson, medians of the gap closed."""
    lines = [
        f"{'kind':22}{'sets':>5} {'flagged':26}{'flagged, right place':26}{'right name or class':26}"
        f"{'confident wrong name':26}closed"
    ]
    for kind in (*KINDS, "all"):
        members = [each for each in results if kind in (each.kind, "all")]
        if members:
            tests: tuple[Callable[[Result], bool], ...] = (
                lambda each: each.flagged,
                lambda each: each.flagged and each.located,
                lambda each: each.named_right,
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
    parser.add_argument("--backend", default="processes", help="processes, dask, or a scheduler's tcp://HOST:PORT")
    parser.add_argument("--table", action="store_true", help="print the table of what is there")
    return parser.parse_args()


if __name__ == "__main__":
    main()
