"""A comparison, from the config to the report: each step is a line of ``run_comparison``.

Certificates are proven lower bounds: how far below its runs any optimiser could get, box by box.

From a run's matrix to its row: costs, errors and improvements on each split.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from omnibench.compare.config import CertificateChoice, CompareConfig, effective_config, load_calibrators
from omnibench.compare.execute import PRELOAD, execute, resumable
from omnibench.compare.output import check_output, prepare_output, write_results
from omnibench.compare.plan import UNBOUNDED, PlannedRun, load_datasets, make_plan
from omnibench.compare.report.comparison_report import comparison_document
from omnibench.compare.result import (
    BoxCertificate,
    ComparisonResult,
    EntryStatistics,
    RunRecord,
    ScoredRun,
    SplitScore,
    TypicalAnswer,
)
from omnibench.compare.statistics import (
    design_costs,
    entry_statistics,
    held_out_verdicts,
    is_mean,
    sessions_that_differ,
)
from omnibench.data.dataset import SPLITS, Dataset, Split, Trajectory
from omnibench.environment import environment
from omnibench.errors import ConfigError, DataError, PluginError, UnknownNameError, require_type
from omnibench.files import results_locked
from omnibench.fit.calibrator import Outcome, RunResult, describe_error
from omnibench.fit.certify import prove, proven_gap
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.evaluate import final_errors, positions_and_headings
from omnibench.fit.geometry import WheelGeometry, searched_parameters
from omnibench.fit.identifiability import warnings_of_calibration
from omnibench.fit.intervals import UnitName, units_of
from omnibench.fit.parameterisation import make_bounds
from omnibench.fit.prior import mount_is_fitted
from omnibench.fit.reference_rows import with_mean_errors
from omnibench.fit.span import Treatment, driven_span
from omnibench.fit.uncertainty import NoCovarianceError, physical_parameters, uncertainty_of
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import ResultStore
from omnibench.processes import one_thread_processes
from omnibench.progress import Reporter, no_progress
from omnibench.registry import PluginFailure, calibrators, costs
from omnibench.report.render import write_document
from omnibench.robot.calibration import extended_model, matrix_rows
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryBatch
from omnibench.robot.physical import PhysicalParameter
from omnibench.robot.stored_odometry import odometry_of
from omnibench.simulate.config import RobotConfig
from omnibench.slam.slam_options import PRELOAD as SLAM_PRELOAD


class SplitScorer:
    """Scores matrices, and models with effects, on one split with one cost."""

    def __init__(
        self, trajectories: Sequence[Trajectory], cost: Cost, integration: Integration, unit: UnitName | None = None
    ) -> None:
        self._cost = cost
        self._units = units_of(trajectories, unit)
        self._odometry = cost.batch(trajectories, integration)
        self._reference = cost.reference(trajectories)
        self._trajectories, self._integration = tuple(trajectories), integration
        self._ends = odometry_of([trajectory.final_log for trajectory in trajectories], integration)
        self._final = np.array([trajectory.final_pose for trajectory in trajectories])

    def cost(self, matrix: Array) -> float:
        """The cost of a matrix (3, N) on the split. PluginError when the cost raises or is not a finite number."""
        errors = self._errors(matrix)[None]
        return float(self._checked(1, lambda: self._cost.combine(errors, self._odometry.trajectory))[0])

    def costs(self, matrix: Array) -> Array:
        """The cost (Z,) of every trajectory. PluginError when the cost raises or is not a finite number."""
        errors = self._errors(matrix)
        return self._checked(len(self._final), lambda: self._cost.of_each(errors, self._odometry.trajectory))

    def final_errors(self, matrix: Array) -> Array:
        """Odometry minus reference (Z, 3) at the last reference pose of every trajectory, m, m, rad.

        Of one without poses: the mean error of its lengths and places, 0, and that of its angles.
        """
        errors = self._ends.poses(matrix[None])[0] - self._final
        return with_mean_errors(errors, matrix, self._trajectories, self._integration)

    def score(self, matrix: Array) -> SplitScore:
        """All of these of a matrix (3, N). PluginError when the cost raises or is not a finite number."""
        return SplitScore(
            self.cost(matrix), self.costs(matrix), self.final_errors(matrix), self._units, self._cost.rounding
        )

    def score_of_model(self, model: OdometryModel) -> SplitScore:
        """All of these of a model with effects. PluginError as ``score``. DataError: it lacks what an effect needs."""
        errors, owner = self._cost.errors_of(model, self._trajectories)
        cost = float(self._checked(1, lambda: self._cost.combine(errors[None], owner))[0])
        costs = self._checked(len(self._final), lambda: self._cost.of_each(errors, owner))
        return SplitScore(cost, costs, final_errors(model, self._trajectories), self._units, self._cost.rounding)

    def _errors(self, matrix: Array) -> Array:
        return self._odometry.poses(matrix[None])[0] - self._reference

    def _checked(self, count: int, costs: Callable[[], Array]) -> Array:
        """Costs (count,), by a cost that may be a plug-in's."""
        try:
            values = np.asarray(costs(), dtype=float)
        except Exception as error:
            raise PluginError(f"cost {self._cost.name!r} raised {describe_error(error)}") from error
        if values.shape != (count,) or not np.isfinite(values).all():
            given = f"an array of shape {values.shape}" if values.shape != (count,) else "NaN or infinity"
            raise PluginError(f"cost {self._cost.name!r} gave {given} for finite errors, expected {count} finite costs")
        return values


