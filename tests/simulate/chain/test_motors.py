"""Motors and encoders: against closed forms, at rest, at their limits, and what cannot be asked of them."""

import math
import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from sample_robots import APR_02
from scipy.integrate import solve_ivp

from omnibench.config import validate
from omnibench.errors import ConfigError
from omnibench.robot.kinematics import Array, wheel_equations
from omnibench.simulate.commands import Command
from omnibench.simulate.motion_commands import CommandedMotion, CommandLink, MotionProfile, command_motion, target_rates
from omnibench.simulate.motors import Controller, DrivenRun, Encoder, Motor, check_reach, drive_session

PERIOD, STEP = 0.01, 0.001  # s
TICK = Encoder().tick
FULL = 1e6  # rad/s; a target that asks for the full voltage

rates = st.one_of(st.floats(0.2, 3), st.floats(-3, -0.2))
starts = st.floats(-100, 100)
motors = st.builds(
    Motor,
    resistance=st.floats(0.3, 2),
    inductance=st.floats(1e-4, 2e-3),
    torque_constant=st.floats(0.03, 0.06),
    inertia=st.floats(0.2, 1),
    static_friction=st.floats(0.5, 1),
    coulomb_friction=st.floats(0.1, 0.5),
    viscous_friction=st.floats(0, 0.5),
)


def drive(
    *pieces: tuple[float, float], start: float = 0.0, motor: Motor | None = None, controller: Controller | None = None
) -> DrivenRun:
    """One wheel that is told rates, each for so many s."""
    told = np.concatenate([np.full(round(seconds / PERIOD), rate) for rate, seconds in pieces])
    return session([told[:, None]], np.array([start]), motor, controller)[0]


def session(
    targets: list[Array], start: Array, motor: Motor | None = None, controller: Controller | None = None
) -> list[DrivenRun]:
    return drive_session(motor or Motor(), controller or Controller(), Encoder(), targets, PERIOD, start)


def turning(run: DrivenRun) -> Array:
    """True rates of the first wheel (M F,), rad/s, each the mean of a millisecond."""
    return np.diff(run.wheel_angles[:, 0]) / STEP


def petals(seed: int) -> list[Array]:
    """Target rates of a few runs of the APR-02."""
    rng = np.random.default_rng(seed)
    commands = [Command(0.2, math.radians(30 * rng.integers(12)), 0.35 * rng.integers(-1, 2)) for _ in range(4)]
    return [
        target_rates(APR_02, command_motion(each, 0.3, 6.0, MotionProfile(), CommandLink(), PERIOD, 0.5, rng))
        for each in commands
    ]


# Against closed forms


@given(motors)
@example(Motor(resistance=0.3, inductance=0.002, torque_constant=0.03, inertia=0.2))  # its two roots are one
def test_a_motor_without_friction_runs_up_as_its_closed_form_says(motor: Motor) -> None:
    free = motor.model_copy(update={"static_friction": 0.0, "coulomb_friction": 0.0, "viscous_friction": 0.0})
    run = drive((FULL, 0.5), motor=free)
    times = STEP * np.arange(len(run.wheel_angles))
    constant, supply = free.wheel_torque_constant, free.supply_voltage
    # s1, s2 = -middle +- spread: roots of s2 + R/L s + K2/(J L) = 0, which may be one; the rate goes from 0 to V/K.
    middle = free.resistance / free.inductance / 2
    product = constant**2 / (free.inertia * free.inductance)
    spread = np.emath.sqrt(middle**2 - product)
    first = np.exp((spread - middle) * times)
    apart = -2 * spread * times  # of the exponents
    difference = -np.expm1(apart) / (2 * spread) if spread else times
    mean = (1 + np.exp(apart)) / 2
    course = 2 * middle / product * (1 - first * mean) - (2 * middle**2 / product - 1) * first * difference
    expected = supply / constant * np.real(times - course)
    assert np.abs(run.wheel_angles[:, 0] - expected).max() < 1e-9


