"""Motion commands: what is sent, what the set point makes of it, and when the watchdog stops the robot."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.config import validate
from omnibench.errors import ConfigError
from omnibench.robot.kinematics import Array
from omnibench.simulate.commands import Command
from omnibench.simulate.motion_commands import (
    CommandedMotion,
    CommandLink,
    MotionProfile,
    Phase,
    SetPoint,
    SlewLimits,
    command_motion,
    target_rates,
)

PERIOD, SETTLE, TURN = 0.01, 0.5, 6.0
PETAL, WAY = Command(0.2, math.radians(30), 0.35), 1.116

turn_rates = st.one_of(st.just(0.0), st.floats(0.05, 2), st.floats(-2, -0.05))
travels = st.builds(Command, st.floats(0.02, 2), st.floats(-math.pi, math.pi), turn_rates)
ways = st.floats(0.01, 5)
profiles = st.builds(
    MotionProfile,
    shape=st.sampled_from(["trapezoid", "jerk_limited"]),
    acceleration=st.floats(0.1, 5),
    turn_acceleration=st.floats(0.1, 5),
    jerk=st.floats(0.5, 50),
    turn_jerk=st.floats(0.5, 50),
)
lossy_links = st.builds(CommandLink, lost=st.floats(0, 0.6))
seeds = st.integers(0, 2**32 - 1)


def motion(
    command: Command = PETAL,
    way: float | None = WAY,
    profile: MotionProfile | None = None,
    link: CommandLink | None = None,
    seed: int = 0,
) -> CommandedMotion:
    rng = np.random.default_rng(seed)
    return command_motion(command, way, TURN, profile or MotionProfile(), link or CommandLink(), PERIOD, SETTLE, rng)


def shares(driven: CommandedMotion, command: Command) -> Array:
    """Which share of the command's twist the set point is in each sample (F,)."""
    return driven.twists @ command.twist / (command.twist @ command.twist)


def arrivals(driven: CommandedMotion) -> list[tuple[float, float]]:
    """From when to when each command that arrived is valid, s."""
    return [(each.time, each.time + each.duration) for each in driven.commands if each.arrived]


@given(travels, ways, profiles)
def test_an_undisturbed_run_covers_the_commanded_distance(command: Command, way: float, profile: MotionProfile) -> None:
    driven = motion(command, way, profile)
    assert driven.distance == pytest.approx(way, rel=1e-9, abs=1e-10)
    assert driven.stopped_by_watchdog == ()


@given(turn_rates.filter(bool), profiles)
def test_a_turn_on_the_spot_turns_by_its_rate_times_its_duration(turn_rate: float, profile: MotionProfile) -> None:
    driven = motion(Command(0.0, 0.0, turn_rate), None, profile)
    assert driven.twists[:, 2].sum() * PERIOD == pytest.approx(turn_rate * TURN, rel=1e-9)
    assert not driven.twists[:, :2].any()


@given(travels, ways, profiles, lossy_links, seeds)
def test_direction_and_curvature_stay_those_of_the_command(
    command: Command, way: float, profile: MotionProfile, link: CommandLink, seed: int
) -> None:
    driven = motion(command, way, profile, link, seed)
    share = shares(driven, command)
    assert np.abs(driven.twists - share[:, None] * command.twist).max() < 1e-12
    assert share.min() >= -1e-9
    assert share.max() <= 1 + 1e-9


@given(travels, ways, profiles, lossy_links, seeds)
def test_accelerations_and_jerks_stay_within_the_profile_and_validity_within_the_watchdog(
    command: Command, way: float, profile: MotionProfile, link: CommandLink, seed: int
) -> None:
    driven = motion(command, way, profile, link, seed)
    change = np.abs(np.diff(driven.twists, axis=0, prepend=0.0)) / PERIOD
    assert np.hypot(change[:, 0], change[:, 1]).max() <= profile.acceleration + 1e-6
    assert change[:, 2].max() <= profile.turn_acceleration + 1e-6
    assert all(0 <= each.duration <= 0.5 for each in driven.commands)
    if profile.shape == "jerk_limited":
        jerk = np.abs(np.diff(driven.twists, n=2, axis=0)) / PERIOD**2
        assert np.hypot(jerk[:, 0], jerk[:, 1]).max(initial=0.0) <= profile.jerk + 1e-6
        assert jerk[:, 2].max(initial=0.0) <= profile.turn_jerk + 1e-6


def test_a_trapezoid_rises_with_the_limit_of_what_is_slower_and_an_s_curve_takes_longer() -> None:
    turning = Command(0.2, 0.0, 0.8)  # 0.4 s at 0.5 m/s2, 0.8 s at 1 rad/s2
    assert shares(motion(turning), turning)[79:82] == pytest.approx([1 - 0.005 / 0.8, 1.0, 1.0])
    assert motion(profile=MotionProfile(shape="jerk_limited")).times[-1] > motion().times[-1]


