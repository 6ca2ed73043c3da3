"""A quick fit of the matrix by least squares, which cross-validation and the check of a recording can afford often."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.fit.cost import NO_ERROR
from omnibench.fit.linear_fit import linear_fit
from omnibench.fit.observations.reference_fit import ReferenceFit
from omnibench.fit.shrinkage.prior import default_cost, prior_root, tolerance_of
from omnibench.fit.span import directions_kept, driven_span
from omnibench.robot.arrays import Array
from omnibench.robot.kinematics import Robot
from omnibench.robot.odometry import Integration
from omnibench.robot.stored.odometry_of_stored import odometry_of

_SPARSE = 1.0  # s between poses, from which on headings do not lie on lines between them; chosen
_REWEIGHTED = 10  # steps, of which the best counts; chosen: on README's log the cost is within 1 % of closed_form's
_VANISHING = 1e-3  # of the mean norm: smaller ones have no larger weight; chosen
_STEPS = 3  # Gauss-Newton steps by references, chosen: the design is so near that two settle


def quick_fit(robot: Robot, runs: Sequence[Trajectory], integration: Integration = "arc") -> Array:
    """The matrix (3, M) that fits the poses of runs, or, where none has any, their references."""
    posed = [run for run in runs if run.has_poses]
    if not posed:
        return _by_references(robot, runs)
    odometry = odometry_of([run.reference_log for run in posed], integration)
    observed = np.concatenate([run.poses[1:] for run in posed])
    kept = directions_kept(robot, driven_span(posed), "shrink")
    _, _, directions = np.linalg.svd(np.vstack([kept, np.zeros((1, len(robot.drive.names)))]))
    directions = directions[len(kept) :]
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


def _by_references(robot: Robot, runs: Sequence[Trajectory]) -> Array:
    """The likeliest matrix (3, M) of the class's tolerance about the design, by the references' own uncertainty."""
    design = robot.inverse_kinematic_matrix
    root = prior_root(robot, tolerance_of(robot))
    fit = ReferenceFit.of(runs, design, "arc")
    if fit is None:
        return design
    fit = fit.with_walk(design, root)
    steps = np.zeros(root.shape[1])
    for _ in range(_STEPS):
        residuals, columns = fit.whitened(design + (root @ steps).reshape(design.shape), root)
        slopes, left = np.concatenate(columns), np.concatenate(residuals)
        steps = steps + np.linalg.solve(slopes.T @ slopes + np.eye(len(steps)), slopes.T @ left - steps)
    return design + (root @ steps).reshape(design.shape)
