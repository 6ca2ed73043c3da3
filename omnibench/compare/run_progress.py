"""Progress of the runs of a comparison: an event when one begins, moves and ends, and how many have ended."""

from __future__ import annotations

from omnibench.compare.plan import PlannedRun
from omnibench.fit.calibrator import RunResult
from omnibench.progress import Progress, Reporter
from omnibench.words import plural

_ALL = "comparing"


class RunProgress:
    """Reports the progress of ``runs`` runs. Each is a task of its own, with a line about its outcome as result."""

    def __init__(self, report: Reporter, runs: int) -> None:
        self._report = report
        self._runs = runs
        self._ended = 0
        report(Progress(_ALL, 0, runs, "run"))

    def began(self, run: PlannedRun) -> None:
        """Report that a run begins."""
        self._report(_event(run))

    def moved(self, run: PlannedRun, event: Progress) -> None:
        """Report a run's evaluations so far and its best cost, as it tells them itself."""
        self._report(_event(run, event.done, event.best))

    def ended(self, run: PlannedRun, result: RunResult, reused: bool) -> None:
        """Report the result of a run. reused: it was stored by an earlier comparison."""
        self._ended += 1
        cost = "no answer" if result.cost is None else f"cost {result.cost:.6f}"
        kept = ", kept from an earlier run" if reused else ""
        figures = f"{cost}, {plural(result.evaluations, 'evaluation')}, {result.seconds:.1f} s{kept}"
        line = f"[{self._ended}/{self._runs}] {_title(run)}: {result.outcome}, {figures} ({result.reason})"
        self._report(_event(run, result.evaluations, result.cost, line))
        self._report(Progress(_ALL, self._ended, self._runs, "run"))


def _event(run: PlannedRun, evaluations: int = 0, best: float | None = None, result: str | None = None) -> Progress:
    return Progress(_title(run), evaluations, run.config.budget.evaluations, "evaluation", best, result=result)


def _title(run: PlannedRun) -> str:
    """Data set, entry and seed of a run."""
    return f"{run.dataset_name} {run.label} seed {run.seed}"