@given(
    st.floats(0.2, 20),
    st.one_of(st.just(math.inf), st.floats(1, 500)),
    st.lists(st.floats(1e-3, 0.5), min_size=1, max_size=12),
)
def test_phases_of_set_points_join_between_rest_and_full_speed(slope: float, jerk: float, pauses: list[float]) -> None:
    course, time = SetPoint(SlewLimits(slope, jerk)), 0.0
    for number, pause in enumerate(pauses):
        course = course.towards((number + 1) % 2, time)
        time += pause
    course = course.towards(0.0, time)
    told = [phase.at(t) for phase, t in _instants(course)]
    scales, slopes = np.array([each.scale for each in told]), np.array([each.slope for each in told])
    assert scales.min() >= -1e-9
    assert scales.max() <= 1 + 1e-9
    assert np.abs(slopes).max() <= slope * (1 + 1e-9)
    for before, after in pairwise(course.phases):
        end = before.at(after.start)
        assert (end.way, end.scale) == pytest.approx((after.way, after.scale), abs=1e-9)
        if math.isfinite(jerk):
            assert end.slope == pytest.approx(after.slope, abs=1e-6 * slope)


def _instants(course: SetPoint) -> list[tuple[Phase, float]]:
    """Twenty instants in every phase but the last, which has no end."""
    return [
        (phase, float(t))
        for phase, following in pairwise(course.phases)
        for t in np.linspace(phase.start, following.start, 20)
    ]


def test_commands_are_refreshed_every_300_ms_and_the_last_is_shorter() -> None:
    sent = motion().commands
    assert [each.time for each in sent] == pytest.approx(0.3 * np.arange(19))
    assert {each.duration for each in sent[:-1]} == {0.5}
    assert sent[-1].duration == pytest.approx(WAY / 0.2 - 18 * 0.3)  # the ramp up lacks what the ramp down adds


@given(travels, ways, profiles, lossy_links, seeds)
def test_the_watchdog_stops_the_robot_wherever_no_valid_command_is_there(
    command: Command, way: float, profile: MotionProfile, link: CommandLink, seed: int
) -> None:
    driven = motion(command, way, profile, link, seed)
    valid = arrivals(driven)
    gaps = [(until, again) for (_, until), (again, _) in pairwise(valid) if until < again]
    if not driven.commands[-1].arrived:  # nothing is sent after the last that arrived has run out
        gaps.append((valid[-1][1], float(driven.times[-1])))
    assert driven.stopped_by_watchdog == tuple(gaps)


@given(travels, ways, profiles, lossy_links, seeds)
def test_a_planner_that_loses_commands_goes_on_until_the_distance_is_covered(
    command: Command, way: float, profile: MotionProfile, link: CommandLink, seed: int
) -> None:
    driven = motion(command, way, profile, link, seed)
    assert driven.distance >= way * (1 - 1e-8) - 1e-8
    if driven.commands[-1].arrived:  # where the last is lost, the one before is valid for up to half a second more
        before = max((until for _, until in arrivals(driven)[:-1]), default=0.0)
        if before <= driven.commands[-1].time:
            assert driven.distance == pytest.approx(way, rel=1e-8, abs=1e-8)


@given(travels, profiles, st.floats(0.01, 3))
def test_a_stalled_computer_leaves_a_braking_robot(command: Command, profile: MotionProfile, stalls_at: float) -> None:
    driven = motion(command, 50.0, profile, CommandLink(stalls_at=stalls_at))
    (stop,) = driven.stopped_by_watchdog
    assert stop[0] <= stalls_at + 0.5
    assert stop[1] == driven.times[-1]
    if profile.shape == "trapezoid":
        share = np.append(shares(driven, command), 0.0)
        assert (np.diff(share)[driven.times > stop[0]] <= 1e-9).all()
    assert driven.twists[-1] == pytest.approx([0, 0, 0], abs=1e-12)
    assert driven.distance < 50.0


def test_a_computer_that_is_stalled_from_the_start_leaves_the_robot_at_rest() -> None:
    driven = motion(link=CommandLink(stalls_at=0.0))
    assert driven.commands == ()
    assert not driven.twists.any()
    assert driven.times[-1] == pytest.approx(SETTLE)


def test_a_run_ends_with_the_rest_that_was_asked_for() -> None:
    driven = motion()
    resting = driven.times > WAY / 0.2 + 0.4 + 1e-9  # the ramp takes 0.2 / 0.5 s
    assert resting.sum() == SETTLE / PERIOD
    assert not driven.twists[resting].any()


def test_the_same_seed_gives_the_same_motion() -> None:
    link = CommandLink(lost=0.4)
    one, other, third = (motion(link=link, seed=seed) for seed in (5, 5, 6))
    assert one.commands == other.commands
    assert np.array_equal(one.twists, other.twists)
    assert one.commands != third.commands


@given(travels, ways)
def test_target_rates_are_those_of_the_kinematic_matrix(command: Command, way: float) -> None:
    driven = motion(command, way)
    rates = target_rates(APR_02, driven)
    assert rates.shape == (len(driven.times), 3)
    assert np.abs(rates @ APR_02.inverse_kinematic_matrix.T - driven.twists).max() < 1e-12


def test_a_command_that_moves_nothing_is_refused() -> None:
    with pytest.raises(ConfigError, match="v0_a0_w0"):
        motion(Command(0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("part", "settings", "named"),
    [
        (CommandLink, {"watchdog": 0.2}, "watchdog 0.2 s .*refresh 0.3 s"),
        (CommandLink, {"lost": 1.0}, "lost"),
        (CommandLink, {"wachdog": 0.4}, "'watchdog'"),
        (CommandLink, {"stalls_at": -1}, "stalls_at"),
        (MotionProfile, {"shape": "s_curve"}, "'trapezoid' or 'jerk_limited'"),
    ],
)
def test_a_link_or_profile_that_cannot_be_is_refused(part: Any, settings: dict[str, float], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        validate(part, settings, "link")
