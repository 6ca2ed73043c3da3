"""Counters of a robot's inputs: everything that was taken, refused or put right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

from omnibench.words import plural


@dataclass(slots=True)
class Counts:
    """Counters since the start, in the order in which diagnostics show them."""

    samples: int = 0  # wheel samples taken
    missing: int = 0  # wheel samples that never came, by the stamps of those that did
    irregular: int = 0  # periods off the mean by a quarter or more, missing samples aside
    duplicates: int = 0  # samples with a stamp that was taken already
    late: int = 0  # samples out of order: a newer one had been taken
    gaps: int = 0  # silences longer than max_gap
    clock_jumps: int = 0  # the stamps went on somewhere else
    bad_stamps: int = 0  # stamps far from the last one, which the next ones did not confirm
    wraps: int = 0  # angles that started again after a turn of the counter
    counter_restarts: int = 0  # angles that started again elsewhere, or moved faster than max_rate
    not_finite: int = 0  # NaN or infinity among angles and rates
    too_fast: int = 0  # samples with rates beyond max_rate
    wrong_joints: int = 0  # a wheel is not among the names, or has neither angle nor rate
    undecodable: int = 0  # wheel messages that are no sensor_msgs/JointState
    poses: int = 0  # SLAM poses that were fused
    pose_rejected: int = 0  # SLAM poses too far from the expected one, by the gate
    pose_too_late: int = 0  # older than the history
    pose_ahead: int = 0  # stamps in the future, or more than can wait for their wheel samples
    pose_duplicates: int = 0
    pose_invalid: int = 0  # not finite, no covariance, wrong frame
    pose_undecodable: int = 0  # not a geometry_msgs/PoseWithCovarianceStamped
    reacquired: int = 0  # times that the filter gave up its pose for SLAM's
    swaps: int = 0  # calibrations taken
    swaps_refused: int = 0
    failures: int = 0  # errors of omnibench itself while it took a message; each is logged

    def as_dict(self) -> dict[str, int]:
        """Names and values."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def anomalies(self) -> dict[str, int]:
        """The counters above 0 of what should not happen."""
        usual = ("samples", "poses", "swaps", "wraps")
        return {name: value for name, value in self.as_dict().items() if value and name not in usual}


_WORDS = {  # noun, and what follows it, of the counters in ``Counts.anomalies``
    "missing": ("wheel sample", "missing"),
    "irregular": ("wheel sample", "at irregular times"),
    "duplicates": ("wheel sample", "twice"),
    "late": ("wheel sample", "out of order"),
    "gaps": ("gap", "longer than max_gap"),
    "clock_jumps": ("jump", "of the wheel samples' clock"),
    "bad_stamps": ("wheel sample", "with an unlikely stamp"),
    "counter_restarts": ("restart", "of a wheel's counter"),
    "not_finite": ("wheel sample", "not finite"),
    "too_fast": ("wheel sample", "faster than max_rate"),
    "wrong_joints": ("wheel sample", "without all wheels"),
    "undecodable": ("wheel message", "undecodable"),
    "pose_rejected": ("pose", "refused by the gate"),
    "pose_too_late": ("pose", "older than the history"),
    "pose_ahead": ("pose", "ahead of the wheel samples"),
    "pose_duplicates": ("pose", "twice"),
    "pose_invalid": ("pose", "invalid"),
    "pose_undecodable": ("pose message", "undecodable"),
    "reacquired": ("restart", "of the filter at SLAM's pose"),
    "swaps_refused": ("calibration", "refused"),
    "failures": ("error", "of omnibench"),
}


def anomalies_in_words(anomalies: Mapping[str, int]) -> str:
    """Anomalies by their counters' names as a list in words: ``3 wheel samples missing, 1 pose invalid``."""
    worded = ((count, *_WORDS[name]) for name, count in anomalies.items())
    return ", ".join(f"{plural(count, noun)} {rest}" for count, noun, rest in worded)
