"""Poses of the plane, one after another."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from omnibench.robot.planar import compose, correction, moved_to, relative

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
