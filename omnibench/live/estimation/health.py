"""Health of a robot's stream: status, reason and figures, as JSON and as ROS 2 diagnostics."""

from __future__ import annotations

from typing import Any, Literal

from omnibench.config import Model
from omnibench.live.wire.messages import Diagnostic

Status = Literal["ok", "waiting", "stale", "degraded"]
_LEVELS: dict[Status, int] = {"ok": 0, "waiting": 1, "degraded": 1, "stale": 3}


class FusionHealth(Model):
    """Health of the fusion. located: SLAM has said where the robot is. pose_age_s: since the last fused pose came."""

    located: bool
    pose_age_s: float | None
    last_outcome: str | None
    rejected_in_a_row: int


class SwapRecord(Model):
    """Outcome of the last calibration that was sent."""

    accepted: bool
    name: str | None
    reason: str
    at: float  # unix time, s


class Health(Model):
    """A robot's health, as the query ``health`` answers it.

    rate_hz: wheel samples a second. age_s: since the last one came. behind_s: the longest time that samples have waited
    in the last second, where they come faster than they can be taken. position_sigma_m, heading_sigma_rad: standard
    deviations now; they grow while no sample comes. unfitted_motion_s: time outside the training domain of the
    calibration's effects, where that is known.
    """

    robot: str
    status: Status
    message: str
    calibration: str
    simulated: bool
    rate_hz: float
    age_s: float | None
    behind_s: float
    last_stamp: float | None
    position_sigma_m: float
    heading_sigma_rad: float
    fusion: FusionHealth | None
    counts: dict[str, int]
    last_refusal: str
    last_swap: SwapRecord | None
    unfitted_motion_s: float | None = None


def diagnostic(health: Health, hardware: str) -> Diagnostic:
    """A health as a status of ``<robot>/diagnostics``."""
    values: dict[str, Any] = {
        "calibration": health.calibration,
        "rate_hz": f"{health.rate_hz:.1f}",
        "age_s": "-" if health.age_s is None else f"{health.age_s:.3f}",
        "behind_s": f"{health.behind_s:.3f}",
        "position_sigma_m": f"{health.position_sigma_m:.4g}",
        "heading_sigma_rad": f"{health.heading_sigma_rad:.4g}",
        **health.counts,
    }
    if health.fusion is not None:
        values["located"] = health.fusion.located
        values["pose_age_s"] = "-" if health.fusion.pose_age_s is None else f"{health.fusion.pose_age_s:.3f}"
        values["last_outcome"] = health.fusion.last_outcome or "-"
    if health.unfitted_motion_s is not None:
        values["unfitted_motion_s"] = f"{health.unfitted_motion_s:.1f}"
    if health.last_refusal:
        values["last_refusal"] = health.last_refusal
    if health.last_swap is not None:
        values["last_swap"] = f"{'accepted' if health.last_swap.accepted else 'refused'}: {health.last_swap.reason}"
    return Diagnostic(
        f"omnibench: {health.robot} odometry",
        _LEVELS[health.status],
        health.message,
        hardware,
        tuple((key, str(value)) for key, value in values.items()),
    )
