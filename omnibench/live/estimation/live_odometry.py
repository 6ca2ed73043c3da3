"""Odometry with its covariance, one wheel step at a time: the calibration's model, and what its noise makes of it."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from omnibench.live.estimation.wheel_input import WheelStep
from omnibench.robot.calibration import Calibration, Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, OdometryStream

# For a calibration file that says nothing of noise: generous, so that a filter follows SLAM.
UNKNOWN_NOISE = Noise(pose_position=0.02, pose_heading=0.02, walk_position=0.03, walk_heading=0.03)
_BLIND_SHARE = 0.3  # of a motion whose path nobody saw
_STILL = 1e-3  # rad/s; slower wheels stand
_CORRELATION = 1.0  # s over which an error of the matrix looks like noise to the filter
_REMEMBERED = 200  # steps from which effects of another calibration learn how the robot is driving


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
    """Pose and twist of one robot with covariances; they never jump, also when the calibration changes.

    The covariance is the sum of what the noise model's random walk adds along the way (bent by the heading's own error)
    and of the uncertainty of the matrix, which errs in the same way all the time and therefore adds up.

    Effects take the session that the calibration names for the one that is driven. Where no wheel angles are told they
    are counted from 0.

    standstill: share of the noise that is left while no wheel turns. session_time: s since the session began, at first
    that of the node.
    """

    def __init__(self, calibration: Calibration, standstill: float = 0.01, session_time: float = 0.0) -> None:
        self._standstill = standstill
        self._calibration = calibration
        self._stream = self._new_stream(session_time)
        self.session_time = session_time
        self._recent: deque[WheelStep] = deque(maxlen=_REMEMBERED)
        self._wheel_angles: Array = np.zeros(len(calibration.robot.wheels))
        self.twist: Array = np.zeros(3)
        self._duration = calibration.sample_period
        noise = calibration.noise or UNKNOWN_NOISE
        self._position_walk = noise.walk_position**2 or UNKNOWN_NOISE.walk_position**2 / 100
        self._heading_walk = noise.walk_heading**2 or UNKNOWN_NOISE.walk_heading**2 / 100
        self._walked = _Walked()
        wheels = len(calibration.robot.wheels)
        self._slopes = _Slopes(wheels, calibration.integration)
        self._elements: Array | None = None
        self._blocks = np.zeros((3, wheels, wheels))
        if calibration.covariance is not None:
            self._elements = np.array(calibration.covariance)[: 3 * wheels, : 3 * wheels]
            by_row = self._elements.reshape(3, wheels, 3, wheels)
            self._blocks = np.stack([by_row[row, :, row] for row in range(3)])
        self._of_matrix = [0.0, 0.0, 0.0]  # variances of the twist by the matrix's uncertainty

    @property
    def pose(self) -> Array:
        """(3,): m, m, rad; the heading is not wrapped."""
        return self._stream.pose

    @property
    def covariance(self) -> Array:
        """Of the pose, (3, 3)."""
        if self._elements is None:
            return self._walked.covariance
        slopes = self._slopes.jacobian
        return self._walked.covariance + slopes @ self._elements @ slopes.T

    @property
    def twist_covariance(self) -> Array:
        """Of the twist, (3, 3), in the robot's frame."""
        position, heading = self._position_walk / self._duration, self._heading_walk / self._duration
        along_x, along_y, turning = self._of_matrix
        covariance = np.zeros((3, 3))
        covariance[0, 0], covariance[1, 1] = position + along_x, position + along_y
        covariance[2, 2] = heading + turning
        return covariance

    def face(self, heading: float) -> None:
        """The heading of odom in the map is ``heading`` (rad): effects of the world act along the axes of the map.

        Until it is known they act along those of odom.
        """
        self._stream.frame_heading = heading

    def resume(self, pose: Array, covariance: Array, session_time: float = 0.0) -> None:
        """Go on from a pose and covariance that another process reached, and its time in the session (s)."""
        self._stream = self._new_stream(session_time)
        self.session_time = session_time
        self._begin(pose, covariance)

    def _begin(self, pose: Array, covariance: Array) -> None:
        self._stream.pose = np.array(pose, dtype=float)
        self._walked.set(covariance)
        self._slopes.clear()

    def continued(self, calibration: Calibration) -> LiveOdometry:
        """Odometry with another calibration from the same pose on; what is uncertain by now stays uncertain."""
        other = LiveOdometry(calibration, self._standstill)
        begun = self.session_time - sum(step.duration for step in self._recent)
        other._stream = other._new_stream(begun)
        for step in self._recent:  # so that no effect takes the swap for a start from rest
            other._stream.drive(step.angles, step.duration, step.positions)
        other._stream.frame_heading = self._stream.frame_heading
        other._begin(self.pose, self.covariance)
        other.session_time, other._recent, other._wheel_angles = self.session_time, self._recent, self._wheel_angles
        other.twist, other._duration = self.twist, self._duration
        return other

    def step(self, step: WheelStep) -> Motion:
        """Take a wheel step; the motion that it made."""
        before, twist = self._stream.pose, self.twist
        positions = step.positions
        self._wheel_angles = self._wheel_angles + step.angles if positions is None else positions
        self._stream.drive(step.angles, step.duration, self._wheel_angles)
        self.session_time += step.duration
        self._recent.append(step)
        moved = self._stream.moved
        if step.duration > 0:
            self.twist = self._stream.matrix @ step.rates if step.blind else moved / step.duration
            self._duration = step.duration
            self._of_matrix = ((self._blocks @ step.rates) @ step.rates).tolist()
        position, heading = self._variances(step, moved, twist)
        self._spread(before, step.angles, position, heading)
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

    def _new_stream(self, session_time: float) -> OdometryStream:
        return self._calibration.model.stream(session=self._calibration.session, session_time=session_time)

    def _variances(self, step: WheelStep, moved: Array, twist: Array) -> tuple[float, float]:
        """What the step's noise adds to the variances of position and heading; twist: before it."""
        still = max(map(abs, step.angles.tolist())) <= _STILL * step.duration
        share = self._standstill if still and not step.blind else 1.0
        position, heading = share * self._position_walk * step.duration, share * self._heading_walk * step.duration
        if step.blind:
            length, turn = math.hypot(moved[0], moved[1]), 0.0
            if not step.counted:  # it may have gone on as before, or as after, or have stood
                length = step.blind * max(math.hypot(each[0], each[1]) for each in (twist, self.twist))
                turn = step.blind * max(abs(float(each[2])) for each in (twist, self.twist))
            position += (_BLIND_SHARE * length) ** 2
            heading += (_BLIND_SHARE * turn) ** 2
        return position, heading

    def _of_filter(self, step: WheelStep, position: float, heading: float) -> tuple[float, float, bool]:
        """The same for a filter that has no memory: an error of the matrix looks like noise to it."""
        along_x, along_y, turning = self._of_matrix
        time = _CORRELATION * step.duration
        return position + time * (along_x + along_y) / 2, heading + time * turning, step.restarted

    def _spread(self, before: Array, angles: Array, position: float, heading: float) -> None:
        """Carry the covariance along the step from the pose ``before``, and add the step's own variances."""
        x, y, start = before.tolist()
        to_x, to_y, end = self._stream.pose.tolist()
        self._walked.carry(to_x - x, to_y - y)
        self._walked.add(position, heading)
        if self._elements is not None:
            self._slopes.add(angles, to_x - x, to_y - y, start, end)


