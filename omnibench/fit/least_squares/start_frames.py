"""Residuals as seen from the heading in which each run starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.robot.kinematics import Array
from omnibench.robot.planar import rotation


def in_start_frames(runs: Sequence[Trajectory], values: Sequence[Array]) -> list[Array]:
    """Residuals (K, 3), or derivatives of poses (K, 3, m), turned into the frame of each run's start.

    Repetitions of a command that start in different headings can be compared only so.
    """
    turned = []
    for run, of_run in zip(runs, values, strict=True):
        turned.append(np.einsum("ij,kj...->ki...", rotation(-run.start[2]), of_run))
    return turned
