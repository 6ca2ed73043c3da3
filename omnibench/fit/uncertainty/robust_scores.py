"""Score vectors of runs under a robust loss, for the sandwich.

With the ratios x = r / s of the norms r_i of weighted errors e_i to their scale s, psi(x) = x w(x) and u = e / |e|, a
run's share of the loss sum_i p_i s^2 rho(x_i) has, with the derivatives J_i of e_i by the fitted numbers, the score and
the Hessian

    sum_i p_i w(x_i) J_i'e_i,   sum_i p_i J_i' (w(x_i) (1 - u_i u_i') + psi'(x_i) u_i u_i') J_i.               (1)

The scale counts as known: for errors whose distribution is even it is not correlated with what is fitted (Huber 1981,
section 6.4). A fit of p numbers to n errors makes the mean of psi' too large; its curvature is less by

    1 + p/n var(psi') / mean(psi')^2                                                                          (2)

(Huber 1981, section 7.6).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.fit.least_squares.noise import covariance_of_sums
from omnibench.fit.least_squares.roots import roots_of
from omnibench.fit.loss.robust_cost import RobustCost
from omnibench.fit.observations.reference_batch import ReferenceBatch
from omnibench.fit.uncertainty.reference_scores import covariance_of_rows
from omnibench.fit.uncertainty.sandwich import Scores
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch


def robust_scores(
    objective: RobustCost,
    odometry: OdometryBatch | ReferenceBatch,
    errors: Array,
    jacobian: Array,
    trajectories: Sequence[Trajectory],
    noise: Noise,
) -> Scores:
    """Score vectors and Hessians of the runs, Eq. (1).

    errors (S, 3): odometry minus reference at the cost's stamps. jacobian (S, 3, n): their derivatives by the searched
    numbers; second derivatives of the poses are neglected.
    """
    base, loss = objective.base, objective.loss
    factors = np.array(base.weights)
    used = np.flatnonzero(factors)
    errors, slopes = errors[:, used] * factors[used], jacobian[:, used] * factors[used, None]
    owner, shares = odometry.trajectory, base.shares(odometry.trajectory)
    norms = np.linalg.norm(errors, axis=1)
    ratios = norms / loss.scales(norms[None], shares)[0]
    weights = loss.weights(ratios)
    units = errors / np.maximum(norms, np.finfo(float).tiny)[:, None]
    bent = loss.slopes(ratios)[:, None, None] * units[:, :, None] * units[:, None, :]  # psi' - w = x w'
    curvatures = shares[:, None, None] * (weights[:, None, None] * np.eye(len(used)) + bent)  # (S, k, k)
    curved = curvatures @ slopes
    pulls = np.einsum("ski,sk->si", slopes, (shares * weights)[:, None] * errors)
    runs = range(len(trajectories))
    hessians = np.array([np.einsum("ski,skj->ij", slopes[owner == run], curved[owner == run]) for run in runs])
    correction = _correction(weights + loss.slopes(ratios), shares, len(trajectories) * len(used), hessians)
    by_errors = curved * factors[used][:, None]
    if isinstance(odometry, ReferenceBatch):
        whole = np.zeros((len(by_errors), 3, by_errors.shape[2]))
        whole[:, used] = by_errors
        working = [covariance_of_rows(odometry, run, whole[owner == run], noise) for run in runs]
    else:
        stamps = [log.stamps for log in objective.logs(trajectories)]
        working = [covariance_of_sums(noise, stamps[run], by_errors[owner == run], used.tolist()) for run in runs]
    scores = np.array([pulls[owner == run].sum(axis=0) for run in runs])
    roots = roots_of(np.einsum("s,ski,skj->ij", shares * weights, slopes, slopes))
    step = -roots @ roots.T @ scores.sum(axis=0)
    return Scores(scores, hessians / correction, trajectories, step, np.array(working))


def _correction(curvatures: Array, shares: Array, numbers: int, hessians: Array) -> float:
    """Eq. (2) for psi' (S,) with shares (S,), of a fit to so many numbers."""
    fitted = np.linalg.matrix_rank(hessians.sum(axis=0), hermitian=True)
    mean = float(curvatures @ shares)
    spread = float(np.square(curvatures - mean) @ shares)
    return 1 + float(fitted) / numbers * spread / mean**2 if mean > 0 else 1.0
