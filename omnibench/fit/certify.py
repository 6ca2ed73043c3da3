"""Certificate of optimality: a proven bound on how much better than a calibration any matrix in a box could be.

Branch and bound on the matrix elements (Horst and Tuy, Global Optimization, 1996, ch. IV): the parts P that the box is
cut into have the lower bounds b(P) of the class LowerBounds, which rest on sums over the samples (StampSums) and on a
dual solution (least_sum_of_norms); M is the best matrix that is known. At any time

    min over P of b(P)  <=  least cost in the box  <=  F(M)                                        (C1)
    gap = 1 - min b(P) / F(M).                                                                     (C2)

The part with the lowest bound, which alone can raise the minimum, is cut in two until the gap is as small as wanted.
"""

from __future__ import annotations

import heapq
import math
import time
from dataclasses import dataclass
from functools import partial
from itertools import product
from operator import itemgetter
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from omnibench.config import Model
from omnibench.data.dataset import Dataset
from omnibench.data.splits import training_split
from omnibench.errors import ConfigError, DataError, require_choice, require_range, require_type
from omnibench.fit.calibrator import run_calibrator
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.evaluator import ElementBox, impulses, make_path, quadrature
from omnibench.fit.parameterisation import Box, BoxName, ExplicitBox, MatrixElements
from omnibench.fit.problem import CalibrationProblem, make_problem
from omnibench.fit.settings import CompleteSettings, CostChoice
from omnibench.jobs.job import Backend, gathered
from omnibench.processes import one_thread
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import calibrators
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex, Integration, OdometryBatch, WheelLog
from omnibench.robot.stored_odometry import EachLog
from omnibench.views import Brief

# m: error of the quadrature of arcs, which bounds subtract: a millionth of the millimetre that poses are known to.
# Half of it and twice move a bound by 6e-6 of the gap that is asked for (tests/studies/constants_fit.py).
QUADRATURE = 1e-9
# These numbers change how tight a bound is, not whether it holds. In tests/studies/constants_fit.py each is halved
# and doubled: _SMOOTHING and _SETTLED then move the bound by 4 % and 0.3 % of the gap that is asked for, the others not
# at all.
_STEPS = 25  # steps of the reweighted least squares
_SMOOTHING = 3.0  # digits: eps falls to this negative power of ten of the mean norm
# The reweighting ends when no deviation changes by more, in units in which the normal equations' diagonal is 1.
_SETTLED = 1e-5
_RIDGE = 1e-13  # added to the normalised normal equations, which are singular where the data leave a direction open
_INSIDE = 1 - 1e-14  # length of the vectors: the margin covers the rounding of their norm, some 1e-15
# m or rad per rad: slope of phi that is assumed beside Eq. (B8), so that a part whose width does no harm to first order
# is cut all the same. It decides only where nothing else does: a proof has the same parts with half of it and with
# twice (tests/studies/constants_fit.py).
_IMBALANCE = 1e-9
_TIMED = 3  # parts whose mean time stands for that of all: the whole box and its first two parts
# Parts of proofs to a gap of 0.1 %: the median and the fewest of twelve of simulated data (61 to 379), and the 901 of
# the real omni3 in the box paper. A tenth of the gap takes about twice as many (tests/studies/proof_parts.py).
_PARTS, _FEW_PARTS, _MANY_PARTS = 150, 60, 900
_PARTS_GAP = 1e-3
# Parts that are cut at once by a backend, and how often each, however many workers it has: a cut takes 10 to 20 ms, to
# send what it needs as much again (chosen).
_AT_ONCE, _CUTS = 8, 32