def test_friction_acts_as_an_independent_integration_says() -> None:
    motor = Motor()
    constant, supply = motor.wheel_torque_constant, motor.supply_voltage

    def standing(_: float, state: Array) -> list[float]:
        return [(supply - motor.resistance * state[0]) / motor.inductance, 0.0, 0.0]

    def moving(_: float, state: Array) -> list[float]:
        current, rate, _angle = state
        torque = constant * current - motor.coulomb_friction - motor.viscous_friction * rate
        back = supply - motor.resistance * current - constant * rate
        return [back / motor.inductance, torque / motor.inertia, rate]

    class BreaksAway:
        """Event of solve_ivp: zero as the torque of the current reaches the static friction, where it ends."""

        terminal = True

        def __call__(self, _: float, state: Array) -> float:
            return constant * state[0] - motor.static_friction

    first = solve_ivp(standing, (0, 1), [0, 0, 0], events=BreaksAway(), method="LSODA", rtol=1e-10, atol=1e-12)
    then = solve_ivp(
        moving, (first.t[-1], 0.3), first.y[:, -1], method="LSODA", rtol=1e-10, atol=1e-12, dense_output=True
    )
    times = np.arange(10, 301) * STEP
    found = drive((FULL, 0.3)).wheel_angles[10:, 0]
    fastest_step = motor.fastest_rate * 1e-4  # the breakaway is found to a step of 0.1 ms
    assert np.abs(found - then.sol(times)[2]).max() < fastest_step


# Following a target


@given(rates, starts)
def test_a_step_is_followed_quickly_and_with_little_overshoot(rate: float, start: float) -> None:
    share = turning(drive((rate, 1.0), start=start)) / rate
    assert np.argmax(share > 0.9) - np.argmax(share > 0.1) < 150  # ms
    # One tick in a sample is 0.2 rad/s: the wheel ripples by that much less its inertia, so 50 ms are told.
    assert np.convolve(share, np.full(50, 0.02), "valid").max() < 1.1


@given(rates, starts)
def test_the_mean_rate_in_steady_state_is_the_target_to_a_tick(rate: float, start: float) -> None:
    run = drive((rate, 3.0), start=start)
    turned = run.wheel_angles[3000, 0] - run.wheel_angles[1000, 0]
    assert abs(turned - 2 * rate) < 1.5 * TICK


@given(st.integers(0, 1000))
def test_wheels_follow_the_ramps_of_a_command(seed: int) -> None:
    for told in petals(seed):
        (run,) = session([told], np.zeros(3))
        turned = run.wheel_angles[10::10] - np.cumsum(told, axis=0) * PERIOD
        lag = np.abs(told).max() * 0.15  # rad: what is missing at a lag of 150 ms
        assert np.abs(turned).max() < lag + 3 * TICK
        assert np.abs(turned[-1]).max() < 0.01


# At rest


@given(starts, st.integers(1, 300))
def test_a_wheel_told_to_stand_stands(start: float, samples: int) -> None:
    run = drive((0.0, samples * PERIOD), start=start)
    assert (run.wheel_angles == start).all()
    assert not run.rates.any()
    assert not run.voltages.any()


@given(rates, starts)
def test_a_wheel_comes_to_rest_and_no_tick_follows_though_its_target_is_rounding(rate: float, start: float) -> None:
    rounding = wheel_equations(APR_02.wheels)[1] @ Command(0.2, 0.0, 0.0).twist  # of a wheel across the motion
    assert 0 < abs(rounding) < 1e-12
    for target in (0.0, rounding):
        run = drive((rate, 0.5), (target, 1.0), start=start)
        resting = run.wheel_angles[1000:, 0]
        assert (resting == resting[0]).all()
        assert not run.voltages[-50:].any()


@given(motors, starts)
def test_a_wheel_at_rest_moves_only_when_the_torque_beats_static_friction(motor: Motor, start: float) -> None:
    enough = motor.static_friction * motor.resistance / motor.wheel_torque_constant  # V
    only_proportional = Controller(proportional=1.0, integral=0.0, derivative=0.0)
    held, moved = (
        drive((share * enough, 0.2), start=start, motor=motor, controller=only_proportional) for share in (0.999, 1.001)
    )
    assert (held.wheel_angles == start).all()
    assert moved.wheel_angles[-1, 0] > start


@given(rates, st.floats(0.3, 1), st.floats(0.05, 0.3), st.floats(0, 0.5))
def test_friction_stops_a_wheel_and_never_turns_it(rate: float, static: float, coulomb: float, viscous: float) -> None:
    motor = Motor(static_friction=static, coulomb_friction=coulomb, viscous_friction=viscous)
    run = drive((rate, 0.5), (0.0, 1.0), motor=motor)
    braked = 10 * (np.flatnonzero(run.voltages[:, 0])[-1] + 2)  # ms; 10 ms later no current is left of the voltage
    rest = turning(run)[braked:]
    assert (rest >= 0).all() or (rest <= 0).all()
    assert rest[-1] == 0


# At the limits


