"""Live odometry, of robots that steer too, with effects and learned ones: the batch's numbers, covariances, swaps."""

import logging
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Command as InProcess
from commands import assert_refused, flower, succeeded, write_config, write_effect
from drives import EXACT, NOISE, ORIGIN, PERIOD, Drive, calibration, drive, fed, odometry, slam, term, with_effects
from hypothesis import given
from hypothesis import strategies as st
from learned_samples import a_learned_calibration
from nodes import asked, config_of, running, write_node
from sample_robots import CAR, DIFFERENTIAL, TRICYCLE
from samples import messages_of
from steered import SKID, SWERVE, only, recording, steered_calibration, steered_drive

from omnibench.config import to_yaml, validate
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.errors import DataError
from omnibench.live.config import LiveConfig
from omnibench.live.control import LONGEST
from omnibench.live.demonstration import demonstrate
from omnibench.live.drive import ConcatenatedDrive, Recording, ReplayConfig, concatenate_recording
from omnibench.live.fusion import FusionSettings
from omnibench.live.node import LiveNode
from omnibench.live.odometry import LiveOdometry
from omnibench.live.replay import ReplayMessages
from omnibench.live.state import RobotMemory, SavedState
from omnibench.live.tracker import RobotTracker
from omnibench.live.wheels import WheelSettings, WheelStep
from omnibench.live.wire import JOINT_STATE, JointState
from omnibench.robot.calibration import (
    Calibration,
    EffectTerm,
    Noise,
    Provenance,
    covariance_rows,
    matrix_rows,
    parse_calibration,
    write_calibration,
)
from omnibench.robot.effects.effect import MOST_BYTES, encode_weights
from omnibench.robot.kinematics import Array, Mount, Robot, compose, moved_to, relative, rotation
from omnibench.robot.odometry import Integration, OdometryBatch, WheelLog
from omnibench.testing.synthetic import synthetic_robot


def driven(odometry: LiveOdometry, angles: np.ndarray, durations: np.ndarray) -> LiveOdometry:
    for turned, duration in zip(np.diff(angles, axis=0), durations, strict=True):
        odometry.step(WheelStep(0, float(duration), turned, turned / duration))
    return odometry