class StampSums:
    """Sums over the samples up to each stamp, on which a lower bound rests, and the error of computing them.

    At row 3 = m3 + d, with the angles a_k that sample k drives and c_k before it along the fitted directions,

        S_sj(d) = sum_k a_kj exp(i (m3.C_k + d.c_k)),   dS_sj/dd_l = i sum_k a_kj c_kl exp(...)        (S1)
        |d^2 S_sj / dd_l dd_m| <= sum_k |a_kj c_kl c_km|.                                              (S2)

    An Euler step is one sample k. An arc is an integral along the sample, taken by Gauss-Legendre quadrature with
    enough nodes that its error (fit/evaluator.py) sums up to q = 1e-9 m at most over a run, for every matrix of the
    box.

    Rounding: with u = 2^-53, n additions into one number are wrong by less than 1.01 n u of the largest magnitude that
    their partial sums have (Higham, Accuracy and Stability of Numerical Algorithms, 2002, sections 3.1 and 4.2). With L
    the longest path of the box (m) and A the largest heading that it allows at any sample (rad), partial sums of phases
    are at most A and those of the sums at most L: the phases are wrong by at most 1.01 n u A, hence the sums by 1.01 n
    u (1 + A) L. In a part of the box the slopes are multiplied by delta with |delta.c_k| <= C, the bounds of curvature
    by C^2 / 2. Offsets and headings are differences of numbers of size P. Altogether the rounding is below

        e = 8 n u (1 + L) (2 + A) (1 + C)^2 (1 + P).                                                   (S3)

    The factor 8 covers the few operations on each term; n are the samples, the stamps and 1000 for all else, which are
    some dozens.

    curvature (S, 1 + r, r, r): the bounds of Eq. (S2). fitted (r, N): orthonormal directions of wheel rates. elements:
    a box that holds all matrices of the problem's box. ConfigError where arcs are too long for the quadrature.
    """

    def __init__(self, problem: CalibrationProblem, fitted: Array, elements: ElementBox) -> None:
        logs = problem.objective.logs(problem.trajectories)
        integration = problem.integration
        paths = EachLog(partial(make_path, integration=integration), logs)
        row, speed = elements.largest[2], elements.speed
        nodes = quadrature(paths, row, speed, QUADRATURE, integration)
        if nodes is None:
            raise ConfigError("samples turn too far for a lower bound with arcs; use integration euler")
        self._quadrature = QUADRATURE if integration == "arc" else 0.0
        design = problem.start.reshape(3, -1)
        self._runs = EachLog(partial(_RunColumns, design, fitted, integration, nodes), logs)
        self.curvature = np.concatenate([run.curvature for run in self._runs])
        reaches = [
            ((np.abs(path.angles) @ speed).sum(), (np.abs(path.before) @ row).max(initial=0.0)) for path in paths
        ]
        longest, angle = np.array(reaches).max(axis=0).tolist()
        self._farthest = np.max([np.abs(run.turns).max(axis=0) for run in self._runs], axis=0)  # |c|: (r,)
        additions = nodes * max(len(path.angles) for path in paths) + len(self.curvature) + 1000
        self._rounding = 4 * np.finfo(float).eps * additions * (1 + longest) * (2 + angle)  # eps = 2 u

    def at(self, row_3: Array) -> tuple[Complex, Complex]:
        """Sums (S, 1 + r) and slopes (S, 1 + r, r) at deviations (r,) of row 3, Eq. (S1).

        The first of the 1 + r is the design's displacement, the others are the regressors of rows 1 and 2.
        """
        sums = np.concatenate([run.up_to_stamps(row_3) for run in self._runs])  # (S, (2 + r)(1 + r))
        size = len(row_3)
        parts = sums.reshape(len(sums), 1 + size, 2 + size)
        whole = np.concatenate([parts[:, :, :1] + 1j * parts[:, :, 1:2], parts[:, :, 2:]], axis=2)
        return whole[:, 0], 1j * np.moveaxis(whole[:, 1:], 1, 2)

    def error(self, reach: Array, size: float) -> float:
        """Error, m or rad, of quadrature and rounding, q + e of Eq. (S3), in a part of half-widths ``reach`` (r,).

        size: magnitude P of poses and references.
        """
        turned = float(self._farthest @ reach)
        return self._quadrature + self._rounding * (1 + turned) ** 2 * (1 + size)