class _Walked:
    """A covariance (3, 3) of a pose, by its six numbers: in Python's own floats it is three times as fast."""

    def __init__(self) -> None:
        self._xx = self._xy = self._yy = self._xt = self._yt = self._tt = 0.0

    @property
    def covariance(self) -> Array:
        return np.array(
            [[self._xx, self._xy, self._xt], [self._xy, self._yy, self._yt], [self._xt, self._yt, self._tt]]
        )

    def set(self, covariance: Array) -> None:
        (self._xx, self._xy, self._xt), (_, self._yy, self._yt), (_, _, self._tt) = np.asarray(covariance).tolist()

    def carry(self, along_x: float, along_y: float) -> None:
        """F P F^T with the heading's error bending the path (m) in the world's frame."""
        xt, yt, tt = self._xt, self._yt, self._tt
        self._xx += along_y * (along_y * tt - 2 * xt)
        self._xy += along_x * xt - along_y * yt - along_x * along_y * tt
        self._yy += along_x * (along_x * tt + 2 * yt)
        self._xt -= along_y * tt
        self._yt += along_x * tt

    def add(self, position: float, heading: float) -> None:
        """White noise on each axis (m2) and the heading (rad2)."""
        self._xx += position
        self._yy += position
        self._tt += heading


class _Slopes:
    """Derivatives of the pose with respect to the matrix, to first order in the turn of one step.

    jacobian (3, 3N): of (x, y, heading) on the elements row by row.
    """

    def __init__(self, wheels: int, integration: Integration) -> None:
        self._arc = integration == "arc"
        self.jacobian = np.zeros((3, 3 * wheels))
        self._by_row = self.jacobian.reshape(3, 3, wheels)

    def clear(self) -> None:
        self.jacobian[:] = 0.0

    def add(self, angles: Array, along_x: float, along_y: float, start: float, end: float) -> None:
        """Take a step: angles (N,) rad, path (m) in the world's frame, headings at its ends (rad)."""
        direction, half = ((start + end) / 2, 0.5) if self._arc else (start, 0.0)
        cosine, sine = math.cos(direction), math.sin(direction)
        by_row = self._by_row
        turned = by_row[2, 2]
        by_row[0, 2] -= along_y * turned  # row 3 has bent the path so far, and bends this step by half of its own turn
        by_row[1, 2] += along_x * turned
        shares = ((cosine, -sine, -half * along_y), (sine, cosine, half * along_x), (0.0, 0.0, 1.0))
        by_row += np.array(shares)[:, :, None] * angles
