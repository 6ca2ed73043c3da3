"""A quick fit of the matrix by least squares, which cross-validation and the check of a recording can afford often."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

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
    reference = np.concatenate([run.poses[1:] for run in posed])
    span = driven_span(posed)
    kept = directions_kept(robot, span, "shrink")
    _, _, directions = np.linalg.svd(np.vstack([kept, np.zeros((1, len(robot.drive.names)))]))

    def fitted(headed: Sequence[Trajectory]) -> Array:
        return linear_fit(odometry, headed, reference, robot.inverse_kinematic_matrix, directions[len(kept) :])

    matrix = fitted(posed)
    if float(np.median(np.concatenate([np.diff(run.pose_times) for run in posed]))) > _SPARSE:
        matrix = fitted([_headed(run, matrix[2]) for run in posed])
    if default_cost(robot, len(posed)) == "trajectory":
        return matrix
    # Eq. (6) is a sum of norms: least squares that are weighted by 1 / norm lead to its minimum.
    ends, observed = odometry_of([run.final_log for run in posed], integration), np.array([r.final_pose for r in posed])
    free = np.kron(np.eye(3), directions[len(kept) :].T)
    tried = []
    for number in range(_REWEIGHTED):
        errors = ends.poses(matrix[None])[0] - observed
        norms = np.linalg.norm(errors, axis=1)
        tried.append((float(norms.mean()), number, matrix))
        roots = 1 / np.sqrt(np.maximum(norms, _VANISHING * norms.mean() + NO_ERROR))[:, None]
        columns = (ends.jacobian(matrix).reshape(*errors.shape, -1) @ free) * roots[..., None]
        step = np.linalg.lstsq(columns.reshape(errors.size, -1), (roots * errors).ravel(), rcond=None)[0]
        matrix = matrix - (free @ step).reshape(matrix.shape)
    return min(tried)[2]


def _headed(run: Trajectory, row_3: Array) -> Trajectory:
    """The run with headings at all its samples: those that row 3 of a matrix turns by, led through the poses'."""
    edges = np.append(0.0, run.times)
    turned = np.append(0.0, np.cumsum((run.signals @ row_3) * np.diff(edges)))
    off = run.poses[:, 2] - np.interp(run.pose_times, edges, turned)
    poses = np.tile(run.poses[:1], (len(edges), 1))
    poses[1:, 2] = (turned + np.interp(edges, run.pose_times, off))[1:]
    return replace(run, pose_times=edges, poses=poses, pose_covariances=None)


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
