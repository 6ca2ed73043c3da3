"""Costs that a calibration minimises: Eq. (6) of the paper and its relatives, all sums of norms of pose errors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.reference_rows import ReferenceBatch, ReferenceRows, predicted_by, reference_rows
from omnibench.registry import Options, costs
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryBatch, WheelLog
from omnibench.robot.stored_odometry import odometry_of

NO_ERROR = 1e-9  # m, rad: smaller errors are rounding


class Cost(ABC):
    """One number for the pose errors of a set of trajectories.

    stamps: where along a trajectory poses are compared, ``final`` (last reference pose) or ``reference`` (all after the
    start). Of a run with references other than poses all of these count, too, each with the coordinates that it has.
    rounding: in the cost's unit; one that is not above it is rounding, of which no share means anything.
    coordinates: factors of the errors of x, y and heading; 0 of those that do not count.
    """

    Options: ClassVar[type[Options]] = Options
    name: str
    stamps: Literal["final", "reference"] = "final"
    rounding: float = 0.0
    coordinates: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __init__(self, options: Any) -> None:
        self.options = options

    @abstractmethod
    def combine(self, errors: Array, trajectory: NDArray[np.intp]) -> Array:
        """Costs (P,) from pose errors (P, S, 3) in m, m, rad; ``trajectory`` (S,): index of each stamp's trajectory."""

    def of_each(self, errors: Array, trajectory: NDArray[np.intp]) -> Array:
        """The cost (Z,) of every trajectory by itself, from errors (S, 3) of one candidate."""
        parts = (errors[None, trajectory == index] for index in range(int(trajectory[-1]) + 1))
        return np.array([self.combine(part, np.zeros(part.shape[1], dtype=np.intp))[0] for part in parts])

    def of_model(self, model: OdometryModel, trajectories: Sequence[Trajectory]) -> float:
        """The cost of a model on some trajectories. DataError: these lack what an effect of the model needs."""
        errors, owner = self.errors_of(model, trajectories)
        return float(self.combine(errors[None], owner)[0])

    def errors_of(self, model: OdometryModel, trajectories: Sequence[Trajectory]) -> tuple[Array, NDArray[np.intp]]:
        """Errors (S, 3) of a model at this cost's stamps, and the trajectory (S,) of each. DataError: see above."""
        if (rows := self.rows(trajectories)) is not None:
            return predicted_by(model, rows) - rows.observed, rows.trajectory
        poses = model.reported(self.logs(trajectories))
        owner = np.repeat(np.arange(len(poses)), [len(of_run) for of_run in poses])
        return np.concatenate(poses) - self.reference(trajectories), owner

    def rows(self, trajectories: Sequence[Trajectory]) -> ReferenceRows | None:
        """The rows that this cost compares, where a trajectory has references other than poses; else None.

        DataError: a trajectory has nothing that this cost compares.
        """
        if all(run.references is None for run in trajectories):
            return None
        return reference_rows(trajectories, self.stamps, self.coordinates, self.name)

    def logs(self, trajectories: Sequence[Trajectory]) -> list[WheelLog]:
        """The wheel logs of the trajectories with this cost's stamps. DataError: one has no pose after its start."""
        for run in trajectories if self.stamps == "reference" else ():
            if len(run.pose_times) < 2:
                raise DataError(f"trajectory {run.id} has no reference pose after its start, which {self.name} needs")
        return [t.final_log if self.stamps == "final" else t.reference_log for t in trajectories]

    def batch(self, trajectories: Sequence[Trajectory], integration: Integration) -> OdometryBatch | ReferenceBatch:
        """The odometry of the trajectories at this cost's stamps, or what it says of their references."""
        if (rows := self.rows(trajectories)) is not None:
            return ReferenceBatch(rows, integration)
        return odometry_of(self.logs(trajectories), integration)

    def reference(self, trajectories: Sequence[Trajectory]) -> Array:
        """The reference poses (S, 3) at this cost's stamps, or what was observed in their place."""
        if (rows := self.rows(trajectories)) is not None:
            return rows.observed
        return np.concatenate([t.poses[-1:] if self.stamps == "final" else t.poses[1:] for t in trajectories])


costs.contract = Cost


class SumOfNorms(Cost):
    """Mean over trajectories of the mean norm of the weighted pose errors at the stamps.

    weights (3,): factors of the errors of x (m), y (m) and heading (rad) before the norm is taken.
    """

    weights: ClassVar[tuple[float, float, float]] = (1.0, 1.0, 1.0)
    rounding = NO_ERROR

    def __init__(self, options: Any) -> None:
        super().__init__(options)
        self.coordinates = self.weights

    def combine(self, errors: Array, trajectory: NDArray[np.intp]) -> Array:
        """Costs (P,): the norms, weighted by the stamps' shares."""
        return self.norms(errors) @ self.shares(trajectory)

    def norms(self, errors: Array) -> Array:
        """Norms (..., S) of pose errors (..., S, 3)."""
        squares = np.zeros(errors.shape[:-1])
        for axis, weight in enumerate(self.weights):
            if weight:
                squares += np.square(errors[..., axis] if weight == 1 else weight * errors[..., axis])
        return np.sqrt(squares, out=squares)

    def shares(self, trajectory: NDArray[np.intp]) -> Array:
        """Share (S,) of each stamp in the cost; they sum to one."""
        counts = np.bincount(trajectory)
        return 1.0 / (counts[trajectory] * len(counts))


@costs.register("final_pose")
class FinalPose(SumOfNorms):
    """Eq. (6): mean over trajectories of the norm of the final pose error, m and rad alike."""


@costs.register("final_position")
class FinalPosition(SumOfNorms):
    """Mean distance between final odometry and final reference position, m."""

    weights = (1.0, 1.0, 0.0)


@costs.register("final_heading")
class FinalHeading(SumOfNorms):
    """Mean absolute final heading error, rad."""

    weights = (0.0, 0.0, 1.0)


@costs.register("trajectory")
class AlongTrajectory(SumOfNorms):
    """Mean pose error along the whole reference, m and rad alike, each trajectory counting the same."""

    stamps = "reference"
