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
    assert f"--set wheel_signs=[{signs}], times the present ones; rosbag: joint_signs" in warning
    assert warning.startswith(f"wheel {names[wheel]} ")


@pytest.mark.parametrize("robot", WHEELS)
@pytest.mark.parametrize("count", [500, 1440, 4096])
def test_ticks_taken_for_radians_are_named_with_their_count(robot: str, count: int) -> None:
    (warning,) = warnings_of(robot, rates=times(count / (2 * math.pi)))
    assert told(warning, "at about ", " a turn") == pytest.approx(count, rel=0.15)
    assert "--set wheel_unit=ticks --set ticks_per_turn=N" in warning


def told(warning: str, before: str, after: str) -> float:
    """The number between two texts of a warning."""
    return float(warning.partition(before)[2].partition(after)[0].replace(",", ""))


@each_steered
def test_a_steering_column_in_degrees_is_named(robot: str) -> None:
    (warning,) = warnings_of(robot, steering=times(180 / math.pi))
    assert warning.startswith("steering angles look like degrees")
    assert "--set steering_unit=deg" in warning
    rates, angles = warnings_of(robot, steering=times(180 / math.pi), rates=times(180 / math.pi))
    assert rates.startswith("wheel rates look like deg/s; ")
    assert angles.startswith("steering angles look like degrees; ")


@each_steered
@pytest.mark.parametrize(
    ("change", "words", "option"),
    [
        (plus(10), "looks 10 degrees too large", "steering_offsets_deg=[-10{}], added to"),
        (plus(-10), "looks 10 degrees too small", "steering_offsets_deg=[10{}], added to"),
        (times(-1), "looks counted clockwise", "steering_signs=[-1{}], times the present ones"),
    ],
)
def test_zero_and_sense_of_all_steering_angles_are_named(robot: str, change: Change, words: str, option: str) -> None:
    (warning,) = warnings_of(robot, steering=change)
    first = option.partition("[")[2].partition("{")[0]
    assert words in warning
    assert option.format(f",{first}" * (len(STEERED[robot]) - 1)) in warning


@each_of_several
@pytest.mark.parametrize(
    ("factor", "offset", "words", "option"),
    [
        (180 / math.pi, 0, "looks like degrees", ("steering_scale", "0.0174533", "1")),
        (1, 10, "looks 10 degrees too large", ("steering_offsets_deg", "-10", "0")),
        (-1, 0, "looks counted clockwise", ("steering_signs", "-1", "1")),
    ],
)
def test_one_of_several_steering_angles_is_named(
    robot: str, wheel: int, factor: float, offset: float, words: str, option: tuple[str, str, str]
) -> None:
    change = plus(offset, wheel) if offset else times(factor, wheel)
    (warning,) = warnings_of(robot, steering=change)
    key, wrong, right = option
    values = ",".join(wrong if index == wheel else right for index in range(len(STEERED[robot])))
    assert warning.startswith(f"the steering angle of wheel {STEERED[robot][wheel]} {words}")
    assert f"--set {key}=[{values}], " in warning


def test_a_swerve_base_s_zeros_may_be_the_reference_s_yaw() -> None:
    assert "heading_offset_deg=-10 (" in warnings_of("swerve", steering=plus(10))[0]
    assert "heading_offset_deg" not in warnings_of("tricycle", steering=plus(10))[0]


@each_steered
def test_ticks_and_a_gear_of_the_steering_are_named_relative_to_the_present_scale(robot: str) -> None:
    """A data set does not know by which scale it was imported."""
    (warning,) = warnings_of(robot, steering=times(8192 / (2 * math.pi)))
    assert told(warning, "at about ", " a turn") == pytest.approx(8192, rel=0.1)
    assert "--set steering_unit=ticks --set steering_ticks_per_turn=N; or --set steering_scale" in warning
    for gear in (10, 0.2):
        (warning,) = warnings_of(robot, steering=times(gear))
        assert f"times too {'large' if gear > 1 else 'small'}" in warning
        assert told(warning, "steering_scale=", ", times the present one") == pytest.approx(1 / gear, rel=0.15)


@pytest.mark.parametrize(("robot", "wheel"), [("tricycle", 0), ("car", None), *(("swerve", i) for i in range(4))])
def test_a_steering_angle_that_never_changes_is_named(robot: str, wheel: int | None) -> None:
    (warning,) = warnings_of(robot, steering=times(0, wheel))
    names = STEERED[robot] if wheel is None else (STEERED[robot][wheel],)
    assert f"{', '.join(names)} never changes" in warning
    assert "steering_columns; of bags steering_joints or steering_topic" in warning
