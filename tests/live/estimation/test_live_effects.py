"""Calibrations with effects in a running node: the batch's numbers, swaps without a jump, SLAM poses put right."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import Command as InProcess
from commands import assert_refused, flower, omnibench, write_config
from drives import ORIGIN, PERIOD, Drive, calibration, drive, slam
from hypothesis import given
from hypothesis import strategies as st
from nodes import config_of, write_node
from recordings import random_dataset, simulated_recording
from sessions import free_port

from omnibench.config import to_yaml
from omnibench.live.estimation.live_odometry import LiveOdometry
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.fusion.pose_fusion import FusionSettings
from omnibench.live.node import LiveNode
from omnibench.live.replay.concatenated_drive import (
    ReplayConfig,
    concatenate_recording,
    concatenate_runs,
    concatenated_truth,
)
from omnibench.live.replay.replay_player import events
from omnibench.live.wheels.wheel_input import WheelStep
from omnibench.live.wire.messages import JOINT_STATE, JointState
from omnibench.live.wire.outputs import Update
from omnibench.robot.calibration import Calibration, EffectTerm, Noise, covariance_rows, matrix_rows, write_calibration
from omnibench.robot.kinematics import Array, relative
from omnibench.robot.odometry import Integration, WheelLog
from omnibench.testing import synthetic_robot
from omnibench.testing.synthetic import true_robot

ECCENTRIC = {f"{kind}_{wheel}": 0.02 for kind in "ab" for wheel in "abc"}
EFFECTS: dict[str, dict[str, float]] = {
    "wheel_eccentricity": ECCENTRIC,
    "speed_dependent_radius": {"k": 0.01},
    "thermal_radius_drift": {"k": 1e-4},
    "acceleration_slip": {"k": 0.08},
    "centripetal_slip": {"k": 0.05},
    "start_transient": {"k": 0.2, "length": 0.1},
    "heading_drift": {"b": 0.005},
    "floor_drift": {"dx": 0.02, "dy": -0.01},
    "sample_period_scale": {"s": 0.01},
    "tyre_wear": {"radius_evening": 0.01},
}


def term(name: str, **parameters: float) -> EffectTerm:
    return EffectTerm(name=name, parameters=parameters)


def every_effect() -> list[EffectTerm]:
    return [term(name, **values) for name, values in EFFECTS.items()]


def with_effects(*terms: EffectTerm, plain: Calibration | None = None, **changes: Any) -> Calibration:
    given_changes = {"effects": terms, "covariance": None, "session": "evening"}
    return (plain or calibration()).model_copy(update=given_changes | changes)


def batch(path: Drive, using: Calibration) -> Array:
    """Batch odometry at every sample from the origin, with angles as the wheels count them."""
    rates = np.diff(path.angles, axis=0) / np.diff(path.times, prepend=0.0)[:, None]
    log = WheelLog(path.times, rates, np.zeros(3), path.times, path.angles[1:], 0.0, using.session)
    return using.model.poses([log])[0]


def fed(robot: RobotTracker, payloads: list[bytes]) -> list[Update]:
    return [update for index, payload in enumerate(payloads) for update in robot.take_wheels(payload, 0.01 * index)]


def odometry(updates: list[Update]) -> Array:
    return np.array([update.pose for update in updates])


class TestAgreesWithTheBatch:
    @given(st.sets(st.sampled_from(sorted(EFFECTS)), min_size=1, max_size=4), st.integers(0, 1000))
    def test_odom_with_any_effects_is_the_batch_odometry(self, names: set[str], seed: int) -> None:
        using = with_effects(*(term(name, **EFFECTS[name]) for name in names))
        path = drive(1.0, seed=seed, using=using)
        updates = fed(RobotTracker("apr", using), path.payloads())
        np.testing.assert_allclose(odometry(updates)[1:], batch(path, using), atol=1e-9)

    @pytest.mark.parametrize("integration", ["euler", "arc"])
    def test_a_replayed_recording_gives_the_batch_odometry(self, integration: Integration) -> None:
        using = with_effects(*every_effect(), plain=calibration(integration=integration))
        dataset = random_dataset(3)
        drive = concatenate_runs(dataset)
        robot = RobotTracker("apr", using.model_copy(update={"robot": dataset.robot}))
        updates = [
            update
            for event in events(drive, ReplayConfig(), origin=ORIGIN)
            if isinstance(event.message, JointState)
            for update in robot.take_wheels(JOINT_STATE.encode(event.message), event.arrival)
        ]
        log = replace(drive.log(session="evening"), start=np.zeros(3))
        np.testing.assert_allclose(odometry(updates), using.model.poses([log])[0], atol=1e-9)

    def test_a_sender_of_rates_alone_has_its_wheel_angles_counted_from_0(self) -> None:
        using = with_effects(term("wheel_eccentricity", **ECCENTRIC))
        path = drive(1.0, using=using)
        live = LiveOdometry(using)
        for turned in np.diff(path.angles, axis=0):
            live.step(WheelStep(0, PERIOD, turned, turned / PERIOD))
        from_zero = replace(path, angles=path.angles - path.angles[0])
        np.testing.assert_allclose(live.pose, batch(from_zero, using)[-1], atol=1e-9)

    def test_motions_lead_the_filter_along_odom_with_effects_too(self) -> None:
        using = with_effects(*every_effect())
        path = drive(2.0, using=using)
        robot = RobotTracker("apr", using, fusion=FusionSettings())
        robot.take_wheels(path.payloads()[0], 0.0)
        robot.take_pose(slam(ORIGIN, [0.0, 0.0, 0.0]), 0.0)
        updates = fed(robot, path.payloads()[1:])
        for update in updates:
            assert update.in_map is not None
            np.testing.assert_allclose(update.in_map[0], update.pose, atol=1e-9)

    def test_the_covariance_of_the_matrix_is_used_though_that_of_effects_follows_it(self) -> None:
        plain, nothing = calibration(), term("heading_drift", b=0.0)
        spread = np.diag([1e-8] * 9 + [1e-4])
        using = with_effects(nothing, plain=plain, covariance=covariance_rows(spread))
        path = drive(1.0)
        last, last_with_effect = (fed(RobotTracker("apr", each), path.payloads())[-1] for each in (plain, using))
        np.testing.assert_allclose(last_with_effect.covariance, last.covariance, rtol=1e-9)

    def test_odom_fades_outside_the_training_domain_as_the_batch_does(self) -> None:
        using = fading(term("heading_drift", b=0.05), deviation=0.02)
        path = drive(1.0, using=using)
        whole = using.model_copy(update={"plain": None})
        np.testing.assert_allclose(
            odometry(fed(RobotTracker("apr", using), path.payloads()))[1:], batch(path, using), atol=1e-9
        )
        assert np.abs(batch(path, using) - batch(path, whole)).max() > 1e-3

    def test_the_covariance_grows_by_what_effects_extrapolate_and_only_there(self) -> None:
        """A heading that drifts by an unsure rate displaces the robot sideways of its way by half of what it turns."""
        using, speed, seconds = fading(term("heading_drift", b=0.05), deviation=0.02), 0.2, 2.0
        known, new = (driven_for(using, seconds, twist).covariance for twist in ((speed, 0.0, 0.0), (0.0, speed, 0.0)))
        assert np.abs(known).max() < 1e-12
        assert new[2, 2] > (0.02 * seconds) ** 2
        assert new[0, 2] == pytest.approx(-speed * seconds / 2 * new[2, 2], rel=0.02)
        assert new[0, 0] == pytest.approx((speed * seconds / 2) ** 2 * new[2, 2], rel=0.04)


def fading(effect: EffectTerm, deviation: float) -> Calibration:
    """A calibration without other noise, fitted to driving forwards, whose effect has a value of this deviation."""
    covariance = covariance_rows(np.diag([0.0] * 9 + [deviation**2]))
    quiet = Noise(walk_position=1e-9, walk_heading=1e-9)
    changes = {"covariance": covariance, "driven": ((0.2, 0.0, 0.0),), "plain": calibration().matrix, "noise": quiet}
    return with_effects(effect).model_copy(update=changes)


def driven_for(using: Calibration, seconds: float, twist: tuple[float, float, float]) -> LiveOdometry:
    rates = np.linalg.solve(using.matrix_array, twist)
    live = LiveOdometry(using)
    for _ in range(round(seconds / PERIOD)):
        live.step(WheelStep(0, PERIOD, PERIOD * rates, rates))
    return live


class TestSwaps:
    @given(
        st.sets(st.sampled_from(sorted(EFFECTS.keys() - {"floor_drift"})), max_size=3),
        st.integers(0, 99),
        st.booleans(),
    )
    def test_odom_goes_on_from_where_it_was_as_with_the_other_all_the_time(
        self, names: set[str], place: int, there: bool
    ) -> None:
        path, both = drive(1.0), [calibration(), with_effects(*(term(name, **EFFECTS[name]) for name in names))]
        first, second = both if there else both[::-1]
        robot = RobotTracker("apr", first)
        before = odometry(fed(robot, path.payloads()[: place + 1]))[-1]
        robot.swap(second)
        after = odometry(fed(robot, path.payloads()[place + 1 :]))[0]
        all_the_time = odometry(fed(RobotTracker("apr", second), path.payloads()))
        expected = relative(all_the_time[place], all_the_time[place + 1])
        np.testing.assert_allclose(relative(before, after), expected, atol=1e-9)

    def test_a_floor_that_carries_the_robot_does_not_move_it_at_once(self) -> None:
        path, using = drive(1.0), with_effects(term("floor_drift", dx=0.02, dy=-0.01))
        robot = RobotTracker("apr", calibration())
        before = odometry(fed(robot, path.payloads()[:51]))[-1]
        robot.swap(using)
        moved = odometry(fed(robot, path.payloads()[51:]))[0] - before
        plain = path.poses[51] - path.poses[50]
        np.testing.assert_allclose(moved, plain, atol=0.03 * np.hypot(plain[0], plain[1]))

    def test_a_swap_while_driving_is_not_taken_for_a_start_from_rest(self) -> None:
        using = with_effects(term("acceleration_slip", k=0.1), term("start_transient", k=0.2, length=0.05))
        step = np.array([0.05, -0.02, 0.01])
        live = LiveOdometry(calibration())
        for _ in range(300):
            live.step(WheelStep(0, PERIOD, step, step / PERIOD))
        swapped = live.continued(using)
        for _ in range(10):
            moved = swapped.step(WheelStep(0, PERIOD, step, step / PERIOD)).moved
            np.testing.assert_allclose(moved, using.matrix_array @ step, atol=1e-6)
        started = LiveOdometry(using).step(WheelStep(0, PERIOD, step, step / PERIOD)).moved
        assert np.abs(started - using.matrix_array @ step).max() > 1e-3  # which the same effects would have made of one

    def test_a_session_goes_on_over_a_swap(self) -> None:
        using = with_effects(term("thermal_radius_drift", k=1e-3))
        path = drive(3.0, using=using)
        robot = RobotTracker("apr", calibration())
        fed(robot, path.payloads()[:251])
        robot.swap(using)
        updates = fed(robot, path.payloads()[251:])
        expected = np.diff(batch(path, using), axis=0)[250:, 2]
        np.testing.assert_allclose(np.diff(odometry(updates), axis=0)[:, 2], expected, atol=1e-12)

    def test_wheels_keep_their_counted_angles_over_a_swap(self) -> None:
        using = with_effects(term("wheel_eccentricity", **ECCENTRIC))
        path = drive(6.0, using=using)
        live = LiveOdometry(using)
        for number, turned in enumerate(np.diff(path.angles, axis=0)):
            if number == 500:
                live = live.continued(using)
            live.step(WheelStep(0, PERIOD, turned, turned / PERIOD))
        from_zero = replace(path, angles=path.angles - path.angles[0])
        np.testing.assert_allclose(live.pose, batch(from_zero, using)[-1], atol=1e-9)


class TestSessions:
    def test_a_session_is_the_one_that_the_calibration_names(self) -> None:
        worn, path = term("tyre_wear", radius_evening=0.01), drive(1.0)
        turned = {
            session: odometry(fed(RobotTracker("apr", with_effects(worn, session=session)), path.payloads()))[-1, 2]
            for session in ("evening", "morning", None)
        }
        assert turned["evening"] == pytest.approx(1.01 * turned["morning"])
        assert turned["morning"] == turned[None] == pytest.approx(path.poses[-1, 2])

    def test_a_node_that_starts_again_goes_on_in_its_session(self, tmp_path: Path) -> None:
        from omnibench.live.estimation.saved_state import RobotMemory

        using = with_effects(term("thermal_radius_drift", k=1e-3))
        path = drive(4.0, using=using)
        memory = RobotMemory(tmp_path, "apr")
        first = RobotTracker("apr", using, memory=memory)
        fed(first, path.payloads()[:201])
        first.close()
        saved = RobotMemory(tmp_path, "apr").load()
        assert saved is not None
        assert saved.session_time == pytest.approx(2.0)
        second = RobotTracker("apr", using)
        second.resume(saved, 0.0, saved.wall)
        updates = fed(second, path.payloads()[201:])
        np.testing.assert_allclose(odometry(updates), batch(path, using)[200:], atol=1e-9)


class TestAngles:
    def test_that_angles_are_missing_is_told_once(self, caplog: pytest.LogCaptureFixture) -> None:
        using = with_effects(term("wheel_eccentricity", **ECCENTRIC))
        samples = [JOINT_STATE.encode(replace(each, positions=None)) for each in drive(0.2, using=using).samples()]
        with caplog.at_level(logging.WARNING, "omnibench.live"):
            fed(RobotTracker("apr", using), samples)
        (record,) = caplog.records
        assert "apr: wheel_eccentricity acts by wheel angles, and the messages tell none" in record.getMessage()

    @pytest.mark.parametrize("effect", ["heading_drift", "wheel_eccentricity"])
    def test_nothing_is_told_where_none_are_missing(self, effect: str, caplog: pytest.LogCaptureFixture) -> None:
        using = with_effects(term(effect, **EFFECTS[effect]))
        with caplog.at_level(logging.WARNING, "omnibench.live"):
            fed(RobotTracker("apr", using), drive(0.2, using=using).payloads())
        assert caplog.records == []


@pytest.mark.parametrize(
    "hidden",
    [
        (term("floor_drift", dx=0.02, dy=0.01), term("motor_lag", tau=0.1)),
        (term("wheel_eccentricity", **ECCENTRIC), term("thermal_radius_drift", k=1e-4)),
    ],
)
def test_the_truth_of_a_drive_has_the_effects_that_were_hidden(hidden: tuple[EffectTerm, ...]) -> None:
    recording = simulated_recording(effects=hidden)
    drive = concatenate_recording(recording)
    truth = concatenated_truth(drive, recording)
    at = np.searchsorted(drive.wheel_times, drive.slam_times - 1e-6)
    np.testing.assert_allclose(drive.slam_poses, truth[at], atol=1e-9)


def test_a_replay_with_effects_to_a_real_node_shows_the_batch_odometry(tmp_path: Path) -> None:
    hidden = [{"name": "wheel_eccentricity", "parameters": {"a_b": 0.02}}]
    simulated = flower(truth={"published": "palacin2023_eq8", "effects": hidden}, repetitions=1)
    config = write_config(tmp_path, datasets={"flower": {"simulate": simulated}})
    robot = calibration().robot
    using = Calibration(
        name="with effects",
        robot=robot,
        sample_period=0.05,
        matrix=matrix_rows(true_robot(synthetic_robot()).inverse_kinematic_matrix),
        integration="arc",
        effects=(term("wheel_eccentricity", **ECCENTRIC), term("acceleration_slip", k=0.05)),
    )
    write_calibration(using, tmp_path / "calibration.yaml")
    node = {
        "robots": [{"name": "apr", "calibration": "calibration.yaml"}],
        "fusion": "ekf",
        "zenoh": {"listen": f"tcp/127.0.0.1:{free_port()}"},
        "replay": {"dataset": config.name, "speed": "max"},
    }
    (tmp_path / "node.yaml").write_text(yaml.safe_dump(node))
    run = omnibench("live", tmp_path / "node.yaml", "--replay")
    assert run.returncode == 0, run.stderr
    difference = re.search(r"batch odometry: (\S+) \(m, rad\) at most; 0 messages of odom lost", run.stdout)
    assert difference is not None, run.stdout
    assert float(difference[1]) <= 1e-9


PLUGIN = '''
import numpy as np
from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter


@effects.register("stretched_turns")
class StretchedTurns(MotionEffect):
    """Turns are longer than the wheels say."""

    stage = "body"
    physics = "The robot is wider than it seems."
    source = "first principles"
    shows_in = "command"

    def parameters(self, robot, sessions=()):
        return (Parameter("k", "1", -0.1, 0.1, "share that is added"),)

    def correction(self, signals, values):
        return values["k"] * signals.twists * [0.0, 0.0, 1.0]
'''


def test_a_node_runs_effects_of_the_plugins_that_its_config_names(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "stretched_turns.py").write_text(PLUGIN)
    config = config_of(tmp_path, "apr", plugins=["mine"])
    using = with_effects(term("stretched_turns", k=0.1), session=None)
    (tmp_path / "calibration.yaml").write_text(to_yaml(using))
    path = drive(0.5)
    with LiveNode(config) as node:
        updates = fed(node.trackers["apr"], path.payloads())
    np.testing.assert_allclose(odometry(updates)[:, 2], 1.1 * path.poses[:, 2], atol=1e-9)


def test_live_takes_the_plugins_that_are_named(command: InProcess, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "stretched_turns.py").write_text(PLUGIN)
    write_node(tmp_path, "apr", replay={"dataset": "small.yaml", "speed": "max"})
    write_config(tmp_path, datasets={"flower": {"simulate": flower()}})
    using = with_effects(term("stretched_turns", k=0.1), session=None, sample_period=0.05)
    (tmp_path / "calibration.yaml").write_text(to_yaml(using))
    assert_refused(command("live", "node.yaml", "--replay"), "unknown effect 'stretched_turns'")
    shown = command("live", "node.yaml", "--replay", "--plugins", "mine")
    assert shown.returncode == 0, shown.stderr
    assert "0 messages of odom lost" in shown.stdout
