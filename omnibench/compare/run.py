"""A comparison, from the config to the report: each step is a line of ``run_comparison``.

Certificates are proven lower bounds: how far below its runs any optimiser could get, box by box.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from omnibench.compare.config import CertificateChoice, CompareConfig, effective_config, load_calibrators
from omnibench.compare.execute import PRELOAD, execute, resumable
from omnibench.compare.output import check_output, prepare_output, write_results
from omnibench.compare.plan import UNBOUNDED, PlannedRun, load_datasets, make_plan
from omnibench.compare.report.comparison_report import comparison_document
from omnibench.compare.result import BoxCertificate, ComparisonResult, EntryStatistics, ScoredRun
from omnibench.compare.scoring import is_comparable, score
from omnibench.compare.statistics import (
    design_costs,
    entry_statistics,
    held_out_verdicts,
    is_mean,
    sessions_that_differ,
)
from omnibench.data.dataset import Dataset
from omnibench.environment import environment
from omnibench.errors import ConfigError, UnknownNameError, require_type
from omnibench.files import results_locked
from omnibench.fit.calibrator import RunResult
from omnibench.fit.certify import prove, proven_gap
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.identifiability import warnings_of_calibration
from omnibench.fit.span import driven_span
from omnibench.fit.uncertainty import NoCovarianceError, Uncertainty, uncertainty_of
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import ResultStore
from omnibench.processes import one_thread_processes
from omnibench.progress import Reporter, no_progress
from omnibench.registry import PluginFailure
from omnibench.report.render import write_document
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch
from omnibench.simulate.robot_config import RobotConfig
from omnibench.slam.slam_options import PRELOAD as SLAM_PRELOAD


def certify(
    choice: CertificateChoice | None, plan: Sequence[PlannedRun], scored: Sequence[ScoredRun]
) -> tuple[tuple[ScoredRun, ...], tuple[BoxCertificate, ...]]:
    """The runs with their proven gaps, and one proof for each box of matrix elements in which a run gave an answer.

    A geometry, or an answer without a box, is compared with a box that contains its matrix. Nothing is proven where the
    config asks for no certificate, the cost is no sum of norms, or references are no poses: no bound is known then.
    """
    proofs: list[tuple[PlannedRun, BoxCertificate]] = []
    for run, done in zip(plan, scored, strict=True):
        in_a_box = run.element_box is not None and done.matrix is not None
        boxes = [(owner.dataset_name, owner.element_box) for owner, _ in proofs]
        if choice and in_a_box and (run.dataset_name, run.element_box) not in boxes:
            answers = [
                other.matrix.ravel()
                for planned, other in zip(plan, scored, strict=True)
                if other.matrix is not None and planned.dataset_name == run.dataset_name
            ]
            proofs += [(run, proof) for proof in _proof(choice, run, answers)]
    return (
        tuple(_with_proven_gap(run, done, proofs) for run, done in zip(plan, scored, strict=True)),
        tuple(proof for _, proof in proofs),
    )


def _proof(choice: CertificateChoice, run: PlannedRun, answers: Sequence[Array]) -> list[BoxCertificate]:
    """The lower bound over a run's box, if its cost has one. Good answers (3N,) that are known make it faster."""
    problem = run.problem()
    posed = isinstance(problem.odometry, OdometryBatch)
    if not posed or not isinstance(problem.objective, SumOfNorms):
        return []
    known = np.stack([problem.start, *answers])
    inside = known[problem.inside(known)]
    best = inside[int(np.nanargmin(problem.values(inside)))]
    proof = prove(problem, best, gap=choice.gap, seconds=choice.seconds, parts=choice.parts)
    return [
        BoxCertificate(
            dataset=run.dataset_name,
            box=run.box_name,
            lower_bound=proof.lower_bound,
            best_cost=proof.best_cost,
            gap=proven_gap(proof.best_cost, proof.lower_bound),
            parts=proof.boxes,
            seconds=proof.seconds,
            finished=proof.finished,
        )
    ]


def _with_proven_gap(
    run: PlannedRun, done: ScoredRun, proofs: Sequence[tuple[PlannedRun, BoxCertificate]]
) -> ScoredRun:
    cost, matrix = done.record.train_cost, done.matrix
    if cost is None or matrix is None or done.extension is not None:  # no matrix of a box has effects
        return done
    for owner, proof in proofs:
        if is_comparable(run, matrix, owner):
            gap = proven_gap(cost, proof.lower_bound)
            return replace(done, record=done.record.model_copy(update={"proven_gap": gap}))
    return done


