"""The matrix that fits a recording best, whatever the design says, and its distance from a design.

The matrix is fitted freely, by linear least squares. Between reference poses at t_i and t_j about a second apart, with
C (M) the integrals of the drive signals, p = x + iy and theta the reference's position and heading,

    theta_j - theta_i = k3 . (C_j - C_i),                                                           (1)
    exp(-i theta_i) (p_j - p_i) = (k1 + i k2) . sum over samples of exp(i (theta - theta_i)) dC.    (2)

Both are linear in the matrix with rows k1, k2, k3. Headings between two poses lie on straight lines.

Its distance from a design is counted in what designs, tyres and floors may be off. With k the elements of a fitted
matrix K (3, M) and k0 the design's, the distance is

    d^2 = (k - k0)^T (V + S)^-1 (k - k0),                                                           (3)

V being the covariance of the fit and S that of real robots about their designs: a radius and a gain of every row, the
yaw and place of the tracked point, and small errors of all elements. Directions that are not driven have a huge V and
add nothing, so that no mistake is claimed of what the recording does not show. Over OptiOdom's four robots, a Robotino
and simulated ones d^2 is at most 3.9, in whole sets and single sessions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array, Robot, interpolated
from omnibench.robot.odometry import Complex, WheelLog

_WINDOW = 1.0  # s between two poses: long beside their noise, short beside the drift of headings; chosen
_LONGEST = 3.0  # s: a longer window turns too far for straight lines between its poses; chosen
_DENSE = 0.6  # s between poses, in which no robot of this kind turns by half a turn; chosen
_STEP = 0.1  # s: samples are taken together up to here, which windows of a second hardly show; chosen
_GENTLE = 1.0  # m/s2 of lateral acceleration, up to which tyres hardly slip; chosen
_HUBER = 1.5  # standard deviations from which on a residual counts less
_REWEIGHTED = 5  # rounds of reweighted least squares; outliers are found in three
# Slip of the strongest motion that may pass for motion along a weakly driven direction, as a share; of mecanum and
# skid-steered robots it is the largest; chosen.
_SLIP = 0.03
# Share of the largest singular value of the wheel angles: a direction with less is noise, and its part of the matrix
# stays 0; a wheel that slips nowhere leaves 0.003 along the direction in which it would have to slip.
_NULL = 5e-3
_CORRELATED_WINDOWS = 4.0  # windows that tell as much as one, since slip lasts; chosen
_FEWEST = 8  # windows for each column of the matrix, of fewer it is not fitted; chosen


@dataclass(frozen=True, eq=False)
class FreeFit:
    """The matrix that fits a recording best.

    matrix (3, M): m, m and rad per rad. covariance (3, M, M): of each row. unexplained (2,): shares of the positions
    and of the headings that the wheels do not explain, robust; share: of both together, a turn counting at the robot's
    size. windows: their number. gram (M, M): sum of products of the driven signals, rad^2.
    """

    matrix: Array
    covariance: Array
    unexplained: Array
    share: float
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
    def of(cls, logs: Sequence[WheelLog], poses: Sequence[Array], length: float = _WINDOW) -> Windows | None:
        """The windows of logs with the reference's poses (K, 3) at their stamps; None if its poses are too sparse.

        length: s between two poses, at least.
        """
        pairs = enumerate(zip(logs, poses, strict=True))
        parts = [part for run, pair in pairs if (part := _of_run(run, *pair, length))]
        if not parts:
            return None
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))

    def gentle(self) -> NDArray[np.bool_]:
        """True (W,) for windows of little lateral acceleration, in which tyres hardly slip; for all where few are.

        The turns are those that the signals tell: chosen by the reference's own, windows would make slopes too small.
        """
        seconds = self.times[:, 1] - self.times[:, 0]
        turned = self.driven @ np.linalg.lstsq(self.driven, self.turned)[0]
        chosen: NDArray[np.bool_] = np.abs(self.moved) * np.abs(turned) < _GENTLE * seconds**2
        return chosen if 5 * chosen.sum() > len(chosen) else np.ones(len(chosen), dtype=bool)

    def only(self, chosen: NDArray[np.bool_]) -> Windows:
        """Some of the windows."""
        return Windows(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def fit(self, reach: float) -> FreeFit | None:
        """The free fit; None if there are too few windows. reach: size of the robot, m."""
        count, columns = self.driven.shape
        if count < _FEWEST * columns:
            return None
        heading, heading_weights = _robust(self.driven.astype(complex), self.turned.astype(complex))
        position, position_weights = _robust(self.bent, self.moved)
        off = self.moved - self.bent @ position
        missed = self.turned - self.driven @ heading.real
        unexplained = [_share(off, self.moved, position_weights), _share(missed, self.turned, heading_weights)]
        # Slip of the wheels as a covariance (M, M) of the matrix, as a share of a row's scale squared.
        _, strengths, directions = np.linalg.svd(self.driven, full_matrices=False)
        shares = np.maximum(strengths / max(float(strengths[0]), 1e-300), 1e-4)
        slip: Array = (directions.T * (_SLIP / shares) ** 2) @ directions
        of_place = _covariance(self.bent, off, position_weights) / 2
        of_heading = _covariance(self.driven.astype(complex), self.turned - self.driven @ heading, heading_weights)
        matrix = np.array([position.real, position.imag, heading.real])
        scales = np.maximum(np.abs(matrix).max(axis=1), 1e-12)
        scales[:2] = scales[:2].max()
        covariance = np.array([of_place, of_place, of_heading]) + scales[:, None, None] ** 2 * slip
        wholes = [float(position_weights @ np.abs(self.moved) ** 2), reach**2 * float(heading_weights @ self.turned**2)]
        share = float(np.sqrt(np.square(unexplained) @ wholes / max(sum(wholes), 1e-300)))
        return FreeFit(matrix, covariance, np.array(unexplained), share, count, self.driven.T @ self.driven)

    def unexplained(self, fit: FreeFit | None, reach: float, runs: int) -> Array:
        """Shares (R,) of the motion of each of some runs that a fit leaves; a turn counts at the robot's size, m."""
        if fit is None:
            return np.zeros(runs)
        off = np.abs(self.moved - self.bent @ (fit.matrix[0] + 1j * fit.matrix[1]))
        off = off + reach * np.abs(self.turned - self.driven @ fit.matrix[2])
        whole = np.abs(self.moved) + reach * np.abs(self.turned)
        left, every = (np.bincount(self.run, each, runs) for each in (off, whole))
        return left / np.maximum(every, 1e-9)

    def steering_zero(self) -> tuple[float, float]:
        """The angle, rad, that a car's steering angles lack, and its standard error.

        Its signals are the mean rate m and m tan phi, of which small zeros d of phi make m tan(phi + d), about
        m tan phi + d m. By the heading changes of Eq. (1), fitted to both, d is the ratio of their coefficients.
        """
        columns = self.driven[:, :2].astype(complex)
        solution, weights = _robust(columns, self.turned.astype(complex))
        covariance = _covariance(columns, self.turned - columns @ solution, weights)
        by_mean, by_tangent = solution.real
        slopes = np.array([1.0, -by_mean / by_tangent]) / by_tangent
        return float(by_mean / by_tangent), float(np.sqrt(slopes @ covariance @ slopes))


