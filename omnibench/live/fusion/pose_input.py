"""From pose messages to pose measurements: a message that cannot be a pose in the map is refused and counted."""

from __future__ import annotations

import numpy as np

from omnibench.live.estimation.counts import Counts
from omnibench.live.estimation.live_odometry import UNKNOWN_NOISE
from omnibench.live.fusion.timeline import PoseMeasurement
from omnibench.live.wire.messages import POSE_ESTIMATE, MessageError, PoseEstimate
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array

_FARTHEST = 1e7  # m; chosen: no robot drives as far from its map's origin
_SUREST = 1e-7  # m, rad; chosen: no SLAM has smaller standard deviations


class PoseInput:
    """Reads geometry_msgs/PoseWithCovarianceStamped messages whose poses are in the frame ``frame``."""

    def __init__(self, frame: str, counts: Counts) -> None:
        self._frame = frame
        self._counts = counts

    def read(self, payload: bytes, arrival: float, calibration: Calibration) -> PoseMeasurement:
        """The measurement in a payload that came at ``arrival`` (s, monotonic). MessageError: why it is refused.

        calibration: its noise model gives the covariance of a pose that comes without one.
        """
        try:
            message = POSE_ESTIMATE.decode(payload)
        except MessageError:
            self._counts.pose_undecodable += 1
            raise
        try:
            covariance = self._checked_covariance(message, calibration)
        except MessageError:
            self._counts.pose_invalid += 1
            raise
        return PoseMeasurement(message.stamp, message.pose, covariance, arrival)

    def _checked_covariance(self, message: PoseEstimate, calibration: Calibration) -> Array:
        """The covariance (3, 3) of a message. MessageError: pose or covariance cannot be."""
        if message.frame not in ("", self._frame):
            raise MessageError(f"the pose is in frame {message.frame!r}, not in {self._frame!r}")
        if not np.isfinite(message.pose).all() or not np.isfinite(message.covariance).all():
            raise MessageError("the pose or its covariance is not finite")
        if np.abs(message.pose[:2]).max() > _FARTHEST:
            raise MessageError(f"the pose lies {np.abs(message.pose[:2]).max():.3g} m away")
        covariance = message.covariance if message.covariance.any() else _usual_covariance(calibration)
        least, *_, largest = np.linalg.eigvalsh(covariance)
        if not np.allclose(covariance, covariance.T) or least <= 0:
            raise MessageError("the pose's covariance is not positive definite")
        if largest > _FARTHEST**2 or least < _SUREST**2:
            raise MessageError(f"the pose's standard deviations reach from {least**0.5:.1e} to {largest**0.5:.1e}")
        return covariance


def _usual_covariance(calibration: Calibration) -> Array:
    """Covariance (3, 3) of the reference's white noise and bias together, as the calibration knows them."""
    noise = calibration.noise or UNKNOWN_NOISE
    position = noise.pose_position**2 + noise.bias_position**2 or UNKNOWN_NOISE.pose_position**2
    heading = noise.pose_heading**2 + noise.bias_heading**2 or UNKNOWN_NOISE.pose_heading**2
    return np.diag([position, position, heading])
