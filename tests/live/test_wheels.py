"""Wheel messages and steering angles of real senders: late, twice, missing, wrapped, by a clock that jumps."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drives import ORIGIN, PERIOD, SECOND, Drive, drive
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import CAR, DIFFERENTIAL, TRICYCLE
from steered import SWERVE, only, steered_drive

from omnibench.errors import ConfigError
from omnibench.live.health import Counts
from omnibench.live.wheels import WheelSettings, WheelState, WheelStep, admit, decode, joints_of, unwrap
from omnibench.live.wire import JointState
from omnibench.robot.kinematics import Robot
from omnibench.testing import synthetic_robot

NAMES = ("a", "b", "c")


def steps_of(message: JointState, arrival: float, state: WheelState, skipped: int = 0) -> list[WheelStep]:
    reading = decode(message, arrival, state, skipped)
    return [] if reading is None else admit(reading, state)


class Receiver:
    """The wheel input of a robot, fed with messages, by default as soon as they are stamped."""

    def __init__(self, robot: Robot | None = None, **settings: object) -> None:
        self.counts = Counts()
        chosen = WheelSettings.model_validate(settings)
        self.input = WheelState(robot or synthetic_robot(), chosen, PERIOD, self.counts)
        self.steps: list[WheelStep] = []

    def take(
        self, *messages: JointState, arrivals: list[float] | None = None, skipped: list[int] | None = None
    ) -> list[WheelStep]:
        made: list[WheelStep] = []
        for index, message in enumerate(messages):
            arrival = (message.stamp - ORIGIN) / SECOND if arrivals is None else arrivals[index]
            made += steps_of(message, arrival, self.input, 0 if skipped is None else skipped[index])
        self.steps += made
        return made

    @property
    def driven(self) -> np.ndarray:
        return np.sum([step.angles for step in self.steps], axis=0)


@pytest.fixture
def receiver() -> Receiver:
    return Receiver()


def at(time: float, *values: float, rates: bool = False) -> JointState:
    """A message ``time`` s after the origin, with wheel angles or rates."""
    stamp = ORIGIN + round(time * SECOND)
    array = np.array(values)
    return JointState(stamp, NAMES, None, array) if rates else JointState(stamp, NAMES, array, None)


def whole(path: Drive) -> np.ndarray:
    return path.angles[-1] - path.angles[0]


@given(st.data())
def test_angles_hold_the_whole_motion_whatever_is_lost_or_comes_twice_or_in_another_order(data: st.DataObject) -> None:
    path = drive(0.5)
    messages = path.samples()
    kept = [messages[0]]
    for message in messages[1:-1]:
        kept += [message] * data.draw(st.sampled_from([0, 1, 1, 1, 2]))
    kept.append(messages[-1])
    for place in data.draw(st.lists(st.integers(1, max(1, len(kept) - 3)), max_size=5)):
        kept[place], kept[place + 1] = kept[place + 1], kept[place]
    receiver = Receiver()
    receiver.take(*kept)
    np.testing.assert_allclose(receiver.driven, whole(path), atol=1e-12)
    stamps = [step.stamp for step in receiver.steps]
    assert stamps == sorted(set(stamps))


def test_a_duplicate_and_a_late_sample_make_no_step(receiver: Receiver) -> None:
    receiver.take(at(0, 0, 0, 0), at(0.01, 1, 1, 1), at(0.03, 3, 3, 3))
    assert receiver.take(at(0.03, 3, 3, 3)) == []
    assert receiver.take(at(0.02, 2, 2, 2)) == []
    assert (receiver.counts.duplicates, receiver.counts.late) == (1, 1)


@pytest.mark.parametrize(
    ("low", "length", "settings"), [(-math.pi, 2 * math.pi, {}), (0.0, 2 * math.pi, {}), (0.0, 1.7, {"wrap": 1.7})]
)
def test_angles_within_a_turn_or_a_length_are_unwrapped(low: float, length: float, settings: dict[str, float]) -> None:
    path, receiver = drive(8.0), Receiver(**settings)
    for sample in path.samples():
        receiver.take(JointState(sample.stamp, NAMES, (sample.positions - low) % length + low, None))
    np.testing.assert_allclose(receiver.driven, whole(path), atol=1e-9)
    assert receiver.counts.wraps > 0
    assert receiver.counts.counter_restarts == 0


@pytest.mark.parametrize("every", [2, 200])
def test_messages_that_arrive_at_once_add_no_turns_and_are_not_missing(every: int) -> None:
    """Every second, or rarely one, waits for the next, and the times of arrival count."""
    receiver = Receiver(stamps="arrival")
    numbers = np.arange(1500)
    arrivals = (numbers + (numbers % every == every - 2)) * PERIOD - (numbers % every == every - 2) * 5e-5
    for number, arrival in zip(numbers.tolist(), arrivals.tolist(), strict=True):
        receiver.take(at(arrival, *[math.remainder(10.0 * number * PERIOD, 2 * math.pi)] * 3))
    np.testing.assert_allclose(receiver.driven, 10.0 * numbers[-1] * PERIOD, atol=1e-6)
    assert receiver.counts.missing == receiver.counts.counter_restarts == 0


def test_a_counter_that_starts_again_costs_one_sample_at_the_rate_before(receiver: Receiver) -> None:
    receiver.take(*[at(PERIOD * k, 500 + 0.02 * k, 0.02 * k, 0.02 * k) for k in range(10)])
    (step,) = receiver.take(at(0.1, 0.0, 0.2, 0.2))
    np.testing.assert_allclose(step.angles, [0.02, 0.02, 0.02], atol=1e-9)
    assert receiver.counts.counter_restarts == 1
    assert step.blind == pytest.approx(0.01)
    (after,) = receiver.take(at(0.11, 0.02, 0.22, 0.22))
    np.testing.assert_allclose(after.angles, [0.02, 0.02, 0.02], atol=1e-9)
    assert after.blind == 0


def both(time: float, angle: float, rate: float) -> JointState:
    """A message with the same angle and rate of all wheels."""
    return JointState(ORIGIN + round(time * SECOND), NAMES, np.full(3, angle), np.full(3, rate))


@pytest.mark.parametrize(
    ("messages", "driven"),
    [
        ([(0, 9, True), (0.01, 1, True), (0.04, 1, True)], 0.04),
        ([*((PERIOD * k, 2.0, True) for k in range(10)), *((PERIOD * k, 77 + 0.02 * k) for k in range(10, 20))], 0.38),
        (
            [
                *((PERIOD * k, 0.02 * k) for k in range(10)),
                (0.1, 2.0, True),
                *((PERIOD * k, 0.02 * k) for k in range(11, 20)),
            ],
            0.38,
        ),
        ([(0, 1, True), (0.01, 1, True), both(0.02, 99.0, 1.0)], 0.02),
        ([(0, 500.0), (0.01, 500.0), (0.02, 500.0), both(0.03, 0.0, 2.0)], 0.02),
    ],
    ids=["rates over the time", "rates and then angles", "rates between angles", "rates first", "a restarted counter"],
)
def test_angles_and_rates_of_one_sender_make_one_motion(messages: list[Any], driven: float, receiver: Receiver) -> None:
    for message in messages:
        receiver.take(
            message if isinstance(message, JointState) else at(message[0], *[message[1]] * 3, rates=len(message) > 2)
        )
    np.testing.assert_allclose(receiver.driven, driven, atol=1e-9)
    assert receiver.counts.wrong_joints == 0


@pytest.mark.parametrize("jump", [-3600.0, -5.0, 5.0, 86400.0])
def test_a_clock_that_jumps_is_followed_after_three_samples_without_loss(jump: float, receiver: Receiver) -> None:
    receiver.take(*[at(PERIOD * k, k * 0.02, k * 0.01, 0) for k in range(10)])
    after = range(10, 20)
    made = receiver.take(
        *[at(PERIOD * k + jump, k * 0.02, k * 0.01, 0) for k in after], arrivals=[PERIOD * k for k in after]
    )
    assert len(made) == 10
    assert [step.restarted for step in made] == [True] + [False] * 9
    assert receiver.counts.clock_jumps == 1
    np.testing.assert_allclose(receiver.driven, [0.38, 0.19, 0], atol=1e-12)


@pytest.mark.parametrize("jump", [-3600.0, 3600.0])
def test_one_stamp_far_away_is_not_believed(jump: float, receiver: Receiver) -> None:
    receiver.take(at(0, 0, 0, 0), at(0.01, 0.1, 0, 0))
    assert receiver.take(at(0.02 + jump, 0.2, 0, 0), arrivals=[0.02]) == []
    (step,) = receiver.take(at(0.03, 0.3, 0, 0))
    assert step.duration == pytest.approx(0.02)
    assert receiver.counts.clock_jumps == 0
    assert receiver.counts.late + receiver.counts.bad_stamps == 1


def test_a_long_silence_is_a_gap_and_its_path_is_unknown(receiver: Receiver) -> None:
    receiver.take(*[at(PERIOD * k, 100 + 0.02 * k, 100, 100) for k in range(10)])
    made = receiver.take(*[at(5 + PERIOD * k, 103 + 0.02 * k, 100, 100) for k in range(5)])
    assert receiver.counts.gaps == 1
    assert made[0].blind == pytest.approx(5 - 0.09)
    assert made[0].counted
    assert not made[0].restarted
    np.testing.assert_allclose(receiver.driven, [3.08, 0, 0])


@pytest.mark.parametrize("settings", [{}, {"wrap": 2.0}])
def test_whole_turns_may_be_lost_in_a_silence_of_counters_that_wrap(settings: dict[str, float]) -> None:
    receiver = Receiver(**settings)
    receiver.take(*[at(PERIOD * k, 0.02 * k, 0, 0) for k in range(10)])
    (step,) = receiver.take(at(10, 0.5, 0, 0))
    assert not step.counted
    assert step.blind > 9


@pytest.mark.parametrize("silence", [0.5, 10.0, 36000.0])
def test_a_counter_that_begins_at_zero_again_after_a_silence_is_no_motion(silence: float, receiver: Receiver) -> None:
    """A controller that was switched off and on again."""
    receiver.take(*[at(PERIOD * k, 5000 + 0.02 * k, 4200.0, 3900.0) for k in range(10)])
    receiver.take(at(silence, 0.0, 0.0, 0.0))
    assert np.abs(receiver.driven).max() < 0.18 + 2.1 * 0.5
    assert receiver.counts.counter_restarts == 1
    assert not receiver.steps[-1].counted


def test_a_restarted_counter_is_found_out_by_a_node_that_was_itself_restarted(receiver: Receiver) -> None:
    receiver.input.resume(ORIGIN - 36_000 * SECOND, [5000.0, 4200.0, 3900.0], arrival=-36_000.0)
    (step,) = receiver.take(at(0, 0.1, 0.0, 0.2))
    assert step.angles.tolist() == [0, 0, 0]
    assert receiver.counts.counter_restarts == 1


@given(st.floats(-6.0, 6.0), st.floats(0.02, 0.9), st.booleans(), st.floats(-3.0, 3.0))
def test_lost_samples_do_not_lose_turns_at_a_steady_rate(rate: float, lost: float, wraps: bool, begin: float) -> None:
    receiver = Receiver()
    times = [*np.arange(0, 0.5, 0.01), 0.5 + lost]
    for time in times:
        angle = begin + rate * time
        receiver.take(at(float(time), *[(angle + math.pi) % (2 * math.pi) - math.pi if wraps else angle] * 3))
    np.testing.assert_allclose(receiver.driven, rate * times[-1], atol=1e-6)


@pytest.mark.parametrize("use", ["positions", "auto"])
def test_a_state_without_angles_is_no_obstacle_to_a_sender_of_angles(use: str) -> None:
    receiver = Receiver(use=use)
    receiver.input.resume(ORIGIN - SECOND // 100, None, arrival=-0.01)
    made = receiver.take(*[at(PERIOD * k, 0.02 * k, 0, 0) for k in range(10)])
    assert len(made) == 10


@pytest.mark.parametrize("jump", [-0.5, -0.19, -0.15, 0.3, 0.9])
@pytest.mark.parametrize("rates", [True, False])
def test_a_clock_that_is_set_by_less_than_a_second_neither_adds_nor_loses_motion(jump: float, rates: bool) -> None:
    receiver = Receiver()
    values = [(2.0, 1.0, 0.0) if rates else (100 + 0.02 * k, 0.01 * k, 0.0) for k in range(200)]
    receiver.take(*[at(PERIOD * k, *values[k], rates=rates) for k in range(100)])
    late = range(100, 200)
    receiver.take(*[at(PERIOD * k + jump, *values[k], rates=rates) for k in late], arrivals=[PERIOD * k for k in late])
    np.testing.assert_allclose(receiver.driven, [3.98, 1.99, 0], atol=0.25 if rates else 1e-9)
    assert receiver.counts.clock_jumps == 1
    unsure = rates and jump > -0.2  # a clock that goes back by more is no other explanation's
    assert (max(step.blind for step in receiver.steps) > 0.1) == unsure


@pytest.mark.parametrize("begin", [1, 100])
def test_samples_lost_after_a_late_one_are_missing_and_no_way_is_lost_with_them(begin: int, receiver: Receiver) -> None:
    lost = range(begin + 1, begin + 20)
    times = [PERIOD * k for k in range(200) if k not in lost]
    arrivals = [time + 0.15 * (time == PERIOD * begin) for time in times]
    receiver.take(*[at(time, 2.0, 1.0, 0.0, rates=True) for time in times], arrivals=arrivals)
    np.testing.assert_allclose(receiver.driven, [3.98, 1.99, 0], atol=1e-9)
    assert receiver.counts.clock_jumps == 0
    assert receiver.counts.missing == (19 if begin == 100 else 0)  # the period is not known before
    blind = [step.blind for step in receiver.steps if step.blind]
    assert blind == pytest.approx([0.19])


@pytest.mark.parametrize(("period", "learnt"), [(0.1, 0.1), (1.2, PERIOD)])  # shorter and longer than a gap
def test_the_period_is_learnt_from_the_sender(period: float, learnt: float) -> None:
    receiver = Receiver(max_gap=1.0)  # told of 100 Hz
    made = receiver.take(*[at(period * k, 100 + 0.1 * k, 100, 100) for k in range(50)])
    assert len(made) == 50
    assert receiver.counts.missing == 0
    assert receiver.input.period == pytest.approx(learnt)


def test_a_replay_at_ten_times_the_speed_may_have_gaps(receiver: Receiver) -> None:
    times = [*np.arange(0, 10, 0.01), *np.arange(15, 17, 0.01)]
    receiver.take(*[at(float(t), 100 + 0.5 * float(t), 100, 100) for t in times], arrivals=[t / 10 for t in times])
    assert receiver.counts.clock_jumps == 0
    assert receiver.counts.gaps == 1


def test_a_rate_says_nothing_of_a_long_silence_before_it(receiver: Receiver) -> None:
    receiver.take(*[at(PERIOD * k, 1, 1, 1, rates=True) for k in range(10)])
    made = receiver.take(*[at(5 + PERIOD * k, 1, 1, 1, rates=True) for k in range(3)])
    np.testing.assert_allclose(made[0].angles, PERIOD * np.ones(3), rtol=0.01)
    assert not made[0].counted


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("rates", [True, False])
def test_what_is_not_finite_is_refused_and_the_next_goes_on(value: float, rates: bool, receiver: Receiver) -> None:
    receiver.take(at(0, 0, 0, 0, rates=rates), at(0.01, 0.01, 0, 0, rates=rates))
    assert receiver.take(at(0.02, 0.02, value, 0, rates=rates)) == []
    assert receiver.counts.not_finite == 1
    assert len(receiver.take(at(0.03, 0.03, 0, 0, rates=rates))) == 1


@pytest.mark.parametrize("settings", [{}, {"wrap": 2.0}])
def test_a_counter_that_no_saved_state_could_hold_is_refused(settings: dict[str, float]) -> None:
    receiver = Receiver(**settings)
    receiver.take(at(0, 0, 0, 0), at(0.01, 1e308, 0, 0), at(0.02, -1e308, 0, 0), at(0.03, 0.1, 0, 0))
    assert receiver.driven.tolist() == [0.1, 0, 0]
    assert receiver.counts.not_finite == 2


def test_a_rate_beyond_the_limit_is_refused_with_both_told() -> None:
    receiver = Receiver(max_rate=20)
    receiver.take(at(0, 0, 0, 0, rates=True))
    assert receiver.take(at(0.01, 0, 1e6, 0, rates=True)) == []
    assert receiver.counts.too_fast == 1
    assert "max_rate 20" in receiver.input.refusal


def test_joints_are_found_by_name_in_any_order_and_among_others_and_a_missing_one_is_named() -> None:
    receiver = Receiver(joints=["left", "back", "right"])
    names = ("arm", "right", "left", "back")
    for time, values in ((0.0, [9.0, 0.0, 0.0, 0.0]), (0.01, [8.0, 3.0, 1.0, 2.0])):
        receiver.take(JointState(ORIGIN + round(time * SECOND), names, np.array(values) * 0.1, None))
    np.testing.assert_allclose(receiver.driven, [0.1, 0.2, 0.3])
    assert receiver.take(at(0.02, 0, 0, 0)) == []
    assert receiver.input.refusal == "no joint 'left' among a, b, c; set wheels.joints"


def test_irregular_periods_are_taken_as_they_are_stamped(receiver: Receiver) -> None:
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.002, 0.05, 100))
    receiver.take(*[at(float(t), 0.5 * float(t), 0, 0) for t in times])
    for step in receiver.steps[1:]:
        assert step.angles[0] / step.duration == pytest.approx(0.5, rel=1e-5)
    assert receiver.counts.irregular > 20


@pytest.mark.parametrize("share", [0.02, 0.5])
def test_missing_samples_are_all_counted_however_many_they_are_and_none_is_irregular(
    share: float, receiver: Receiver
) -> None:
    rng = np.random.default_rng(1)
    kept = [0, *(k for k in range(1, 2999) if k < 20 or rng.random() > share), 2999]
    first, *_ = receiver.take(*(at(k * PERIOD, 5.0 + 0.01 * k, 0.0, 0.0) for k in kept))
    assert (first.angles.tolist(), first.duration) == ([0, 0, 0], 0)  # counting begins there
    assert (receiver.counts.missing, receiver.counts.irregular) == (3000 - len(kept), 0)


def test_a_robot_that_sends_more_rarely_from_now_on_misses_nothing_after_a_while(receiver: Receiver) -> None:
    times = [*(k * PERIOD for k in range(200)), *(2.0 + 2 * k * PERIOD for k in range(400))]
    receiver.take(*(at(time, time, 0.0, 0.0) for time in times))
    assert receiver.counts.missing <= 50
    assert receiver.input.period == pytest.approx(2 * PERIOD)


def test_of_a_link_that_loses_every_second_sample_all_are_counted_where_they_are_numbered() -> None:
    receiver, kept = Receiver(), range(0, 1000, 2)
    receiver.take(*(at(k * PERIOD, 0.01 * k, 0.0, 0.0) for k in kept), skipped=[0, *[1] * (len(kept) - 1)])
    assert receiver.counts.missing == len(kept) - 1
    assert receiver.input.period == pytest.approx(PERIOD)


def test_numbered_samples_that_are_lost_from_a_burst_are_missing_and_no_clock_has_jumped(receiver: Receiver) -> None:
    kept = [*range(100), *range(150, 200)]
    arrivals = [PERIOD * min(k, 100) for k in kept]  # the link stood still, and then delivered all at once
    receiver.take(
        *(at(PERIOD * k, 0.01 * k, 0.0, 0.0) for k in kept),
        arrivals=arrivals,
        skipped=[50 if k == 150 else 0 for k in kept],
    )
    assert (receiver.counts.missing, receiver.counts.clock_jumps) == (50, 0)
    assert receiver.driven[0] == pytest.approx(1.99)


@pytest.mark.parametrize(("turned", "believed"), [(2.0, True), (4.0, False)])
def test_a_slow_robot_may_have_turned_its_wheels_by_half_a_turn_in_a_silence(turned: float, believed: bool) -> None:
    """At 0.1 rad/s so far, 1 s may hold 1.5 x 0.1 rad and half a turn to get going; more is a counter set anew."""
    counts = Counts()
    state = WheelState(DIFFERENTIAL, WheelSettings(max_rate=50.0), PERIOD, counts)
    state.count_from([20.0, 30.0])
    unwrap([20.05, 30.05], [0.05, 0.05], 0.5, state)
    unseen, whole = unwrap([20.05 + turned, 30.05 + turned], None, 1.0, state)
    assert unseen == pytest.approx([turned * believed] * 2)
    assert (whole, counts.counter_restarts) == (believed, int(not believed))


def at_joints(time: float, **joints: float) -> JointState:
    """A message ``time`` s after the origin with positions of joints, rad."""
    return JointState(ORIGIN + round(time * SECOND), tuple(joints), np.array(list(joints.values())))


def steering(steps: list[WheelStep]) -> list[float]:
    """Of each step the first steering angle at_joints its end."""
    return [float(step.steering[0]) for step in steps if step.steering is not None]


@pytest.mark.parametrize(
    ("first", "reason"),
    [
        (at_joints(0.0, front=1.0), "no joint 'front_steering' among front; set wheels.steering_joints"),
        (at_joints(0.0, front=1.0, front_steering=math.nan), "joint 'front_steering' tells no position"),
        (JointState(ORIGIN, ("front", "front_steering"), None, np.ones(2)), "'front_steering' tells no position"),
    ],
)
def test_samples_before_the_first_steering_angle_are_refused_with_the_reason(first: JointState, reason: str) -> None:
    receiver = Receiver(TRICYCLE)
    assert receiver.take(first) == []
    assert receiver.counts.no_steering == 1
    assert receiver.input.refusal.startswith("no steering angle yet: ")
    assert receiver.input.refusal.endswith(reason)
    assert len(receiver.take(at_joints(0.01, front=1.0, front_steering=0.1))) == 1


def test_a_sample_steers_as_the_newest_angle_says_which_may_come_in_messages_of_its_own() -> None:
    receiver = Receiver(TRICYCLE)
    assert receiver.take(at_joints(0.0, front_steering=0.3)) == []
    steps = receiver.take(
        at_joints(0.005, front=0.0),
        at_joints(0.015, front=0.1),
        at_joints(0.02, front_steering=0.4),
        at_joints(0.025, front=0.2),
    )
    assert steering(steps) == [0.3, 0.3, 0.4]
    assert receiver.counts.anomalies() == {}
    steps = receiver.take(at_joints(0.03, front=0.3, front_steering=0.1), at_joints(0.06, front_steering=0.5))
    receiver.take(at_joints(0.05, front_steering=0.2))  # older than the one that is known
    assert steering([*steps, *receiver.take(at_joints(0.07, front=0.4))]) == [0.1, 0.5]


@given(st.lists(st.sets(st.sampled_from(["fl", "fr", "rl", "rr"])), min_size=20, max_size=20))
def test_angles_are_those_of_whole_messages_however_the_joints_are_spread_over_several(apart: list[set[str]]) -> None:
    whole, spread = Receiver(SWERVE), Receiver(SWERVE)
    for sample, wheels in zip(steered_drive(0.19).samples(), apart, strict=True):
        own = tuple(f"{wheel}_steering" for wheel in wheels)
        beside = [name for name in sample.names if name not in own]
        (expected,) = whole.take(sample)
        (step,) = spread.take(*(only(sample, name) for name in own), only(sample, *beside))
        np.testing.assert_array_equal(step.steering, expected.steering)
        np.testing.assert_array_equal(step.angles, expected.angles)


@pytest.mark.parametrize("jump", [-3600.0, 3600.0])
def test_steering_is_followed_over_a_jump_of_the_clock(jump: float) -> None:
    receiver = Receiver(TRICYCLE)
    receiver.take(at_joints(0.0, front=0.0, front_steering=0.1))
    steps = [
        step
        for k in range(1, 6)
        for step in steps_of(
            at_joints(PERIOD * k + jump, front=0.02 * k, front_steering=0.1 + 0.01 * k), PERIOD * k, receiver.input
        )
    ]
    np.testing.assert_allclose(steering(steps), [0.11, 0.12, 0.13, 0.14, 0.15])
    assert receiver.counts.old_steering == 0


def test_an_angle_that_misses_for_long_is_held_and_said_and_makes_the_path_unknown() -> None:
    receiver = Receiver(TRICYCLE, max_steering_age=0.2)
    receiver.take(at_joints(0.0, front=0.0, front_steering=0.1))
    steps = receiver.take(*(at_joints(PERIOD * k, front=0.02 * k) for k in range(1, 31)))
    assert steering(steps) == [0.1] * 30
    assert [bool(step.blind) for step in steps] == [False] * 20 + [True] * 10
    assert receiver.counts.old_steering == 10
    assert receiver.input.old_steering == pytest.approx(0.3)
    (again,) = receiver.take(at_joints(0.31, front=0.62, front_steering=0.5))
    assert (again.blind, receiver.input.old_steering) == (0.0, 0.0)
    several = Receiver(SWERVE)
    first, *others = steered_drive(0.5).samples()
    several.take(first, *(only(each, "fl", "fr", "rl", "rr", "fl_steering", "rr_steering") for each in others))
    assert several.counts.old_steering == 30


@pytest.mark.parametrize(("behind", "old"), [(1, 0), (10, 0), (30, 30)])
def test_steering_behind_its_wheel_samples_counts_for_the_next_until_too_old(behind: int, old: int) -> None:
    """Messages of the steering that wait in a loaded network; every angle tells the number of its sample."""
    receiver = Receiver(TRICYCLE, max_steering_age=0.2)
    receiver.take(at_joints(0.0, front=0.0, front_steering=0.0))
    steps = []
    for k in range(1, 51):
        now = PERIOD * k
        steps += steps_of(at_joints(now, front=0.02 * k), now, receiver.input)
        if k >= behind:
            steps_of(at_joints(PERIOD * (k - behind), front_steering=1e-3 * (k - behind)), now, receiver.input)
    np.testing.assert_allclose(steering(steps), [1e-3 * max(0, k - 1 - behind) for k in range(1, 51)], atol=1e-12)
    assert sum(bool(step.blind) for step in steps) == receiver.counts.old_steering == old
    assert receiver.counts.late == 0


def test_an_angle_that_wraps_at_a_turn_goes_on_the_shorter_way() -> None:
    angles = np.linspace(2.0, 9.0, 100)
    receiver = Receiver(TRICYCLE)
    wrapped = (angles + math.pi) % (2 * math.pi) - math.pi
    steps = receiver.take(*(at_joints(PERIOD * k, front=0.0, front_steering=angle) for k, angle in enumerate(wrapped)))
    np.testing.assert_allclose(steering(steps), angles, atol=1e-12)


@pytest.mark.parametrize("angle", [30.0, -1.6])
def test_a_car_that_steers_in_degrees_is_told(angle: float) -> None:
    receiver, rear = Receiver(CAR), {"left": 0.0, "right": 0.0}
    assert receiver.take(at_joints(0.0, **rear, front_left_steering=angle, front_right_steering=0.1)) == []
    assert f"'front_left_steering' says {angle:g} rad" in receiver.input.refusal
    assert "degrees" in receiver.input.refusal
    steps = receiver.take(at_joints(0.01, **rear, front_left_steering=0.1, front_right_steering=0.1))
    steps += receiver.take(at_joints(0.02, **rear, front_left_steering=angle, front_right_steering=0.2))
    assert [step.steering.tolist() for step in steps if step.steering is not None] == [[0.1, 0.1], [0.1, 0.2]]
    assert receiver.counts.bad_steering == 2


def test_an_angle_that_no_wheel_reaches_one_wheel_without_an_angle_and_other_joints_are_refused() -> None:
    receiver, swerve, sample = Receiver(TRICYCLE), Receiver(SWERVE), steered_drive(0.1).samples()[0]
    assert receiver.take(at_joints(0.0, front=0.0, front_steering=-1e308)) == []
    receiver.take(at_joints(0.01, front=0.0, front_steering=0.1), at_joints(0.02, front=0.0, front_steering=1e308))
    assert receiver.counts.bad_steering == 2
    assert receiver.take(at_joints(0.03, shoulder=1.0, elbow=2.0)) == []
    assert "'front' among shoulder, elbow" in receiver.input.refusal
    assert swerve.take(replace(sample, positions=np.where(np.arange(8) == 1, np.nan, sample.positions))) == []
    assert swerve.counts.not_finite == 1


def test_what_ros2_control_does_not_tell_is_nan_and_is_not_taken_for_a_reading() -> None:
    """Wheels with a velocity interface alone, steering joints with a position alone, in one message."""
    receiver, path = Receiver(SWERVE), steered_drive(0.3)
    for sample in path.samples():
        positions = np.where([name.endswith("_steering") for name in sample.names], sample.positions, np.nan)
        (step,) = receiver.take(replace(sample, positions=positions))
        assert step.positions is None
    assert receiver.counts.anomalies() == {}
    np.testing.assert_allclose(step.angles, path.angles[-1] - path.angles[-2], atol=1e-12)


def test_joints_are_called_like_the_wheels_unless_they_are_named() -> None:
    assert joints_of(TRICYCLE).names == ("front", "front_steering")
    assert joints_of(CAR).names == ("left", "right", "front_left_steering", "front_right_steering")
    named = WheelSettings(joints=("traction",), steering_joints=("fork",))
    assert joints_of(TRICYCLE, named).names == ("traction", "fork")
    steps = Receiver(TRICYCLE, joints=["traction"], steering_joints=["fork"]).take(
        at_joints(0.0, traction=0.0, fork=0.2)
    )
    assert steering(steps) == [0.2]


@pytest.mark.parametrize(
    ("robot", "joints", "named"),
    [
        (SWERVE, ("a", "b"), "a, b"),
        (TRICYCLE, ("front",), "front"),
        (TRICYCLE, (), "none"),
        (synthetic_robot(), ("a",), "no wheel steers"),
    ],
)
def test_steering_joints_other_than_one_a_wheel_are_refused(robot: Robot, joints: tuple[str, ...], named: str) -> None:
    with pytest.raises(ConfigError, match=rf"wheels\.steering_joints: .*{named}"):
        joints_of(robot, WheelSettings(steering_joints=joints))
