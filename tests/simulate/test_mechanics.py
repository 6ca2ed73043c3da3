"""True mechanics of steering, casters and grip: by hand, in simulated data, and near what the effects make of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from config_robots import NAMES, experiment, settings
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import DIFFERENTIAL, SWERVE, TRICYCLE

from omnibench.errors import ConfigError, DataError
from omnibench.fit.evaluate import ModelErrors
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.simulate.commands import Command, Variation
from omnibench.simulate.flower import true_steering
from omnibench.simulate.mechanics import body_truth, lost_by_light_wheels, steering_truth, turned_by_steering
from omnibench.simulate.simulate import simulate_dataset
from omnibench.simulate.truth import Simulation

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


def hidden(name: str) -> tuple[Simulation, OdometryModel, float]:
    """Quiet recordings of a robot as designed, its model with the effect, and the error that is allowed."""
    robot, variation, share, parameters = HIDDEN[name]
    commands = settings(robot)["commands"] | {"variation": variation, "ramp": 0.5}
    truth = {"tolerances": {}, "effects": [{"name": name, "parameters": parameters}]}
    made = simulate_dataset(experiment(robot, commands=commands, truth=truth))
    return made, made.truth.true_robot().model, share


@pytest.mark.parametrize("name", HIDDEN)
def test_the_effect_explains_what_the_mechanics_do_to_first_order_at_least(name: str) -> None:
    made, model, share = hidden(name)
    plain = OdometryModel(model.robot, model.matrix, "arc")
    runs = made.dataset.trajectories
    assert ModelErrors.of(plain, runs).on(runs).cost > 1e-3
    assert ModelErrors.of(model, runs).on(runs).cost < share * ModelErrors.of(plain, runs).on(runs).cost


@pytest.mark.parametrize("name", HIDDEN)
def test_what_is_measured_does_not_tell_of_it(name: str) -> None:
    made, _, _ = hidden(name)
    robot, variation, _, _ = HIDDEN[name]
    commands = settings(robot)["commands"] | {"variation": variation, "ramp": 0.5}
    plain = simulate_dataset(experiment(robot, commands=commands, truth={"tolerances": {}}))
    for one, other in zip(made.dataset.trajectories, plain.dataset.trajectories, strict=True):
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


def test_an_effect_of_another_kind_of_robot_is_refused_in_one_line() -> None:
    truth = {"tolerances": {}, "effects": [{"name": "icr_shift", "parameters": {"x": 0.1}}]}
    with pytest.raises(DataError) as refusal:
        simulate_dataset(experiment("diff", truth=truth))
    words = "data set flower: truth.effects: effect 'icr_shift' is for skid-steered robots; robot diff is none, leave"
    assert str(refusal.value).startswith(words)


def of_steering(name: str, ends: list[float], duration: float = 0.1, **values: float) -> Array:
    return steering_truth(name, values, np.array(ends)[:, None], np.full(len(ends), duration))[:, 0]


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
    found = turned_by_steering({"k": 0.5}, SWERVE.wheels, ends, np.array([0.1, 0.1]))
    np.testing.assert_allclose(found, [[0, 0, 0, 0], [0.5, 0, -1.0, 0]])
    alone = turned_by_steering({"k": 0.5}, TRICYCLE.wheels, ends[:, :1], np.array([0.1, 0.1]))
    np.testing.assert_allclose(alone, [[0.0], [0.5]])


def test_a_robot_on_a_circle_is_accelerated_towards_its_centre() -> None:
    twists = np.tile([0.5, 0.0, 1.0], (4000, 1))
    values = {f"k_{name}": 0.1 for name in SWERVE.wheel_names}
    steering = np.tile([0.0, math.pi / 2, math.pi, 0.0], (4000, 1))
    lost = lost_by_light_wheels(values, SWERVE.wheels, steering, twists, np.full(4000, 0.001))
    np.testing.assert_allclose(lost[-1], [0, 0.1 * 0.5 / 0.05, 0, 0], atol=1e-3)


@given(turn=st.floats(-1.0, 1.0).filter(lambda turn: abs(turn) > 0.02))
def test_a_caster_hands_on_its_whole_swing_when_the_robot_turns_back(turn: float) -> None:
    ahead, back = np.tile([0.3, 0.0, turn], (400, 1)), np.tile([-0.3, 0.0, turn], (2000, 1))
    twists = np.vstack([ahead, back])
    added = body_truth("caster_pull", {"k": 0.01}, DIFFERENTIAL, twists, np.full(2400, 0.005))[:, 2]
    swung = (added[400:] - added[399]).sum() * 0.005
    # From trailing behind one course it goes to trail behind the other, by the side on which the turn lies.
    lag = math.asin(0.05 * turn / math.hypot(0.3, 0.15 * turn))
    whole = math.pi - 2 * abs(math.atan2(0.15 * turn, 0.3))
    assert swung == pytest.approx(-0.01 * math.copysign(whole, turn), abs=0.01 * (2 * abs(lag) + 1e-3))


class TestVariation:
    def test_a_weave_swings_the_rate_of_turn_about_the_commands(self) -> None:
        commands = settings("diff")["commands"] | {"variation": {"weave": 0.3, "period": 2.0}}
        for run in simulate_dataset(experiment("diff", commands=commands)).dataset.trajectories:
            turns = run.rates @ experiment("diff").robot.inverse_kinematic_matrix[2]
            middles = run.times - 0.5 * run.times[0]
            np.testing.assert_allclose(turns, (run.omega or 0) + 0.3 * np.sin(math.pi * middles), atol=1e-12)

    def test_the_speed_is_reversed_and_the_turn_goes_on(self) -> None:
        commands = settings("diff")["commands"] | {"variation": {"reversals": 2}}
        for run in simulate_dataset(experiment("diff", commands=commands)).dataset.trajectories:
            twists = run.rates @ experiment("diff").robot.inverse_kinematic_matrix.T
            ahead = (run.v or 0.0) * math.cos(run.alpha or 0.0)
            third = len(twists) // 3
            for row, sign in ((0, 1), (third + 2, -1), (len(twists) - 1, 1)):
                np.testing.assert_allclose(twists[row], [sign * ahead, 0.0, run.omega or 0.0], atol=1e-12)

    @pytest.mark.parametrize("name", NAMES)
    def test_without_noise_the_truth_still_scores_nothing(self, name: str) -> None:
        commands = settings(name)["commands"] | {"variation": {"weave": 0.1, "reversals": 1}}
        made = simulate_dataset(experiment(name, commands=commands, truth={"tolerances": {}}))
        # An angle in the middle of a sample is the mean of those at its ends, which differ where the speed is reversed.
        missed = {"car": 2e-6, "swerve": 2e-3}.get(name, 1e-8)
        assert (
            ModelErrors.of(OdometryModel.of_design(made.dataset.robot, "arc"), made.dataset.trajectories)
            .on(made.dataset.trajectories)
            .cost
            < missed
        )

    @pytest.mark.parametrize("name", ["tricycle", "swerve"])
    def test_steering_angles_can_be_told_again_from_the_truth(self, name: str) -> None:
        commands = settings(name)["commands"] | {"variation": {"weave": 0.1, "period": 2.5, "reversals": 1}}
        made = simulate_dataset(experiment(name, commands=commands))
        for run in made.dataset.trajectories:
            np.testing.assert_array_equal(true_steering(made.dataset.robot, run, made.truth.variation), run.steering)

    def test_between_reversals_a_module_turns_on_past_a_right_angle(self) -> None:
        times = 0.02 * np.arange(1, 201)
        _, steering = Variation(weave=1.0).wheels(SWERVE, Command(0.3, math.pi / 2, 0.0), times, ends=True)
        assert np.abs(np.diff(steering, axis=0)).max() < 0.1
        assert np.abs(steering).max() > math.pi / 2

    def test_commands_that_weave_beyond_the_steering_limit_are_left_out(self) -> None:
        commands = {"speeds": [0.5], "turn_rates": [0.0, 0.4], "variation": {"weave": 0.2}}
        given_config = experiment("car", commands=commands)
        assert [each.name for each in given_config.driven] == ["v0.5_a0_w0", "v0.5_a180_w0"]
        (warning,) = given_config.left_out
        assert warning.startswith("2 of 4 commands cannot be steered and are left out: v0.5_a0_w0.6 needs more than")
        with pytest.raises(ConfigError, match=r"commands: v0.5_a0_w0.6 needs more than steering_limit_deg"):
            experiment("car", commands=commands | {"turn_rates": [0.4]})

    @pytest.mark.parametrize("wrong", [{"weave": -1}, {"period": 0}, {"reversals": -1}, {"reversals": 0.5}])
    def test_a_variation_that_cannot_be_is_refused(self, wrong: dict[str, float]) -> None:
        with pytest.raises(ConfigError, match=r"commands.variation"):
            experiment("diff", commands=settings("diff")["commands"] | {"variation": wrong})
