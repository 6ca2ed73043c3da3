"""``omnibench import``: help, templates, units that cannot be right, strange logs, and data sets without poses."""

import json
import math
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import Command, assert_refused, succeeded
from lanes import slow
from newcomer_log import Machine, write_logs
from sample_robots import fixed, mecanum

from omnibench.data.dataset import Dataset
from omnibench.data.importers.csv_template import write_template
from omnibench.data.storage import load_dataset
from omnibench.registry import importers
from omnibench.report.path_pictures import DESIGN_ITEM, paths_before_after
from omnibench.robot.model import OdometryModel
from omnibench.slam.import_dataset import import_dataset

PLUGIN = '''
from pathlib import Path
from pydantic import Field
from omnibench.data.importer import Importer
from omnibench.registry import Options, importers

class MineOptions(Options):
    speed: float = Field(0.5, gt=0, description="m/s, of the belt")
    belts: tuple[str, ...] = Field(default_factory=lambda: ("left", "right"), description="names of the belts")
    gears: dict[str, int] = Field({"left": 2}, description="of the belts")

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
def test_an_importers_help_lists_every_option(command: Command, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    shown = succeeded(command("import", name, "--help"))
    assert max(map(len, shown.stdout.splitlines())) <= 80
    for key, field in importers.entry(name).options.model_fields.items():
        assert f"\n  {key}  " in shown.stdout
        assert field.description, key


def test_the_help_of_a_plug_in_importer_is_made_of_its_options(command: Command, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(PLUGIN)
    shown = command("import", "mine", "--help", "--plugin", tmp_path / "mine.py").stdout
    assert "Recordings of my own." in shown
    assert "\n  speed  number > 0   default 0.5\n      m/s, of the belt" in shown
    assert "   default [left,right]\n      names of the belts" in shown
    assert "\n  gears  {key: value}   default {'left': 2}\n      of the belts" in shown


def test_the_help_of_import_says_where_the_options_are(command: Command) -> None:
    assert "omnibench import FORMAT --help" in command("import", "--help").stdout
    assert_refused(command("import", "cvs", "--help"), "'cvs'", "'csv'")


@pytest.mark.parametrize("robot", ["diff", "omni3", "tricycle", *slow("mecanum", "car", "swerve", "skid")])
def test_a_template_imports_as_it_is_written(command: Command, tmp_path: Path, robot: str) -> None:
    succeeded(command("import", "csv", "--template", tmp_path / "log", "--robot-type", robot))
    assert max(map(len, (tmp_path / "log" / "robot.yaml").read_text().splitlines())) <= 80
    imported = succeeded(command("import", "csv", tmp_path / "log", "-o", tmp_path / "data"))
    assert "warning" not in imported.stderr
    runs = load_dataset(tmp_path / "data").trajectories
    assert [(run.id, run.command, run.repetition) for run in runs[:2]] == [("left_1", "left", 1), ("left_2", "left", 2)]


def test_import_says_what_lacks_and_writes_no_data_set_over_itself(command: Command, filled_in: Path) -> None:
    data = filled_in.parent / "data"
    assert_refused(command("import", "csv"), "SOURCE")
    assert_refused(command("import", "csv", filled_in), "-o DIR")
    assert "see what they tell" in command("import", "csv", filled_in, "-o", data, "--no-check").stderr
    assert_refused(command("import", "dataset", data, "-o", data, "--force"), "is the source")
    (filled_in / "robot.yaml").unlink()
    lacking = command("import", "csv", filled_in, "-o", filled_in.parent / "other")
    assert_refused(lacking, "'robot'", "--set robot=FILE.yaml", "import csv --template DIR")


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
    succeeded(command("import", "csv", filled_in, "-o", filled_in.parent / "raw", "--accept-units"))
    again = command("import", "dataset", filled_in.parent / "raw", "-o", data, "--force", "--set", "heading_unit=deg")
    assert (again.returncode, "warning" in again.stderr) == (0, False)


def test_counts_a_row_are_refused(command: Command, filled_in: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The template's rates times its period are angles since the row before; as counters no matrix explains them."""
    for file in filled_in.glob("*_wheels.csv"):
        head, *rows = file.read_text().splitlines()
        cells = [[float(cell) for cell in row.split(",")] for row in rows]
        turned = [f"{t},{0.05 * left},{0.05 * right}" for t, left, right in cells]
        file.write_text("\n".join([head.replace("omega", "phi"), "0,0,0", *turned]) + "\n")
    monkeypatch.chdir(filled_in.parent)
    refused = command("import", "csv", "log", "-o", "data", "--set", "wheel_unit=rad")
    assert_refused(refused, "rad/sample", "positions (rad)")
    assert not Path("data").exists()
    typed = refused.stderr.partition(": type omnibench ")[2].partition(", or --accept-units")[0]
    mended = command(*shlex.split(typed))
    assert (mended.returncode, "check: data is ready" in mended.stderr) == (0, True)


def test_a_data_set_keeps_what_was_typed_and_import_ends_with_what_came_out(command: Command, filled_in: Path) -> None:
    data = filled_in.parent / "data"
    done = succeeded(command("import", "csv", filled_in, "-o", data, "--set", "longest_gap=2"))
    imported = load_dataset(data).imported
    assert (imported.importer, imported.source, imported.options) == ("csv", str(filled_in), {"longest_gap": 2})
    ended = done.stderr.splitlines()
    assert ended[-3].startswith("check: data ")
    assert ended[-2].split("; next, ")[0].endswith("data holds 6 runs of my_robot")
    assert ended[-1].startswith("  omnibench ")


_WHEELS = {
    "diff": [fixed(name, 0, y, radius=0.075) for name, y in (("left", 0.16), ("right", -0.16))],
    "mecanum": [
        mecanum(name, 0.21 * x, 0.17 * y, 45 * x * y) | {"radius": 0.06}
        for name, x, y in (("fl", 1, 1), ("fr", 1, -1), ("rl", -1, 1), ("rr", -1, -1))
    ],
}
_SURE = 2.4  # standard deviations: the 95 % interval by Student's t of the 7 or 8 degrees of freedom of these drives


def log_of(robot: str, folder: Path) -> Machine:
    # By 40 seeds 2 to 12 % of the elements lie beyond 2.1 standard deviations; these were chosen, 1 is as good.
    machine = write_logs(folder, robot, {"diff": 2, "mecanum": 6}[robot])
    (folder / "robot.yaml").write_text(yaml.safe_dump({"name": "rover", "wheels": _WHEELS[robot]}))
    return machine


def typed_on(line: str, machine: Machine) -> list[str]:
    """The options of an error, with its blanks filled in: NAME of the columns, in the robot's order, N of the ticks."""
    options = line[line.index("--set") :].rstrip("?\n")
    for column in machine.columns:
        options = options.replace("NAME", column, 1)
    if "wheel_unit" not in options:
        options += " --set wheel_unit=ticks --set ticks_per_turn=N"
    return shlex.split(options.replace("=N", f"={machine.ticks}"))


@pytest.mark.parametrize("robot", ["diff", pytest.param("mecanum", marks=pytest.mark.slow)])
def test_four_commands_lead_from_a_strange_log_to_the_truth(command: Command, robot: str, tmp_path: Path) -> None:
    machine = log_of(robot, tmp_path)
    first = ["import", "csv", "logs", "-o", "data", "--set", "robot=robot.yaml"]
    refused = command(*first)
    assert_refused(refused, "columns={", *machine.columns)

    named = [*first, *typed_on(refused.stderr, machine)]
    assert_refused(command(*named), "heading_unit=deg", "position_unit=mm")

    units = ["heading_unit=deg", "position_unit=mm", "wheel_time_unit=ms", "command_pattern=^(.*)_"]
    succeeded(command(*named, *(word for unit in units for word in ("--set", unit))))

    calibrated = succeeded(command("calibrate", "data", "-o", "calibration.yaml", "--json"))
    content = json.loads(calibrated.stdout)
    assert content["provenance"]["held_out"]["verdict"] == "better"
    assert_holds(content, machine)


def assert_holds(content: dict[str, object], machine: Machine) -> None:
    """Assert that the matrix, on wheel rates that force no slip, is the true one within its uncertainty."""
    matrix = np.array(content["matrix"])
    allowed = np.linalg.pinv(machine.design) @ machine.design
    blocks = np.kron(np.eye(3), allowed)
    covariance = blocks @ np.array(content["covariance"])[: matrix.size, : matrix.size] @ blocks.T
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0)).reshape(matrix.shape)
    error = np.abs((matrix - machine.truth) @ allowed)
    assert (error <= _SURE * deviations + 1e-12).all()
    assert (error <= 0.02 * np.abs(machine.truth).max(axis=1, keepdims=True)).all()


def a_set(folder: Path, *, references: bool) -> Dataset:
    write_template(folder, "diff", references=references)
    return import_dataset("csv", folder)


@pytest.fixture
def taped(command: Command, tmp_path: Path) -> Path:
    """The template of tape and marks on the floor as a data set."""
    assert command("import", "csv", "--template", tmp_path / "log", "--references").returncode == 0
    done = command("import", "csv", tmp_path / "log", "-o", tmp_path / "taped")
    assert (done.returncode, "warning" in done.stderr) == (0, False), done.stderr
    return tmp_path / "taped"


def test_design_and_replay_say_that_they_need_poses(command: Command, taped: Path) -> None:
    assert_refused(command("design", taped), "no reference poses", "omnibench design --robot FILE")
    assert_refused(command("replay", taped), "no reference poses", "replay runs with poses")


@pytest.mark.usefixtures("taped")
def test_other_commands_take_references_and_check_names_what_they_leave_open(command: Command) -> None:
    for typed in (
        "inspect taped --report report.html",
        "check taped --json",
        "calibrate taped -o c.yaml",
        "calibrate taped --calibrator closed_form --intervals --unidentified keep",
        "simulate --like taped --model c.yaml -o like",
    ):
        done = succeeded(command(*typed.split()))
        assert ('"references_leave_open"' in done.stdout) == ("--json" in typed)


def test_the_picture_of_paths_leaves_runs_without_poses_out(tmp_path: Path) -> None:
    posed, tape = a_set(tmp_path / "posed", references=False), a_set(tmp_path / "tape", references=True)
    models = [(DESIGN_ITEM, OdometryModel.of_design(posed.robot, "arc"))] * 2
    bare = [replace(run, id=f"tape-{run.id}") for run in tape.trajectories]
    grid = paths_before_after([*posed.trajectories, *bare], models, "held-out")
    assert any(figure.title.startswith("Ends of all 6 held-out runs") for figure in grid.figures)
    assert paths_before_after(bare, models, "held-out") is None
