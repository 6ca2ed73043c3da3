"""Commands on a data set whose only references are distances and turned angles: they work, or say what they need."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from commands import Command, assert_refused

from omnibench.cli.handbook_topics import find_topic
from omnibench.data.dataset import Dataset
from omnibench.data.importers.csv_tables.csv_template import write_template
from omnibench.report.path_pictures import DESIGN_ITEM, paths_before_after
from omnibench.robot.model import OdometryModel
from omnibench.slam.import_dataset import import_dataset


def a_set(folder: Path, *, references: bool) -> Dataset:
    write_template(folder, "diff", references=references)
    return import_dataset("csv", folder)


@pytest.fixture
def taped(command: Command, tmp_path: Path) -> Path:
    """The template of tape and marks on the floor as a data set."""
    assert command("import", "csv", "--template", tmp_path / "log", "--references").returncode == 0
    done = command("import", "csv", tmp_path / "log", "-o", tmp_path / "taped")
    assert done.returncode == 0, done.stderr
    return tmp_path / "taped"


def test_design_says_that_it_needs_poses(command: Command, taped: Path) -> None:
    assert_refused(command("design", taped), "no reference poses", "omnibench design --robot FILE")


def test_replay_says_that_it_needs_poses(command: Command, taped: Path) -> None:
    assert_refused(command("replay", taped), "no reference poses", "replay runs with poses")


def test_check_names_what_the_references_leave_open(command: Command, taped: Path) -> None:
    done = command("check", taped, "--json")
    assert done.returncode == 0, done.stderr
    assert '"references_leave_open"' in done.stdout


def test_a_report_of_inspection_and_a_simulation_alike_are_made(command: Command, taped: Path, tmp_path: Path) -> None:
    assert command("inspect", taped, "--report", tmp_path / "report.html").returncode == 0
    assert command("calibrate", taped, "-o", tmp_path / "c.yaml").returncode == 0
    made = command("simulate", "--like", taped, "--model", tmp_path / "c.yaml", "-o", tmp_path / "like")
    assert made.returncode == 0, made.stderr


def test_intervals_by_resampling_are_drawn_with_closed_form(command: Command, taped: Path) -> None:
    done = command("calibrate", taped, "--calibrator", "closed_form", "--intervals", "--unidentified", "keep")
    assert done.returncode == 0, done.stderr


def test_the_picture_of_paths_leaves_runs_without_poses_out(tmp_path: Path) -> None:
    posed, tape = a_set(tmp_path / "posed", references=False), a_set(tmp_path / "tape", references=True)
    models = [(DESIGN_ITEM, OdometryModel.of_design(posed.robot, "arc"))] * 2
    bare = [replace(run, id=f"tape-{run.id}") for run in tape.trajectories]
    grid = paths_before_after([*posed.trajectories, *bare], models, "held-out")
    assert grid is not None
    assert any(figure.title.startswith("Ends of all 6 held-out runs") for figure in grid.figures)
    assert paths_before_after(bare, models, "held-out") is None


def test_the_page_on_references_shows_the_import_of_a_table() -> None:
    assert "omnibench import csv --template tape --references" in find_topic("references").text
