"""Poses of many candidate matrices at once, from moments of the wheel angles that were summed up once.

For a given row 3 of the matrix positions are linear in rows 1 and 2 (odometry.py), and their regressors

    G_j(m3) = sum_i a_ij exp(i m3.c_i)

are smooth functions of row 3 alone. Over a box they are expanded once in Chebyshev polynomials, of which a singular
value decomposition leaves some hundred combinations (expansion_plan.py). The poses of a population then are two matrix
products, whatever the sampling rate. A recording whose heading the box turns too far for one expansion is cut into
segments, each in the frame of its anchor, whose heading is linear in row 3 too; they are joined in the end.
Runs that are read from files have an evaluator for each part of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from omnibench.fit.evaluator.driven_frame import DrivenFrame
from omnibench.fit.evaluator.element_box import ElementBox
from omnibench.fit.evaluator.expansion_plan import ExpansionPlan, make_plan
from omnibench.fit.evaluator.impulses import impulses
from omnibench.processes import one_thread
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex, Integration, OdometryBatch, WheelLog
from omnibench.robot.stored.odometry_of_stored import together


@dataclass(frozen=True, eq=False)
class PartedEvaluator:
    """Poses at the stamps of many logs, as PoseEvaluator gives them, by the evaluators of parts of the logs."""

    parts: Sequence[PoseEvaluator]

    def covers(self, matrices: Array) -> NDArray[np.bool_]:
        """True (P,) for the matrices (P, 3, N) that lie in the box."""
        return self.parts[0].covers(matrices)

    def poses(self, matrices: Array) -> Array:
        """Poses (P, S, 3) of matrices (P, 3, N) in the box, see PoseEvaluator."""
        return np.concatenate([part.poses(matrices) for part in self.parts], axis=1)


def make_parted_evaluator(
    logs: Sequence[WheelLog], integration: Integration, box: ElementBox, frame: DrivenFrame | None
) -> PartedEvaluator | None:
    """The evaluator of logs for matrices in a box; None where that of a part is None. frame: of the matrices."""
    parts = []
    for part in together(logs):
        seen = part if frame is None else frame.logs(part)
        evaluator = make_evaluator(OdometryBatch(seen, integration), seen, integration, box)
        if evaluator is None:
            return None
        parts.append(evaluator)
    return PartedEvaluator(parts)


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


@dataclass(frozen=True, eq=False)
class SegmentJoin:
    """Indices that join the rows of G segments to the S stamps.

    row_of_stamp, log_of_stamp (S,). segment_of_row (R,). anchors (G, N): wheel angles of the segments' anchors, rad.
    last_row, first_of_log (G,): the row at a segment's end, and the first segment of its log.
    """

    row_of_stamp: NDArray[np.intp]
    log_of_stamp: NDArray[np.intp]
    segment_of_row: NDArray[np.intp]
    anchors: Array
    last_row: NDArray[np.intp]
    first_of_log: NDArray[np.intp]

    def positions(self, displacements: Array, matrices: Array) -> Array:
        """x and y (P, 2, S) relative to the start, m, from displacements (P, 2, R) within the rows' segments."""
        if self._uncut:  # the anchors are the starts
            alike = len(self.segment_of_row) == len(self.row_of_stamp)
            return displacements if alike else displacements[:, :, self.row_of_stamp]
        phase = matrices[:, 2] @ self.anchors.T
        turn: Complex = (np.cos(phase) + 1j * np.sin(phase))[:, self.segment_of_row]
        moved = (displacements[:, 0] + 1j * displacements[:, 1]) * turn
        before = np.zeros((len(matrices), len(self.anchors) + 1), dtype=complex)
        np.cumsum(moved[:, self.last_row], axis=1, out=before[:, 1:])
        carried = before[:, :-1] - before[:, self.first_of_log]
        at_rows = moved + carried[:, self.segment_of_row]
        path = at_rows[:, self.row_of_stamp]
        return np.stack([path.real, path.imag], axis=1)

    @cached_property
    def _uncut(self) -> bool:
        return not self.anchors.any()


def join_segments(plan: ExpansionPlan) -> SegmentJoin:
    """The indices of a plan's rows, segments and stamps."""
    row_of_stamp: list[int] = []
    log_of_stamp: list[int] = []
    segment_of_row: list[int] = []
    last_row: list[int] = []
    first_of_log: list[int] = []
    for index, path in enumerate(plan.paths):
        first = len(last_row)
        row_at: dict[int, int] = {}
        for _, ends in plan.row_ends(index):
            row_at |= {end: len(segment_of_row) + offset for offset, end in enumerate(ends)}
            segment_of_row += [len(last_row)] * len(ends)
            last_row.append(len(segment_of_row) - 1)
            first_of_log.append(first)
        row_of_stamp += [row_at[end] for end in path.ends.tolist()]
        log_of_stamp += [index] * len(path.ends)
    anchors = np.array([segment.anchor for segments in plan.segments for segment in segments])
    return SegmentJoin(
        np.array(row_of_stamp),
        np.array(log_of_stamp),
        np.array(segment_of_row),
        anchors,
        np.array(last_row),
        np.array(first_of_log),
    )


# Share of the largest pose: rounding of a direct sum of some thousand samples, which the check allows beside the bound.
_ROUNDING = 1e-12
# Values of the large product at a time, 2 MB, so that they stay in the processor's cache. It changes the order of sums
# alone, hence costs by 1e-16 m (tests/studies/constants_fit.py); bench_evaluator.py measures the speed.
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
