"""Moments of the wheel angles: coefficients of the expanded regressors, summed up once for all candidates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnibench.fit.evaluator.expansion_plan import ExpansionPlan
from omnibench.fit.evaluator.impulses import impulses
from omnibench.robot.kinematics import Array


def moments_of(plan: ExpansionPlan) -> Array:
    """Coefficients (R, n, 2N) of the regressors at the R rows of all logs: real parts of the N wheels, then imaginary.

    n: terms of the plan's basis.
    """
    return np.concatenate([_moments_of_log(plan, index) for index in range(len(plan.paths))])


def compress(moments: Array, plan: ExpansionPlan) -> tuple[Array, float]:
    """The fewest combinations (n, K) of terms that keep every row of moments (R, 2N, n) to ``plan.spare``.

    Also returns a bound of what they neglect over a path, m: polynomials are at most 1, so it is a sum of residuals.
    """
    rows, components, terms = moments.shape
    speed = np.tile(plan.box.speed, 2)
    scaled = (moments * speed[:, None]).reshape(-1, terms)
    _, _, directions = np.linalg.svd(np.linalg.qr(scaled, mode="r"), full_matrices=False)

    def neglected(count: int) -> float:
        kept = directions[:count]
        residual = np.abs(scaled - (scaled @ kept.T) @ kept).sum(axis=1).reshape(rows, 2, components // 2)
        return float(np.hypot(residual[:, 0], residual[:, 1]).sum(axis=1).max())

    low, high = 0, len(directions)
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if neglected(middle) <= plan.spare else (middle + 1, high)
    return directions[:low].T, neglected(low) * max(map(len, plan.segments))


def _moments_of_log(plan: ExpansionPlan, index: int) -> Array:
    """The moments (R, n, 2N) of one log."""
    path, basis = plan.paths[index], plan.basis
    start = plan.logs[index].start[2]
    centre, reach = plan.box.centre[2], np.where(plan.free, plan.box.reach[2], 0.0)
    sums = []
    for segment, ends in plan.row_ends(index):
        angles, about = impulses(path, segment, plan.integration, plan.nodes)
        heading = about @ centre + start
        sources = np.concatenate([angles * np.cos(heading)[..., None], angles * np.sin(heading)[..., None]], axis=2)
        wheels = about.shape[2]
        coefficients = basis.coefficients(about.reshape(-1, wheels) * reach)
        total = 0.0
        for first, last in zip([segment.first, *ends[:-1]], ends, strict=True):
            pieces = slice(first - segment.first, last - segment.first)
            summed = slice(pieces.start * plan.nodes, pieces.stop * plan.nodes)
            total = total + coefficients[:, summed] @ sources[pieces].reshape(-1, 2 * wheels)
            sums.append(total)
    return _times_powers_of_i(np.array(sums), basis.quarter_turns)


def _times_powers_of_i(sums: Array, quarter_turns: NDArray[np.intp]) -> Array:
    """Real and imaginary parts (R, n, 2N) of sums (R, n, 2N) of cosines and sines times i^quarter_turns (n,)."""
    cosine, sine = np.split(sums, 2, axis=2)
    real = np.choose(quarter_turns[:, None], [cosine, -sine, -cosine, sine])
    imaginary = np.choose(quarter_turns[:, None], [sine, cosine, -sine, -cosine])
    return np.concatenate([real, imaginary], axis=2)
