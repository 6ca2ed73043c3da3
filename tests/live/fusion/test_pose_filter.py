"""The extended Kalman filter's covariance: against finite differences, and against the errors that it describes."""

from __future__ import annotations

import numpy as np
import pytest
from drives import motion

from omnibench.live.fusion.pose_fusion import PoseFilter, innovation_of
from omnibench.robot.odometry import advance

COVARIANCE = np.array([[0.04, 0.01, -0.02], [0.01, 0.09, 0.03], [-0.02, 0.03, 0.05]])
VARIANCE = 1e-4


@pytest.mark.parametrize("moved", [[0.8, -0.3, 0.4], [0.0, 0.5, 0.0], [0.6, 0.0, -1.0]])
def test_the_predicted_covariance_is_that_of_finite_differences(moved: list[float]) -> None:
    pose, step = np.array([1.0, -2.0, 0.7]), motion(0, np.array(moved), variance=VARIANCE)
    shifts = 1e-6 * np.eye(3)
    jacobian = np.column_stack(
        [
            (advance(pose + shift, step.moved, "arc") - advance(pose - shift, step.moved, "arc")) / 2e-6
            for shift in shifts
        ]
    )
    pose_filter = PoseFilter(pose, COVARIANCE)
    pose_filter.predict(step)
    expected = jacobian @ COVARIANCE @ jacobian.T + VARIANCE * np.eye(3)
    np.testing.assert_allclose(pose_filter.covariance, expected, atol=1e-8)


def test_the_normalised_error_of_sparse_poses_is_that_of_three_degrees_of_freedom() -> None:
    """Mean NEES: its standard deviation is sqrt(6 / 300) = 0.14, so that 3.5 would be 3.5 of these away."""
    rng = np.random.default_rng(4)
    slam = np.diag([0.02, 0.02, 0.03]) ** 2
    normalised = []
    for _ in range(150):
        true = rng.uniform(-3, 3, 3)
        moved = np.array([0.06, rng.uniform(-0.03, 0.03), rng.uniform(-0.02, 0.02)])
        pose_filter = PoseFilter(true + rng.multivariate_normal(np.zeros(3), slam), slam)
        for _ in range(2):
            for _ in range(50):  # 3 m from pose to pose
                step = motion(0, moved, variance=1e-6)
                true = advance(true, moved, "arc") + 1e-3 * rng.standard_normal(3)
                pose_filter.predict(step)
            error = innovation_of(true.copy(), pose_filter.pose)
            normalised.append(error @ np.linalg.solve(pose_filter.covariance, error))
            pose_filter.correct(true + rng.multivariate_normal(np.zeros(3), slam), slam)
    assert np.mean(normalised) == pytest.approx(3.0, abs=0.5)
