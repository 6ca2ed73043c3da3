"""Many candidates at once: poses from moments of the wheel angles that were summed up once.

For a given row 3 of the matrix positions are linear in rows 1 and 2 (odometry.py), and their regressors

    G_j(m3) = sum_i a_ij exp(i m3.c_i)

are smooth functions of row 3 alone. Over a box they are expanded once in Chebyshev polynomials (expansion.py), of
which a singular value decomposition leaves some hundred combinations. The poses of a population then are two matrix
products, whatever the sampling rate. A recording whose heading the box moves too far for one expansion is cut into
segments with a phase each: the heading at an anchor, which is linear in row 3 too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import comb

import numpy as np
from numpy.typing import NDArray

from omnibench.fit.evaluator.expansion import Basis, degree_for
from omnibench.fit.evaluator.impulses import Path, Segment, cut, impulses, make_path, quadrature
from omnibench.fit.parameterisation import Parameterisation
from omnibench.processes import one_thread
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex, Integration, OdometryBatch, WheelLog

# What may be left out of a position by truncation, by quadrature, and by the decomposition, as a share of the longest
# path (at least 1 m). The bounds are of absolute sums; what is really left out is about a thousand times less.
_TRUNCATION, _QUADRATURE, _DECOMPOSITION = 1e-12, 1e-12, 5e-12
# Rounding of a direct sum over a path, as a share of it; what the check at building allows beside the bound.
_ROUNDING = 1e-12
# How far the box may move the heading of a segment about its anchor, rad; the first leaves recordings whole.
_LIMITS = (np.inf, 2.0, 1.0, 0.5, 0.25)
# What things take beside one multiplication and addition of a matrix product. They only choose the faster way.
_SAMPLE, _SEGMENT, _TERM = 400.0, 1000.0, 100.0
_MOST_BYTES = 48e6
_BLOCK = 250_000  # values of the large product, which then stay in the processor's cache
_MARGIN = 0.1  # by which the box of a curved parameterisation is widened beyond its linear reach


@dataclass(frozen=True, eq=False)
class ElementBox:
    """Where matrices are looked for: ``lower`` and ``upper`` (3, N) of their elements."""

    lower: Array
    upper: Array

    @classmethod
    def of(cls, parameterisation: Parameterisation, lower: Array, upper: Array) -> ElementBox:
        """The matrices of the vectors between ``lower`` and ``upper`` (n,).

        All of them, where the matrix is linear in the vector; about all, where it is curved.
        """
        middle, half = (lower + upper) / 2, (upper - lower) / 2
        centre, *moved = parameterisation.matrices(middle + np.vstack([np.zeros(len(half)), np.diag(half)]))
        reach: Array = np.abs(np.array(moved) - centre).sum(axis=0)
        reach *= 1 + (1e-9 if parameterisation.name == "matrix" else _MARGIN)
        slack = 1e-15 * np.abs(centre).max(axis=1, keepdims=True)
        return cls(centre - reach - slack, centre + reach + slack)

    @property
    def centre(self) -> Array:
        """The middle (3, N)."""
        return (self.lower + self.upper) / 2

    @property
    def reach(self) -> Array:
        """Half-widths (3, N)."""
        return (self.upper - self.lower) / 2

    @property
    def speed(self) -> Array:
        """The largest |m1j + i m2j| (N,)."""
        largest = np.maximum(np.abs(self.lower[:2]), np.abs(self.upper[:2]))
        speed: Array = np.hypot(largest[0], largest[1])
        return speed


class PoseEvaluator:
    """Poses at the stamps of some logs, for candidate matrices in a box. Made by :func:`make_evaluator`.

    error_bound: how far a position may be off that of direct integration, m.
    """

    def __init__(self, plan: _Plan) -> None:
        box = plan.box
        self._box = box
        self._centre = box.centre[2]
        self._scale = np.where(plan.free, box.reach[2], 1.0)
        self._basis = plan.basis
        moments = np.concatenate([_moments(plan, index) for index in range(len(plan.paths))])  # (R, n, 2N)
        rows, terms, components = moments.shape
        moments = np.ascontiguousarray(np.swapaxes(moments, 1, 2))
        combinations, dropped = _compress(moments, plan)
        self.error_bound = plan.error + dropped
        self._combinations = np.ascontiguousarray(combinations.T)  # (K, n)
        left = (moments.reshape(-1, terms) @ combinations).reshape(rows, components, -1)
        self._product = np.ascontiguousarray(np.transpose(left, (2, 1, 0)).reshape(-1, components * rows))  # (K, 2N R)
        self._chain = plan.chain()
        starts = np.array([log.start for log in plan.logs])[self._chain.log_of_stamp]
        self._start = np.ascontiguousarray(starts.T)
        self._driven = np.concatenate([path.driven for path in plan.paths]).T

    @property
    def size(self) -> int:
        """Memory that is kept, bytes."""
        return int(self._product.nbytes + self._combinations.nbytes + self._driven.nbytes + self._start.nbytes)

    @property
    def combinations(self) -> int:
        """How many combinations of polynomials stand for the recordings."""
        return len(self._combinations)

    @property
    def segments(self) -> int:
        """How many segments the recordings are cut into."""
        return len(self._chain.anchors)

    def covers(self, matrices: Array) -> NDArray[np.bool_]:
        """Which matrices (P, 3, N) lie in the box: (P,) of bool."""
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
            positions = self._chain.positions(self._displacements(matrices[part]), matrices[part])
            np.add(positions, self._start[:2], out=result[part, :2])
        np.add(matrices[:, 2] @ self._driven, self._start[2], out=result[:, 2])
        return np.swapaxes(result, 1, 2)

    def _displacements(self, matrices: Array) -> Array:
        """x and y (P, 2, R) of every row relative to its segment's start, in the frame of its anchor."""
        features = self._combinations @ self._basis.values((matrices[:, 2] - self._centre) / self._scale)
        first, second = matrices[:, 0], matrices[:, 1]
        weights = np.concatenate([first, -second, second, first], axis=1).reshape(len(matrices), 2, -1)
        regressors = (features.T @ self._product).reshape(len(matrices), weights.shape[2], -1)
        displacements: Array = weights @ regressors
        return displacements


