"""Reference correction: what effects of the reference do to SLAM poses is undone before a pose is fused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omnibench.live.estimation.robot_centre import RobotCentre, carried
from omnibench.live.fusion.timeline import PoseMeasurement
from omnibench.robot.effects.effect import ReferenceEffect, Values
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel

_SECOND = 1e9  # ns


class ReferenceCorrection:
    """Undoes a model's effects of the reference.

    start: the first pose of a run, from which some effects act on; None: the next pose that comes.
    """

    def __init__(self, model: OdometryModel, start: PoseMeasurement | None = None) -> None:
        self._mount = model.robot.mount
        self._terms: list[tuple[ReferenceEffect, Values]] = [
            (term.effect, term.values) for term in model.reference_terms if isinstance(term.effect, ReferenceEffect)
        ]
        self._start = start

    def continued(self, model: OdometryModel) -> ReferenceCorrection:
        """The correction by another model, from the same start on."""
        return ReferenceCorrection(model, self._start)

    def restart(self) -> None:
        """The next pose is the first of another run."""
        self._start = None

    def corrected(self, measurement: PoseMeasurement) -> PoseMeasurement:
        """The tracked point's true pose when its position was measured; its heading may be of another time."""
        if self._start is None:
            self._start = measurement
        if self._mount is not None:
            measurement = replace(measurement, mount=self._mount)
        if not self._terms:
            return measurement
        stamps = np.array([(measurement.stamp - self._start.stamp) / _SECOND])
        delays = [effect.delays(stamps, values) for effect, values in self._terms]
        of_position, of_heading = (sum(float(delay[kind][0]) for delay in delays) for kind in range(2))
        poses = measurement.pose[None]
        for effect, values in reversed(self._terms):
            poses = effect.corrected(poses, self._start.pose, values)
        return replace(
            measurement,
            stamp=measurement.stamp - round(_SECOND * of_position),
            heading_stamp=measurement.stamp - round(_SECOND * of_heading),
            pose=np.array(poses[0]),
        )


def turned(measurement: PoseMeasurement, before: Array, after: Array) -> PoseMeasurement:
    """A pose whose heading was measured at another time, with its heading turned to the time of the position.

    before, after: odometry's poses (3,) at the time of the heading and at that of the position.
    """
    pose: Array = measurement.pose + np.array([0.0, 0.0, after[2] - before[2]])
    return replace(measurement, pose=pose, heading_stamp=None)


def of_centre(measurement: PoseMeasurement) -> PoseMeasurement:
    """The pose of the robot's centre, from that of a point of the robot."""
    if measurement.mount is None:
        return measurement
    pose = RobotCentre(measurement.mount).pose(measurement.pose)
    covariance = carried(measurement.covariance, (pose - measurement.pose)[:2])
    return replace(measurement, pose=pose, covariance=covariance, mount=None)
