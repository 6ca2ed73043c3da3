"""From a run's matrix to its row: costs, errors and improvements on each split."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from omnibench.compare.config import CompareConfig
from omnibench.compare.plan import PlannedRun
from omnibench.compare.result import RunRecord, ScoredRun, SplitScore
from omnibench.data.dataset import SPLITS, Dataset, Split, Trajectory
from omnibench.errors import DataError, PluginError
from omnibench.fit.calibrator import Outcome, RunResult, describe_error
from omnibench.fit.cost import Cost
from omnibench.fit.evaluate import final_errors, positions_and_headings
from omnibench.fit.geometry import FittedParameter, WheelGeometry, fitted_parameters
from omnibench.fit.parameterisation import make_bounds
from omnibench.fit.ratio_intervals import UnitName, units_of
from omnibench.fit.reference_rows import with_mean_errors
from omnibench.registry import calibrators, costs
from omnibench.robot.calibration import extended_model, matrix_rows
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration
from omnibench.robot.stored_odometry import odometry_of


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

        Of one without poses: what ``with_mean_errors`` of reference_rows.py says.
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


def _parameters(run: PlannedRun, result: RunResult) -> tuple[FittedParameter, ...] | None:
    if run.settings.parameterisation != "geometry" or result.vector is None:
        return None
    geometry = WheelGeometry(run.dataset.robot, fitted_mount=run.settings.mount == "fit")
    return fitted_parameters(geometry, result.vector)


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
