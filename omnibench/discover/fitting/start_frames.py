"""Residuals as seen from the heading in which each run starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.robot.kinematics import Array


def in_start_frames(runs: Sequence[Trajectory], values: Sequence[Array]) -> list[Array]:
    """Residuals (K, 3), or derivatives of poses (K, 3, m), turned into the frame of each run's start.

    Repetitions of a command that start in different headings can be compared only so.
    """
    turned = []
    for run, of_run in zip(runs, values, strict=True):
        cosine, sine = np.cos(run.start[2]), np.sin(run.start[2])
        turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        turned.append(np.einsum("ij,kj...->ki...", turn, of_run))
    return turned
