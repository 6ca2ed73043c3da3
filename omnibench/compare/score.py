"""Scores of fits: errors of every answer on all runs of its robot; of data sets also costs, gaps and proven bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from omnibench.compare.config import CertificateChoice, CompareConfig
from omnibench.compare.plan import ComparedRobot, PlannedFit
from omnibench.compare.result import BoxCertificate, EntryStatistics, RunRecord, ScoredFit, SplitScore, TypicalAnswer
from omnibench.data.dataset import SPLITS, Split, Trajectory
from omnibench.errors import OmnibenchError, PluginError
from omnibench.fit.calibrator import Outcome, RunResult, describe_error
from omnibench.fit.certify import prove, proven_gap
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.evaluate import final_errors, positions_and_headings
from omnibench.fit.geometry import WheelGeometry, searched_parameters
from omnibench.fit.intervals import UnitName, units_of
from omnibench.fit.parameterisation import make_bounds
from omnibench.fit.prior import mount_is_fitted
from omnibench.fit.reference_rows import with_mean_errors
from omnibench.fit.uncertainty import NoCovarianceError, physical_parameters, uncertainty_of
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import calibrators, costs
from omnibench.robot.calibration import extended_model, matrix_rows
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryBatch
from omnibench.robot.stored_odometry import odometry_of

_TOGETHER = 64  # matrices that are judged at once (chosen: 164 runs of 1,200 samples take 0.1 GB)


class FinalErrors:
    """Odometry minus reference (Z, 3) at the last reference pose of each of Z runs, m, m, rad.

    Of a run without poses: the mean error of its lengths and places, 0, and that of its angles.
    """

    def __init__(self, runs: Sequence[Trajectory], integration: Integration) -> None:
        self._runs, self._integration = tuple(runs), integration
        self._odometry = odometry_of([run.final_log for run in runs], integration)
        self._ends = np.array([run.final_pose for run in runs])

    def of_matrices(self, matrices: Sequence[Array]) -> list[Array]:
        """The errors (Z, 3) of each matrix (3, M)."""
        errors: list[Array] = []
        for first in range(0, len(matrices), _TOGETHER):
            together = matrices[first : first + _TOGETHER]
            poses = self._odometry.poses(np.array(together))
            errors += [
                with_mean_errors(of_one - self._ends, matrix, self._runs, self._integration)
                for of_one, matrix in zip(poses, together, strict=True)
            ]
        return errors


class SplitScorer:
    """Scores matrices, and models with effects, on one split with one cost."""

    def __init__(
        self, trajectories: Sequence[Trajectory], cost: Cost, integration: Integration, unit: UnitName | None = None
    ) -> None:
        self._cost = cost
        self._units = units_of(trajectories, unit)
        self._odometry = cost.batch(trajectories, integration)
        self._reference = cost.reference(trajectories)
        self._trajectories, self._ends = tuple(trajectories), FinalErrors(trajectories, integration)

    def cost(self, matrix: Array) -> float:
        """The cost of a matrix (3, N) on the split. PluginError when the cost raises or is not a finite number."""
        errors = self._errors(matrix)[None]
        return float(self._checked(1, lambda: self._cost.combine(errors, self._odometry.trajectory))[0])

    def costs(self, matrix: Array) -> Array:
        """The cost (Z,) of every trajectory. PluginError when the cost raises or is not a finite number."""
        errors = self._errors(matrix)
        return self._checked(len(self._trajectories), lambda: self._cost.of_each(errors, self._odometry.trajectory))

    def score(self, matrix: Array) -> SplitScore:
        """All of these of a matrix (3, N). PluginError when the cost raises or is not a finite number."""
        (errors,) = self._ends.of_matrices([matrix])
        return SplitScore(self.cost(matrix), self.costs(matrix), errors, self._units, self._cost.rounding)

    def score_of_model(self, model: OdometryModel) -> SplitScore:
        """All of these of a model with effects. PluginError as ``score``. DataError: it lacks what an effect needs."""
        errors, owner = self._cost.errors_of(model, self._trajectories)
        cost = float(self._checked(1, lambda: self._cost.combine(errors[None], owner))[0])
        costs = self._checked(len(self._trajectories), lambda: self._cost.of_each(errors, owner))
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


def score_fits(
    config: CompareConfig,
    fits: Sequence[PlannedFit],
    results: Sequence[RunResult],
    progress: Reporter = no_progress,
) -> tuple[tuple[ScoredFit, ...], dict[str, Array]]:
    """Every fit with its errors, and by robot the errors (Z, 3) of the design values on all its runs.

    Of data sets: with its costs, and its gap above closed_form where that converged in the same box. An answer whose
    effects do not act on some run is a failed one.
    """
    scored: dict[int, ScoredFit] = {}
    designs: dict[str, Array] = {}
    for robot in {fit.robot.name: fit.robot for fit in fits}.values():
        progress(Progress("judging", len(scored), len(fits), "answer"))
        dataset, judge = robot.dataset, FinalErrors(robot.dataset.trajectories, config.integration)
        scorers = _scorers(config, robot)
        (designs[robot.name],) = judge.of_matrices([dataset.robot.inverse_kinematic_matrix])
        design = {split: scorer.score(dataset.robot.inverse_kinematic_matrix) for split, scorer in scorers.items()}
        mine = [(index, fit) for index, fit in enumerate(fits) if fit.robot is robot]
        plain = [i for i, _ in mine if results[i].matrix is not None and results[i].extension is None]
        matrices = [matrix for i in plain if (matrix := results[i].matrix) is not None]
        errors = dict(zip(plain, judge.of_matrices(matrices), strict=True))
        for index, fit in mine:
            result, of_fit, scores = results[index], errors.get(index), dict[Split, SplitScore]()
            try:
                if result.matrix is not None and result.extension is not None:
                    model = extended_model(
                        dataset.robot, result.matrix, config.integration, dataset.sample_period, result.extension,
                        fit.label,
                    )  # fmt: skip
                    of_fit = final_errors(model, dataset.trajectories)
                    scores = {split: scorer.score_of_model(model) for split, scorer in scorers.items()}
                elif result.matrix is not None:
                    scores = {split: scorer.score(result.matrix) for split, scorer in scorers.items()}
            except OmnibenchError as error:
                if isinstance(error, PluginError) and config.datasets:  # its cost
                    raise
                result, of_fit = _without_answer(result, Outcome.FAILED, str(error)), None
            if of_fit is not None and not np.isfinite(of_fit).all() and config.robots:
                result = _without_answer(result, Outcome.INVALID, "its odometry is not finite on a run that judges it")
                of_fit = None
            record = _record(fit, result, scores, design) if config.datasets else None
            scored[index] = ScoredFit(fit, result, of_fit, record, scores, design)
    progress(Progress("judging", len(fits), len(fits), "answer"))
    in_order = [scored[index] for index in range(len(fits))]
    exact = [done for done in in_order if _is_exact(done)]
    return tuple(_with_gap(done, exact) for done in in_order), designs


def _scorers(config: CompareConfig, robot: ComparedRobot) -> dict[Split, SplitScorer]:
    """A scorer for each split of a data set that has trajectories; none of a robot whose runs are divided otherwise."""
    if not config.datasets or config.cost is None:
        return {}
    choice, unit = config.cost, config.bootstrap.unit
    return {
        split: SplitScorer(runs, costs.create(choice.name, choice.options), config.integration, unit)
        for split in SPLITS
        if (runs := robot.dataset.split(split))
    }


def _without_answer(result: RunResult, outcome: Outcome, reason: str) -> RunResult:
    return replace(result, outcome=outcome, reason=reason, vector=None, matrix=None, cost=None)


def _record(
    fit: PlannedFit, result: RunResult, scores: Mapping[Split, SplitScore], design: Mapping[Split, SplitScore]
) -> RunRecord:
    """A fit to a data set as a row of summary.json, without its gaps."""
    settings, parameters = fit.settings, None
    if settings.parameterisation == "geometry" and result.vector is not None:
        geometry = WheelGeometry(fit.dataset.robot, fitted_mount=settings.mount == "fit")
        parameters = searched_parameters(geometry, result.vector)
    return RunRecord(
        dataset=fit.robot.name,
        label=fit.label,
        calibrator=settings.calibrator,
        parameterisation=settings.parameterisation,
        box=fit.box_name,
        seed=settings.seed,
        options=settings.options,
        outcome=result.outcome,
        reason=result.reason,
        **_columns("train", scores, design),
        **_columns("validation", scores, design),
        evaluations=result.evaluations,
        seconds=result.seconds,
        reference_seconds=None if result.timing is None else result.timing.reference_seconds,
        machine=None if result.timing is None else result.timing.machine,
        matrix=None if result.matrix is None else matrix_rows(result.matrix),
        parameters=parameters,
        at_bounds=result.at_bounds,
        held=result.held,
        gap=None,
        gap_box=None,
        proven_gap=None,
    )


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


def _is_exact(scored: ScoredFit) -> bool:
    """True if a run converged to what should be the optimum in its box of matrix elements, with a cost to divide by."""
    fit, score = scored.fit, scored.scores.get("train")
    plain = fit.settings.loss == "squares"  # under a robust loss no run minimises the cost by which it is scored
    exact = calibrators.entry(fit.settings.calibrator).cls.exact and fit.element_box is not None and plain
    return exact and scored.result.outcome is Outcome.CONVERGED and score is not None and score.cost > score.rounding


def _with_gap(scored: ScoredFit, exact: Sequence[ScoredFit]) -> ScoredFit:
    """The run with its gap above the first answer of closed_form that it can be compared with.

    One with effects has none: no matrix of a box has them.
    """
    matrix, record = scored.result.matrix, scored.row
    if record is None or record.train_cost is None or matrix is None or scored.result.extension is not None:
        return scored
    for optimum in exact:
        if is_comparable(scored.fit, matrix, optimum.fit):
            gap = record.train_cost / optimum.scores["train"].cost - 1
            return replace(scored, row=record.model_copy(update={"gap": gap, "gap_box": optimum.fit.box_name}))
    return scored


def is_comparable(run: PlannedFit, matrix: Array, other: PlannedFit) -> bool:
    """True if a run's matrix (3, N) can be compared with the lowest cost in the box of ``other``, which has one.

    The data must be the same, and so must the box; for a geometry, or an answer without a box, the other's box must
    contain the matrix.
    """
    if run.robot is not other.robot:
        return False
    if run.element_box is not None:
        return run.element_box == other.element_box
    bounds = make_bounds(other.dataset.robot, other.settings.box)
    return bool(((matrix.ravel() >= bounds.lower) & (matrix.ravel() <= bounds.upper)).all())


def certify(
    choice: CertificateChoice | None, scored: Sequence[ScoredFit]
) -> tuple[tuple[ScoredFit, ...], tuple[BoxCertificate, ...]]:
    """The fits with their proven gaps, and one proof for each box of matrix elements in which a fit gave an answer.

    A geometry, or an answer without a box, is compared with a box that contains its matrix. Nothing is proven where the
    config asks for no certificate, the cost is no sum of norms, or references are no poses: no bound is known then.
    """
    proofs: list[tuple[PlannedFit, BoxCertificate]] = []
    for done in scored:
        fit = done.fit
        known = any(owner.robot is fit.robot and owner.element_box == fit.element_box for owner, _ in proofs)
        if choice and fit.element_box is not None and done.result.matrix is not None and not known:
            others = [other.result.matrix for other in scored if other.fit.robot is fit.robot]
            answers = [matrix.ravel() for matrix in others if matrix is not None]
            proofs += [(fit, proof) for proof in _proof(choice, fit, answers)]
    proven = []
    for done in scored:
        matrix, record = done.result.matrix, done.row
        effects = done.result.extension is not None  # which no matrix of a box has
        if record is not None and matrix is not None and not effects:
            bounds = (proof.lower_bound for owner, proof in proofs if is_comparable(done.fit, matrix, owner))
            if record.train_cost is not None and (bound := next(bounds, None)) is not None:
                gap = proven_gap(record.train_cost, bound)
                done = replace(done, row=record.model_copy(update={"proven_gap": gap}))
        proven.append(done)
    return tuple(proven), tuple(proof for _, proof in proofs)


def _proof(choice: CertificateChoice, run: PlannedFit, answers: Sequence[Array]) -> list[BoxCertificate]:
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
            dataset=run.robot.name,
            box=run.box_name,
            lower_bound=proof.lower_bound,
            best_cost=proof.best_cost,
            gap=proven_gap(proof.best_cost, proof.lower_bound),
            parts=proof.boxes,
            seconds=proof.seconds,
            finished=proof.finished,
        )
    ]


def typical_answers(
    scored: Sequence[ScoredFit], statistics: Sequence[EntryStatistics]
) -> dict[tuple[str, str], TypicalAnswer]:
    """How sure the answer of every entry's typical run is, and what it means, by data set and label."""
    typical = [entry.typical for entry in statistics]
    answers = {}
    for done in scored:
        fit, result = done.fit, done.result
        if result.vector is None or not any(done is one for one in typical):
            continue
        problem, uncertainty, cls = fit.problem(), None, calibrators.entry(fit.settings.calibrator).cls
        if cls.fitted:
            with suppress(NoCovarianceError):  # its answer is no minimum
                uncertainty = uncertainty_of(problem, result)
        effects = result.extension.effects if result.extension else ()
        asked = None if cls.as_is else fit.settings.mount  # of which an answer that stands as it is knows nothing
        by_prior = cls.weighs_design and fit.settings.tolerance is None
        fitted_mount = mount_is_fitted(fit.dataset.robot, asked, by_prior=by_prior)
        reading = physical_parameters(problem, result, uncertainty, effects, fitted_mount=fitted_mount)
        answers[fit.robot.name, fit.label] = TypicalAnswer(uncertainty, reading.parameters)
    return answers
