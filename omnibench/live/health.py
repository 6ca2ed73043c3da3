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


Kind = Literal["change", "fault", "burst", "reference"]


class Alarm(Model):
    """A statement of the guard: of a change or a fault its name, value and 95 % interval; of the others their size.

    kind: a change of the robot, a fault of a wheel or its encoder, a burst that is over, or of the reference. value,
    low, high: in ``unit``. trajectory, t: when it was raised, s of that run; since, since_t: when its cause began.
    detected_after_m: m that the wheels rolled between the two. alternatives: names that explain it nearly as well, of
    which ``advice`` says how to tell them apart.
    """

    kind: Kind
    name: str
    value: float | None
    low: float | None = None
    high: float | None = None
    unit: str
    trajectory: str
    t: float
    since: str
    since_t: float
    detected_after_m: float
    alternatives: tuple[str, ...] = ()
    advice: str = ""

    @property
    def sentence(self) -> str:
        """The alarm in words: what, how much, or what else it may be and how to tell."""
        size = "" if self.value is None else f" of {number_with_unit(self.value, self.unit)}"
        if self.low is not None and self.high is not None:
            size = f"{size.replace(' of', ' is')} ({self.low:.5g} to {self.high:.5g})"
        if self.alternatives:
            return f"{self.name}{size}, or {', '.join(self.alternatives)}: {self.advice}"
        return f"{self.name}{size}"


def number_with_unit(value: float, unit: str) -> str:
    """A value with its unit; 1 is none."""
    return f"{value:.5g}" + ("" if unit == "1" else f" {unit}")


class HeldOut(Model):
    """A proposal judged by motion after it was made. log_e: log of the likelihood ratio; ratio: of the errors."""

    metres: float
    log_e: float
    error_ratio: float | None


class Proposal(Model):
    """A parameter with a new value, in shadow beside the calibration's. accepted: None while it is not decided.

    since: the run in which the change began.
    """

    name: str
    value: float
    low: float | None = None
    high: float | None = None
    accepted: bool | None = None
    rolled_back: bool = False
    reason: str = ""
    since: str = ""
    held_out: HeldOut = HeldOut(metres=0.0, log_e=0.0, error_ratio=None)

    @property
    def passed(self) -> bool:
        """True if there is no such change after all, or not any more."""
        return self.rolled_back or self.accepted is False

    @property
    def verdict(self) -> str:
        """Where the proposal stands, in one or two words."""
        verdicts = {True: "accepted", False: "rejected", None: "in shadow"}
        return "rolled back" if self.rolled_back else verdicts[self.accepted]

    @property
    def sentence(self) -> str:
        """Where the proposal stands, and why."""
        return f"{self.name} of {self.value:.6g} is {self.verdict}: {self.reason}"


class GuardHealth(Model):
    """The guard's part of a robot's health. changed: there was a change or a fault; message: the last of them.

    metres: watched so far. alarms, proposals: the latest.
    """

    changed: bool
    message: str
    metres: float
    alarms: tuple[Alarm, ...] = ()
    proposals: tuple[Proposal, ...] = ()


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
    guard: GuardHealth | None = None


def diagnostics(health: Health, hardware: str) -> tuple[Diagnostic, ...]:
    """A health as the statuses of ``<robot>/diagnostics``: of odometry and, where there is one, of the guard."""
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
    odometry = Diagnostic(
        f"omnibench: {health.robot} odometry",
        _LEVELS[health.status],
        health.message,
        hardware,
        tuple((key, str(value)) for key, value in values.items()),
    )
    if health.guard is None:
        return (odometry,)
    told = {f"{alarm.kind} {alarm.name}": f"{alarm.t:.3f} s" for alarm in health.guard.alarms}
    values = {"metres": f"{health.guard.metres:.1f}"} | told
    name, level = f"omnibench: {health.robot} guard", _LEVELS["degraded" if health.guard.changed else "ok"]
    return odometry, Diagnostic(name, level, health.guard.message, hardware, tuple(values.items()))


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
