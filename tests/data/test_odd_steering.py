"""Mistakes of robots that steer are named, with the option that mends them; so are wheels that count backward."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import yaml
from commands import CONFIGS

from omnibench.config import validate
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.robot.kinematics import Array
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset

STEERED = {"tricycle": ("front",), "car": ("fl", "fr"), "swerve": ("fl", "fr", "rl", "rr")}
WHEELS = {"diff": 2, "tricycle": 1, "car": 2, "swerve": 4, "skid": 4, "mecanum": 4}
each_steered = pytest.mark.parametrize("robot", STEERED)
each_wheel = pytest.mark.parametrize(("robot", "wheel"), [(robot, i) for robot, n in WHEELS.items() for i in range(n)])
each_of_several = pytest.mark.parametrize(
    ("robot", "wheel"), [(robot, i) for robot in ("car", "swerve") for i in range(len(STEERED[robot]))]
)
Change = Callable[[Array], Array]


@cache
def recorded(robot: str) -> Dataset:
    """Simulated runs of every third command of a config, of a robot that is a little off its design, noisy."""
    (dataset,) = yaml.safe_load((CONFIGS / f"{robot}.yaml").read_text())["datasets"].values()
    settings = {**dataset["simulate"], "repetitions": 1, "validation": None}
    simulated = simulate_dataset(validate(FlowerConfig, settings, robot)).dataset
    return replace(simulated, trajectories=simulated.trajectories[::3])


def warnings_of(robot: str, *, steering: Change | None = None, rates: Change | None = None) -> tuple[str, ...]:
    data, runs = recorded(robot), recorded(robot).trajectories
    if steering is not None:
        runs = tuple(replace(run, steering=steering(run.steering)) for run in runs if run.steering is not None)
    if rates is not None:
        runs = tuple(replace(run, rates=rates(run.rates)) for run in runs)
    return make_dataset("changed", data.robot, data.sample_period, runs).warnings


def times(factor: float, wheel: int | None = None) -> Change:
    return lambda values: values * np.where([wheel in (None, i) for i in range(values.shape[1])], factor, 1.0)


def plus(degrees: float, wheel: int | None = None) -> Change:
    return lambda values: values + np.where([wheel in (None, i) for i in range(values.shape[1])], degrees, 0) / 57.29578


@pytest.mark.parametrize("robot", WHEELS)
def test_sound_recordings_of_every_robot_give_no_warning(robot: str) -> None:
    assert warnings_of(robot) == ()


@each_wheel
def test_a_wheel_that_is_counted_the_wrong_way_is_named_with_its_option(robot: str, wheel: int) -> None:
    names = recorded(robot).robot.wheel_names
    (warning,) = warnings_of(robot, rates=times(-1, wheel))
    signs = ",".join("-1" if index == wheel else "1" for index in range(len(names)))
    assert f"(import with --set wheel_signs=[{signs}], times the present ones; rosbag: joint_signs)" in warning
    assert warning.startswith(f"wheel {names[wheel]} looks counted the wrong way round")


@pytest.mark.parametrize("robot", WHEELS)
@pytest.mark.parametrize("count", [500, 1440, 4096])
def test_ticks_taken_for_radians_are_named_with_their_count(robot: str, count: int) -> None:
    (warning,) = warnings_of(robot, rates=times(count / (2 * math.pi)))
    told = float(warning.partition("as ticks would be at about ")[2].partition(" a turn")[0].replace(",", ""))
    assert told == pytest.approx(count, rel=0.15)
    assert "(import with --set wheel_unit=ticks --set ticks_per_turn=N" in warning
    assert "correct the radius of the wheels, in m, in robot.yaml" in warning


@each_steered
def test_a_steering_column_in_degrees_is_named(robot: str) -> None:
    expected = "steering angles look like degrees; steer_* must be rad (import with --set steering_unit=deg)"
    assert warnings_of(robot, steering=times(180 / math.pi)) == (expected,)


@each_steered
def test_steering_angles_and_rates_in_degrees_are_both_named(robot: str) -> None:
    rates, angles = warnings_of(robot, steering=times(180 / math.pi), rates=times(180 / math.pi))
    assert rates.startswith("wheel rates look like deg/s; ")
    assert angles.startswith("steering angles look like degrees; ")


@each_of_several
def test_one_of_several_steering_columns_in_degrees_is_named(robot: str, wheel: int) -> None:
    (warning,) = warnings_of(robot, steering=times(180 / math.pi, wheel))
    scales = ",".join("0.0174533" if index == wheel else "1" for index in range(len(STEERED[robot])))
    name = STEERED[robot][wheel]
    assert warning.startswith(f"the steering angle of wheel {name} looks like degrees; steer_{name} must be rad")
    assert warning.endswith(f"(import with --set steering_scale=[{scales}], times the present ones)")


@each_steered
@pytest.mark.parametrize("degrees", [10, -10])
def test_a_zero_of_all_steering_angles_10_degrees_off_is_named(robot: str, degrees: int) -> None:
    (warning,) = warnings_of(robot, steering=plus(degrees))
    assert f"looks 10 degrees too {'large' if degrees > 0 else 'small'}, its zero not straight ahead" in warning
    assert f"--set steering_offsets_deg=[{','.join([str(-degrees)] * len(STEERED[robot]))}], added to" in warning


@each_of_several
def test_the_zero_of_one_of_several_steering_angles_10_degrees_off_is_named(robot: str, wheel: int) -> None:
    (warning,) = warnings_of(robot, steering=plus(10, wheel))
    offsets = ",".join("-10" if index == wheel else "0" for index in range(len(STEERED[robot])))
    assert warning.startswith(f"the steering angle of wheel {STEERED[robot][wheel]} looks 10 degrees too large")
    assert f"--set steering_offsets_deg=[{offsets}], added to the present ones" in warning


def test_a_swerve_base_s_zeros_may_be_the_reference_s_yaw() -> None:
    turned = "; or the reference is turned: heading_offset_deg=-10 ("
    assert turned in warnings_of("swerve", steering=plus(10))[0]
    assert "heading_offset_deg" not in warnings_of("tricycle", steering=plus(10))[0]


@each_steered
def test_steering_angles_counted_clockwise_are_named(robot: str) -> None:
    (warning,) = warnings_of(robot, steering=times(-1))
    signs = ",".join(["-1"] * len(STEERED[robot]))
    assert "looks counted clockwise; it must count counter-clockwise" in warning
    assert f"(import with --set steering_signs=[{signs}], times the present ones)" in warning


@each_of_several
def test_one_of_several_steering_angles_counted_clockwise_is_named(robot: str, wheel: int) -> None:
    (warning,) = warnings_of(robot, steering=times(-1, wheel))
    assert warning.startswith(f"the steering angle of wheel {STEERED[robot][wheel]} looks counted clockwise")


@each_steered
def test_ticks_of_the_steering_encoder_taken_for_radians_are_named_with_their_count(robot: str) -> None:
    (warning,) = warnings_of(robot, steering=times(8192 / (2 * math.pi)))
    told = float(warning.partition("as ticks would be at about ")[2].partition(" a turn")[0].replace(",", ""))
    assert told == pytest.approx(8192, rel=0.1)
    assert "import with --set steering_unit=ticks --set steering_ticks_per_turn=N; or --set steering_scale" in warning


@each_steered
@pytest.mark.parametrize("gear", [10, 0.2])
def test_a_gear_of_the_steering_is_named_relative_to_the_present_scale(robot: str, gear: float) -> None:
    """A data set does not know by which scale it was imported."""
    (warning,) = warnings_of(robot, steering=times(gear))
    assert (
        f"times too {'large' if gear > 1 else 'small'}; is there a gear between the encoder and the wheel?" in warning
    )
    told = float(warning.partition("steering_scale=")[2].partition(", times the present one")[0])
    assert told == pytest.approx(1 / gear, rel=0.15)


@pytest.mark.parametrize(("robot", "wheel"), [("tricycle", 0), ("car", None), *(("swerve", i) for i in range(4))])
def test_a_steering_angle_that_never_changes_is_named(robot: str, wheel: int | None) -> None:
    (warning,) = warnings_of(robot, steering=times(0, wheel))
    names = STEERED[robot] if wheel is None else (STEERED[robot][wheel],)
    wheels = f"wheel{'s' if len(names) > 1 else ''} {', '.join(names)}"
    assert warning.startswith(f"the steering angle of {wheels} never changes, though the reference shows that it must")
    assert "(steering_columns; of bags steering_joints or steering_topic)" in warning
