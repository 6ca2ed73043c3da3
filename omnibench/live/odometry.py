"""Odometry with its covariance, one wheel step at a time, from a calibration's model and noise.

The covariance P of the pose (x, y, heading) has these parts, P = W + J C J^T + E E^T:                           (L1)

- W is that of a random walk: each step adds the noise model's variances and carries W along, W <- F W F^T + Q, with F
  the derivative of the pose after the step with respect to the pose before it.                                 (L2)
- C is the covariance of the matrix's elements, J the derivative of the pose with respect to them. The matrix errs in
  the same way all the time, so that J adds up along the way.                                                   (L3)
- E are the deviations of the pose by those of motions that effects extrapolate, Eq. (3) of robot/corrections.py; these
  are the same all the time, too, and add up as J does.                                                         (L4)

The matrix moves the tracked point. Where that is mounted off the robot's centre, W and J are of its pose, and what is
told is of the centre.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from typing import NamedTuple

import numpy as np

from omnibench.live.wheels import WheelStep
from omnibench.robot.calibration import Calibration, Noise
from omnibench.robot.corrections import TrainingDomain, extrapolation_consequence
from omnibench.robot.kinematics import Array, Mount, compose, relative, unit_twist
from omnibench.robot.odometry import Integration, OdometryStream


class RobotCentre:
    """The centre of a robot whose tracked point lies elsewhere.

    start (3,): pose of the tracked point when the centre is at the origin, m, m, rad. of_twist (3, 3): makes the
    centre's twist of the tracked point's.
    """

    def __init__(self, mount: Mount) -> None:
        self.start = np.array([mount.x, mount.y, mount.yaw])
        self.of_twist: Array = np.linalg.inv(mount.twist)
        self._back = relative(self.start, np.zeros(3))

    def pose(self, tracked: Array) -> Array:
        """Pose (..., 3) of the centre, from that of the tracked point."""
        return compose(tracked, self._back)

    def tracked(self, centre: Array) -> Array:
        """Pose (..., 3) of the tracked point, from that of the centre."""
        return compose(centre, self.start)


def carried(covariance: Array, lever: Array) -> Array:
    """Covariance (3, 3) of the pose of another point of the same body, ``lever`` (2,), m, away in the poses' frame."""
    carry = np.eye(3)
    carry[0, 2], carry[1, 2] = -lever[1], lever[0]
    moved: Array = carry @ covariance @ carry.T
    return moved


LOG = logging.getLogger("omnibench.live")

# Noise for a calibration file without a noise model; chosen generously, so that a filter follows SLAM.
UNKNOWN_NOISE = Noise(pose_position=0.02, pose_heading=0.02, walk_position=0.03, walk_heading=0.03)
_BLIND_SHARE = 0.3  # standard deviation of a motion without samples, as a share of its length or turn; chosen
_STILL = 1e-3  # rad/s; a slower wheel counts as standing; chosen
_CORRELATION = 1.0  # s, correlation time with which the filter takes the matrix's error as noise; chosen
_REMEMBERED = 200  # steps that are replayed to a new calibration, whose effects depend on the recent motion; chosen


class Motion(NamedTuple):
    """The robot's motion in one wheel step, as the filter takes it.

    stamp: ns, at its end. duration: s. moved (3,): in the robot's frame, m, m, rad. position_variance (m2, each axis),
    heading_variance (rad2): noise that the step adds. restarted: the clock jumped before the stamp.
    """

    stamp: int
    duration: float
    moved: Array
    integration: Integration
    position_variance: float
    heading_variance: float
    restarted: bool = False

    def part(self, share: float) -> Motion:
        """The first ``share`` (0 to 1) of the motion, at constant twist."""
        position, heading = share * self.position_variance, share * self.heading_variance
        return Motion(self.stamp, share * self.duration, share * self.moved, self.integration, position, heading)


