"""Least-squares weights that imitate a cost: a fit uses them where no matrix fits the runs within their noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.least_squares.noise import LEAST_WHITE
from omnibench.robot.kinematics import Array


@dataclass(frozen=True, eq=False)
class CostWeighting:
    """Scales a run's pose residuals by ``scale`` (3,); last_alone: all but the last pose are left out."""

    scale: Array
    last_alone: bool

    def __call__(self, residuals: Array) -> Array:
        """Weighted residuals (k, 3) or derivatives (k, 3, n)."""
        chosen = residuals[-1:] if self.last_alone else residuals
        weighted: Array = chosen * self.scale.reshape(3, *([1] * (residuals.ndim - 2)))
        return weighted


def cost_weightings(cost: Cost, trajectories: Sequence[Trajectory], residuals: Sequence[Array]) -> list[CostWeighting]:
    """The weighting of every run, at the cost's stamps: equal for all runs, normalised to unit mean square over them.

    A cost that is no sum of norms has no weights; m and rad then count alike.
    """
    weights = np.array(cost.weights if isinstance(cost, SumOfNorms) else (1.0, 1.0, 1.0))
    last_alone = cost.stamps == "final"
    raw = [
        CostWeighting(weights / np.sqrt(1 if last_alone else len(run.pose_times) - 1), last_alone)
        for run in trajectories
    ]
    squares = [float(np.square(weigh(errors)).sum()) for weigh, errors in zip(raw, residuals, strict=True)]
    size = max(float(np.sqrt(np.mean(squares))), LEAST_WHITE)
    return [CostWeighting(weigh.scale / size, last_alone) for weigh in raw]
