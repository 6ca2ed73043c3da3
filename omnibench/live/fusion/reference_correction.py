"""What effects of the reference make of SLAM poses, undone before a pose is fused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omnibench.live.fusion.timeline import PoseMeasurement
from omnibench.robot.effects.effect import ReferenceEffect, Values
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel

_SECOND = 1e9  # ns


class ReferenceCorrection:
    """The effects of the reference in a model, undone.

    A run starts with the first pose that comes: effects that act from a run's start pose on begin there.
    """

    def __init__(self, model: OdometryModel, start: PoseMeasurement | None = None) -> None:
        self._terms: list[tuple[ReferenceEffect, Values]] = [
            (term.effect, term.values) for term in model.reference_terms if isinstance(term.effect, ReferenceEffect)
        ]
        self._start = start

    def continued(self, model: OdometryModel) -> ReferenceCorrection:
        """Those of another model, from the same start on."""
        return ReferenceCorrection(model, self._start)

    def restart(self) -> None:
        """The next pose is the first of another run."""
        self._start = None

    def corrected(self, measurement: PoseMeasurement) -> PoseMeasurement:
        """The pose as it truly was, at the time at which its position was taken; its heading may be of another time."""
        if self._start is None:
            self._start = measurement
        if not self._terms:
            return measurement
        stamps = np.array([(measurement.stamp - self._start.stamp) / _SECOND])
        delays = [effect.delays(stamps, values) for effect, values in self._terms]
        of_position, of_heading = (sum(float(each[kind][0]) for each in delays) for kind in range(2))
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
    """A pose whose heading was taken at another time, with its heading at its own.

    before, after: odometry's poses (3,) at the time of the heading and at that of the position.
    """
    pose: Array = measurement.pose + np.array([0.0, 0.0, after[2] - before[2]])
    return replace(measurement, pose=pose, heading_stamp=None)
