"""Motions that a model was fitted to, which others are far from all of them, and corrections that fade there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_samples import EVERY, ROBOTS, a_drive, at_every_sample, mixture, model, streamed, term
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sample_robots import APR_02

from omnibench.robot.corrections import (
    Fade,
    TrainingDomain,
    extrapolated_share,
    extrapolation_consequence,
    kinds_of_motion,
    motions_of,
    representatives,
)
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

DISTANCE = 0.195  # m, of the APR-02's wheels
FORWARDS = np.array([0.2, 0.0, 0.0])
SIDEWAYS = np.array([0.0, 0.2, 0.0])
ON_THE_SPOT = np.array([0.0, 0.0, 1.0])
STANDING = np.zeros(3)

_twists = st.integers(1, 30).flatmap(lambda count: arrays(float, (count, 3), elements=st.floats(-1, 1)))


def known(*motions: Array) -> TrainingDomain:
    return TrainingDomain(APR_02, motions)


def at_wheels(robot: Robot, motions: Array) -> Array:
    return motions * [1.0, 1.0, np.mean([wheel.distance for wheel in robot.wheels])]


@given(_twists, st.sampled_from(sorted(ROBOTS)))
def test_a_few_representatives_are_near_every_motion(motions: Array, robot: str) -> None:
    few = representatives(ROBOTS[robot], motions)
    own, kept = at_wheels(ROBOTS[robot], motions), at_wheels(ROBOTS[robot], few)
    away = np.linalg.norm(own[:, None] - kept, axis=2).min(axis=1)
    largest = np.linalg.norm(own, axis=1).max()
    assert away.max() <= (1 + np.sqrt(3)) * 0.05 * largest + 1e-9  # a cell of the grid, and one more step
    apart = np.linalg.norm(kept[:, None] - kept, axis=2) + np.diag(np.full(len(kept), np.inf))
    assert apart.min() > 0.05 * largest


@given(_twists, st.sampled_from(sorted(ROBOTS)))
def test_motions_of_a_kind_are_near_its_first_one_and_those_are_far_from_each_other(motions: Array, robot: str) -> None:
    spreads = np.abs(motions[::-1]) / 2
    own = np.hstack([at_wheels(ROBOTS[robot], each) for each in (motions, spreads)])
    kinds = kinds_of_motion(ROBOTS[robot], motions, spreads)
    near = 0.15 * np.linalg.norm(own, axis=1).max()
    firsts = np.array([own[kinds == kind][0] for kind in range(kinds.max() + 1)])
    assert (np.linalg.norm(own - firsts[kinds], axis=1) <= near + 1e-9).all()
    apart = np.linalg.norm(firsts[:, None] - firsts, axis=2) + np.diag(np.full(len(firsts), np.inf))
    assert apart.min() >= near - 1e-9


def test_the_directions_and_turns_of_a_flower_are_kinds_of_their_own() -> None:
    flower = [[0.2 * np.cos(angle), 0.2 * np.sin(angle), turn]
              for angle in np.radians(np.arange(0, 360, 30)) for turn in (-0.35, 0.0, 0.35)]  # fmt: skip
    assert len(set(kinds_of_motion(APR_02, np.array(flower), np.zeros((36, 3))).tolist())) == 36


def test_paths_that_end_where_they_began_are_of_as_many_kinds_as_they_swing_differently() -> None:
    swings = np.array([[0.2, 0.0, 0.0], [0.2, 0.0, 0.01], [0.0, 0.0, 1.0], [0.2, 0.0, 1.0]])
    assert kinds_of_motion(APR_02, 1e-4 * swings, swings).tolist() == [0, 0, 1, 2]


@given(_twists, st.sampled_from(sorted(ROBOTS)))
def test_what_was_driven_is_never_new(motions: Array, robot: str) -> None:
    few = TrainingDomain(ROBOTS[robot], representatives(ROBOTS[robot], motions))
    assert not few.outside(motions).any()


@given(_twists, _twists, st.sampled_from(sorted(ROBOTS)))
def test_a_live_node_judges_one_motion_as_all_are_judged_together(driven: Array, others: Array, robot: str) -> None:
    chosen = TrainingDomain(ROBOTS[robot], driven)
    assert [chosen.is_outside(motion) for motion in others] == chosen.outside(others).tolist()


@pytest.mark.parametrize("motion", [SIDEWAYS, ON_THE_SPOT, 1.3 * FORWARDS, -FORWARDS, 0.5 * (FORWARDS + SIDEWAYS)])
def test_another_direction_or_speed_is_new(motion: Array) -> None:
    assert known(FORWARDS).is_outside(motion)


@pytest.mark.parametrize("motion", [FORWARDS, 1.1 * FORWARDS, FORWARDS + 0.1 * SIDEWAYS, STANDING, 0.01 * SIDEWAYS])
def test_what_is_near_is_not_new_and_to_stand_neither(motion: Array) -> None:
    assert not known(FORWARDS).is_outside(motion)


def test_turning_counts_as_what_it_moves_at_the_wheels() -> None:
    driven, more = known(FORWARDS, ON_THE_SPOT), ON_THE_SPOT * 0.2 / DISTANCE
    assert not driven.is_outside(ON_THE_SPOT + 0.1 * more)
    assert driven.is_outside(ON_THE_SPOT + 0.2 * more)


def test_new_motions_in_passing_do_not_make_a_run_new() -> None:
    passing = np.array([*[FORWARDS] * 97, *[SIDEWAYS] * 3])
    staying = np.array([*[FORWARDS] * 90, *[SIDEWAYS] * 10])
    assert not known(FORWARDS).outside_in_run(passing).any()
    assert known(FORWARDS).outside_in_run(staying).tolist() == [False] * 90 + [True] * 10


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        (ON_THE_SPOT, "turning on the spot"),
        (SIDEWAYS, "driving straight at 0.20 m/s"),
        (np.array([0.3, 0.4, -1.0]), "turning while driving at 0.50 m/s"),
    ],
)
def test_new_motions_are_told_in_words_with_their_share(motion: Array, words: str) -> None:
    run = np.array([*[FORWARDS] * 3, motion])
    assert extrapolated_share(APR_02, FORWARDS[None], run) == (0.25, words)
    assert extrapolated_share(APR_02, FORWARDS[None], run[:3]) == (0.0, "")


def test_motions_of_a_run_are_its_twists_smoothed() -> None:
    matrix = APR_02.inverse_kinematic_matrix
    twist = np.array([0.1, -0.2, 0.3])
    times = 0.01 * np.arange(1, 201)
    rates = np.linalg.solve(matrix, twist) + np.where(np.arange(200) % 2, 1.0, -1.0)[:, None]
    found = motions_of(matrix, times, rates)
    assert len(found) > 10
    assert np.abs(found - twist).max() < 0.05 * np.abs(rates @ matrix.T - twist).max()
    shorter = np.tile(np.linalg.solve(matrix, twist), (5, 1))  # than the smoothing
    np.testing.assert_allclose(motions_of(matrix, times[:5], shorter), twist[None], atol=1e-12)


def test_it_is_told_what_is_not_known() -> None:
    assert extrapolation_consequence(["a"]).startswith("a is not known")
    assert "a, b are not known to hold there, fade" in extrapolation_consequence(["a", "b", "a"], fading=True)


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


def test_never_driven_motions_keep_what_is_known_well_and_are_left_the_plain_matrix_elsewhere() -> None:
    np.testing.assert_allclose(moved(unsure(1e-6), SIDEWAYS), moved(model(GROWN), SIDEWAYS), rtol=1e-6)
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
