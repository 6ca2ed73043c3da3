"""Chi-square differences and estimates of whitened columns, against plain least squares."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given as cases
from hypothesis import strategies as st

from omnibench.fit.noise import whiteners
from omnibench.fit.trajectory_fit import given, whitened
from omnibench.robot.calibration import Noise

NOISE = Noise(pose_position=0.01, pose_heading=0.02, walk_position=0.005, walk_heading=0.01, bias_position=0.02)


def random_data(seed: int, count: int, deviations: np.ndarray):
    rng = np.random.default_rng(seed)
    stamps = [np.cumsum(rng.uniform(0.1, 0.4, size)) for size in rng.integers(3, 9, count)]
    residuals = [rng.normal(0, 0.03, (len(each), 3)) for each in stamps]
    columns = [rng.normal(0, 1, (len(each), 3, 6)) for each in stamps]
    nuisances = [rng.normal(0, 1, (len(each), 3, 3)) for each in stamps]
    known = deviations > 0
    data = whitened(
        residuals, columns, whiteners(NOISE, stamps), [each[..., known] for each in nuisances], deviations[known]
    )
    return data, residuals, columns, stamps, nuisances


@cases(seed=st.integers(0, 10**6), count=st.integers(2, 6))
def test_a_gain_is_what_least_squares_lowers_chi2_by(seed: int, count: int) -> None:
    data, *_ = random_data(seed, count, np.zeros(3))
    columns, residuals = np.concatenate(data.columns), np.concatenate(data.residuals)

    def left(index: list[int]) -> float:
        answer, *_ = np.linalg.lstsq(columns[:, index], residuals, rcond=None)
        return float(np.square(residuals - columns[:, index] @ answer).sum())

    assert np.isclose(given(data, [0, 1]).chi_square([2, 3]), left([0, 1]) - left([0, 1, 2, 3]), rtol=1e-6, atol=1e-8)


@cases(seed=st.integers(0, 10**6))
def test_estimates_beyond_other_columns_are_those_of_the_joint_fit(seed: int) -> None:
    data, *_ = random_data(seed, 4, np.zeros(3))
    columns, residuals = np.concatenate(data.columns), np.concatenate(data.residuals)
    joint, *_ = np.linalg.lstsq(columns, residuals, rcond=None)
    values, covariance = given(data, [0, 1, 2]).estimate([3, 4, 5])
    assert np.allclose(values, joint[3:], rtol=1e-6, atol=1e-9)
    assert np.allclose(covariance, np.linalg.inv(columns.T @ columns)[3:, 3:], rtol=1e-6)


@cases(seed=st.integers(0, 10**6))
def test_nuisances_of_a_run_count_as_noise_that_its_poses_share(seed: int) -> None:
    deviations = np.array([0.02, 0.0, 0.05])
    data, residuals, columns, stamps, nuisances = random_data(seed, 3, deviations)
    for row, (own, slopes, times, extra) in enumerate(zip(residuals, columns, stamps, nuisances, strict=True)):
        noise = np.zeros((3 * len(times), 3 * len(times)))
        for axis, (white, walk, bias) in enumerate([(0.01, 0.005, 0.02)] * 2 + [(0.02, 0.01, 0.0)]):
            covariance = white**2 * np.eye(len(times)) + walk**2 * np.minimum.outer(times, times) + bias**2
            noise[axis::3, axis::3] = covariance
        spread = extra.reshape(-1, 3) * deviations
        inverse = np.linalg.inv(noise + spread @ spread.T)
        flat, target = slopes.reshape(-1, 6), own.ravel()
        assert np.allclose(data.columns[row].T @ data.columns[row], flat.T @ inverse @ flat, rtol=1e-6, atol=1e-6)
        assert np.allclose(data.scores[row], flat.T @ inverse @ target, rtol=1e-5, atol=1e-6)


def test_a_direction_that_others_make_is_no_direction() -> None:
    data, *_ = random_data(1, 5, np.zeros(3))
    columns = tuple(np.column_stack([each, each[:, 0] + each[:, 1]]) for each in data.columns)
    twice = type(data)(
        data.residuals,
        columns,
        sum(each.T @ each for each in columns),
        np.array([each.T @ own for each, own in zip(columns, data.residuals, strict=True)]),
    )
    assert given(twice, [0, 1]).rank([6]) == 0
    assert given(twice, [0, 1]).chi_square([6]) == 0.0


@pytest.mark.parametrize("size", [1e-17, 1e-140])
def test_a_signal_that_no_motion_drives_is_not_estimated_from_its_rounding(size: float) -> None:
    """As of two wheels that share an encoder: DART's car got a matrix of 1e137, and discover a traceback."""
    data, *_ = random_data(1, 5, np.zeros(3))
    rounding = np.random.default_rng(2)
    columns = tuple(np.column_stack([each, size * rounding.normal(0, 1, len(each))]) for each in data.columns)
    undriven = type(data)(
        data.residuals,
        columns,
        sum(each.T @ each for each in columns),
        np.array([each.T @ own for each, own in zip(columns, data.residuals, strict=True)]),
    )
    values, covariance = given(undriven, []).estimate(range(7))
    assert values[:6] == pytest.approx(given(data, []).estimate(range(6))[0], rel=1e-9)
    assert abs(values[6] * size) < 1e-12
    assert np.isfinite(covariance).all()
    assert given(undriven, []).rank([6]) == 0