def continuous(stamps: Array, poses: Array) -> Array:
    """Poses (K, 3) at stamps (K,) with steps of the heading of less than half a turn, where poses are near each other.

    A data set has the steps that its wheels tell, which are whole turns off where these are misread.
    """
    near = len(stamps) > 1 and float(np.median(np.diff(stamps))) <= _DENSE
    if not near or np.abs(np.diff(poses[:, 2])).max() < np.pi:
        return poses
    return np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])


def _of_run(run: int, log: WheelLog, poses: Array, length: float) -> Windows | None:
    stamps = log.stamps
    if len(stamps) < 3:
        return None
    period = float(np.median(np.diff(stamps)))
    apart = max(length, period)
    if apart > _LONGEST:
        return None
    # Stamps that are ``apart``, s, or a little more.
    numbers = np.floor((stamps - stamps[0]) / apart + 1e-9)
    chosen = np.flatnonzero(np.diff(numbers, prepend=-1.0))
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
    turned, times = poses[last, 2] - poses[first, 2], np.column_stack([begins, ends])
    return Windows(at[:, -1] - at[:, 0], bent, turned, moved, np.full(len(first), run), times)


def _robust(columns: Complex, observed: Complex) -> tuple[Complex, Array]:
    """Least squares (M,) with Huber's weights (W,)."""
    weights = np.ones(len(observed))
    for _ in range(_REWEIGHTED):
        roots = np.sqrt(weights)
        solution = np.linalg.lstsq(columns * roots[:, None], observed * roots, rcond=_NULL)[0]
        sizes = np.abs(observed - columns @ solution)
        deviation = 1.4826 * float(np.median(sizes))
        if not deviation:
            break
        weights = np.minimum(1.0, _HUBER * deviation / np.maximum(sizes, 1e-300)) ** 2  # outliers hardly count
    return solution.astype(np.complex128), weights


def _share(residuals: Array | Complex, observed: Array | Complex, weights: Array) -> float:
    """Root of the share of the squares of what was observed that a fit does not explain."""
    whole = float(weights @ np.abs(observed) ** 2)
    return float(np.sqrt(weights @ np.abs(residuals) ** 2 / whole)) if whole else 0.0


def _covariance(columns: Complex, residuals: Array | Complex, weights: Array) -> Array:
    """Covariance (M, M) of a fit's solution, huge along directions that are not driven."""
    normal = ((columns.conj() * weights[:, None]).T @ columns).real
    values, vectors = np.linalg.eigh(normal)
    values = np.maximum(values, 1e-8 * max(float(values[-1]), 1e-300))
    variance = _CORRELATED_WINDOWS * float(weights @ np.abs(residuals) ** 2) / max(float(weights.sum()), 1.0)
    return (vectors / values) @ vectors.T * variance


