"""Inspection of a data set: its content, and which parameters its runs can identify."""

from __future__ import annotations

import numpy as np

from omnibench.config import Model
from omnibench.data.dataset import SPLITS, Dataset, Split
from omnibench.data.references import KINDS, ReferenceKind
from omnibench.data.scans import Scans
from omnibench.errors import require_type
from omnibench.fit.identifiability import Identifiability, identifiability
from omnibench.fit.span import direction_in_words, driven_span
from omnibench.robot.model import OdometryModel
from omnibench.words import plural


class SplitContent(Model):
    """Content of one split."""

    trajectories: int
    commands: int
    repetitions_min: int
    repetitions_max: int
    sessions: int
    duration_s: float
    distance_m: float
    turned_rad: float


class ScansContent(Model):
    """The scans of a data set. scan_period_s: the median. seen_share: share of the rays that measured a range."""

    trajectories: int
    scans: int
    scan_period_s: float | None
    rays: int
    field_of_view_rad: float
    range_max_m: float
    seen_share: float


class Inspection(Model):
    """A data set in numbers. references: how many there are other than poses, by kind. driven_shares: RMS along each
    direction of wheel rates, relative to the strongest.

    identifiability: how well the training runs (all runs, if none is marked train) determine the robot's parameters.
    """

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
    pose_period_s: float | None
    wheel_samples: int
    reference_poses: int
    references: dict[ReferenceKind, int]
    has_angles: bool
    has_targets: bool
    scans: ScansContent | None
    splits: dict[str, SplitContent]
    driven_directions: int
    driven_shares: tuple[float, ...]
    undriven: tuple[str, ...]
    identifiability: Identifiability
    findings: tuple[str, ...]
    warnings: tuple[str, ...]


def inspect_dataset(dataset: Dataset) -> Inspection:
    """Count and measure a data set's content, and predict how well its training runs determine the robot.

    Every scan is read; DataError names one that is broken.
    """
    require_type(dataset, Dataset, "load_dataset")
    trajectories = dataset.trajectories
    periods = np.array([[steps.min(), steps.max()] for t in trajectories for steps in [np.diff(t.times, prepend=0.0)]])
    pose_periods = np.concatenate([np.diff(t.pose_times) for t in trajectories])
    marked = dataset.split("train")
    training = marked or trajectories
    span = driven_span(training)
    identifiable = identifiability(dataset.robot, training, span=span)
    kinds = [kind for run in trajectories if run.references is not None for kind in run.references.kinds.tolist()]
    findings = list(identifiable.sentences)
    if not marked:
        findings.append("no trajectory is marked train: nothing can be calibrated")
    if not dataset.split("validation"):
        findings.append("no trajectory is marked validation: calibrations cannot be judged on other data")
    if marked and all(t.command is None for t in marked):
        findings.append("no commands are named: repetitions are unknown")
    scanned = None if dataset.scans is None else set(dataset.scans.trajectories)
    if bare := [run.id for run in trajectories if scanned is not None and run.id not in scanned]:
        have = "has" if len(bare) == 1 else "have"
        findings.append(
            f"{plural(len(bare), 'trajectory')} {have} no scans, e.g. {', '.join(bare[:3])}: SLAM needs them"
        )
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
        pose_period_s=float(np.median(pose_periods)) if len(pose_periods) else None,
        wheel_samples=sum(t.samples.count for t in trajectories),
        reference_poses=len(pose_periods) + sum(run.start_known for run in trajectories),
        references={kind: kinds.count(kind) for kind in KINDS if kind in kinds},
        has_angles=all(t.angles is not None for t in trajectories),
        has_targets=all(t.targets is not None for t in trajectories),
        scans=None if dataset.scans is None else _scans(dataset.scans),
        splits={split: _content(dataset, split) for split in SPLITS if dataset.split(split)},
        driven_directions=len(span.driven),
        driven_shares=tuple(span.shares.tolist()),
        undriven=tuple(direction_in_words(direction, dataset.robot.drive.names) for direction in span.null),
        identifiability=identifiable,
        findings=tuple(findings),
        warnings=dataset.warnings,
    )


def _content(dataset: Dataset, split: Split) -> SplitContent:
    group = dataset.split(split)
    commands = [t.command for t in group if t.command is not None]
    design = OdometryModel.of_design(dataset.robot, "arc")  # which drives the runs that have no poses
    paths = [t.poses if t.has_poses else design.poses([t.log(t.times)])[0] for t in group]
    counts = [commands.count(command) for command in sorted(set(commands))] or [1]
    return SplitContent(
        trajectories=len(group),
        commands=len(set(commands)),
        repetitions_min=min(counts),
        repetitions_max=max(counts),
        sessions=len({t.session for t in group if t.session is not None}),
        duration_s=float(sum(t.samples.end for t in group)),
        distance_m=float(sum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum() for path in paths)),
        turned_rad=float(sum(np.abs(path[-1, 2] - path[0, 2]) for path in paths)),
    )


def _scans(scans: Scans) -> ScansContent:
    scanner = scans.scanner
    periods, count, seen = [np.zeros(0)], 0, 0
    for _, of_run in scans:
        periods.append(np.diff(of_run.times))
        count += len(of_run.times)
        seen += sum(int(scanner.valid(ranges).sum()) for ranges in of_run.ranges)
    steps = np.concatenate(periods)
    return ScansContent(
        trajectories=len(scans.trajectories),
        scans=count,
        scan_period_s=float(np.median(steps)) if len(steps) else None,
        rays=scanner.rays,
        field_of_view_rad=abs(scanner.angle_increment) * (scanner.rays - 1),
        range_max_m=scanner.range_max,
        seen_share=seen / max(count * scanner.rays, 1),
    )
