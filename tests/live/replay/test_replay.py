"""Replay: which messages there are, when they arrive and what they hold."""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from replayed import DRIVE, arrivals, config, of, played, same, taken

from omnibench.config import parse_yaml, to_yaml, validate
from omnibench.errors import ConfigError
from omnibench.live.replay.concatenated_drive import ConcatenatedDrive, ReplayConfig
from omnibench.live.replay.replay_player import events
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array


class TestEvents:
    @given(
        st.integers(0, 100), st.floats(0, 0.5), st.floats(0, 0.5), st.floats(0, 1), st.floats(0, 1), st.floats(0, 0.5)
    )
    def test_they_come_by_time_of_arrival_and_never_before_they_were_taken(
        self, seed: int, delay: float, jitter: float, drop: float, duplicate: float, period: float
    ) -> None:
        channel = {"delay": delay, "jitter": jitter, "drop": drop, "duplicate": duplicate}
        played_events = played(seed=seed, wheels=channel, slam=channel | {"period": period})
        assert (np.diff(arrivals(played_events)) >= 0).all()
        assert (arrivals(played_events) - taken(played_events) >= delay - 1e-9).all()

    def test_without_jitter_stamps_increase_and_delays_are_as_asked(self) -> None:
        played_events = played(wheels={"delay": 0.03}, slam={"delay": 0.2, "jitter": 0, "period": 0})
        for topic, delay in (("joint_states", 0.03), ("slam_pose", 0.2)):
            messages = of(played_events, topic)
            assert (np.diff([each.message.stamp for each in messages]) > 0).all()
            np.testing.assert_allclose(arrivals(messages) - taken(messages), delay, atol=1e-8)

    def test_every_sample_and_pose_of_the_drive_is_there(self) -> None:
        played_events = played(slam={"period": 0})
        samples, poses = of(played_events, "joint_states"), of(played_events, "slam_pose")
        poses.sort(key=lambda each: each.message.stamp)
        np.testing.assert_allclose(taken(samples), DRIVE.wheel_times, atol=1e-9)
        np.testing.assert_array_equal([each.message.positions for each in samples], DRIVE.angles)
        np.testing.assert_array_equal([each.message.velocities for each in samples], DRIVE.rates)
        np.testing.assert_allclose(taken(poses), DRIVE.slam_times, atol=1e-9)
        np.testing.assert_array_equal([each.message.pose for each in poses], DRIVE.slam_poses)
        assert {each.message.frame for each in poses} == {"map"}

    def test_jitter_is_half_normal(self) -> None:
        times = 0.01 * np.arange(20_000.0)
        long = replace(DRIVE, wheel_times=times, angles=np.zeros((20_000, 3)), rates=np.zeros((20_000, 3)))
        samples = of(played(long, wheels={"delay": 1.0, "jitter": 0.05}), "joint_states")
        late = arrivals(samples) - taken(samples) - 1.0
        assert late.min() > -1e-9
        assert late.mean() == pytest.approx(0.05 * math.sqrt(2 / math.pi), rel=0.05)
        assert late.std() == pytest.approx(0.05 * math.sqrt(1 - 2 / math.pi), rel=0.05)

    def test_jitter_of_more_than_the_period_brings_wheel_samples_out_of_order(self) -> None:
        stamps = np.array([each.message.stamp for each in of(played(wheels={"jitter": 0.05}), "joint_states")])
        assert np.count_nonzero(np.diff(stamps) < 0) > 10
        assert len(np.unique(stamps)) == len(DRIVE.wheel_times)

    def test_the_share_to_drop_is_dropped(self) -> None:
        samples = of(played(wheels={"drop": 0.3}), "joint_states")
        assert len(samples) == pytest.approx(0.7 * len(DRIVE.wheel_times), rel=0.2)
        assert of(played(slam={"drop": 1}), "slam_pose") == []

    def test_the_share_to_duplicate_comes_twice_with_the_same_content(self) -> None:
        samples = of(played(wheels={"duplicate": 0.3, "jitter": 0.05}), "joint_states")
        counts = Counter(each.message.stamp for each in samples)
        assert set(counts.values()) == {1, 2}
        assert sum(count == 2 for count in counts.values()) == pytest.approx(0.3 * len(DRIVE.wheel_times), rel=0.25)
        stamp = next(stamp for stamp, count in counts.items() if count == 2)
        first, second = (each for each in samples if each.message.stamp == stamp)
        assert same(first.message, second.message)
        assert first.arrival != second.arrival

    def test_the_same_seed_gives_the_same_and_another_one_another(self) -> None:
        channel = {"jitter": 0.01, "drop": 0.1, "duplicate": 0.1}
        first, again, other = (played(seed=seed, wheels=channel, slam=channel) for seed in (3, 3, 4))
        assert [(each.arrival, each.topic, each.message.stamp) for each in first] == [
            (each.arrival, each.topic, each.message.stamp) for each in again
        ]
        assert all(same(one.message, two.message) for one, two in zip(first, again, strict=True))
        assert not np.array_equal(arrivals(first), arrivals(other))

    def test_what_befalls_the_slam_does_not_change_the_wheels(self) -> None:
        wheels = {"jitter": 0.01, "drop": 0.1}
        one = of(played(wheels=wheels), "joint_states")
        two = of(played(wheels=wheels, slam={"drop": 0.5, "period": 1.0}), "joint_states")
        np.testing.assert_array_equal(arrivals(one), arrivals(two))

    @pytest.mark.parametrize("period", [0.1, 0.15, 0.25, 1.0])
    def test_poses_are_thinned_to_the_period_and_no_more(self, period: float) -> None:
        times = taken(of(played(slam={"period": period, "jitter": 0}), "slam_pose"))
        assert times[0] == 0
        assert (np.diff(times) >= period - 1e-6).all()
        for before, after in pairwise(times):  # the next one is the first that was far enough
            assert after == pytest.approx(DRIVE.slam_times[DRIVE.slam_times >= before + period - 1e-6][0])

    @pytest.mark.parametrize(("use", "held"), [("positions", (1, 0)), ("velocities", (0, 1)), ("both", (1, 1))])
    def test_wheel_messages_hold_what_is_asked_for(self, use: str, held: tuple[int, int]) -> None:
        messages = [each.message for each in of(played(wheels={"use": use}), "joint_states")]
        assert {(m.positions is not None, m.velocities is not None) for m in messages} == {held}

    def test_joints_are_the_robots_wheels_or_as_named(self) -> None:
        assert next(events(DRIVE, config())).message.names == ("a", "b", "c")
        named = next(events(DRIVE, config(), names=("left", "right", "rear")))
        assert named.message.names == ("left", "right", "rear")

    @pytest.mark.parametrize("names", [("left", "right"), ("left", "left", "rear"), ()])
    def test_names_that_are_not_one_for_each_wheel_are_refused(self, names: tuple[str, ...]) -> None:
        with pytest.raises(ConfigError, match="name one joint, and a different one, for each of the wheels a, b, c"):
            events(DRIVE, config(), names=names)

    def test_stamps_begin_with_the_time_of_the_replay_unless_given(self) -> None:
        before = time.time_ns()
        first = next(events(DRIVE, ReplayConfig()))
        assert before <= first.message.stamp <= time.time_ns()
        assert next(events(DRIVE, config(), origin=5)).message.stamp == 5