def typical_uncertainties(
    plan: Sequence[PlannedRun],
    results: Sequence[RunResult],
    scored: Sequence[ScoredRun],
    statistics: Sequence[EntryStatistics],
) -> dict[tuple[str, str], Uncertainty]:
    """The uncertainty of every entry's typical run, by data set and label; none where its answer is no minimum."""
    typical = [entry.typical for entry in statistics]
    uncertainties = {}
    for run, result, done in zip(plan, results, scored, strict=True):
        if run.box_name == UNBOUNDED or not any(done is one for one in typical):
            continue
        try:
            uncertainties[run.dataset_name, run.label] = uncertainty_of(run.problem(), result)
        except NoCovarianceError:
            continue
    return uncertainties


def run_comparison(
    config: CompareConfig, output: Path | None = None, progress: Reporter = no_progress, *, force: bool = False
) -> ComparisonResult:
    """Run every calibrator of the config on every data set, score the answers, and write results and report.

    output: the folder of results; runs whose results are there are not repeated. progress: told of the making of data
    sets and of every run. force: write into a folder with other files, or of a comparison of another name.

    ConfigError or DataError: the config, a data set or the folder is unfit, or the disk refuses. Interrupted: Ctrl-C;
    the results of all runs that had ended are kept.
    """
    require_type(config, CompareConfig, "read_compare_config")
    check_output(output, config, force=force)
    failures = load_calibrators(config.plugins, [entry.name for entry in config.calibrators])
    with ExitStack() as lock:
        if output is not None:
            lock.enter_context(results_locked(output))
        with _naming_failed_plugins(failures):
            config = effective_config(config)
            with ExitStack() as opened:
                workers = config.workers or os.cpu_count() or 1
                choice = BackendChoice(name=config.backend, workers=workers, tls=config.tls)
                backend = opened.enter_context(open_backend(choice, PRELOAD, progress))
                # Processes that are started for simulation serve the calibrators, too.
                # Modules for the processes of calibrators, and for those of SLAM where a robot's scans are simulated
                scans = any(isinstance(source.simulate, RobotConfig) for source in config.datasets.values())
                opened.enter_context(one_thread_processes((*PRELOAD, *(SLAM_PRELOAD if scans else ()))))
                datasets = load_datasets(config, progress)
                plan = make_plan(config, datasets)
                folder = prepare_output(config, output, force=force)
                if output is None:
                    lock.enter_context(results_locked(folder))
                store = ResultStore(folder / "runs", RunResult)
                with resumable(plan, store, folder), opened.pop_all():  # Ctrl-C while they close is resumable, too
                    results = execute(plan, store, progress, backend)
        with resumable(plan, store, folder):
            scored = score(config, plan, results, datasets)
            runs, certificates = certify(config.certificate, plan, scored)
            statistics = entry_statistics(runs, config.bootstrap)
            uncertainties = typical_uncertainties(plan, results, runs, statistics)
            result = ComparisonResult(
                config=config,
                output=folder,
                datasets=datasets,
                runs=runs,
                statistics=statistics,
                design_costs=design_costs(runs, config.bootstrap),
                certificates=certificates,
                uncertainties=uncertainties,
                held_out=held_out_verdicts(statistics, datasets, config.bootstrap),
                sessions=sessions_that_differ(datasets, config.integration),
                environment=environment(),
                warnings=tuple(_warnings(config, failures, datasets, plan, runs)),
            )
            write_results(result)
            write_document(comparison_document(result), folder / "report.html")
        return result


@contextmanager
def _naming_failed_plugins(failures: Sequence[PluginFailure]) -> Iterator[None]:
    """Add the plug-ins that failed to import to an error of an unknown name, which may be one of theirs."""
    try:
        yield
    except UnknownNameError as error:
        raise ConfigError("; ".join([str(error), *map(_described, failures)])) from None


def _warnings(
    config: CompareConfig,
    failures: Iterable[PluginFailure],
    datasets: Mapping[str, Dataset],
    plan: Sequence[PlannedRun],
    runs: Iterable[ScoredRun],
) -> Iterator[str]:
    yield from map(_described, failures)
    for name, dataset in datasets.items():
        yield from (f"data set {name}: {warning}" for warning in dataset.warnings)
    fitted = [run for run in plan if run.box_name != UNBOUNDED]
    for name, parameterisation in dict.fromkeys(
        (run.dataset_name, run.search_space.parameterisation) for run in fitted
    ):
        dataset = datasets[name]
        span = driven_span(dataset.split("train"))
        undetermined = warnings_of_calibration(dataset.robot, span, parameterisation, config.unidentified)
        yield from (f"data set {name}, fit of the {parameterisation}: {warning}" for warning in undetermined)
    if config.loss != "squares":
        first = {run.dataset_name: run for run in reversed(plan)}
        for name, run in first.items():
            yield from (f"data set {name}: {sentence}" for sentence in run.problem().moved_ends)
    if not all(is_mean(run) for run in runs):
        yield "the cost is no mean over trajectories: intervals and differences are of the mean of their own costs"


def _described(failure: PluginFailure) -> str:
    return f"plug-in {failure.origin} cannot be imported: {failure.error}"
