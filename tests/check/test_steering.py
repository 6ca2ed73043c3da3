"""Mistakes of robots that steer are named, with the option that mends them; so are wheels that count backward."""

import math
import re
import shlex
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import CONFIGS, RECORDINGS
from lanes import slow, slow_cases

from omnibench import check
from omnibench.check.misreadings import search
from omnibench.check.source import recorded as recorded_of
from omnibench.config import parse_settings, validate
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.data.finding import Finding
from omnibench.robot.kinematics import Array
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset

STEERED = {"tricycle": ("front",), "car": ("fl", "fr"), "swerve": ("fl", "fr", "rl", "rr")}
WHEELS = {"diff": 2, "tricycle": 1, "car": 2, "swerve": 4, "skid": 4, "mecanum": 4}
QUICK = ("diff", "tricycle", "mecanum")
FIRST_WHEELS = [(robot, 0) for robot in (*QUICK, "swerve")]
OTHER_WHEELS = [(robot, i) for robot, n in WHEELS.items() for i in range(n) if (robot, i) not in FIRST_WHEELS]
each_steered = pytest.mark.parametrize("robot", ["tricycle", *slow("car", "swerve")])
Change = Callable[[Array], Array]


@cache
def recorded(robot: str) -> Dataset:
    """Simulated runs of every third command of a config, of a robot that is a little off its design, noisy."""
    (dataset,) = yaml.safe_load((CONFIGS / f"{robot}.yaml").read_text())["datasets"].values()
    settings = {**dataset["simulate"], "repetitions": 1, "validation": None}
    simulated = simulate_dataset(validate(FlowerConfig, settings, robot)).dataset
    return replace(simulated, trajectories=simulated.trajectories[::3])


def mistakes_of(robot: str, *, steering: Change | None = None, rates: Change | None = None) -> tuple[Finding, ...]:
    """The mistakes that the search tells first, and then those that it cannot tell from them."""
    data, runs = recorded(robot), recorded(robot).trajectories
    if steering is not None:
        runs = tuple(replace(run, steering=steering(run.steering)) for run in runs if run.steering is not None)
    if rates is not None:
        runs = tuple(replace(run, rates=rates(run.rates)) for run in runs)
    explained = search(recorded_of(make_dataset("changed", data.robot, data.sample_period, runs)))
    return tuple(mistake for mistakes in (explained.mistakes, *explained.alike) for mistake in mistakes)


def changes_of(mistakes: tuple[Finding, ...], key: str) -> Any:
    """The change that mistakes make to an option; None if they make none."""
    return next((mistake.changes[key] for mistake in mistakes if key in mistake.changes), None)


def times(factor: float, wheel: int | None = None) -> Change:
    return lambda values: values * np.where([wheel in (None, i) for i in range(values.shape[1])], factor, 1.0)


def plus(degrees: float, wheel: int | None = None) -> Change:
    return lambda values: values + np.where([wheel in (None, i) for i in range(values.shape[1])], degrees, 0) / 57.29578


@pytest.mark.parametrize(("robot", "wheel"), [*FIRST_WHEELS, *slow_cases(*OTHER_WHEELS)])
def test_a_wheel_that_is_counted_the_wrong_way_is_named_with_its_option(robot: str, wheel: int) -> None:
    names = recorded(robot).robot.wheel_names
    mistake, *_ = mistakes_of(robot, rates=times(-1, wheel))
    assert mistake.changes == {"wheel_signs": [-1 if index == wheel else 1 for index in range(len(names))]}
    assert mistake.what.startswith(f"wheel {names[wheel]} ")


@pytest.mark.parametrize("robot", [*QUICK, *slow("car", "swerve", "skid")])
def test_ticks_taken_for_radians_are_named_with_their_count(robot: str) -> None:
    mistake, *_ = mistakes_of(robot, rates=times(500 / (2 * math.pi)))
    told = mistake.what.partition("at about ")[2].partition(" a turn")[0]
    assert float(told.replace(",", "")) == pytest.approx(500, rel=0.15)


@each_steered
def test_steering_angles_in_degrees_are_named_also_beside_rates_in_degrees(robot: str) -> None:
    assert changes_of(mistakes_of(robot, steering=times(180 / math.pi)), "steering_unit") == "deg"


@each_steered
@pytest.mark.parametrize("degrees", [10, -10])
def test_the_zero_of_all_steering_angles_is_named(robot: str, degrees: int) -> None:
    offsets = changes_of(mistakes_of(robot, steering=plus(degrees)), "steering_offsets_deg")
    assert offsets == pytest.approx([-degrees] * len(STEERED[robot]), abs=2.5)


