"""Whitening is exact, and the variances of the noise come out of the differences between repetitions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.noise import (
    Difference,
    Differences,
    Whitener,
    covariance_of_sums,
    differences_between_repetitions,
    estimate_noise,
)
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset

NOISE = {
    "pose_position": 0.006,
    "pose_heading": 0.004,
    "walk_position": 0.004,
    "walk_heading": 0.003,
    "bias_position": 0.009,
    "bias_heading": 0.007,
}
NOISES = st.builds(Noise, **dict.fromkeys(NOISE, st.floats(1e-3, 1.0)))
STAMPS = st.lists(st.floats(0.01, 2.0), min_size=1, max_size=12).map(np.cumsum)


def dense(white: float, walk: float, bias: float, stamps: Array) -> Array:
    """The covariance (K, K) of one coordinate."""
    shared = walk**2 * np.minimum(stamps[:, None], stamps) + bias**2
    covariance: Array = white**2 * np.eye(len(stamps)) + shared
    return covariance


@given(noise=NOISES, stamps=STAMPS, seed=st.integers(0, 2**31))
def test_whitened_residuals_have_the_chi_square_and_the_determinant_of_the_dense_covariance(
    noise: Noise, stamps: Array, seed: int
) -> None:
    residuals = np.random.default_rng(seed).standard_normal((len(stamps), 3))
    whitener = Whitener(noise, stamps)
    position = dense(noise.pose_position, noise.walk_position, noise.bias_position, stamps)
    heading = dense(noise.pose_heading, noise.walk_heading, noise.bias_heading, stamps)
    squares = sum(
        float(column @ np.linalg.solve(covariance, column))
        for column, covariance in zip(residuals.T, (position, position, heading), strict=True)
    )
    assert np.square(whitener(residuals)).sum() == pytest.approx(squares, rel=1e-6)
    determinant = 2 * np.linalg.slogdet(position)[1] + np.linalg.slogdet(heading)[1]
    assert whitener.log_determinant == pytest.approx(determinant, rel=1e-6, abs=1e-6)


@given(noise=NOISES, stamps=STAMPS, seed=st.integers(0, 2**31))
def test_sums_of_errors_have_the_covariance_that_the_dense_one_gives(noise: Noise, stamps: Array, seed: int) -> None:
    weights = np.random.default_rng(seed).standard_normal((len(stamps), 2, 4))
    left = dense(noise.pose_position, noise.walk_position, noise.bias_position, stamps)
    heading = dense(noise.pose_heading, noise.walk_heading, noise.bias_heading, stamps)
    expected = weights[:, 0].T @ left @ weights[:, 0] + weights[:, 1].T @ heading @ weights[:, 1]
    assert_allclose(covariance_of_sums(noise, stamps, weights, [1, 2]), expected, rtol=1e-9, atol=1e-9)


def test_derivatives_are_whitened_column_by_column() -> None:
    stamps = np.array([0.2, 0.5, 1.1])
    slopes = np.random.default_rng(0).standard_normal((3, 3, 4))
    whitener = Whitener(Noise(**NOISE), stamps)
    together = whitener(slopes)
    for index in range(4):
        assert together[..., index] == pytest.approx(whitener(slopes[..., index]))


def test_noise_that_is_nothing_but_a_bias_can_be_whitened() -> None:
    whitened = Whitener(Noise(bias_position=0.01, bias_heading=0.01), np.array([0.5, 1.0]))(np.zeros((2, 3)))
    assert np.isfinite(whitened).all()


@pytest.mark.parametrize("stamps", [[0.0, 1.0], [1.0, 0.5], []])
def test_stamps_must_increase_from_above_zero(stamps: list[float]) -> None:
    with pytest.raises(ValueError, match="increasing"):
        Whitener(Noise(**NOISE), np.array(stamps))


def recorded(repetitions: int, seed: int = 0) -> tuple[list[Trajectory], list[Array]]:
    """Simulated runs whose residuals about the true motion are the reference's noise alone."""
    wheels = [
        {"name": name, "radius": 0.1, "distance": 0.2, "angle": angle}
        for name, angle in zip("abc", (1, 3, 5), strict=True)
    ]
    shared = {
        "robot": {"name": "three", "wheels": wheels},
        "sample_period": 0.05,
        "commands": {"directions_deg": [0, 60, 120, 180, 240, 300], "turn_rates": [-0.3, 0.3]},
        "repetitions": repetitions,
        "truth": {"tolerances": {}},
        "train": {"seed": seed, "distance": 1.2},
    }
    noisy = simulate_dataset(FlowerConfig.model_validate(shared | {"noise": NOISE})).dataset.trajectories
    exact = simulate_dataset(FlowerConfig.model_validate(shared)).dataset.trajectories
    residuals = [there.poses[1:] - here.poses[1:] for here, there in zip(noisy, exact, strict=True)]
    return list(noisy), residuals


def test_the_variances_are_found_from_the_repetitions() -> None:
    runs, residuals = recorded(20)
    estimate = estimate_noise(differences_between_repetitions(runs, residuals))
    assert estimate.source == "repetitions"
    for name, value in NOISE.items():
        assert getattr(estimate.noise, name) == pytest.approx(value, rel=0.15), name


def test_what_the_model_gets_wrong_of_a_command_is_no_noise() -> None:
    runs, residuals = recorded(20)
    wrong = {run.command: 0.1 * np.random.default_rng(index).standard_normal(3) for index, run in enumerate(runs)}
    bent = [part + wrong[run.command] for run, part in zip(runs, residuals, strict=True)]
    plain, found = (estimate_noise(differences_between_repetitions(runs, values)).noise for values in (residuals, bent))
    assert found.bias_position == pytest.approx(plain.bias_position, rel=0.01)


def test_without_repetitions_the_residuals_are_taken_and_that_is_said() -> None:
    runs, residuals = recorded(1)
    alone = [replace(run, command=None) for run in runs]
    estimate = estimate_noise(differences_between_repetitions(alone, residuals))
    assert estimate.source == "within runs"
    assert "no command is repeated" in estimate.description
    assert estimate.noise.pose_position == pytest.approx(NOISE["pose_position"], rel=0.2)


def test_no_trajectories_have_no_noise() -> None:
    with pytest.raises(DataError, match="no trajectory has a reference pose"):
        estimate_noise(differences_between_repetitions([], []))


def test_a_component_that_differences_hardly_show_is_the_likeliest_one_and_not_zero() -> None:
    """Twice the log-likelihood of a bias beside none is near 1 here: no proof of it, and yet zero is less likely."""
    stamps, rng = np.array([1.0, 2.0, 3.0, 4.0]), np.random.default_rng(5)
    values = rng.standard_normal((20, 4, 3)) + 0.3 * rng.standard_normal((20, 1, 3))
    differences = tuple(Difference(stamps, of_run, np.zeros((4, 3, 0))) for of_run in values)
    noise = estimate_noise(Differences(differences, "repetitions", "")).noise

    def loss(white: float, walk: float, bias: float) -> float:
        covariance, headings = dense(white, walk, bias, stamps), values[:, :, 2].T
        squares = float((headings * np.linalg.solve(covariance, headings)).sum())
        return 20 * float(np.linalg.slogdet(covariance)[1]) + squares

    grid = np.linspace(0.0, 0.6, 13)
    losses = np.array([[loss(w, k, b) for w in np.linspace(0.8, 1.2, 21) for k in grid] for b in grid])
    assert 0.3 < losses[0].min() - losses.min() < 2.0
    assert loss(noise.pose_heading, noise.walk_heading, noise.bias_heading) <= losses.min() + 0.01
