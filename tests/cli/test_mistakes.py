"""A user's mistake and a disk that refuses: one line on standard error, exit code 2, nothing lost."""

from __future__ import annotations

import functools
import os
import resource
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import polars as pl
import pytest
import yaml
from commands import (
    COMMAND,
    ENVIRONMENT,
    Command,
    Prepared,
    assert_refused,
    disk_that_takes,
    omnibench,
    run_here,
)
from timing import PATIENCE

from omnibench.data.storage import load_dataset


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["compre"], ["No such command 'compre'. Did you mean 'compare'? (see omnibench --help)"]),
        (["compare"], ["Missing argument 'CONFIG|DATASET'", "(see omnibench compare --help)"]),
        (["compare", "a.yaml", "b.yaml"], ["unexpected extra argument"]),
        (["compare", "nowhere.yaml"], ["nowhere.yaml: no such file"]),
        (["compare", "CONFIG", "--outptu", "x"], ["No such option", "--output"]),
        (["compare", "CONFIG", "--output"], ["--output"]),
        (["compare", "CONFIG", "--data", "nowhere"], ["--data nowhere: no such file or folder"]),
        (["compare", "CONFIG", "--data", "flower=nowhere"], ["--data flower=nowhere: no such file or folder"]),
        (["compare", "CONFIG", "--data", "flwer=DATA"], ["unknown data set 'flwer'; did you mean 'flower'?"]),
        (["compare", "CONFIG", "--data", "CONFIG"], ["is a file; a data set is a folder with dataset.yaml in it"]),
        (["compare", "CONFIG", "--plugins", "nowhere"], ["plug-in folder ", "nowhere does not exist"]),
        (["compare", "CONFIG", "--plugins", "CONFIG"], ["plug-in folder ", "small.yaml is a file; name the folder"]),
        (["compare", "CONFIG", "--output", "x" * 300], ["File name too long"]),
        (["compare", "."], [".: is a folder without dataset.yaml; name a config, or the folder of a data set"]),
        (["compare", "DATA/dataset.yaml"], ["unknown key 'format'"]),
        (["calibrate", "nowhere", "-o", "x"], ["nowhere: no such folder"]),
        (
            ["calibrate", "DATA", "-o", "x", "--calibrator", "crss"],
            ["--calibrator: unknown calibrator 'crss'; did you"],
        ),
        (["calibrate", "DATA", "-o", "x", "--cost", "final"], ["--cost: unknown cost 'final'; did you mean 'final_"]),
        (["calibrate", "DATA", "-o", "x", "--box", "papr"], ["--box", "'papr' is not one of 'paper', 'row'"]),
        (["calibrate", "DATA", "-o", "x", "--seed", "-1"], ["--seed"]),
        (["calibrate", "DATA", "-o", "x", "--evaluations", "many"], ["--evaluations", "valid integer"]),
        (["calibrate", "DATA", "-o", "x", "--seconds", "nan"], ["--seconds"]),
        (["calibrate", "DATA", "-o", "x", "--set", "tolerance"], ["--set tolerance: expected KEY=VALUE"]),
        (["calibrate", "DATA", "-o", "x", "--set", "=3"], ["--set =3: expected KEY=VALUE"]),
        (["calibrate", "DATA", "-o", "x", "--set", "tolerance=["], ["--set tolerance=[: not valid YAML"]),
        (["calibrate", "DATA", "-o", "x", "--set", "a=2023-99-99"], ["--set a=2023-99-99: not valid YAML: month must"]),
        (
            ["calibrate", "DATA", "-o", "x", "--set", "tolerence=1"],
            ["unknown key 'tolerence'; did you mean 'tolerance'"],
        ),
        (["calibrate", "DATA", "-o", "DATA"], ["cannot be written: is a folder; name a file"]),
        (["calibrate", "DATA", "-o", "CONFIG/x"], ["cannot be written", "small.yaml is not a folder"]),
        (["evaluate", "CALIBRATION"], ["Missing argument 'DATASET...'"]),
        (["evaluate", "CONFIG", "DATA"], ["format is None, expected 'omnibench-calibration/1'"]),
        (["evaluate", "nowhere.yaml", "DATA"], ["nowhere.yaml: no such file"]),
        (["evaluate", "CALIBRATION", "nowhere"], ["nowhere: no such folder"]),
        (["export", "CALIBRATION"], ["Missing option '--to'"]),
        (["export", "CALIBRATION", "--to", "c_heder"], ["unknown export format 'c_heder'; did you mean 'c_header'?"]),
        (["export", "CALIBRATION", "--to", "c_header", "-o", "CONFIG/x"], ["small.yaml is not a folder"]),
        (["simulate", "CONFIG"], ["Missing option"]),
        (["simulate", "CONFIG", "-o", "CONFIG"], ["is a file; name a folder for the data set"]),
        (["simulate", "CONFIG", "-o", "CONFIG/x"], ["cannot be written", "is not a folder"]),
        (["simulate", "CONFIG", "-o", "x", "--truth", "x"], ["--truth: must be a folder apart from the data set's"]),
        (["simulate", "CONFIG", "-o", "x", "--dataset", "flour"], ["unknown simulated data set 'flour'; did you mean"]),
        (["simulate", "CONFIG", "-o", "x", "--format", "xml"], ["'xml' is not one of 'parquet', 'csv'"]),
        (["import", "csvv", "DATA", "-o", "x"], ["import: unknown importer 'csvv'; did you mean 'csv'?"]),
        (["import", "optiodom", "nowhere", "-o", "x"], ["nowhere: no such file or folder"]),
        (["import", "table1", "DATA", "-o", "x", "--set", "splt=1"], ["unknown key 'splt'"]),
        (["inspect", "CONFIG"], ["is a file; a data set is a folder with dataset.yaml in it"]),
        (["plugin", "check", "DATA"], ["is a folder; name the plug-in's file in it"]),
        (["list", "--plugins", "nowhere"], ["plug-in folder nowhere does not exist"]),
        (["plugin", "new"], ["Missing argument 'name'"]),
        (["plugin", "new", "My-Search"], ["'My-Search' cannot name a plug-in"]),
        (["plugin", "new", "mine", "--kind", "costt"], ["unknown kind of plug-in 'costt'; did you mean 'cost'?"]),
        (["plugin", "check", "nowhere.py"], ["nowhere.py: no such file"]),
        (["plugin", "chek", "x"], ["No such command 'chek'"]),
    ],
    ids=lambda value: " ".join(value)[:50],
)
def test_a_mistake_is_one_line_and_exit_code_2(
    arguments: list[str], parts: list[str], command: Command, prepared: Prepared
) -> None:
    places = {"CONFIG": prepared.config, "DATA": prepared.data, "CALIBRATION": prepared.calibration}

    def placed(argument: str) -> str:
        for name, path in places.items():
            argument = argument.replace(name, str(path))
        return argument

    assert_refused(command(*map(placed, arguments)), *parts)


