"""A comparison, from the config to the report: each step is a line of ``run_comparison``.

Fits are jobs. One that raises, hangs or dies is a failed fit; Ctrl-C keeps those done.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from omnibench.compare.config import CompareConfig, effective_config, load_calibrators
from omnibench.compare.output import check_output, prepare_output, write_results
from omnibench.compare.plan import UNBOUNDED, ComparedRobot, FitTask, PlannedFit, load_robots, plan_fits
from omnibench.compare.report.comparison_view import ComparisonView
from omnibench.compare.result import ComparisonResult, ScoredFit
from omnibench.compare.score import certify, score_fits
from omnibench.compare.statistics import design_costs, entry_statistics, held_out_verdicts, is_mean, make_cells
from omnibench.environment import environment
from omnibench.errors import ConfigError, DataError, Interrupted, UnknownNameError, require_type
from omnibench.files import results_locked
from omnibench.fit.calibrator import Outcome, RunResult, Timing, describe_error, run_calibrator
from omnibench.fit.identifiability import warnings_of_calibration
from omnibench.fit.problem import make_problem
from omnibench.fit.sessions import compare_sessions
from omnibench.fit.span import Treatment, driven_span
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import Backend, BackendError, Failure, Job, JobWatch, ResultStore, run_jobs
from omnibench.processes import interrupts_not_in_callbacks, one_thread_processes
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import calibrators
from omnibench.report.render import write_document
from omnibench.robot.model import OdometryModel
from omnibench.simulate.config import RobotConfig
from omnibench.slam.slam_options import PRELOAD as SLAM_PRELOAD
from omnibench.words import plural

_GRACE = 10.0  # s after the budget's time: a run that has not stopped by then is killed (chosen)
_REFERENCES = 5  # evaluations that a machine is measured by: the best is one that nothing disturbed (chosen)
# Modules that the processes share, so that they need not be imported for every run. Importers are among them, since a
# plug-in is loaded after all that is built in.
_IMPORTERS = ("omnibench.data.importers.csv", "omnibench.data.importers.rosbag", "omnibench.data.importers.tum")
PRELOAD = ("omnibench.compare.run", "omnibench.fit.sum_of_norms", "nlopt", *_IMPORTERS)


def execute(
    plan: Sequence[PlannedFit], store: ResultStore[RunResult], report: Reporter, backend: Backend
) -> list[RunResult]:
    """Execute the runs, except those whose results are stored: the result of every run, in the plan's order.

    Failed runs are not stored: what made them fail (a missing package, too little memory) may be gone next time.
    KeyboardInterrupt passes through after the running processes are ended; what had ended is in the store.
    """
    asked = [fit for fit in plan if not fit.refusal]
    runs = _Runs(asked, store, report)
    jobs = (
        Job(
            run.key,
            _solve,
            run.task,
            seconds=run.settings.budget.seconds + _GRACE,
            memory_mb=run.config.memory_mb,
            timed=run.config.timing,
            shared=(run.training_runs,),
        )
        for run in asked
    )
    with interrupts_not_in_callbacks():
        run_jobs(jobs, store, backend, runs)
    results = iter([runs.results[number] for number in range(len(asked))])
    return [_without_answer(Outcome.NOT_APPLICABLE, fit.refusal) if fit.refusal else next(results) for fit in plan]


@contextmanager
def resumable(plan: Sequence[PlannedFit], store: ResultStore[RunResult], folder: Path) -> Iterator[None]:
    """Let Ctrl-C and a lost cluster end in a line that says which runs are kept and how to continue."""
    try:
        yield
    except (KeyboardInterrupt, BackendError) as error:
        asked = [fit for fit in plan if not fit.refusal]
        stored = sum(store.get(fit.key) is not None for fit in asked)
        way = f"{stored} of {len(asked)} runs are kept in {folder}: run again with -o {folder}"
        if isinstance(error, BackendError):
            raise type(error)(f"{error}; {way}") from None
        raise Interrupted(f"interrupted; {way}") from None


class _RunFailed(Exception):  # noqa: N818 (not an error: the outcome of a run that leaves no file)
    """Raised by the job of a run with the outcome failed; its argument is the result."""


def _solve(task: FitTask, report: Reporter) -> RunResult:
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

    def __init__(self, plan: Sequence[PlannedFit], store: ResultStore[RunResult], report: Reporter) -> None:
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
        origin = ", kept from an earlier run" if reused else ""
        figures = f"{cost}, {plural(result.evaluations, 'evaluation')}, {result.seconds:.1f} s{origin}"
        words = f"{self._plan[number].title}: {result.outcome}, {figures} ({result.reason})"
        line = f"[{len(self.results)}/{len(self._plan)}] {words}"
        self._report_run(number, result.evaluations, result.cost, line)
        self._report_all()

    def _report_all(self) -> None:
        self._report(Progress("comparing", len(self.results), len(self._plan), "run"))

    def _report_run(self, number: int, done: int = 0, best: float | None = None, result: str | None = None) -> None:
        run = self._plan[number]
        self._report(Progress(run.title, done, run.settings.budget.evaluations, "evaluation", best, result=result))

    def _result(self, number: int, failure: Failure) -> RunResult:
        """The result of a run that left none. DataError: the disk refused it."""
        if isinstance(failure.error, _RunFailed):
            return failure.error.args[0]
        if isinstance(failure.error, DataError):
            raise failure.error
        run, now = self._plan[number], time.monotonic()
        spent = self._evaluations.get(number, 0), now - self._began.get(number, now)
        if not failure.over_time:
            return _without_answer(Outcome.FAILED, failure.reason, *spent)
        reason = f"ended by force: {run.settings.budget.seconds:g} s spent without an answer"
        result = _without_answer(Outcome.TIME, reason, *spent)
        self._store.put(run.key, result)  # it would spend them again
        return result


def run_comparison(
    config: CompareConfig,
    output: Path | None = None,
    progress: Reporter = no_progress,
    *,
    force: bool = False,
    cache: Path | None = None,
) -> ComparisonResult:
    """Fit every calibrator of the config to every training set, score the answers, and write results and report.

    output: the folder of results; fits whose results are there are not repeated. progress: told of the making of data
    sets and of every fit. force: write into a folder with other files, or of a comparison of another name. cache: where
    the results of fits are kept, by the hash of their data and code, in the place of the folder of results.

    ConfigError or DataError: the config, a data set or the folder is unfit, no robot's recordings can be read, or the
    disk refuses. Interrupted: Ctrl-C; the results of all fits that had ended are kept.
    """
    require_type(config, CompareConfig, "read_compare_config")
    check_output(output, config, force=force)
    failures = load_calibrators(config.plugins, [entry.name for entry in config.entries])
    broken_plugins = [f"plug-in {failure.origin} cannot be imported: {failure.error}" for failure in failures]
    with ExitStack() as lock:
        if output is not None:
            lock.enter_context(results_locked(output))
        try:
            config = effective_config(config)
            with ExitStack() as opened:
                workers = config.workers or os.cpu_count() or 1
                choice = BackendChoice(name=config.backend, workers=workers, tls=config.tls)
                backend = opened.enter_context(open_backend(choice, PRELOAD, progress))
                # Processes that are started for simulation, and for SLAM of its scans, serve the calibrators, too
                scans = any(isinstance(source.simulate, RobotConfig) for source in config.datasets.values())
                opened.enter_context(one_thread_processes((*PRELOAD, *(SLAM_PRELOAD if scans else ()))))
                robots, broken = load_robots(config, progress)
                fits = plan_fits(config, robots)
                folder = prepare_output(config, output, force=force)
                if output is None:
                    lock.enter_context(results_locked(folder))
                store = ResultStore(cache or folder / "runs", RunResult)
                with resumable(fits, store, folder), opened.pop_all():  # Ctrl-C while they close is resumable, too
                    results = execute(fits, store, progress, backend)
        except UnknownNameError as error:  # the name may be that of a plug-in that cannot be imported
            raise ConfigError("; ".join([str(error), *broken_plugins])) from None
        with resumable(fits, store, folder):
            result = assess(config, robots, fits, results, folder, broken, broken_plugins, progress)
            write_results(result)
            write_document(ComparisonView(result).page(), folder / "report.html")
        return result


def assess(
    config: CompareConfig,
    robots: Sequence[ComparedRobot],
    fits: Sequence[PlannedFit],
    results: Sequence[RunResult],
    output: Path,
    broken: Mapping[str, str] | None = None,
    warnings: Sequence[str] = (),
    progress: Reporter = no_progress,
) -> ComparisonResult:
    """The comparison of the results of all fits: scores, proofs, statistics of entries and of cells.

    broken: why recordings could not be read, by robot. warnings: those that there are already. PluginError: a cost
    raises.
    """
    told = progress if config.robots else no_progress  # a data set is judged at once
    scored, designs = score_fits(config, fits, results, told)
    runs, certificates = certify(config.certificate, scored)
    of_datasets = [run for run in runs if run.row is not None]
    statistics = entry_statistics(of_datasets, config.bootstrap)
    datasets = {robot.name: robot.dataset for robot in robots if config.datasets}
    # Sessions are compared by the design values: any would do
    sessions = {
        name: compare_sessions(OdometryModel.of_design(dataset.robot, config.integration), dataset.trajectories)
        for name, dataset in datasets.items()
    }
    return ComparisonResult(
        config=config,
        output=output,
        robots=tuple(robots),
        broken=broken or {},
        runs=runs,
        cells=make_cells(runs, designs),
        statistics=statistics,
        design_costs=design_costs(of_datasets, config.bootstrap),
        certificates=certificates,
        held_out=held_out_verdicts(statistics, datasets, config.bootstrap),
        sessions={name: (*compared.sentences, *compared.doubts) for name, compared in sessions.items()},
        environment=environment(),
        warnings=(*warnings, *_warnings(config, robots, runs)),
    )


def _warnings(config: CompareConfig, robots: Sequence[ComparedRobot], runs: Sequence[ScoredFit]) -> Iterator[str]:
    for robot in robots:
        place = robot.name if config.robots else f"data set {robot.name}"
        yield from (f"{place}: {warning}" for warning in robot.dataset.warnings)
    if config.robots:
        return
    fits = [run.fit for run in runs]
    searched = [fit for fit in fits if fit.box_name != UNBOUNDED]
    for robot, parameterisation in dict.fromkeys((fit.robot, fit.settings.parameterisation) for fit in searched):
        span = driven_span(robot.dataset.split("train"))
        treatment: Treatment = "fit" if config.unidentified == "fit" else "keep"
        undetermined = warnings_of_calibration(robot.dataset.robot, span, parameterisation, treatment)
        yield from (f"data set {robot.name}, fit of the {parameterisation}: {warning}" for warning in undetermined)
    if config.loss != "squares":
        for name, fit in {fit.robot.name: fit for fit in reversed(fits)}.items():
            yield from (f"data set {name}: {sentence}" for sentence in fit.problem().moved_ends)
    if not all(is_mean(run) for run in runs):
        yield "the cost is no mean over trajectories: intervals and differences are of the mean of their own costs"