# Standard deviations by which robots differ from their designs, as shares (chosen; OptiOdom's tricycle is 7 % off in
# row 3, omni3's rows 1 and 2 by 10 %): radius of each wheel, gains of rows x, y and heading, each element.
_RADIUS, _GAINS, _ELEMENT = 0.06, (0.05, 0.05, 0.12), 0.02
_LATERAL = 0.2  # the gain of row y of mecanum wheels, which slip sideways; chosen
_SKID = 0.5  # the gain of row 3 of a skid-steered robot, which turns 20 to 50 % less than its design
_YAW = 0.035  # rad of the tracked point's heading; chosen, 2 degrees
_PLACE = 0.1  # standard deviation of the tracked point's x and y, as a share of the robot's reach; chosen


def usual_changes(robot: Robot) -> Array:
    """Changes (J, 3, M) of the design by one standard deviation of each radius, row's gain and tracked point's yaw."""
    design = robot.inverse_kinematic_matrix
    columns = design.shape[1]
    lateral = _LATERAL if any(wheel.kind == "mecanum" for wheel in robot.wheels) else _GAINS[1]
    gains = (_GAINS[0], lateral, _SKID if robot.skid else _GAINS[2])
    changes = [_RADIUS * design * (np.arange(columns) == column) for column in range(columns)]
    changes += [gain * design * (np.arange(3) == row)[:, None] for row, gain in enumerate(gains)]
    x, y, turn = design
    return np.array([*changes, _YAW * np.array([-y, x, 0 * turn])])


class DesignDistance:
    """Distances of fits from the design of one robot, Eq. (3)."""

    def __init__(self, robot: Robot) -> None:
        self.design = robot.inverse_kinematic_matrix
        scales, columns = robot.row_scales, self.design.shape[1]
        # The projection (M, M) that takes from drive signals those that a twist of the robot gives.
        within, strengths, _ = np.linalg.svd(robot.signal_equations @ robot.allowed_basis, full_matrices=False)
        within = within[:, strengths > 1e-9 * strengths[0]]
        outside = np.eye(columns) - within @ within.T
        self._outside = np.where(np.abs(outside) < 1e-12, 0.0, outside)
        self._units = np.repeat(1 / scales, columns)
        # S (3M, 3M) in units of the rows: what radii, gains, and yaw and place of the tracked point may change.
        turn, still = self.design[2], 0 * self.design[2]
        places = _PLACE * robot.reach * np.array([[turn, still, still], [still, turn, still]])
        flat = np.concatenate([usual_changes(robot), places]).reshape(-1, 3 * columns)
        allowed = flat.T @ flat + np.diag(np.repeat((_ELEMENT * scales) ** 2, columns))
        self._allowed = allowed * np.outer(self._units, self._units)

    def squared(self, matrices: Array, covariances: Array) -> Array:
        """d^2 (P,) of matrices (P, 3, M) whose rows have covariances (P, 3, M, M)."""
        count, _, columns = matrices.shape
        whole = np.zeros((count, 3 * columns, 3 * columns))
        for row in range(3):
            block = slice(row * columns, (row + 1) * columns)
            whole[:, block, block] = covariances[:, row]
        off = (matrices - self.design).reshape(count, -1) * self._units
        whole = whole * np.outer(self._units, self._units) + self._allowed
        return np.einsum("pi,pi->p", off, np.linalg.solve(whole, off[..., None])[..., 0])

    def of(self, fit: FreeFit) -> float:
        """d^2 of one fit."""
        return float(self.squared(fit.matrix[None], fit.covariance[None])[0])

    def contradictions(self, gram: Array, columns: Array) -> Array:
        """Shares (P,) of the signals that no motion of the robot gives, by which its wheels contradict each other.

        gram (M, M): sum of products of the signals as recorded. columns (P, M, M): from those meant to those recorded.
        """
        meant = np.linalg.inv(columns)
        grams = meant @ gram @ np.swapaxes(meant, 1, 2)
        whole = np.maximum(np.trace(grams, axis1=1, axis2=2), 1e-300)
        outside = np.einsum("ij,pjk,ik->p", self._outside, grams, self._outside)
        return np.sqrt(np.maximum(outside, 0.0) / whole)


def transformed(fit: FreeFit, rows: Array, columns: Array) -> tuple[Array, Array]:
    """Matrices (P, 3, M) and covariances (P, 3, M, M) of a fit for other readings of what was recorded.

    rows (P, 3, 3): from a twist as recorded to the one meant. columns (P, M, M): from the signals that are meant to
    those recorded.
    """
    matrices = rows @ fit.matrix @ columns
    turned = np.einsum("pij,jkl->pikl", rows**2, fit.covariance)
    return matrices, np.swapaxes(columns, 1, 2)[:, None] @ turned @ columns[:, None]
