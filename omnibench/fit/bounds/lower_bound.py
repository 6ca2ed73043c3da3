"""Lower bounds of a sum of norms over a box of matrices.

The cost of a matrix M is

    F(M) = sum_s share_s |W e_s(M)|                                                              (B1)

with e_s the pose error (x, y, heading) at stamp s and W the diagonal matrix of its weights. Duality of the norm
(|v| >= u.v for |u| <= 1) bounds it by a function that is simpler: for any vectors u_s in the unit ball

    F(M) >= phi(M) = sum_s share_s u_s.W e_s(M).                                                 (B2)

The choice of u_s decides how tight the bound is, not whether it holds.

Matrices are M = M0 + D Q with the design M0 and orthonormal directions Q (r, N) of the wheel rates that are fitted, so
that four wheels on three degrees of freedom have r = 3, too. A part of the box bounds the deviations D (3, r); where
r < N the whole is the least such part that contains the box, so that the bound holds, but stays apart from the least
cost of the box if the part holds a better matrix. With
zeta_j = D_1j + i D_2j, the driven angles a_k of sample k and c_k before it, both along Q, position errors x + iy are

    o_s + S_s0(d) + sum_j zeta_j S_sj(d),   S_sj(d) = sum_k a_kj exp(i (m3.C_k + d.c_k)),        (B3)

d being row 3 of D, a_k0 the design's own displacement and m3.C_k its heading; heading errors are linear in d. Summed
over the stamps with v_s = share_s (W u_s)_x - i share_s (W u_s)_y,

    phi = k_0 + k.d + Re H_0(d) + sum_j Re(zeta_j H_j(d)),   H_j(d) = sum_s v_s S_sj(d).         (B4)

About the middle of the part, d = middle + delta with |delta_l| <= rho_l, each H_j is expanded once. From
|exp(ix) - 1 - ix| <= x^2 / 2

    H_j(d) = H_j + dH_j.delta + R_j,   |R_j| <= 1/2 sum_lm rho_l rho_m B_jlm,                    (B5)
    B_jlm = sum_s |v_s| sum_k |a_kj c_kl c_km|.

Without the R_j, phi is linear in delta for given zeta and linear in zeta for given delta. Its least value over the box
of zeta is a minimum of functions that are linear in delta, so that it is concave in delta and least at a corner of the
box of delta (Al-Khayyal and Falk, Math. Oper. Res. 8:273, 1983; Horst and Tuy, Global Optimization, 1996, ch. I). With
h_j = H_j + dH_j.delta there,

    L = min over the corners of  k_0 + k.d + Re(H_0 + dH_0.delta)
        + sum_j [min over D_1j of D_1j Re h_j + min over D_2j of -D_2j Im h_j]                   (B6)
    F >= L - 1/2 sum_lm rho_l rho_m (B_0lm + sum_j max|zeta_j| B_jlm) - w (q + e),               (B7)

w the largest weight, q the error of the quadrature of arcs and e that of rounding (stamp_sums.py). u_s with heading
components alone have H = 0: they are taken where others prove nothing beyond the part that was cut, as in wide boxes.

The part is cut where its width takes most from (B7), which is at most

    row 1: width_j sum_l |Re dH_jl| rho_l,   row 2: width_j sum_l |Im dH_jl| rho_l,              (B8)
    row 3: both, summed over j, and rho_l sum_m (B_0lm + sum_j max|zeta_j| B_jlm) rho_m.

Vectors u_s in the unit ball that make a lower bound tight: the dual solution of a sum of norms in a box.

The bound holds for any u_s; the best are u_s = e_s / |e_s| at the minimiser of the sum of norms

    sum_s share_s |e_s|,   e_s = r_s + J_s v,   lower <= v <= upper,                              (D1)

because sum_s share_s J_s^T u_s vanishes there (or points out of the box), so that phi does not fall with v. Iteratively
reweighted least squares (Daubechies, DeVore, Fornasier and Guentuerk, Comm. Pure Appl. Math. 63:1, 2010) minimises

    sum_s share_s w_s |r_s + J_s v|^2   with   w_s = 1 / sqrt(|e_s|^2 + eps^2)                    (D2)

at the e_s before, with eps falling in steps. The residuals times w_s of the last step,

    u_s = w_s e_s,                                                                                (D3)

solve its normal equations exactly, so that they are balanced even where residuals vanish.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from omnibench.errors import ConfigError
from omnibench.fit.bounds.stamp_sums import StampSums
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.evaluator.element_box import ElementBox
from omnibench.fit.parameterisation import MatrixElements
from omnibench.fit.problem import CalibrationProblem
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex, OdometryBatch

# These numbers change how tight a bound is, not whether it holds. In tests/studies/constants_fit.py each is halved
# and doubled: _SMOOTHING and _SETTLED then move the bound by 4 % and 0.3 % of the gap that is asked for, the others not
# at all.
_STEPS = 25  # steps of the reweighted least squares
_SMOOTHING = 3.0  # digits: eps falls to this negative power of ten of the mean norm
# The reweighting ends when no deviation changes by more, in units in which the normal equations' diagonal is 1.
_SETTLED = 1e-5
_RIDGE = 1e-13  # added to the normalised normal equations, which are singular where the data leave a direction open
_INSIDE = 1 - 1e-14  # length of the vectors: the margin covers the rounding of their norm, some 1e-15


class Minimum(NamedTuple):
    """An approximate minimiser (n,) of Eq. (D1) and its directions (S, k), Eq. (D3)."""

    point: Array
    directions: Array


def least_sum_of_norms(
    residuals: Array, jacobian: Array, shares: Array, lower: Array, upper: Array, begin: Array
) -> Minimum:
    """Minimise sum_s shares_s |residuals_s + jacobian_s v| over v (n,) in the box; residuals (S, k)."""
    free = (upper > lower) & (np.abs(jacobian).max(axis=(0, 1)) > 0)
    point = np.clip(begin, lower, upper)
    errors = residuals + jacobian @ point
    weights = 1 / np.maximum(np.linalg.norm(errors, axis=1), 1e-300)
    fixed, moving = residuals + jacobian[:, :, ~free] @ point[~free], jacobian[:, :, free]
    columns = moving.reshape(fixed.size, moving.shape[2])
    for step in range(_STEPS if free.any() else 0):
        lengths = np.linalg.norm(errors, axis=1)
        weights = 1 / np.hypot(lengths, 1e-12 + lengths.mean() * 10.0 ** -min(1 + step / 2, _SMOOTHING))  # Eq. (D2)
        weighted = columns * np.repeat(shares * weights, fixed.shape[1])[:, None]
        normal, target = weighted.T @ columns, weighted.T @ fixed.ravel()
        scale = 1 / np.sqrt(np.diag(normal))
        factor = np.linalg.cholesky(normal * np.outer(scale, scale) + _RIDGE * np.eye(len(scale))).T
        wanted = -np.linalg.solve(factor.T, scale * target)
        best = scale * np.linalg.solve(factor, wanted)
        if (best < lower[free]).any() or (best > upper[free]).any():
            best = lsq_linear(factor / scale, wanted, (lower[free], upper[free]), method="bvls").x
        settled = 1 + step / 2 > _SMOOTHING and np.abs((best - point[free]) / scale).max() < _SETTLED
        point[free] = np.clip(best, lower[free], upper[free])
        errors = fixed + moving @ point[free]
        if settled:
            break
    return Minimum(point, errors * weights[:, None])  # Eq. (D3)


def into_unit_ball(directions: Array) -> tuple[Array, Array, Array]:
    """Vectors (S, k) of length about one in the unit ball: shrunk by one factor, each by its own, or all of length one.

    The first keeps the balance between the vectors, the second the short ones of residuals that vanish; the third is
    exact in a box without width.
    """
    lengths = np.linalg.norm(directions, axis=1)
    one_by_one = directions / np.maximum(1.0, lengths)[:, None] * _INSIDE
    of_length_one = directions / np.maximum(1e-300, lengths)[:, None] * _INSIDE
    return directions / max(1.0, float(lengths.max())) * _INSIDE, one_by_one, of_length_one


# m or rad per rad: slope of phi that is assumed beside Eq. (B8), so that a part whose width does no harm to first order
# is cut all the same. It decides only where nothing else does: a proof has the same parts with half of it and with
# twice (tests/studies/constants_fit.py).
_IMBALANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Node(ElementBox):
    """A part of the box, given by its deviations (3, r), with its proven bound.

    bound: no matrix in it costs less. good (3, r): deviations of a matrix in it with a low cost. looseness (3, r): by
    how much the width in each deviation may lower the bound, Eq. (B8).
    """

    bound: float
    good: Array
    looseness: Array


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
        odometry = problem.odometry
        if not isinstance(odometry, OdometryBatch):
            raise ConfigError(
                "a lower bound is proven for reference poses alone; of runs with distances, turns and other references "
                "no bound is known, and their calibration cannot be certified"
            )
        self._design = problem.start.reshape(3, -1)
        self._fitted = _complement(parameterisation.null, self._design.shape[1])
        self._box = self._deviations_of_box(problem)
        owner = odometry.trajectory
        self._shares = objective.shares(owner)
        self._weights = np.array(objective.weights)
        elements = ElementBox.of(parameterisation, problem.lower, problem.upper)
        self._stamps = StampSums(problem, self._fitted, elements)
        start = np.array([run.start for run in problem.trajectories])[owner]
        self._offset = start[:, 0] - problem.reference[:, 0] + 1j * (start[:, 1] - problem.reference[:, 1])
        self._turned = odometry.driven @ self._fitted.T
        self._heading = start[:, 2] + odometry.driven @ self._design[2] - problem.reference[:, 2]
        self._size = float(np.abs(problem.reference).max()) + float(np.abs(start).max())

    def root(self, vector: Array) -> Node:
        """The whole box; ``vector`` (n,): first guess of a good matrix."""
        near = (vector.reshape(3, -1) - self._design) @ self._fitted.T
        return self._node(self._box, near)

    def split(self, node: Node) -> tuple[Node, Node]:
        """The node cut in two where its width lowers the bound most; both parts inherit the node's bound.

        Row 3 is halved. Rows 1 and 2, in which the cost is convex, are cut halfway between the good matrix and the
        farther side: the part without the good matrix is usually ruled out at once.
        """
        row, column = np.unravel_index(int(np.argmax(node.looseness)), node.looseness.shape)
        low, high = float(node.lower[row, column]), float(node.upper[row, column])
        border = (low + high) / 2
        if row < 2:
            good = float(node.good[row, column])
            border = (good + (high if high - good > good - low else low)) / 2
        below, above = node.upper.copy(), node.lower.copy()
        below[row, column] = above[row, column] = border
        parts = ElementBox(node.lower, below), ElementBox(above, node.upper)
        return self._node(parts[0], node.good, node.bound), self._node(parts[1], node.good, node.bound)

    def vector(self, deviations: Array) -> Array:
        """Deviations (3, r) as a vector (n,) of the problem."""
        matrix: Array = self._design + deviations @ self._fitted
        return matrix.ravel()

    def _deviations_of_box(self, problem: CalibrationProblem) -> ElementBox:
        """The least part (3, r) whose deviations contain those of all vectors in the problem's box."""
        low = problem.lower.reshape(3, -1) - self._design
        high = problem.upper.reshape(3, -1) - self._design
        positive, negative = np.maximum(self._fitted, 0).T, np.minimum(self._fitted, 0).T
        return ElementBox(low @ positive + high @ negative, high @ positive + low @ negative)

    def _node(self, part: ElementBox, near: Array, proven: float = 0.0) -> Node:
        """A part of the box with its bound; near (3, r): first guess of a good matrix; proven: bound of the whole."""
        begin = np.clip(near, part.lower, part.upper)
        sums, slopes = self._stamps.at(part.centre[2])
        residuals, jacobian = self._linearised(part, sums, slopes, begin[:2])
        middle = part.centre * [[0.0], [0.0], [1.0]]
        box = (part.lower - middle).ravel(), (part.upper - middle).ravel(), (begin - middle).ravel()
        point, directions = least_sum_of_norms(residuals, jacobian, self._shares, *box)
        bounds = [self._dual_bound(part, sums, slopes, scaled) for scaled in into_unit_ball(directions)]
        bound, looseness = max(bounds, key=itemgetter(0))
        if self._weights[2] and bound <= proven:
            turns = least_sum_of_norms(residuals[:, 2:], jacobian[:, 2:], self._shares, *box).directions
            headings = np.column_stack([np.zeros((len(turns), 2)), turns])
            proven = max(proven, *(self._dual_bound(part, sums, slopes, each)[0] for each in into_unit_ball(headings)))
        return Node(part.lower, part.upper, max(proven, bound), point.reshape(3, -1) + middle, looseness)

    def _linearised(self, part: ElementBox, sums: Complex, slopes: Complex, rows_12: Array) -> tuple[Array, Array]:
        """Weighted errors (S, 3) of the part's middle in row 3 and no deviation in rows 1 and 2, and their slopes.

        The slopes (S, 3, 3r) are those at rows 1 and 2 of ``rows_12`` (2, r), Eq. (B3) and (B5).
        """
        zeta = rows_12[0] + 1j * rows_12[1]
        moved = self._offset + sums[:, 0]
        turning = slopes[:, 0] + np.einsum("sjl,j->sl", slopes[:, 1:], zeta)
        driving = sums[:, 1:]
        residuals = np.stack([moved.real, moved.imag, self._heading + self._turned @ part.centre[2]], axis=1)
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

    def _dual_bound(self, part: ElementBox, sums: Complex, slopes: Complex, directions: Array) -> tuple[float, Array]:
        """Bound (B7) of a part for u_s = ``directions`` (S, 3), and its looseness (3, r), Eq. (B8)."""
        lower, upper, reach = part.lower[:2], part.upper[:2], part.reach[2]
        weighted = directions * self._weights * self._shares[:, None]
        along = weighted[:, 0] - 1j * weighted[:, 1]  # v_s of Eq. (B4)
        value = along @ sums
        slope = np.tensordot(along, slopes, (0, 0))  # dH: (1 + r, r)
        curvature = np.tensordot(np.abs(along), self._stamps.curvature, (0, 0))  # B of Eq. (B5): (1 + r, r, r)
        corners = np.array(list(product(*((-side, side) for side in reach)))).T  # (r, 2^r)
        turned = weighted[:, 2] @ self._turned
        constant = (
            (along @ self._offset).real + value[0].real + weighted[:, 2] @ self._heading + turned @ part.centre[2]
        )
        total = constant + (turned + slope[0].real) @ corners  # Eq. (B6), first line
        at_corners = value[1:, None] + slope[1:] @ corners
        for row, factor in enumerate((at_corners.real, -at_corners.imag)):  # Eq. (B6), second line
            total += np.minimum(factor * lower[row][:, None], factor * upper[row][:, None]).sum(axis=0)
        bending = np.tensordot(np.append(1.0, part.speed), curvature, (0, 0))  # (r, r)
        remainder = reach @ bending @ reach / 2
        widths = upper - lower
        bilinear = widths[..., None] * np.abs([slope[1:].real, slope[1:].imag]) * reach  # (2, r, r)
        in_rows_12 = bilinear.sum(axis=2) + widths * _IMBALANCE
        in_row_3 = bilinear.sum(axis=(0, 1)) + reach * (bending @ reach + _IMBALANCE)
        error = float(np.abs(self._weights).max()) * self._stamps.error(reach, self._size)
        return float(total.min() - remainder - error), np.vstack([in_rows_12, in_row_3])  # Eq. (B7), (B8)


def _complement(null: Array, wheels: int) -> Array:
    """Orthonormal directions (r, N) of wheel rates across the null ones; the unit vectors if there are none."""
    if len(null) == 0:
        return np.eye(wheels)
    _, _, directions = np.linalg.svd(np.eye(wheels) - null.T @ null)
    return directions[: wheels - len(null)]
