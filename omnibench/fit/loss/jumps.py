"""Recordings without the reference poses that have jumped, for estimates that have no loss of their own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.fit.least_squares.usable_runs import with_poses
from omnibench.fit.loss.losses import LossName, make_loss
from omnibench.robot.kinematics import Array


def poses_near(residuals: Sequence[Array], loss: LossName) -> list[NDArray[np.bool_]]:
    """True (K,) for the poses of each run that have not jumped, from their residuals (K, 3), m and rad alike.

    Where most of a run's poses are off, its start is, which shifts or turns them all: it then has none.
    """
    chosen = make_loss(loss, 3)
    if chosen is None:
        return [np.ones(len(of_run), dtype=bool) for of_run in residuals]
    counts = np.array([len(of_run) for of_run in residuals])
    shares = np.repeat(1 / (np.maximum(counts, 1) * max(np.count_nonzero(counts), 1)), counts)
    near = chosen.is_near(np.linalg.norm(np.concatenate(residuals), axis=1), shares)
    return [of_run & (of_run.mean() > 1 / 2) for of_run in np.split(near, np.cumsum(counts)[:-1])]


def without_jumps(
    runs: Sequence[Trajectory], residuals: Sequence[Array], loss: LossName
) -> tuple[list[Trajectory], list[Array]]:
    """Runs and their residuals (K, 3) at the poses that have not jumped; runs that have none are left out."""
    if loss == "squares":
        return list(runs), list(residuals)
    near = poses_near(residuals, loss)
    kept = [
        (with_poses(run, np.append(0, 1 + np.flatnonzero(chosen))), of_run[chosen])
        for run, of_run, chosen in zip(runs, residuals, near, strict=True)
        if chosen.any()
    ]
    return [run for run, _ in kept], [of_run for _, of_run in kept]
