"""Poses of many candidate matrices at once, from moments of the wheel angles that were summed up once.

For a given row 3 of the matrix positions are linear in rows 1 and 2 (odometry.py), and their regressors

    G_j(m3) = sum_i a_ij exp(i m3.c_i)

are smooth functions of row 3 alone. Over a box they are expanded once in Chebyshev polynomials (expansion.py), of
which a singular value decomposition leaves some hundred combinations (moments.py). The poses of a population then are
two matrix products, whatever the sampling rate. A recording whose heading the box turns too far for one expansion is
cut into segments (expansion_plan.py), each in the frame of its anchor, whose heading is linear in row 3 too
(segment_join.py).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from omnibench.fit.evaluator.element_box import ElementBox
from omnibench.fit.evaluator.expansion_plan import ExpansionPlan, make_plan
from omnibench.fit.evaluator.moments import compress, moments_of
from omnibench.fit.evaluator.segment_join import join_segments
from omnibench.processes import one_thread
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, OdometryBatch, WheelLog

# Share of the largest pose: rounding of a direct sum of some thousand samples, which the check allows beside the bound.
_ROUNDING = 1e-12
# Values of the large product at a time, 2 MB, so that they stay in the processor's cache. It changes the order of sums
# alone, hence costs by 1e-16 m (tests/benchmarks/constants_fit.py); bench_evaluator.py measures the speed.
_BLOCK = 250_000


class PoseEvaluator:
    """Poses at the stamps of some logs, for candidate matrices in a box. Made by :func:`make_evaluator`.

    error_bound: largest difference of a position from direct integration, m.
    """

    def __init__(self, plan: ExpansionPlan) -> None:
        box = plan.box
        self._box = box
        self._centre = box.centre[2]
        self._scale = np.where(plan.free, box.reach[2], 1.0)
        self._basis = plan.basis
        moments = moments_of(plan)  # (R, n, 2N)
        rows, terms, components = moments.shape
        moments = np.ascontiguousarray(np.swapaxes(moments, 1, 2))
        combinations, dropped = compress(moments, plan)
        self.error_bound = plan.error + dropped
        self._combinations = np.ascontiguousarray(combinations.T)  # (K, n)
        left = (moments.reshape(-1, terms) @ combinations).reshape(rows, components, -1)
        self._product = np.ascontiguousarray(np.transpose(left, (2, 1, 0)).reshape(-1, components * rows))  # (K, 2N R)
        self._join = join_segments(plan)
        starts = np.array([log.start for log in plan.logs])[self._join.log_of_stamp]
        self._start = np.ascontiguousarray(starts.T)
        self._driven = np.concatenate([path.driven for path in plan.paths]).T

    @property
    def size(self) -> int:
        """Memory that is kept, bytes."""
        return int(self._product.nbytes + self._combinations.nbytes + self._driven.nbytes + self._start.nbytes)

    @property
    def combinations(self) -> int:
        """Number of combinations of polynomials that stand for the recordings."""
        return len(self._combinations)

    @property
    def segments(self) -> int:
        """Number of segments that the recordings are cut into."""
        return len(self._join.anchors)

    def covers(self, matrices: Array) -> NDArray[np.bool_]:
        """True (P,) for the matrices (P, 3, N) that lie in the box."""
        inside = (matrices >= self._box.lower) & (matrices <= self._box.upper)
        return np.asarray(inside.all(axis=(1, 2)))

    def poses(self, matrices: Array) -> Array:
        """Poses (P, S, 3) in m, m, rad of matrices (P, 3, N) in the box. Headings are not wrapped."""
        if len(matrices) == 1:
            return self._poses(matrices)
        with one_thread():
            return self._poses(matrices)

    def _poses(self, matrices: Array) -> Array:
        result = np.empty((len(matrices), *self._start.shape))
        block = max(1, _BLOCK // self._product.shape[1])
        for first in range(0, len(matrices), block):
            part = slice(first, first + block)
            positions = self._join.positions(self._displacements(matrices[part]), matrices[part])
            np.add(positions, self._start[:2], out=result[part, :2])
        np.add(matrices[:, 2] @ self._driven, self._start[2], out=result[:, 2])
        return np.swapaxes(result, 1, 2)

    def _displacements(self, matrices: Array) -> Array:
        """x and y (P, 2, R) of every row relative to its segment's start, in the frame of its anchor, m."""
        features = self._combinations @ self._basis.values((matrices[:, 2] - self._centre) / self._scale)
        first, second = matrices[:, 0], matrices[:, 1]
        weights = np.concatenate([first, -second, second, first], axis=1).reshape(len(matrices), 2, -1)
        regressors = (features.T @ self._product).reshape(len(matrices), weights.shape[2], -1)
        displacements: Array = weights @ regressors
        return displacements


def make_evaluator(
    odometry: OdometryBatch, logs: Sequence[WheelLog], integration: Integration, box: ElementBox
) -> PoseEvaluator | None:
    """The evaluator of logs for matrices in a box, checked against direct integration by ``odometry``.

    None where direct integration is faster, or the check finds a larger error than the bound.
    """
    plan = make_plan(logs, integration, box)
    if plan is None:
        return None
    with one_thread():
        evaluator = PoseEvaluator(plan)
    return evaluator if _agrees(evaluator, odometry, box) else None


def _agrees(evaluator: PoseEvaluator, odometry: OdometryBatch, box: ElementBox) -> bool:
    """True if both ways give the same poses, up to the bound and rounding, at the box's centre and some corners."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(3, *box.centre.shape))
    matrices = np.concatenate([box.centre[None], box.centre + signs * box.reach])
    direct = odometry.poses(matrices)
    fast = evaluator.poses(matrices)
    if fast.shape != direct.shape:
        return False
    length = max(1.0, float(np.abs(direct).max()))
    return bool(np.abs(fast - direct).max() <= evaluator.error_bound + _ROUNDING * length)
