"""The covariances of SLAM's poses against errors that are drawn, and against cases that are known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from omnibench.robot.kinematics import Array
from omnibench.slam.pose_errors import FLOOR, PoseErrors
from omnibench.slam.scan_matching import Match

NONE: Array = np.zeros((3, 3))


def match_at(
    pose: Array, gain: Array, by_keyframe: dict[int, Array], scatter: Array = NONE, delayed: Array = NONE
) -> Match:
    """A match with a gain (3, 3) and the information of each keyframe's surfaces (3, 3)."""
    information = sum(by_keyframe.values(), np.zeros((3, 3)))
    weight = gain @ np.linalg.pinv(information)
    return Match(pose, gain, np.ones(3), np.eye(3), weight, information, by_keyframe, scatter, delayed, 1.0)


def test_errors_of_the_motion_are_the_same_in_every_step_and_add_up() -> None:
    """With gain g and a motion's error s the pose errs by e = (1 - g)(e + s): the steps' variances do not just add."""
    errors = PoseErrors(np.zeros(3))
    errors.keep()
    gain, moved = 0.75, np.array([0.02, 0.0, 0.0])
    error = 0.0
    for step in range(1, 6):
        match = match_at(np.array([0.1 * step, 0.0, 0.0]), gain * np.eye(3), {0: np.eye(3)})
        found = errors.step(match, moved, np.zeros(3))
        error = (1 - gain) * (error + 0.02)
        assert found[0, 0] == pytest.approx(error**2 + FLOOR[0, 0], rel=1e-12)


def test_a_pose_that_its_keyframe_determines_errs_as_the_keyframe_does() -> None:
    """However often it is matched to it: the keyframe's error is considered, and never averaged away."""
    moved = np.array([0.03, 0.01, 0.0])
    errors = PoseErrors(np.zeros(3), moved)
    errors.keep()
    for step in range(1, 30):
        found = errors.step(match_at(np.array([0.1 * step, 0.2, 0.0]), np.eye(3), {0: np.eye(3)}), moved, 0 * moved)
    np.testing.assert_allclose(np.diag(found)[:2], moved[:2] ** 2 + np.diag(FLOOR)[:2], rtol=1e-12)


def test_two_keyframes_share_the_error_by_their_information() -> None:
    """Keyframe 0 is exact, keyframe 1 has the variance s^2: with three quarters of the information on it, 9/16 s^2."""
    moved, still = np.array([0.04, 0.0, 0.0]), np.zeros(3)
    errors = PoseErrors(np.zeros(3))
    errors.keep()
    errors.step(match_at(np.zeros(3), np.zeros((3, 3)), {0: np.eye(3)}), moved, still)
    errors.keep()
    found = errors.step(match_at(np.zeros(3), np.eye(3), {0: np.eye(3), 1: 3 * np.eye(3)}), still, still)
    assert found[0, 0] == pytest.approx(9 / 16 * 0.04**2 + FLOOR[0, 0], rel=1e-12)


def test_an_error_of_the_heading_swings_the_poses_that_follow() -> None:
    """A start that is wrong by a heading of s puts a pose 2 m ahead wrong by 2 s across, if no scan corrects it."""
    errors = PoseErrors(np.zeros(3), np.array([0.0, 0.0, 0.01]))
    found = errors.step(match_at(np.array([2.0, 0.0, 0.0]), NONE, {}), np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(found - FLOOR, 0.01**2 * np.outer([0, 2, 1], [0, 2, 1]), atol=1e-15)


class Drawn:
    """Poses (n, 3) of many runs whose errors are drawn, composed without linearisation."""

    def __init__(self, count: int) -> None:
        self.rng = np.random.default_rng(0)
        self.systematic = self.rng.standard_normal((count, 3))

    @staticmethod
    def composed(first: Array, second: Array) -> Array:
        way = (first[..., 0] + 1j * first[..., 1]) + (second[..., 0] + 1j * second[..., 1]) * np.exp(1j * first[..., 2])
        return np.stack([way.real, way.imag, first[..., 2] + second[..., 2]], axis=-1)

    @staticmethod
    def seen(first: Array, second: Array) -> Array:
        way = ((second - first)[0] + 1j * (second - first)[1]) * np.exp(-1j * first[2])
        return np.array([way.real, way.imag, second[2] - first[2]])

    def noise(self, covariance: Array) -> Array:
        return self.rng.multivariate_normal(np.zeros(3), covariance, len(self.systematic))


def test_the_stated_covariances_are_those_of_drawn_errors() -> None:
    """A winding path, three keyframes, gains that leave a direction to the odometry, noise of scans and of skew."""
    drawn = Drawn(40_000)
    true = np.array(
        [[0, 0, 0.3], [0.3, 0.2, 0.8], [0.4, 0.6, 1.5], [0.1, 0.9, 2.1], [-0.4, 0.7, 2.6], [-0.6, 0.2, 3.0]]
    )
    moved, skew = np.array([3e-3, 2e-3, 4e-3]), np.array([1e-3, 2e-3, 1e-3])
    surfaces = [np.diag([4.0, 1.0, 2.0]), np.array([[2.0, 0.5, 0.0], [0.5, 3.0, 0.2], [0.0, 0.2, 1.0]]), np.eye(3)]
    gains = [np.diag([0.9, 0.4, 0.8]), np.diag([0.2, 0.9, 0.7]), np.eye(3), np.diag([0.0, 0.8, 0.9]), np.eye(3)]
    scatter, delayed = 1e-5 * np.diag([1.0, 2.0, 0.5]), np.diag([0.3, 0.2, 0.1])

    errors = PoseErrors(true[0])
    errors.keep(skew)
    poses = np.tile(true[0], (len(drawn.systematic), 1))
    keyframes = [drawn.composed(poses, drawn.noise(np.diag(skew**2)))]
    for step, (here, gain) in enumerate(zip(true[1:], gains, strict=True), 1):
        parts = dict(enumerate(surfaces[: len(keyframes)]))
        match = match_at(here, gain, parts, scatter, delayed)
        found = errors.step(match, moved, skew) - FLOOR

        motion = drawn.seen(true[step - 1], here)
        start = drawn.composed(drawn.composed(poses, moved * drawn.systematic), motion)
        inverse = np.linalg.inv(match.information)
        turn = np.array([[np.cos(here[2]), -np.sin(here[2]), 0], [np.sin(here[2]), np.cos(here[2]), 0], [0, 0, 1]])
        skewed = delayed @ turn @ np.diag(skew)
        matched = here + drawn.noise(inverse @ (scatter + skewed @ skewed.T) @ inverse)
        for (number, part), places in zip(parts.items(), keyframes, strict=True):
            seen_there = drawn.composed(places, drawn.seen(true[(0, 2, 4)[number]], here))
            matched += (seen_there - here) @ (inverse @ part).T
        poses = start + (matched - start) @ gain.T
        scales = np.sqrt(np.diag(found))
        np.testing.assert_allclose(
            np.cov(poses.T) / np.outer(scales, scales), found / np.outer(scales, scales), atol=0.03
        )
        if step % 2 == 0:
            errors.keep()
            keyframes.append(poses)
