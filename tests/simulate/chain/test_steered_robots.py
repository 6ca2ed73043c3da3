"""Robots that steer, simulated from command to SLAM: their steering motors and encoders, and a car's differential."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from config_robots import settings

from omnibench.config import validate
from omnibench.errors import ConfigError
from omnibench.robot.model import OdometryModel
from omnibench.simulate.commands import Command
from omnibench.simulate.motors import Motor, check_reach
from omnibench.simulate.robot_config import RobotConfig
from omnibench.simulate.simulate import simulate_dataset
from omnibench.simulate.truth import Simulation


def made(name: str, **changes: Any) -> Simulation:
    """A run straight on and one in a curve."""
    given = {
        "generator": "robot",
        "robot": settings(name)["robot"],
        "sample_period": 0.02,
        "commands": {"speeds": [0.3], "directions_deg": [0], "turn_rates": [0.0, 0.2]},
        "repetitions": 1,
        "order": "sorted",
        "truth": settings(name)["truth"],
        "motor": {"gear_ratio": 25},
        "steering": {"noise_deg": 0},
        "room": {"plan": "hall"},
        "train": {"seed": 1, "distance": 0.5},
    }
    return simulate_dataset(validate(RobotConfig, given | changes, "config"), name)


@pytest.mark.parametrize("name", ["tricycle", "car", "swerve"])
def test_what_is_measured_tells_the_true_path_by_the_true_matrix(name: str) -> None:
    simulation = made(name)
    truth = OdometryModel(simulation.dataset.robot, np.array(simulation.truth.matrix), "arc")
    for run in simulation.dataset.trajectories:
        log = replace(run.log(run.pose_times), start=np.zeros(3))
        path = simulation.paths[run.id].at(run.pose_times)
        np.testing.assert_allclose(truth.poses([log])[0], path, atol=2e-3)
        assert np.abs(run.poses - path).max() < 0.02  # by SLAM


def test_a_tricycle_steers_while_it_drives_at_the_rate_of_its_motor_in_whole_ticks() -> None:
    straight, curve = made("tricycle").dataset.trajectories
    assert straight.steering is not None
    assert curve.steering is not None
    assert not straight.steering.any()
    ticks = curve.steering * 8192 / (2 * math.pi)
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-9)
    wanted = math.atan(0.2 * 0.6 / 0.3)
    expected = np.minimum(math.pi * curve.times, wanted)
    np.testing.assert_allclose(curve.steering[:, 0], expected, atol=1e-3)
    assert curve.rates[: int(wanted / math.pi / 0.02)].any()


def test_a_swerve_drive_steers_before_it_drives() -> None:
    _, curve = made("swerve").dataset.trajectories
    assert curve.steering is not None
    steering = np.abs(np.diff(curve.steering, axis=0)).max(axis=1) > 1e-9
    driving = np.abs(curve.rates).max(axis=1) > 0
    assert steering.any()
    assert driving.argmax() > np.flatnonzero(steering)[-1]


def test_a_steered_command_beyond_the_motors_is_refused_with_the_speed_that_is_not() -> None:
    robot = validate(RobotConfig, {
        "generator": "robot", "robot": settings("tricycle")["robot"], "commands": {"turn_rates": [0]},
        "truth": {"tolerances": {}}, "room": {"plan": "hall"}, "train": {"seed": 1, "distance": 1},
    }, "config").robot  # fmt: skip
    with pytest.raises(ConfigError, match=r"wheel front would need .* give it a speed of at most 0.927 m/s"):
        check_reach(robot, [Command(2.0, 0.0, 0.5)], Motor())