def test_voltages_stay_within_the_supply_and_the_integral_does_not_wind_up() -> None:
    run = drive((30.0, 2.0), (3.0, 1.0))
    assert np.abs(run.voltages).max() == Motor().supply_voltage
    assert turning(run)[1999] == pytest.approx(Motor().fastest_rate, rel=1e-3)
    assert turning(run)[2500:] == pytest.approx(np.full(500, 3.0), abs=0.1)


# Encoders and sessions


@given(st.integers(0, 1000), st.floats(-1e5, 1e5))
def test_measured_angles_are_within_a_tick_of_the_true_ones_for_ever(seed: int, start: float) -> None:
    for run in session(petals(seed), np.full(3, start)):
        missing = run.wheel_angles[10::10] - run.angles
        assert missing.min() >= -1e-6 * TICK
        assert missing.max() <= TICK * (1 + 1e-6)


@given(st.integers(0, 1000), st.floats(-1e3, 1e3))
def test_measured_rates_are_whole_ticks_and_sum_to_the_measured_angles(seed: int, start: float) -> None:
    seen = np.floor(np.full(3, start) / TICK) * TICK
    for run in session(petals(seed), np.full(3, start)):
        ticks = run.rates * PERIOD / TICK
        assert np.abs(ticks - np.round(ticks)).max() < 1e-6
        assert np.abs(seen + np.cumsum(run.rates, axis=0) * PERIOD - run.angles).max() < 1e-8
        seen = run.angles[-1]


def test_every_run_starts_from_rest_whatever_came_before_and_has_its_true_angles_at_every_millisecond() -> None:
    moving, told = np.full((50, 3), 2.0), petals(1)[0]
    _, after = session([moving, told], np.zeros(3))
    (alone,) = session([told], after.wheel_angles[0])
    assert np.array_equal(after.wheel_angles, alone.wheel_angles)
    assert np.array_equal(after.rates, alone.rates)
    assert alone.wheel_angles.shape == (10 * len(told) + 1, 3)
    assert alone.rates.shape == alone.angles.shape == alone.voltages.shape == told.shape


@given(st.floats(0.05, 4), st.floats(-math.pi, math.pi), st.floats(-5, 5))
def test_the_proposed_speed_fits_and_little_more_does_not(speed: float, direction: float, turn_rate: float) -> None:
    command = Command(speed, direction, turn_rate)
    try:
        check_reach(APR_02, [command], Motor())
    except ConfigError as error:
        (proposal,) = re.findall(r"give it a speed of at most ([\d.]+) m/s", str(error))
        proposed = float(proposal)
        check_reach(APR_02, [Command(proposed, direction, turn_rate)], Motor())
        with pytest.raises(ConfigError):
            check_reach(APR_02, [Command(proposed * 1.02, direction, turn_rate)], Motor())


def test_a_command_faster_than_the_motors_is_refused_with_the_greatest_speed_or_rate() -> None:
    fits = Command(0.2, 0.0, 0.35)
    with pytest.raises(ConfigError) as caught:
        check_reach(APR_02, [fits, Command(2.0, 0.0, 0.35)], Motor())
    for part in ("command v2_a0_w0.35", "wheel c", "12.16 rad/s", "10.42 rad/s", "1.52 m/s"):
        assert part in str(caught.value)
    with pytest.raises(ConfigError, match=r"7.11 rad/s"):
        check_reach(APR_02, [Command(0.0, 0.0, 8.0)], Motor())
    check_reach(APR_02, [Command(0.0, 0.0, 7.11)], Motor())


@pytest.mark.parametrize(
    ("part", "settings", "named"),
    [
        (Motor, {"coulomb_friction": 2.0}, "coulomb_friction"),
        (Motor, {"static_friction": 100.0}, "67.5 N m"),
        (Motor, {"resistence": 1.0}, "'resistance'"),
        (Motor, {"inductance": 0.0}, "inductance"),
        (Controller, {"proportional": 0, "integral": 0}, "no wheel"),
        (CommandLink, {"watchdog": 0.2}, "watchdog 0.2 s .*refresh 0.3 s"),
        (CommandLink, {"lost": 1.0}, "lost"),
        (CommandLink, {"wachdog": 0.4}, "'watchdog'"),
        (CommandLink, {"stalls_at": -1}, "stalls_at"),
        (MotionProfile, {"shape": "s_curve"}, "'trapezoid' or 'jerk_limited'"),
    ],
)
def test_a_motor_controller_link_or_profile_that_cannot_be_is_refused(
    part: Any, settings: dict[str, float], named: str
) -> None:
    with pytest.raises(ConfigError, match=named):
        validate(part, settings, "motor")


# Motion commands: what is sent, what the set point makes of it, and when the watchdog stops the robot.

SETTLE, TURN = 0.5, 6.0
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
