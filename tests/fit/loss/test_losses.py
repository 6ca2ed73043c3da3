"""Robust losses of norms: their constants, scales and weights."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.stats import chi

from omnibench.fit.loss import CORNERS, DEGREES_OF_FREEDOM, LEAST_SCALE, Huber, Loss, StudentT, make_loss

KINDS = [Huber, StudentT]


def norms_and_shares(seed: int, jumps: float, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    norms = np.linalg.norm(rng.standard_normal((2, count, 3)), axis=2)
    norms[:, rng.random(count) < jumps] += 100.0
    shares = rng.uniform(0.5, 1.5, count)
    return norms, shares / shares.sum()


@cache
def mean_square(size: int) -> float:
    """E min(R, c)^2 of Eq. (1)."""
    corner = CORNERS[size]
    inside = quad(lambda r: r**2 * chi(size).pdf(r), 0, corner)[0]
    return float(inside + corner**2 * chi(size).sf(corner))


def cost_at(loss: Loss, scale: float, norms: np.ndarray, shares: np.ndarray) -> float:
    """Eq. (1), or the exponential of Eq. (3), written out."""
    ratios, size = norms / scale, loss.coordinates
    if isinstance(loss, Huber):
        corner = CORNERS[size]
        mean = mean_square(size)
        rho = np.where(ratios <= corner, ratios**2 / 2, corner * ratios - corner**2 / 2)
        return float(scale * (shares @ rho + mean / 2))
    power = (DEGREES_OF_FREEDOM + size) / (2 * size)
    return float(np.exp(np.log(scale) + power * shares @ np.log1p(ratios**2 / DEGREES_OF_FREEDOM)))


@pytest.mark.parametrize("size", [1, 2, 3])
def test_hubers_corner_leaves_95_percent_of_the_efficiency_for_normal_errors(size: int) -> None:
    corner, pdf = CORNERS[size], chi(size).pdf
    slope = size * quad(pdf, 0, corner)[0] + (size - 1) * quad(lambda r: corner / r * pdf(r), corner, 50)[0]
    square = quad(lambda r: r * r * pdf(r), 0, corner)[0] + corner**2 * chi(size).sf(corner)
    assert (slope / size) ** 2 / (square / size) == pytest.approx(0.95, abs=1e-4)


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 10**6), jumps=st.sampled_from([0.0, 0.05, 0.2]))
def test_the_cost_is_the_minimum_over_all_scales(kind: type[Loss], seed: int, jumps: float) -> None:
    norms, shares = norms_and_shares(seed, jumps)
    loss = kind(3)
    scales, costs = loss.scales(norms, shares), loss.costs(norms, shares)
    for of_one, scale, cost in zip(norms, scales, costs, strict=True):
        best = minimize_scalar(
            lambda logarithm, of_one=of_one: cost_at(loss, np.exp(logarithm), of_one, shares),
            bounds=np.log([1e-2, 1e2]), method="bounded", options={"xatol": 1e-9},
        )  # fmt: skip
        assert cost == pytest.approx(float(best.fun), rel=1e-7)
        assert scale == pytest.approx(float(np.exp(best.x)), rel=1e-3)


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 10**6))
def test_derivatives_by_the_errors_are_those_of_weighted_squares(kind: type[Loss], seed: int) -> None:
    norms, shares = norms_and_shares(seed, 0.1, count=12)
    loss, step = kind(3), 1e-5
    moved = norms[0] + step * np.vstack([np.eye(12), -np.eye(12)])
    values = loss.costs(moved, shares)
    slopes = (values[:12] - values[12:]) / (2 * step)
    scale = loss.scales(norms[:1], shares)[0]
    expected = shares * loss.weights(norms[0] / scale) * norms[0]
    np.testing.assert_allclose(slopes / slopes.sum(), expected / expected.sum(), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("unit", [1e-4, 1e3])
def test_costs_and_scales_have_the_unit_of_the_errors(kind: type[Loss], unit: float) -> None:
    norms, shares = norms_and_shares(0, 0.1)
    np.testing.assert_allclose(kind(3).costs(unit * norms, shares), unit * kind(3).costs(norms, shares), rtol=1e-12)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_hubers_scale_is_the_standard_deviation_of_normal_errors(size: int) -> None:
    errors = 0.02 * np.random.default_rng(0).standard_normal((1, 200_000, size))
    norms = np.linalg.norm(errors, axis=2)
    assert Huber(size).scales(norms, np.full(200_000, 5e-6))[0] == pytest.approx(0.02, rel=0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_a_scale_found_from_a_sample_first_is_that_of_all(kind: type[Loss]) -> None:
    rng = np.random.default_rng(0)
    norms = np.abs(rng.standard_cauchy((3, 9000)))
    norms[:, ::4] = 0.0  # the sample takes every fourth: it sees no error at all
    shares = np.full(9000, 1 / 9000)
    pieces = np.concatenate([norms[:, 1:2000], norms[:, 2000:], norms[:, :1]], axis=1)  # the sample is another one
    np.testing.assert_allclose(kind(3).scales(norms, shares), kind(3).scales(pieces, shares), rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_the_derivative_of_the_weights_is_right(kind: type[Loss]) -> None:
    ratios = np.array([0.3, 1.0, 2.0, 7.0])
    step = 1e-6
    slopes = (kind(3).weights(ratios * (1 + step)) - kind(3).weights(ratios * (1 - step))) / (2 * step)
    np.testing.assert_allclose(kind(3).slopes(ratios), slopes, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_no_error_has_the_least_scale_and_what_cannot_be_evaluated_costs_nan(kind: type[Loss]) -> None:
    norms = np.array([[0.0, 0.0], [np.nan, 1.0], [1.0, 1.0]])
    shares = np.full(2, 0.5)
    assert kind(3).scales(norms[:1], shares)[0] == LEAST_SCALE
    with np.errstate(all="ignore"):
        costs = kind(3).costs(norms, shares)
    assert costs[0] < 1e-9
    assert np.isnan(costs).tolist() == [False, True, False]


def test_squares_have_no_loss() -> None:
    assert make_loss("squares", 3) is None
