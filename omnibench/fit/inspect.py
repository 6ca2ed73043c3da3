"""What is in a data set, and what can be identified from it."""

from __future__ import annotations

import numpy as np

from omnibench.config import Model
from omnibench.data.dataset import SPLITS, Dataset, Split
from omnibench.fit.span import DrivenSpan, direction_in_words, driven_span

# Below this share of the strongest direction of wheel rates a motion is called hardly driven.
_WEAK_SHARE = 0.2


class SplitContent(Model):
    """What one split holds."""

    trajectories: int
    commands: int
    repetitions_min: int
    repetitions_max: int
    sessions: int
    duration_s: float
    distance_m: float
    turned_rad: float


class Inspection(Model):
    """A data set in numbers. Periods in s; shares are of the most driven direction of wheel rates."""

    dataset: str
    description: str
    source: str
    licence: str
    simulated: bool
    robot: str
    wheels: tuple[str, ...]
    trajectories: int
    sample_period_s: float
    sample_period_range_s: tuple[float, float]
    pose_period_s: float
    wheel_samples: int
    reference_poses: int
    has_angles: bool
    has_targets: bool
    splits: dict[str, SplitContent]
    driven_directions: int
    driven_shares: tuple[float, ...]
    undriven: tuple[str, ...]
    findings: tuple[str, ...]
    warnings: tuple[str, ...]


def inspect_dataset(dataset: Dataset) -> Inspection:
    """Count, measure, and look for directions of wheel rates that the training runs do not drive, or hardly."""
    trajectories = dataset.trajectories
    periods = np.concatenate([np.diff(t.times, prepend=0.0) for t in trajectories])
    pose_periods = np.concatenate([np.diff(t.pose_times) for t in trajectories])
    span = driven_span(dataset.split("train") or trajectories)
    undriven = tuple(direction_in_words(direction, dataset.robot.wheel_names) for direction in span.null)
    return Inspection(
        dataset=dataset.name,
        description=dataset.description,
        source=dataset.source,
        licence=dataset.licence,
        simulated=dataset.simulated,
        robot=dataset.robot.name,
        wheels=dataset.robot.wheel_names,
        trajectories=len(trajectories),
        sample_period_s=dataset.sample_period,
        sample_period_range_s=(float(periods.min()), float(periods.max())),
        pose_period_s=float(np.median(pose_periods)),
        wheel_samples=len(periods),
        reference_poses=len(pose_periods) + len(trajectories),
        has_angles=all(t.angles is not None for t in trajectories),
        has_targets=all(t.targets is not None for t in trajectories),
        splits={split: _content(dataset, split) for split in SPLITS if dataset.split(split)},
        driven_directions=len(span.driven),
        driven_shares=tuple(span.shares.tolist()),
        undriven=undriven,
        findings=tuple(_findings(dataset, span)),
        warnings=dataset.warnings,
    )


def _content(dataset: Dataset, split: Split) -> SplitContent:
    group = dataset.split(split)
    commands = [t.command for t in group if t.command is not None]
    counts = [commands.count(command) for command in sorted(set(commands))] or [1]
    return SplitContent(
        trajectories=len(group),
        commands=len(set(commands)),
        repetitions_min=min(counts),
        repetitions_max=max(counts),
        sessions=len({t.session for t in group if t.session is not None}),
        duration_s=float(sum(t.times[-1] for t in group)),
        distance_m=float(sum(np.linalg.norm(np.diff(t.poses[:, :2], axis=0), axis=1).sum() for t in group)),
        turned_rad=float(sum(np.abs(t.poses[-1, 2] - t.poses[0, 2]) for t in group)),
    )


def _findings(dataset: Dataset, span: DrivenSpan) -> list[str]:
    findings = []
    names = dataset.robot.wheel_names
    for direction in span.null:
        alone = len(names) == 4 and len(span.null) == 1
        expected = ", as for any robot on four wheels that does not slip" if alone else ""
        findings.append(
            f"no run drives the wheels along {direction_in_words(direction, names)}{expected}: the matrix is not "
            "determined along it, and calibration keeps the design values there"
        )
    for direction, share in zip(span.driven, span.shares, strict=False):
        if share < _WEAK_SHARE:
            words = direction_in_words(direction, names)
            findings.append(
                f"the runs hardly drive the wheels along {words} ({100 * share:.1f} % of the strongest): what the "
                "matrix says of that motion rests on slips and noise; drive it on purpose"
            )
    if not dataset.split("train"):
        findings.append("no trajectory is marked train: nothing can be calibrated")
    if not dataset.split("validation"):
        findings.append("no trajectory is marked validation: calibrations cannot be judged on other data")
    training = dataset.split("train")
    if training and all(t.command is None for t in training):
        findings.append("no commands are named: repetitions are unknown")
    return findings
