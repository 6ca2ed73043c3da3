"""Odometry with its covariance, one wheel step at a time: the calibration's model, and what its noise makes of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from omnibench.live.wheels import WheelStep
from omnibench.robot.calibration import Calibration, Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration

# For a calibration file that says nothing of noise: generous, so that a filter follows SLAM.
UNKNOWN_NOISE = Noise(pose_position=0.02, pose_heading=0.02, walk_position=0.03, walk_heading=0.03)
_BLIND_SHARE = 0.3  # of a motion whose path nobody saw
_STILL = 1e-3  # rad/s; slower wheels stand
_CORRELATION = 1.0  # s over which an error of the matrix looks like noise to the filter


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """One step of the robot, as odometry and filter take it.

    moved (3,): in the robot's frame, m, m, rad. variances: what the step adds to those of position (m2, each axis) and
    heading (rad2).
    """

    stamp: int
    duration: float
    moved: Array
    integration: Integration
    position_variance: float
    heading_variance: float
    restarted: bool = False

    def part(self, share: float) -> Motion:
        """A share of the motion, at constant twist."""
        return Motion(
            self.stamp,
            share * self.duration,
            share * self.moved,
            self.integration,
            share * self.position_variance,
            share * self.heading_variance,
        )


class LiveOdometry:
    """Pose and twist of one robot with covariances; they never jump, also when the calibration is swapped.

    The covariance is the sum of what the noise model's random walk adds along the way (bent by the heading's own error)
    and of the uncertainty of the matrix, which errs in the same way all the time and therefore adds up.

    standstill: share of the noise that is left while no wheel turns.
    """

    def __init__(self, calibration: Calibration, standstill: float = 0.01) -> None:
        self._standstill = standstill
        self._walked = np.zeros((3, 3))
        self._stream = calibration.model.stream()
        self.twist: Array = np.zeros(3)
        self._rates: Array = np.zeros(len(calibration.robot.wheels))
        self._duration = calibration.sample_period
        self._use(calibration)

    @property
    def pose(self) -> Array:
        """(3,): m, m, rad; the heading is not wrapped."""
        return self._stream.pose

    @property
    def covariance(self) -> Array:
        """Of the pose, (3, 3)."""
        if self._elements is None:
            return self._walked.copy()
        slopes = self._slopes.reshape(3, -1)
        return self._walked + slopes @ self._elements @ slopes.T

    @property
    def twist_covariance(self) -> Array:
        """Of the twist, (3, 3), in the robot's frame."""
        per_second = 1.0 / self._duration
        diagonal = np.array([self._position_walk, self._position_walk, self._heading_walk]) * per_second
        return np.diag(diagonal + self._matrix_variances())

    def resume(self, pose: Array, covariance: Array) -> None:
        """Go on from a pose and covariance that another process reached."""
        self._stream.pose = np.array(pose, dtype=float)
        self._walked = np.array(covariance, dtype=float)
        self._slopes[:] = 0.0

    def swap(self, calibration: Calibration) -> None:
        """Go on with another calibration from the same pose; what is uncertain by now stays uncertain."""
        pose, walked = self.pose, self.covariance
        self._stream = calibration.model.stream(pose)
        self._walked = np.array(walked)
        self._use(calibration)

    def _use(self, calibration: Calibration) -> None:
        noise = calibration.noise or UNKNOWN_NOISE
        self._position_walk = noise.walk_position**2 or UNKNOWN_NOISE.walk_position**2 / 100
        self._heading_walk = noise.walk_heading**2 or UNKNOWN_NOISE.walk_heading**2 / 100
        wheels = len(calibration.robot.wheels)
        self._elements = None
        self._blocks = np.zeros((3, wheels, wheels))
        if calibration.covariance is not None:
            self._elements = np.array(calibration.covariance)[: 3 * wheels, : 3 * wheels]
            by_row = self._elements.reshape(3, wheels, 3, wheels)
            self._blocks = np.stack([by_row[row, :, row] for row in range(3)])
        self._slopes = np.zeros((3, 3, wheels))  # of the pose on the matrix's elements

    def step(self, step: WheelStep) -> Motion:
        """Take a wheel step; the motion that it made."""
        before = self._stream.pose
        self._stream.drive(step.angles)
        moved = self._stream.moved
        if step.duration > 0:
            self._rates = step.angles / step.duration
            self.twist = moved / step.duration
            self._duration = step.duration
        position, heading = self._variances(step, moved)
        self._spread(self._stream.pose - before, step.angles, position, heading)
        return Motion(
            step.stamp, step.duration, moved, self._stream.integration, *self._of_filter(step, position, heading)
        )

    def grown(self, seconds: float) -> Array:
        """The covariance after so long without any news, the robot having done what it last did, or not."""
        position = (_BLIND_SHARE * math.hypot(self.twist[0], self.twist[1]) * seconds) ** 2
        heading = (_BLIND_SHARE * abs(float(self.twist[2])) * seconds) ** 2
        growth = [
            position + self._position_walk * seconds,
            position + self._position_walk * seconds,
            heading + self._heading_walk * seconds,
        ]
        return self.covariance + np.diag(growth)

    def _variances(self, step: WheelStep, moved: Array) -> tuple[float, float]:
        """What the step's noise adds to the variances of position and heading."""
        still = np.abs(step.angles).max() <= _STILL * step.duration
        share = self._standstill if still and not step.blind else 1.0
        position, heading = share * self._position_walk * step.duration, share * self._heading_walk * step.duration
        if step.blind:
            if step.counted:
                length, turn = math.hypot(moved[0], moved[1]), 0.0
            else:
                length = math.hypot(self.twist[0], self.twist[1]) * step.blind
                turn = abs(float(self.twist[2])) * step.blind
            position += (_BLIND_SHARE * length) ** 2
            heading += (_BLIND_SHARE * turn) ** 2
        return position, heading

    def _of_filter(self, step: WheelStep, position: float, heading: float) -> tuple[float, float, bool]:
        """The same for a filter that has no memory: an error of the matrix looks like noise to it."""
        along_x, along_y, turning = (self._matrix_variances() * (_CORRELATION * step.duration)).tolist()
        return position + (along_x + along_y) / 2, heading + turning, step.restarted

    def _matrix_variances(self) -> Array:
        """Variances (3,) of the twist by the matrix's uncertainty."""
        return (self._blocks @ self._rates) @ self._rates

    def _spread(self, path: Array, angles: Array, position: float, heading: float) -> None:
        """Carry the covariance along a path (3,) in the world's frame."""
        across, along = -float(path[1]), float(path[0])
        walked = self._walked
        walked[0] += across * walked[2]
        walked[1] += along * walked[2]
        walked[:, 0] += across * walked[:, 2]
        walked[:, 1] += along * walked[:, 2]
        walked[0, 0] += position
        walked[1, 1] += position
        walked[2, 2] += heading
        if self._elements is None:
            return
        slopes, half = self._slopes, angles / 2 if self._stream.integration == "arc" else 0.0
        direction = self._stream.pose[2] - (path[2] / 2 if self._stream.integration == "arc" else path[2])
        cosine, sine = math.cos(direction), math.sin(direction)
        slopes[0] += across * slopes[2]
        slopes[1] += along * slopes[2]
        slopes[0, 0] += cosine * angles
        slopes[0, 1] -= sine * angles
        slopes[1, 0] += sine * angles
        slopes[1, 1] += cosine * angles
        slopes[0, 2] += across * half
        slopes[1, 2] += along * half
        slopes[2, 2] += angles
