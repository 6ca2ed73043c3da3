"""The odometry model that a calibrator fits and the live node runs: matrix, integration and effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration, OdometryBatch, OdometryStream, WheelLog


@dataclass(frozen=True, eq=False)
class OdometryModel:
    """A robot's odometry: ``matrix`` (3, N) in m and rad per rad of wheel, and how a sample is integrated."""

    robot: Robot
    matrix: Array
    integration: Integration

    @classmethod
    def of_design(cls, robot: Robot, integration: Integration) -> OdometryModel:
        """The model of the design values, Eq. (7) for the APR-02."""
        return cls(robot, robot.inverse_kinematic_matrix, integration)

    def poses(self, logs: Sequence[WheelLog]) -> list[Array]:
        """Poses of each log at its stamps: a list of (S, 3) in m, m, rad."""
        batch = OdometryBatch(logs, self.integration)
        poses = batch.poses(self.matrix[None])[0]
        return [poses[batch.trajectory == index] for index in range(len(logs))]

    def stream(self, start: Array | None = None) -> OdometryStream:
        """The model as a stream of samples, from a start pose (default: the origin)."""
        return OdometryStream(self.matrix, self.integration, start)
