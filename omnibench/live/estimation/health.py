"""How a robot's stream is: one word, the reason, and the figures, as JSON and as ROS 2 diagnostics."""

from __future__ import annotations

from typing import Any, Literal

from omnibench.config import Model
from omnibench.live.wire.messages import Diagnostic

Status = Literal["ok", "waiting", "stale", "degraded"]
_LEVELS: dict[Status, int] = {"ok": 0, "waiting": 1, "degraded": 1, "stale": 3}


class FusionHealth(Model):
    """How fusing goes. pose_age_s: since the last pose that was fused came."""

    located: bool
    pose_age_s: float | None
    last_outcome: str | None
    rejected_in_a_row: int


class SwapRecord(Model):
    """What became of the last calibration that was sent."""

    accepted: bool
    name: str | None
    reason: str
    at: float  # unix time, s


class Health(Model):
    """A robot's health, as the queryable ``health`` gives it.

    rate_hz: wheel samples a second, as they came. age_s: since the last one came. position_sigma_m, heading_sigma_rad:
    standard deviations now, growing while nothing comes. unfitted_motion_s: for how long the robot has driven motions
    that the effects of its calibration were not fitted to, where these are known.
    """

    robot: str
    status: Status
    message: str
    calibration: str
    simulated: bool
    rate_hz: float
    age_s: float | None
    last_stamp: float | None
    position_sigma_m: float
    heading_sigma_rad: float
    fusion: FusionHealth | None
    counts: dict[str, int]
    last_refusal: str
    last_swap: SwapRecord | None
    unfitted_motion_s: float | None = None


def diagnostic(health: Health, hardware: str) -> Diagnostic:
    """The same for ``<robot>/diagnostics``."""
    values: dict[str, Any] = {
        "calibration": health.calibration,
        "rate_hz": f"{health.rate_hz:.1f}",
        "age_s": "-" if health.age_s is None else f"{health.age_s:.3f}",
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