@each_steered
def test_steering_angles_that_count_clockwise_are_named(robot: str) -> None:
    signs = changes_of(mistakes_of(robot, steering=times(-1)), "steering_signs")
    assert signs == [-1] * len(STEERED[robot])


@pytest.mark.parametrize("wheel", [1, *slow(0, 2, 3)])
def test_one_of_several_steering_angles_is_named(wheel: int) -> None:
    chosen = [index == wheel for index in range(4)]
    factors = changes_of(mistakes_of("swerve", steering=times(180 / math.pi, wheel)), "steering_factors")
    assert factors == pytest.approx([math.pi / 180 if one else 1 for one in chosen], rel=0.25)
    offsets = changes_of(mistakes_of("swerve", steering=plus(10, wheel)), "steering_offsets_deg")
    assert offsets == pytest.approx([-10 if one else 0 for one in chosen], abs=2.5)
    signs = changes_of(mistakes_of("swerve", steering=times(-1, wheel)), "steering_signs")
    assert signs == [-1 if one else 1 for one in chosen]


@each_steered
@pytest.mark.parametrize("gear", [8192 / (2 * math.pi), 10.0, 0.2])
def test_ticks_and_a_gear_of_the_steering_are_named(robot: str, gear: float) -> None:
    factors = changes_of(mistakes_of(robot, steering=times(gear)), "steering_factors")
    assert factors[0] == pytest.approx(1 / gear, rel=0.15)


@pytest.mark.parametrize("wheel", [0, *slow(2)])
def test_the_zero_of_one_module_is_named_by_the_wheels_that_it_contradicts(wheel: int) -> None:
    (mistake,) = mistakes_of("swerve", steering=plus(6.0, wheel))
    assert mistake.kind == "steering_zero"
    offsets = np.array(mistake.changes["steering_offsets_deg"])
    assert offsets[wheel] == pytest.approx(-6.0, abs=2.0)
    assert not np.delete(offsets, wheel).any()


@pytest.mark.parametrize("degrees", [0.0, 2.0, *slow(-3.0)])
def test_a_small_zero_of_a_cars_steering_is_warned_of_with_its_option(degrees: float) -> None:
    data = recorded("car")
    runs = [replace(run, steering=plus(degrees)(run.steering)) for run in data.trajectories if run.steering is not None]
    report = check(make_dataset("changed", data.robot, data.sample_period, runs))
    zeros = [finding for finding in report.findings if finding.kind == "steering_zero"]
    assert [finding.severity for finding in zeros] == (["warning"] if degrees else [])
    for finding in zeros:
        assert "calibrate --steering fit" in finding.what
        (offset,) = set(finding.changes["steering_offsets_deg"])
        assert offset == pytest.approx(-degrees, abs=0.4)


@pytest.mark.skipif(not (RECORDINGS / "dart").is_dir(), reason="the recordings of the car DART are not at hand")
@pytest.mark.parametrize("drives", ["dart", *slow("dart/free_driving")])
def test_a_command_that_a_real_car_steers_by_is_told_with_its_scale_and_lag_and_nothing_else(
    drives: str, tmp_path: Path
) -> None:
    wheels = [
        {"name": "rear", "type": "fixed", "radius": 0.0325, "x": 0, "y": 0},
        {"name": "front", "type": "steered", "driven": False, "radius": 0.0325, "x": 0.175, "y": 0},
    ]
    robot = tmp_path / "robot.yaml"
    robot.write_text(yaml.safe_dump({"name": "dart", "wheels": wheels}))
    columns = {
        "t": "vicon time", "rear": "vel encoder", "steer_front": "steering",
        "x": "vicon x", "y": "vicon y", "theta": "vicon yaw",
    }  # fmt: skip
    options: dict[str, Any] = {"columns": columns, "wheel_unit": "m/s"}
    report = check(RECORDINGS / drives, options=options, robot=robot)
    typed = parse_settings([word for word in shlex.split(report.command) if re.match("steering_|clocks", word)])
    assert 0.36 <= typed["steering_scale"] <= 0.44
    assert 0.06 <= typed["steering_lag"] <= 0.14
    mended = check(RECORDINGS / drives, options=options | typed, robot=robot)
    kinds = {finding.kind for finding in (*report.findings, *mended.findings)}
    assert not [kind for kind in kinds if kind.startswith("design") or kind == "clock_drift"]