@dataclass(frozen=True, eq=False)
class _Chain:
    """How rows add up to stamps.

    row_of_stamp, log_of_stamp (S,). segment_of_row (R,). anchors (G, N): wheel angles of the segments' anchors.
    last_row, first_of_log (G,): the row at a segment's end, and the first segment of its log.
    """

    row_of_stamp: NDArray[np.intp]
    log_of_stamp: NDArray[np.intp]
    segment_of_row: NDArray[np.intp]
    anchors: Array
    last_row: NDArray[np.intp]
    first_of_log: NDArray[np.intp]

    def positions(self, displacements: Array, matrices: Array) -> Array:
        """x and y (P, 2, S) relative to the start, from those of the rows (P, 2, R)."""
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


@dataclass(frozen=True, eq=False)
class _Plan:
    """How logs are expanded: their paths in segments, the basis, and a bound (m) of what that leaves out."""

    logs: Sequence[WheelLog]
    box: ElementBox
    integration: Integration
    paths: list[Path]
    segments: list[list[Segment]]
    nodes: int
    basis: Basis
    free: NDArray[np.bool_]
    error: float
    spare: float  # what the decomposition may leave out of a row, m

    def ends(self, index: int) -> list[tuple[Segment, list[int]]]:
        """The segments of a path with the ends of their rows: stamps, and where the next segment goes on from."""
        path, segments = self.paths[index], self.segments[index]
        found = []
        for number, segment in enumerate(segments, 1):
            stamps = path.ends[(path.ends > segment.first) & (path.ends <= segment.last)]
            onward = [segment.last] if number < len(segments) else []
            found.append((segment, sorted({*stamps.tolist(), *onward})))
        return found

    def chain(self) -> _Chain:
        """The bookkeeping of rows, segments and stamps."""
        row_of_stamp: list[int] = []
        log_of_stamp: list[int] = []
        segment_of_row: list[int] = []
        last_row: list[int] = []
        first_of_log: list[int] = []
        for index, path in enumerate(self.paths):
            first = len(last_row)
            row_at: dict[int, int] = {}
            for _, ends in self.ends(index):
                row_at |= {end: len(segment_of_row) + place for place, end in enumerate(ends)}
                segment_of_row += [len(last_row)] * len(ends)
                last_row.append(len(segment_of_row) - 1)
                first_of_log.append(first)
            row_of_stamp += [row_at[end] for end in path.ends.tolist()]
            log_of_stamp += [index] * len(path.ends)
        anchors = np.array([segment.anchor for segments in self.segments for segment in segments])
        return _Chain(
            np.array(row_of_stamp),
            np.array(log_of_stamp),
            np.array(segment_of_row),
            anchors,
            np.array(last_row),
            np.array(first_of_log),
        )


def make_evaluator(
    odometry: OdometryBatch, logs: Sequence[WheelLog], integration: Integration, box: ElementBox
) -> PoseEvaluator | None:
    """The evaluator of logs for matrices in a box, checked against direct integration by ``odometry``.

    None where direct integration is the faster way, or the only one within the error bound.
    """
    plan = _make_plan(logs, integration, box)
    if plan is None:
        return None
    with one_thread():
        evaluator = PoseEvaluator(plan)
    return evaluator if _agrees(evaluator, odometry, plan) else None


