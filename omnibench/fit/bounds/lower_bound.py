"""Lower bounds of a sum of norms over a box of matrices.

The cost is F = sum_s share_s |W e_s|, with e_s the pose error at stamp s and W its weights. For any vectors u_s in the
unit ball

    F >= phi(z, d) = sum_s share_s u_s.W e_s

(duality of the norm). The choice of u_s decides how tight the bound is, not whether it holds. With d the deviation of
row 3 from the middle of the box, and rows 1 and 2 as zeta_j = z_1j + i z_2j,

    phi = Re H_0(d) + sum_j Re(zeta_j H_j(d)) + k_0 + k.d,     H_j(d) = H_j + dH_j.d + R_j(d),

where the H_j are sums over all stamps, and |R_j| <= 1/2 sum_lm rho_l rho_m B_jlm with B_jlm from sums of
|a_j c_l c_m|, since each term of H_j is an exponential exp(i m3.c). Without R_j, phi is linear in d for given z and
linear in z for given d: its least value over z is concave in d, so that it lies at a corner of the box of d, and is
found exactly. Headings have no R_j; u_s with heading components alone rule out distant boxes early.

All matrices are given as deviations (3, r) from the design along the r directions of wheel rates that are driven, so
that four wheels on three degrees of freedom have r = 3, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import product
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from omnibench.errors import ConfigError
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.evaluator.impulses import cut, impulses, make_path, quadrature
from omnibench.fit.parameterisation import MatrixElements
from omnibench.fit.problem import CalibrationProblem
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex

_QUADRATURE = 1e-9  # m, error of the quadrature of arcs, which the bound subtracts
# The other numbers are chosen; they change how fast the bound becomes tight, not whether it holds.
_CUT_OFF = 3.0  # preference for cutting rows 1 and 2 over row 3
_IMBALANCE = 1e-9  # m or rad per rad: assumed imbalance of u_s, so that no width of a box counts as exactly harmless
_STEPS = 25  # steps of the reweighted least squares that find u_s
_LOOSE = 0.9  # share of the expected cost below which a bound is tried again with headings alone
_SMOOTHING = 3.0  # digits: norms are smoothed below this negative power of ten of their mean
# The reweighting ends when no deviation changes by more, in units in which the normal equations' diagonal is 1.
_SETTLED = 1e-5
_RIDGE = 1e-13  # added to the normalised normal equations, which are singular where the data leave a direction open


@dataclass(frozen=True, eq=False)
class Node:
    """A part of the box, between the deviations ``lower`` and ``upper`` (3, r), with its proven bound.

    bound: no matrix in it costs less. good (3, r): deviations of a matrix in it with a low cost. looseness (3, r): by
    how much the width in each deviation may lower the bound.
    """

    lower: Array
    upper: Array
    bound: float
    good: Array
    looseness: Array

    @property
    def centre(self) -> Array:
        """The middle (r,) in row 3."""
        return (self.lower[2] + self.upper[2]) / 2

    @property
    def reach(self) -> Array:
        """The half-widths (r,) in row 3."""
        return (self.upper[2] - self.lower[2]) / 2


class LowerBounds:
    """Lower bounds of a problem's cost over parts of its box.

    ConfigError for another parameterisation than the matrix, or a cost that is no sum of norms.
    """

    def __init__(self, problem: CalibrationProblem) -> None:
        parameterisation, objective = problem.parameterisation, problem.objective
        if not isinstance(parameterisation, MatrixElements):
            raise ConfigError(
                "a lower bound needs the matrix parameterisation; its box contains what a geometry can do"
            )
        if not isinstance(objective, SumOfNorms):
            raise ConfigError(f"a lower bound needs a cost that is a sum of norms, which {objective.name} is not")
        self._design = problem.start.reshape(3, -1)
        self._driven = _complement(parameterisation.null, self._design.shape[1])
        self.lower, self.upper = self._deviations_of_box(problem)
        owner = problem.odometry.trajectory
        self._shares = objective.shares(owner)
        self._weights = np.array(objective.weights)
        self._stamps = _StampSums(problem, self._driven)
        start = np.array([run.start for run in problem.trajectories])[owner]
        self._offset = start[:, 0] - problem.reference[:, 0] + 1j * (start[:, 1] - problem.reference[:, 1])
        self._turned = problem.odometry.driven @ self._driven.T
        self._heading = start[:, 2] + problem.odometry.driven @ self._design[2] - problem.reference[:, 2]
        size = float(np.abs(problem.reference).max()) + float(np.abs(start).max())
        self._rounding = self._stamps.rounding * (1.0 + size) + self._stamps.quadrature

    def root(self, vector: Array) -> Node:
        """The whole box; ``vector`` (n,): first guess of a good matrix."""
        near = (vector.reshape(3, -1) - self._design) @ self._driven.T
        return self._node(self.lower, self.upper, np.clip(near, self.lower, self.upper))

    def split(self, node: Node) -> tuple[Node, Node]:
        """The node cut in two where its width lowers the bound most; both parts inherit the node's bound.

        Row 3 is halved. Rows 1 and 2, in which the cost is convex, are cut halfway between the good matrix and the
        farther side: the part without the good matrix is usually ruled out at once.
        """
        worth = node.looseness * np.array([[_CUT_OFF], [_CUT_OFF], [1.0]])
        row, column = np.unravel_index(int(np.argmax(worth)), worth.shape)
        low, high = float(node.lower[row, column]), float(node.upper[row, column])
        border = (low + high) / 2
        if row < 2:
            good = float(node.good[row, column])
            border = (good + (high if high - good > good - low else low)) / 2
        below, above = node.upper.copy(), node.lower.copy()
        below[row, column] = above[row, column] = border
        return self._node(node.lower, below, node.good, node.bound), self._node(
            above, node.upper, node.good, node.bound
        )

    def vector(self, deviations: Array) -> Array:
        """Deviations (3, r) as a vector (n,) of the problem."""
        matrix: Array = self._design + deviations @ self._driven
        return matrix.ravel()

    def _deviations_of_box(self, problem: CalibrationProblem) -> tuple[Array, Array]:
        """Bounds (3, r) of the deviations along the driven directions that contain all vectors in the box."""
        low = problem.lower.reshape(3, -1) - self._design
        high = problem.upper.reshape(3, -1) - self._design
        positive, negative = np.maximum(self._driven, 0).T, np.minimum(self._driven, 0).T
        return low @ positive + high @ negative, high @ positive + low @ negative

    def _node(self, lower: Array, upper: Array, near: Array, proven: float = 0.0) -> Node:
        """A part of the box with its bound; near (3, r): first guess of a good matrix; proven: bound of the whole."""
        centre, reach = (lower[2] + upper[2]) / 2, (upper[2] - lower[2]) / 2
        rows_12 = np.clip(near[:2], lower[:2], upper[:2])
        sums, slopes = self._stamps.at(centre)
        residuals, jacobian = self._linearised(centre, sums, slopes, rows_12)
        low, high = (np.concatenate([*rows[:2], side]) for rows, side in ((lower, -reach), (upper, reach)))
        begin = np.concatenate([*rows_12, np.clip(near[2] - centre, -reach, reach)])
        point, directions = _least_sum_of_norms(residuals, jacobian, self._shares, low, high, begin)
        part = _Part(lower, upper, sums, slopes)
        bound, looseness = max(map(partial(self._dual_bound, part), _into_unit_ball(directions)), key=itemgetter(0))
        expected = float(self._shares @ np.linalg.norm(residuals + jacobian @ point, axis=1))
        if self._weights[2] and bound < _LOOSE * expected:
            _, turns = _least_sum_of_norms(residuals[:, 2:], jacobian[:, 2:], self._shares, low, high, begin)
            headings = np.column_stack([np.zeros((len(turns), 2)), turns])
            bound = max(bound, *(self._dual_bound(part, chosen)[0] for chosen in _into_unit_ball(headings)))
        good = point.reshape(3, -1)
        good[2] += centre
        return Node(lower, upper, max(proven, bound), good, looseness)

    def _linearised(self, centre: Array, sums: Complex, slopes: Complex, rows_12: Array) -> tuple[Array, Array]:
        """Weighted errors (S, 3) for no deviation in rows 1 and 2, and their slopes (S, 3, 3r) about ``rows_12``."""
        zeta = rows_12[0] + 1j * rows_12[1]
        moved = self._offset + sums[:, 0]
        turning = slopes[:, 0] + np.einsum("sjl,j->sl", slopes[:, 1:], zeta)
        driving = sums[:, 1:]
        residuals = np.stack([moved.real, moved.imag, self._heading + self._turned @ centre], axis=1)
        still = np.zeros_like(driving.real)
        jacobian = np.stack(
            [
                np.concatenate([driving.real, -driving.imag, turning.real], axis=1),
                np.concatenate([driving.imag, driving.real, turning.imag], axis=1),
                np.concatenate([still, still, self._turned], axis=1),
            ],
            axis=1,
        )
        return residuals * self._weights, jacobian * self._weights[:, None]

    def _dual_bound(self, part: _Part, directions: Array) -> tuple[float, Array]:
        """The least phi in a part of the box for u_s = ``directions`` (S, 3), and its looseness (3, r) (see Node)."""
        lower, upper = part.lower[:2], part.upper[:2]
        centre, reach = (part.lower[2] + part.upper[2]) / 2, (part.upper[2] - part.lower[2]) / 2
        weighted = directions * self._weights * self._shares[:, None]
        along = weighted[:, 0] - 1j * weighted[:, 1]  # Re(along * (x + iy)) is the share of the position errors in phi
        value = along @ part.sums
        slope = np.tensordot(along, part.slopes, (0, 0))  # (1 + r, r)
        curvature = np.tensordot(np.abs(along), self._stamps.curvature, (0, 0))  # (1 + r, r, r)
        corners = np.array(list(product(*((-side, side) for side in reach)))).T  # (r, 2^r)
        turned = weighted[:, 2] @ self._turned
        constant = (along @ self._offset).real + value[0].real + weighted[:, 2] @ self._heading + turned @ centre
        total = constant + (turned + slope[0].real) @ corners
        at_corners = value[1:, None] + slope[1:] @ corners
        for row, factor in enumerate((at_corners.real, -at_corners.imag)):
            total += np.minimum(factor * lower[row][:, None], factor * upper[row][:, None]).sum(axis=0)
        largest = np.maximum(np.abs(lower), np.abs(upper))
        bending = np.tensordot(np.append(1.0, np.hypot(*largest)), curvature, (0, 0))  # (r, r)
        remainder = reach @ bending @ reach / 2
        bilinear = (upper - lower)[..., None] * np.abs([slope[1:].real, slope[1:].imag]) * reach  # (2, r, r)
        in_row_3 = bilinear.sum(axis=(0, 1)) + reach * (bending @ reach + _IMBALANCE)
        looseness = np.vstack([bilinear.sum(axis=2), in_row_3])
        return float(total.min() - remainder - self._rounding), looseness


@dataclass(frozen=True, eq=False)
class _Part:
    """A part of the box with the sums at its middle in row 3."""

    lower: Array
    upper: Array
    sums: Complex
    slopes: Complex


class _StampSums:
    """Sums over the samples up to each stamp, and their derivatives by the deviations of row 3.

    curvature (S, 1 + r, r, r): bounds of their second derivatives. rounding: error of a sum relative to its terms.
    quadrature: error of the quadrature, m.
    """

    def __init__(self, problem: CalibrationProblem, driven: Array) -> None:
        design = problem.start.reshape(3, -1)
        largest = np.abs(design) + np.maximum(problem.upper - problem.start, problem.start - problem.lower).reshape(
            3, -1
        )
        logs = problem.objective.logs(problem.trajectories)
        integration = problem.integration
        paths = [make_path(log, integration) for log in logs]
        speed = np.hypot(largest[0], largest[1])
        nodes = quadrature(paths, largest[2], speed, _QUADRATURE, integration)
        if nodes is None:
            raise ConfigError("samples turn too far for a lower bound with arcs; use integration euler")
        self.quadrature = _QUADRATURE if nodes > 1 or integration == "arc" else 0.0
        self._runs: list[tuple[Array, Array, Array, NDArray[np.intp]]] = []
        curvature = []
        for path, log in zip(paths, logs, strict=True):
            (whole,) = cut(path, largest[2], np.inf)
            angles, before = (
                np.reshape(part, (-1, design.shape[1])) for part in impulses(path, whole, integration, nodes)
            )
            moved, turns = angles @ (design[0] + 1j * design[1]), before @ driven.T
            sources = np.column_stack([moved.real, moved.imag, angles @ driven.T])
            columns = np.concatenate([sources, *(sources * turn[:, None] for turn in turns.T)], axis=1)
            ends = path.ends * nodes
            self._runs.append((columns, before @ design[2] + log.start[2], turns, ends))
            sizes = np.column_stack([np.abs(moved), np.abs(angles @ driven.T)])
            pairs = np.einsum("ij,il,im->ijlm", sizes, np.abs(turns), np.abs(turns))
            curvature.append(np.cumsum(pairs, axis=0)[ends - 1])
        self.curvature = np.concatenate(curvature)
        longest = max(float((np.abs(path.angles) @ speed).sum()) for path in paths)
        angle = max(float((np.abs(path.before) @ largest[2]).max(initial=0.0)) for path in paths)
        terms = nodes * max(len(path.angles) for path in paths) + len(self.curvature) + 1000
        self.rounding = 4 * np.finfo(float).eps * terms * (1 + longest) * (2 + angle)

    def at(self, row_3: Array) -> tuple[Complex, Complex]:
        """Sums (S, 1 + r) and slopes (S, 1 + r, r) at deviations (r,) of row 3.

        The first of the 1 + r is the design's displacement, the others are the regressors of rows 1 and 2.
        """
        sums = np.concatenate([_up_to_stamps(*run, row_3) for run in self._runs])  # (S, (2 + r)(1 + r))
        size = len(row_3)
        parts = sums.reshape(len(sums), 1 + size, 2 + size)
        whole = np.concatenate([parts[:, :, :1] + 1j * parts[:, :, 1:2], parts[:, :, 2:]], axis=2)
        return whole[:, 0], 1j * np.moveaxis(whole[:, 1:], 1, 2)


def _up_to_stamps(columns: Array, phase: Array, turns: Array, ends: NDArray[np.intp], row_3: Array) -> Complex:
    """Sums (S, c) of columns (n, c) times exp(i (phase + turns.row_3)) over the first ``ends`` (S,) rows."""
    angle = phase + turns @ row_3
    cosine, sine = np.cos(angle), np.sin(angle)
    if len(ends) == 1:
        last = int(ends[0])
        return (cosine[:last] @ columns[:last] + 1j * (sine[:last] @ columns[:last]))[None]
    firsts = np.concatenate([[0], ends[:-1]])
    between = np.add.reduceat(columns * cosine[:, None], firsts) + 1j * np.add.reduceat(columns * sine[:, None], firsts)
    between[firsts == ends] = 0.0  # reduceat returns the first row for an empty part
    return np.cumsum(between, axis=0)


def _complement(null: Array, wheels: int) -> Array:
    """Orthonormal directions (r, N) of wheel rates across the null ones; the unit vectors if there are none."""
    if len(null) == 0:
        return np.eye(wheels)
    _, _, directions = np.linalg.svd(np.eye(wheels) - null.T @ null)
    return directions[: wheels - len(null)]


def _least_sum_of_norms(
    residuals: Array, jacobian: Array, shares: Array, lower: Array, upper: Array, begin: Array
) -> tuple[Array, Array]:
    """An approximate minimiser v (n,) of sum_s shares_s |residuals_s + jacobian_s v| in the box, and its dual (S, k).

    Iteratively reweighted least squares: the weighted residuals of the last step solve its normal equations exactly,
    so that scaled into the unit ball they are good duals even where residuals vanish. An unfinished minimisation only
    makes the bound less tight.
    """
    free = (upper > lower) & (np.abs(jacobian).max(axis=(0, 1)) > 0)
    point = np.clip(begin, lower, upper)
    errors = residuals + jacobian @ point
    weights = 1 / np.maximum(np.linalg.norm(errors, axis=1), 1e-300)
    fixed, moving = residuals + jacobian[:, :, ~free] @ point[~free], jacobian[:, :, free]
    columns = moving.reshape(fixed.size, moving.shape[2])
    for step in range(_STEPS if free.any() else 0):
        lengths = np.linalg.norm(errors, axis=1)
        weights = 1 / np.hypot(lengths, 1e-12 + lengths.mean() * 10.0 ** -min(1 + step / 2, _SMOOTHING))
        weighted = columns * np.repeat(shares * weights, fixed.shape[1])[:, None]
        normal, target = weighted.T @ columns, weighted.T @ fixed.ravel()
        scale = 1 / np.sqrt(np.diag(normal))
        factor = np.linalg.cholesky(normal * np.outer(scale, scale) + _RIDGE * np.eye(len(scale))).T
        wanted = -np.linalg.solve(factor.T, scale * target)
        best = scale * np.linalg.solve(factor, wanted)
        if (best < lower[free]).any() or (best > upper[free]).any():
            best = lsq_linear(factor / scale, wanted, (lower[free], upper[free])).x
        settled = 1 + step / 2 > _SMOOTHING and np.abs((best - point[free]) / scale).max() < _SETTLED
        point[free] = np.clip(best, lower[free], upper[free])
        errors = fixed + moving @ point[free]
        if settled:
            break
    return point, errors * weights[:, None]


def _into_unit_ball(directions: Array) -> tuple[Array, Array]:
    """Vectors (S, k) of length about one, scaled into the unit ball: all by one factor, or each by its own.

    The first keeps the balance between the vectors, the second their lengths.
    """
    lengths = np.linalg.norm(directions, axis=1)
    inside = 1 - 1e-14  # margin for rounding
    one_by_one = directions / np.maximum(1.0, lengths)[:, None] * inside
    return directions / max(1.0, float(lengths.max())) * inside, one_by_one
