"""State of a robot as its messages give it: newest odometry, rate, age and health; also as a JSON document."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from pydantic_core import to_jsonable_python

from omnibench.live.wire.messages import Odometry


@dataclass(frozen=True)
class OdometryStatus:
    """The newest message of one odometry topic.

    rate: Hz over the last 2 s. age: s since the message arrived. stamp_age: s since its stamp, None where the sender's
    clock differs from ours. undecodable: number of messages so far that were not odometry. missed: number of messages
    since the first that were published and did not come.
    """

    message: Odometry
    rate: float | None
    age: float
    stamp_age: float | None
    undecodable: int
    missed: int = 0

    @property
    def position_sigma(self) -> float:
        """Standard deviation of the position along an axis, m: the root of the mean of x's and y's variances."""
        covariance = self.message.pose_covariance
        return math.sqrt(max(float(covariance[0, 0] + covariance[1, 1]) / 2, 0.0))

    @property
    def heading_sigma(self) -> float:
        """Standard deviation of the heading, rad."""
        return math.sqrt(max(float(self.message.pose_covariance[2, 2]), 0.0))


@dataclass(frozen=True)
class HealthSummary:
    """A robot's health as its node reports it: a word, the reason, and the counters of anomalies that are not 0."""

    status: str
    message: str
    counts: dict[str, int]


@dataclass(frozen=True)
class RobotStatus:
    """The state of one robot. presence: of its liveliness token; ``no token`` if no omnibench node runs the robot."""

    robot: str
    presence: Literal["alive", "left", "no token"]
    odom: OdometryStatus | None
    filtered: OdometryStatus | None
    health: HealthSummary | None


def json_document(status: RobotStatus) -> Any:
    """A robot's state as a JSON document: SI units, infinity and NaN as null."""
    content = {
        "robot": status.robot,
        "presence": status.presence,
        "odom": _odometry_record(status.odom),
        "filtered": _odometry_record(status.filtered),
        "health": status.health,
    }
    return to_jsonable_python(content, inf_nan_mode="null")


def _odometry_record(status: OdometryStatus | None) -> dict[str, Any] | None:
    if status is None:
        return None
    message = status.message
    return {
        "stamp": message.seconds,
        "frame": message.frame,
        "pose": message.pose.tolist(),
        "pose_covariance": message.pose_covariance.tolist(),
        "position_sigma_m": status.position_sigma,
        "heading_sigma_rad": status.heading_sigma,
        "twist": message.twist.tolist(),
        "rate_hz": status.rate,
        "age_s": status.age,
        "stamp_age_s": status.stamp_age,
        "undecodable": status.undecodable,
        "missed": status.missed,
    }