def _make_plan(logs: Sequence[WheelLog], integration: Integration, box: ElementBox) -> _Plan | None:
    """The fastest way to cut and expand; None where direct integration is faster."""
    if any(len(log.stamps) == 0 or log.stamps[0] <= 0 for log in logs) or not np.isfinite(box.reach).all():
        return None
    paths = [make_path(log, integration) for log in logs]
    row, speed = np.abs(box.centre[2]) + box.reach[2], box.speed
    lengths = [float((np.abs(path.angles) @ speed).sum()) for path in paths]
    length = max(1.0, *lengths)
    nodes = quadrature(paths, row, speed, _QUADRATURE * length, integration)
    if nodes is None:
        return None
    free = box.reach[2] > 1e-14 * np.abs(box.centre[2]).max()
    wheels = int(free.sum())
    steps = np.concatenate([np.abs(path.angles) @ speed for path in paths])
    firsts = np.cumsum([0, *(len(path.angles) for path in paths[:-1])])
    cheapest, chosen = _SAMPLE * len(steps), None
    for limit in _LIMITS:
        segments = [cut(path, box.reach[2], limit) for path in paths]
        zeta = np.concatenate([_zeta(path, parts, box.reach[2]) for path, parts in zip(paths, segments, strict=True)])
        degree, left_out = degree_for(zeta, steps, firsts, _TRUNCATION * length, wheels)
        if degree is None:
            continue
        terms, count = comb(degree + wheels, wheels), sum(map(len, segments))
        rows = max(sum(len(path.ends) for path in paths), count)
        rank = _likely_rank(terms)
        values = 2 * len(row) * rows * rank
        cost = values + terms * (rank + _TERM) + (0.0 if np.isinf(limit) else _SEGMENT * count)
        if 8 * values < _MOST_BYTES and cost < cheapest:
            cheapest, chosen = cost, (segments, degree, left_out)
    if chosen is None:
        return None
    segments, degree, left_out = chosen
    error = _QUADRATURE * length * (nodes > 1) + left_out
    spare = _DECOMPOSITION * length / max(map(len, segments))
    basis = Basis.make(degree, free)
    return _Plan(logs, box, integration, paths, segments, nodes, basis, free, error, spare)


def _likely_rank(terms: int) -> float:
    """How many combinations are left of so many terms; seen on the recordings that omnibench knows."""
    return min(float(terms), 1.65 * terms**0.7)


def _zeta(path: Path, segments: list[Segment], reach: Array) -> Array:
    """The most (n,) that the box moves the heading of each piece about its anchor, rad."""
    anchors = np.repeat([s.anchor for s in segments], [s.last - s.first for s in segments], axis=0)
    begin = path.before - anchors
    moved: Array = np.maximum(np.abs(begin), np.abs(begin + path.angles)) @ reach
    return moved


def _moments(plan: _Plan, index: int) -> Array:
    """Coefficients (R, n, 2N) of the regressors at the rows of one path: real parts of all wheels, then imaginary."""
    path, basis = plan.paths[index], plan.basis
    start = plan.logs[index].start[2]
    centre, reach = plan.box.centre[2], np.where(plan.free, plan.box.reach[2], 0.0)
    found = []
    for segment, ends in plan.ends(index):
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
            found.append(total)
    return _turned(np.array(found), basis.quarter_turns)


def _turned(sums: Array, quarter_turns: NDArray[np.intp]) -> Array:
    """Sums (R, n, 2N) of cosine and sine parts, each times the power of i of its term."""
    cosine, sine = np.split(sums, 2, axis=2)
    real = np.choose(quarter_turns[:, None], [cosine, -sine, -cosine, sine])
    imaginary = np.choose(quarter_turns[:, None], [sine, cosine, -sine, -cosine])
    return np.concatenate([real, imaginary], axis=2)


def _compress(moments: Array, plan: _Plan) -> tuple[Array, float]:
    """The fewest combinations (n, K) of terms that keep every row of moments (R, 2N, n) to ``plan.spare``.

    Also returns what they leave out of a path at most (m): polynomials are at most 1, so that is a sum of residuals.
    """
    rows, components, terms = moments.shape
    speed = np.tile(plan.box.speed, 2)
    scaled = (moments * speed[:, None]).reshape(-1, terms)
    _, _, directions = np.linalg.svd(np.linalg.qr(scaled, mode="r"), full_matrices=False)

    def left_out(count: int) -> float:
        kept = directions[:count]
        residual = np.abs(scaled - (scaled @ kept.T) @ kept).sum(axis=1).reshape(rows, 2, components // 2)
        return float(np.hypot(residual[:, 0], residual[:, 1]).sum(axis=1).max())

    low, high = 0, len(directions)
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if left_out(middle) <= plan.spare else (middle + 1, high)
    return directions[:low].T, left_out(low) * max(map(len, plan.segments))


def _agrees(evaluator: PoseEvaluator, odometry: OdometryBatch, plan: _Plan) -> bool:
    """Whether both ways give the same poses, to the bound and rounding, at the centre and at corners of the box."""
    box = plan.box
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(3, *box.centre.shape))
    matrices = np.concatenate([box.centre[None], box.centre + signs * box.reach])
    direct = odometry.poses(matrices)
    found = evaluator.poses(matrices)
    if found.shape != direct.shape:
        return False
    length = max(1.0, float(np.abs(direct).max()))
    return bool(np.abs(found - direct).max() <= evaluator.error_bound + _ROUNDING * length)