def score(
    config: CompareConfig,
    plan: Sequence[PlannedRun],
    results: Sequence[RunResult],
    datasets: Mapping[str, Dataset],
) -> tuple[ScoredRun, ...]:
    """Every run with its costs and errors, and its gap above closed_form where that converged in the same box."""
    scorers: dict[str, dict[Split, SplitScorer]] = {}
    design: dict[str, dict[Split, SplitScore]] = {}
    for run in plan:
        if run.dataset_name not in scorers:
            dataset = datasets[run.dataset_name]
            # A scorer for each split that has trajectories
            scorers[run.dataset_name] = {
                split: SplitScorer(
                    dataset.split(split),
                    costs.create(config.cost.name, config.cost.options),
                    config.integration,
                    config.bootstrap.unit,
                )
                for split in SPLITS
                if dataset.split(split)
            }
            design[run.dataset_name] = _scores(scorers[run.dataset_name], dataset.robot.inverse_kinematic_matrix)
    scored = []
    for run, result in zip(plan, results, strict=True):
        try:
            scores = _scores_of(run, result, scorers[run.dataset_name])
        except DataError as error:  # a run lacks what an effect of the answer needs
            result = replace(result, outcome=Outcome.FAILED, reason=str(error), vector=None, matrix=None, cost=None)
            scores = {}
        # The run as a row of summary.json, with its scores
        design_scores = design[run.dataset_name]
        settings = run.settings
        record = RunRecord(
            dataset=run.dataset_name,
            label=run.label,
            calibrator=settings.calibrator,
            parameterisation=settings.parameterisation,
            box=run.box_name,
            seed=settings.seed,
            options=settings.options,
            outcome=result.outcome,
            reason=result.reason,
            **_columns("train", scores, design_scores),
            **_columns("validation", scores, design_scores),
            evaluations=result.evaluations,
            seconds=result.seconds,
            reference_seconds=None if result.timing is None else result.timing.reference_seconds,
            machine=None if result.timing is None else result.timing.machine,
            matrix=None if result.matrix is None else matrix_rows(result.matrix),
            parameters=_parameters(run, result),
            at_bounds=result.at_bounds,
            held=result.held,
            gap=None,
            gap_box=None,
            proven_gap=None,
        )
        scored.append(
            ScoredRun(record, run.search_space, result.history, scores, design_scores, result.extension, result.noise)
        )
    exact = [(run, done) for run, done in zip(plan, scored, strict=True) if _is_exact(run, done)]
    return tuple(_with_gap(run, done, exact) for run, done in zip(plan, scored, strict=True))


def _scores(scorers: Mapping[Split, SplitScorer], matrix: Array) -> dict[Split, SplitScore]:
    """A matrix's score on each split."""
    return {split: scorer.score(matrix) for split, scorer in scorers.items()}


def _scores_of(run: PlannedRun, result: RunResult, scorers: Mapping[Split, SplitScorer]) -> dict[Split, SplitScore]:
    """The score on each split of a run's answer, with its effects if it has some; none without an answer."""
    if result.matrix is None:
        return {}
    if result.extension is None:
        return _scores(scorers, result.matrix)
    dataset = run.dataset
    model = extended_model(
        dataset.robot, result.matrix, run.settings.integration, dataset.sample_period, result.extension, run.label
    )
    return {split: scorer.score_of_model(model) for split, scorer in scorers.items()}


def position_error(errors: Array) -> float:
    """Mean distance of final errors (Z, 3), m."""
    return float(positions_and_headings(errors)[0].mean())


def heading_error(errors: Array) -> float:
    """Mean absolute heading of final errors (Z, 3), rad."""
    return float(positions_and_headings(errors)[1].mean())


def _columns(split: Split, scores: Mapping[Split, SplitScore], design: Mapping[Split, SplitScore]) -> dict[str, Any]:
    """The columns of a run's row that a split has; None where it has no trajectories, or the run no answer."""
    score, theoretical = scores.get(split), design.get(split)
    return {
        f"{split}_cost": None if score is None else score.cost,
        f"theoretical_{split}_cost": None if theoretical is None else theoretical.cost,
        f"{split}_improvement": _improvement(score, theoretical),
        f"{split}_position_m": None if score is None else position_error(score.errors),
        f"{split}_heading_rad": None if score is None else heading_error(score.errors),
    }