class LiveOdometry:
    """Pose and twist of a robot's centre with covariances; the pose does not jump when the calibration changes.

    Effects take the session that the calibration names as the one that is driven. Wheel angles that the sender does not
    give are counted from 0.

    standstill: share of the noise that is left while no wheel turns. pose (3,): m, m, rad; the heading is not wrapped.
    session_time: s since the session began; 0 for a new node.
    """

    def __init__(self, calibration: Calibration, standstill: float = 0.01) -> None:
        self._standstill = standstill
        self._calibration = calibration
        mount, self._drive = calibration.robot.mount, calibration.robot.drive
        self._direct = self._drive.direct
        self._centre = None if mount is None else RobotCentre(mount)
        self.session_time = 0.0
        self._stream = self._new_stream(self.session_time)
        self.pose: Array = np.zeros(3)
        self._recent: deque[WheelStep] = deque(maxlen=_REMEMBERED)
        self._wheel_angles: Array = np.zeros(len(self._drive.wheels))
        self._steering: Array | None = None  # at the end of the last step
        self._unsteered = 0.0  # m that the wheels have rolled since steering angles are held for too long
        self._radii, self._reach = calibration.robot.radii, calibration.robot.reach
        self.twist: Array = np.zeros(3)
        self._duration = calibration.sample_period
        noise = calibration.noise or UNKNOWN_NOISE
        self._position_walk = noise.walk_position**2 or UNKNOWN_NOISE.walk_position**2 / 100
        self._heading_walk = noise.walk_heading**2 or UNKNOWN_NOISE.walk_heading**2 / 100
        # W of Eq. (L2) as xx, xy, yy, xt, yt, tt: Python's floats are three times as fast as an array
        self._walk = (0.0,) * 6
        signals = len(self._drive.names)
        # J of Eq. (L3), (3, 3, M): derivatives of x, y and heading by each row of the matrix
        self._jacobian: Array = np.zeros((3, 3, signals))
        self._doubts: Array | None = None  # E (3, r) of Eq. (L4), once something was extrapolated
        self._elements: Array | None = None  # C
        self._blocks = np.zeros((3, signals, signals))  # C of each row of the matrix
        self._matrix_variances = [0.0, 0.0, 0.0]  # of the twist, by the matrix's covariance and by what is extrapolated
        if calibration.provenance is not None and calibration.provenance.on_bounds:
            LOG.warning(
                "calibration %r: %s on a bound of the box, of which no variance is known: covariances are too small",
                calibration.name,
                ", ".join(calibration.provenance.on_bounds),
            )
        if calibration.covariance is not None:
            self._elements = np.array(calibration.covariance)[: 3 * signals, : 3 * signals]
            by_row = self._elements.reshape(3, signals, 3, signals)
            self._blocks = np.stack([by_row[row, :, row] for row in range(3)])

    @property
    def driven(self) -> Array:
        """Integrals (M,) of the last step's drive signals, rad."""
        return self._stream.driven

    @property
    def tracked_motion(self) -> Array:
        """Motion (3,) of the tracked point in the last step, in its own frame, m, m, rad."""
        return self._stream.moved

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) of the pose, Eq. (L1)."""
        xx, xy, yy, xt, yt, tt = self._walk
        covariance = np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])
        if self._elements is not None:
            jacobian = self._jacobian.reshape(3, -1)
            covariance = covariance + jacobian @ self._elements @ jacobian.T
        if self._doubts is not None:
            covariance = covariance + self._doubts @ self._doubts.T
        return covariance if self._centre is None else carried(covariance, (self.pose - self._stream.pose)[:2])

    @property
    def twist_covariance(self) -> Array:
        """Covariance (3, 3) of the twist in the robot's frame."""
        position, heading = self._position_walk / self._duration, self._heading_walk / self._duration
        along_x, along_y, turning = self._matrix_variances
        covariance = np.array([[position + along_x, 0, 0], [0, position + along_y, 0], [0, 0, heading + turning]])
        if self._centre is None:
            return covariance
        of_centre: Array = self._centre.of_twist @ covariance @ self._centre.of_twist.T
        return of_centre

    def silence_covariance(self, seconds: float) -> Array:
        """What a silence adds to the covariance (3, 3) of the pose: the robot may have kept its twist, or stood."""
        position = (_BLIND_SHARE * math.hypot(self.twist[0], self.twist[1]) * seconds) ** 2
        position += self._position_walk * seconds
        heading = (_BLIND_SHARE * abs(float(self.twist[2])) * seconds) ** 2 + self._heading_walk * seconds
        return np.diag([position, position, heading])

    def set_odom_heading(self, heading: float) -> None:
        """Set the heading of odom in the map, rad, along whose axes effects of the world act; at first it is 0."""
        self._stream.frame_heading = heading

    def resume(self, pose: Array, covariance: Array, session_time: float = 0.0, steering: Array | None = None) -> None:
        """Continue from the pose, covariance, session time (s) and steering (S,) that another process reached."""
        self._stream = self._new_stream(session_time)
        self.session_time = session_time
        self._begin(pose, covariance, steering)

    def continued(self, calibration: Calibration) -> LiveOdometry:
        """Odometry with another calibration from the same pose and covariance on."""
        other = LiveOdometry(calibration, self._standstill)
        begun = self.session_time - sum(step.duration for step in self._recent)
        other._stream = other._new_stream(begun)
        for step in self._recent:  # so that no effect takes the swap for a start from rest
            other._stream.drive(step.angles, step.duration, step.positions, step.steering)
        other._stream.frame_heading = self._stream.frame_heading
        other._begin(self.pose, self.covariance, self._steering)
        other.session_time, other._recent, other._wheel_angles = self.session_time, self._recent, self._wheel_angles
        other.twist, other._duration = self.twist, self._duration
        return other

    def _new_stream(self, session_time: float) -> OdometryStream:
        start = None if self._centre is None else self._centre.start
        return self._calibration.model.stream(start, self._calibration.session, session_time)

    def _begin(self, pose: Array, covariance: Array, steering: Array | None) -> None:
        self.pose = self._stream.pose = np.array(pose, dtype=float)
        if self._centre is not None:
            self._stream.pose = self._centre.tracked(self.pose)
            covariance = carried(covariance, (self._stream.pose - self.pose)[:2])
        if steering is not None:
            self._stream.steer(steering)
        self._steering = steering
        (xx, xy, xt), (_, yy, yt), (_, _, tt) = np.asarray(covariance).tolist()
        self._walk = xx, xy, yy, xt, yt, tt
        self._jacobian[:] = 0.0
        self._doubts = None

    def step(self, step: WheelStep) -> Motion:
        """Integrate a wheel step and its covariance; the motion that it made."""
        stream, centre, duration, twist = self._stream, self._centre, step.duration, self.twist
        before, centre_before = stream.pose, self.pose
        self._wheel_angles = self._wheel_angles + step.angles if step.positions is None else step.positions
        after = stream.drive(step.angles, duration, self._wheel_angles, step.steering)
        moved: Array = stream.moved
        doubts, integration = stream.doubts, stream.integration
        self._steering = step.steering
        self.session_time += duration
        self._recent.append(step)
        # Twist at the end of the step, and its variances by the matrix's covariance
        if duration > 0:
            if self._direct:
                rates = step.rates
            elif not step.blind:
                rates = stream.driven / duration
            else:
                rates = self._drive.signals(step.rates[None], None if step.steering is None else step.steering[None])[0]
            twist_now = stream.matrix @ rates if step.blind else moved / duration
            self.twist = twist_now if centre is None else centre.of_twist @ twist_now
            self._duration = duration
            variances = (self._blocks @ rates) @ rates
            if doubts is not None:
                variances = variances + np.square(doubts / duration).sum(axis=1)
            self._matrix_variances = variances.tolist()
        position, heading = self._step_variances(step, moved, twist)
        # Eq. (L2): W <- F W F^T + Q, with a path in the world's frame whose direction has the heading's error
        x, y, start = before.tolist()
        to_x, to_y, end = after.tolist()
        along_x, along_y = to_x - x, to_y - y
        xx, xy, yy, xt, yt, tt = self._walk
        self._walk = (
            xx + along_y * (along_y * tt - 2 * xt) + position,
            xy + (along_x * xt - along_y * yt - along_x * along_y * tt),
            yy + along_x * (along_x * tt + 2 * yt) + position,
            xt - along_y * tt,
            yt + along_x * tt,
            tt + heading,
        )
        if self._elements is not None or doubts is not None or self._doubts is not None:
            # Derivatives (3, 3) of the step in the world's frame by its motion in the robot's frame
            direction, half = ((start + end) / 2, 0.5) if integration == "arc" else (start, 0.0)
            cosine, sine = math.cos(direction), math.sin(direction)
            slopes = np.array([[cosine, -sine, -half * along_y], [sine, cosine, half * along_x], [0.0, 0.0, 1.0]])
            if self._elements is not None:
                # Eq. (L3): row 3 turns this step by the heading's error so far, and by half of the turn in the step
                x_by_row_3, y_by_row_3, turned = self._jacobian[:, 2]
                x_by_row_3 -= along_y * turned
                y_by_row_3 += along_x * turned
                self._jacobian += slopes[:, :, None] * stream.driven
            if doubts is not None and self._doubts is None:
                self._doubts = np.zeros_like(doubts)
            if self._doubts is not None:  # Eq. (L4)
                self._doubts[0] -= along_y * self._doubts[2]
                self._doubts[1] += along_x * self._doubts[2]
                if doubts is not None:
                    self._doubts += slopes @ doubts
        self.pose = after
        if centre is not None:
            self.pose, integration = centre.pose(after), "arc"
            moved = unit_twist(relative(centre_before, self.pose))
        # A filter has no state for the matrix: the matrix's error counts as noise.
        variance_x, variance_y, turning = self._matrix_variances
        time = _CORRELATION * duration
        position, heading = position + time * (variance_x + variance_y) / 2, heading + time * turning
        return Motion(step.stamp, duration, moved, integration, position, heading, step.restarted)

    def _step_variances(self, step: WheelStep, moved: Array, twist: Array) -> tuple[float, float]:
        """Variances of position (m2) and heading (rad2) that a step adds. twist (3,): before the step."""
        still = max(map(abs, step.angles.tolist())) <= _STILL * step.duration
        share = self._standstill if still and not step.blind else 1.0
        position, heading = share * self._position_walk * step.duration, share * self._heading_walk * step.duration
        if not step.held:
            self._unsteered = 0.0
        if step.blind:
            length, turn = math.hypot(moved[0], moved[1]), 0.0
            if not step.counted:  # the robot may have kept the twist before, had the one after, or stood
                length = step.blind * max(math.hypot(vx, vy) for vx, vy, _ in (twist, self.twist))
                turn = step.blind * max(abs(float(turning)) for _, _, turning in (twist, self.twist))
            if step.held:
                length = float(np.abs(step.angles * self._radii).max())
                turn = length / self._reach
            # where steering angles are held, every step errs in the same way as the one before
            position += _BLIND_SHARE**2 * length * (length + 2 * self._unsteered)
            heading += _BLIND_SHARE**2 * turn * (turn + 2 * self._unsteered / self._reach)
            self._unsteered += length
        return position, heading


