"""Sessions that differ, at the ends of evaluate and compare."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from commands import Command
from hidden.session_sets import session_set

from omnibench.data.storage import save_dataset
from omnibench.robot.calibration import Calibration, matrix_rows, write_calibration

WORDS = "The sessions differ: in s2 against s1, 12 commands"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A data set whose validation session has larger wheels, and a calibration of its design."""
    dataset = session_set("small", 3, change=0.02)
    runs = [run for run in dataset.trajectories if run.repetition is not None and run.repetition < 4]
    save_dataset(replace(dataset, trajectories=tuple(runs)), tmp_path / "data")
    design = Calibration(
        name="design",
        robot=dataset.robot,
        sample_period=dataset.sample_period,
        matrix=matrix_rows(dataset.robot.inverse_kinematic_matrix),
        integration="arc",
    )
    write_calibration(design, tmp_path / "design.yaml")
    return tmp_path / "data"


def test_evaluate_says_after_its_verdict_that_the_sessions_differ(command: Command, data: Path) -> None:
    lines = command("evaluate", data.parent / "design.yaml", data).stdout.splitlines()
    assert lines[-3].startswith("held out (")
    assert lines[-1].startswith(WORDS)
    document = json.loads(command("evaluate", data.parent / "design.yaml", data, "--json").stdout)
    assert [sentence.startswith(WORDS) for sentence in document["sessions"]] == [True]


def test_compare_says_after_its_verdict_and_in_its_report_that_the_sessions_differ(
    command: Command, data: Path
) -> None:
    config = {
        "name": "sessions",
        "datasets": {"robot": {"path": str(data)}},
        "cost": "final_pose",
        "calibrators": ["theoretical", "closed_form"],
        "certificate": None,
    }
    (data.parent / "compare.yaml").write_text(yaml.safe_dump(config))
    output = data.parent / "results"
    told = command("compare", data.parent / "compare.yaml", "-o", output)
    assert told.returncode == 0, told.stderr
    assert WORDS in told.stdout
    assert json.loads((output / "summary.json").read_text())["sessions"]["robot"][0].startswith(WORDS)
    assert WORDS in (output / "report.html").read_text()
