"""The guard on a recording: its runs one after another, as a robot would have driven them."""

from __future__ import annotations

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.live.guard import LEAST_POSES, Guard


def watch(guard: Guard, run: Trajectory) -> None:
    """Let the guard watch a run."""
    calibration = guard.calibration
    stream = calibration.model.stream(run.start, calibration.session, run.started_at or 0.0)
    durations = np.diff(run.times, prepend=0.0)
    moved, driven = np.zeros((len(durations), 3)), np.zeros((len(durations), calibration.matrix_array.shape[1]))
    for k, duration in enumerate(durations):
        angles = None if run.angles is None else run.angles[k]
        steering = None if run.steering is None else run.steering[k]
        stream.drive(run.rates[k] * duration, float(duration), angles, steering)
        moved[k], driven[k] = stream.moved, stream.driven
    # Poses that are far enough apart.
    chosen = [0]
    for k in range(1, len(run.pose_times)):
        if run.pose_times[k] - run.pose_times[chosen[-1]] >= LEAST_POSES:
            chosen.append(k)
    stamps = run.pose_times[chosen]
    guard.begin(run.poses[0], None if run.pose_covariances is None else run.pose_covariances[0])
    begins = run.times - durations
    for previous, k in zip(chosen, chosen[1:]):
        t0, t1 = run.pose_times[previous], run.pose_times[k]
        first = int(np.searchsorted(run.times, t0, side="right"))
        last = int(np.searchsorted(begins, t1, side="left"))
        if last <= first:
            continue
        low, high = np.maximum(begins[first:last], t0), np.minimum(run.times[first:last], t1)
        seconds = high - low
        share = (seconds / durations[first:last])[:, None]
        stretch = guard.predictor.stretch(moved[first:last] * share, driven[first:last] * share, seconds)
        covariance = None if run.pose_covariances is None else run.pose_covariances[k]
        guard.take(stretch, run.poses[k], (run.id, float(t1)), covariance)