@pytest.mark.parametrize("integration", ["euler", "arc"])
def test_the_covariance_of_the_matrix_spreads_as_the_batch_derivatives_say(integration: Integration) -> None:
    path = drive(4.0, using=calibration(integration=integration))
    log = WheelLog(path.times, np.diff(path.angles, axis=0) / PERIOD, np.zeros(3), path.times[-1:])
    slopes = OdometryBatch([log], integration).jacobian(path.calibration.matrix_array)[0].reshape(3, 9)
    expected = slopes @ np.array(path.calibration.covariance) @ slopes.T
    quiet = path.calibration.model_copy(update={"noise": Noise(walk_position=1e-9, walk_heading=1e-9)})
    live = driven(LiveOdometry(quiet), path.angles, np.full(400, 0.01))
    np.testing.assert_allclose(live.pose, path.poses[-1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(live.covariance, expected, rtol=2e-3, atol=1e-3 * np.abs(expected).max())


def test_the_random_walk_spreads_as_simulations_of_it_do() -> None:
    path = drive(4.0, using=calibration(deviation=None))
    rng = np.random.default_rng(5)
    live = driven(LiveOdometry(path.calibration), path.angles, np.full(400, 0.01))
    matrix, steps = path.calibration.matrix_array, np.diff(path.angles, axis=0)
    count = 4000
    pose = np.zeros((count, 3))
    for moved in steps @ matrix.T:
        direction = pose[:, 2] + moved[2] / 2
        pose[:, 0] += moved[0] * np.cos(direction) - moved[1] * np.sin(direction)
        pose[:, 1] += moved[0] * np.sin(direction) + moved[1] * np.cos(direction)
        pose[:, 2] += moved[2]
        pose += 0.1 * rng.standard_normal((count, 3)) * [NOISE.walk_position, NOISE.walk_position, NOISE.walk_heading]
    seen = np.cov(pose.T)
    np.testing.assert_allclose(np.diag(live.covariance), np.diag(seen), rtol=0.1)
    assert np.corrcoef(pose.T)[0, 2] == pytest.approx(
        live.covariance[0, 2] / np.sqrt(live.covariance[0, 0] * live.covariance[2, 2]), abs=0.05
    )


@given(st.floats(0.6, 1.4), st.integers(1, 99))
def test_a_swapped_calibration_moves_the_next_sample_and_not_the_pose(scale: float, place: int) -> None:
    path, other = drive(1.0), calibration(scale=scale, integration="euler")
    durations = np.full(100, 0.01)
    live = driven(LiveOdometry(path.calibration), path.angles[: place + 1], durations[:place])
    before, spread = live.pose.copy(), live.covariance
    live = live.continued(other)
    np.testing.assert_array_equal(live.pose, before)
    np.testing.assert_allclose(live.covariance, spread, rtol=1e-12)
    live.step(step(0.01, [0.01, 0.0, 0.0]))
    moved = other.matrix_array @ [0.01, 0.0, 0.0]
    assert np.linalg.norm(live.pose[:2] - before[:2]) == pytest.approx(np.linalg.norm(moved[:2]), rel=1e-9)


def step(duration: float, angles: list[float], blind: float = 0.0) -> WheelStep:
    return WheelStep(0, duration, np.array(angles), np.array(angles) / duration, blind)


def test_noise_shrinks_while_no_wheel_turns() -> None:
    still, moving = (LiveOdometry(calibration(deviation=None), standstill=0.01) for _ in range(2))
    for _ in range(100):
        still.step(step(0.01, [0.0, 0.0, 0.0]))
        moving.step(step(0.01, [0.02, 0.02, 0.02]))
    assert still.covariance[2, 2] == pytest.approx(0.01 * moving.covariance[2, 2], rel=1e-6)


def test_what_nobody_saw_makes_the_pose_less_certain() -> None:
    seen, unseen = LiveOdometry(calibration()), LiveOdometry(calibration())
    for live, blind in ((seen, 0.0), (unseen, 3.0)):
        live.step(step(0.01, [0.02, 0.01, -0.02]))
        live.step(step(3.0, [6.0, 3.0, -6.0], blind=blind))
    assert unseen.covariance[0, 0] > seen.covariance[0, 0] + 0.01


@pytest.mark.parametrize("bare", [False, True])
def test_the_covariance_is_regular_and_grows_while_nothing_comes(bare: bool) -> None:
    live = LiveOdometry(calibration(deviation=None).model_copy(update={"noise": None}) if bare else calibration())
    live.step(step(0.01, [0.02, 0.01, -0.02]))
    assert np.linalg.eigvalsh(live.covariance)[0] > 0
    traces = [float(np.trace(live.covariance + live.silence_covariance(seconds))) for seconds in (0.0, 0.5, 1.0, 5.0)]
    assert traces == sorted(traces)
    assert traces[-1] > 2 * traces[0]


def test_a_calibration_with_numbers_on_a_bound_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    origin = Provenance(
        dataset="d", dataset_hash="0", calibrator="crs", seed=1, cost="final_pose", box="row", outcome="converged"
    )
    LiveOdometry(calibration().model_copy(update={"provenance": origin}))
    assert not caplog.messages
    LiveOdometry(calibration().model_copy(update={"provenance": origin.model_copy(update={"on_bounds": ("m23",)})}))
    assert "m23 on a bound of the box, of which no variance is known: covariances are too small" in caplog.text


@pytest.mark.parametrize("heading", [0.7, -2.0])
def test_the_covariance_of_a_path_that_begins_turned_is_turned_with_it(heading: float) -> None:
    path, turn = drive(4.0), rotation(heading)
    straight, turned = LiveOdometry(path.calibration), LiveOdometry(path.calibration)
    turned.resume(np.array([0.0, 0.0, heading]), np.zeros((3, 3)))
    for live in (straight, turned):
        driven(live, path.angles, np.full(400, 0.01))
    expected = turn @ straight.covariance @ turn.T
    np.testing.assert_allclose(turned.covariance, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_filter_takes_the_error_of_the_matrix_as_noise_that_lasts_a_second() -> None:
    """What the matrix adds to the twist's variances, v2 for a velocity, adds v2 x 1 s x dt to the motion's."""
    exact, doubtful = LiveOdometry(calibration(deviation=None)), LiveOdometry(calibration(deviation=2e-3))
    quiet, noisy = (live.step(step(0.02, [0.01, -0.02, 0.005])) for live in (exact, doubtful))
    along_x, along_y, turning = np.diag(doubtful.twist_covariance - exact.twist_covariance)
    assert min(along_x, along_y, turning) > 0
    added = noisy.position_variance - quiet.position_variance, noisy.heading_variance - quiet.heading_variance
    assert added == pytest.approx((0.02 * (along_x + along_y) / 2, 0.02 * turning))


def test_held_steering_angles_make_a_way_as_doubtful_in_many_steps_as_in_one() -> None:
    """The angle is wrong in the same way all along, so that deviations add up, and not variances."""
    once, often = (LiveOdometry(calibration(deviation=None)) for _ in range(2))
    whole = [once.step(step(1.0, [1.0, 1.0, 1.0], blind=1.0)._replace(held=True))]
    parts = [often.step(step(0.1, [0.1, 0.1, 0.1], blind=0.1)._replace(held=True)) for _ in range(10)]
    for name in ("position_variance", "heading_variance"):
        assert sum(getattr(part, name) for part in parts) == pytest.approx(getattr(whole[0], name))


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


def batch(path: Drive, using: Calibration) -> Array:
    """Batch odometry at every sample from the origin, with angles as the wheels count them."""
    return replace(path, calibration=using).poses[1:]


# Agrees with the batch


@given(st.sets(st.sampled_from(sorted(EFFECTS)), max_size=4), st.integers(0, 1000), st.sampled_from(["euler", "arc"]))
def test_odom_with_effects_is_that_of_the_batch(names: set[str], seed: int, integration: Integration) -> None:
    plain = calibration(integration=integration)
    using = with_effects(*(term(name, **EFFECTS[name]) for name in names), plain=plain)
    path = drive(1.0, seed=seed, using=using)
    updates = fed(RobotTracker("apr", using), path.payloads())
    np.testing.assert_allclose(odometry(updates)[1:], batch(path, using), atol=1e-9)


def test_motions_lead_the_filter_along_odom_with_effects_too() -> None:
    using = with_effects(*(term(name, **values) for name, values in EFFECTS.items()))
    path = drive(2.0, using=using)
    robot = RobotTracker("apr", using, fusion=FusionSettings())
    robot.take_wheels(path.payloads()[0], 0.0)
    robot.take_pose(slam(ORIGIN, [0.0, 0.0, 0.0]), 0.0)
    updates = fed(robot, path.payloads()[1:])
    for update in updates:
        np.testing.assert_allclose(update.in_map[0], update.pose, atol=1e-9)


def test_the_covariance_of_the_matrix_is_used_though_that_of_effects_follows_it() -> None:
    plain, nothing = calibration(), term("heading_drift", b=0.0)
    spread = np.diag([1e-8] * 9 + [1e-4])
    using = with_effects(nothing, plain=plain, covariance=covariance_rows(spread))
    path = drive(1.0)
    last, last_with_effect = (fed(RobotTracker("apr", each), path.payloads())[-1] for each in (plain, using))
    np.testing.assert_allclose(last_with_effect.covariance, last.covariance, rtol=1e-9)


def test_the_covariance_grows_by_what_effects_extrapolate_and_only_there() -> None:
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


# Swaps


@given(
    st.sets(st.sampled_from(sorted(EFFECTS.keys() - {"floor_drift"})), max_size=3), st.integers(0, 99), st.booleans()
)
def test_odom_goes_on_after_a_swap_as_with_the_other(names: set[str], place: int, there: bool) -> None:
    path, both = drive(1.0), [calibration(), with_effects(*(term(name, **EFFECTS[name]) for name in names))]
    first, second = both if there else both[::-1]
    robot = RobotTracker("apr", first)
    before = odometry(fed(robot, path.payloads()[: place + 1]))[-1]
    robot.swap(second)
    after = odometry(fed(robot, path.payloads()[place + 1 :]))[0]
    all_the_time = odometry(fed(RobotTracker("apr", second), path.payloads()))
    expected = relative(all_the_time[place], all_the_time[place + 1])
    np.testing.assert_allclose(relative(before, after), expected, atol=1e-9)


def test_a_floor_that_carries_the_robot_does_not_move_it_at_once() -> None:
    path, using = drive(1.0), with_effects(term("floor_drift", dx=0.02, dy=-0.01))
    robot = RobotTracker("apr", calibration())
    before = odometry(fed(robot, path.payloads()[:51]))[-1]
    robot.swap(using)
    moved = odometry(fed(robot, path.payloads()[51:]))[0] - before
    plain = path.poses[51] - path.poses[50]
    np.testing.assert_allclose(moved, plain, atol=0.03 * np.hypot(plain[0], plain[1]))


def test_a_swap_while_driving_is_not_taken_for_a_start_from_rest() -> None:
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


@pytest.mark.parametrize("effect", ["wheel_eccentricity", "thermal_radius_drift"])
def test_counted_angles_and_the_sessions_time_go_on_over_swaps(effect: str) -> None:
    using = with_effects(term(effect, **EFFECTS[effect]))
    path = drive(6.0, using=using)
    live = LiveOdometry(using)
    for number, turned in enumerate(np.diff(path.angles, axis=0)):
        if number in (200, 500):
            live = live.continued(using)
        live.step(WheelStep(0, PERIOD, turned, turned / PERIOD))
    from_zero = replace(path, angles=path.angles - path.angles[0])
    np.testing.assert_allclose(live.pose, batch(from_zero, using)[-1], atol=1e-9)


# Sessions


def test_a_session_is_the_one_that_the_calibration_names() -> None:
    worn, path = term("tyre_wear", radius_evening=0.01), drive(1.0)
    turned = {
        session: odometry(fed(RobotTracker("apr", with_effects(worn, session=session)), path.payloads()))[-1, 2]
        for session in ("evening", "morning", None)
    }
    assert turned["evening"] == pytest.approx(1.01 * turned["morning"])
    assert turned["morning"] == turned[None] == pytest.approx(path.poses[-1, 2])


# Angles


@pytest.mark.parametrize("effect", ["heading_drift", "wheel_eccentricity"])
@pytest.mark.parametrize("missing", [False, True])
def test_missing_angles_are_told(effect: str, missing: bool, caplog: pytest.LogCaptureFixture) -> None:
    using = with_effects(term(effect, **EFFECTS[effect]))
    samples = [replace(each, positions=None) if missing else each for each in drive(0.2, using=using).samples()]
    with caplog.at_level(logging.WARNING, "omnibench.live"):
        fed(RobotTracker("apr", using), [JOINT_STATE.encode(each) for each in samples])
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == (missing and effect == "wheel_eccentricity")
    assert all(message.startswith("apr: wheel_eccentricity ") for message in told)


# Turns are longer than the wheels say: the parameter, and the correction.
STRETCHED = ('"k", "1", -0.1, 0.1, "share that is added"', 'values["k"] * signals.twists * [0.0, 0.0, 1.0]')


def test_live_takes_the_named_plugins_and_replays_to_the_batch_odometry(command: InProcess, tmp_path: Path) -> None:
    write_effect(tmp_path / "mine" / "stretched_turns.py", "body", *STRETCHED)
    write_node(tmp_path, "apr", replay={"dataset": "small.yaml", "speed": "max"})
    hidden = [{"name": "wheel_eccentricity", "parameters": {"a_b": 0.02}}]
    simulated = flower(truth={"published": "palacin2023_eq8", "effects": hidden})
    write_config(tmp_path, datasets={"flower": {"simulate": simulated}})
    terms = (term("stretched_turns", k=0.1), term("wheel_eccentricity", **ECCENTRIC), term("acceleration_slip", k=0.05))
    (tmp_path / "calibration.yaml").write_text(to_yaml(with_effects(*terms, session=None, sample_period=0.05)))
    assert_refused(command("live", "node.yaml", "--replay"), "unknown effect 'stretched_turns'")
    shown = succeeded(command("live", "node.yaml", "--replay", "--plugins", "mine"))
    difference = re.search(r"batch odometry: (\S+) \(m, rad\) at most; 0 messages of odom lost", shown.stdout)
    assert difference is not None, shown.stdout
    assert float(difference[1]) <= 1e-9


def test_a_node_runs_effects_of_the_plugins_that_its_config_names(tmp_path: Path) -> None:
    write_effect(tmp_path / "mine" / "stretched_turns.py", "body", *STRETCHED)
    config = config_of(tmp_path, "apr", plugins=["mine"])
    (tmp_path / "calibration.yaml").write_text(to_yaml(with_effects(term("stretched_turns", k=0.1), session=None)))
    path = drive(0.5)
    with LiveNode(config) as node:
        updates = fed(node.trackers["apr"], path.payloads())
    np.testing.assert_allclose(odometry(updates)[:, 2], 1.1 * path.poses[:, 2], atol=1e-9)


DRIVEN = [[20.0, 0.0, 0.0]]  # m/s, m/s, rad/s: so fast that all that is driven here is near to it


def learned() -> Calibration:
    return a_learned_calibration(synthetic_robot(3), DRIVEN, PERIOD).model_copy(update={"noise": NOISE})


def test_the_largest_weights_with_many_motions_fit_in_a_request() -> None:
    """487 motions are driven in OptiOdom's circles of omni3, the most of all recordings here."""
    motions = tuple((-0.123456789, 0.123456789, -0.123456789) for _ in range(600))
    (term,) = learned().effects
    weights = encode_weights(np.ones(MOST_BYTES // 4))
    heaviest = term.model_copy(update={"weights": weights})
    largest = learned().model_copy(update={"driven": motions, "effects": (heaviest,)})
    assert len(to_yaml(largest).encode()) < LONGEST


def test_a_swap_to_a_learned_calibration_is_read_from_its_message_and_does_not_jump() -> None:
    text = to_yaml(learned())
    path, robot = drive(2.0), RobotTracker("apr", calibration())
    payloads = path.payloads()
    before = fed(robot, payloads[:100])
    robot.swap(parse_calibration(text, "request"))
    after = fed(robot, payloads[100:], 1.0)
    assert np.abs(after[0].pose - before[-1].pose).max() < 0.1
    stayed = fed(RobotTracker("apr", calibration()), payloads)
    assert np.abs(after[-1].pose - stayed[-1].pose).max() > 1e-4


# Robots that steer in a running node: the batch and its numbers, over swaps, restarts and replays, of their centre.

MOUNT = Mount(x=0.3, y=-0.1, yaw=0.4)
EFFECTS_OF_STEERED = (
    EffectTerm(name="speed_dependent_radius", parameters={"k": 0.01}),
    EffectTerm(name="acceleration_slip", parameters={"k": 0.08}),
    EffectTerm(name="centripetal_slip", parameters={"k": 0.05}),
    EffectTerm(name="floor_drift", parameters={"dx": 0.02, "dy": -0.01}),
    EffectTerm(name="heading_drift", parameters={"b": 0.005}),
)


def mounted(robot: Robot, mount: Mount | None = MOUNT) -> Robot:
    return robot.model_copy(update={"mount": mount})


def centre_of(tracked: Array) -> Array:
    """The centre's pose, from that of the tracked point."""
    return compose(tracked, relative(np.array([MOUNT.x, MOUNT.y, MOUNT.yaw]), np.zeros(3)))


def retracked(one: Calibration, robot: Robot) -> Array:
    """The matrix by which another point of a robot, its tracked one or the centre, moves as in a calibration."""
    centred: Array = np.linalg.inv(one.robot.mount.twist) @ one.matrix_array
    return centred if robot.mount is None else robot.mount.twist @ centred


@pytest.mark.parametrize("robot", [SWERVE, TRICYCLE, CAR], ids=lambda robot: robot.name)
@pytest.mark.parametrize("integration", ["euler", "arc"])
@pytest.mark.parametrize("effects", [False, True])
def test_odom_is_the_batch_odometry(robot: Robot, integration: Integration, effects: bool) -> None:
    plain = steered_calibration(robot, integration=integration)
    path = steered_drive(using=with_effects(*EFFECTS_OF_STEERED, plain=plain) if effects else plain)
    updates = fed(RobotTracker("base", path.calibration), path.payloads())
    np.testing.assert_allclose(odometry(updates), path.poses, atol=1e-12)


@pytest.mark.parametrize("use", ["positions", "velocities"])
def test_wheels_are_read_by_what_the_config_says_and_steering_by_positions(use: Any) -> None:
    path = steered_drive()
    robot = RobotTracker("base", path.calibration, wheels=WheelSettings(use=use))
    np.testing.assert_allclose(odometry(fed(robot, path.payloads())), path.poses, atol=1e-12)


def test_the_first_sample_steers_by_the_mean_of_its_own_angle_and_that_of_the_message_before() -> None:
    path = steered_drive(0.01)
    turned = path.steering.copy()
    turned[0] -= 0.3
    updates = fed(RobotTracker("base", path.calibration), replace(path, steering=turned).payloads())
    middle = replace(path, steering=path.steering - 0.15)
    np.testing.assert_allclose(odometry(updates), middle.poses, atol=1e-12)


def test_messages_that_are_lost_cost_the_turns_of_the_steering_and_no_way() -> None:
    path = steered_drive(2.0)
    kept = [path.payloads()[0], *(each for number, each in enumerate(path.payloads()[1:], 1) if number % 3 == 0)]
    robot = RobotTracker("base", path.calibration)
    last = [update for number, each in enumerate(kept) for update in robot.take_wheels(each, 3 * PERIOD * number)][-1]
    np.testing.assert_allclose(last.pose, path.poses[198], atol=0.02)
    assert np.hypot(*last.pose[:2]) > 0.05


def test_steering_joints_in_messages_of_their_own_give_the_same_poses() -> None:
    path = steered_drive()
    robot, updates = RobotTracker("base", path.calibration), []
    for number, sample in enumerate(path.samples()):
        for joints in (sample.names[4:], sample.names[:4]):
            updates += robot.take_wheels(JOINT_STATE.encode(only(sample, *joints)), PERIOD * number)
    np.testing.assert_allclose(odometry(updates), path.poses, atol=1e-12)
    assert robot.counts.anomalies() == {}


@pytest.mark.parametrize("robot", [SWERVE, CAR], ids=lambda robot: robot.name)
def test_the_twist_is_the_matrix_times_the_signals(robot: Robot) -> None:
    path = steered_drive(0.5, using=steered_calibration(robot))
    update = fed(RobotTracker("base", path.calibration), path.payloads())[-1]
    np.testing.assert_allclose(update.twist, path.calibration.matrix_array @ path.log.signals[-1], atol=1e-9)


def test_health_says_what_a_robot_without_steering_angles_waits_for_and_how_old_its_last_ones_are() -> None:
    path = steered_drive(0.6)
    robot = RobotTracker("base", path.calibration)
    wheels = [JOINT_STATE.encode(only(sample, *sample.names[:4])) for sample in path.samples()]
    robot.take_wheels(wheels[0], 0.0)
    assert robot.health(0.0).status == "waiting"
    assert "no joint 'fl_steering' among fl, fr, rl, rr" in robot.health(0.0).message
    fed(robot, [path.payloads()[1], *wheels[2:]], PERIOD)
    health = robot.health(0.6)
    assert (health.status, "no steering angles for 0.6 s" in health.message) == ("degraded", True)
    assert health.counts["old_steering"] == 39


def test_what_is_driven_by_old_angles_makes_the_pose_as_uncertain_as_the_way_is_long() -> None:
    path = steered_drive(3.0)
    robot = RobotTracker("base", path.calibration)
    fed(robot, [path.payloads()[0]])
    wheels = [JOINT_STATE.encode(only(sample, *sample.names[:4])) for sample in path.samples()[1:]]
    deviations = np.sqrt([update.covariance[0, 0] for update in fed(robot, wheels, PERIOD)])
    rolled = 0.05 * np.abs(np.diff(path.angles[[20, -1]], axis=0)).max()
    assert deviations[19] < 0.005
    assert deviations[-1] > 0.3 * rolled > 0.02


# Restarts


def saved(**state: Any) -> SavedState:
    covariance = (1e-4 * np.eye(3)).ravel().tolist()
    return SavedState(sequence=5, stamp=ORIGIN, wall=1.8e9, pose=[1.0, 2.0, 0.3], covariance=covariance, **state)


AGAIN = {
    "swerve": steered_drive(using=steered_calibration(SWERVE)),
    "car with a mount": steered_drive(using=steered_calibration(mounted(CAR))),
    "later in its session": drive(1.0, using=with_effects(term("thermal_radius_drift", k=1e-3))),
}


@pytest.mark.parametrize("case", AGAIN)
def test_a_node_that_starts_again_goes_on_exactly(tmp_path: Path, case: str) -> None:
    path = AGAIN[case]
    memory = RobotMemory(tmp_path, "base")
    first = RobotTracker("base", path.calibration, memory=memory)
    before = fed(first, path.payloads()[:51])
    first.close()
    saved = RobotMemory(tmp_path, "base").load()
    second = RobotTracker("base", path.calibration)
    second.resume(saved, 0.5, saved.wall)
    found = odometry(before + fed(second, path.payloads()[51:], 0.51))
    uninterrupted = odometry(fed(RobotTracker("base", path.calibration), path.payloads()))
    np.testing.assert_allclose(found, uninterrupted, atol=1e-12)


def test_a_robot_whose_saved_state_has_no_steering_waits_for_it() -> None:
    path = steered_drive(0.1)
    robot = RobotTracker("base", path.calibration)
    robot.resume(saved(positions=path.angles[0].tolist()), 0.0, 1.8e9)
    bare = path.samples()[1]
    assert robot.take_wheels(JOINT_STATE.encode(only(bare, *bare.names[:4])), PERIOD) == []
    updates = fed(robot, path.payloads()[2:], 2 * PERIOD)
    held = replace(path, angles=path.angles[[0, *range(2, 11)]], steering=path.steering[[0, *range(2, 11)]])
    np.testing.assert_allclose(odometry(updates)[-1], compose(np.array([1.0, 2.0, 0.3]), held.poses[-1]), atol=1e-9)


def test_a_state_of_a_robot_with_other_steered_wheels_is_refused() -> None:
    with pytest.raises(DataError, match="1 steered wheel"):
        RobotTracker("base", steered_calibration(CAR)).resume(saved(positions=[0.0] * 2, steering=[0.1]), 0.0, 1.8e9)


# Swaps


@pytest.mark.parametrize("place", [0, 50])
@pytest.mark.parametrize("effects", [False, True])
def test_the_next_sample_steers_by_the_angle_before_the_swap(place: int, effects: bool) -> None:
    plain = steered_calibration()
    path = steered_drive()
    other = with_effects(*EFFECTS_OF_STEERED, plain=plain) if effects else plain.model_copy(update={"name": "other"})
    robot = RobotTracker("base", plain)
    fed(robot, path.payloads()[: place + 1])
    robot.swap(other)
    after = fed(robot, path.payloads()[place + 1 :], PERIOD * (place + 1))
    if not effects:
        np.testing.assert_allclose(odometry(after), path.poses[place + 1 :], atol=1e-12)
    assert len(after) == 100 - place
    assert np.abs(odometry(after)[0] - path.poses[place + 1]).max() < 2e-3


@pytest.mark.parametrize(
    ("robot", "reason"),
    [
        (TRICYCLE, "is for wheels front, this robot has fl, fr, rl, rr"),
        (SKID, "is for steered wheels none, this robot has fl, fr, rl, rr"),
    ],
)
def test_a_calibration_of_other_wheels_is_refused(robot: Robot, reason: str) -> None:
    with pytest.raises(DataError, match=reason):
        RobotTracker("base", steered_calibration()).swap(steered_calibration(robot))


def test_a_matrix_row_without_design_is_compared_with_the_size_of_the_other() -> None:
    robot = RobotTracker("base", steered_calibration(DIFFERENTIAL))
    slid = robot.calibration.matrix_array
    slid[1] = 0.1 * slid[0]
    robot.swap(steered_calibration(DIFFERENTIAL, matrix=matrix_rows(slid)))
    slid[1] = slid[0]
    with pytest.raises(DataError, match=r"row 2 of the matrix is 10.% off the design of robot 'diff'"):
        robot.swap(steered_calibration(DIFFERENTIAL, matrix=matrix_rows(slid)))


def test_the_tracked_point_may_move_and_the_centre_does_not_jump() -> None:
    path = steered_drive(using=steered_calibration(mounted(SWERVE)))
    other = steered_calibration(mounted(SWERVE, Mount(x=-0.5, y=0.4, yaw=2.0)))
    other = other.model_copy(update={"matrix": matrix_rows(retracked(path.calibration, other.robot))})
    robot = RobotTracker("base", path.calibration)
    before = fed(robot, path.payloads()[:51])
    robot.swap(other)
    found = odometry(before + fed(robot, path.payloads()[51:], 0.51))
    alone = fed(RobotTracker("base", path.calibration), path.payloads())
    np.testing.assert_allclose(found, odometry(alone), atol=1e-12)


# A calibration moves the tracked point; what a node tells is of the robot's centre.


@pytest.mark.parametrize("effects", [False, True])
def test_the_pose_is_of_the_point_from_which_the_tracked_one_is_mounted(effects: bool) -> None:
    plain = steered_calibration(mounted(SWERVE))
    path = steered_drive(using=with_effects(*EFFECTS_OF_STEERED, plain=plain) if effects else plain)
    updates = fed(RobotTracker("base", path.calibration), path.payloads())
    np.testing.assert_allclose(updates[0].pose, np.zeros(3), atol=1e-15)
    tracked = compose(odometry(updates), np.array([MOUNT.x, MOUNT.y, MOUNT.yaw]))
    if not effects:
        np.testing.assert_allclose(moved_to(np.zeros(3), tracked), path.poses, atol=1e-12)
    log = replace(path.log, start=tracked[0])
    np.testing.assert_allclose(tracked, path.calibration.model.poses([log])[0], atol=1e-12)


def test_twist_and_covariances_are_those_of_a_calibration_of_the_centre_itself() -> None:
    mount, noise = mounted(SWERVE), Noise(walk_position=1e-9, walk_heading=1e-9)
    path = steered_drive(using=steered_calibration(mount, noise=noise))
    carry = np.kron(np.linalg.inv(MOUNT.twist), np.eye(8))
    centred = steered_calibration(
        SWERVE,
        noise=noise,
        matrix=matrix_rows(retracked(path.calibration, SWERVE)),
        covariance=covariance_rows(carry @ np.array(path.calibration.covariance) @ carry.T),
    )
    (found, expected) = (fed(RobotTracker("base", each), path.payloads())[-1] for each in (path.calibration, centred))
    np.testing.assert_allclose(found.pose, expected.pose, atol=1e-12)
    np.testing.assert_allclose(found.twist, expected.twist, atol=1e-12)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-3, atol=1e-10)
    np.testing.assert_allclose(np.diag(found.twist_covariance), np.diag(expected.twist_covariance), rtol=0.5)


@pytest.mark.parametrize("late", [0.0, 0.1])
def test_poses_of_the_tracked_point_locate_the_centre(late: float) -> None:
    terms = (EffectTerm(name="reference_time_offset", parameters={"tau": late}),) if late else ()
    path = steered_drive(3.0, using=steered_calibration(mounted(SWERVE), effects=terms, covariance=None))
    at = np.array([2.0, -1.0, 0.7])
    tracked = moved_to(at, path.poses)
    robot = RobotTracker("base", path.calibration, fusion=FusionSettings())
    behind = round(late / PERIOD)
    for number, payload in enumerate(path.payloads()):
        updates = robot.take_wheels(payload, PERIOD * number)
        if number % 25 == 20:
            seen = slam(path.samples()[number].stamp, tracked[number - behind], 1e-2 * EXACT)
            robot.take_pose(seen, PERIOD * number)
    np.testing.assert_allclose(updates[-1].in_map[0], centre_of(tracked[-1]), atol=1e-6)
    assert robot.counts.anomalies() == {}


def played(drive: ConcatenatedDrive, names: tuple[str, ...] | None = None, **changes: Any) -> list[JointState]:
    config = validate(ReplayConfig, changes, "test")
    messages = (each.message for each in ReplayMessages(drive, config, names=names).stamped_from(ORIGIN))
    return [each for each in messages if isinstance(each, JointState)]


def replayed_odometry(robot: RobotTracker, messages: list[JointState]) -> Array:
    payloads = ((JOINT_STATE.encode(each), (each.stamp - ORIGIN) / 1e9) for each in messages)
    return np.array([update.pose for each in payloads for update in robot.take_wheels(*each)])


@pytest.mark.parametrize("robot", [SWERVE, TRICYCLE, CAR], ids=lambda robot: robot.name)
@pytest.mark.parametrize("pause", [0.0, 0.1])
def test_what_a_node_makes_of_a_replay_is_the_batch_odometry(robot: Robot, pause: float) -> None:
    using = steered_calibration(robot)
    drive = concatenate_recording(recording(using=using), pause=pause)
    found = replayed_odometry(RobotTracker("base", using), played(drive))
    np.testing.assert_allclose(moved_to(drive.start_poses[0], found), using.model.poses([drive.log()])[0], atol=1e-12)


def test_every_run_of_a_drive_with_pauses_is_driven_as_it_was_alone() -> None:
    using = steered_calibration()
    made = recording(using=using)
    drive = concatenate_recording(made, pause=0.1)
    (poses,) = using.model.poses([drive.log()])
    for number, run in enumerate(made.dataset.trajectories):
        ends = drive.start_times[number] + run.times
        at = np.searchsorted(drive.wheel_times, [ends[0] - run.times[0] - 1e-6, *(ends - 1e-6)])
        (alone,) = using.model.poses([run.log(np.append(0.0, run.times))])
        np.testing.assert_allclose(moved_to(alone[0], poses[at]), alone, atol=1e-12)


def test_a_run_that_is_cut_at_its_last_pose_steers_as_it_did() -> None:
    using = steered_calibration()
    drive = concatenate_recording(recording(using=using, runs=1, pose_every=13))
    assert len(drive.steering) == len(drive.wheel_times) == 40
    (poses,) = using.model.poses([drive.log(drive.slam_times)])
    np.testing.assert_allclose(poses, drive.slam_poses, atol=1e-12)


@pytest.mark.parametrize(("use", "told"), [("positions", (1, 0)), ("velocities", (0, 1)), ("both", (1, 1))])
def test_messages_hold_the_steering_angles_whatever_they_hold_of_the_wheels(use: str, told: tuple[int, int]) -> None:
    drive = concatenate_recording(recording())
    for row, message in enumerate(played(drive, wheels={"use": use})):
        assert message.names == ("fl", "fr", "rl", "rr", *(f"{each}_steering" for each in ("fl", "fr", "rl", "rr")))
        np.testing.assert_array_equal(message.positions[4:], drive.steering[row])
        velocities = np.full(8, math.nan) if message.velocities is None else message.velocities
        assert tuple(int(np.isfinite(each[:4]).all()) for each in (message.positions, velocities)) == told
        assert np.isnan(velocities[4:]).all()


MOUNTED = mounted(SWERVE)


def config(folder: Path, using: Calibration, **changes: object) -> LiveConfig:
    made = config_of(folder, "base", **changes)
    write_calibration(using, folder / "calibration.yaml")
    return made


def test_a_node_says_how_its_robot_steers_and_where_its_tracked_point_is(tmp_path: Path) -> None:
    with running(config(tmp_path, steered_calibration(MOUNTED))) as (_, session):
        info = asked(session, "omnibench/base/info")
    assert info["steered"] == ["fl", "fr", "rl", "rr"]
    assert info["signals"][:2] == ["fl_cos", "fl_sin"]
    assert info["mount"] == {"x": 0.3, "y": -0.1, "yaw": 0.4}


def test_a_replay_shows_the_batch_odometry_of_the_tracked_point_and_is_recorded(tmp_path: Path) -> None:
    using = steered_calibration(MOUNTED)
    made = config(tmp_path, using, record="run.mcap", replay={"speed": "max", "slam": {"period": 0.1, "delay": 0.0}})
    shown = demonstrate(made, recording(using=using))
    assert shown.batch_difference < 1e-12
    assert shown.calibrated.final_position < 1e-9 < 1e-4 < shown.theoretical.final_position
    assert shown.fused.final_position < 0.05
    assert len(messages_of(tmp_path / "run.mcap")["/base/joint_states"]) == shown.report.sent["joint_states"]


def test_a_replay_counts_every_turn_by_which_the_odometry_is_off(tmp_path: Path) -> None:
    design = DIFFERENTIAL.inverse_kinematic_matrix
    using = steered_calibration(DIFFERENTIAL, matrix=matrix_rows(design * [[1.0], [1.0], [0.4]]))
    times, rates = PERIOD * np.arange(1, 401), np.tile([-6.0, 6.0], (400, 1))
    log = WheelLog(times, rates, np.zeros(3), np.append(0.0, times[9::10]))
    poses = using.model.poses([log])[0]
    run = Trajectory("turn", "train", times, rates, log.stamps, poses)
    made = config(tmp_path, using, replay={"speed": "max", "slam": {"period": 0.1, "delay": 0.0}})
    shown = demonstrate(made, Recording(Dataset("turns", using.robot, PERIOD, (run,))))
    headings = np.append(0.0, times * (design[2] @ rates[0]))
    assert poses[-1, 2] > np.pi
    assert 0.6 * headings[-1] > np.pi
    assert shown.theoretical.heading == pytest.approx(float(np.sqrt(np.mean((0.6 * headings) ** 2))), rel=1e-6)
    assert shown.calibrated.heading < 1e-9
    assert shown.batch_difference < 1e-9
    assert shown.fused.heading < 0.05


def test_a_recording_of_a_robot_that_steers_otherwise_is_refused(tmp_path: Path) -> None:
    fixed = SWERVE.model_copy(update={"wheels": SWERVE.wheels[:2]})
    with pytest.raises(DataError, match="'base' has fl, fr"):
        demonstrate(config(tmp_path, steered_calibration()), recording(using=steered_calibration(fixed)))