def _improvement(score: SplitScore | None, theoretical: SplitScore | None) -> float | None:
    if score is None or theoretical is None or theoretical.cost <= theoretical.rounding:
        return None
    return 1 - score.cost / theoretical.cost


def _parameters(run: PlannedRun, result: RunResult) -> tuple[PhysicalParameter, ...] | None:
    if run.settings.parameterisation != "geometry" or result.vector is None:
        return None
    geometry = WheelGeometry(run.dataset.robot, fitted_mount=run.settings.mount == "fit")
    return searched_parameters(geometry, result.vector)


def _is_exact(run: PlannedRun, scored: ScoredRun) -> bool:
    """True if a run converged to what should be the optimum in its box of matrix elements, with a cost to divide by."""
    plain = run.settings.loss == "squares"  # under a robust loss no run minimises the cost by which it is scored
    exact = calibrators.entry(scored.record.calibrator).cls.exact and run.element_box is not None and plain
    score = scored.scores.get("train")
    return exact and scored.record.outcome is Outcome.CONVERGED and score is not None and score.cost > score.rounding


def _with_gap(run: PlannedRun, scored: ScoredRun, exact: Sequence[tuple[PlannedRun, ScoredRun]]) -> ScoredRun:
    """The run with its gap above the first answer of closed_form that it can be compared with.

    One with effects has none: no matrix of a box has them.
    """
    cost, matrix = scored.record.train_cost, scored.matrix
    if cost is None or matrix is None or scored.extension is not None:
        return scored
    for other, optimum in exact:
        if is_comparable(run, matrix, other):
            gap = cost / optimum.scores["train"].cost - 1
            return replace(scored, record=scored.record.model_copy(update={"gap": gap, "gap_box": other.box_name}))
    return scored


def is_comparable(run: PlannedRun, matrix: Array, other: PlannedRun) -> bool:
    """True if a run's matrix (3, N) can be compared with the lowest cost in the box of ``other``, which has one.

    The data must be the same, and so must the box; for a geometry, or an answer without a box, the other's box must
    contain the matrix.
    """
    if run.dataset_name != other.dataset_name:
        return False
    if run.element_box is not None:
        return run.element_box == other.element_box
    bounds = make_bounds(other.dataset.robot, other.settings.box)
    return bool(((matrix.ravel() >= bounds.lower) & (matrix.ravel() <= bounds.upper)).all())


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


def typical_answers(
    plan: Sequence[PlannedRun],
    results: Sequence[RunResult],
    scored: Sequence[ScoredRun],
    statistics: Sequence[EntryStatistics],
) -> dict[tuple[str, str], TypicalAnswer]:
    """How sure the answer of every entry's typical run is, and what it means, by data set and label."""
    typical = [entry.typical for entry in statistics]
    answers = {}
    for run, result, done in zip(plan, results, scored, strict=True):
        if result.vector is None or not any(done is one for one in typical):
            continue
        problem, uncertainty, cls = run.problem(), None, calibrators.entry(run.settings.calibrator).cls
        if cls.fitted:
            with suppress(NoCovarianceError):  # its answer is no minimum
                uncertainty = uncertainty_of(problem, result)
        effects = result.extension.effects if result.extension else ()
        asked = None if cls.as_is else run.settings.mount  # of which an answer that stands as it is knows nothing
        by_prior = cls.weighs_design and run.settings.tolerance is None
        fitted_mount = mount_is_fitted(run.dataset.robot, asked, by_prior=by_prior)
        reading = physical_parameters(problem, result, uncertainty, effects, fitted_mount=fitted_mount)
        answers[run.dataset_name, run.label] = TypicalAnswer(uncertainty, reading.parameters)
    return answers


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
            typical = typical_answers(plan, results, runs, statistics)
            result = ComparisonResult(
                config=config,
                output=folder,
                datasets=datasets,
                runs=runs,
                statistics=statistics,
                design_costs=design_costs(runs, config.bootstrap),
                certificates=certificates,
                typical=typical,
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
        treatment: Treatment = "fit" if config.unidentified == "fit" else "keep"
        undetermined = warnings_of_calibration(dataset.robot, span, parameterisation, treatment)
        yield from (f"data set {name}, fit of the {parameterisation}: {warning}" for warning in undetermined)
    if config.loss != "squares":
        first = {run.dataset_name: run for run in reversed(plan)}
        for name, run in first.items():
            yield from (f"data set {name}: {sentence}" for sentence in run.problem().moved_ends)
    if not all(is_mean(run) for run in runs):
        yield "the cost is no mean over trajectories: intervals and differences are of the mean of their own costs"


def _described(failure: PluginFailure) -> str:
    return f"plug-in {failure.origin} cannot be imported: {failure.error}"
