"""Least squares of pose errors: linear ones with the headings of the reference, and reweighted ones for robust costs.

With C_s the wheel angles driven up to stamp s and a_k those of sample k, a run that starts at (x, y, theta)_0 obeys

    theta_s - theta_0 = m3.C_s                                                                   (L1)
    (x + iy)_s - (x + iy)_0 = (m1 + i m2).sum_k a_k exp(i theta(k))                              (L2)

for the matrix with rows m1, m2, m3. With theta(k) interpolated between reference poses, both are linear in them: this
is where searches begin.

Gauss-Newton steps within the box of a calibration problem lead to the minimum of a robust cost. They reweight: at the
weights w of fit/loss.py, Eq. (5), of the present errors e_i, a step d minimises

    sum_i p_i w_i |e_i + J_i d|^2,                                                               (G1)

which for linear poses lowers the cost with every step (iteratively reweighted least squares: its squares lie above the
loss and touch it; Lange, Hunter and Yang, J. Comput. Graph. Stat. 9:1, 2000). It is halved where curved poses do not.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.fit.calibrator import Solution
from omnibench.fit.loss import RobustCost
from omnibench.fit.noise import roots_of
from omnibench.fit.problem import CalibrationProblem
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch

_ROUNDING = 1e-12  # share of chi2: an increase that is no increase
_ROOM = 1e-9  # share of the box: lsq_linear needs an interior, and the vector is clipped afterwards
_MOST_REWEIGHTED_STEPS = 300  # steps; 20 to 60 are usual
_MOST_REWEIGHTED_HALVINGS = 30  # lengths of one step that are tried, each half the one before: down to a billionth


def linear_fit(
    odometry: OdometryBatch, runs: Sequence[Trajectory], reference: Array, design: Array, directions: Array
) -> Array:
    """The matrix (3, N) that fits reference poses (S, 3) at the stamps of ``odometry``, made from ``runs``.

    directions (r, N): orthonormal directions of wheel rates that are fitted; along the others it keeps ``design``.
    """
    basis = directions.T
    moved, columns = linear_system(odometry, runs, reference)
    turned = moved[:, 2] - odometry.driven @ design[2]
    row_3 = basis @ np.linalg.lstsq(odometry.driven @ basis, turned, rcond=None)[0]  # Eq. (L1)
    missing = moved[:, 0] + 1j * moved[:, 1] - columns @ (design[0] + 1j * design[1])
    rows_12 = basis @ np.linalg.lstsq(columns @ basis, missing, rcond=None)[0]  # Eq. (L2)
    return np.asarray(design + np.stack([rows_12.real, rows_12.imag, row_3]))


def linear_system(
    odometry: OdometryBatch,
    runs: Sequence[Trajectory],
    reference: Array,
    used: Sequence[NDArray[np.bool_]] | None = None,
) -> tuple[Array, NDArray[np.complex128]]:
    """The left side of Eq. (L1) and (L2): motions (S, 3) since the start; and the factor of m1 + i m2, (S, N).

    used: for each run, True (K,) for the reference poses between which headings are interpolated; default all.
    """
    moved = reference - np.array([run.start for run in runs])[odometry.trajectory]
    chosen = [np.ones(len(run.poses), dtype=bool) for run in runs] if used is None else used
    headings = (
        np.interp(np.append(0.0, run.times[:-1]), run.pose_times[near], run.poses[near, 2])
        for run, near in zip(runs, chosen, strict=True)
    )
    return moved, odometry.position_design(headings)


def bounded_step(problem: CalibrationProblem, vector: Array, information: Array, score: Array) -> Array:
    """The step d (n,) within the box that minimises d'A d / 2 + g'd; zero along directions without information.

    information (n, n): A. score (n,): g.
    """
    free = problem.free
    step = np.zeros(len(vector))
    if not free.any():
        return step
    unit = (problem.upper - problem.lower)[free]
    information = information[np.ix_(free, free)] * np.outer(unit, unit)
    roots = roots_of(information)
    target = -roots.T @ (score[free] * unit)
    inner = roots @ target
    low, high = ((bound - vector)[free] / unit for bound in (problem.lower, problem.upper))
    if ((inner < low) | (inner > high)).any() and roots.size:
        bounds = (np.minimum(low, 0.0) - _ROOM, np.maximum(high, 0.0) + _ROOM)
        inner = scipy.optimize.lsq_linear(roots.T @ information, target, bounds=bounds, tol=1e-12).x
    step[free] = inner * unit
    return step


def reweighted_minimum(
    problem: CalibrationProblem, objective: RobustCost, vector: Array, tolerance: float
) -> tuple[Array, int, bool]:
    """The vector (n,) of least cost near another one, after how many steps, and True if the last was small.

    objective: may have another loss than the problem's. tolerance: largest change of a matrix element in the last step.
    ``problem.cost`` counts every vector that is tried.
    """
    owner = problem.odometry.trajectory
    factors = np.array(objective.base.weights)
    shares = objective.base.shares(owner)
    for count in range(1, _MOST_REWEIGHTED_STEPS + 1):
        matrix = problem.matrix(vector)
        errors = problem.odometry.poses(matrix[None])[0] - problem.reference
        slopes = problem.parameterisation.slopes(vector)
        jacobian = problem.odometry.jacobian(matrix).reshape(len(errors), 3, -1) @ slopes
        weights = objective.loss.weights(objective.ratios(errors, owner))
        roots = np.sqrt(shares * weights)[:, None] * factors
        columns, values = (roots[..., None] * jacobian).reshape(-1, len(vector)), (roots * errors).ravel()
        step = bounded_step(problem, vector, columns.T @ columns, columns.T @ values)  # Eq. (G1)
        cost = float(objective.combine(errors[None], owner)[0])
        for halvings in range(_MOST_REWEIGHTED_HALVINGS):
            trial = problem.settled(vector + 0.5**halvings * step)
            if not np.isfinite(problem.cost(trial[None])[0]):
                continue
            poses = problem.odometry.poses(problem.matrix(trial)[None])[0]
            if float(objective.combine((poses - problem.reference)[None], owner)[0]) <= cost * (1 + _ROUNDING):
                break
        else:
            return vector, count, bool(np.abs(slopes @ step).max() < 100 * tolerance)
        moved = np.abs(problem.matrix(trial) - matrix).max()
        vector = trial
        if moved < tolerance:
            return vector, count, True
    return vector, _MOST_REWEIGHTED_STEPS, False


def minimum_in_turn(
    problem: CalibrationProblem, costs: Sequence[RobustCost], vector: Array, tolerance: float, steps_name: str
) -> Solution:
    """The minimum of the last of some costs, each searched from that of the one before, the first from ``vector``."""
    steps, settled = 0, True
    for cost in costs:
        vector, count, settled = reweighted_minimum(problem, cost, vector, tolerance)
        steps += count
    return Solution(vector, f"{'' if settled else 'not '}settled after {steps} {steps_name} steps", settled)
