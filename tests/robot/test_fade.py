"""Corrections outside the training domain: kept where they are known, faded to the plain matrix where they are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_samples import EVERY, a_drive, at_every_sample, mixture, model, streamed, term
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.robot.corrections import Fade, motions_of, representatives
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

FORWARDS, SIDEWAYS = np.array([0.2, 0.0, 0.0]), np.array([0.0, 0.2, 0.0])
GROWN = term("speed_dependent_radius", k=0.01)
PLAIN = 0.9 * APR_02.inverse_kinematic_matrix


def unsure(deviation: float) -> OdometryModel:
    """A model with a radius that grows with the rate, fitted to driving forwards; deviation of its k, s/rad."""
    matrix, covariance = APR_02.inverse_kinematic_matrix, np.zeros((10, 10))
    covariance[9, 9] = deviation**2
    return replace(model(GROWN), fade=Fade(APR_02, matrix - PLAIN, FORWARDS[None], [GROWN], covariance))


def log_of(twist: Array) -> WheelLog:
    """Two seconds of a twist by the design values."""
    times = 0.1 * np.arange(1, 21)
    rates = np.tile(np.linalg.solve(APR_02.inverse_kinematic_matrix, twist), (20, 1))
    return WheelLog(times, rates, np.zeros(3), times)


def moved(chosen: OdometryModel, twist: Array) -> Array:
    return chosen.poses([log_of(twist)])[0][-1]


def by_plain_matrix(twist: Array) -> Array:
    return moved(OdometryModel(APR_02, PLAIN, "arc"), twist)


@given(seed=st.integers(0, 2**32 - 1), robot=st.sampled_from(sorted(EVERY)), samples=st.integers(2, 60))
def test_a_stream_fades_as_a_batch_does(seed: int, robot: str, samples: int) -> None:
    log, rng = at_every_sample(a_drive(seed, samples, EVERY[robot])), np.random.default_rng(seed)
    terms = mixture(seed, EVERY[robot])
    whole = model(*terms, robot=EVERY[robot])
    shapes = [{each.name for each in one.effect.parameters(EVERY[robot]) if each.choices} for one in terms]
    values = [0.0 if name in of_term else value for one, of_term in zip(terms, shapes, strict=True)
              for name, value in one.values.items()]  # fmt: skip
    deviations = np.append(np.full(whole.matrix.size, 1e-4), 0.2 * np.abs(values))
    root = deviations[:, None] * rng.normal(size=(len(deviations), 3))
    driven = representatives(EVERY[robot], motions_of(whole.matrix, log.times, log.signals)[:1])
    change = 1e-3 * rng.normal(size=whole.matrix.shape)
    chosen = replace(whole, fade=Fade(EVERY[robot], change, driven, terms, root @ root.T))
    stream = chosen.stream(log.start, log.session, log.started_at or 0.0)
    np.testing.assert_allclose(streamed(stream, log), chosen.poses([log])[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("deviation", [0.001, 0.1])
def test_corrections_are_whole_where_the_robot_was_driven(deviation: float) -> None:
    np.testing.assert_array_equal(moved(unsure(deviation), FORWARDS), moved(model(GROWN), FORWARDS))


def test_what_is_known_well_is_kept_where_the_robot_was_never_driven() -> None:
    np.testing.assert_allclose(moved(unsure(1e-6), SIDEWAYS), moved(model(GROWN), SIDEWAYS), rtol=1e-6)


def test_far_outside_the_plain_matrix_is_left_of_what_is_not_known() -> None:
    np.testing.assert_allclose(moved(unsure(0.1), SIDEWAYS), by_plain_matrix(SIDEWAYS), atol=1e-12)


def test_between_these_a_correction_fades_the_farther_it_is_from_what_was_driven() -> None:
    angles, shares = np.radians([0, 10, 20, 30, 40]), []
    for angle in angles:
        twist = 0.2 * np.array([np.cos(angle), np.sin(angle), 0.0])
        part, whole, none = moved(unsure(0.02), twist), moved(model(GROWN), twist), by_plain_matrix(twist)
        shares.append(np.linalg.norm(part - none) / np.linalg.norm(whole - none))
    assert shares[0] == pytest.approx(1.0)
    assert (np.diff(shares[1:]) < 0).all()
    assert shares[-1] > 0


def test_the_matrix_errs_along_with_the_parameters_that_it_was_fitted_with() -> None:
    """A parameter that a change of the matrix undoes says nothing wrong, however little it is known."""
    scale = term("sample_period_scale", s=0.02)  # every motion is 2 % longer
    matrix, covariance = APR_02.inverse_kinematic_matrix, np.zeros((10, 10))
    along = np.append(-matrix.ravel() / 1.02, 1.0)  # what leaves the motion as it is
    covariance[:] = 0.1**2 * np.outer(along, along)
    fade = Fade(APR_02, matrix - PLAIN, FORWARDS[None], [scale], covariance)
    kept = moved(replace(model(scale), fade=fade), SIDEWAYS)
    np.testing.assert_allclose(kept, moved(model(scale), SIDEWAYS), rtol=1e-2)
