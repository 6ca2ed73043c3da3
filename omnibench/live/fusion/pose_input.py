"""From pose messages to pose measurements: a message that cannot be a pose in the map is refused and counted."""

from __future__ import annotations

import logging
import math

import numpy as np

from omnibench.live.estimation.counts import Counts
from omnibench.live.estimation.live_odometry import UNKNOWN_NOISE
from omnibench.live.fusion.pose_fusion import FusionSettings
from omnibench.live.fusion.timeline import PoseMeasurement
from omnibench.live.wire.messages import POSE_ESTIMATE, MessageError, PoseEstimate, arrival_stamp
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array, pose_covariance, usable_covariances

LOG = logging.getLogger("omnibench.live")
_FARTHEST = 1e7  # m; chosen: no robot drives as far from its map's origin


class PoseInput:
    """Reads geometry_msgs/PoseWithCovarianceStamped messages whose poses are in the frame ``frame``."""

    def __init__(self, frame: str, settings: FusionSettings, counts: Counts) -> None:
        self._frame = frame
        self._settings = settings
        self._counts = counts

    def read(
        self, payload: bytes, arrival: float, calibration: Calibration, *, replayed: bool = False
    ) -> PoseMeasurement:
        """The measurement in a payload that came at ``arrival`` (s, monotonic). MessageError: why it is refused.

        calibration: its noise model gives the covariance of a pose that comes without one, unless the settings do.
        replayed: its stamp counts in any case.
        """
        try:
            message = POSE_ESTIMATE.decode(payload)
        except MessageError:
            self._counts.pose_undecodable += 1
            raise
        try:
            if message.frame not in ("", self._frame):
                raise MessageError(f"the pose is in frame {message.frame!r}, not in {self._frame!r}")
            if not np.isfinite(message.pose).all():
                raise MessageError("the pose is not finite")
            if np.abs(message.pose[:2]).max() > _FARTHEST:
                raise MessageError(f"the pose lies {np.abs(message.pose[:2]).max():.3g} m away")
        except MessageError:
            self._counts.pose_invalid += 1
            raise
        by_arrival = self._settings.stamps == "arrival" and not replayed
        stamp = arrival_stamp(arrival) if by_arrival else message.stamp
        return PoseMeasurement(stamp, message.pose, self._covariance(message, calibration), arrival)

    def _covariance(self, message: PoseEstimate, calibration: Calibration) -> Array:
        """The covariance (3, 3) of a message, or the default where that says that it is unknown, with a warning."""
        if usable_covariances(message.covariance):
            return message.covariance
        sigma = self._settings.pose_sigma
        covariance = _usual_covariance(calibration) if sigma is None else pose_covariance(*sigma)
        if not self._counts.pose_default_covariance:
            LOG.warning(
                "slam_pose: the covariance of a pose is unknown (variances %s); standard deviations of %.3g m and "
                "%.3g deg count, by %s",
                ", ".join(f"{variance:.3g}" for variance in np.diagonal(message.covariance)),
                math.sqrt(covariance[0, 0]),
                math.degrees(math.sqrt(covariance[2, 2])),
                "the calibration; `fusion: {pose_sigma: [m, deg]}` sets others" if sigma is None else "pose_sigma",
            )
        self._counts.pose_default_covariance += 1
        return covariance


def _usual_covariance(calibration: Calibration) -> Array:
    """Covariance (3, 3) of the reference's white noise and bias together, as the calibration knows them."""
    noise = calibration.noise or UNKNOWN_NOISE
    position = noise.pose_position**2 + noise.bias_position**2 or UNKNOWN_NOISE.pose_position**2
    heading = noise.pose_heading**2 + noise.bias_heading**2 or UNKNOWN_NOISE.pose_heading**2
    return np.diag([position, position, heading])
