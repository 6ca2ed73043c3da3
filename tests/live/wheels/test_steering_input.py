"""Steering angles as real senders send them: beside the wheels or alone, late, missing, wrapped, as NaN."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from drives import ORIGIN, PERIOD, SECOND
from hypothesis import given
from hypothesis import strategies as st
from steered import CAR, SWERVE, TRICYCLE, calibration, drive, only

from omnibench.errors import ConfigError
from omnibench.live.estimation.robot_state import new_state
from omnibench.live.wheels.wheel_input import WheelSettings, WheelStep, joints_of
from omnibench.live.wire.messages import JointState
from omnibench.robot.kinematics import Robot
from omnibench.testing import synthetic_robot


class Receiver:
    """The wheel input of a robot, fed with messages as soon as they are stamped."""

    def __init__(self, robot: Robot = TRICYCLE, **settings: object) -> None:
        state = new_state("robot", calibration(robot), WheelSettings.model_validate(settings), None)
        self.counts, self.input = state.counts, state.wheel_input

    def take(self, *messages: JointState) -> list[WheelStep]:
        return [step for each in messages for step in self.input.take(each, (each.stamp - ORIGIN) / SECOND)]


def at(time: float, **joints: float) -> JointState:
    """A message ``time`` s after the origin with positions of joints, rad."""
    return JointState(ORIGIN + round(time * SECOND), tuple(joints), np.array(list(joints.values())))


def steering(steps: list[WheelStep]) -> list[float]:
    """Of each step the first steering angle at its end."""
    return [float(step.steering[0]) for step in steps if step.steering is not None]


def test_a_sample_steers_as_its_own_message_says_at_its_end() -> None:
    steps = Receiver().take(at(0.0, front=1.0, front_steering=0.1), at(0.01, front=1.1, front_steering=0.2))
    assert steering(steps) == [0.1, 0.2]


@pytest.mark.parametrize(
    ("first", "reason"),
    [
        (at(0.0, front=1.0), "no joint 'front_steering' among front; set wheels.steering_joints"),
        (at(0.0, front=1.0, front_steering=math.nan), "joint 'front_steering' tells no position"),
        (JointState(ORIGIN, ("front", "front_steering"), None, np.ones(2)), "'front_steering' tells no position"),
    ],
)
def test_samples_before_the_first_steering_angle_are_refused_with_the_reason(first: JointState, reason: str) -> None:
    receiver = Receiver()
    assert receiver.take(first) == []
    assert receiver.counts.no_steering == 1
    assert receiver.input.last_refusal.startswith("no steering angle yet: ")
    assert receiver.input.last_refusal.endswith(reason)
    assert len(receiver.take(at(0.01, front=1.0, front_steering=0.1))) == 1


def test_steering_in_messages_of_its_own_makes_no_step_and_is_held_for_the_wheels() -> None:
    receiver = Receiver()
    assert receiver.take(at(0.0, front_steering=0.3)) == []
    steps = receiver.take(
        at(0.005, front=0.0), at(0.015, front=0.1), at(0.02, front_steering=0.4), at(0.025, front=0.2)
    )
    assert steering(steps) == [0.3, 0.3, 0.4]
    assert receiver.counts.anomalies() == {}


@given(st.lists(st.sets(st.sampled_from(["fl", "fr", "rl", "rr"])), min_size=20, max_size=20))
def test_angles_are_those_of_whole_messages_however_the_joints_are_spread_over_several(apart: list[set[str]]) -> None:
    whole, spread = Receiver(SWERVE), Receiver(SWERVE)
    for sample, wheels in zip(drive(0.19).samples(), apart, strict=True):
        own = tuple(f"{wheel}_steering" for wheel in wheels)
        beside = [name for name in sample.names if name not in own]
        (expected,) = whole.take(sample)
        (step,) = spread.take(*(only(sample, name) for name in own), only(sample, *beside))
        assert step.steering is not None
        np.testing.assert_array_equal(step.steering, expected.steering)
        np.testing.assert_array_equal(step.angles, expected.angles)


def test_an_angle_that_is_older_than_the_known_one_is_left_out() -> None:
    receiver = Receiver()
    steps = receiver.take(
        at(0.0, front=0.0, front_steering=0.1), at(0.03, front_steering=0.4), at(0.02, front_steering=0.3)
    )
    assert steering([*steps, *receiver.take(at(0.04, front=0.1))]) == [0.1, 0.4]


@pytest.mark.parametrize("jump", [-3600.0, 3600.0])
def test_steering_is_followed_over_a_jump_of_the_clock(jump: float) -> None:
    receiver = Receiver()
    receiver.take(at(0.0, front=0.0, front_steering=0.1))
    steps = [
        step
        for k in range(1, 6)
        for step in receiver.input.take(
            at(PERIOD * k + jump, front=0.02 * k, front_steering=0.1 + 0.01 * k), PERIOD * k
        )
    ]
    np.testing.assert_allclose(steering(steps), [0.11, 0.12, 0.13, 0.14, 0.15])
    assert receiver.counts.old_steering == 0


def test_an_angle_that_misses_for_long_is_held_and_said_and_makes_the_path_unknown() -> None:
    receiver = Receiver(max_steering_age=0.2)
    receiver.take(at(0.0, front=0.0, front_steering=0.1))
    steps = receiver.take(*(at(PERIOD * k, front=0.02 * k) for k in range(1, 31)))
    assert steering(steps) == [0.1] * 30
    assert [bool(step.blind) for step in steps] == [False] * 20 + [True] * 10
    assert receiver.counts.old_steering == 10
    assert receiver.input.old_steering == pytest.approx(0.3)
    (again,) = receiver.take(at(0.31, front=0.62, front_steering=0.5))
    assert (again.blind, receiver.input.old_steering) == (0.0, 0.0)


@pytest.mark.parametrize(("behind", "old"), [(1, 0), (10, 0), (30, 30)])
def test_steering_that_arrives_behind_its_wheel_samples_counts_for_the_next_and_is_said_when_too_old(
    behind: int, old: int
) -> None:
    """Messages of the steering that wait in a loaded network; every angle tells the number of its sample."""
    receiver = Receiver(max_steering_age=0.2)
    receiver.take(at(0.0, front=0.0, front_steering=0.0))
    steps = []
    for k in range(1, 51):
        now = PERIOD * k
        steps += receiver.input.take(at(now, front=0.02 * k), now)
        if k >= behind:
            receiver.input.take(at(PERIOD * (k - behind), front_steering=1e-3 * (k - behind)), now)
    np.testing.assert_allclose(steering(steps), [1e-3 * max(0, k - 1 - behind) for k in range(1, 51)], atol=1e-12)
    assert sum(bool(step.blind) for step in steps) == receiver.counts.old_steering == old
    assert receiver.counts.late == 0


def test_one_of_several_angles_that_misses_counts_as_old() -> None:
    receiver, path = Receiver(SWERVE), drive(0.5)
    first, *others = path.samples()
    receiver.take(first, *(only(each, "fl", "fr", "rl", "rr", "fl_steering", "rr_steering") for each in others))
    assert receiver.counts.old_steering == 30


def test_an_angle_that_wraps_at_a_turn_goes_on_the_shorter_way() -> None:
    angles = np.linspace(2.0, 9.0, 100)
    receiver = Receiver()
    wrapped = (angles + math.pi) % (2 * math.pi) - math.pi
    steps = receiver.take(*(at(PERIOD * k, front=0.0, front_steering=angle) for k, angle in enumerate(wrapped)))
    np.testing.assert_allclose(steering(steps), angles, atol=1e-12)


@pytest.mark.parametrize("angle", [30.0, -1.6])
def test_a_car_that_steers_in_degrees_is_told(angle: float) -> None:
    receiver = Receiver(CAR)
    rear = {"rear_left": 0.0, "rear_right": 0.0}
    assert receiver.take(at(0.0, **rear, front_left_steering=angle, front_right_steering=0.1)) == []
    reason = f"joint 'front_left_steering' says {angle:g} rad, so far such a wheel does not steer; is it in degrees?"
    assert receiver.input.last_refusal == f"no steering angle yet: {reason}"
    steps = receiver.take(at(0.01, **rear, front_left_steering=0.1, front_right_steering=0.1))
    steps += receiver.take(at(0.02, **rear, front_left_steering=angle, front_right_steering=0.2))
    assert [step.steering.tolist() for step in steps if step.steering is not None] == [[0.1, 0.1], [0.1, 0.2]]
    assert receiver.counts.bad_steering == 2
    assert receiver.input.last_refusal == reason


def test_an_angle_that_no_wheel_reaches_is_refused() -> None:
    receiver = Receiver()
    assert receiver.take(at(0.0, front=0.0, front_steering=-1e308)) == []
    receiver.take(at(0.01, front=0.0, front_steering=0.1), at(0.02, front=0.0, front_steering=1e308))
    assert receiver.counts.bad_steering == 2


def test_what_ros2_control_does_not_tell_is_nan_and_is_not_taken_for_a_reading() -> None:
    """Wheels with a velocity interface alone, steering joints with a position alone, in one message."""
    receiver, path = Receiver(SWERVE), drive(0.3)
    for sample in path.samples():
        assert sample.positions is not None
        positions = np.where([name.endswith("_steering") for name in sample.names], sample.positions, np.nan)
        (step,) = receiver.take(replace(sample, positions=positions))
        assert step.positions is None
    assert receiver.counts.anomalies() == {}
    assert step.steering is not None
    np.testing.assert_allclose(step.angles, path.angles[-1] - path.angles[-2], atol=1e-12)


def test_one_wheel_of_several_that_says_nan_is_refused_as_ever() -> None:
    receiver, sample = Receiver(SWERVE), drive(0.1).samples()[0]
    assert sample.positions is not None
    broken = np.where(np.arange(8) == 1, np.nan, sample.positions)
    assert receiver.take(replace(sample, positions=broken)) == []
    assert receiver.counts.not_finite == 1


def test_messages_of_other_joints_are_refused_as_ever() -> None:
    receiver = Receiver()
    assert receiver.take(at(0.0, shoulder=1.0, elbow=2.0)) == []
    assert receiver.input.last_refusal == "no joint 'front' among shoulder, elbow; set wheels.joints"


def test_joints_are_called_like_the_wheels_unless_they_are_named() -> None:
    assert joints_of(TRICYCLE).names == ("front", "front_steering")
    assert joints_of(CAR).names == (
        *("rear_left", "rear_right"),
        *("front_left_steering", "front_right_steering"),
    )
    named = WheelSettings(joints=("traction",), steering_joints=("fork",))
    assert joints_of(TRICYCLE, named).names == ("traction", "fork")
    steps = Receiver(TRICYCLE, joints=["traction"], steering_joints=["fork"]).take(at(0.0, traction=0.0, fork=0.2))
    assert steering(steps) == [0.2]


@pytest.mark.parametrize(
    ("robot", "settings", "message"),
    [
        (
            SWERVE,
            {"steering_joints": ("a", "b")},
            "wheels.steering_joints: a, b; .* each of the steered wheels fl, fr, rl",
        ),
        (TRICYCLE, {"steering_joints": ("front",)}, "wheels.steering_joints: front is the joint of a wheel, too"),
        (TRICYCLE, {"steering_joints": ()}, "wheels.steering_joints: none; name one joint"),
    ],
)
def test_steering_joints_that_are_not_one_for_each_wheel_are_refused(
    robot: Robot, settings: dict[str, tuple[str, ...]], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        joints_of(robot, WheelSettings.model_validate(settings))


def test_steering_joints_of_a_robot_that_does_not_steer_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"wheels\.steering_joints: a; no wheel steers"):
        joints_of(synthetic_robot(), WheelSettings(steering_joints=("a",)))
