"""From a run's matrix to its row: costs, errors and improvements on both splits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from omnibench.compare.plan import UNBOUNDED, PlannedRun
from omnibench.compare.results import FittedParameter, RunRecord, ScoredRun
from omnibench.data.dataset import Dataset, Split, Trajectory
from omnibench.fit.calibrator import Outcome, RunResult
from omnibench.fit.cost import Cost
from omnibench.fit.parameterisation import WheelGeometry, make_bounds
from omnibench.registry import costs
from omnibench.robot.calibration import matrix_rows
from omnibench.robot.kinematics import Array, Robot
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
        """The cost of a matrix (3, N) on the split."""
        return float(self._cost.combine(self._errors(matrix)[None], self._odometry.trajectory)[0])

    def costs(self, matrix: Array) -> Array:
        """The cost (Z,) of every trajectory."""
        return self._cost.of_each(self._errors(matrix), self._odometry.trajectory)

    def final_errors(self, matrix: Array) -> Array:
        """Odometry minus reference (Z, 3) at the last reference pose of every trajectory, m, m, rad."""
        return self._ends.poses(matrix[None])[0] - self._final

    def _errors(self, matrix: Array) -> Array:
        return self._odometry.poses(matrix[None])[0] - self._reference


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
    return tuple(_with_gap(run, scored, datasets[run.record.dataset].robot) for run in scored)


def position_error(errors: Array) -> float:
    """Mean distance of final errors (Z, 3), m."""
    return float(np.linalg.norm(errors[:, :2], axis=1).mean())


def heading_error(errors: Array) -> float:
    """Mean absolute heading of final errors (Z, 3), rad."""
    return float(np.abs(errors[:, 2]).mean())


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
        gap=None,
        gap_box=None,
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
    geometry = WheelGeometry(run.dataset.robot, run.entry.limits)
    return tuple(
        FittedParameter(
            name=name,
            value=float(value),
            unit="rad" if name.startswith("angle") else "m",
            design=float(design),
            deviation_percent=float(100 * (value - design) / design) if design else None,
        )
        for name, value, design in zip(geometry.names, result.vector, geometry.start, strict=True)
    )


def _with_gap(run: ScoredRun, runs: Sequence[ScoredRun], robot: Robot) -> ScoredRun:
    """The gap above closed_form's optimum in the same box.

    A geometry, or an answer without a box, is compared with the optimum over a box that contains its matrix.
    """
    record = run.record
    if record.train_cost is None or run.matrix is None:
        return run
    for other in runs:
        exact = other.record
        if exact.calibrator != "closed_form" or exact.outcome is not Outcome.CONVERGED or not exact.train_cost:
            continue
        if exact.dataset != record.dataset:
            continue
        elsewhere = record.parameterisation == "geometry" or record.box == UNBOUNDED
        if exact.box == record.box or (elsewhere and _contains(robot, exact.box, run.matrix)):
            gap = record.train_cost / exact.train_cost - 1
            return replace(run, record=record.model_copy(update={"gap": gap, "gap_box": exact.box}))
    return run


def _contains(robot: Robot, box: str, matrix: Array) -> bool:
    if box not in ("paper", "row"):
        return False
    bounds = make_bounds(robot, "paper" if box == "paper" else "row")
    return bool(((matrix.ravel() >= bounds.lower) & (matrix.ravel() <= bounds.upper)).all())
