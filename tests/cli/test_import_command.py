"""``omnibench import``: the help of every importer, tables to fill in, and units that cannot be right."""

from __future__ import annotations

import math
import shlex
from pathlib import Path

import pytest
from commands import Command, assert_refused

from omnibench.data.storage import load_dataset
from omnibench.registry import importers

PLUGIN = '''
from pathlib import Path
from pydantic import Field
from omnibench.data.importer import Importer
from omnibench.registry import Options, importers

class MineOptions(Options):
    speed: float = Field(0.5, gt=0, description="m/s, of the belt")

@importers.register("mine")
class Mine(Importer):
    """Recordings of my own."""

    Options = MineOptions

    def read(self, source):
        raise NotImplementedError
'''


@pytest.fixture
def filled_in(command: Command, tmp_path: Path) -> Path:
    """The template of a differential drive, as it is written."""
    assert command("import", "csv", "--template", tmp_path / "log").returncode == 0
    return tmp_path / "log"


@pytest.mark.parametrize("name", ["csv", "dataset", "optiodom", "rosbag", "table1"])
def test_the_help_of_an_importer_lists_every_option_at_80_columns(
    command: Command, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    shown = command("import", name, "--help")
    assert shown.returncode == 0
    assert max(map(len, shown.stdout.splitlines())) <= 80
    for key, field in importers.entry(name).options.model_fields.items():
        assert f"\n  {key}  " in shown.stdout
        assert field.description, key


def test_the_help_of_a_plug_in_importer_is_made_of_its_options(command: Command, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(PLUGIN)
    shown = command("import", "mine", "--help", "--plugin", tmp_path / "mine.py").stdout
    assert "Recordings of my own." in shown
    assert "\n  speed  number > 0   default 0.5\n      m/s, of the belt" in shown


def test_the_help_of_import_says_where_the_options_are(command: Command) -> None:
    assert "omnibench import FORMAT --help" in command("import", "--help").stdout


def test_the_help_of_an_unknown_format_names_the_nearest(command: Command) -> None:
    assert_refused(command("import", "cvs", "--help"), "unknown importer 'cvs'; did you mean 'csv'?")


@pytest.mark.parametrize("robot", ["diff", "omni3", "mecanum", "tricycle", "car", "swerve", "skid"])
def test_a_template_imports_as_it_is_written(command: Command, tmp_path: Path, robot: str) -> None:
    made = command("import", "csv", "--template", tmp_path / "log", "--robot-type", robot)
    assert made.returncode == 0
    assert max(map(len, (tmp_path / "log" / "robot.yaml").read_text().splitlines())) <= 80
    imported = command("import", "csv", tmp_path / "log", "-o", tmp_path / "data")
    assert imported.returncode == 0, imported.stderr
    assert "warning" not in imported.stderr
    runs = load_dataset(tmp_path / "data").trajectories
    assert [(run.id, run.command, run.repetition) for run in runs[:2]] == [("left_1", "left", 1), ("left_2", "left", 2)]


def test_a_template_of_references_imports_and_calibrates_as_it_is_written(command: Command, tmp_path: Path) -> None:
    made = command("import", "csv", "--template", tmp_path / "log", "--references")
    assert made.returncode == 0, made.stderr
    done = command("import", "csv", tmp_path / "log", "-o", tmp_path / "data")
    assert (done.returncode, "warning" in done.stderr) == (0, False), done.stderr
    fitted = command("calibrate", tmp_path / "data", "-o", tmp_path / "calibration.yaml")
    assert fitted.returncode == 0, fitted.stderr


def test_import_says_what_lacks(command: Command, filled_in: Path) -> None:
    assert_refused(command("import", "csv"), "say SOURCE, the file or folder with the recordings")
    assert_refused(command("import", "csv", filled_in), "say -o DIR, the folder to write")
    (filled_in / "robot.yaml").unlink()
    lacking = command("import", "csv", filled_in, "-o", filled_in.parent / "data")
    assert_refused(lacking, "key 'robot' is missing", "--set robot=FILE.yaml", "import csv --template DIR writes one")


def test_a_data_set_is_not_written_over_itself(command: Command, filled_in: Path) -> None:
    data = filled_in.parent / "data"
    assert command("import", "csv", filled_in, "-o", data).returncode == 0
    assert_refused(command("import", "dataset", data, "-o", data, "--force"), "is the source; name another folder")


def test_units_that_cannot_be_right_are_refused_with_the_option_to_type(command: Command, filled_in: Path) -> None:
    for file in filled_in.glob("*_poses.csv"):
        head, *rows = file.read_text().splitlines()
        cells = [[float(cell) for cell in row.split(",")] for row in rows]
        turned = [f"{t},{x},{y},{math.degrees(theta)}" for t, x, y, theta in cells]
        file.write_text("\n".join([head, *turned]) + "\n")
    data = filled_in.parent / "data"
    assert_refused(command("import", "csv", filled_in, "-o", data), "--set heading_unit=deg", "--accept-units")
    assert not data.exists()
    mended = command("import", "csv", filled_in, "-o", data, "--set", "heading_unit=deg")
    assert (mended.returncode, "warning" in mended.stderr) == (0, False)
    accepted = command("import", "csv", filled_in, "-o", filled_in.parent / "raw", "--accept-units")
    assert accepted.returncode == 0
    again = command("import", "dataset", filled_in.parent / "raw", "-o", data, "--force", "--set", "heading_unit=deg")
    assert (again.returncode, "warning" in again.stderr) == (0, False)


def test_counts_since_the_row_before_that_are_read_as_counters_are_refused_with_the_unit_to_type(
    command: Command, filled_in: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The template's rates times its period are angles since the row before; as counters no matrix explains them."""
    for file in filled_in.glob("*_wheels.csv"):
        head, *rows = file.read_text().splitlines()
        cells = [[float(cell) for cell in row.split(",")] for row in rows]
        turned = [f"{t},{0.05 * left},{0.05 * right}" for t, left, right in cells]
        file.write_text("\n".join([head.replace("omega", "phi"), "0,0,0", *turned]) + "\n")
    monkeypatch.chdir(filled_in.parent)
    refused = command("import", "csv", "log", "-o", "data", "--set", "wheel_unit=rad")
    assert_refused(refused, "increments since the row before (rad/sample); they are read as positions (rad)")
    assert not Path("data").exists()
    typed = refused.stderr.partition(": type omnibench ")[2].partition(", or --accept-units")[0]
    mended = command(*shlex.split(typed))
    assert (mended.returncode, "check: data is ready" in mended.stderr) == (0, True)


def test_a_data_set_keeps_what_was_typed(command: Command, filled_in: Path) -> None:
    data = filled_in.parent / "data"
    assert command("import", "csv", filled_in, "-o", data, "--set", "longest_gap=2").returncode == 0
    imported = load_dataset(data).imported
    assert imported is not None
    assert (imported.importer, imported.source, imported.options) == ("csv", str(filled_in), {"longest_gap": 2})


def test_import_ends_with_what_came_out_and_what_to_do(command: Command, filled_in: Path) -> None:
    ended = command("import", "csv", filled_in, "-o", filled_in.parent / "data").stderr.splitlines()
    assert ended[-3].startswith("check: data ")
    assert ended[-2].split("; next, ")[0].endswith("data holds 6 runs of my_robot")
    assert ended[-1].startswith("  omnibench ")