@pytest.fixture(scope="module")
def as_csv(prepared: Prepared, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data set in tables that an editor can damage."""
    folder = tmp_path_factory.mktemp("csv")
    assert run_here("simulate", prepared.config, "-o", "data", "--format", "csv", cwd=folder).returncode == 0
    return folder / "data"


@pytest.mark.parametrize(
    ("table", "damage", "part"),
    [
        ("wheels", lambda text: text.replace("omega_b", "omega_x", 1), "wheels.csv: "),
        ("wheels", lambda text: text.replace("train-001,0.1,", "train-001,nan,", 1), "wheels.csv, row 2: "),
        ("wheels", lambda text: text.replace("train-001,0.05,", "train-001,0.0,", 1), "wheels.csv, row 1: "),
        ("poses", lambda text: text.replace("train-002,", "train-001,"), "train-00"),
        ("poses", lambda text: text.replace("train-001,0.5,", "train-001,0.1,", 1), "poses.csv, row 3: "),
        ("trajectories", lambda text: text.replace("train-002,", "train-001,", 1), "trajectories.csv, row 2: "),
        ("trajectories", lambda text: text.replace(",train,train", ",training,train", 1), "trajectories.csv, row 1: "),
        ("dataset", lambda text: text.replace("sample_period", "sample_perid"), "did you mean 'sample_period'?"),
        ("dataset", lambda text: text.replace("dataset/1", "dataset/2"), "omnibench-dataset/1"),
    ],
)
def test_a_reading_rule_reaches_the_user_as_one_line(
    table: str,
    damage: Callable[[str], str],
    part: str,
    command: Command,
    prepared: Prepared,
    as_csv: Path,
    tmp_path: Path,
) -> None:
    shutil.copytree(as_csv, tmp_path / "data")
    file = tmp_path / "data" / f"{table}.{'yaml' if table == 'dataset' else 'csv'}"
    whole = file.read_text()
    file.write_text(damage(whole))
    assert file.read_text() != whole
    assert_refused(command("inspect", tmp_path / "data"), part)
    assert_refused(command("compare", prepared.config, "--data", tmp_path / "data", "--output", tmp_path / "out"), part)
    assert not (tmp_path / "out").exists()


def test_a_mistake_is_one_line_in_a_real_process_too(tmp_path: Path) -> None:
    assert_refused(omnibench("compare", tmp_path / "nowhere.yaml"), "nowhere.yaml: no such file")


def test_nothing_typed_shows_the_help(command: Command) -> None:
    printed = command()
    assert printed.returncode == 2
    assert printed.stderr.startswith("Usage: omnibench [OPTIONS] COMMAND")
    assert "\n  compare " in printed.stderr
    assert printed.stdout == ""


def test_a_reader_that_has_gone_is_no_error(prepared: Prepared) -> None:
    shell = f"{COMMAND[0]} -m omnibench inspect {prepared.data} --json | true; exit ${{PIPESTATUS[0]}}"
    run = subprocess.run(
        ["bash", "-c", shell], env=ENVIRONMENT, capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert run.returncode in (0, 1)
    assert run.stderr == ""


@pytest.mark.parametrize("closed", [1, 2])
def test_a_stream_that_was_closed_before_the_start_is_no_traceback(closed: int) -> None:
    run = omnibench("list", preexec_fn=lambda: os.close(closed))
    assert run.returncode == 0
    assert "Traceback" not in run.stderr
    assert ("closed_form" in run.stdout) == (closed == 2)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_disk_behind_standard_output_is_one_line() -> None:
    with open("/dev/full", "w") as full:
        run = subprocess.run(
            [*COMMAND, "schema"],
            env=ENVIRONMENT,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
    assert (run.returncode, run.stderr) == (2, "error: output: No space left on device\n")


FULL = "cannot be written: File too large; free space or choose another place"


def test_a_full_disk_is_one_line_and_leaves_no_half_file(prepared: Prepared, tmp_path: Path) -> None:
    limited = functools.partial(resource.setrlimit, resource.RLIMIT_FSIZE, (100, 100))
    run = omnibench("simulate", prepared.config, "-o", tmp_path / "new", preexec_fn=limited)
    assert_refused(run, str(tmp_path / "new"), FULL)
    assert [file for file in (tmp_path / "new").rglob("*") if file.is_file()] == []


@pytest.mark.parametrize("arguments", [["calibrate", "DATA", "-o", "new/c.yaml"], ["plugin", "new", "mine"]])
def test_a_file_that_the_disk_does_not_take_is_not_there(
    arguments: list[str], command: Command, prepared: Prepared
) -> None:
    with disk_that_takes(600):  # the line on standard error
        run = command(*(str(prepared.data) if argument == "DATA" else argument for argument in arguments))
    assert_refused(run, FULL)
    assert [file for file in Path().rglob("*") if file.is_file()] == []


def test_a_calibration_that_cannot_be_written_in_the_end_is_one_line(command: Command, prepared: Prepared) -> None:
    too_long = "x" * 245 + ".yaml"  # with what is added while it is written
    run = command("calibrate", prepared.data, "-o", too_long)
    assert_refused(run, f"{too_long}: cannot be written: File name too long; choose another place\n")


@pytest.mark.parametrize("name", ["calibration", "robot", "data set", "run", "session"])
def test_a_name_of_many_letters_is_one_short_line(
    name: str, command: Command, prepared: Prepared, tmp_path: Path
) -> None:
    long, data, calibration = "x" * 100_000, tmp_path / "data", yaml.safe_load(prepared.calibration.read_text())
    shutil.copytree(prepared.data, data)
    file = tmp_path / "calibration.yaml"
    if name in ("calibration", "robot"):
        (calibration["robot"] if name == "robot" else calibration)["name"] = long
    elif name == "data set":
        header = yaml.safe_load((data / "dataset.yaml").read_text())
        (data / "dataset.yaml").write_text(yaml.safe_dump(header | {"name": long}))
    else:
        runs = pl.read_parquet(data / "trajectories.parquet")
        column = pl.lit(long).alias("trajectory" if name == "run" else "session")
        runs.with_columns(column).write_parquet(data / "trajectories.parquet")
    file.write_text(yaml.safe_dump(calibration))
    run = command("evaluate", file, data)
    assert_refused(run, str(tmp_path), "characters")
    assert len(run.stderr) < 500


def test_a_disk_that_is_full_is_said_before_the_work(prepared: Prepared, tmp_path: Path) -> None:
    mounted = ["unshare", "--map-root-user", "--mount", "sh", "-c", 'mount -t tmpfs -o size=16k none "$0" && exec "$@"']
    mounted.append(str(tmp_path))
    if subprocess.run([*mounted, "true"], capture_output=True, check=False).returncode:
        pytest.skip("a small disk cannot be mounted here")
    calibrate = [*COMMAND, "calibrate", prepared.data, "-o", tmp_path / "c.yaml", "--plugins", "none"]
    run = subprocess.run([*mounted, *calibrate], capture_output=True, text=True, env=ENVIRONMENT, check=False)
    assert_refused(run, f"{tmp_path}/c.yaml: cannot be written: No space left on device; free space or choose")


def test_a_data_set_that_does_not_fit_leaves_the_one_that_was_there(
    command: Command, prepared: Prepared, tmp_path: Path
) -> None:
    data = shutil.copytree(prepared.data, tmp_path / "data")
    with disk_that_takes(600):
        run = command("simulate", prepared.config, "-o", data, "--format", "csv", "--force")
    assert_refused(run, FULL)
    assert load_dataset(data).hash == load_dataset(prepared.data).hash


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_one_line(prepared: Prepared, tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    assert_refused(omnibench("simulate", prepared.config, "-o", tmp_path / "locked" / "x"), "Permission denied")
