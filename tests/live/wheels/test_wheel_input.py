"""Wheel messages as real senders send them: late, twice, missing, wrapped, restarted, by a clock that jumps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from drives import ORIGIN, PERIOD, SECOND, Drive, drive
from hypothesis import given
from hypothesis import strategies as st

from omnibench.live.estimation.counts import Counts
from omnibench.live.wheels.wheel_input import WheelInput, WheelSettings, WheelStep
from omnibench.live.wire.messages import JointState

NAMES = ("a", "b", "c")


class Receiver:
    """A wheel input that is fed with messages, by default as soon as they are stamped."""

    def __init__(self, **settings: object) -> None:
        self.counts = Counts()
        self.input = WheelInput(NAMES, WheelSettings.model_validate(settings), PERIOD, self.counts)
        self.steps: list[WheelStep] = []

    def take(
        self, *messages: JointState, arrivals: list[float] | None = None, skipped: list[int] | None = None
    ) -> list[WheelStep]:
        made: list[WheelStep] = []
        for index, message in enumerate(messages):
            arrival = (message.stamp - ORIGIN) / SECOND if arrivals is None else arrivals[index]
            made += self.input.take(message, arrival, 0 if skipped is None else skipped[index])
        self.steps += made
        return made

    @property
    def driven(self) -> np.ndarray:
        return np.sum([step.angles for step in self.steps], axis=0)


def at(time: float, *values: float, rates: bool = False) -> JointState:
    """A message ``time`` s after the origin, with wheel angles or rates."""
    stamp = ORIGIN + round(time * SECOND)
    array = np.array(values)
    return JointState(stamp, NAMES, None, array) if rates else JointState(stamp, NAMES, array, None)


def whole(path: Drive) -> np.ndarray:
    return path.angles[-1] - path.angles[0]


def test_the_first_message_says_where_counting_begins() -> None:
    (step,) = Receiver().take(at(0, 5.0, 6.0, 7.0))
    assert step.angles.tolist() == [0, 0, 0]
    assert step.duration == 0


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


def test_a_sample_that_never_came_is_counted_by_the_stamps_of_the_others() -> None:
    receiver = Receiver()
    receiver.take(*[at(PERIOD * k, k, k, k) for k in range(50) if k not in (20, 31, 32)])
    assert receiver.counts.missing == 3


def test_a_duplicate_and_a_late_sample_make_no_step() -> None:
    receiver = Receiver()
    receiver.take(at(0, 0, 0, 0), at(0.01, 1, 1, 1), at(0.03, 3, 3, 3))
    assert receiver.take(at(0.03, 3, 3, 3)) == []
    assert receiver.take(at(0.02, 2, 2, 2)) == []
    assert (receiver.counts.duplicates, receiver.counts.late) == (1, 1)


@pytest.mark.parametrize("low", [-math.pi, 0.0])
def test_angles_within_one_turn_are_unwrapped_without_being_told(low: float) -> None:
    path = drive(8.0)
    receiver = Receiver()
    for sample in path.samples():
        assert sample.positions is not None
        receiver.take(JointState(sample.stamp, NAMES, (sample.positions - low) % (2 * math.pi) + low, None))
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


def test_a_counter_of_any_length_is_unwrapped_when_the_length_is_told() -> None:
    path, length = drive(3.0), 1.7
    receiver = Receiver(wrap=length)
    for sample in path.samples():
        assert sample.positions is not None
        receiver.take(JointState(sample.stamp, NAMES, sample.positions % length, None))
    np.testing.assert_allclose(receiver.driven, whole(path), atol=1e-9)


def test_a_counter_that_starts_again_costs_one_sample_at_the_rate_before() -> None:
    receiver = Receiver()
    receiver.take(*[at(PERIOD * k, 500 + 0.02 * k, 0.02 * k, 0.02 * k) for k in range(10)])
    (step,) = receiver.take(at(0.1, 0.0, 0.2, 0.2))
    np.testing.assert_allclose(step.angles, [0.02, 0.02, 0.02], atol=1e-9)
    assert receiver.counts.counter_restarts == 1
    assert step.blind == pytest.approx(0.01)
    (after,) = receiver.take(at(0.11, 0.02, 0.22, 0.22))
    np.testing.assert_allclose(after.angles, [0.02, 0.02, 0.02], atol=1e-9)
    assert after.blind == 0


def test_a_restarted_counter_is_bridged_by_the_rate_that_the_message_tells() -> None:
    receiver = Receiver()
    receiver.take(*[at(PERIOD * k, 500.0, 500.0, 500.0) for k in range(3)])
    message = JointState(ORIGIN + round(0.03 * SECOND), NAMES, np.zeros(3), np.array([1.0, 2.0, 3.0]))
    (step,) = receiver.take(message)
    np.testing.assert_allclose(step.angles, [0.01, 0.02, 0.03])


def test_rates_are_taken_over_the_time_since_the_sample_before() -> None:
    receiver = Receiver()
    receiver.take(at(0, 9, 9, 9, rates=True), at(0.01, 1, 2, 3, rates=True), at(0.04, 1, 2, 3, rates=True))
    np.testing.assert_allclose(receiver.driven, [0.04, 0.08, 0.12])


def test_a_sender_that_begins_with_rates_is_read_by_rates() -> None:
    receiver = Receiver()
    receiver.take(at(0, 1, 1, 1, rates=True), at(0.01, 1, 1, 1, rates=True))
    both = JointState(ORIGIN + round(0.02 * SECOND), NAMES, np.array([99.0, 99.0, 99.0]), np.ones(3))
    receiver.take(both)
    np.testing.assert_allclose(receiver.driven, [0.02, 0.02, 0.02])


@pytest.mark.parametrize("jump", [-3600.0, -5.0, 5.0, 86400.0])
def test_a_clock_that_jumps_is_followed_after_three_samples_and_no_motion_is_lost(jump: float) -> None:
    receiver = Receiver()
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
def test_one_stamp_far_away_is_not_believed(jump: float) -> None:
    receiver = Receiver()
    receiver.take(at(0, 0, 0, 0), at(0.01, 0.1, 0, 0))
    assert receiver.take(at(0.02 + jump, 0.2, 0, 0), arrivals=[0.02]) == []
    (step,) = receiver.take(at(0.03, 0.3, 0, 0))
    assert step.duration == pytest.approx(0.02)
    assert receiver.counts.clock_jumps == 0
    assert receiver.counts.late + receiver.counts.bad_stamps == 1


def test_a_long_silence_is_a_gap_and_its_path_is_unknown() -> None:
    receiver = Receiver()
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
def test_a_counter_that_begins_at_zero_again_after_a_silence_is_no_motion(silence: float) -> None:
    """A controller that was switched off and on again."""
    receiver = Receiver()
    receiver.take(*[at(PERIOD * k, 5000 + 0.02 * k, 4200.0, 3900.0) for k in range(10)])
    receiver.take(at(silence, 0.0, 0.0, 0.0))
    assert np.abs(receiver.driven).max() < 0.18 + 2.1 * 0.5
    assert receiver.counts.counter_restarts == 1
    assert not receiver.steps[-1].counted


def test_a_restarted_counter_is_found_out_by_a_node_that_was_itself_restarted() -> None:
    receiver = Receiver()
    receiver.input.resume(ORIGIN - 36_000 * SECOND, np.array([5000.0, 4200.0, 3900.0]), arrival=-36_000.0)
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


def test_a_message_without_angles_among_others_costs_nothing() -> None:
    receiver = Receiver()
    receiver.take(*[at(PERIOD * k, 0.02 * k, 0, 0) for k in range(10)])
    receiver.take(at(0.10, 2.0, 0, 0, rates=True))
    receiver.take(*[at(PERIOD * k, 0.02 * k, 0, 0) for k in range(11, 20)])
    np.testing.assert_allclose(receiver.driven, [0.38, 0, 0], atol=1e-9)
    assert receiver.counts.wrong_joints == 0


def test_a_sender_of_rates_that_turns_to_angles_is_followed() -> None:
    receiver = Receiver()
    receiver.take(*[at(PERIOD * k, 2.0, 0, 0, rates=True) for k in range(10)])
    receiver.take(*[at(PERIOD * k, 77 + 0.02 * k, 0, 0) for k in range(10, 20)])
    np.testing.assert_allclose(receiver.driven, [0.38, 0, 0], atol=1e-9)


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
    after = range(100, 200)
    receiver.take(
        *[at(PERIOD * k + jump, *values[k], rates=rates) for k in after], arrivals=[PERIOD * k for k in after]
    )
    np.testing.assert_allclose(receiver.driven, [3.98, 1.99, 0], atol=0.25 if rates else 1e-9)
    assert receiver.counts.clock_jumps == 1
    unsure = rates and jump > -0.2  # a clock that goes back by more is no other explanation's
    assert (max(step.blind for step in receiver.steps) > 0.1) == unsure


@pytest.mark.parametrize("begin", [1, 100])
def test_samples_lost_after_a_late_one_are_missing_and_no_way_is_lost_with_them(begin: int) -> None:
    lost = range(begin + 1, begin + 20)
    times = [PERIOD * k for k in range(200) if k not in lost]
    arrivals = [time + 0.15 * (time == PERIOD * begin) for time in times]
    receiver = Receiver()
    receiver.take(*[at(time, 2.0, 1.0, 0.0, rates=True) for time in times], arrivals=arrivals)
    np.testing.assert_allclose(receiver.driven, [3.98, 1.99, 0], atol=1e-9)
    assert receiver.counts.clock_jumps == 0
    assert receiver.counts.missing == (19 if begin == 100 else 0)  # the period is not known before
    blind = [step.blind for step in receiver.steps if step.blind]
    assert blind == pytest.approx([0.19])


def test_samples_farther_apart_than_a_gap_are_taken_one_by_one() -> None:
    receiver = Receiver(max_gap=1.0)
    made = receiver.take(*[at(1.2 * k, 100 + 0.5 * k, 100, 100) for k in range(30)])
    assert len(made) == 30


def test_the_period_is_learnt_from_the_sender() -> None:
    receiver = Receiver()  # told of 100 Hz
    receiver.take(*[at(0.1 * k, 0.1 * k, 0, 0) for k in range(50)])
    assert receiver.counts.missing == 0
    assert receiver.input.period == pytest.approx(0.1)


def test_a_replay_at_ten_times_the_speed_may_have_gaps() -> None:
    receiver = Receiver()
    times = [*np.arange(0, 10, 0.01), *np.arange(15, 17, 0.01)]
    receiver.take(*[at(float(t), 100 + 0.5 * float(t), 100, 100) for t in times], arrivals=[t / 10 for t in times])
    assert receiver.counts.clock_jumps == 0
    assert receiver.counts.gaps == 1


def test_a_rate_says_nothing_of_a_long_silence_before_it() -> None:
    receiver = Receiver()
    receiver.take(*[at(PERIOD * k, 1, 1, 1, rates=True) for k in range(10)])
    made = receiver.take(*[at(5 + PERIOD * k, 1, 1, 1, rates=True) for k in range(3)])
    np.testing.assert_allclose(made[0].angles, PERIOD * np.ones(3), rtol=0.01)
    assert not made[0].counted


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("rates", [True, False])
def test_what_is_not_finite_is_refused_and_the_next_sample_goes_on(value: float, rates: bool) -> None:
    receiver = Receiver()
    receiver.take(at(0, 0, 0, 0, rates=rates), at(0.01, 0.01, 0, 0, rates=rates))
    assert receiver.take(at(0.02, 0.02, value, 0, rates=rates)) == []
    assert receiver.counts.not_finite == 1
    assert len(receiver.take(at(0.03, 0.03, 0, 0, rates=rates))) == 1


def test_a_rate_beyond_the_limit_is_refused_with_both_told() -> None:
    receiver = Receiver(max_rate=20)
    receiver.take(at(0, 0, 0, 0, rates=True))
    assert receiver.take(at(0.01, 0, 1e6, 0, rates=True)) == []
    assert receiver.counts.too_fast == 1
    assert "max_rate 20" in receiver.input.last_refusal


def test_joints_are_found_by_name_in_any_order_and_among_others() -> None:
    receiver = Receiver(joints=["left", "back", "right"])
    names = ("arm", "right", "left", "back")
    for time, values in ((0.0, [9.0, 0.0, 0.0, 0.0]), (0.01, [8.0, 3.0, 1.0, 2.0])):
        receiver.take(JointState(ORIGIN + round(time * SECOND), names, np.array(values) * 0.1, None))
    np.testing.assert_allclose(receiver.driven, [0.1, 0.2, 0.3])


def test_a_missing_joint_is_named_with_those_that_are_there() -> None:
    receiver = Receiver(joints=["a", "b", "z"])
    assert receiver.take(at(0, 0, 0, 0)) == []
    assert receiver.input.last_refusal == "no joint 'z' among a, b, c; set wheels.joints"


def test_irregular_periods_are_taken_as_they_are_stamped() -> None:
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.002, 0.05, 100))
    receiver = Receiver()
    receiver.take(*[at(float(t), 0.5 * float(t), 0, 0) for t in times])
    for step in receiver.steps[1:]:
        assert step.angles[0] / step.duration == pytest.approx(0.5, rel=1e-5)
    assert receiver.counts.irregular > 20


@pytest.mark.parametrize("share", [0.02, 0.2, 0.5])
def test_missing_samples_are_all_counted_however_many_they_are(share: float) -> None:
    rng = np.random.default_rng(1)
    kept = [0, *(k for k in range(1, 2999) if k < 20 or rng.random() > share), 2999]
    receiver = Receiver()
    receiver.take(*(at(k * PERIOD, 0.01 * k, 0.0, 0.0) for k in kept))
    assert receiver.counts.missing == 3000 - len(kept)


def test_a_robot_that_sends_more_rarely_from_now_on_misses_nothing_after_a_while() -> None:
    times = [*(k * PERIOD for k in range(200)), *(2.0 + 2 * k * PERIOD for k in range(400))]
    receiver = Receiver()
    receiver.take(*(at(time, time, 0.0, 0.0) for time in times))
    assert receiver.counts.missing <= 50
    assert receiver.input.period == pytest.approx(2 * PERIOD)


def test_of_a_link_that_loses_every_second_sample_all_are_counted_where_they_are_numbered() -> None:
    receiver, kept = Receiver(), range(0, 1000, 2)
    receiver.take(*(at(k * PERIOD, 0.01 * k, 0.0, 0.0) for k in kept), skipped=[0, *[1] * (len(kept) - 1)])
    assert receiver.counts.missing == len(kept) - 1
    assert receiver.input.period == pytest.approx(PERIOD)


def test_numbered_samples_that_are_lost_from_a_burst_are_missing_and_no_clock_has_jumped() -> None:
    kept = [*range(100), *range(150, 200)]
    arrivals = [PERIOD * min(k, 100) for k in kept]  # the link stood still, and then delivered all at once
    receiver = Receiver()
    receiver.take(
        *(at(PERIOD * k, 0.01 * k, 0.0, 0.0) for k in kept),
        arrivals=arrivals,
        skipped=[50 if k == 150 else 0 for k in kept],
    )
    assert (receiver.counts.missing, receiver.counts.clock_jumps) == (50, 0)
    assert receiver.driven[0] == pytest.approx(1.99)


def test_even_periods_are_not_irregular_whatever_is_missing() -> None:
    receiver = Receiver()
    receiver.take(*[at(PERIOD * k, k, k, k) for k in range(50) if k not in (20, 31, 32)])
    assert receiver.counts.irregular == 0
