"""Health of a robot's stream: status, reason, figures and counters of its inputs, as JSON and ROS 2 diagnostics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from omnibench.config import Model
from omnibench.live.wire import Diagnostic

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


def _anomaly(words: str) -> Any:
    """A counter of what should not happen, with what messages call it."""
    return field(default=0, metadata={"words": words})


@dataclass(slots=True)
class Counts:
    """Counters since the start, in the order in which diagnostics show them."""

    samples: int = 0  # wheel samples taken
    missing: int = _anomaly("wheel samples missing")  # it never came, by the numbers or stamps of those that did
    irregular: int = _anomaly("wheel samples at irregular times")  # off the mean period by a quarter or more
    duplicates: int = _anomaly("wheel samples twice")  # its stamp was taken already
    late: int = _anomaly("wheel samples out of order")  # a newer one had been taken
    gaps: int = _anomaly("gaps longer than max_gap")
    clock_jumps: int = _anomaly("jumps of the wheel samples' clock")  # the stamps went on somewhere else
    bad_stamps: int = _anomaly("wheel samples with an unlikely stamp")  # the next stamps did not confirm it
    wraps: int = 0  # angles that started again after a turn of the counter
    counter_restarts: int = _anomaly("restarts of a wheel's counter, or jumps beyond max_rate")
    not_finite: int = _anomaly("wheel samples not finite")  # NaN or infinity among angles and rates
    too_fast: int = _anomaly("wheel samples faster than max_rate")
    wrong_joints: int = _anomaly("wheel samples without all wheels")  # by name, or without angle and rate
    no_steering: int = _anomaly("wheel samples before the first steering angles")
    old_steering: int = _anomaly("wheel samples with old steering angles")  # beyond max_steering_age: these are held
    bad_steering: int = _anomaly("steering angles too large")  # mostly a car's in degrees
    undecodable: int = _anomaly("wheel messages undecodable")  # no sensor_msgs/JointState
    poses: int = 0  # SLAM poses that were fused
    pose_rejected: int = _anomaly("poses refused by the gate")  # too far from the expected one
    pose_too_late: int = _anomaly("poses older than the history")
    pose_ahead: int = _anomaly("poses ahead of the wheel samples")  # or more than can wait for them
    pose_duplicates: int = _anomaly("poses twice")
    pose_invalid: int = _anomaly("poses invalid")  # not finite, too far away, wrong frame
    pose_default_covariance: int = 0  # fused with pose_sigma or the calibration's, as the message's is unknown
    pose_undecodable: int = _anomaly("pose messages undecodable")  # no geometry_msgs/PoseWithCovarianceStamped
    reacquired: int = _anomaly("restarts of the filter at SLAM's pose")  # it gave up its own
    swaps: int = 0  # calibrations taken
    swaps_refused: int = _anomaly("calibrations refused")
    unpublished: int = _anomaly("odometry messages not published")  # late, or by a killed node already
    overflow: int = _anomaly("messages not taken")  # too many were waiting
    failures: int = _anomaly("errors of omnibench")  # while it took a message; each is logged

    def as_dict(self) -> dict[str, int]:
        """Names and values."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def anomalies(self) -> dict[str, int]:
        """The counters above 0 of what should not happen."""
        return anomalies_among(self.as_dict())


_WORDS = {item.name: item.metadata["words"] for item in fields(Counts) if item.metadata}


def anomalies_among(counts: Mapping[str, Any]) -> dict[str, int]:
    """The counters of anomalies that are not 0, from all counters of a node, be it of another version."""
    return {name: int(value) for name, value in counts.items() if name in _WORDS and int(value)}


def anomalies_in_words(anomalies: Mapping[str, int]) -> str:
    """Anomalies by their counters' names as a list: ``wheel samples missing: 3, poses invalid: 1``."""
    return ", ".join(f"{_WORDS[name]}: {count:,}" for name, count in anomalies.items())
