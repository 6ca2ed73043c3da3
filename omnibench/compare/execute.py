"""The runs of a plan as jobs. One that raises, hangs or dies is a failed run; Ctrl-C keeps those done."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from omnibench.compare.config import load_calibrators
from omnibench.compare.plan import PlannedRun, RunTask
from omnibench.errors import DataError, Interrupted
from omnibench.fit.calibrator import Outcome, RunResult, Timing, describe_error, run_calibrator
from omnibench.fit.problem import make_problem
from omnibench.jobs.job import Backend, BackendError, Failure, Job, JobWatch, ResultStore, run_jobs
from omnibench.processes import interrupts_not_in_callbacks
from omnibench.progress import Progress, Reporter
from omnibench.registry import calibrators
from omnibench.words import plural

_GRACE = 10.0  # s after the budget's time: a run that has not stopped by then is killed (chosen)
_REFERENCES = 5  # evaluations that a machine is measured by: the best is one that nothing disturbed (chosen)
# Modules that the processes share, so that they need not be imported for every run. Importers are among them, since a
# plug-in is loaded after all that is built in.
_IMPORTERS = ("omnibench.data.importers.csv", "omnibench.data.importers.rosbag", "omnibench.data.importers.tum")
PRELOAD = ("omnibench.compare.execute", "omnibench.fit.sum_of_norms", "nlopt", *_IMPORTERS)


def execute(
    plan: Sequence[PlannedRun], store: ResultStore[RunResult], report: Reporter, backend: Backend
) -> list[RunResult]:
    """Execute the runs, except those whose results are stored: the result of every run, in the plan's order.

    Failed runs are not stored: what made them fail (a missing package, too little memory) may be gone next time.
    KeyboardInterrupt passes through after the running processes are ended; what had ended is in the store.
    """
    runs = _Runs(plan, store, report)
    with interrupts_not_in_callbacks():
        run_jobs(map(_job, plan), store, backend, runs)
    return [runs.results[number] for number in range(len(plan))]


@contextmanager
def resumable(
    plan: Sequence[PlannedRun], store: ResultStore[RunResult], folder: Path, noun: str = "runs"
) -> Iterator[None]:
    """Let Ctrl-C and a lost cluster end in a line that says which runs are kept and how to continue."""
    try:
        yield
    except (KeyboardInterrupt, BackendError) as error:
        kept = sum(store.get(run.key) is not None for run in plan)
        way = f"{kept} of {len(plan)} {noun} are kept in {folder}: run again with -o {folder}"
        if isinstance(error, BackendError):
            raise type(error)(f"{error}; {way}") from None
        raise Interrupted(f"interrupted; {way}") from None


def _job(run: PlannedRun) -> Job[RunResult]:
    return Job(
        run.key,
        _solve,
        run.task,
        seconds=run.settings.budget.seconds + _GRACE,
        memory_mb=run.config.memory_mb,
        timed=run.config.timing,
        shared=(run.training,),
    )


class _RunFailed(Exception):  # noqa: N818 (not an error: the outcome of a run that leaves no file)
    """Raised by the job of a run with the outcome failed; its argument is the result."""


def _solve(task: RunTask, report: Reporter) -> RunResult:
    """Solve one run's problem in a worker process."""
    try:
        load_calibrators(task.plugins, [task.settings.calibrator])
        calibrator = calibrators.create(task.settings.calibrator, task.settings.options)
        problem = make_problem(task.settings, task.robot, task.trajectories, report)
        result = run_calibrator(calibrator, problem)
        if task.timing and result.matrix is not None:
            # Wall time in s of one evaluation of the start's cost by direct integration, the best of a few
            spent = []
            for _ in range(_REFERENCES):
                began = time.perf_counter()
                problem.values(problem.start[None])
                spent.append(time.perf_counter() - began)
            result = replace(result, timing=Timing(min(spent), platform.node()))
    except BaseException as error:  # whatever a plug-in raises, wherever, is this run's outcome
        result = _without_answer(Outcome.FAILED, describe_error(error))
    if result.outcome is Outcome.FAILED:
        raise _RunFailed(result)
    return result


def _without_answer(outcome: Outcome, reason: str, evaluations: int = 0, seconds: float = 0.0) -> RunResult:
    return RunResult(outcome, reason, None, None, None, evaluations, seconds, ())


class _Runs(JobWatch[RunResult]):
    """The results of runs so far, by their numbers in the plan.

    In the progress that is reported each run is a task of its own, with a line about its outcome as result.
    """

    def __init__(self, plan: Sequence[PlannedRun], store: ResultStore[RunResult], report: Reporter) -> None:
        self.results: dict[int, RunResult] = {}
        self._plan, self._store, self._report = plan, store, report
        self._began: dict[int, float] = {}
        self._evaluations: dict[int, int] = {}
        self._report_all()

    def began(self, number: int) -> None:
        if number not in self._began:
            self._began[number] = time.monotonic()
            self._report_run(number)

    def moved(self, number: int, event: Progress) -> None:
        self._evaluations[number] = event.done
        self._report_run(number, event.done, event.best)

    def ended(self, number: int, ending: RunResult | Failure, reused: bool) -> None:
        result = self._result(number, ending) if isinstance(ending, Failure) else ending
        self.results[number] = result
        cost = "no answer" if result.cost is None else f"cost {result.cost:.6f}"
        kept = ", kept from an earlier run" if reused else ""
        figures = f"{cost}, {plural(result.evaluations, 'evaluation')}, {result.seconds:.1f} s{kept}"
        words = f"{self._plan[number].title}: {result.outcome}, {figures} ({result.reason})"
        line = f"[{len(self.results)}/{len(self._plan)}] {words}"
        self._report_run(number, result.evaluations, result.cost, line)
        self._report_all()

    def _report_all(self) -> None:
        self._report(Progress("comparing", len(self.results), len(self._plan), "run"))

    def _report_run(
        self, number: int, evaluations: int = 0, best: float | None = None, result: str | None = None
    ) -> None:
        run = self._plan[number]
        budget = run.settings.budget.evaluations
        self._report(Progress(run.title, evaluations, budget, "evaluation", best, result=result))

    def _result(self, number: int, failure: Failure) -> RunResult:
        """The result of a run that left none. DataError: the disk refused it."""
        if isinstance(failure.error, _RunFailed):
            result: RunResult = failure.error.args[0]
            return result
        if isinstance(failure.error, DataError):
            raise failure.error
        now = time.monotonic()
        spent = self._evaluations.get(number, 0), now - self._began.get(number, now)
        if not failure.over_time:
            return _without_answer(Outcome.FAILED, failure.reason, *spent)
        run = self._plan[number]
        reason = f"ended by force: {run.settings.budget.seconds:g} s spent without an answer"
        result = _without_answer(Outcome.TIME, reason, *spent)
        self._store.put(run.key, result)  # it would spend them again
        return result
