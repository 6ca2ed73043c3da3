"""The matrix of linear least squares with the headings of the reference, where searches begin."""

from __future__ import annotations

import math

import numpy as np
from motions import RING, TURNS, driven

from omnibench.fit.linear_fit import linear_fit
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch
from omnibench.testing.synthetic import synthetic_robot, true_robot

ROBOT = synthetic_robot()
TRUTH = true_robot(ROBOT).inverse_kinematic_matrix
TURN = np.full((1, 3), 1 / math.sqrt(3))  # all wheels alike: the robot turns on the spot
ACROSS = np.array([[2.0, -1.0, -1.0], [0.0, math.sqrt(3), -math.sqrt(3)]]) / math.sqrt(6)


def fitted(directions: Array, noise: float = 0.0) -> Array:
    runs = driven((*RING, *TURNS), noise=noise)
    odometry = OdometryBatch([run.reference_log for run in runs], "arc")
    reference = np.concatenate([run.poses[1:] for run in runs])
    return linear_fit(odometry, runs, reference, ROBOT.inverse_kinematic_matrix, directions)


def test_runs_without_noise_give_the_hidden_matrix() -> None:
    matrix = fitted(np.eye(3))
    np.testing.assert_allclose(matrix[2], TRUTH[2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        matrix[:2], TRUTH[:2], rtol=0, atol=1e-5
    )  # arcs are steps in the heading they begin with


def test_directions_that_are_not_fitted_keep_the_design() -> None:
    matrix = fitted(ACROSS, noise=0.01)
    np.testing.assert_allclose((matrix - ROBOT.inverse_kinematic_matrix) @ TURN[0], 0.0, atol=1e-15)
    assert np.abs(matrix - ROBOT.inverse_kinematic_matrix).max() > 1e-3


def test_its_residuals_are_orthogonal_to_what_is_fitted() -> None:
    """Row 3 obeys the normal equations of headings on wheel angles: C'(theta - C m3) = 0."""
    runs = driven((*RING, *TURNS), noise=0.01)
    odometry = OdometryBatch([run.reference_log for run in runs], "arc")
    reference = np.concatenate([run.poses[1:] for run in runs])
    matrix = linear_fit(odometry, runs, reference, ROBOT.inverse_kinematic_matrix, np.eye(3))
    starts = np.array([run.start[2] for run in runs])[odometry.trajectory]
    missing = reference[:, 2] - starts - odometry.driven @ matrix[2]
    np.testing.assert_allclose(odometry.driven.T @ missing, 0.0, atol=1e-9)
