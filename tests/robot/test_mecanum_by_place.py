"""Mecanum wheels by x and y, with the rollers of the usual arrangement."""

from __future__ import annotations

import math
from pathlib import Path

import config_robots
import numpy as np
import pytest
import yaml
from commands import Command

from omnibench.config import validate
from omnibench.data.storage import save_dataset
from omnibench.errors import ConfigError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.geometry import WheelGeometry
from omnibench.robot.export.formats import export_calibration
from omnibench.robot.kinematics import Robot, Wheel
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset

PLACES = {"fl": (0.2, 0.15), "fr": (0.2, -0.15), "rl": (-0.2, 0.15), "rr": (-0.2, -0.15)}
MECANUM = Robot(
    name="mecanum", wheels=[Wheel(name=n, type="mecanum", radius=0.05, x=x, y=y) for n, (x, y) in PLACES.items()]
)


def test_it_is_the_robot_that_lever_arms_and_angles_describe() -> None:
    by_angles = config_robots.robot("mecanum")
    forward = [
        -1,
        1,
        -1,
        1,
    ]  # by angles a positive rate turns the robot counter-clockwise, by x and y it drives forward
    np.testing.assert_allclose(
        MECANUM.inverse_kinematic_matrix, by_angles.inverse_kinematic_matrix * forward, atol=1e-12
    )


def test_rollers_that_are_given_stay() -> None:
    wheel = Wheel(name="fl", type="mecanum", radius=0.05, x=0.2, y=0.15, roller_angle=-math.pi / 4)
    assert wheel.roller_angle == -math.pi / 4
    assert Wheel(name="a", radius=0.05, x=0.2, y=0.15, angle=0.3).kind == "omni"


def test_a_wheel_on_an_axis_has_to_say_its_rollers() -> None:
    with pytest.raises(ConfigError, match="Wheel: roller_angle of a mecanum wheel is missing"):
        Wheel(name="ahead", type="mecanum", radius=0.05, x=0.2, y=0.0)


def test_a_file_says_the_rollers_that_were_taken() -> None:
    written = yaml.safe_load(yaml.safe_dump(MECANUM.model_dump(mode="json")))
    assert [wheel["roller_angle"] > 0 for wheel in written["wheels"]] == [True, False, False, True]
    assert Robot.model_validate(written) == MECANUM


def test_such_a_robot_is_simulated_calibrated_designed_for_and_exported(command: Command, tmp_path: Path) -> None:
    content = config_robots.settings("mecanum") | {"robot": MECANUM.model_dump(mode="json")}
    truth = {"truth": {"tolerances": {"radius": 0.01, "position": 0.003, "angle_deg": 0.3, "seed": 7}}}
    dataset = simulate_dataset(validate(FlowerConfig, content | truth, "mecanum"), "mecanum").dataset
    run = calibrate(dataset)
    verdict = run.calibration.provenance.held_out if run.calibration.provenance else None
    assert verdict is not None
    assert verdict.verdict == "better"
    exported = export_calibration(run.calibration, "ros2_controllers").text
    (line,) = [line for line in exported.splitlines() if line.strip().startswith("sum_of_robot")]
    assert float(line.split(":")[1].split("#")[0]) == pytest.approx(0.35, rel=0.03)
    assert export_calibration(run.calibration, "c_header").text
    assert WheelGeometry(MECANUM).names[:4] == ("radius_fl", "radius_fr", "radius_rl", "radius_rr")
    save_dataset(dataset, tmp_path / "data")
    assert command("inspect", tmp_path / "data").returncode == 0
    Path("robot.yaml").write_text(
        yaml.safe_dump(
            {
                "robot": {
                    "name": "m",
                    "wheels": [
                        {"name": n, "type": "mecanum", "radius": 0.05, "x": x, "y": y} for n, (x, y) in PLACES.items()
                    ],
                }
            }
        )
    )
    designed = command("design", "--robot", "robot.yaml")
    assert designed.returncode == 0, designed.stderr