class _RunColumns:
    """A run's impulses, n: columns (n, (2 + r)(1 + r)), phase (n,) at the design, turns (n, r) along the fitted
    directions, sizes (n, 1 + r) of Eq. (S2); ends (S,): the impulses up to each stamp. See StampSums.
    """

    def __init__(self, design: Array, fitted: Array, integration: Integration, nodes: int, log: WheelLog) -> None:
        path = make_path(log, integration)
        # One row of zeros more: the sum up to a stamp at the end, or at t = 0, then begins at a row that exists.
        angles, before = (
            np.vstack([np.reshape(part, (-1, len(design[0]))), np.zeros((1, len(design[0])))])
            for part in impulses(path, integration, nodes)
        )
        moved, along, self.turns = angles @ (design[0] + 1j * design[1]), angles @ fitted.T, before @ fitted.T
        sources = np.column_stack([moved.real, moved.imag, along])
        self.columns = np.concatenate([sources, *(sources * turn[:, None] for turn in self.turns.T)], axis=1)
        self.phase = before @ design[2] + float(log.start[2])
        self.ends: NDArray[np.intp] = path.ends * nodes
        self.sizes = np.column_stack([np.abs(moved), np.abs(along)])

    @property
    def curvature(self) -> Array:
        """Bounds (S, 1 + r, r, r) of the second derivatives, Eq. (S2)."""
        pairs = np.einsum("ij,il,im->ijlm", self.sizes, np.abs(self.turns), np.abs(self.turns))
        sums = np.cumsum(np.roll(pairs, 1, axis=0), axis=0)  # the row of zeros comes first
        return np.asarray(sums[self.ends])

    def up_to_stamps(self, row_3: Array) -> Complex:
        """Sums (S, c) of columns (n, c) times exp(i (phase + turns.row_3)) up to each stamp."""
        columns, ends = self.columns, self.ends
        angle = self.phase + self.turns @ row_3
        cosine, sine = np.cos(angle), np.sin(angle)
        if len(ends) == 1:
            last = int(ends[0])
            return (cosine[:last] @ columns[:last] + 1j * (sine[:last] @ columns[:last]))[None]
        firsts = np.concatenate([[0], ends[:-1]])
        between: Complex = np.add.reduceat(columns * cosine[:, None], firsts) + 1j * np.add.reduceat(
            columns * sine[:, None], firsts
        )
        between[firsts == ends] = 0.0  # reduceat returns the first row for an empty part
        return np.cumsum(between, axis=0)


def least_sum_of_norms(
    residuals: Array, jacobian: Array, shares: Array, lower: Array, upper: Array, begin: Array
) -> tuple[Array, Array]:
    """Minimum over v (n,) in a box of a sum of norms, with the vectors u_s of the best bound, its dual solution.

    The bound holds for any u_s; the best are u_s = e_s / |e_s| at the minimiser of the sum of norms

        sum_s share_s |e_s|,   e_s = r_s + J_s v,   lower <= v <= upper,                              (D1)

    because sum_s share_s J_s^T u_s vanishes there (or points out of the box), so that phi does not fall with v.
    Iteratively reweighted least squares (Daubechies, DeVore, Fornasier and Guentuerk, Comm. Pure Appl. Math. 63:1,
    2010) minimises

        sum_s share_s w_s |r_s + J_s v|^2   with   w_s = 1 / sqrt(|e_s|^2 + eps^2)                    (D2)

    at the e_s before, with eps falling in steps. The residuals times w_s of the last step,

        u_s = w_s e_s,                                                                                (D3)

    solve its normal equations exactly, so that they are balanced even where residuals vanish.

    residuals (S, k), jacobian (S, k, n), shares (S,), lower, upper and begin (n,). Returns an approximate
    minimiser (n,) and its directions (S, k).
    """
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
        solved = -np.linalg.solve(factor.T, scale * target)
        best = scale * np.linalg.solve(factor, solved)
        if (best < lower[free]).any() or (best > upper[free]).any():
            best = lsq_linear(factor / scale, solved, (lower[free], upper[free]), method="bvls").x
        settled = 1 + step / 2 > _SMOOTHING and np.abs((best - point[free]) / scale).max() < _SETTLED
        point[free] = np.clip(best, lower[free], upper[free])
        errors = fixed + moving @ point[free]
        if settled:
            break
    return point, errors * weights[:, None]  # Eq. (D3)


