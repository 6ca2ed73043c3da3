"""A small robot with a calibration, and the messages that it sends while it drives."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from omnibench.live.odometry import Motion
from omnibench.live.topics import Update
from omnibench.live.tracker import RobotTracker
from omnibench.live.wheels import joints_of
from omnibench.live.wire import JOINT_STATE, POSE_ESTIMATE, JointState, PoseEstimate
from omnibench.robot.calibration import Calibration, EffectTerm, Noise, covariance_rows, matrix_rows
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, WheelLog
from omnibench.testing.synthetic import synthetic_robot, true_robot

ORIGIN = 1_800_000_000_000_000_000  # ns
SECOND = 1_000_000_000
PERIOD = 0.01  # s
NOISE = Noise(pose_position=0.01, pose_heading=0.01, walk_position=0.003, walk_heading=0.003)
EXACT = np.diag([1e-4, 1e-4, 1e-4])


def calibration(
    *, scale: float = 1.0, integration: Integration = "arc", wheels: int = 3, deviation: float | None = 1e-4
) -> Calibration:
    """A calibration of the synthetic robot; scale: of its matrix. deviation: of every element."""
    robot = synthetic_robot(4 if wheels == 4 else 3)
    matrix = scale * true_robot(robot).inverse_kinematic_matrix
    return Calibration(
        name=f"synthetic {scale:g}",
        robot=robot,
        sample_period=PERIOD,
        matrix=matrix_rows(matrix),
        integration=integration,
        noise=NOISE,
        covariance=None if deviation is None else covariance_rows(deviation**2 * np.eye(3 * wheels)),
    )


def term(name: str, **parameters: float) -> EffectTerm:
    return EffectTerm(name=name, parameters=parameters)


def with_effects(*terms: EffectTerm, plain: Calibration | None = None, **changes: Any) -> Calibration:
    """A calibration with effects, of the session of the evening, without a covariance."""
    given_changes = {"effects": terms, "covariance": None, "session": "evening"}
    return (plain or calibration()).model_copy(update=given_changes | changes)


@dataclass(frozen=True, eq=False)
class Drive:
    """angles (F + 1, N) rad and, of robots that steer, steering (F + 1, S) rad, at 0 and at every period."""

    angles: Array
    calibration: Calibration
    steering: Array | None = None

    @property
    def times(self) -> Array:
        return PERIOD * np.arange(1, len(self.angles))

    @property
    def stamps(self) -> list[int]:
        return [ORIGIN, *(ORIGIN + np.round(self.times * SECOND).astype(int)).tolist()]

    @property
    def log(self) -> WheelLog:
        """The samples, with poses wanted at 0 and at every period. The baseline steers as the first sample ends."""
        rates, stamps = np.diff(self.angles, axis=0) / PERIOD, np.append(0.0, self.times)
        steered = (
            {} if self.steering is None else {"steering": self.steering[1:], "drive": self.calibration.robot.drive}
        )
        known = {"wheel_angles": self.angles[1:], "started_at": 0.0, "session": self.calibration.session}
        return WheelLog(self.times, rates, np.zeros(3), stamps, **known, **steered)

    @property
    def poses(self) -> Array:
        """Batch odometry at 0 and at every period, (F + 1, 3)."""
        return self.calibration.model.poses([self.log])[0]

    def samples(self) -> list[JointState]:
        """Every message as ros2_control sends it: positions of all joints, velocities of the wheels."""
        rates = np.vstack([np.zeros(self.angles.shape[1]), np.diff(self.angles, axis=0) / PERIOD])
        steering = np.zeros((len(rates), 0)) if self.steering is None else self.steering
        positions, velocities = np.hstack([self.angles, steering]), np.hstack([rates, np.full_like(steering, np.nan)])
        names = joints_of(self.calibration.robot).names
        return [
            JointState(stamp, names, position, velocity)
            for stamp, position, velocity in zip(self.stamps, positions, velocities, strict=True)
        ]

    def payloads(self) -> list[bytes]:
        return [JOINT_STATE.encode(sample) for sample in self.samples()]


def drive(seconds: float = 2.0, *, seed: int = 1, using: Calibration | None = None) -> Drive:
    """A lively drive: wheel rates that wander by some rad/s."""
    chosen = using or calibration()
    rng = np.random.default_rng(seed)
    count = round(seconds / PERIOD)
    times = PERIOD * np.arange(1, count + 1)
    phase = rng.uniform(0, 6, (len(chosen.robot.wheels), 1))
    rates = 1.5 * np.sin(0.8 * times + phase) + 0.7 + 0.2 * rng.standard_normal((len(phase), count))
    angles = np.vstack([np.zeros(len(phase)), np.cumsum(PERIOD * rates.T, axis=0)])
    return Drive(angles + rng.uniform(-3, 3, len(phase)), chosen)


def slam(stamp: int, pose: Array, covariance: Array = EXACT, frame: str = "map") -> bytes:
    """A pose of SLAM as it comes over the wire."""
    return POSE_ESTIMATE.encode(PoseEstimate(stamp, frame, np.asarray(pose, dtype=float), covariance))


def motion(stamp: int, moved: Array, duration: float = PERIOD, variance: float = 1e-6) -> Motion:
    """A motion of the robot's own frame."""
    return Motion(stamp, duration, np.asarray(moved, dtype=float), "arc", variance, variance)


def fed(robot: RobotTracker, payloads: list[bytes], begin: float = 0.0) -> list[Update]:
    """What a robot publishes of wheel messages that arrive one every period, from ``begin`` s on."""
    return [each for k, payload in enumerate(payloads) for each in robot.take_wheels(payload, begin + PERIOD * k)]


def odometry(updates: list[Update]) -> Array:
    """Poses (N, 3) of updates."""
    return np.array([update.pose for update in updates])
