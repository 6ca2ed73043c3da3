"""The recordings by simulators of their own are as strong as they say, of the robot that they say, and well judged."""

from __future__ import annotations

import ast
import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from foreign_study import KINDS, Result, table

import omnibench
from omnibench.robot.model import OdometryModel

FOREIGN = Path(__file__).parents[1] / "studies" / "foreign"


@pytest.mark.parametrize("file", sorted(FOREIGN.glob("*.py")), ids=lambda file: file.stem)
def test_a_foreign_simulator_imports_nothing_of_omnibench_or_of_the_other_makers(file: Path) -> None:
    for node in ast.walk(ast.parse(file.read_text())):
        names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            names = ["numpy" if node.level and node.module == "recording" else node.module or ""]
        assert {name.split(".")[0] for name in names} <= {"numpy", "polars", *sys.stdlib_module_names}


@pytest.mark.parametrize("kind", KINDS)
def test_a_foreign_recording_loads_without_a_warning_and_its_robot_drives_as_designed(
    kind: str, tmp_path: Path
) -> None:
    truth = importlib.import_module(f"foreign.{kind}").make(tmp_path, 1)
    assert truth["noncentrality"] == pytest.approx(1000, rel=0.02)
    assert kind not in (tmp_path / "dataset.yaml").read_text()
    dataset = omnibench.load_dataset(tmp_path)
    assert dataset.warnings == ()
    training = dataset.split("train")
    assert 120 <= len(training) <= 180
    assert not {run.session for run in training} & {run.session for run in dataset.split("validation")}
    design = OdometryModel(
        dataset.robot, dataset.robot.inverse_kinematic_matrix, "arc", (), sample_period=dataset.sample_period
    )
    reported = design.reported([run.reference_log for run in training])
    ends = np.array([poses[-1] - run.poses[-1] for run, poses in zip(training, reported, strict=True)])
    driven = np.array([run.poses[-1] - run.poses[0] for run in training])
    assert (np.abs(ends).max(axis=0) < 0.12 * np.abs(driven).max(axis=0)).all()


def test_a_foreign_study_counts_what_is_flagged_in_the_right_place_and_what_is_misnamed() -> None:
    hidden = {"kind": "tether_pull", "noncentrality": 1000.0, "covariates": ("place",)}
    right = Result(**hidden, seed=1, verdict="unknown", where=("heading", "place"), closed_chi2=0.5)
    late = Result(**hidden, seed=2, verdict="incomplete", where=("heading", "command", "place"))
    wrong = Result(**hidden, seed=3, verdict="named", names=(("floor_drift", 0.97),), where=("place",))
    line = table([right, late, wrong])[1]
    assert re.findall(r"(\S+%) \(", line) == ["66.7%", "33.3%", "33.3%"]
    assert line.endswith("chi2 50% of 1, eq6 -")
