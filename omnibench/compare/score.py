"""Scores of fits: errors of every answer on all runs of its robot; of data sets also costs, gaps and proven bounds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from omnibench.compare.config import CertificateChoice, CompareConfig
from omnibench.compare.plan import PlannedFit
from omnibench.compare.result import BoxCertificate, RunRecord, ScoredFit, SplitScore
from omnibench.data.dataset import SPLITS, Split, Trajectory
from omnibench.errors import OmnibenchError, PluginError
from omnibench.fit.calibrator import Outcome, RunResult, describe_error
from omnibench.fit.certify import prove, proven_gap
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.evaluate import final_errors, positions_and_headings
from omnibench.fit.geometry import WheelGeometry, searched_parameters
from omnibench.fit.intervals import UnitName, units_of
from omnibench.fit.parameterisation import make_bounds
from omnibench.fit.reference_rows import with_mean_errors
from omnibench.fit.settings import CostChoice
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import calibrators, costs
from omnibench.robot.calibration import extended_model, matrix_rows
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryBatch
from omnibench.robot.stored_odometry import odometry_of

T = TypeVar("T")
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
            errors += [
                with_mean_errors(poses - self._ends, matrix, self._runs, self._integration)
                for poses, matrix in zip(self._odometry.poses(np.array(together)), together, strict=True)
            ]
        return errors


class SplitScorer:
    """Scores matrices, and models with effects, on one split with one cost."""

    def __init__(
        self, trajectories: Sequence[Trajectory], cost: Cost, integration: Integration, unit: UnitName | None = None
    ) -> None:
        self._cost, self._trajectories = cost, tuple(trajectories)
        self._units, self._odometry = units_of(trajectories, unit), cost.batch(trajectories, integration)
        self._reference, self._ends = cost.reference(trajectories), FinalErrors(trajectories, integration)

    def score(self, model: Array | OdometryModel) -> SplitScore:
        """Costs and final errors of a matrix (3, N), or of a model with effects.

        PluginError when the cost raises or is not a finite number. DataError: the model lacks what an effect needs.
        """
        if isinstance(model, OdometryModel):
            errors, owner = self._cost.errors_of(model, self._trajectories)
            ends = final_errors(model, self._trajectories)
        else:
            errors, owner = self._odometry.poses(model[None])[0] - self._reference, self._odometry.trajectory
            (ends,) = self._ends.of_matrices([model])
        cost = float(self._checked(1, lambda: self._cost.combine(errors[None], owner))[0])
        costs = self._checked(len(self._trajectories), lambda: self._cost.of_each(errors, owner))
        return SplitScore(cost, costs, ends, self._units, self._cost.rounding)

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
    config: CompareConfig, fits: Sequence[PlannedFit], results: Sequence[RunResult], progress: Reporter = no_progress
) -> tuple[tuple[ScoredFit, ...], dict[str, Array]]:
    """Every fit with its errors, and by robot the errors (Z, 3) of the design values on all its runs.

    Of data sets: with its costs, and its gap above closed_form where that converged in the same box. An answer whose
    effects do not act on some run is a failed one.
    """
    scored: dict[int, ScoredFit] = {}
    designs: dict[str, Array] = {}
    no_answer: dict[str, Any] = {"vector": None, "matrix": None, "cost": None}
    for robot in {fit.robot.name: fit.robot for fit in fits}.values():
        progress(Progress("judging", len(scored), len(fits), "answer"))
        dataset, runs, choice = robot.dataset, robot.dataset.trajectories, config.cost or CostChoice()
        scorers: dict[Split, SplitScorer] = {}
        for split in SPLITS if config.datasets else ():
            if of_split := dataset.split(split):
                cost = costs.create(choice.name, choice.options)
                scorers[split] = SplitScorer(of_split, cost, config.integration, config.bootstrap.unit)
        mine = [(index, fit) for index, fit in enumerate(fits) if fit.robot is robot]
        plain = [i for i, _ in mine if results[i].matrix is not None and results[i].extension is None]
        matrices = [matrix for i in plain if (matrix := results[i].matrix) is not None]
        start, judge = dataset.robot.inverse_kinematic_matrix, FinalErrors(runs, config.integration)
        (designs[robot.name],) = judge.of_matrices([start])
        of_plain = dict(zip(plain, judge.of_matrices(matrices), strict=True))
        design = {split: scorer.score(start) for split, scorer in scorers.items()}
        for index, fit in mine:
            result, of_fit, scores = results[index], of_plain.get(index), dict[Split, SplitScore]()
            try:
                if result.matrix is not None:
                    model: Array | OdometryModel = result.matrix
                    if result.extension is not None:
                        model = extended_model(
                            dataset.robot, result.matrix, config.integration, dataset.sample_period, result.extension,
                            fit.label,
                        )  # fmt: skip
                        of_fit = final_errors(model, runs)
                    scores = {split: scorer.score(model) for split, scorer in scorers.items()}
            except OmnibenchError as error:
                if isinstance(error, PluginError) and config.datasets:  # its cost
                    raise
                result, of_fit = replace(result, outcome=Outcome.FAILED, reason=str(error), **no_answer), None
            if of_fit is not None and not np.isfinite(of_fit).all() and config.robots:
                why = "its odometry is not finite on a run that judges it"
                result, of_fit = replace(result, outcome=Outcome.INVALID, reason=why, **no_answer), None
            record = _record(fit, result, scores, design) if config.datasets else None
            scored[index] = ScoredFit(fit, result, of_fit, record, scores, design)
    progress(Progress("judging", len(fits), len(fits), "answer"))
    in_order = [scored[index] for index in range(len(fits))]
    # What should be the optima in their boxes of matrix elements, with a cost to divide by. Under a robust loss no run
    # minimises the cost by which it is scored
    optima = [
        (done.fit, (done.fit.box_name, score.cost))
        for done in in_order
        if calibrators.entry(done.fit.settings.calibrator).cls.exact
        and (done.fit.element_box is not None and done.fit.settings.loss == "squares")
        and (done.result.outcome is Outcome.CONVERGED and (score := done.scores.get("train")) is not None)
        and score.cost > score.rounding
    ]
    for index, done in enumerate(in_order):
        known = known_of_box(done, optima)
        if done.row is not None and done.row.train_cost is not None and known is not None:
            gap = {"gap": done.row.train_cost / known[1] - 1, "gap_box": known[0]}
            in_order[index] = replace(done, row=done.row.model_copy(update=gap))
    return tuple(in_order), designs


def known_of_box(done: ScoredFit, others: Iterable[tuple[PlannedFit, T]]) -> T | None:
    """What is first known of the box of another run on the same data that a run's answer can be compared with.

    The box must be the same; for a geometry, or an answer without a box, it must contain the matrix. An answer with
    effects has none: no matrix of a box has them.
    """
    fit, matrix = done.fit, done.result.matrix
    if matrix is None or done.result.extension is not None:
        return None
    for other, known in others:
        if fit.robot is other.robot and fit.element_box is not None:
            inside = fit.element_box == other.element_box
        elif fit.robot is other.robot:
            bounds = make_bounds(other.dataset.robot, other.settings.box)
            inside = bool(((matrix.ravel() >= bounds.lower) & (matrix.ravel() <= bounds.upper)).all())
        else:
            inside = False
        if inside:
            return known
    return None


def _record(
    fit: PlannedFit, result: RunResult, scores: Mapping[Split, SplitScore], design: Mapping[Split, SplitScore]
) -> RunRecord:
    """A fit to a data set as a row of summary.json, without its gaps."""
    settings, timing, parameters = fit.settings, result.timing, None
    if settings.parameterisation == "geometry" and result.vector is not None:
        geometry = WheelGeometry(fit.dataset.robot, fitted_mount=settings.mount == "fit")
        parameters = searched_parameters(geometry, result.vector)
    of_settings = ("calibrator", "parameterisation", "seed", "options")
    of_result = ("outcome", "reason", "evaluations", "seconds", "at_bounds", "held")
    return RunRecord(
        dataset=fit.robot.name,
        label=fit.label,
        box=fit.box_name,
        **{name: getattr(settings, name) for name in of_settings},
        **{name: getattr(result, name) for name in of_result},
        **_columns("train", scores, design),
        **_columns("validation", scores, design),
        reference_seconds=timing and timing.reference_seconds,
        machine=timing and timing.machine,
        matrix=None if result.matrix is None else matrix_rows(result.matrix),
        parameters=parameters,
    )


def _columns(split: Split, scores: Mapping[Split, SplitScore], design: Mapping[Split, SplitScore]) -> dict[str, Any]:
    """The columns of a run's row that a split has; None where it has no trajectories, or the run no answer."""
    score, theoretical = scores.get(split), design.get(split)
    position, heading = (None, None) if score is None else mean_errors_of(score.errors)
    known = score is not None and theoretical is not None and theoretical.cost > theoretical.rounding
    return {
        f"{split}_cost": score and score.cost,
        f"theoretical_{split}_cost": theoretical and theoretical.cost,
        f"{split}_improvement": 1 - score.cost / theoretical.cost if known and score and theoretical else None,
        f"{split}_position_m": position,
        f"{split}_heading_rad": heading,
    }


