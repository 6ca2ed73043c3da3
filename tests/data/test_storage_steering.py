"""Steering angles on disk: they come back, and a data set without them is refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from storage_samples import FORMATS, Change, Format, drop_column, header, read_frame, set_cell
from wheeled_samples import CAR, DIFF, TRICYCLE, driven

from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError
from omnibench.robot.kinematics import Robot


@pytest.mark.parametrize("fmt", FORMATS)
@pytest.mark.parametrize("robot", [TRICYCLE, CAR], ids=lambda robot: robot.name)
def test_steering_angles_come_back(robot: Robot, fmt: Format, tmp_path: Path) -> None:
    dataset = driven(robot, runs=2, samples=10)
    save_dataset(dataset, tmp_path / "d", fmt)
    found = load_dataset(tmp_path / "d")
    assert found.hash == dataset.hash
    for before, after in zip(dataset.trajectories, found.trajectories, strict=True):
        np.testing.assert_array_equal(after.steering, before.steering)
        np.testing.assert_array_equal(after.signals, before.signals)


def test_the_tables_have_a_column_for_every_measured_rate_and_angle(tmp_path: Path) -> None:
    for robot, columns in (
        (TRICYCLE, ["omega_front", "steer_front"]),
        (CAR, ["omega_rl", "omega_rr", "steer_fl", "steer_fr"]),
        (DIFF, ["omega_right", "omega_left"]),
    ):
        folder = tmp_path / robot.name
        save_dataset(driven(robot, runs=1, samples=5), folder)
        assert read_frame(folder, "wheels").columns == ["trajectory", "t", *columns]
        assert yaml.safe_load((folder / "dataset.yaml").read_text())["wheels"] == list(robot.wheel_names)


@pytest.mark.parametrize("fmt", FORMATS)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            drop_column("wheels", "steer_front"),
            "column 'steer_front', the steering angle of wheel front (rad, counter-clockwise, at the sample's end), is "
            "missing; found: trajectory, t, omega_front",
        ),
        (set_cell("wheels", 3, "steer_front", math.nan), "row 3: steer_front is nan; remove or repair the row"),
        (header("wheels", ["front", "left", "right"]), "the robot's wheels with a measured rate are front; name the"),
    ],
)
def test_steering_angles_that_cannot_be_read_are_refused(
    change: Change, message: str, fmt: Format, tmp_path: Path
) -> None:
    save_dataset(driven(TRICYCLE, runs=1, samples=5), tmp_path / "d", fmt)
    change(tmp_path / "d")
    with pytest.raises(DataError) as refusal:
        load_dataset(tmp_path / "d")
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)