def into_unit_ball(directions: Array) -> tuple[Array, Array, Array]:
    """Vectors (S, k) of length about one in the unit ball: shrunk by one factor, each by its own, or all of length one.

    The first keeps the balance between the vectors, the second the short ones of residuals that vanish; the third is
    exact in a box without width.
    """
    lengths = np.linalg.norm(directions, axis=1)
    one_by_one = directions / np.maximum(1.0, lengths)[:, None] * _INSIDE
    of_length_one = directions / np.maximum(1e-300, lengths)[:, None] * _INSIDE
    return directions / max(1.0, float(lengths.max())) * _INSIDE, one_by_one, of_length_one


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
    """Lower bounds of a problem's cost, a sum of norms, over parts of its box.

    The cost of a matrix M is

        F(M) = sum_s share_s |W e_s(M)|                                                              (B1)

    with e_s the pose error (x, y, heading) at stamp s and W the diagonal matrix of its weights. Duality of the norm
    (|v| >= u.v for |u| <= 1) bounds it by a function that is simpler: for any vectors u_s in the unit ball

        F(M) >= phi(M) = sum_s share_s u_s.W e_s(M).                                                 (B2)

    The choice of u_s decides how tight the bound is, not whether it holds.

    Matrices are M = M0 + D Q with the design M0 and orthonormal directions Q (r, N) of the wheel rates that are fitted,
    so that four wheels on three degrees of freedom have r = 3, too. A part of the box bounds the deviations D (3, r);
    where r < N the whole is the least such part that contains the box, so that the bound holds, but stays apart from
    the least cost of the box if the part holds a better matrix. With zeta_j = D_1j + i D_2j, the driven angles a_k of
    sample k and c_k before it, both along Q, position errors x + iy are

        o_s + S_s0(d) + sum_j zeta_j S_sj(d),   S_sj(d) = sum_k a_kj exp(i (m3.C_k + d.c_k)),        (B3)

    d being row 3 of D, a_k0 the design's own displacement and m3.C_k its heading; heading errors are linear in d.
    Summed over the stamps with v_s = share_s (W u_s)_x - i share_s (W u_s)_y,

        phi = k_0 + k.d + Re H_0(d) + sum_j Re(zeta_j H_j(d)),   H_j(d) = sum_s v_s S_sj(d).         (B4)

    About the middle of the part, d = middle + delta with |delta_l| <= rho_l, each H_j is expanded once. From |exp(ix) -
    1 - ix| <= x^2 / 2

        H_j(d) = H_j + dH_j.delta + R_j,   |R_j| <= 1/2 sum_lm rho_l rho_m B_jlm,                    (B5)
        B_jlm = sum_s |v_s| sum_k |a_kj c_kl c_km|.

    Without the R_j, phi is linear in delta for given zeta and linear in zeta for given delta. Its least value over the
    box of zeta is a minimum of functions that are linear in delta, so that it is concave in delta and least at a corner
    of the box of delta (Al-Khayyal and Falk, Math. Oper. Res. 8:273, 1983; Horst and Tuy, Global Optimization, 1996,
    ch. I). With h_j = H_j + dH_j.delta there,

        L = min over the corners of  k_0 + k.d + Re(H_0 + dH_0.delta)
            + sum_j [min over D_1j of D_1j Re h_j + min over D_2j of -D_2j Im h_j]                   (B6)
        F >= L - 1/2 sum_lm rho_l rho_m (B_0lm + sum_j max|zeta_j| B_jlm) - w (q + e),               (B7)

    w the largest weight, q the error of the quadrature of arcs and e that of rounding, Eq. (S3). u_s with heading
    components alone have H = 0: they are taken where others prove nothing beyond the part that was cut, as in wide
    boxes.

    The part is cut where its width takes most from (B7), which is at most

        row 1: width_j sum_l |Re dH_jl| rho_l,   row 2: width_j sum_l |Im dH_jl| rho_l,              (B8)
        row 3: both, summed over j, and rho_l sum_m (B_0lm + sum_j max|zeta_j| B_jlm) rho_m.

    ConfigError for another parameterisation than the matrix, or a cost that is no sum of norms.
    """

    def __init__(self, problem: CalibrationProblem) -> None:
        parameterisation, objective = problem.parameterisation, problem.objective
        if not isinstance(parameterisation, MatrixElements):
            raise ConfigError("a lower bound needs the matrix parameterisation; its box holds what a geometry can do")
        if not isinstance(objective, SumOfNorms):
            raise ConfigError(f"a lower bound needs a cost that is a sum of norms, which {objective.name} is not")
        odometry = problem.odometry
        if not isinstance(odometry, OdometryBatch):
            raise ConfigError("a lower bound needs reference poses alone: of other references none is known")
        self._design = problem.start.reshape(3, -1)
        # Orthonormal directions (r, N) of wheel rates across the null ones, the unit vectors if there are none.
        null, unit = parameterisation.null, np.eye(self._design.shape[1])
        self._fitted = unit if len(null) == 0 else np.linalg.svd(unit - null.T @ null)[2][: len(unit) - len(null)]
        # The least part (3, r) whose deviations contain those of all vectors in the problem's box.
        low, high = (bound.reshape(3, -1) - self._design for bound in (problem.lower, problem.upper))
        positive, negative = np.maximum(self._fitted, 0).T, np.minimum(self._fitted, 0).T
        self._box = ElementBox(low @ positive + high @ negative, high @ positive + low @ negative)
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
        return (self._design + deviations @ self._fitted).ravel()

    def _node(self, part: ElementBox, near: Array, proven: float = 0.0) -> Node:
        """A part of the box with its bound; near (3, r): first guess of a good matrix; proven: bound of the whole."""
        begin = np.clip(near, part.lower, part.upper)
        sums, slopes = self._stamps.at(part.centre[2])
        # Weighted errors (S, 3) of the part's middle in row 3 and no deviation in rows 1 and 2, and their slopes
        # (S, 3, 3r) at rows 1 and 2 of the first guess, Eq. (B3) and (B5).
        moved, driving = self._offset + sums[:, 0], sums[:, 1:]
        turning = slopes[:, 0] + np.einsum("sjl,j->sl", slopes[:, 1:], begin[0] + 1j * begin[1])
        errors = np.stack([moved.real, moved.imag, self._heading + self._turned @ part.centre[2]], axis=1)
        still = np.zeros_like(driving.real)
        x = np.concatenate([driving.real, -driving.imag, turning.real], axis=1)
        y = np.concatenate([driving.imag, driving.real, turning.imag], axis=1)
        heading = np.concatenate([still, still, self._turned], axis=1)
        residuals = errors * self._weights
        jacobian = np.stack([x, y, heading], axis=1) * self._weights[:, None]
        # The dual solution of the sum of norms, and the best of the bounds that its directions prove.
        middle = part.centre * [[0.0], [0.0], [1.0]]
        box = (part.lower - middle).ravel(), (part.upper - middle).ravel(), (begin - middle).ravel()
        point, directions = least_sum_of_norms(residuals, jacobian, self._shares, *box)
        bounds = [self._dual_bound(part, sums, slopes, scaled) for scaled in into_unit_ball(directions)]
        bound, looseness = max(bounds, key=itemgetter(0))
        if self._weights[2] and bound <= proven:
            _, turns = least_sum_of_norms(residuals[:, 2:], jacobian[:, 2:], self._shares, *box)
            headings = np.column_stack([np.zeros((len(turns), 2)), turns])
            bounds = [self._dual_bound(part, sums, slopes, scaled) for scaled in into_unit_ball(headings)]
            proven = max(proven, *(by_headings for by_headings, _ in bounds))
        return Node(part.lower, part.upper, max(proven, bound), point.reshape(3, -1) + middle, looseness)

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


