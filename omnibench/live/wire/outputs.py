"""Outputs: the topics that a node publishes of every update, one function a topic that makes its message.

To add an output, write its function and its row in OUTPUTS; a message type that is new goes to messages.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from omnibench.live.frames import Frames
from omnibench.live.wire.messages import ODOMETRY, TRANSFORMS, MessageType, Odometry, Transform
from omnibench.live.wire.robot_messages import OdometryEncoder, TransformsEncoder
from omnibench.robot.kinematics import Array, correction


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """Estimates after one wheel sample; poses (3,) in m, m, rad, twists (3,) in m/s, m/s, rad/s, covariances (3, 3).

    stamp: ns, never published before. pose, covariance: of the robot in odom. twist, twist_covariance: in the robot's
    frame. in_map: fused pose and its covariance; None without fusion.
    """

    stamp: int
    pose: Array
    covariance: Array
    twist: Array
    twist_covariance: Array
    in_map: tuple[Array, Array] | None = None


@dataclass(frozen=True)
class Output:
    """One topic that is published of every update.

    topic: below the robot's name. message: makes a message from an update. fused: only where SLAM poses are fused.
    encoder: makes, for a robot's frames, a function that encodes messages faster than ``message_type`` does.
    """

    topic: str
    message_type: MessageType[Any]
    message: Callable[[Update, Frames], Any]
    fused: bool = False
    encoder: Callable[[Frames], Callable[[Any], bytes]] | None = None

    def encoding(self, frames: Frames) -> Callable[[Update], bytes]:
        """The function from an update to its payload in CDR, for a robot with these frames."""
        message, encode = self.message, self.encoder(frames) if self.encoder else self.message_type.encode
        return lambda update: encode(message(update, frames))


def odometry(update: Update, frames: Frames) -> Odometry:
    """Pose in odom, which never jumps, and twist."""
    return Odometry(
        update.stamp, frames.odom, frames.base, update.pose, update.covariance, update.twist, update.twist_covariance
    )


def filtered_odometry(update: Update, frames: Frames) -> Odometry:
    """Pose in the map, fused with SLAM, and twist."""
    pose, covariance = _in_map(update)
    return Odometry(update.stamp, frames.map, frames.base, pose, covariance, update.twist, update.twist_covariance)


def transforms(update: Update, frames: Frames) -> tuple[Transform, Transform]:
    """From map to odom, and from odom to the robot."""
    pose, _ = _in_map(update)
    return (
        Transform(update.stamp, frames.map, frames.odom, correction(pose, update.pose)),
        Transform(update.stamp, frames.odom, frames.base, update.pose),
    )


OUTPUTS: Final = (
    Output(
        "odom",
        ODOMETRY,
        odometry,
        encoder=lambda frames: OdometryEncoder(frames.odom, frames.base).encode,
    ),
    Output(
        "odometry/filtered",
        ODOMETRY,
        filtered_odometry,
        fused=True,
        encoder=lambda frames: OdometryEncoder(frames.map, frames.base).encode,
    ),
    Output(
        "tf",
        TRANSFORMS,
        transforms,
        fused=True,
        encoder=lambda frames: TransformsEncoder(((frames.map, frames.odom), (frames.odom, frames.base))).encode,
    ),
)


def _in_map(update: Update) -> tuple[Array, Array]:
    if update.in_map is None:
        raise ValueError("this output needs fusion, and the update has no pose in the map")
    return update.in_map
