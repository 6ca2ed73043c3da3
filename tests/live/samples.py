"""Messages with numbers that no default has, one for each topic."""

from __future__ import annotations

from typing import Any

import numpy as np

from omnibench.live.wire.messages import Diagnostic, Diagnostics, JointState, Odometry, PoseEstimate, Transform

STAMP = 1_700_000_000_123_456_789
PERIOD = 10_000_000  # ns
COVARIANCE = np.array([[4e-4, 1e-5, 2e-5], [1e-5, 9e-4, 3e-5], [2e-5, 3e-5, 1.6e-3]])


def odometry(k: int = 0, frame: str = "odom") -> Odometry:
    """The k-th message of a robot that moves."""
    return Odometry(
        STAMP + k * PERIOD,
        frame,
        "base_link",
        np.array([1.25 + 0.01 * k, -2.5, 0.7 + 0.001 * k]),
        COVARIANCE,
        np.array([0.31, -0.12, 0.45]),
        2 * COVARIANCE,
    )


def sample(topic: str, k: int = 0) -> Any:
    """The k-th message of any topic of TOPICS."""
    stamp = STAMP + k * PERIOD
    messages: dict[str, Any] = {
        "joint_states": JointState(
            stamp, ("a", "b", "c"), np.array([0.1, 0.2, 0.3]) * (k + 1), np.array([1.5, -2.5, 3.5])
        ),
        "slam_pose": PoseEstimate(stamp, "map", np.array([3.5, -1.25, -2.1]), COVARIANCE),
        "odom": odometry(k),
        "odometry/filtered": odometry(k, "map"),
        "diagnostics": Diagnostics(
            stamp, (Diagnostic("odometry", 1, "late samples", "apr02", (("late", "3"), ("rate_hz", "99.8"))),)
        ),
        "tf": (
            Transform(stamp, "map", "odom", np.array([0.5, 0.25, 0.125])),
            Transform(stamp, "odom", "base_link", np.array([1.0, 2.0, -3.0])),
        ),
    }
    return messages[topic]
