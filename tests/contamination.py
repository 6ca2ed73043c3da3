"""Recordings whose reference poses jump, made from others."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Trajectory


def with_jumps(runs: Sequence[Trajectory], share: float, off: float, rng: np.random.Generator) -> list[Trajectory]:
    """The runs with a share of their reference poses, starts among them, moved by ``off`` m in random directions."""
    moved = []
    for run in runs:
        chosen = rng.random(len(run.poses)) < share
        angles = rng.uniform(0, 2 * np.pi, len(run.poses))
        poses = run.poses.copy()
        poses[:, :2] += off * np.where(chosen[:, None], np.column_stack([np.cos(angles), np.sin(angles)]), 0.0)
        moved.append(replace(run, poses=poses))
    return moved
