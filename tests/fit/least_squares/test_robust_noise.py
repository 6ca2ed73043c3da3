"""Heavy-tailed noise: what a run says of one pose, and the weights of poses and starts that are off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fit_samples import make_problem, noisy_trajectories
from hypothesis import given
from hypothesis import strategies as st

from omnibench.fit.calibrators.trajectory_ml import robust_noise
from omnibench.fit.gauss_newton import first_fit
from omnibench.fit.loss import LossName
from omnibench.fit.noise import ExtraVariance, Whitener
from omnibench.fit.trajectory_fit import TrajectoryFit
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

NOISE = Noise(
    pose_position=0.01, walk_position=0.02, bias_position=0.03, pose_heading=0.02, walk_heading=0.01, bias_heading=0.005
)
STAMPS = np.array([0.3, 0.5, 1.1, 1.2, 2.0])


def covariance(kind: str, extra: tuple[Array, float]) -> Array:
    white, walk, bias = (getattr(NOISE, f"{part}_{kind}") for part in ("pose", "walk", "bias"))
    of_poses, of_all = extra
    shared = walk**2 * np.minimum(STAMPS[:, None], STAMPS) + bias**2 + of_all
    return np.asarray(shared + np.diag(white**2 + of_poses))


@given(seed=st.integers(0, 10**6))
def test_variance_beyond_the_noise_whitens_as_the_dense_covariance_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    extra = ExtraVariance((rng.exponential(1e-3, 5), 1e-4), (rng.exponential(1e-3, 5), 0.0))
    residuals = rng.standard_normal((5, 3))
    white = Whitener(NOISE, STAMPS, extra)(residuals)
    position, heading = covariance("position", extra.position), covariance("heading", extra.heading)
    expected = [r @ np.linalg.solve(c, r) for r, c in zip(residuals.T, (position, position, heading), strict=True)]
    assert np.square(white).sum() == pytest.approx(sum(expected), rel=1e-9)


@given(seed=st.integers(0, 10**6))
def test_what_the_others_say_of_a_pose_is_that_of_the_dense_inverse(seed: int) -> None:
    residuals = np.random.default_rng(seed).standard_normal((5, 3))
    errors, variances = Whitener(NOISE, STAMPS).left_out(residuals)
    dense = covariance("position", (np.zeros(5), 0.0))
    others = [0, 1, 3, 4]
    gain = np.linalg.solve(dense[np.ix_(others, others)], dense[others, 2])
    assert errors[2, 0] == pytest.approx(residuals[2, 0] - gain @ residuals[others, 0], rel=1e-9)
    assert variances[2, 1] == pytest.approx(dense[2, 2] - gain @ dense[others, 2], rel=1e-9)


@given(seed=st.integers(0, 10**6))
def test_the_likeliest_shift_is_that_of_generalised_least_squares(seed: int) -> None:
    residuals = np.random.default_rng(seed).standard_normal((5, 3))
    shift, variances = Whitener(NOISE, STAMPS).shift(residuals)
    inverse = np.linalg.inv(covariance("heading", (np.zeros(5), 0.0)))
    assert variances[2] == pytest.approx(1 / inverse.sum(), rel=1e-9)
    assert shift[2] == pytest.approx(inverse.sum(axis=0) @ residuals[:, 2] / inverse.sum(), rel=1e-9)


def fit_of_a_jump(run: int, pose: int, by: float) -> TrajectoryFit:
    """A fit of runs, of which one pose has jumped."""
    runs = list(noisy_trajectories(noise=0.002, encoder=0.002))
    poses = runs[run].poses.copy()
    poses[pose, 0] += by
    runs[run] = replace(runs[run], poses=poses)
    return first_fit(make_problem(runs)).trajectories


@pytest.mark.parametrize("loss", ["huber", "student_t"])
def test_a_pose_that_has_jumped_loses_its_weight_and_its_neighbours_keep_theirs(loss: LossName) -> None:
    fit = fit_of_a_jump(2, 4, 1.0)
    found = robust_noise(Noise(pose_position=0.02, pose_heading=0.02, walk_position=0.05, walk_heading=0.05), fit, loss)
    weights = found.runs[2].poses
    assert weights[3] < 0.1
    assert np.delete(weights, 3).min() > 0.5
    assert len(found.without_jumps(fit).runs[2].poses) == len(fit.runs[2].poses) - 1


@pytest.mark.parametrize("loss", ["huber", "student_t"])
def test_a_run_whose_start_has_jumped_keeps_the_weights_of_its_poses(loss: LossName) -> None:
    fit = fit_of_a_jump(2, 0, 1.0)
    found = robust_noise(Noise(pose_position=0.02, pose_heading=0.02, walk_position=0.05, walk_heading=0.05), fit, loss)
    assert [run.near for run in found.runs] == [index != 2 for index in range(len(fit.runs))]
    assert found.runs[2].poses.min() > 0.5
    assert found.runs[2].extra.position[1] > 0.1  # m^2: a metre is likely
    assert len(found.without_jumps(fit).runs) == len(fit.runs) - 1
