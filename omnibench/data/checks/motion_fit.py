"""A robot's matrix as the recording itself has it, by linear least squares, whatever its design says.

Between reference poses at t_i and t_j about a second apart, with C (M) the integrals of the drive signals, p = x + iy
and theta the reference's position and heading,

    theta_j - theta_i = k3 . (C_j - C_i),                                                           (1)
    exp(-i theta_i) (p_j - p_i) = (k1 + i k2) . sum over samples of exp(i (theta - theta_i)) dC.    (2)

Both are linear in the matrix with rows k1, k2, k3. Headings between two poses lie on straight lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array, interpolated
from omnibench.robot.odometry import Complex, WheelLog

_WINDOW = 1.0  # s between two poses: long beside their noise, short beside the drift of headings; chosen
_LONGEST = 3.0  # s: a longer window turns too far for straight lines between its poses; chosen
_DENSE = 0.6  # s between poses, in which no robot of this kind turns by half a turn; chosen
_STEP = 0.1  # s: samples are taken together up to here, which windows of a second hardly show; chosen
_HUBER = 1.5  # standard deviations from which on a residual counts less
_REWEIGHTED = 5  # rounds of reweighted least squares; outliers are found in three
# Slip of the strongest motion that may pass for motion along a weakly driven direction, as a share; of mecanum and
# skid-steered robots it is the largest; chosen.
_SLIP = 0.03
_NULL = 5e-3  # of the strongest direction: one that is driven less is noise; of a wheel that slips nowhere it is 0.003
_CORRELATED = 4.0  # windows that tell as much as one, since slip lasts; chosen
_FEWEST = 8  # windows for each column of the matrix, below which it is not told; chosen


@dataclass(frozen=True, eq=False)
class FreeFit:
    """The matrix that fits a recording best.

    matrix (3, M): m, m and rad per rad. covariance (3, M, M): of each row. left (2,): share of position and heading
    that the wheels do not explain, robust. windows: their number. gram (M, M): sum of products of the driven signals,
    rad^2.
    """

    matrix: Array
    covariance: Array
    left: Array
    windows: int
    gram: Array


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of all runs together: driven (W, M), bent (W, M) as in Eq. (2), turned (W,), rad, moved (W,), m.

    run (W,): index of the run. times (W, 2): stamps of both poses, s.
    """

    driven: Array
    bent: Complex
    turned: Array
    moved: Complex
    run: NDArray[np.intp]
    times: Array

    @classmethod
    def of(cls, logs: Sequence[WheelLog], poses: Sequence[Array]) -> Windows | None:
        """The windows of logs with the reference's poses (K, 3) at their stamps; None if its poses are too sparse."""
        parts = [part for run, pair in enumerate(zip(logs, poses, strict=True)) if (part := _of_run(run, *pair))]
        if not parts:
            return None
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))

    def fit(self) -> FreeFit | None:
        """The free fit; None if there are too few windows."""
        count, columns = self.driven.shape
        if count < _FEWEST * columns:
            return None
        heading, heading_weights = _robust(self.driven.astype(complex), self.turned.astype(complex))
        position, position_weights = _robust(self.bent, self.moved)
        left = np.array(
            [
                _unexplained(self.moved, self.bent @ position, position_weights),
                _unexplained(self.turned, self.driven @ heading.real, heading_weights),
            ]
        )
        slip = _slip(self.driven)
        rows = [
            _covariance(self.bent, self.moved - self.bent @ position, position_weights) / 2,
            _covariance(self.bent, self.moved - self.bent @ position, position_weights) / 2,
            _covariance(self.driven.astype(complex), self.turned - self.driven @ heading, heading_weights),
        ]
        matrix = np.array([position.real, position.imag, heading.real])
        scales = np.maximum(np.abs(matrix).max(axis=1), 1e-12)
        scales[:2] = scales[:2].max()
        covariance = np.array([row + (scale**2) * slip for row, scale in zip(rows, scales, strict=True)])
        return FreeFit(matrix, covariance, left, count, self.driven.T @ self.driven)


def continuous(stamps: Array, poses: Array) -> Array:
    """Poses (K, 3) at stamps (K,) with steps of the heading of less than half a turn, where poses are near each other.

    A data set has the steps that its wheels tell, which are whole turns off where these are misread.
    """
    if len(stamps) < 2 or float(np.median(np.diff(stamps))) > _DENSE:
        return poses
    return np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])


