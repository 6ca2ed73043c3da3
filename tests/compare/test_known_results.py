"""Results that are known beforehand: the paper's, a real robot's, and a matrix that was hidden."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import CONFIGS, RECORDINGS, ROOT, Command, compared, omnibench, rows, summary

from omnibench.data.storage import load_dataset
from omnibench.fit.span import driven_span
from omnibench.robot.calibration import read_calibration


def selection(config: str, calibrators: list[Any], folder: Path) -> Path:
    """A config that we ship, with some of its calibrators, and without proofs, which no test here looks at."""
    content = yaml.safe_load((CONFIGS / config).read_text(encoding="utf-8"))
    content |= {"calibrators": calibrators, "plugins": [], "certificate": None, "bootstrap": {"resamples": 200}}
    (folder / config).write_text(yaml.safe_dump(content), encoding="utf-8")
    return folder / config


@pytest.fixture(scope="module")
def paper(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("apr02")
    compared(selection("apr02.yaml", ["closed_form", "crs", "theoretical"], folder), folder / "out")
    return rows(folder / "out")


def test_the_theoretical_matrix_costs_what_the_paper_says(paper: dict[str, dict[str, Any]]) -> None:
    assert paper["theoretical"]["train_cost"] == pytest.approx(0.1234, rel=0.02)
    assert paper["theoretical"]["validation_cost"] == pytest.approx(0.1251, rel=0.03)


@pytest.mark.parametrize("label", ["closed_form", "crs"])
def test_a_calibration_improves_as_much_as_in_the_paper(label: str, paper: dict[str, dict[str, Any]]) -> None:
    assert paper[label]["train_improvement"] >= 0.82
    assert paper[label]["validation_improvement"] >= 0.81


def test_nothing_is_below_the_exact_optimum_in_the_same_box(paper: dict[str, dict[str, Any]]) -> None:
    assert paper["crs"]["box"] == paper["closed_form"]["box"] == "paper"
    assert paper["crs"]["train_cost"] >= paper["closed_form"]["train_cost"] - 1e-9
    assert -1e-9 <= paper["crs"]["gap"] < 1e-5


def test_the_exact_optimum_takes_a_handful_of_evaluations(paper: dict[str, dict[str, Any]]) -> None:
    assert paper["closed_form"]["evaluations"] <= 10  # times are measured in tests/benchmarks
    assert paper["closed_form"]["outcome"] == "converged"


def test_a_real_robot_is_calibrated_as_well_as_was_measured(tmp_path: Path) -> None:
    recordings = RECORDINGS / "optiodom" / "omni3"
    if not recordings.is_dir():
        pytest.skip(f"the recordings are not there: {recordings}")
    trajectory_ml = {"name": "trajectory_ml", "options": {"clock": "offset_and_slope"}}  # as in the config
    config = selection("omni3.yaml", ["theoretical", "closed_form", trajectory_ml], tmp_path)
    compared(config, tmp_path / "out", "--data", recordings)
    assert summary(tmp_path / "out")["simulated"] == {"omni3": False}
    found = rows(tmp_path / "out")
    assert f"{100 * found['closed_form']['validation_improvement']:.1f} %" in (ROOT / "README.md").read_text(
        encoding="utf-8"
    )
    assert found["closed_form"]["train_position_m"] <= 0.045
    assert np.degrees(found["closed_form"]["train_heading_rad"]) <= 3.8
    assert found["closed_form"]["validation_position_m"] <= 0.11
    assert np.degrees(found["closed_form"]["validation_heading_rad"]) <= 5.5
    for name in ("train_position_m", "train_heading_rad", "validation_position_m", "validation_heading_rad"):
        assert found["theoretical"][name] > found["closed_form"][name]
    # Other commands, other shapes: there the poses along the way, their clocks set right, are worth as much or more.
    assert found["trajectory_ml"]["validation_cost"] <= found["closed_form"]["validation_cost"]


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


def test_the_truth_is_nowhere_in_the_data(mecanum: Path) -> None:
    truth = yaml.safe_load((mecanum / "truth" / "truth.yaml").read_text())["matrix"]
    assert {file.suffix for file in (mecanum / "data").iterdir()} == {".parquet", ".yaml"}
    header = (mecanum / "data" / "dataset.yaml").read_text()
    for value in np.ravel(truth):
        assert f"{value:.6g}"[:8] not in header
    assert "tolerances" not in header
