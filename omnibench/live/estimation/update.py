"""Update: the estimates after one wheel sample, from which every output is made."""

from __future__ import annotations

from dataclasses import dataclass

from omnibench.robot.kinematics import Array


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