class TestCovariances:
    @staticmethod
    def covariances(drive: ConcatenatedDrive = DRIVE, noise: Noise | None = None, **slam: Any) -> Array:
        poses = of(played(drive, noise=noise, slam={"period": 0, "jitter": 0} | slam), "slam_pose")
        return np.array([each.message.covariance for each in poses])

    def test_those_of_the_data_set_come_first(self) -> None:
        recorded = np.random.default_rng(1).normal(size=(len(DRIVE.slam_times), 3, 3))
        covariances = self.covariances(
            replace(DRIVE, slam_covariances=recorded), Noise(pose_position=1), covariance={"position": 1, "heading": 1}
        )
        np.testing.assert_array_equal(covariances, recorded)

    def test_then_those_of_the_config(self) -> None:
        covariances = self.covariances(noise=Noise(pose_position=1), covariance={"position": 0.03, "heading": 0.01})
        np.testing.assert_allclose(covariances, np.tile(np.diag([9e-4, 9e-4, 1e-4]), (len(covariances), 1, 1)))

    def test_then_what_the_noise_model_makes_of_the_time_since_the_run_began(self) -> None:
        noise = Noise(
            pose_position=0.03,
            bias_position=0.04,
            walk_position=0.02,
            pose_heading=0.01,
            bias_heading=0,
            walk_heading=0.1,
        )
        covariances = self.covariances(noise=noise)
        since = DRIVE.slam_times - DRIVE.start_times[DRIVE.slam_run]
        assert since.max() == pytest.approx(0.8)
        np.testing.assert_allclose(covariances[:, 0, 0], 0.0025 + 0.0004 * since)
        np.testing.assert_allclose(covariances[:, 1, 1], covariances[:, 0, 0])
        np.testing.assert_allclose(covariances[:, 2, 2], 0.0001 + 0.01 * since)

    def test_without_any_they_are_moderate_and_never_singular(self) -> None:
        np.testing.assert_allclose(self.covariances()[0], np.diag([4e-4, 4e-4, 4e-4]))
        assert np.linalg.eigvalsh(self.covariances(noise=Noise())).min() > 0


class TestConfig:
    def test_the_highest_speed_is_called_max(self) -> None:
        assert config(speed="max").speed == math.inf
        assert validate(ReplayConfig, parse_yaml("speed: max", "test"), "test").speed == math.inf

    def test_it_comes_back_from_yaml(self) -> None:
        for speed in (0.5, math.inf):
            written = ReplayConfig(speed=speed)
            assert validate(ReplayConfig, parse_yaml(to_yaml(written), "test"), "test") == written

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"speed": 1e-300}, "speed: Input should be greater than or equal to 0.001"),
            ({"speed": math.nan}, "speed: Input should be greater than or equal to 0.001"),
            ({"speed": "fast"}, "speed: Input should be a valid number"),
            ({"pause": -1}, "pause: Input should be greater than or equal to 0"),
            ({"wheels": {"drop": 1.5}}, "wheels.drop: Input should be less than or equal to 1"),
            ({"slam": {"delay": math.inf}}, "slam.delay: Input should be less than or equal to 3600"),
            ({"slam": {"period": 1e300}}, "slam.period: Input should be less than or equal to 3600"),
            ({"slam": {"covariance": {"position": 0}}}, "slam.covariance.position: Input should be greater than 0"),
            ({"wheels": {"periot": 1}}, "unknown key 'wheels.periot'"),
            ({"sped": 1}, "did you mean 'speed'"),
        ],
    )
    def test_what_cannot_be_is_refused(self, changes: dict[str, Any], message: str) -> None:
        with pytest.raises(ConfigError, match=message):
            config(**changes)
