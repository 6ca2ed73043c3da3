"""Poses of the plane, one after another."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from omnibench.robot.kinematics import compose, correction, interpolated, moved_to, relative, unit_twist, wrapped
from omnibench.robot.odometry import advance

POSES = arrays(float, 3, elements=st.floats(-10, 10))


@given(POSES, POSES)
def test_the_relative_pose_leads_from_the_first_to_the_second(first: np.ndarray, second: np.ndarray) -> None:
    np.testing.assert_allclose(compose(first, relative(first, second)), second, atol=1e-9)


@given(POSES, POSES, POSES)
def test_composing_is_associative(first: np.ndarray, second: np.ndarray, third: np.ndarray) -> None:
    np.testing.assert_allclose(
        compose(compose(first, second), third), compose(first, compose(second, third)), atol=1e-9
    )


@given(POSES, POSES)
def test_the_correction_takes_odom_to_the_map(in_map: np.ndarray, in_odom: np.ndarray) -> None:
    np.testing.assert_allclose(compose(correction(in_map, in_odom), in_odom), in_map, atol=1e-9)


@given(POSES, arrays(float, (4, 3), elements=st.floats(-10, 10)))
def test_a_path_that_is_moved_begins_there_and_keeps_its_shape(start: np.ndarray, path: np.ndarray) -> None:
    moved = moved_to(start, path)
    np.testing.assert_allclose(moved[0], start, atol=1e-9)
    for before, after in ((0, 1), (1, 3)):
        np.testing.assert_allclose(
            relative(moved[before], moved[after]), relative(path[before], path[after]), atol=1e-9
        )


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-np.pi, np.pi))
def test_the_twist_of_a_motion_makes_it_along_an_arc(x: float, y: float, turn: float) -> None:
    motion = np.array([x, y, turn])
    np.testing.assert_allclose(advance(np.zeros(3), unit_twist(motion), "arc"), motion, atol=1e-12)
    np.testing.assert_allclose(unit_twist(np.stack([motion, motion]))[1], unit_twist(motion), atol=1e-12)


@given(st.floats(-20, 20))
def test_the_twist_of_whole_turns_is_finite(turn: float) -> None:
    assert np.isfinite(unit_twist(np.array([1.0, -1.0, turn]))).all()


def test_rows_are_interpolated_by_straight_lines_and_held_beyond_their_stamps() -> None:
    rows = np.array([[0.0, 1.0, 0.0], [2.0, 1.0, -4.0]])
    found = interpolated(np.array([-1.0, 1.5, 9.0]), np.array([1.0, 2.0]), rows)
    np.testing.assert_array_equal(found, [[0.0, 1.0, 0.0], [1.0, 1.0, -2.0], [2.0, 1.0, -4.0]])


def test_wrapped_angles_differ_by_whole_turns() -> None:
    np.testing.assert_allclose(wrapped(np.array([0.1, np.pi, -np.pi, 7.0])), [0.1, -np.pi, -np.pi, 7.0 - 2 * np.pi])
