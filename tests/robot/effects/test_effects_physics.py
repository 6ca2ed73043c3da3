"""What effects do to a robot's path: what physics says of them, and which of them another matrix hides."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from effect_samples import ROBOTS, a_drive, a_term, model, term
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.robot.effects.effect import Term, Values
from omnibench.robot.kinematics import Array, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

MATRIX = APR_02.inverse_kinematic_matrix


def constant(twist: list[float], seconds: float, heading: float = 0.0, period: float = 0.01) -> WheelLog:
    """A run at constant wheel rates, one pose wanted at its end."""
    times = period * np.arange(1, round(seconds / period) + 1)
    rates = np.tile(wheel_equations(APR_02.wheels) @ twist, (len(times), 1))
    angles = np.cumsum(rates * period, axis=0)
    return WheelLog(times, rates, np.array([0.0, 0.0, heading]), times[-1:], angles, 0.0, "morning")


def end(log: WheelLog, *terms: Term) -> Array:
    return model(*terms).reported([log])[0][-1]


def shift(log: WheelLog, *terms: Term) -> Array:
    """By how much effects move the last pose."""
    return end(log, *terms) - end(log)


def lever_arm(matrix: Array, values: Values) -> Array:
    return matrix + np.outer([-values["y"], values["x"], 0.0], matrix[2])


def turned(matrix: Array, values: Values) -> Array:
    cosine, sine = math.cos(values["beta"]), math.sin(values["beta"])
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ matrix


ABSORBED_BY: dict[str, Callable[[Array, Values], Array]] = {
    "lidar_lever_arm": lever_arm,
    "lidar_yaw": turned,
    "reference_scale": lambda matrix, values: np.diag([1 + values["s"], 1 + values["s"], 1.0]) @ matrix,
    "sample_period_scale": lambda matrix, values: (1 + values["s"]) * matrix,
}


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("name", ABSORBED_BY)
@given(seed=st.integers(0, 2**32 - 1))
def test_another_matrix_absorbs_the_effect(name: str, robot: str, seed: int) -> None:
    chosen = ROBOTS[robot]
    log, given_term = a_drive(seed, 60, chosen), a_term(name, chosen, seed)
    matrix = ABSORBED_BY[name](chosen.inverse_kinematic_matrix, given_term.values)
    (found,) = model(given_term, robot=chosen).reported([log])
    (expected,) = OdometryModel(chosen, matrix, "arc").poses([log])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("name", "harmonic"), [("wheel_eccentricity", 1), ("roller_ripple", 9)])
def test_a_ripple_averages_out_over_whole_turns_of_a_wheel(name: str, harmonic: int) -> None:
    shape = {"rollers": 9.0} if name == "roller_ripple" else {}
    ripple = term(name, **{f"{part}_{wheel}": 0.02 for part in "ab" for wheel in "abc"}, **shape)
    spin = constant([0.0, 0.0, 1.0], seconds=30.0, period=0.002)
    spin = replace(spin, stamps=spin.times)
    turned = model(ripple).poses([spin])[0][:, 2] - model().poses([spin])[0][:, 2]
    one_turn = 2 * math.pi / spin.rates[0, 0] / 0.002
    whole = [round(count * one_turn) - 1 for count in (1, 2, 3)]
    assert np.abs(turned).max() > 0.01 / harmonic
    assert np.abs(turned[whole]).max() < 1e-3 / harmonic


def test_a_time_offset_moves_a_steady_run_back_by_its_way() -> None:
    late = end(constant([0.2, 0.0, 0.0], 5.0), term("reference_time_offset", tau=0.1))
    np.testing.assert_allclose(late, [1.0 - 0.02, 0.0, 0.0], rtol=0, atol=1e-12)


def test_a_clock_drift_is_an_offset_that_grows() -> None:
    late = end(constant([0.2, 0.0, 0.0], 5.0), term("reference_clock_drift", offset=0.1, slope=0.01))
    np.testing.assert_allclose(late, [1.0 - 0.2 * (0.1 + 0.05), 0.0, 0.0], rtol=0, atol=1e-12)


def test_a_heading_latency_leaves_positions_alone() -> None:
    run = constant([0.2, 0.0, 0.5], 4.0)
    np.testing.assert_allclose(shift(run, term("heading_latency", tau=0.1)), [0.0, 0.0, -0.05], rtol=0, atol=1e-12)


def test_a_floor_carries_the_robot_the_same_way_whatever_its_heading() -> None:
    carried = [
        shift(run, term("floor_drift", dx=0.02, dy=-0.01))
        for heading in (0.0, 1.0, 4.0)
        for run in (constant([0.2, 0.0, 0.0], 5.0, heading), constant([0.0, 0.2, 0.8], 5.0, heading))
    ]
    np.testing.assert_allclose(carried, np.tile([0.02, -0.01, 0.0], (6, 1)), rtol=0, atol=1e-12)


def test_a_body_bias_follows_the_robots_heading() -> None:
    bias = term("body_velocity_bias", bx=0.005, by=0.0)
    for heading in (0.0, 1.0, 4.0):
        run = constant([0.2, 0.0, 0.0], 5.0, heading)
        expected = [0.025 * math.cos(heading), 0.025 * math.sin(heading), 0.0]
        np.testing.assert_allclose(shift(run, bias), expected, rtol=0, atol=1e-12)


def test_an_acceleration_slip_costs_speed_times_k_and_braking_gives_it_back() -> None:
    rising = constant([0.2, 0.0, 0.0], 5.0)
    stopped = np.vstack([rising.rates, np.zeros((500, 3))])
    whole = replace(
        rising, times=0.01 * np.arange(1, 1001), rates=stopped, stamps=np.array([5.0, 10.0]), wheel_angles=None
    )
    slip = term("acceleration_slip", k=0.1)
    at_speed, at_rest = model(slip).poses([whole])[0] - model().poses([whole])[0]
    np.testing.assert_allclose(at_speed, [-0.02, 0.0, 0.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(at_rest, np.zeros(3), rtol=0, atol=1e-12)


def test_an_acceleration_slip_is_a_sum_of_offset_latency_and_centripetal_slip() -> None:
    # v - k dv/dt = what is reported k earlier, its heading k later, and k w x v. To first order in k.
    times = 0.005 * np.arange(1, 3001)
    speed = np.sin(math.pi * times / 15) ** 2
    rates = speed[:, None] * (wheel_equations(APR_02.wheels) @ [0.5, 0.2, 0.4])
    run = WheelLog(times, rates, np.zeros(3), np.linspace(1, 14, 14))
    k = 1e-3
    parts = (
        *(term("reference_time_offset", tau=k), term("heading_latency", tau=-k)),
        term("centripetal_slip", k=k),
    )
    alone = (term("acceleration_slip", k=k),)
    (slip,), (plain,), (imitated,) = (model(*terms).reported([run]) for terms in (alone, (), parts))
    size = np.abs(slip - plain).max()
    assert np.abs(slip - imitated).max() < 0.02 * size


@pytest.mark.parametrize("twist", [[0.3, 0.0, 0.8], [-0.1, 0.2, -0.5]])
def test_an_euler_step_looks_like_a_centripetal_slip_of_half_a_sample(twist: list[float]) -> None:
    run, slip = constant(twist, 6.0, period=0.02), term("centripetal_slip", k=0.01)
    arc, euler = (OdometryModel(APR_02, MATRIX, integration).poses([run])[0] for integration in ("arc", "euler"))
    (slipping,) = OdometryModel(APR_02, MATRIX, "euler", (slip,), 0.02).poses([run])
    assert np.abs(slipping - arc).max() < 0.01 * np.abs(euler - arc).max()


def test_a_start_transient_costs_k_times_its_length_once() -> None:
    lost = shift(constant([0.2, 0.0, 0.0], 20.0), term("start_transient", k=0.2, length=0.05))
    np.testing.assert_allclose(lost, [-0.2 * 0.05, 0.0, 0.0], rtol=0, atol=1e-6)


def test_a_start_transient_comes_again_after_a_rest() -> None:
    run = constant([0.2, 0.0, 0.0], 5.0)
    twice = replace(
        run,
        times=0.01 * np.arange(1, 1002),
        rates=np.vstack([run.rates, np.zeros((1, 3)), run.rates]),
        stamps=np.array([10.01]),
        wheel_angles=None,
    )
    transient = term("start_transient", k=0.2, length=0.05)
    once, again = (shift(each, transient) for each in (run, twice))
    np.testing.assert_allclose(again, 2 * once, rtol=1e-9, atol=1e-12)


def test_a_thermal_drift_grows_with_the_session_and_not_with_the_run() -> None:
    run = constant([0.2, 0.0, 0.0], 5.0)
    drift = term("thermal_radius_drift", k=1e-5)
    for started_at in (0.0, 1000.0):
        expected = 1.0 + 1e-5 * (started_at + 2.5)
        assert end(replace(run, started_at=started_at), drift)[0] == pytest.approx(expected, abs=1e-12)


def test_a_radius_that_grows_with_its_rate_tells_fast_runs_from_slow_ones() -> None:
    grown = term("speed_dependent_radius", k=0.01)
    slow, fast = constant([0.1, 0.0, 0.0], 10.0), constant([0.3, 0.0, 0.0], 10.0 / 3)
    surplus = [shift(run, grown)[0] for run in (slow, fast)]
    assert surplus[1] == pytest.approx(3 * surplus[0], rel=2e-3)


def test_a_dead_zone_tells_slow_runs_from_fast_ones_and_creep_does_not() -> None:
    slow, fast = constant([0.1, 0.0, 0.0], 9.0), constant([0.3, 0.0, 0.0], 3.0)
    names = ("wheel_dead_zone", "coulomb_creep")
    lost = {name: [shift(run, term(name, c=0.01))[0] for run in (slow, fast)] for name in names}
    assert lost["wheel_dead_zone"][0] == pytest.approx(3 * lost["wheel_dead_zone"][1], rel=1e-3)
    assert lost["coulomb_creep"][0] == pytest.approx(lost["coulomb_creep"][1], rel=1e-3)


def test_a_direction_dependent_radius_tells_a_command_from_its_reverse() -> None:
    forwards_farther = term("direction_dependent_radius", k_a=0.01, k_b=0.01, k_c=0.01)
    there, back = (end(constant([sign * 0.2, 0.0, 0.0], 5.0), forwards_farther) for sign in (1, -1))
    assert abs(there[2] + back[2]) > 0.02  # both turn the same way


def test_turning_slips_alone_and_turning_on_the_spot_does_not_couple() -> None:
    spin, curve = constant([0.0, 0.0, 0.5], 4.0), constant([0.2, 0.1, 0.5], 4.0)
    coupling = term("rotation_translation_coupling", kx=0.3, ky=-0.2)
    assert end(spin, coupling)[2] == pytest.approx(2.0, abs=1e-12)
    assert end(curve, coupling)[2] == pytest.approx(2.0 * (1 + 0.3 * 0.2 - 0.2 * 0.1), abs=1e-12)
    assert end(spin, term("quadratic_rotation_slip", k=0.1))[2] == pytest.approx(4 * (0.5 - 0.1 * 0.25), abs=1e-12)


@pytest.mark.parametrize(("name", "harmonic"), [("wheel_eccentricity", 1), ("roller_ripple", 9)])
def test_long_samples_tell_of_a_ripple_what_short_ones_tell(name: str, harmonic: int) -> None:
    shape = {"rollers": float(harmonic)} if name == "roller_ripple" else {}
    ripple = term(name, **{f"{part}_{wheel}": 0.02 for part in "ab" for wheel in "abc"}, **shape)
    stamps = 0.05 * np.arange(1, 100)
    short, long = (
        model(ripple).poses([replace(constant([0.0, 0.0, 2.0], 5.0, period=period), stamps=stamps)])[0][:, 2]
        for period in (0.001, 0.05)
    )
    np.testing.assert_allclose(long, short, rtol=0, atol=1e-9)
