"""The directions of wheel rates that recordings drive."""

from __future__ import annotations

import numpy as np
import pytest
from fit_samples import noisy_trajectories
from hypothesis import given
from hypothesis import strategies as st
from motions import FLOWER, RING, driven

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.span import (
    aligned,
    direction_in_words,
    directions_kept,
    driven_span,
    motion_in_words,
    unidentified_directions,
)
from omnibench.robot.kinematics import Array, wheel_equations
from omnibench.testing.synthetic import synthetic_robot


def run_at(rates: Array, samples: int = 10, poses: int = 6) -> Trajectory:
    """A run at constant wheel rates (N,) for 2 s."""
    times = 0.2 * np.arange(1, samples + 1)
    stamps = np.linspace(0, times[-1], poses)
    return Trajectory("run", "train", times, np.tile(rates, (samples, 1)), stamps, np.zeros((poses, 3)))


def test_three_wheels_that_are_all_driven_leave_no_direction() -> None:
    span = driven_span(noisy_trajectories(3))
    assert span.driven.shape == (3, 3)
    assert span.null.shape == (0, 3)


def test_mecanum_wheels_leave_the_direction_that_would_make_them_slip() -> None:
    span = driven_span(noisy_trajectories(4, encoder=0.0))
    robot = synthetic_robot(4)
    assert span.driven.shape == (3, 4)
    assert span.null.shape == (1, 4)
    np.testing.assert_allclose(span.null @ wheel_equations(robot.wheels), 0, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_the_direction_that_mecanum_wheels_leave_has_the_same_name_on_any_data(seed: int) -> None:
    # Positive rates drive counter-clockwise, so forward is negative on the left.
    (null,) = driven_span(noisy_trajectories(4, seed=seed)).null
    assert direction_in_words(null, synthetic_robot(4).wheel_names) == "fl - fr - rl + rr"


def test_a_direction_is_named_with_its_shares() -> None:
    assert direction_in_words(np.array([-0.25, 0.001, 0.5]), ("a", "b", "c")) == "- 0.5 a + c"


def test_encoder_noise_does_not_count_as_driving() -> None:
    noisy, exact = (driven_span(noisy_trajectories(4, encoder=encoder)) for encoder in (0.05, 0.0))
    assert noisy.null.shape == exact.null.shape == (1, 4)
    assert noisy.shares[3] > 1e-4 > 1e-12 > exact.shares[3]


@given(rank=st.integers(1, 4), wheels=st.integers(4, 6), seed=st.integers(0, 2**16))
def test_driven_and_null_directions_project_onto_complements(rank: int, wheels: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    directions = np.linalg.qr(rng.normal(size=(wheels, wheels)))[0][:rank]
    span = driven_span([run_at(3.0 * direction) for direction in directions])
    assert len(span.driven) == rank
    both = np.vstack([span.driven, span.null])
    np.testing.assert_allclose(both @ both.T, np.eye(wheels), atol=1e-12)
    np.testing.assert_allclose(span.null @ directions.T, 0, atol=1e-12)


def test_shares_are_of_the_direction_that_is_driven_most() -> None:
    span = driven_span([run_at(np.array([4.0, 0, 0])), run_at(np.array([0, 1.0, 0]))])
    np.testing.assert_allclose(span.shares, [1.0, 0.25, 0.0], atol=1e-12)


@pytest.mark.parametrize("poses", [2, 3])
def test_few_increments_still_give_a_direction_for_every_wheel(poses: int) -> None:
    span = driven_span([run_at(np.array([1.0, 2.0, 2.0, 0.0]), poses=poses)])
    assert (span.driven.shape, span.null.shape, span.shares.shape) == ((1, 4), (3, 4), (4,))
    np.testing.assert_allclose(np.abs(span.driven[0]), [1 / 3, 2 / 3, 2 / 3, 0], atol=1e-12)


def test_wheels_that_never_turn_drive_nothing() -> None:
    span = driven_span([run_at(np.zeros(3))])
    assert (span.driven.shape, span.null.shape) == ((0, 3), (3, 3))


def test_hundreds_of_thousands_of_poses_are_no_burden() -> None:
    samples = 300_000
    rates = np.random.default_rng(0).normal(size=(samples, 3))
    times = 0.01 * np.arange(1, samples + 1)
    stamps = np.append(0.0, times)
    span = driven_span([Trajectory("long", "train", times, rates, stamps, np.zeros((samples + 1, 3)))])
    assert span.driven.shape == (3, 3)


def test_no_trajectories_are_refused() -> None:
    with pytest.raises(DataError, match="no trajectories"):
        driven_span([])


ROBOT = synthetic_robot()
TURN = np.ones(3) / np.sqrt(3)


def test_what_is_driven_with_less_than_a_tenth_is_weak() -> None:
    span = driven_span([run_at(np.array([4.0, 0, 0])), run_at(np.array([0, 0.41, 0])), run_at(np.array([0, 0, 0.39]))])
    assert (len(span.driven), len(span.strong), len(span.weak), len(span.null)) == (3, 2, 1, 0)
    np.testing.assert_allclose(np.abs(span.weak), [[0, 0, 1]], atol=1e-12)
    assert [span.state(direction) for direction in np.eye(3)] == ["driven", "driven", "weak"]


def test_the_share_of_a_direction_between_two_is_between_theirs() -> None:
    span = driven_span([run_at(np.array([4.0, 0, 0])), run_at(np.array([0, 2.0, 0]))])
    between = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    assert span.share(between) == pytest.approx(np.sqrt((1 + 0.25) / 2))


def test_translation_with_slip_keeps_the_turn_of_the_design_exactly() -> None:
    kept = directions_kept(ROBOT, driven_span(driven(RING, slip=0.02)), "keep")
    np.testing.assert_allclose(kept, TURN[None], atol=1e-15)


def test_told_to_fit_only_what_is_not_driven_is_kept() -> None:
    assert directions_kept(ROBOT, driven_span(driven(RING, slip=0.02)), "fit").shape == (0, 3)
    assert directions_kept(ROBOT, driven_span(driven(RING)), "fit").shape == (1, 3)


@pytest.mark.parametrize("wheels", [3, 4])
def test_nothing_changes_where_every_direction_is_driven(wheels: int) -> None:
    span = driven_span(driven(FLOWER, wheels=wheels))
    np.testing.assert_array_equal(directions_kept(synthetic_robot(wheels), span, "keep"), span.null)


@given(size=st.integers(1, 4), seed=st.integers(0, 2**16))
def test_aligned_directions_are_orthonormal_and_stay_close_to_their_span(size: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    space = np.linalg.qr(rng.normal(size=(4, 4)))[0][:size]
    turned = aligned(space, synthetic_robot(4))
    np.testing.assert_allclose(turned @ turned.T, np.eye(size), atol=1e-9)
    assert np.linalg.norm(turned @ space.T @ space - turned, axis=1).max() < 0.25


def test_a_span_that_holds_motions_is_named_by_them() -> None:
    robot = synthetic_robot(4)
    rng = np.random.default_rng(0)
    mixed = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    first, *others, last = (motion_in_words(direction, robot) for direction in aligned(mixed, robot))
    assert (first, set(others), last) == ("turning on the spot", {"moving along x", "moving along y"}, "")


@pytest.mark.parametrize(
    ("twist", "words"),
    [
        ((0.0, 0.0, -0.3), "turning on the spot"),
        ((-0.2, 0.0, 0.0), "moving along x"),
        ((0.0, 0.2, 0.0), "moving along y"),
        ((0.2, -0.2, 0.0), "moving at 135 deg"),
        ((0.2, 0.0, 1.0), "moving along x while turning"),
    ],
)
def test_a_direction_is_told_by_what_the_designed_robot_does(twist: tuple[float, float, float], words: str) -> None:
    rates = wheel_equations(ROBOT.wheels) @ np.array(twist)
    assert motion_in_words(rates / np.linalg.norm(rates), ROBOT) == words


def test_what_is_not_identified_is_named_the_same_on_any_slip() -> None:
    names = {
        tuple(
            direction_in_words(direction, ROBOT.wheel_names)
            for direction in unidentified_directions(ROBOT, driven_span(driven(RING, slip=0.02, seed=seed)))
        )
        for seed in range(5)
    }
    assert names == {("a + b + c",)}