@dataclass(frozen=True, eq=False, repr=False)
class Proof(Brief):
    """State of the branch and bound: no matrix of the box costs less than ``lower_bound``.

    best_cost, best_vector (n,): the best matrix that is known. boxes: number of parts bounded so far. finished: False
    when time or parts ran out.
    """

    lower_bound: float
    best_cost: float
    best_vector: Array
    boxes: int
    seconds: float
    finished: bool


class Certificate(Model):
    """Largest possible distance of a calibration's cost from the optimum: ``gap`` = 1 - lower_bound / cost.

    cost: on the training split; of a calibration that has effects or weighs the design, that of the optimum without.
    lower_bound: no matrix in the box costs less. shrinking: share by which the calibration costs more than that
    optimum; None for others.
    """

    cost: float
    lower_bound: float
    gap: float
    box: str
    seconds: float
    shrinking: float | None = None


@dataclass(frozen=True, eq=False, repr=False)
class CertifiedCalibration(Brief):
    """A certificate with its proof. inside: True if the calibration lies in the box. held: names of fixed elements."""

    certificate: Certificate
    proof: Proof
    cost_name: str
    dataset: Dataset
    inside: bool
    held: tuple[str, ...]


def certify_optimum(
    calibration: Calibration,
    dataset: Dataset,
    *,
    box: Box | None = None,
    gap: float = 1e-3,
    seconds: float = 60.0,
    parts: int | None = None,
    watch: Reporter = no_progress,
    backend: Backend | None = None,
) -> CertifiedCalibration:
    """Bound how much better than a calibration any matrix of the box could be, on a data set's training split.

    Cost and integration are those of the calibration. Of one that has effects, or weighs the design, the optimum of the
    matrix alone is certified, found anew, and by how much the calibration costs more. box: default the one that was
    searched, or ``row``.
    watch: told early about how long the proof takes, then of every part.
    gap: stop when the best known matrix is proven to be this close to the optimum. seconds, parts: stop after this time
    or after so many parts of the box; the number ends a proof at the same place on every machine. backend: bounds parts
    as jobs, several at once; the proof is then the same on every backend, and has other parts than without one.
    Raises DataError when the wheels differ, the calibration was fitted with a robust loss, or the
    training split is empty, ConfigError for a cost that is no sum of norms.
    """
    require_type(calibration, Calibration, "read_calibration")
    require_type(dataset, Dataset, "load_dataset")
    if not (box is None or isinstance(box, ExplicitBox)):
        require_choice("box", box, get_args(BoxName))
    require_range("gap", gap, 0, 1)
    calibration.check_wheels(dataset.robot, f"the data set {dataset.name}")
    provenance = calibration.provenance
    if provenance is not None and provenance.loss is not None:
        fitted = f"calibration {calibration.name!r} was fitted with the loss {provenance.loss}"
        raise DataError(f"{fitted}, of which no bound is known; certify one that was fitted without --loss")
    settings = CompleteSettings(
        calibrator="closed_form",
        cost=CostChoice(name=provenance.cost) if provenance else CostChoice(),
        parameterisation="matrix",
        box=box or ("paper" if provenance and provenance.box == "paper" else "row"),
        integration=calibration.integration,
        seed=0,
        unidentified="keep",
        mount=provenance.mount if provenance else "known",
    )
    problem = make_problem(settings, dataset.robot, training_split(dataset))
    vector = calibration.matrix_array.ravel()
    cost = problem.objective.of_model(calibration.model, problem.trajectories)
    inside = bool(problem.inside(vector[None])[0])
    shrinking = None
    weighed = provenance is not None and provenance.unidentified in ("shrink", "weigh")
    if calibration.effects or weighed:
        optimum = run_calibrator(calibrators.create(settings.calibrator), problem)
        if optimum.vector is None or optimum.cost is None:
            raise DataError(f"{calibration.name!r}: the optimum of the matrix alone is not found: {optimum.reason}")
        if optimum.cost > problem.objective.rounding:  # no share of rounding means anything
            vector, inside, shrinking, cost = optimum.vector, True, cost / optimum.cost - 1, optimum.cost
    began = time.perf_counter()

    def foretell(event: Progress) -> None:
        watch(event)
        if event.done == _TIMED and (parts or math.inf) > _TIMED and gap > 0:  # to a gap of 0 the limits end it
            of_part = (time.perf_counter() - began) / _TIMED
            growth = 2 ** math.log10(_PARTS_GAP / gap)
            about, least, most = (growth * number for number in (_PARTS, _FEW_PARTS, _MANY_PARTS))
            words = (
                f"a proof to within {gap:.3g} of the cost takes about {of_part * about:.2g} s here "
                f"({of_part * least:.2g} to {of_part * most:.2g} s: {least:.0f} to {most:.0f} parts at {of_part:.2g} s)"
            )
            limits = [f"{seconds:g} s"] * math.isfinite(seconds) + [f"{parts} parts"] * (parts is not None)
            words += f"; it ends after {' or '.join(limits)} at the latest" if limits else ""
            watch(Progress("duration", result=words))

    known = vector if inside else problem.start
    proof = prove(problem, known, gap=gap, seconds=seconds, parts=parts, watch=foretell, backend=backend)
    lowest, spent = proof.lower_bound, proof.seconds
    certificate = Certificate(
        cost=cost, lower_bound=lowest, gap=proven_gap(cost, lowest), box=problem.box, seconds=spent, shrinking=shrinking
    )
    return CertifiedCalibration(certificate, proof, problem.objective.name, dataset, inside, problem.held)


