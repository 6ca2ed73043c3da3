"""Matrix by two linear least squares, with the headings of the reference: where searches begin.

With C_s the wheel angles driven up to stamp s and a_k those of sample k, a run that starts at (x, y, theta)_0 obeys

    theta_s - theta_0 = m3.C_s                                                                   (L1)
    (x + iy)_s - (x + iy)_0 = (m1 + i m2).sum_k a_k exp(i theta(k))                              (L2)

for the matrix with rows m1, m2, m3. With theta(k) interpolated between reference poses, both are linear in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.data.stored import median_period
from omnibench.fit.cost import NO_ERROR
from omnibench.fit.estimate import EstimateProblem, estimate
from omnibench.fit.prior import default_cost, physical_prior_root, physical_tolerance
from omnibench.fit.span import directions_kept, driven_span
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration, OdometryBatch
from omnibench.robot.stored_odometry import odometry_of

_SPARSE = 1.0  # s between poses, from which on headings do not lie on lines between them; chosen
_REWEIGHTED = 10  # steps, of which the best counts; chosen: on README's log the cost is within 1 % of closed_form's
_VANISHING = 1e-3  # of the mean norm: smaller ones have no larger weight; chosen
_MOST_POSES = 100_000  # a quick fit takes every n-th pose of n times as many: fewer than twice this number; chosen


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


def quick_fit(robot: Robot, runs: Sequence[Trajectory], integration: Integration = "arc") -> Array:
    """The matrix (3, M) that fits the poses of runs, or, where none has any, their references."""
    posed = [run for run in runs if run.has_poses]
    if not posed:
        root = physical_prior_root(robot, physical_tolerance(robot))
        period = median_period(runs)
        return estimate(EstimateProblem(robot, runs, root, integration, period)).matrix
    if (every := sum(len(run.poses) for run in posed) // _MOST_POSES) > 1:
        thinned = slice(None, None, every)
        posed = [
            replace(run, pose_times=run.pose_times[thinned], poses=run.poses[thinned], pose_covariances=None)
            for run in posed
        ]
    odometry = odometry_of([run.reference_log for run in posed], integration)
    observed = np.concatenate([run.poses[1:] for run in posed])
    held = directions_kept(robot, driven_span(posed), "keep")
    _, _, directions = np.linalg.svd(np.vstack([held, np.zeros((1, len(robot.drive.names)))]))
    directions = directions[len(held) :]
    matrix = linear_fit(odometry, posed, observed, robot.inverse_kinematic_matrix, directions)
    sparse = float(np.median(np.concatenate([np.diff(run.pose_times) for run in posed]))) > _SPARSE
    if default_cost(robot, len(posed)) == "final_pose":
        odometry = odometry_of([run.final_log for run in posed], integration)
        observed = np.array([run.final_pose for run in posed])
    elif not sparse:
        return matrix
    # The cost is a sum of norms: least squares that are weighted by 1 / norm lead to its minimum.
    free, tried = np.kron(np.eye(3), directions.T), []
    for number in range(_REWEIGHTED):
        errors = odometry.poses(matrix[None])[0] - observed
        norms = np.linalg.norm(errors, axis=1)
        tried.append((float(norms.mean()), number, matrix))
        roots = 1 / np.sqrt(np.maximum(norms, _VANISHING * norms.mean() + NO_ERROR))[:, None]
        columns = (odometry.jacobian(matrix).reshape(*errors.shape, -1) @ free) * roots[..., None]
        step = np.linalg.lstsq(columns.reshape(errors.size, -1), (roots * errors).ravel(), rcond=None)[0]
        matrix = matrix - (free @ step).reshape(matrix.shape)
    return min(tried)[2]