def mean_errors_of(errors: Array) -> tuple[float, float]:
    """Mean distance, m, and mean absolute heading, rad, of final errors (Z, 3)."""
    positions, headings = positions_and_headings(errors)
    return float(positions.mean()), float(headings.mean())


def certify(
    choice: CertificateChoice | None, scored: Sequence[ScoredFit]
) -> tuple[tuple[ScoredFit, ...], tuple[BoxCertificate, ...]]:
    """The fits with their proven gaps, and one proof for each box of matrix elements in which a fit gave an answer.

    Nothing is proven where the config asks for no certificate, the cost is no sum of norms, or references are no poses:
    no bound is known then.
    """
    proofs: list[tuple[PlannedFit, BoxCertificate]] = []
    for done in scored if choice else ():
        fit = done.fit
        known = any(owner.robot is fit.robot and owner.element_box == fit.element_box for owner, _ in proofs)
        if fit.element_box is None or done.result.matrix is None or known:
            continue
        problem = fit.problem()
        if not isinstance(problem.odometry, OdometryBatch) or not isinstance(problem.objective, SumOfNorms):
            continue
        # Good answers that are known make the proof faster
        others = [other.result.matrix for other in scored if other.fit.robot is fit.robot]
        vectors = np.stack([problem.start, *(matrix.ravel() for matrix in others if matrix is not None)])
        inside = vectors[problem.inside(vectors)]
        best = inside[int(np.nanargmin(problem.values(inside)))]
        assert choice is not None  # it is asked for
        proof = prove(problem, best, gap=choice.gap, seconds=choice.seconds, parts=choice.parts)
        certificate = BoxCertificate(
            dataset=fit.robot.name,
            box=fit.box_name,
            lower_bound=proof.lower_bound,
            best_cost=proof.best_cost,
            gap=proven_gap(proof.best_cost, proof.lower_bound),
            parts=proof.boxes,
            seconds=proof.seconds,
            finished=proof.finished,
        )
        proofs.append((fit, certificate))
    proven = []
    for done in scored:
        proof_of = known_of_box(done, proofs)
        if done.row is not None and done.row.train_cost is not None and proof_of is not None:
            gap = proven_gap(done.row.train_cost, proof_of.lower_bound)
            done = replace(done, row=done.row.model_copy(update={"proven_gap": gap}))
        proven.append(done)
    return tuple(proven), tuple(proof for _, proof in proofs)