_WINDOW = 0.5  # s, over which a twist is averaged before it is judged; chosen
_TRANSITION = 1.0  # s; a motion that lasts no longer is a transition and does not count; chosen


class ExtrapolationMonitor:
    """Counts the time that a robot drives outside its calibration's training domain; warns in the log the first time.

    seconds: the time so far; None where the calibration has no effects, or does not say what it was fitted to.
    """

    def __init__(self, robot: str, calibration: Calibration) -> None:
        self._robot, self._calibration, self._matrix = robot, calibration, calibration.matrix_array
        self._domain: TrainingDomain | None = None
        self.seconds: float | None = None
        if calibration.effects and calibration.driven:
            self._domain, self.seconds = TrainingDomain(calibration.robot, calibration.driven), 0.0
        self._lasted = 0.0  # s that the robot has now been outside the domain without a break
        # rad, integrals of the signals in the present window, and s since it began
        self._driven, self._elapsed = np.zeros(self._matrix.shape[1]), 0.0

    def take(self, step: WheelStep, driven: Array) -> None:
        """Take a wheel step with the integrals (M,) of its drive signals, rad."""
        if self._domain is None or self.seconds is None:
            return
        driven, elapsed = self._driven + driven, self._elapsed + step.duration
        if not step.blind and elapsed < _WINDOW:
            self._driven, self._elapsed = driven, elapsed
            return
        self._driven, self._elapsed = np.zeros(len(driven)), 0.0
        if step.blind:  # its motion is not known
            return
        motion = self._matrix @ driven / elapsed
        if not self._domain.is_outside(motion):
            self._lasted = 0.0
            return
        before, self._lasted = self._lasted, self._lasted + elapsed
        if self._lasted <= _TRANSITION:
            return
        if not self.seconds:
            names, fading = [term.name for term in self._calibration.effects], self._calibration.plain is not None
            LOG.warning(
                "%s: drives motions that %r was not fitted to, such as %s: %s; told once, then counted in health",
                *(self._robot, self._calibration.name, self._domain.in_words(motion[None])),
                extrapolation_consequence(names, fading=fading),
            )
        self.seconds += self._lasted if before <= _TRANSITION else elapsed
