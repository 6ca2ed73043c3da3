"""The guard on a recording: its runs one after another, as the robot drove them, in one state."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from omnibench.config import Model
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.errors import DataError, require_type
from omnibench.live.guard import LEAST_POSES, Alarm, Guard, Proposal
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.robot.calibration import Calibration
from omnibench.robot.effects.effect import ReferenceEffect
from omnibench.robot.kinematics import Array
from omnibench.words import plural


class GuardReport(Model):
    """What a guard told of a recording. metres, seconds: driven between poses, standing included."""

    alarms: tuple[Alarm, ...]
    proposals: tuple[Proposal, ...]
    metres: float
    seconds: float


def watch_recording(
    calibration: Calibration, dataset: Dataset, watch: Reporter = no_progress
) -> tuple[GuardReport, Guard]:
    """Let a guard watch all runs of a data set, sessions in their order; its report, and the guard.

    DataError: the wheels differ, no run has reference poses, or the recordings lack what an effect needs.

    >>> report, _ = watch_recording(calibration, dataset)
    >>> report.alarms
    ()
    """
    require_type(calibration, Calibration, "read_calibration")
    require_type(dataset, Dataset, "load_dataset")
    calibration.check_wheels(dataset.robot, f"the data set {dataset.name}")
    sessions: dict[str | None, list[Trajectory]] = {}
    for run in dataset.trajectories:
        if run.has_poses and len(run.pose_times) > 1:
            sessions.setdefault(run.session, []).append(run)
    if not sessions:
        raise DataError(f"data set {dataset.name}: no run has two reference poses, with which a guard compares motion")
    for runs in sessions.values():
        if all(run.started_at is not None for run in runs):
            runs.sort(key=lambda run: run.started_at or 0.0)
    ordered = [run for runs in sessions.values() for run in runs]
    guard = Guard(calibration)
    for number, run in enumerate(ordered, 1):
        _watch_run(guard, run)
        watch(Progress("guard", number, len(ordered), "run", note=plural(len(guard.alarms), "alarm")))
    guard.end()
    return GuardReport(
        alarms=tuple(guard.alarms), proposals=tuple(guard.proposals), metres=guard.metres, seconds=guard.seconds
    ), guard


def _watch_run(guard: Guard, run: Trajectory) -> None:
    """Let a guard watch a run from its first reference pose to its last."""
    calibration = guard.calibration
    stream = calibration.model.stream(run.start, calibration.session, run.started_at or 0.0)
    durations = np.diff(run.times, prepend=0.0)
    begins, rates, angles, steering = run.times - durations, run.rates, run.angles, run.steering
    moved, driven = np.zeros((len(durations), 3)), np.zeros((len(durations), calibration.matrix_array.shape[1]))
    for k, duration in enumerate(durations.tolist()):
        stream.drive(
            rates[k] * duration,
            duration,
            None if angles is None else angles[k],
            None if steering is None else steering[k],
        )
        moved[k], driven[k] = stream.moved, stream.driven
    stamps, poses = _true_poses(calibration, run)
    chosen = [0]
    for k in range(1, len(stamps)):
        if stamps[k] - stamps[chosen[-1]] >= LEAST_POSES and stamps[k] <= run.times[-1]:
            chosen.append(k)
    covariances = run.pose_covariances
    guard.begin(poses[0], None if covariances is None else covariances[0])
    for previous, k in pairwise(chosen):
        since, until = float(stamps[previous]), float(stamps[k])
        part = slice(np.searchsorted(run.times, since, side="right"), np.searchsorted(begins, until))
        seconds = np.minimum(run.times[part], until) - np.maximum(begins[part], since)
        share = (seconds / durations[part])[:, None]
        stretch = guard.predictor.stretch(moved[part] * share, driven[part] * share, seconds)
        guard.take(stretch, poses[k], (run.id, until), None if covariances is None else covariances[k])


def _true_poses(calibration: Calibration, run: Trajectory) -> tuple[Array, Array]:
    """Stamps (S,), s, and poses (S, 3) of a run's reference without the calibration's effects on it."""
    stamps, poses = run.pose_times, run.poses
    for term in reversed(calibration.model.reference_terms):
        assert isinstance(term.effect, ReferenceEffect)
        stamps = stamps - term.effect.delays(stamps, term.values)[0]
        poses = term.effect.corrected(poses, run.start, term.values)
    return np.maximum(stamps, 0.0), poses
