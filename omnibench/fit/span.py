"""Which directions of wheel rates a set of recordings drives: outside them the matrix is not determined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array

# Below this share of the strongest direction a direction is noise, not motion.
_NULL_SHARE = 1e-2


@dataclass(frozen=True)
class DrivenSpan:
    """Directions of wheel rates: ``driven`` (rank, N) and ``null`` (N - rank, N), orthonormal rows.

    shares (N,): RMS wheel angle along each direction as a share of the strongest.
    """

    driven: Array
    null: Array
    shares: Array


def driven_span(trajectories: Sequence[Trajectory]) -> DrivenSpan:
    """The span of the wheel angles driven between reference poses. DataError when there are no trajectories.

    Angles between poses, not rates: encoder noise averages out of them, motion does not.
    """
    if not trajectories:
        raise DataError("no trajectories; nothing can be calibrated")
    increments = [np.diff(_angles_at_poses(trajectory), axis=0) for trajectory in trajectories]
    wheels = increments[0].shape[1]
    # Rows of zeros, so that there are directions for every wheel however few the increments.
    _, strengths, directions = np.linalg.svd(
        np.concatenate([*increments, np.zeros((wheels, wheels))]), full_matrices=False
    )
    shares: Array = strengths / strengths[0] if strengths[0] > 0 else np.zeros(wheels)
    rank = int((shares > _NULL_SHARE).sum())
    null = directions[rank:]
    # The sign is that of the first large element, so that a direction has the same name on any data.
    leading = (np.abs(null) > 0.5 * np.abs(null).max(axis=1, keepdims=True)).argmax(axis=1)
    null = null * np.sign(null[np.arange(len(null)), leading])[:, None]
    return DrivenSpan(directions[:rank], null, shares)


def direction_in_words(direction: Array, wheels: Sequence[str]) -> str:
    """A direction of wheel rates as ``a - b + 0.5 c``, scaled to its largest element; its sign has no meaning."""
    large = np.abs(direction) > 0.5 * np.abs(direction).max()
    scaled = direction * np.sign(direction[large][0]) / np.abs(direction).max()
    terms = [(value, name) for value, name in zip(scaled, wheels, strict=True) if abs(value) > 0.02]
    text = " ".join(
        f"{'-' if value < 0 else '+'} {'' if abs(abs(value) - 1) < 0.02 else f'{abs(value):.2g} '}{name}"
        for value, name in terms
    )
    return text.removeprefix("+ ")


def _angles_at_poses(trajectory: Trajectory) -> Array:
    """Wheel angles (K, N) driven up to each reference pose, rad."""
    driven = np.cumsum(trajectory.rates * np.diff(trajectory.times, prepend=0.0)[:, None], axis=0)
    times = np.concatenate([[0.0], trajectory.times])
    angles = np.vstack([np.zeros(driven.shape[1]), driven])
    return np.stack([np.interp(trajectory.pose_times, times, column) for column in angles.T], axis=1)
