"""Least-squares weights that imitate a cost: a fit uses them where no matrix fits the runs within their noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.fit.cost import Cost
from omnibench.fit.least_squares.noise import LEAST_WHITE
from omnibench.fit.loss.robust_cost import RobustCost, norms_of
from omnibench.robot.kinematics import Array


@dataclass(frozen=True, eq=False)
class CostWeighting:
    """Scales a run's pose residuals by ``scale`` (3,) or (k, 3); last_alone: all but the last pose are left out."""

    scale: Array
    last_alone: bool

    def __call__(self, residuals: Array) -> Array:
        """Weighted residuals (k, 3) or derivatives (k, 3, n)."""
        chosen = residuals[-1:] if self.last_alone else residuals
        weighted: Array = chosen * self.scale.reshape(*self.scale.shape, *([1] * (residuals.ndim - 2)))
        return weighted


def cost_weightings(cost: Cost, trajectories: Sequence[Trajectory], residuals: Sequence[Array]) -> list[CostWeighting]:
    """The weighting of every run, at the cost's stamps: equal for all runs, normalised to unit mean square over them.

    A cost that is no sum of norms has no weights; m and rad then count alike. A robust one has weights of its poses,
    which are those of the residuals.
    """
    base = norms_of(cost)
    weights = np.array((1.0, 1.0, 1.0) if base is None else base.weights)
    last_alone = cost.stamps == "final"
    raw = [
        CostWeighting(weights / np.sqrt(1 if last_alone else len(run.pose_times) - 1), last_alone)
        for run in trajectories
    ]
    if isinstance(cost, RobustCost):
        errors, owner = _at_stamps(cost, residuals)
        roots = np.sqrt(cost.weights(errors, owner))[:, None]
        raw = [CostWeighting(roots[owner == run] * weigh.scale, last_alone) for run, weigh in enumerate(raw)]
    squares = [float(np.square(weigh(errors)).sum()) for weigh, errors in zip(raw, residuals, strict=True)]
    size = max(float(np.sqrt(np.mean(squares))), LEAST_WHITE)
    return [CostWeighting(weigh.scale / size, last_alone) for weigh in raw]


def mean_curvature(cost: RobustCost, residuals: Sequence[Array]) -> float:
    """Mean second derivative of a robust cost's loss over the mean of its weights, at every run's residuals (K, 3)."""
    errors, owner = _at_stamps(cost, residuals)
    return cost.loss.mean_curvature(cost.ratios(errors, owner), cost.base.shares(owner))


def _at_stamps(cost: Cost, residuals: Sequence[Array]) -> tuple[Array, NDArray[np.intp]]:
    """The residuals (S, 3) at a cost's stamps, of those (K, 3) of every run, and the run (S,) of each."""
    chosen = [of_run[-1:] if cost.stamps == "final" else of_run for of_run in residuals]
    return np.concatenate(chosen), np.repeat(np.arange(len(chosen)), [len(of_run) for of_run in chosen])
