"""Counters of a robot's inputs: everything that was taken, refused or put right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from omnibench.words import plural


def _anomaly(noun: str, rest: str) -> Any:
    """A counter of what should not happen, with its words in messages: a noun, and what follows it."""
    return field(default=0, metadata={"words": (noun, rest)})


@dataclass(slots=True)
class Counts:
    """Counters since the start, in the order in which diagnostics show them."""

    samples: int = 0  # wheel samples taken
    missing: int = _anomaly("wheel sample", "missing")  # it never came, by the numbers or stamps of those that did
    irregular: int = _anomaly("wheel sample", "at irregular times")  # off the mean period by a quarter or more
    duplicates: int = _anomaly("wheel sample", "twice")  # its stamp was taken already
    late: int = _anomaly("wheel sample", "out of order")  # a newer one had been taken
    gaps: int = _anomaly("gap", "longer than max_gap")
    clock_jumps: int = _anomaly("jump", "of the wheel samples' clock")  # the stamps went on somewhere else
    bad_stamps: int = _anomaly("wheel sample", "with an unlikely stamp")  # the next stamps did not confirm it
    wraps: int = 0  # angles that started again after a turn of the counter
    counter_restarts: int = _anomaly("restart", "of a wheel's counter, or jump beyond max_rate")
    not_finite: int = _anomaly("wheel sample", "not finite")  # NaN or infinity among angles and rates
    too_fast: int = _anomaly("wheel sample", "faster than max_rate")
    wrong_joints: int = _anomaly("wheel sample", "without all wheels")  # by name, or without angle and rate
    no_steering: int = _anomaly("wheel sample", "before the first steering angles")
    old_steering: int = _anomaly("wheel sample", "with old steering angles")  # beyond max_steering_age: these are held
    bad_steering: int = _anomaly("steering angle", "too large")  # mostly a car's in degrees
    undecodable: int = _anomaly("wheel message", "undecodable")  # no sensor_msgs/JointState
    poses: int = 0  # SLAM poses that were fused
    pose_rejected: int = _anomaly("pose", "refused by the gate")  # too far from the expected one
    pose_too_late: int = _anomaly("pose", "older than the history")
    pose_ahead: int = _anomaly("pose", "ahead of the wheel samples")  # or more than can wait for them
    pose_duplicates: int = _anomaly("pose", "twice")
    pose_invalid: int = _anomaly("pose", "invalid")  # not finite, too far away, wrong frame
    pose_default_covariance: int = 0  # fused with pose_sigma or the calibration's, as the message's is unknown
    pose_undecodable: int = _anomaly("pose message", "undecodable")  # no geometry_msgs/PoseWithCovarianceStamped
    reacquired: int = _anomaly("restart", "of the filter at SLAM's pose")  # it gave up its own
    swaps: int = 0  # calibrations taken
    swaps_refused: int = _anomaly("calibration", "refused")
    unpublished: int = _anomaly("odometry message", "not published")  # late, or by a killed node already
    overflow: int = _anomaly("message", "not taken")  # too many were waiting
    failures: int = _anomaly("error", "of omnibench")  # while it took a message; each is logged

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
    """Anomalies by their counters' names as a list in words: ``3 wheel samples missing, 1 pose invalid``."""
    worded = ((count, *_WORDS[name]) for name, count in anomalies.items())
    return ", ".join(f"{plural(count, noun)} {rest}" for count, noun, rest in worded)
