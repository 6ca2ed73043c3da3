"""Tables of matrices of robots that steer: columns are drive signals, not wheels."""

from __future__ import annotations

import io
import re

import numpy as np
from export_samples import TRICYCLE
from rich.console import Console

from omnibench.cli.terminal.calibration_tables import print_calibration
from omnibench.cli.terminal.inspection_summary import print_inspection
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.fit.calibrate import calibrate
from omnibench.fit.inspect import inspect_dataset
from omnibench.fit.problem import Budget
from omnibench.robot.kinematics import Robot, Wheel
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.testing.synthetic import PERIOD, synthetic_trajectories


def a_dataset() -> Dataset:
    """Curves of a tricycle to both sides, a hundredth off its design."""
    times, stamps = 0.1 * np.arange(1, 51), 0.5 * np.arange(11)
    model = OdometryModel(TRICYCLE, 1.01 * TRICYCLE.inverse_kinematic_matrix, "arc")
    runs = []
    for number, angle in enumerate((-0.6, -0.3, 0.0, 0.3, 0.6)):
        rates, steering = 3 + np.sin(times + number)[:, None], angle + 0.2 * np.sin(times)[:, None]
        (poses,) = model.poses([WheelLog(times, rates, np.zeros(3), stamps, steering=steering, drive=TRICYCLE.drive)])
        runs.append(Trajectory(f"run-{number}", "train", times, rates, stamps, poses, steering=steering))
    return make_dataset("curves", TRICYCLE, 0.1, runs)


def test_a_matrix_has_a_column_for_each_drive_signal() -> None:
    dataset, console = a_dataset(), Console(file=io.StringIO(), width=120)
    print_calibration(console, calibrate(dataset))
    print_inspection(console, inspect_dataset(dataset))
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert any(line.split() == ["front_cos", "front_sin"] for line in lines)
    assert any(line.startswith("directions of drive signals driven: 2 of 2") for line in lines)
    assert not any("wheel front" in line for line in lines)


def test_the_geometry_of_a_tricycle_is_shown_with_the_place_of_its_tracked_point() -> None:
    console = Console(file=io.StringIO(), width=160)
    searched = calibrate(a_dataset(), "crs", parameterisation="geometry", budget=Budget(evaluations=200))
    print_calibration(console, searched)
    assert isinstance(console.file, io.StringIO)
    assert any(line.startswith("mount_x") for line in console.file.getvalue().splitlines())


def test_an_element_that_is_0_but_for_rounding_has_no_share_of_the_design() -> None:
    wheels = (Wheel(name=f"{n}", radius=0.05, distance=0.2, angle=n * 2 * np.pi / 3) for n in range(3))
    robot, console = Robot(name="omni", wheels=tuple(wheels)), Console(file=io.StringIO(), width=160)
    assert 0 < abs(robot.inverse_kinematic_matrix[0, 0]) < 1e-15
    dataset = make_dataset("omni", robot, PERIOD, synthetic_trajectories(robot))
    print_calibration(console, calibrate(dataset, "random_search", budget=Budget(evaluations=200)))
    assert isinstance(console.file, io.StringIO)
    shares = re.findall(r"([+-][\d.]+) %\)", console.file.getvalue())
    assert len(shares) == 8
    assert max(abs(float(share)) for share in shares) < 100
    assert console.file.getvalue().count("(design 0)") == 1
