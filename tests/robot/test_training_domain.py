"""Motions that a model was fitted to, and which others are far from all of them."""

from __future__ import annotations

import numpy as np
import pytest
from effect_samples import ROBOTS
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sample_robots import APR_02

from omnibench.robot.corrections import (
    TrainingDomain,
    extrapolated_share,
    extrapolation_consequence,
    kinds_of_motion,
    motions_of,
    representatives,
)
from omnibench.robot.kinematics import Array, Robot

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


def test_a_run_shorter_than_the_smoothing_has_one_motion() -> None:
    matrix, twist = APR_02.inverse_kinematic_matrix, np.array([0.1, -0.2, 0.3])
    rates = np.tile(np.linalg.solve(matrix, twist), (5, 1))
    np.testing.assert_allclose(motions_of(matrix, 0.01 * np.arange(1, 6), rates), twist[None], atol=1e-12)


def test_it_is_told_what_is_not_known() -> None:
    assert extrapolation_consequence(["a"]) == "a is not known to hold there, and errors may be larger than stated"
    assert extrapolation_consequence(["a", "b", "a"], fading=True) == (
        "a, b are not known to hold there, fade to the plain matrix where unsure, and errors may be larger than stated"
    )
