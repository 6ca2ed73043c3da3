"""A run cut from the streams of a recording."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.alignment import align
from omnibench.data.dataset import Trajectory
from omnibench.data.importers.runs.reference_stream import ReferenceStream
from omnibench.data.importers.wheel_samples import WheelSamples

_SAME_TIME = 1e-9  # s, the resolution of stamps


@dataclass(frozen=True, eq=False)
class CutRun:
    """A run from t = 0 on, and the time of the recording that became its t = 0, s. kept: its samples' indices."""

    trajectory: Trajectory
    zero: float
    kept: NDArray[np.intp]


def cut_run(
    whole: Trajectory,
    samples: WheelSamples,
    chosen: NDArray[np.intp],
    reference: ReferenceStream,
    seen: NDArray[np.bool_] | slice,
) -> CutRun | None:
    """The run of the chosen samples and the poses that were seen then; None if there are no samples or not two poses.

    whole: the recording as a run, whose id, split and command are taken over; its arrays are replaced. A recording that
    has references of other kinds, and a start pose at most, begins with its wheels.
    """
    if not len(chosen):
        return None
    if not len(reference.times) or (len(reference.times) == 1 and reference.measured is not None):
        return _without_poses(whole, samples, chosen, reference)
    times, poses = reference.times[seen], reference.poses[seen]
    if len(times) < 2:
        return None
    aligned = align(float(samples.begins[chosen[0]]), samples.ends[chosen], times, poses)
    if aligned is None:
        return None
    kept = chosen[aligned.kept]
    shown = np.searchsorted(reference.times, aligned.pose_times + (aligned.zero - _SAME_TIME / 2))
    trajectory = replace(
        _sampled(whole, samples, kept, aligned.zero),
        pose_times=aligned.pose_times,
        poses=aligned.poses,
        pose_covariances=None if reference.covariances is None else reference.covariances[shown],
    )
    return CutRun(trajectory, aligned.zero, kept)


def _without_poses(
    whole: Trajectory, samples: WheelSamples, chosen: NDArray[np.intp], reference: ReferenceStream
) -> CutRun:
    """The run of the chosen samples, from the one pose there is or from the origin of a frame of its own."""
    zero = float(samples.begins[chosen[0]])
    start = reference.poses if len(reference.poses) else np.zeros((1, 3))
    return CutRun(
        replace(_sampled(whole, samples, chosen, zero), pose_times=np.zeros(1), poses=start, pose_covariances=None),
        zero,
        chosen,
    )


def _sampled(whole: Trajectory, samples: WheelSamples, kept: NDArray[np.intp], zero: float) -> Trajectory:
    """The recording's run with the wheel samples that are kept, from a time of the recording on, s."""
    ends = samples.ends[kept] - zero
    return replace(
        whole,
        times=ends,
        rates=samples.rates[kept],
        duration=float(ends[-1]),
        angles=None if samples.angles is None else samples.angles[kept],
        steering=None if samples.steering is None else samples.steering[kept],
    )
