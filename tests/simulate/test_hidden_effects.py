"""Effects that are hidden in simulated recordings, ramps and random starts; and what was simulated before stays."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from commands import refused
from config_robots import NAMES, QUIET, apr02, experiment, robot, settings
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from sample_robots import APR_02, DIFFERENTIAL, SWERVE, TRICYCLE, fixed, make_robot

from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.fit.evaluate import ModelErrors, final_errors
from omnibench.robot.calibration import EffectTerm
from omnibench.robot.kinematics import Array, Mount, Robot, moved_to, published_matrix, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import DrivenPath
from omnibench.simulate import mechanics
from omnibench.simulate.commands import Command, Variation
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.flower import commanded_rates, true_steering
from omnibench.simulate.simulate import simulate_dataset
from omnibench.simulate.truth import Simulation

PUBLISHED = "palacin2023_eq8"
BENCHMARK = [540843.680886297, 18067279.735240657, 11605.562333690346]  # rad/s, rad, m and rad


def few(effects: Mapping[str, Mapping[str, float]] | None = None, **changes: Any) -> FlowerConfig:
    """Six short runs without noise, in the order of the commands, by a robot with these effects."""
    hidden = [{"name": name, "parameters": dict(values)} for name, values in (effects or {}).items()]
    commands = {"speeds": [0.2], "directions_deg": [0, 120, 240], "turn_rates": [-0.35, 0.35]}
    plain = {
        "truth": {"published": PUBLISHED, "effects": hidden},
        "commands": commands | changes.pop("commands", {}),
        "repetitions": 1,
        "order": "sorted",
        "noise": QUIET,
        "train": {"seed": 1, "distance": 0.6},
        "validation": None,
    }
    return apr02(**(plain | changes))


def runs(effects: Mapping[str, Mapping[str, float]] | None = None, **changes: Any) -> tuple[Trajectory, ...]:
    return simulate_dataset(few(effects, **changes)).dataset.trajectories


def test_the_benchmark_stays_what_it_was() -> None:
    """Sums over its 360 runs, by the version that drew noise as the published comparisons have it."""
    runs = simulate_dataset(apr02()).dataset.trajectories
    drawn = [sum(float(np.abs(getattr(run, name)).sum()) for run in runs) for name in ("rates", "angles", "poses")]
    assert drawn == pytest.approx(BENCHMARK, rel=1e-12)


# Effects


def test_motors_with_a_wrong_gain_turn_wheels_by_as_much_faster() -> None:
    for run in runs({"motor_gain": {"g": 0.04}}):
        np.testing.assert_allclose(run.rates, 1.04 * run.targets, rtol=1e-12)


def test_what_motors_lag_behind_is_seen_by_encoders_and_reference() -> None:
    for lagging, plain in zip(runs({"motor_lag": {"tau": 0.2}}), runs(), strict=True):
        missing = (plain.rates - lagging.rates).sum(axis=0) * 0.01
        np.testing.assert_allclose(missing, 0.2 * plain.rates[0], rtol=1e-5)
        turned = published_matrix(PUBLISHED)[2] @ missing
        assert plain.poses[-1, 2] - lagging.poses[-1, 2] == pytest.approx(turned, rel=1e-6)


@pytest.mark.parametrize(
    "effects",
    [
        {"wheel_eccentricity": {"a_a": 0.02, "b_c": -0.01}},
        {"acceleration_slip": {"k": 0.05}, "heading_latency": {"tau": 0.05}},
        {"floor_drift": {"dx": 0.02, "dy": -0.01}, "thermal_radius_drift": {"k": 1e-5}},
        {"start_transient": {"k": 0.2, "length": 0.1}, "lidar_lever_arm": {"x": 0.05, "y": 0.02}},
        {"motor_lag": {"tau": 0.1}, "tyre_wear": {"radius_validation": 0.01}},
        {"heading_drift": {"b": 0.01}, "reference_time_offset": {"tau": 0.1}},
    ],
)
def test_without_noise_the_recording_is_what_the_true_model_reports(effects: dict[str, Any]) -> None:
    shape = {"start": "random", "commands": {"ramp": 0.3}, "validation": {"seed": 2, "distance": 0.5}}
    made = simulate_dataset(few(effects, **shape))
    model = made.truth.true_robot().model
    assert {term.name for term in model.terms} == set(effects)
    found = model.reported([run.reference_log for run in made.dataset.trajectories])
    for run, poses in zip(made.dataset.trajectories, found, strict=True):
        np.testing.assert_allclose(run.poses[1:], poses, atol=1e-12)


def test_encoder_noise_does_not_move_the_wheels_away_from_their_recorded_angles() -> None:
    noisy = {"noise": QUIET | {"encoder": 0.02}, "repetitions": 20}
    errors = []
    for effects in ({"wheel_eccentricity": {"a_a": 0.02}}, {}):
        made = simulate_dataset(few(effects, **noisy))
        errors.append(final_errors(made.truth.true_robot().model, made.dataset.trajectories))
    assert np.abs(errors[1]).max() > 1e-3  # what the noise itself does
    assert np.abs(errors[0] - errors[1]).max() < 5e-5


def test_what_is_hidden_is_in_the_truth_with_all_its_parameters_and_not_in_the_data() -> None:
    made = simulate_dataset(few({"wheel_eccentricity": {"a_b": 0.02}}))
    zeros = dict.fromkeys(("a_a", "b_a", "a_b", "b_b", "a_c", "b_c"), 0.0)
    assert made.truth.effects == (EffectTerm(name="wheel_eccentricity", parameters=zeros | {"a_b": 0.02}),)
    said = (made.dataset.name, made.dataset.description, made.dataset.source, *made.dataset.warnings)
    assert not any("eccentric" in text for text in said)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "an unknown effect": ({"heading_drft": {"b": 0.1}}, "'heading_drift'"),
    "an unknown parameter": ({"heading_drift": {"bb": 0.1}}, "'bb'"),
    "a wheel that is not there": ({"wheel_eccentricity": {"a_d": 0.1}}, "'a_d'"),
    "a session that is not driven": ({"tyre_wear": {"radius_validation": 0.01}}, "'radius_validation'"),
    "no parameter": ({"heading_drift": {}}, "'b' (rad/s)"),
    "no shape": ({"start_transient": {"k": 0.1}}, "'length' (m)"),
    "a shape out of range": ({"start_transient": {"k": 0.1, "length": 99}}, "'length' is 99"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_an_effect_that_cannot_be_hidden_is_refused_in_one_line(case: str) -> None:
    effects, words = REFUSED[case]
    with refused(OmnibenchError, match=f"truth.effects: .*{re.escape(words)}"):
        simulate_dataset(few(effects))


TERM = {"name": "heading_drift", "parameters": {"b": 0.1}}


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"truth": {"published": PUBLISHED, "effects": [TERM, TERM]}}, "heading_drift"),
        ({"commands": {"ramp": 3.5}}, "commands.ramp: 3.5 s; .* 3 s"),
        ({"commands": {"ramp": 1.5, "speeds": [0.0, 0.2], "turn_duration": 1.0}}, "1 s"),
        ({"commands": {"ramp": -1}}, "commands.ramp"),
        ({"start": "anywhere"}, "start"),
        ({"start": "random", "start_area": 0}, "start"),
    ],
)
def test_effects_given_twice_ramps_longer_than_a_run_and_unknown_starts_are_refused(changes: Any, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        few(**changes)


# Ramps


def test_wheels_rise_linearly_to_their_speed_take_longer_and_keep_their_way() -> None:
    for run, plain in zip(runs(commands={"ramp": 0.5}), runs(), strict=True):
        full = plain.rates[0]
        np.testing.assert_allclose(run.rates[0], 0.01 * full, rtol=1e-9)  # mean of the first of 50 samples
        np.testing.assert_allclose(run.rates[-1], 0.01 * full, rtol=1e-9)
        np.testing.assert_allclose(run.rates[50:-50], np.tile(full, (len(run.rates) - 100, 1)), rtol=1e-9)
        steps = np.diff(run.rates[:50], axis=0)
        np.testing.assert_allclose(steps, np.tile(steps[0], (49, 1)), rtol=1e-6)
        assert run.times[-1] == pytest.approx(plain.times[-1] + 0.5)
        np.testing.assert_allclose((run.rates * 0.01).sum(axis=0), (plain.rates * 0.01).sum(axis=0), rtol=1e-9)
        assert (run.distance, run.duration) == (pytest.approx(0.6), run.times[-1])


def test_turns_on_the_spot_are_ramped_too() -> None:
    commands = {"speeds": [0.0], "turn_duration": 2.0, "ramp": 1.0}
    for run in runs(commands=commands):
        assert run.times[-1] == pytest.approx(3.0)
        assert abs(run.omega or 0) == 0.35
        heading = published_matrix(PUBLISHED)[2] @ wheel_equations(few().robot.wheels)[:, 2] * (run.omega or 0) * 2
        assert run.poses[-1, 2] == pytest.approx(heading)


@given(st.floats(0.05, 2.0), st.floats(0.5, 5.0), st.lists(st.floats(1e-3, 0.3), min_size=1, max_size=40))
def test_samples_of_any_length_add_up_to_the_same_way(ramp: float, full: float, lengths: list[float]) -> None:
    end = 2 * ramp + full
    times = np.append(np.cumsum(lengths)[np.cumsum(lengths) < end - 1e-3], end)
    robot = few().robot
    command = Command(0.2, 0.3, 0.1)
    rates = commanded_rates(robot, command, times, ramp)
    driven = (rates * np.diff(times, prepend=0.0)[:, None]).sum(axis=0)
    np.testing.assert_allclose(driven, (full + ramp) * wheel_equations(robot.wheels) @ command.twist, rtol=1e-9)


# Random starts


def test_starts_lie_anywhere_in_the_square_with_any_heading() -> None:
    starts = np.array([run.start for run in runs(repetitions=60, start="random", start_area=3.0)])
    assert np.abs(starts[:, :2]).max() <= 1.5
    assert (np.abs(starts[:, :2]).max(axis=0) > 1.4).all()
    assert [starts[:, 2].min(), starts[:, 2].max()] == pytest.approx([-math.pi, math.pi], abs=0.15)


def test_a_run_is_the_same_from_wherever_it_starts() -> None:
    for moved, plain in zip(runs(start="random"), runs(), strict=True):
        np.testing.assert_allclose(moved.poses, moved_to(moved.start, plain.poses), atol=1e-9)


def test_starts_are_those_of_the_seed() -> None:
    again = [simulate_dataset(few(start="random", train={"seed": seed, "distance": 0.6})).dataset for seed in (1, 1, 2)]
    assert again[0].hash == again[1].hash != again[2].hash


def test_a_record_of_the_truth_says_what_it_lacks() -> None:
    truth = simulate_dataset(few()).truth
    broken = truth.model_copy(update={"effects": (EffectTerm(name="heading_drift"),)})
    with pytest.raises(DataError, match=r"data set flower: truth.effects: effect 'heading_drift': parameter 'b'"):
        broken.true_robot()


# True mechanics of steering, casters, grip and wheel contacts: by hand, in data, and near the effects' models.

WEAVE = {"weave": 0.2, "period": 3.0}
# An effect on a robot with a variation of its commands, how small its model's errors are to be, as a share of those of
# the model without it (to first order only, where the mechanics are not linear), and the parameters.
HIDDEN: dict[str, tuple[str, dict[str, Any], float, dict[str, float]]] = {
    "steering_gain": ("tricycle", WEAVE, 1e-6, {"g": 0.05}),
    "steering_play": ("tricycle", WEAVE, 0.5, {"b": 0.015}),
    "steering_lag": ("tricycle", WEAVE, 0.2, {"tau": 0.03}),
    "steering_offset": ("car", WEAVE, 0.1, {"c": 0.02}),
    "steering_coupling": ("swerve", WEAVE | {"weave": 0.6}, 1e-6, {"k": 0.2}),
    "icr_shift": ("skid", {}, 1e-6, {"x": 0.05}),
    "caster_pull": ("diff", {"reversals": 1}, 0.7, {"k": 0.02}),
    "light_wheel": ("mecanum", {}, 0.1, {"k_fl": 0.05}),
}


def recorded(name: str, *effects: dict[str, Any]) -> Simulation:
    """Quiet recordings of a robot as designed but for these effects, by the commands of a case."""
    robot, variation, _, _ = HIDDEN[name]
    commands = settings(robot)["commands"] | {"variation": variation, "ramp": 0.5}
    return simulate_dataset(experiment(robot, commands=commands, truth={"tolerances": {}, "effects": list(effects)}))


@pytest.mark.parametrize("name", HIDDEN)
def test_the_effect_explains_to_first_order_what_the_mechanics_do_and_what_is_measured_tells_nothing(name: str) -> None:
    robot, _, share, parameters = HIDDEN[name]
    made = recorded(name, {"name": name, "parameters": parameters})
    model, runs = made.truth.true_robot().model, made.dataset.trajectories
    plain = ModelErrors.of(OdometryModel(model.robot, model.matrix, "arc"), runs).on(runs).cost
    assert plain > 1e-3
    assert ModelErrors.of(model, runs).on(runs).cost < share * plain
    for one, other in zip(runs, recorded(name).dataset.trajectories, strict=True):
        if robot != "car":  # whose rear wheels turn as they roll
            np.testing.assert_array_equal(one.rates, other.rates)
        np.testing.assert_array_equal(one.steering, other.steering)


def test_mechanics_act_on_a_robot_of_a_given_matrix_as_well() -> None:
    commands = settings("tricycle")["commands"] | {"variation": WEAVE}
    effects = [{"name": "steering_gain", "parameters": {"g": 0.05}}]
    matrix = experiment("tricycle").robot.inverse_kinematic_matrix.tolist()
    by_matrix, by_contacts = (
        simulate_dataset(experiment("tricycle", commands=commands, truth=truth | {"effects": effects})).dataset
        for truth in ({"matrix": matrix}, {"tolerances": {}})
    )
    for one, other in zip(by_matrix.trajectories, by_contacts.trajectories, strict=True):
        np.testing.assert_allclose(one.poses, other.poses, atol=1e-9)


def test_an_effect_of_another_kind_of_robot_is_refused() -> None:
    truth = {"tolerances": {}, "effects": [{"name": "icr_shift", "parameters": {"x": 0.1}}]}
    with pytest.raises(DataError, match=r"truth\.effects: effect 'icr_shift'.*diff"):
        simulate_dataset(experiment("diff", truth=truth))


def of_steering(name: str, ends: list[float], duration: float = 0.1, **values: float) -> Array:
    return mechanics.steering_truth(name, values, np.array(ends)[:, None], np.full(len(ends), duration))[:, 0]


def test_a_flank_of_the_gear_pushes_the_wheel_and_the_other_one_comes_after_the_play() -> None:
    found = of_steering("steering_play", [0.0, 0.05, 0.3, 0.25, 0.1, -0.1, 0.0], b=0.1)
    np.testing.assert_allclose(found, [0.0, 0.0, 0.2, 0.2, 0.2, 0.0, 0.0])


def test_a_wheel_follows_a_ramp_late_by_the_time_constant_and_comes_to_rest_exponentially() -> None:
    ends = [min(0.1 * step, 2.0) for step in range(1, 41)]  # 1 rad/s for 2 s
    found = of_steering("steering_lag", ends, tau=0.2)
    assert found[19] == pytest.approx(2.0 - 0.2 * (1 - math.exp(-1.9 / 0.2)), abs=1e-12)
    assert found[29] == pytest.approx(2.0 - (2.0 - found[19]) * math.exp(-1.0 / 0.2), abs=1e-12)
    early = of_steering("steering_lag", ends, tau=-0.1)
    np.testing.assert_allclose(early[:-1], ends[1:], atol=1e-12)


def test_a_module_turns_its_own_wheel_only() -> None:
    ends = np.array([[0.0, 0.0, 0.0, 0.0], [0.1, 0.0, -0.2, 0.0]])
    found = mechanics.turned_by_steering({"k": 0.5}, SWERVE.wheels, ends, np.array([0.1, 0.1]))
    np.testing.assert_allclose(found, [[0, 0, 0, 0], [0.5, 0, -1.0, 0]])
    alone = mechanics.turned_by_steering({"k": 0.5}, TRICYCLE.wheels, ends[:, :1], np.array([0.1, 0.1]))
    np.testing.assert_allclose(alone, [[0.0], [0.5]])


def test_a_robot_on_a_circle_is_accelerated_towards_its_centre() -> None:
    twists = np.tile([0.5, 0.0, 1.0], (4000, 1))
    values = {f"k_{name}": 0.1 for name in SWERVE.wheel_names}
    steering = np.tile([0.0, math.pi / 2, math.pi, 0.0], (4000, 1))
    lost = mechanics.lost_by_light_wheels(values, SWERVE.wheels, steering, twists, np.full(4000, 0.001))
    np.testing.assert_allclose(lost[-1], [0, 0.1 * 0.5 / 0.05, 0, 0], atol=1e-3)


@hypothesis_settings(max_examples=6)  # each of 2400 steps
@given(turn=st.floats(-1.0, 1.0).filter(lambda turn: abs(turn) > 0.02))
def test_a_caster_hands_on_its_whole_swing_when_the_robot_turns_back(turn: float) -> None:
    ahead, back = np.tile([0.3, 0.0, turn], (400, 1)), np.tile([-0.3, 0.0, turn], (2000, 1))
    twists = np.vstack([ahead, back])
    added = mechanics.body_truth("caster_pull", {"k": 0.01}, DIFFERENTIAL, twists, np.full(2400, 0.005))[:, 2]
    swung = (added[400:] - added[399]).sum() * 0.005
    # From trailing behind one course it goes to trail behind the other, by the side on which the turn lies.
    lag = math.asin(0.05 * turn / math.hypot(0.3, 0.15 * turn))
    whole = math.pi - 2 * abs(math.atan2(0.15 * turn, 0.3))
    assert swung == pytest.approx(-0.01 * math.copysign(whole, turn), abs=0.01 * (2 * abs(lag) + 1e-3))


# Variation


def test_a_weave_swings_the_rate_of_turn_about_the_commands() -> None:
    commands = settings("diff")["commands"] | {"variation": {"weave": 0.3, "period": 2.0}}
    for run in simulate_dataset(experiment("diff", commands=commands)).dataset.trajectories:
        turns = run.rates @ experiment("diff").robot.inverse_kinematic_matrix[2]
        middles = run.times - 0.5 * run.times[0]
        np.testing.assert_allclose(turns, (run.omega or 0) + 0.3 * np.sin(math.pi * middles), atol=1e-12)


def test_the_speed_is_reversed_and_the_turn_goes_on() -> None:
    commands = settings("diff")["commands"] | {"variation": {"reversals": 2}}
    for run in simulate_dataset(experiment("diff", commands=commands)).dataset.trajectories:
        twists = run.rates @ experiment("diff").robot.inverse_kinematic_matrix.T
        ahead = (run.v or 0.0) * math.cos(run.alpha or 0.0)
        third = len(twists) // 3
        for row, sign in ((0, 1), (third + 2, -1), (len(twists) - 1, 1)):
            np.testing.assert_allclose(twists[row], [sign * ahead, 0.0, run.omega or 0.0], atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_without_noise_the_truth_still_scores_nothing(name: str) -> None:
    commands = settings(name)["commands"] | {"variation": {"weave": 0.1, "reversals": 1}}
    made = simulate_dataset(experiment(name, commands=commands, truth={"tolerances": {}}))
    # An angle in the middle of a sample is the mean of those at its ends, which differ where the speed is reversed.
    missed = {"car": 2e-6, "swerve": 2e-3}.get(name, 1e-8)
    runs = made.dataset.trajectories
    assert ModelErrors.of(OdometryModel.of_design(made.dataset.robot, "arc"), runs).on(runs).cost < missed


@pytest.mark.parametrize("name", ["tricycle", "swerve"])
def test_steering_angles_can_be_told_again_from_the_truth(name: str) -> None:
    commands = settings(name)["commands"] | {"variation": {"weave": 0.1, "period": 2.5, "reversals": 1}}
    made = simulate_dataset(experiment(name, commands=commands))
    for run in made.dataset.trajectories:
        np.testing.assert_array_equal(true_steering(made.dataset.robot, run, made.truth.variation), run.steering)


def test_between_reversals_a_module_turns_on_past_a_right_angle() -> None:
    times = 0.02 * np.arange(1, 201)
    _, steering = Variation(weave=1.0).wheels(SWERVE, Command(0.3, math.pi / 2, 0.0), times, ends=True)
    assert np.abs(np.diff(steering, axis=0)).max() < 0.1
    assert np.abs(steering).max() > math.pi / 2


def test_commands_that_weave_beyond_the_steering_limit_are_left_out() -> None:
    commands = {"speeds": [0.5], "turn_rates": [0.0, 0.4], "variation": {"weave": 0.2}}
    given_config = experiment("car", commands=commands)
    assert [each.name for each in given_config.driven] == ["v0.5_a0_w0", "v0.5_a180_w0"]
    (warning,) = given_config.left_out
    assert warning.startswith("2 of 4 commands")
    assert "v0.5_a0_w0.6" in warning
    with pytest.raises(ConfigError, match=r"v0.5_a0_w0.6 .*steering_limit_deg"):
        experiment("car", commands=commands | {"turn_rates": [0.4]})


@pytest.mark.parametrize("wrong", [{"weave": -1}, {"period": 0}, {"reversals": -1}, {"reversals": 0.5}])
def test_a_variation_that_cannot_be_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=r"commands.variation"):
        experiment("diff", commands=settings("diff")["commands"] | {"variation": wrong})


REAR = make_robot(
    "behind its centre, and rolling to its side",
    *(fixed(name, x, -0.3, angle=math.pi / 2) for name, x in (("a", 0.2), ("b", -0.2))),
    mount=Mount(x=0.1, y=-0.05, yaw=0.3),
)
rates_of_wheels = st.floats(-10, 10).filter(lambda rate: abs(rate) > 0.1)


@pytest.mark.parametrize("design", [*map(robot, NAMES), APR_02, REAR], ids=lambda design: design.name)
def test_wheels_as_designed_move_the_robot_by_the_design_matrix(design: Robot) -> None:
    matrix = mechanics.WheelContacts(design, design.wheels, (), design.mount).matrix
    np.testing.assert_allclose(matrix, design.inverse_kinematic_matrix, atol=1e-9)


@given(rates_of_wheels, st.floats(-1.3, 1.3), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_no_wheel_of_a_tricycle_ever_slides(rate: float, angle: float, aside: float, offset: float) -> None:
    design = robot("tricycle")
    front, *rear = design.wheels
    contacts = mechanics.WheelContacts(design, [front.model_copy(update={"y": aside}), *rear], [offset])
    vx, vy, turn = contacts.twists(np.array([[rate]]), np.array([[angle]]))[0]
    assert vy == pytest.approx(0, abs=1e-12)
    over_front = complex(vx - aside * turn, 0.6 * turn)
    assert over_front == pytest.approx(0.1 * rate * complex(math.cos(angle + offset), math.sin(angle + offset)))


@given(st.floats(0.0, 5.0))
def test_lateral_friction_widens_the_track_of_a_skid_steered_robot(friction: float) -> None:
    design = robot("skid")
    rates = np.array([[-1.0, 1.0, -1.0, 1.0]])  # on the spot, at 0.1 m/s on each side
    turn = mechanics.WheelContacts(design, design.wheels, lateral_friction=friction).twists(rates, None)[0, 2]
    assert turn == pytest.approx(0.1 / (0.25 + friction * 0.2**2 / 0.25), rel=1e-8)


@given(st.floats(0.1, 10), st.floats(-0.5, 0.5))
def test_the_axles_of_a_car_meet_in_one_point_and_its_rear_wheels_turn_as_they_roll(rate: float, turned: float) -> None:
    design = robot("car")
    contacts = mechanics.WheelContacts(design, design.wheels)
    signals = np.array([[rate, rate * math.tan(turned), 0.0]])
    rates, steering = design.drive.commands(signals)
    (twist,) = contacts.twists(rates, steering)
    assert twist[2] == pytest.approx(twist[0] * math.tan(turned) / 0.6, abs=1e-12)
    rolling = contacts.rolling_rates(twist[None])[0]
    assert rolling.mean() == pytest.approx(rate)
    assert rolling[1] - rolling[0] == pytest.approx(twist[2] * 0.4 / 0.1, abs=1e-9)


@pytest.mark.parametrize("integration", ["arc", "euler"])
@given(twists=st.lists(st.tuples(*[st.floats(-3, 3)] * 5), min_size=1, max_size=5))
def test_the_true_motion_is_that_of_odometry_on_other_code(integration: str, twists: list[tuple[float, ...]]) -> None:
    moved, drift = np.array(twists)[:, :3], np.array(twists)[:, 3:]
    times = 0.3 * np.arange(1, len(twists) + 1)
    start, stamps = np.array([1.0, -2.0, 0.5]), np.linspace(-0.1, times[-1] + 0.1, 11)
    way = "arc" if integration == "arc" else "euler"
    true = mechanics.TrueMotion(times, start, moved, way, drift).poses(stamps)
    np.testing.assert_allclose(true, DrivenPath(times, start, 0.3 * moved, way, 0.3 * drift).poses(stamps), atol=1e-12)


@given(st.floats(-1e-3, 1e-3))
def test_a_slow_turn_loses_no_digits(turn: float) -> None:
    second = np.array([1.0])
    (pose,) = mechanics.TrueMotion(second, np.zeros(3), np.array([[1.0, 0.0, turn]]), "arc").poses(second)
    assert pose == pytest.approx([1 - turn**2 / 6 + turn**4 / 120, turn / 2 - turn**3 / 24, turn], abs=1e-15, rel=1e-14)
