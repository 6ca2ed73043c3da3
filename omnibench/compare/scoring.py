"""From a run's matrix to its row: costs, errors and improvements on both splits."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from omnibench.compare.plan import UNBOUNDED, PlannedRun
from omnibench.compare.result import RunRecord, ScoredRun
from omnibench.data.dataset import Dataset, Split, Trajectory
from omnibench.errors import PluginError
from omnibench.fit.calibrator import Outcome, RunResult, describe_error
from omnibench.fit.cost import Cost
from omnibench.fit.evaluate import positions_and_headings
from omnibench.fit.parameterisation import Box, FittedParameter, fitted_parameters, make_bounds
from omnibench.registry import calibrators, costs
from omnibench.robot.calibration import matrix_rows
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, OdometryBatch


class SplitScorer:
    """Scores matrices on one split with one cost."""

    def __init__(self, trajectories: Sequence[Trajectory], cost: Cost, integration: Integration) -> None:
        self._cost = cost
        self._odometry = cost.batch(trajectories, integration)
        self._reference = cost.reference(trajectories)
        self._ends = OdometryBatch([trajectory.final_log for trajectory in trajectories], integration)
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
        """Odometry minus reference (Z, 3) at the last reference pose of every trajectory, m, m, rad."""
        return self._ends.poses(matrix[None])[0] - self._final

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
    plan: Sequence[PlannedRun], results: Sequence[RunResult], datasets: Mapping[str, Dataset]
) -> tuple[ScoredRun, ...]:
    """Every run with its costs and errors, and its gap above the exact optimum where that is known."""
    scorers: dict[tuple[str, Split], SplitScorer] = {}
    for run in plan:
        for split in ("train", "validation"):
            trajectories = datasets[run.dataset_name].split(split)
            if trajectories and (run.dataset_name, split) not in scorers:
                cost = costs.create(run.config.cost.name, run.config.cost.options)
                scorers[run.dataset_name, split] = SplitScorer(trajectories, cost, run.config.integration)
    scored = [_score_one(run, result, scorers) for run, result in zip(plan, results, strict=True)]
    exact = [(run, done) for run, done in zip(plan, scored, strict=True) if _is_exact(done.record)]
    return tuple(_with_gap(run, done, exact) for run, done in zip(plan, scored, strict=True))


def position_error(errors: Array) -> float:
    """Mean distance of final errors (Z, 3), m."""
    return float(positions_and_headings(errors)[0].mean())


def heading_error(errors: Array) -> float:
    """Mean absolute heading of final errors (Z, 3), rad."""
    return float(positions_and_headings(errors)[1].mean())


def _score_one(run: PlannedRun, result: RunResult, scorers: Mapping[tuple[str, Split], SplitScorer]) -> ScoredRun:
    train = scorers[run.dataset_name, "train"]
    validation = scorers.get((run.dataset_name, "validation"))
    design = run.dataset.robot.inverse_kinematic_matrix
    matrix = result.matrix
    train_errors = None if matrix is None else train.final_errors(matrix)
    validation_errors = None if matrix is None or validation is None else validation.final_errors(matrix)
    train_cost = None if matrix is None else train.cost(matrix)
    validation_cost = None if matrix is None or validation is None else validation.cost(matrix)
    theoretical_train = train.cost(design)
    theoretical_validation = None if validation is None else validation.cost(design)
    record = RunRecord(
        dataset=run.dataset_name,
        label=run.label,
        calibrator=run.entry.name,
        parameterisation=run.parameterisation,
        box=run.box,
        seed=run.seed,
        options=run.entry.options,
        outcome=result.outcome,
        reason=result.reason,
        train_cost=train_cost,
        validation_cost=validation_cost,
        theoretical_train_cost=theoretical_train,
        theoretical_validation_cost=theoretical_validation,
        train_improvement=_improvement(train_cost, theoretical_train),
        validation_improvement=_improvement(validation_cost, theoretical_validation),
        train_position_m=None if train_errors is None else position_error(train_errors),
        train_heading_rad=None if train_errors is None else heading_error(train_errors),
        validation_position_m=None if validation_errors is None else position_error(validation_errors),
        validation_heading_rad=None if validation_errors is None else heading_error(validation_errors),
        evaluations=result.evaluations,
        seconds=result.seconds,
        matrix=None if matrix is None else matrix_rows(matrix),
        parameters=_parameters(run, result),
        at_bounds=result.at_bounds,
        held=result.held,
        gap=None,
        gap_box=None,
        proven_gap=None,
    )
    return ScoredRun(
        record=record,
        history=result.history,
        train_errors=train_errors,
        train_costs=None if matrix is None else train.costs(matrix),
        validation_errors=validation_errors,
        validation_costs=None if matrix is None or validation is None else validation.costs(matrix),
        theoretical_train_costs=train.costs(design),
        theoretical_validation_costs=None if validation is None else validation.costs(design),
    )


def _improvement(cost: float | None, theoretical: float | None) -> float | None:
    return None if cost is None or not theoretical else 1 - cost / theoretical


def _parameters(run: PlannedRun, result: RunResult) -> tuple[FittedParameter, ...] | None:
    if run.parameterisation != "geometry" or result.vector is None:
        return None
    return fitted_parameters(run.dataset.robot, result.vector)


def _is_exact(record: RunRecord) -> bool:
    """Whether a run's training cost is the optimum in its box, and one to divide by."""
    exact = calibrators.entry(record.calibrator).cls.exact
    return exact and record.outcome is Outcome.CONVERGED and bool(record.train_cost)


def _with_gap(run: PlannedRun, scored: ScoredRun, exact: Sequence[tuple[PlannedRun, ScoredRun]]) -> ScoredRun:
    """The gap above the exact optimum in the same box.

    A geometry, or an answer without a box, is compared with the optimum over a box that contains its matrix.
    """
    cost, matrix = scored.record.train_cost, scored.matrix
    if cost is None or matrix is None:
        return scored
    for other, optimum in exact:
        if other.dataset_name != run.dataset_name or optimum.record.train_cost is None:
            continue
        if box_contains(other, matrix) if has_no_box(run) else box_of(other) == box_of(run):
            gap = cost / optimum.record.train_cost - 1
            return replace(scored, record=scored.record.model_copy(update={"gap": gap, "gap_box": other.box}))
    return scored


def has_no_box(run: PlannedRun) -> bool:
    """Whether a run's matrix was not searched in a box of matrix elements: a geometry, or an answer that is given."""
    return run.parameterisation == "geometry" or run.box == UNBOUNDED


def box_of(run: PlannedRun) -> Box:
    """The box of a run that has one."""
    return run.entry.box or run.config.box


def box_contains(run: PlannedRun, matrix: Array) -> bool:
    """Whether a matrix (3, N) lies in the box of a run that has one."""
    bounds = make_bounds(run.dataset.robot, box_of(run))
    return bool(((matrix.ravel() >= bounds.lower) & (matrix.ravel() <= bounds.upper)).all())