def proven_gap(cost: float, lower_bound: float) -> float:
    """Largest share of a cost that could be saved; negative for a matrix outside the box that beats the bound.

    0 for a cost that no bound can see: it is rounding.
    """
    return 1 - lower_bound / cost if cost >= QUADRATURE else 0.0


def prove(
    problem: CalibrationProblem,
    known: Array,
    *,
    gap: float = 1e-3,
    seconds: float = 60.0,
    parts: int | None = None,
    watch: Reporter = no_progress,
    backend: Backend | None = None,
) -> Proof:
    """A lower bound of the cost over the problem's box, within ``gap`` of the best cost known unless the limits end it.

    known (n,): a good vector in the box. seconds, parts, backend: as in certify_optimum. ConfigError when the problem
    has no such bound (see LowerBounds).
    """
    began = time.perf_counter()
    with one_thread():
        bounds = LowerBounds(problem)
        count, order = 1, 0
        best_cost, best_vector = float(problem.values(known[None])[0]), known
        root = bounds.root(known)
        boxes: list[tuple[float, int, Node]] = [(root.bound, 0, root)]
        while True:
            lowest, _, node = boxes[0]
            proven = min(lowest, best_cost)  # Eq. (C1)
            spent = time.perf_counter() - began
            closed = proven >= (1 - gap) * best_cost or best_cost < QUADRATURE  # Eq. (C2); no bound sees less
            finished = closed or not node.looseness.any()
            proof = Proof(proven, best_cost, best_vector, count, spent, finished)
            watch(Progress("proof", count, None, "part", best_cost, f"bound {proven:.6f}"))
            if finished or spent > seconds or count >= (parts or math.inf):
                return proof
            # Cut the part with the lowest bound; several at once, and each several times, where a backend takes jobs.
            together, cuts = (1, 1) if backend is None else (_AT_ONCE, _CUTS)
            enough = (1 - gap) * best_cost
            nodes = [heapq.heappop(boxes)[2]]
            while boxes and len(nodes) < together and boxes[0][0] < enough and boxes[0][2].looseness.any():
                nodes.append(heapq.heappop(boxes)[2])
            if parts:
                cuts = min(cuts, max((parts - count) // (2 * len(nodes)), 1))
            orders = [(bounds, node, enough, cuts) for node in nodes]
            for halves, made in gathered(backend, _branch, orders, shared=(bounds,)):
                count += made
                for part in halves:
                    vector = bounds.vector(part.good)
                    if problem.inside(vector[None])[0] and (cost := float(problem.values(vector[None])[0])) < best_cost:
                        best_cost, best_vector = cost, vector
                    order += 1
                    heapq.heappush(boxes, (part.bound, order, part))  # order breaks ties: nodes cannot be compared


def _branch(order: tuple[LowerBounds, Node, float, int], _: Reporter) -> tuple[list[Node], int]:
    """Cut a node in a job, its lowest part first, until all bounds reach the one that is enough, or so many times.

    Returns the parts, and how many were bounded on the way.
    """
    bounds, node, enough, cuts = order
    boxes, made = [(node.bound, 0, node)], 0
    while not made or (made < 2 * cuts and boxes[0][0] < enough and boxes[0][2].looseness.any()):
        for part in bounds.split(heapq.heappop(boxes)[2]):
            made += 1
            heapq.heappush(boxes, (part.bound, made, part))
    return [part for _, _, part in boxes], made
