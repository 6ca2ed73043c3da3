"""A matrix that was hidden in simulated data of four mecanum wheels."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import CONFIGS, Command, omnibench

from omnibench.data.storage import load_dataset
from omnibench.fit.span import driven_span
from omnibench.robot.calibration import read_calibration


@pytest.fixture(scope="module")
def mecanum(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with simulated data of four mecanum wheels, the hidden truth and a calibration."""
    folder = tmp_path_factory.mktemp("mecanum")
    for arguments in (
        ("simulate", CONFIGS / "mecanum.yaml", "-o", folder / "data", "--truth", folder / "truth"),
        ("calibrate", folder / "data", "-o", folder / "calibration.yaml"),
    ):
        run = omnibench(*arguments)
        assert run.returncode == 0, run.stderr
    return folder


def test_four_wheels_are_calibrated_to_the_hidden_matrix_where_they_were_driven(mecanum: Path) -> None:
    truth = np.array(yaml.safe_load((mecanum / "truth" / "truth.yaml").read_text())["matrix"])
    calibration = read_calibration(mecanum / "calibration.yaml")
    dataset = load_dataset(mecanum / "data")
    span = driven_span(dataset.split("train"))
    design = dataset.robot.inverse_kinematic_matrix
    assert truth.shape == calibration.matrix_array.shape == (3, 4)
    on_span, size = span.driven.T @ span.driven, np.abs(truth).max(axis=1)
    missed = np.abs((calibration.matrix_array - truth) @ on_span).max(axis=1) / size
    to_be_found = np.abs((design - truth) @ on_span).max(axis=1) / size
    assert missed.max() < 0.003
    assert to_be_found.min() > 0.015
    assert np.abs((calibration.matrix_array - design) @ span.null.T).max() < 1e-12
    assert np.abs((truth - design) @ span.null.T).max() > 1e-4  # which the data cannot tell


def test_inspection_names_the_direction_that_was_not_driven(command: Command, mecanum: Path) -> None:
    found = json.loads(command("inspect", mecanum / "data", "--json").stdout)
    assert found["undriven"] == ["fl - fr - rl + rr"]
    assert found["driven_directions"] == 3
    shown = command("inspect", mecanum / "data").stdout
    assert "no run drives the wheels along fl - fr - rl + rr, as for any robot on four wheels" in shown
