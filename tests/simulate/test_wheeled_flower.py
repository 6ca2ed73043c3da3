"""Flower data of robots that steer or cannot go sideways: their commands, truth, steering angles and refusals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from config_robots import NAMES, QUIET, experiment, robot, settings

from omnibench.config import validate
from omnibench.errors import ConfigError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.evaluate import ModelErrors
from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, Values
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.signals import Signals
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.flower import true_steering
from omnibench.simulate.simulate import simulate_dataset


@pytest.fixture
def misread_steering() -> str:
    """The name of an effect that is known in one test alone."""
    return effects.register("misread_steering")(MisreadSteering).name


class MisreadSteering(MotionEffect):
    """The true steering angle is the measured one times 1 + g."""

    stage = "steering"
    physics, source, shows_in = "Gain of the angle's encoder.", "first principles", "steering angle"
    fixed_parameters = (Parameter("g", "1", -0.1, 0.1, "gain"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        assert signals.steering is not None
        return values["g"] * signals.steering


@pytest.mark.parametrize("name", NAMES)
def test_without_noise_the_truth_scores_nothing_and_the_design_does_not(name: str) -> None:
    made = simulate_dataset(experiment(name))
    runs, truth = made.dataset.trajectories, OdometryModel(made.dataset.robot, np.array(made.truth.matrix), "arc")
    assert made.dataset.warnings == ()
    # A car's wheels out of place make it turn by what is not quite linear in its signals: 2 to 3 mm over 4 m here.
    assert ModelErrors.of(truth, runs).on(runs).cost < (5e-3 if name == "car" else 1e-9)
    assert ModelErrors.of(OdometryModel.of_design(made.dataset.robot, "arc"), runs).on(runs).cost > 1e-2


def test_robots_that_cannot_go_sideways_drive_forward_and_backward_and_turn_on_the_spot() -> None:
    commands = experiment("diff").driven
    assert {(each.speed, round(math.degrees(each.direction))) for each in commands} == {(0.0, 0), (0.3, 0), (0.3, 180)}
    assert len(commands) == 14
    assert {math.degrees(each.direction) for each in experiment("swerve").driven} == set(range(0, 360, 45))


def test_a_robot_whose_axle_is_not_at_its_centre_turns_about_its_axle() -> None:
    wheels = [wheel | {"x": -0.3} for wheel in robot("diff").model_dump()["wheels"]]
    made = simulate_dataset(experiment("diff", robot={"name": "rear axle", "wheels": wheels}))
    for run in made.dataset.trajectories:
        assert run.targets is not None
        twist = made.dataset.robot.inverse_kinematic_matrix @ run.targets[0]
        np.testing.assert_allclose(
            twist, [(run.v or 0) * math.cos(run.alpha or 0), 0.3 * run.omega, run.omega], atol=1e-9
        )


@pytest.mark.parametrize("name", ["tricycle", "swerve"])
def test_steering_angles_are_those_of_the_commands_within_a_quarter_turn_and_noisy(name: str) -> None:
    quiet, noisy = (
        simulate_dataset(experiment(name, noise=QUIET | {"steering": noise})).dataset.trajectories
        for noise in (0.0, 0.002)
    )
    for plain, measured in zip(quiet, noisy, strict=True):
        assert plain.steering is not None
        assert measured.steering is not None
        assert np.abs(plain.steering).max() <= math.pi / 2 + 1e-6
        assert (plain.steering == plain.steering[0]).all()
        np.testing.assert_array_equal(measured.poses, plain.poses)
        np.testing.assert_array_equal(true_steering(robot(name), measured), plain.steering)
    errors = np.concatenate([m.steering - p.steering for m, p in zip(noisy, quiet, strict=True)])  # type: ignore[operator]
    assert errors.std() == pytest.approx(0.002, rel=0.05)


def test_a_cars_rear_wheels_turn_at_different_rates_in_a_curve() -> None:
    made = simulate_dataset(experiment("car", truth={"tolerances": {}}))
    for run in made.dataset.trajectories:
        turn = (run.rates[:, 1] - run.rates[:, 0]) * 0.1 / 0.4
        np.testing.assert_allclose(turn, run.omega, atol=1e-9)


def test_an_effect_on_the_steering_angle_is_hidden_in_the_motion_and_not_in_what_is_measured(
    misread_steering: str,
) -> None:
    hidden = [{"name": misread_steering, "parameters": {"g": 0.05}}]
    plain, made = (
        simulate_dataset(experiment("tricycle", truth={"tolerances": {}, "effects": effect})) for effect in ([], hidden)
    )
    model = made.truth.true_robot().model
    for with_effect, without in zip(made.dataset.trajectories, plain.dataset.trajectories, strict=True):
        assert with_effect.steering is not None
        np.testing.assert_array_equal(with_effect.steering, without.steering)
        (poses,) = model.poses([with_effect.log(with_effect.pose_times)])
        np.testing.assert_allclose(with_effect.poses, poses, atol=1e-9)
        assert (np.abs(with_effect.poses - without.poses).max() > 1e-3) == (with_effect.omega != 0)


def test_an_effect_on_a_cars_wheels_leaves_them_rolling() -> None:
    hidden = [{"name": "wheel_eccentricity", "parameters": {"a_rl": 0.02}}]
    made = simulate_dataset(experiment("car", truth={"tolerances": {}, "effects": hidden}))
    true = made.truth.true_robot()
    assert true.contacts is not None
    for run in made.dataset.trajectories[:4]:
        again = true.log(run.times, run.rates, run.start, run.times, run.angles[0] - run.rates[0] * run.times[0],  # type: ignore[index]
                         run.started_at, run.session, run.steering)  # fmt: skip
        np.testing.assert_allclose(again.rates, run.rates, atol=1e-4)


def test_commands_beyond_the_steering_limit_are_left_out_and_said() -> None:
    commands = {"speeds": [0.0, 0.5], "turn_rates": [0.0, 0.2, 1.0]}
    given = experiment("car", commands=commands)
    assert [each.name for each in given.driven] == ["v0.5_a0_w0", "v0.5_a180_w0", "v0.5_a0_w0.2", "v0.5_a180_w0.2"]
    (warning,) = simulate_dataset(given).dataset.warnings
    assert "4 of 8 commands cannot be steered and are left out: v0_a0_w0.2 turns on the spot" in warning
    sharper = experiment("tricycle", commands=commands, steering_limit_deg=90)
    assert len(sharper.driven) == 8


MANY: dict[str, tuple[str, dict[str, Any], str]] = {
    "a direction aside": (
        "diff",
        {"commands": {"directions_deg": [0, 90], "turn_rates": [0]}},
        "commands.directions_deg: this robot's fixed wheels would slide at 90 deg; give 0 and 180, or leave",
    ),
    "commands that are all too sharp": (
        "car",
        {"commands": {"speeds": [0.5], "turn_rates": [1.0]}},
        "commands: v0.5_a0_w1 needs more than steering_limit_deg 35; at 0.5 m/s it turns by at most 0.473 rad/s, a "
        "radius of 1.06 m",
    ),
    "turns on the spot of a car": (
        "car",
        {"commands": {"speeds": [0], "turn_rates": [1.0]}},
        "commands: v0_a0_w1 turns on the spot, which steering angles up to 35 deg do not allow",
    ),
    "a steering limit without steering": ("diff", {"steering_limit_deg": 30}, "no wheel of this robot steers"),
    "a matrix of the wheels in the place of the signals": (
        "tricycle",
        {"truth": {"matrix": [[0.1]] * 3}},
        "truth.matrix must have 3 rows of 2 values (front_cos, front_sin)",
    ),
    "a relative distance": ("diff", {"truth": {"tolerances": {"distance": 0.1}}}, "tolerances.distance: wheels that"),
    "a place of wheels without": ("mecanum", {"truth": {"tolerances": {"position": 0.1}}}, "tolerances.position: "),
    "an offset of no steering": ("diff", {"truth": {"tolerances": {"steering_deg": 1}}}, "tolerances.steering_deg: "),
    "friction without sliding": (
        "diff",
        {"truth": {"tolerances": {}, "lateral_friction": 1}},
        "truth.lateral_friction: is for a robot with skid: true",
    ),
}


@pytest.mark.parametrize("case", MANY)
def test_what_a_robot_cannot_do_is_refused_in_one_line(case: str) -> None:
    name, changes, words = MANY[case]
    with pytest.raises(ConfigError) as refusal:
        experiment(name, **changes)
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("name", ["diff", "skid", "tricycle", "car", "swerve"])
def test_what_a_config_simulates_is_calibrated_and_holds_on_the_other_session(name: str) -> None:
    dataset = simulate_dataset(validate(FlowerConfig, settings(name), name)).dataset
    calibrated = calibrate(dataset, "closed_form").calibration.model
    design, found = (
        ModelErrors.of(model, dataset.split("validation")).on(dataset.split("validation")).cost
        for model in (OdometryModel.of_design(dataset.robot, "arc"), calibrated)
    )
    assert found < 0.35 * design