def _of_run(run: int, log: WheelLog, poses: Array) -> Windows | None:
    stamps = log.stamps
    if len(stamps) < 3:
        return None
    period = float(np.median(np.diff(stamps)))
    apart = max(_WINDOW, period)
    if apart > _LONGEST:
        return None
    chosen = _every(stamps, apart)
    first, last = chosen[:-1], chosen[1:]
    near = stamps[last] - stamps[first] < 1.5 * apart + period
    first, last = first[near], last[near]
    if not len(first):
        return None
    edges = np.append(0.0, log.times)
    counted = np.vstack([np.zeros(log.signals.shape[1]), np.cumsum(log.signals * np.diff(edges)[:, None], axis=0)])
    begins, ends = stamps[first], stamps[last]
    # Bounds of the steps of all windows: a grid of _STEP within each, so that every run is a few array operations.
    steps = max(1, int(np.ceil(apart / _STEP)))
    grid = begins[:, None] + (ends - begins)[:, None] * np.linspace(0, 1, steps + 1)
    at = interpolated(grid.ravel(), edges, counted).reshape(*grid.shape, -1)
    pieces = np.diff(at, axis=1)  # (W, steps, M)
    middles = (grid[:, 1:] + grid[:, :-1]) / 2
    headings = np.interp(middles, stamps, poses[:, 2]) - poses[first, 2][:, None]
    bent: Complex = np.einsum("ws,wsm->wm", np.exp(1j * headings), pieces)
    path = poses[:, 0] + 1j * poses[:, 1]
    moved: Complex = (path[last] - path[first]) * np.exp(-1j * poses[first, 2])
    return Windows(
        at[:, -1] - at[:, 0],
        bent,
        poses[last, 2] - poses[first, 2],
        moved,
        np.full(len(first), run),
        np.column_stack([begins, ends]),
    )


def _every(stamps: Array, apart: float) -> NDArray[np.intp]:
    """Indices of stamps (K,) that are ``apart``, s, or a little more."""
    numbers = np.floor((stamps - stamps[0]) / apart + 1e-9)
    return np.flatnonzero(np.diff(numbers, prepend=-1.0))


def _robust(columns: Complex, wanted: Complex) -> tuple[Complex, Array]:
    """Least squares (M,) with Huber's weights (W,)."""
    weights = np.ones(len(wanted))
    for _ in range(_REWEIGHTED):
        roots = np.sqrt(weights)
        solution = np.linalg.lstsq(columns * roots[:, None], wanted * roots, rcond=_NULL)[0]
        sizes = np.abs(wanted - columns @ solution)
        deviation = 1.4826 * float(np.median(sizes))
        if not deviation:
            break
        weights = np.minimum(1.0, _HUBER * deviation / np.maximum(sizes, 1e-300)) ** 2  # outliers hardly count
    return solution.astype(np.complex128), weights


def _unexplained(wanted: Array | Complex, fitted: Array | Complex, weights: Array) -> float:
    """Share of what is wanted that a fit leaves."""
    whole = float(weights @ np.abs(wanted) ** 2)
    return float(np.sqrt(weights @ np.abs(wanted - fitted) ** 2 / whole)) if whole else 0.0


def _covariance(columns: Complex, left: Array | Complex, weights: Array) -> Array:
    """Covariance (M, M) of a fit's solution, huge along directions that are not driven."""
    normal = ((columns.conj() * weights[:, None]).T @ columns).real
    values, vectors = np.linalg.eigh(normal)
    values = np.maximum(values, 1e-8 * max(float(values[-1]), 1e-300))
    variance = _CORRELATED * float(weights @ np.abs(left) ** 2) / max(float(weights.sum()), 1.0)
    covariance: Array = (vectors / values) @ vectors.T * variance
    return covariance


def _slip(driven: Array) -> Array:
    """Covariance (M, M), as a share of a row's scale squared, of a matrix with what slip of the wheels makes of it."""
    _, strengths, directions = np.linalg.svd(driven, full_matrices=False)
    shares = np.maximum(strengths / max(float(strengths[0]), 1e-300), 1e-4)
    slip: Array = (directions.T * (_SLIP / shares) ** 2) @ directions
    return slip
