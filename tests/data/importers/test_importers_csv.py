"""The csv importer: rates, angles and ticks in any units and epoch, its layouts, blank cells and names."""

import math
import re
import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from commands import refused
from corelli import CORELLI, CORELLI_OPTIONS, corelli_dataset
from drive_samples import DIFF, MODEL, PERIOD, ROBOT, drive, odometry_error
from tricycle_samples import PERIOD as LOG_PERIOD
from tricycle_samples import TRICYCLE, tricycle_drive

from omnibench.check.check import check
from omnibench.config import parse_settings
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.finding import CounterRestart
from omnibench.data.importers.csv_template import write_template
from omnibench.data.importers.dataset_folder import DatasetOptions, recordings_of
from omnibench.data.importers.tum import write_tum
from omnibench.data.runs import dataset_of
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.slam.import_dataset import import_dataset

FITS = 0.03  # m: noise of the start's heading over the way of a drive


def read(source: Path, **options: Any) -> Dataset:
    return import_dataset("csv", source, {"robot": DIFF} | options)


def wheels(seed: int, **names: str) -> pl.DataFrame:
    """Wheel rates of a drive, at 50 Hz."""
    of = drive(seed)
    frame = pl.DataFrame({"t": of.times, "omega_left": of.rates[:, 0], "omega_right": of.rates[:, 1]})
    return frame.rename(names)


def poses(seed: int, noise: float = 1.0, **names: str) -> pl.DataFrame:
    """Poses of a drive, at 10 Hz."""
    of = drive(seed, noise=noise)
    x, y, theta = of.poses.T
    return pl.DataFrame({"t": of.pose_times, "x": x, "y": y, "theta": theta}).rename(names)


def both(seed: int) -> pl.DataFrame:
    """Wheels and poses in one table, blank where a stream has no sample."""
    joined = pl.concat([make(seed).with_columns(pl.col("t").round(6)) for make in (wheels, poses)], how="diagonal")
    columns = [pl.col(name).drop_nulls().first() for name in joined.columns if name != "t"]
    return joined.group_by("t", maintain_order=True).agg(columns).sort("t")


def ids(data: Dataset) -> list[str]:
    return [run.id for run in data.trajectories]


def later(frame: pl.DataFrame, seconds: float) -> pl.DataFrame:
    return frame.with_columns(t=pl.col("t") + seconds)


def write_exact(folder: Path, name: str = "run1", seconds: float = 0.0) -> None:
    """A run's two tables, whose poses are those of the design's odometry."""
    folder.mkdir(parents=True, exist_ok=True)
    later(wheels(1), seconds).write_csv(folder / f"{name}_wheels.csv")
    later(poses(1, noise=0.0), seconds).write_csv(folder / f"{name}_poses.csv")


def test_rates_and_poses_in_si_by_any_epoch_need_nothing_but_a_robot(tmp_path: Path) -> None:
    write_exact(tmp_path)
    said = {"description": "d", "source": "s", "licence": "l"}
    data = import_dataset("csv", tmp_path, {"robot": DIFF} | said)
    assert odometry_error(data) < 1e-9
    assert data.sample_period == PERIOD
    assert data.trajectories[0].id == "run1"
    save_dataset(data, tmp_path / "data")
    again = load_dataset(tmp_path / "data")
    assert (again.hash, again.description, again.source, again.licence) == (data.hash, "d", "s", "l")
    write_exact(tmp_path, seconds=1_700_000_000.25)
    data = read(tmp_path)
    assert data.trajectories[0].pose_times[0] == 0.0
    assert odometry_error(data) < 1e-6


def test_a_run_starts_with_its_first_pose_within_a_sample_and_ends_with_its_last_sample(tmp_path: Path) -> None:
    of = drive(1, noise=0.0)
    stamps = np.arange(3.007, 19.9, 0.1)
    (path,) = MODEL.poses([WheelLog(of.times, of.rates, of.poses[0], stamps)])
    write_exact(tmp_path)
    x, y, theta = np.vstack([path, np.zeros(3)]).T  # the last pose is after the last wheel sample
    frame = pl.DataFrame({"t": np.append(stamps, 25.0), "x": x, "y": y, "theta": theta})
    frame.write_csv(tmp_path / "run1_poses.csv")
    data = read(tmp_path)
    assert data.trajectories[0].times[0] == pytest.approx(0.013)
    assert data.trajectories[0].pose_times[-1] == pytest.approx(stamps[-1] - 3.007)
    assert odometry_error(data) < 1e-9
    assert not any("left out" in warning for warning in data.warnings)


def test_columns_signs_units_and_separator_can_be_named(tmp_path: Path) -> None:
    table = wheels(1, t="stamp", omega_left="port", omega_right="starboard")
    table.with_columns(pl.col("stamp") * 1e3, -pl.col("port"), spare=0).write_csv(tmp_path / "a.rates", separator=";")
    table = poses(1, noise=0.0, t="when", x="px", y="py", theta="yaw")
    table = table.with_columns(pl.col("when") * 1e6, pl.col("px", "py") * 100, pl.col("yaw").degrees())
    table.write_csv(tmp_path / "a.slam", separator=";")
    data = read(
        tmp_path,
        wheel_suffix=".rates",
        pose_suffix=".slam",
        separator=";",
        wheel_time_column="stamp",
        wheel_time_unit="ms",
        wheel_columns=["port", "starboard"],
        wheel_signs=[-1, 1],
        pose_time_column="when",
        pose_time_unit="us",
        pose_columns=["px", "py", "yaw"],
        position_unit="cm",
        heading_unit="deg",
    )
    assert odometry_error(data) < 1e-8


def test_poses_can_be_in_tum_format(tmp_path: Path) -> None:
    write_exact(tmp_path, seconds=1e9)
    (tmp_path / "run1_poses.csv").unlink()
    of = drive(1, noise=0.0)
    write_tum(tmp_path / "run1_poses.tum", of.pose_times + 1e9, of.poses)
    assert odometry_error(read(tmp_path)) < 1e-6


def test_the_robot_can_be_a_yaml_file_by_itself_or_inside_another(tmp_path: Path) -> None:
    write_exact(tmp_path / "runs")
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(DIFF))
    alone = read(tmp_path / "runs", robot=str(tmp_path / "robot.yaml"))
    save_dataset(alone, tmp_path / "data")
    inside = read(tmp_path / "runs", robot=str(tmp_path / "data" / "dataset.yaml"))
    beside = import_dataset("csv", tmp_path / "runs")
    (tmp_path / "robot.yaml").rename(tmp_path / "runs" / "robot.yaml")
    assert import_dataset("csv", tmp_path / "runs").robot == alone.robot == inside.robot == beside.robot == ROBOT
    (tmp_path / "runs" / "robot.yaml").unlink()
    with pytest.raises(ConfigError, match="key 'robot' is missing"):
        import_dataset("csv", tmp_path / "runs")


def test_runs_share_commands_and_are_split_by_patterns_and_else_every_second_validates(tmp_path: Path) -> None:
    for name in ("day1/east_1", "day1/east_2", "day2/north_1"):
        write_exact((tmp_path / name).parent, Path(name).name)
    data = read(tmp_path, command_pattern="/(.*)_")
    assert [(run.command, run.repetition, run.split) for run in data.trajectories] == [
        ("east", 1, "train"),
        ("east", 2, "validation"),
        ("north", 1, "train"),
    ]
    assert [run.split for run in read(tmp_path).trajectories] == ["train", "validation", "train"]
    data = read(tmp_path, train="day1/*", validation=["day2/north_1"])
    assert [run.split for run in data.trajectories] == ["train", "train", "validation"]


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("wheels", "\n0.06,", "\n0.03,", r"row 3 \(line 4\): t goes backwards: 0\.03 after 0"),
        ("wheels", "\n0.06,", "\nsoon,", r"row 3 \(line 4\): t is 'soon', expected a number"),
        ("wheels", "\n0.06,", "\ninf,", r"row 3 \(line 4\): t is inf"),
        ("wheels", "\n0.06,", "\n,", r"row 3 \(line 4\): t is missing"),
        ("wheels", "\n0.06,", "\n1,2,", r"row 3 \(line 4\): it has 4 fields, expected 3"),
        ("wheels", "omega_right", "omega_wright", "column 'omega_right' is missing; .*did you mean --set"),
        ("poses", "theta", "th_deg", "column 'theta' is missing; found: t, x, y, th_deg; did you"),
        ("poses", "\n0.0,0.5,", "\n0.0,nan,", r"row 1 \(line 2\): x is nan"),
        ("poses", None, "t,x,y,theta\n", "it has no rows"),
        ("poses", None, "\udcff\udcfe\0\udc81", "cannot be read: it is not a text file"),
    ],
)
def test_a_malformed_row_is_named(tmp_path: Path, file: str, old: str | None, new: str, message: str) -> None:
    write_exact(tmp_path)
    path = tmp_path / f"run1_{file}.csv"
    assert old is None or old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1) if old else new, errors="surrogateescape")
    with refused(DataError, match=rf"run1_{file}\.csv[:,] {message}"):
        read(tmp_path)


ROSTOPIC = "%time,field.name0,field.name1,field.position0,field.position1\n" + "".join(
    f"{n}00000000,wheel_right_joint,wheel_left_joint,{n}.5,{n}\n" for n in range(1, 9)
)
MOTIVE = (
    "Format Version,1.23,Take Name,take,Rotation Type,Quaternion,a,b,c\n\n,,bot,bot,bot,bot,bot,bot,bot\n"
    "Frame,Time,X,Y,Z,W,X,Y,Z\n" + "".join(f"{n},0.{n},0,0,0,1,{n},5,0\n" for n in range(1, 9))
)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("wheels", ROSTOPIC, "t: '%time', omega_left: field.position1, .*unit=rad --set wheel_time_unit=ns"),
        ("poses", MOTIVE, "are there 4 lines above the rows[?] --set pose_header_lines=4"),
        ("poses", MOTIVE.split("\n", 3)[3], "columns={pose_t: 2, qx: 3, qy: 4, qz: 5, qw: 6, x: 7, z: 9}.* --set up=y"),
    ],
)
def test_tables_of_other_programs_are_told_how_to_be_read(tmp_path: Path, file: str, text: str, message: str) -> None:
    write_exact(tmp_path)
    (tmp_path / f"run1_{file}.csv").write_text(text)
    with refused(DataError, match=message):
        read(tmp_path)


def test_wheels_without_poses_and_poses_without_wheels_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no tables below it; .* import csv --template DIR"):
        read(tmp_path)
    write_exact(tmp_path)
    poses(1).write_csv(tmp_path / "run2_poses.csv")
    with pytest.raises(DataError, match=r"run 'run2' has no run2_wheels\.csv"):
        read(tmp_path)
    (tmp_path / "run2_poses.csv").unlink()
    later(poses(1), 1e9).write_csv(tmp_path / "run1_poses.csv")
    with pytest.raises(DataError, match=r"no two poses while the wheels were recorded") as told:
        read(tmp_path)
    offset = str(told.value).partition("--set pose_time_offset=")[2].split()[0]
    assert read(tmp_path, pose_time_offset=float(offset)).trajectories[0].has_poses
    (tmp_path / "run1_poses.csv").rename(tmp_path / "run_1_poses.csv")
    with pytest.raises(DataError, match=r"run 'run1' has no run1_poses\.csv or run1_poses\.tum"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"wheel_unit": "ticks"}, "wheel_unit ticks needs ticks_per_turn"),
        ({"ticks_per_turn": 100}, "ticks_per_turn is for wheel_unit ticks"),
        ({"wraps_at": 360}, r"wraps_at is for positions"),
        ({"wraps_at": "nver"}, r"did you mean 'never'\?"),
        ({"wheel_unit": "tics"}, r"wheel_unit: .*\(given: 'tics'\); did you mean 'ticks'\?"),
        ({"wheel_unit": "ticks", "ticks_per_turn": [1, 2, 3]}, "ticks_per_turn has 3 values, expected 2"),
        ({"gear_ratio": [1, 2, 3]}, "gear_ratio has 3 values, expected 2, .*left, right"),
        ({"steering_columns": "a"}, "steering_columns is for wheels that steer"),
        ({"separator": ", "}, "separator: .*one character, or blanks"),
        ({"wheel_columns": ["a"]}, "wheel_columns has 1 value, expected 2"),
        ({"wheel_signs": [1, 1, 1]}, "wheel_signs has 3 values, expected 2"),
        ({"pose_columns": ["x", "y"]}, "pose_columns has 2 values, expected 3"),
        ({"command_pattern": "("}, "command_pattern is not a regular expression"),
        ({"command_pattern": "^a"}, "command_pattern needs a group"),
        ({"wheel_unt": "rpm"}, "unknown key 'wheel_unt'; did you mean 'wheel_unit'"),
        ({"robot": "nowhere.yaml"}, "nowhere.yaml: no such file"),
        ({"robot": {"name": "r", "wheels": [{"name": "a", "angle_deg": "east"}]}}, "angle_deg must be a number"),
        ({"robot": {"name": "r", "wheels": [{"name": "a", "angle": 0, "angle_deg": 0}]}}, "are both given; keep one"),
        ({"train": "rum*"}, r"no run matches 'rum\*'; did you mean 'run1'"),
    ],
)
def test_wrong_options_are_refused_in_one_line(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    write_exact(tmp_path)
    with refused(ConfigError, match=message):
        read(tmp_path, **options)


def test_a_table_a_run_is_told_by_its_header(tmp_path: Path) -> None:
    for seed in (1, 2):
        both(seed).write_csv(tmp_path / f"drive{seed}.csv")
    pl.DataFrame({"t": [0.0], "voltage": [12.0]}).write_csv(tmp_path / "battery.csv")
    data = read(tmp_path)
    assert ids(data) == ["drive1", "drive2"]
    assert odometry_error(data) < FITS
    assert data.warnings[0] == "tables without columns of wheels and poses were left out: battery.csv"


def test_one_table_names_the_run_of_each_row(tmp_path: Path) -> None:
    frames = [both(seed).with_columns(run=pl.lit(f"r{seed}")) for seed in (1, 2)]
    pl.concat(frames).write_csv(tmp_path / "all.csv")
    for source in (tmp_path / "all.csv", tmp_path):
        data = read(source)
        assert ids(data) == ["r1", "r2"]
        assert odometry_error(data) < FITS


def test_three_tables_hold_wheels_poses_and_runs(tmp_path: Path) -> None:
    for make, name in ((wheels, "Wheels"), (poses, "poses")):
        made = pl.concat([make(seed, t="Clock").with_columns(Run=pl.lit(seed)) for seed in (1, 2, 3)])
        made.write_csv(tmp_path / f"{name}.CSV")
    (tmp_path / "runs.csv").write_text(
        "Run,command,repetition,split,session\n1,curve,2,train,day1\n2,curve,1,validation,day1\n3,line,1,train,\n"
    )
    data = read(tmp_path, columns={"t": "Clock"})
    assert [(run.id, run.command, run.repetition, run.split, run.session) for run in data.trajectories] == [
        ("1", "curve", 2, "train", "day1"),
        ("2", "curve", 1, "validation", "day1"),
        ("3", "line", 1, "train", None),
    ]
    assert odometry_error(data) < FITS


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_folder_a_run_holds_wheels_and_poses(tmp_path: Path, ending: str) -> None:
    for seed in (1, 2):
        (tmp_path / f"run{seed}").mkdir()
        for make, name in ((wheels, "wheels"), (poses, "poses")):
            file = tmp_path / f"run{seed}" / f"{name}.{ending}"
            make(seed).write_csv(file) if ending == "csv" else make(seed).write_parquet(file)
    if ending == "csv":
        assert ids(read(tmp_path)) == ["run1", "run2"]
    else:
        data = read(tmp_path, wheel_suffix="wheels.parquet", pose_suffix="poses.parquet")
        assert odometry_error(data) < FITS


def test_a_table_of_runs_must_list_every_run_and_its_misspelt_columns_are_said(tmp_path: Path) -> None:
    both(1).write_csv(tmp_path / "drive1.csv")
    (tmp_path / "runs.csv").write_text("run,command\ndrive2,curve\n")
    with pytest.raises(DataError, match="'drive1'; did you mean 'drive2'"):
        read(tmp_path)
    (tmp_path / "runs.csv").write_text("run,comand,driver\ndrive1,curve,me\n")
    (warning,) = read(tmp_path).warnings
    assert "runs.csv: column 'comand' is not read; did you mean 'command'?" in warning


def test_semicolons_decimal_commas_marks_and_line_ends_of_spreadsheets_are_read(tmp_path: Path) -> None:
    text = both(1).write_csv(separator=";").replace(".", ",").replace("\n", "\r\n")
    (tmp_path / "log.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    with pytest.raises(DataError, match=r"expected a number; of decimal commas say --set decimal=comma"):
        read(tmp_path)
    assert odometry_error(read(tmp_path, decimal="comma")) < FITS


def test_missing_columns_of_both_files_and_blank_cells_of_a_stream_are_named(tmp_path: Path) -> None:
    wheels(1, omega_left="speed_l").write_csv(tmp_path / "a_wheels.csv")
    poses(1, x="east").write_csv(tmp_path / "a_poses.csv")
    with pytest.raises(DataError, match=r"a_wheels\.csv: column 'omega_left' .*; and .*a_poses\.csv: column 'x' is"):
        read(tmp_path)
    made = both(1).with_columns(theta=pl.when(pl.col("t") == 1.0).then(None).otherwise(pl.col("theta")))
    made.write_csv(tmp_path / "log.csv")
    with pytest.raises(DataError, match=r"log\.csv, .*line \d+.*: theta is missing"):
        read(tmp_path / "log.csv")


def test_poses_without_values_are_left_out_and_said(tmp_path: Path) -> None:
    wheels(1).write_csv(tmp_path / "a_wheels.csv")
    lost = pl.col("t").is_between(5.0, 5.55)
    made = poses(1).with_columns(
        [pl.when(lost).then(float("nan")).otherwise(pl.col(name)).alias(name) for name in ("x", "y", "theta")]
    )
    made.write_csv(tmp_path / "a_poses.csv")
    data = read(tmp_path)
    assert data.warnings[0].endswith("a_poses.csv: 6 rows without values of the poses left out")
    assert odometry_error(data) < FITS


def test_clocks_of_other_epochs_are_matched(tmp_path: Path) -> None:
    for seed in (1, 2):
        wheels(seed).with_columns(t=pl.col("t") + 1.7e9).write_csv(tmp_path / f"r{seed}_wheels.csv")
        poses(seed).with_columns(t=pl.col("t") + 0.3).write_csv(tmp_path / f"r{seed}_poses.csv")
    typed = parse_settings(re.findall(r"--set (\S+)", refusal(tmp_path)))
    assert typed == {"pose_time_offset": 1_700_000_000, "clocks": "match"}
    for options in (typed, {"clocks": "match"}):
        assert odometry_error(read(tmp_path, **options)) < FITS
    for seed in (1, 2):
        poses(seed).with_columns(t=(pl.col("t") + 1.7e9) * 1e3).write_csv(tmp_path / f"r{seed}_poses.csv")
    assert "--set pose_time_unit=ms" in refusal(tmp_path)


@pytest.mark.parametrize("names", [{}, {"columns": {"omega_left": "l", "phi_right": "r"}}])
def test_columns_named_for_another_unit_are_taken_where_the_unit_is_said(tmp_path: Path, names: dict[str, Any]) -> None:
    made = both(1).rename({"omega_left": "l", "omega_right": "r"} if names else {})
    for column in made.columns[1:3]:
        made = made.with_columns(pl.col(column) * 60 / (2 * np.pi))
    shown = made if names else made.rename({"omega_left": "phi_left", "omega_right": "phi_right"})
    shown.write_csv(tmp_path / "log.csv")
    assert odometry_error(read(tmp_path, wheel_unit="rpm", **names)) < FITS


def test_the_words_of_runs_names_are_their_commands(tmp_path: Path) -> None:
    for seed, name in enumerate(("left_1", "left_2", "run03_right", "run04_right")):
        both(seed).write_csv(tmp_path / f"{name}.csv")
    data = read(tmp_path)
    assert [run.command for run in data.trajectories] == ["left", "left", "right", "right"]
    assert [run.split for run in data.trajectories] == ["train", "validation"] * 2
    assert data.warnings[0].startswith("commands by the names of the runs: left, right")


def test_dates_in_parquet_files_are_seconds(tmp_path: Path) -> None:
    start = pl.datetime(2024, 1, 1)
    for name, made in (("wheels", wheels(1)), ("poses", poses(1))):
        dated = made.with_columns((start + pl.duration(microseconds=(1e6 * pl.col("t")).round())).alias("t"))
        dated.write_parquet(tmp_path / f"run1_{name}.parquet")
    data = read(tmp_path, wheel_suffix="_wheels.parquet", pose_suffix="_poses.parquet")
    assert data.sample_period == pytest.approx(PERIOD, rel=1e-3)
    assert odometry_error(data) < FITS


@pytest.mark.parametrize("kind", [pl.Categorical, pl.Binary])
def test_a_column_of_parquet_that_holds_no_numbers_is_refused_in_one_line(tmp_path: Path, kind: type) -> None:
    write_exact(tmp_path)
    table = pl.read_csv(tmp_path / "run1_wheels.csv")
    (tmp_path / "run1_wheels.csv").unlink()
    table.with_columns(pl.nth(1).cast(pl.String).cast(kind)).write_parquet(tmp_path / "run1_wheels.parquet")
    with refused(DataError, match=r"run1_wheels\.parquet: cannot be read: "):
        read(tmp_path)


def test_positions_without_headings_are_shown_the_table_that_takes_them(tmp_path: Path) -> None:
    write_exact(tmp_path)
    file = tmp_path / "run1_poses.csv"
    pl.read_csv(file).drop("theta").write_csv(file)
    assert "put positions without headings into a table RUN_references.csv" in refusal(tmp_path)


@pytest.mark.parametrize("table", ["wheels", "poses"])
def test_a_table_of_one_row_is_said_to_be_one(tmp_path: Path, table: str) -> None:
    write_exact(tmp_path)
    file = tmp_path / f"run1_{table}.csv"
    pl.read_csv(file).head(1).write_csv(file)
    assert f"{table}: has one row" in refusal(tmp_path)
    wheels(1).head(15).write_csv(tmp_path / "run1_wheels.csv")  # which end before the first pose
    assert "run1" in refusal(tmp_path, wheel_time_unit="us")


def refusal(source: Path, **options: Any) -> str:
    """The line with which a recording is refused."""
    with pytest.raises(DataError) as caught:
        read(source, **options)
    return str(caught.value)


def test_what_is_suggested_for_foreign_columns_reads_them_as_it_is_typed(tmp_path: Path) -> None:
    names = {"t": "Time [ms]", "omega_left": "LEFT SPEED", "omega_right": "RIGHT SPEED", "x": "X [mm]", "y": "Y [mm]"}
    scaled = [pl.col("t") * 1e3, pl.col("x") * 1e3, pl.col("y") * 1e3, pl.col("theta").degrees()]
    both(1).with_columns(scaled).rename(names | {"theta": "Yaw [°]"}).write_csv(tmp_path / "log.csv")
    words = shlex.split(refusal(tmp_path).partition("did you mean ")[2].removesuffix("?"))
    typed = parse_settings([word for word in words if word != "--set"])
    assert typed["columns"]["x"] == "X [mm]"
    assert odometry_error(read(tmp_path, **typed)) < FITS


def test_units_in_names_of_columns_are_not_read_as_others_unless_they_are_said(tmp_path: Path) -> None:
    both(1).rename({"x": "x (mm)", "theta": "heading deg"}).write_csv(tmp_path / "log.csv")
    columns = {"x": "x (mm)", "theta": "heading deg"}
    line = refusal(tmp_path, columns=columns)
    assert "(x (mm), heading deg): --set position_unit=mm --set heading_unit=deg; or say" in line
    assert odometry_error(read(tmp_path, columns=columns, position_unit="m", heading_unit="rad")) < FITS


def test_a_table_whose_times_begin_anew_is_refused_with_the_column_that_names_its_runs(tmp_path: Path) -> None:
    pl.concat([both(seed).with_columns(Lauf=pl.lit(f"r{seed}")) for seed in (1, 2)]).write_csv(tmp_path / "all.csv")
    assert refusal(tmp_path).endswith("does Lauf name the run of each row? --set run_column=Lauf")
    assert ids(read(tmp_path, run_column="Lauf")) == ["r1", "r2"]
    assert "column 'Lauv' is missing; did you mean 'Lauf'?" in refusal(tmp_path, run_column="Lauv")


def test_poses_in_the_rows_of_the_wheels_may_have_a_clock_of_their_own(tmp_path: Path) -> None:
    apart = pl.concat([wheels(1), poses(1, t="camera")], how="diagonal")
    apart.write_csv(tmp_path / "log.csv")
    assert refusal(tmp_path).endswith('of their own, --set "columns={pose_t: NAME}"')
    assert odometry_error(read(tmp_path, columns={"pose_t": "camera"})) < FITS


def test_wheels_and_poses_apart_under_other_names_are_refused_with_the_endings_to_say(tmp_path: Path) -> None:
    wheels(1).write_csv(tmp_path / "encoders.csv")
    poses(1).write_csv(tmp_path / "camera.csv")
    assert "encoders.csv holds wheels and camera.csv poses; call them" in refusal(tmp_path)
    assert odometry_error(read(tmp_path, wheel_suffix="encoders.csv", pose_suffix="camera.csv")) < FITS


# The csv importer on other people's logs: one table of wheels and poses, steered wheels, counters of any kind.

DRIVE = tricycle_drive()


def write_table(file: Path, columns: Mapping[str, Array], rows: Any = slice(None)) -> Path:
    lines = [",".join(f"{value:.12g}" for value in row) for row in np.column_stack(list(columns.values()))[rows]]
    file.write_text("\n".join([",".join(columns), *lines]) + "\n")
    return file


def log(folder: Path, rows: Any = slice(None), **columns: Array) -> Path:
    """The drive as a table, with other columns."""
    return write_table(folder / "log.csv", dict(DRIVE) | columns, rows)


def read_log(source: Path, **options: Any) -> Dataset:
    """A table with the columns of ``tricycle_drive``, unless the options say otherwise."""
    named = {"robot": TRICYCLE, "wheel_columns": "angle", "steering_columns": "phi", "wheel_unit": "rad"}
    given = {name: value for name, value in (named | options).items() if value is not None}
    return import_dataset("csv", source, given)


def log_error(data: Dataset, runs: int = 1) -> float:
    """Largest difference of the design's odometry from the reference at any pose."""
    assert len(data.trajectories) == runs
    model = OdometryModel.of_design(data.robot, "arc")
    return max(float(np.abs(model.poses([run.reference_log])[0] - run.poses[1:]).max()) for run in data.trajectories)


def test_one_table_may_hold_wheels_steering_and_poses(tmp_path: Path) -> None:
    columns = {"t": DRIVE["t"], "phi_front": DRIVE["angle"], "steer_front": DRIVE["phi"]}
    poses = {key: DRIVE[key] for key in ("x", "y", "theta")}
    unnamed = {"wheel_columns": None, "steering_columns": None}
    data = read_log(write_table(tmp_path / "log.csv", columns | poses), **unnamed)
    assert log_error(data) < 1e-9
    assert data.trajectories[0].id == "log"
    whole = read_log(tmp_path, wheel_suffix=".csv", pose_suffix=".csv", **unnamed)
    assert whole.trajectories[0].fingerprint == data.trajectories[0].fingerprint


INCREMENTS = np.diff(DRIVE["angle"], prepend=0.0)
TURN = 2 * math.pi


@pytest.mark.parametrize(
    ("angle", "options"),
    [
        (DRIVE["angle"] / TURN, {"wheel_unit": "rev"}),
        (np.degrees(DRIVE["angle"]) % 360, {"wheel_unit": "deg", "wraps_at": 360}),
        (DRIVE["angle"] * 30 * 180 / math.pi, {"wheel_unit": "deg", "gear_ratio": 30}),
        (DRIVE["angle"] * 30 * 2048 / TURN, {"wheel_unit": "ticks", "ticks_per_turn": 2048, "gear_ratio": [30]}),
        (DRIVE["angle"] * 61440 / TURN, {"wheel_unit": "ticks", "ticks_per_turn": 61440}),
        (-DRIVE["angle"], {"wheel_signs": -1}),
        (INCREMENTS / LOG_PERIOD * 30 * 60 / TURN, {"wheel_unit": "rpm", "gear_ratio": 30}),
        (np.degrees(INCREMENTS) / LOG_PERIOD, {"wheel_unit": "deg/s"}),
        (INCREMENTS / TURN, {"wheel_unit": "rev/sample"}),
        (INCREMENTS * 4096 / TURN, {"wheel_unit": "ticks/sample", "ticks_per_turn": 4096}),
    ],
)
def test_positions_rates_and_steps_in_any_unit_agree(tmp_path: Path, angle: Array, options: dict[str, Any]) -> None:
    data = read_log(log(tmp_path, angle=angle), **options)
    assert log_error(data) < 1e-8
    kept, positions = data.trajectories[0].angles, options.get("wheel_unit") in ("rev", "deg", "ticks", None)
    assert (kept is not None) == positions
    if positions:
        np.testing.assert_allclose(np.diff(kept[:, 0]), np.diff(DRIVE["angle"][1:]), atol=1e-9)


@pytest.mark.parametrize(("bits", "signed", "option"), [(16, False, "auto"), (16, True, "2^16"), (32, True, "auto")])
def test_counters_begin_again_at_any_power_of_two(tmp_path: Path, bits: int, signed: bool, option: str) -> None:
    ticks = np.floor(DRIVE["angle"] * 30 * 2048 / (2 * math.pi))
    ticks = (ticks + 2**bits - 20000) % 2**bits - (2 ** (bits - 1) if signed else 0)
    options = {"wheel_unit": "ticks", "ticks_per_turn": 2048, "gear_ratio": 30, "wraps_at": option}
    data = read_log(log(tmp_path, angle=ticks), **options)
    assert log_error(data) < 1e-3
    said = f"wheel positions begin again after {2**bits} ticks and were counted on (wraps_at={2**bits} says so)"
    assert (said in data.warnings) == (option == "auto" and np.ptp(ticks) > 2 ** (bits - 1))


def test_a_wrong_wrap_and_ticks_taken_for_radians_or_without_their_gear_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"log\.csv: wraps_at is 100, but positions span \d+\.\d+ rad"):
        read_log(log(tmp_path), wraps_at=100)
    source = log(tmp_path, angle=np.floor(DRIVE["angle"] * 30 * 2048 / TURN))
    with pytest.raises(DataError, match=r"log\.csv: .*--set wheel_unit=ticks --set ticks_per"):
        read_log(source)
    with pytest.raises(DataError, match=r"turn at up to 330 rad/s; --set ticks_per_turn=N, gear_ratio=N"):
        read_log(source, wheel_unit="ticks", ticks_per_turn=2048)


def test_a_counter_that_is_set_to_zero_ends_a_run(tmp_path: Path) -> None:
    angle = DRIVE["angle"] - np.where(np.arange(401) >= 200, DRIVE["angle"][200], 0)
    data = read_log(log(tmp_path, angle=angle))
    assert log_error(data, runs=2) < 0.01
    assert [(run.id, run.session) for run in data.trajectories] == [("log#1", "log"), ("log#2", "log")]
    assert "the positions begin anew 1 time, faster than any wheel turns" in data.warnings[0]
    assert any(isinstance(warning, CounterRestart) for warning in data.warnings)


@pytest.mark.parametrize(("left", "right"), [([40], [40]), ([40, 90], [60, 61])])
def test_single_readings_of_0_are_left_out_and_said_also_of_a_wheel_that_stands(
    tmp_path: Path, left: list[int], right: list[int]
) -> None:
    times = np.arange(0.0, 8.0, 0.05)
    drives, stands = 5000 + np.floor(1000 * times), np.full(len(times), 5683.0)
    drives[left], stands[right] = 0.0, 0.0
    poses = dict.fromkeys(("x", "y", "theta"), 0 * times)
    write_table(tmp_path / "log.csv", {"t": times, "phi_left": drives, "phi_right": stands, **poses})
    data = read(tmp_path / "log.csv", wheel_unit="ticks", ticks_per_turn=1440)
    assert ids(data) == ["log"]
    count = len(left) + len(right)
    assert f"{count} single readings of wheel positions that jump and return left out" in str(data.warnings)
    assert data.trajectories[0].rates[:, 1].tolist() == [0.0] * (len(times) - len({*left, *right}) - 1)


def test_single_readings_of_the_other_sign_are_no_end_of_a_counter(tmp_path: Path) -> None:
    times = np.arange(0.0, 8.0, 0.05)
    counts = 10_000 + np.floor(1000 * times)
    counts[127] = -counts[127]  # 16,350 ticks: the step is as long as a range of 2^15
    poses = dict.fromkeys(("x", "y", "theta"), 0 * times)
    write_table(tmp_path / "log.csv", {"t": times, "phi_left": counts, "phi_right": counts[0] + 0 * times, **poses})
    data = read(tmp_path / "log.csv", wheel_unit="ticks", ticks_per_turn=1440)
    assert "begin again" not in str(data.warnings)
    assert "1 single reading of wheel positions" in str(data.warnings)


def test_rows_that_repeat_a_time_or_the_wheels_while_they_turned_are_left_out_and_said(tmp_path: Path) -> None:
    twice = np.sort(np.append(np.arange(401), [7, 7, 50]))
    data = read_log(log(tmp_path, twice))
    assert data.warnings[0].endswith("log.csv: 3 rows that repeat the t of the one before left out")
    assert log_error(data) < 1e-9
    with pytest.raises(DataError, match=r"log\.csv, row 2 \(line 3\): t is repeated: 100 after 100"):
        read_log(log(tmp_path, t=np.floor(DRIVE["t"])))
    before = np.arange(401)
    before[[60, 150]] -= 1
    data = read_log(log(tmp_path, angle=DRIVE["angle"][before], phi=DRIVE["phi"][before]))
    assert "log.csv: 2 readings that repeat the ones before" in data.warnings[0]
    assert len(data.trajectories[0].times) == 398
    assert log_error(data) < 0.01


@pytest.mark.parametrize(
    ("shown", "options"),
    [
        (np.degrees(DRIVE["phi"]), {"steering_unit": "deg"}),
        (-DRIVE["phi"] - math.radians(10), {"steering_signs": -1, "steering_offsets_deg": -10}),
        (DRIVE["phi"] * 10 % (2 * math.pi), {"steering_scale": 0.1}),
        (
            np.floor(DRIVE["phi"] / (2 * math.pi) * 4 * 8192) % 8192,
            {"steering_unit": "ticks", "steering_ticks_per_turn": 8192, "steering_scale": [0.25]},
        ),
    ],
    ids=["degrees", "clockwise from another zero", "absolute behind a gear", "ticks of an absolute encoder"],
)
def test_steering_angles_in_any_unit_are_the_same(tmp_path: Path, shown: Array, options: dict[str, Any]) -> None:
    data = read_log(log(tmp_path, phi=shown), **options)
    steering = data.trajectories[0].steering
    np.testing.assert_allclose(steering[:, 0], DRIVE["phi"][1:], atol=2e-4)


@pytest.mark.parametrize("step", [1, 5])
def test_a_steering_column_in_degrees_is_found_however_coarse_the_samples_are(tmp_path: Path, step: int) -> None:
    data = read_log(log(tmp_path, slice(None, None, step), phi=np.degrees(DRIVE["phi"])))
    assert "steering_unit=deg" in {finding.fix for finding in check(data).findings}


def test_a_recording_is_cut_into_equal_runs(tmp_path: Path) -> None:
    data = read_log(log(tmp_path))
    save_dataset(data, tmp_path / "data")
    assert load_dataset(tmp_path / "data").hash == data.hash
    data = read_log(log(tmp_path), window=9)
    assert [run.id for run in data.trajectories] == ["log#1", "log#2"]
    assert log_error(data, runs=2) < 0.01
    assert [(run.split, run.session, run.started_at) for run in data.trajectories] == [
        ("train", "log", 0),
        ("validation", "log", pytest.approx(10)),
    ]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, r"'omega_front' and 'steer_front' are missing; .*\"columns={omega_front: NAME, steer_front: NAME}"),
        ({"header_lines": 0}, r"it has no header and 6 columns; .* t, omega_front, steer_front, x, y"),
        ({"header_lines": 0, "wheel_time_column": 1}, r"which of them are omega_front, steer_front, x, y, theta"),
        ({"wheel_columns": "angle", "steering_columns": 9}, r"column '9' is missing; found: t, angle, phi"),
    ],
)
def test_a_foreign_table_is_refused_with_its_options(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    unnamed = {"wheel_columns": None, "steering_columns": None, "wheel_unit": None}
    with refused(DataError, match=message):
        read_log(log(tmp_path), **(unnamed | options))


def errors(run: Trajectory, robot: dict[str, Any]) -> Array:
    model = OdometryModel.of_design(import_dataset("csv", CORELLI, CORELLI_OPTIONS | {"robot": robot}).robot, "arc")
    distances: Array = np.hypot(*(model.poses([run.reference_log])[0] - run.poses[1:])[:, :2].T)
    return distances


def test_the_design_of_another_laboratory_s_tricycle_is_its_own_model() -> None:
    """The robot's own pose, of its rear axle, in the log: this is odometry by Euler steps, printed to 6 digits."""
    robot = CORELLI_OPTIONS["robot"] | {"mount": {"x": 0}}
    options = {"pose_columns": [7, 8, 9], "robot": robot, "wraps_at": "2^32"}  # it lost turns of its register, too
    distances = errors(import_dataset("csv", CORELLI, CORELLI_OPTIONS | options).trajectories[0], robot)
    assert distances.mean() < 0.005
    assert distances.max() < 0.04


def test_the_steering_scale_of_another_laboratory_s_tricycle_is_told_relative_to_that_of_the_import() -> None:
    fixes = {finding.kind: finding.fix for finding in check(corelli_dataset()).findings}
    assert fixes["steering_unit"] == "steering_scale=0.491"
    found = check(corelli_dataset(steering_scale=0.5)).findings
    assert not [finding for finding in found if "steering" in finding.kind]


def test_the_first_guesses_of_another_laboratory_s_tricycle_are_far_off() -> None:
    data = corelli_dataset()
    for warning, part in zip(
        data.warnings,
        ("4294967296 ticks", "4 steps of wheel positions ran back", "51 readings that repeat"),
        strict=False,
    ):
        assert part in warning
    restarts = [warning for warning in data.warnings if isinstance(warning, CounterRestart)]
    assert restarts == [data.warnings[1]]
    (run,) = data.trajectories
    assert (len(run.times), len(run.pose_times)) == (2382, 2434)
    assert errors(run, CORELLI_OPTIONS["robot"]).mean() == pytest.approx(14.33, abs=0.01)


# Distances, turns, positions and headings in tables beside those of the wheels, in the place of poses or with them.

TAPE = "kind,value,sigma\ndistance,1.01,0.003\n"


def wheel_table(zero: float = 0.0, rates: tuple[float, float] = (4.0, 4.0)) -> str:
    """Five seconds of wheels at 20 Hz from a time on, s."""
    rows = [f"{zero + 0.05 * k:.3f},{rates[0]},{rates[1]}" for k in range(1, 101)]
    return "\n".join(["t,omega_left,omega_right", *rows]) + "\n"


def of_two_runs(column: str) -> str:
    """One table of the wheels of runs a and b, which a column names."""
    header, *rows = wheel_table().splitlines()
    return "\n".join([f"{column},{header}", *(f"{run},{row}" for run in "ab" for row in rows)])


def write(folder: Path, **tables: str) -> Path:
    """A folder with tables by their names without .csv."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in tables.items():
        (folder / f"{name}.csv").write_text(text)
    return folder


def the_run(source: Path, **options: Any) -> Trajectory:
    (run,) = read(source, **options).trajectories
    return run


def measured(run: Trajectory) -> list[tuple[str, float, float, float]]:
    """Kind, t0, t1 and first value of each reference of a run."""
    assert run.references is not None
    its = run.references
    return list(zip(its.kinds.tolist(), its.t0.tolist(), its.t1.tolist(), its.values[:, 0].tolist(), strict=True))


def test_a_run_with_references_needs_no_poses_and_one_table_holds_those_of_all_runs(tmp_path: Path) -> None:
    run = the_run(write(tmp_path / "one", a_wheels=wheel_table(), a_references=TAPE))
    assert not run.has_poses
    assert measured(run) == [("distance", 0.0, 5.0, 1.01)]
    table = "run,kind,value,sigma\nb,turn,3.1,0.01\na,distance,1.0,0.003\nb,turn,3.2,0.01\n"
    source = write(tmp_path / "all", a_wheels=wheel_table(), b_wheels=wheel_table(0.0, (-2, 2)), references=table)
    runs = read(source).trajectories
    assert [[kind for kind, *_ in measured(run)] for run in runs] == [["distance"], ["turn", "turn"]]


def test_references_that_do_not_name_their_run_are_not_taken_for_those_of_every_run(tmp_path: Path) -> None:
    told = "Name,Kind,Value,Sigma\na,distance,1.0,0.003\nb,distance,1.1,0.003\n"
    source = write(tmp_path, log=of_two_runs("Lauf"), references=told)
    with pytest.raises(DataError, match=r"references\.csv: column 'Lauf' is missing; .* --set run_column=NAME"):
        read(source, run_column="Lauf")
    write(tmp_path, log=of_two_runs("run"))
    with pytest.raises(DataError, match=r"references\.csv: column 'run' is missing, .*; --set run_column=NAME"):
        read(source)
    runs = read(write(tmp_path, references=told.replace("Name", "Run"))).trajectories
    assert [(run.id, measured(run)[0][3]) for run in runs] == [("a", 1.0), ("b", 1.1)]


def test_some_runs_have_poses_and_others_references(tmp_path: Path) -> None:
    poses = "t,x,y,theta\n0,0,0,0\n2.5,0.5,0.001,0\n5,1.001,0,0.001\n"
    source = write(tmp_path, a_wheels=wheel_table(), a_poses=poses, b_wheels=wheel_table(), b_references=TAPE)
    posed, taped = read(source).trajectories
    assert (posed.has_poses, posed.references) == (True, None)
    assert (taped.has_poses, len(measured(taped))) == (False, 1)


def test_references_are_read_in_the_units_and_senses_of_the_options(tmp_path: Path) -> None:
    table = (
        "kind,t1,value,value_x,value_y,sigma\ndistance,,1010,,,3\nturn,,90,,,1\n"
        "position,2,,1000,500,20\nheading,3,10,,,2\n"
    )
    options = {"position_unit": "mm", "heading_unit": "deg", "pose_signs": (1, -1, -1), "heading_offset_deg": 90}
    references = the_run(write(tmp_path, a_wheels=wheel_table(), a_references=table), **options).references
    values = dict(zip(references.kinds.tolist(), references.values.tolist(), strict=True))
    assert values["distance"][0] == pytest.approx(1.01)
    assert values["turn"][0] == pytest.approx(-np.pi / 2)
    assert values["position"] == pytest.approx([1.0, -0.5])
    assert values["heading"][0] == pytest.approx(np.radians(80))
    sigmas = dict(zip(references.kinds.tolist(), references.sigmas[:, 0].tolist(), strict=True))
    assert sigmas == pytest.approx(
        {"distance": 0.003, "turn": np.radians(1), "position": 0.02, "heading": np.radians(2)}
    )


def test_times_of_references_are_by_the_clock_of_the_recording(tmp_path: Path) -> None:
    table = "kind,t0,t1,value,value_x,value_y,sigma\nposition,,1700000002500,,0.5,0,0.02\n"
    table += "turn,1700000001000,1700000003000,0.0,,,0.01\n"
    source = write(tmp_path, a_wheels=wheel_table(1_700_000_000.0), a_references=table)
    run = the_run(source, pose_time_unit="ms", pose_time_offset=0.5)
    assert [(kind, pytest.approx(t0), pytest.approx(t1)) for kind, t0, t1, _ in measured(run)] == [
        ("position", 3.0, 3.0),
        ("turn", 1.5, 3.5),
    ]


def test_a_heading_from_zero_on_counts_from_the_start_of_the_run(tmp_path: Path) -> None:
    table = "kind,t0,t1,value,sigma\nheading,0,12,0.1,0.05\nheading,,13,0.2,0.05\n"
    run = the_run(write(tmp_path, a_wheels=wheel_table(10.0), a_references=table))
    assert [each[:2] for each in measured(run)] == [("heading", 0.0), ("heading", pytest.approx(3.0))]


def test_a_pose_at_the_start_alone_makes_the_frame_of_positions_known(tmp_path: Path) -> None:
    table = "kind,t1,value_x,value_y,sigma\nposition,5,3,4,0.01\n"
    source = write(tmp_path, a_wheels=wheel_table(), a_references=table, a_poses="t,x,y,theta\n0,2,4,0\n")
    run = the_run(source)
    assert run.start_known
    assert run.start.tolist() == [2.0, 4.0, 0.0]


def test_references_outside_of_the_wheels_are_left_out_and_said(tmp_path: Path) -> None:
    table = "kind,t1,value_x,value_y,sigma\nposition,2,0.4,0,0.01\nposition,9,1,0,0.01\n"
    dataset = read(write(tmp_path, a_wheels=wheel_table(), a_references=table))
    assert len(measured(dataset.trajectories[0])) == 1
    assert any("1 of 2 references left out" in warning for warning in dataset.warnings)


def test_a_recording_cut_into_windows_keeps_the_references_within_each(tmp_path: Path) -> None:
    table = "kind,t0,t1,value,sigma\ndistance,0.5,2,0.3,0.003\ndistance,3,4.5,0.3,0.003\ndistance,,,1,0.003\n"
    runs = read(write(tmp_path, a_wheels=wheel_table(), a_references=table), window=2.5).trajectories
    assert [measured(run) for run in runs] == [
        [("distance", 0.5, 2.0, 0.3)],
        [("distance", pytest.approx(0.5), pytest.approx(2.0), 0.3)],
    ]


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"a_references": "kind,value,sigma\ndistnace,1,0.1\n"}, r"row 1 \(line 2\): .*did you mean 'distance'"),
        ({"a_references": "kind,value\ndistance,1\n"}, "sigma is missing"),
        ({"a_references": "value,sigma\n1,0.1\n"}, "column 'kind' is missing"),
        ({"a_references": "kind,t1,value,sigma\nheading,90,1,0.1\n"}, "none of its references lies within"),
        ({"references": "run,kind,value,sigma\nb,distance,1,0.1\n"}, "run 'a' is not in its column run"),
        ({"references": "run,kind,value,sigma\na,turn,1,0.1\nab,turn,1,0.1\n"}, "'ab' has no wheels; did you mean 'a'"),
        ({"references": TAPE, "b_wheels": wheel_table()}, "column 'run' is missing"),
        ({"b_references": TAPE}, "run 'a' has no a_poses.csv"),
        ({"a_references": TAPE, "b_references": TAPE}, "run 'b' has no b_wheels.csv"),
    ],
)
def test_what_is_wrong_with_references_is_said_in_one_line(tmp_path: Path, tables: dict[str, str], words: str) -> None:
    source = write(tmp_path, a_wheels=wheel_table(), **tables)
    with refused(DataError, match=words):
        read(source)


@pytest.mark.parametrize("robot_type", ["diff", "omni3", "swerve"])
def test_the_template_with_references_imports_as_it_is_written(tmp_path: Path, robot_type: str) -> None:
    write_template(tmp_path / "log", robot_type, references=True)
    dataset = import_dataset("csv", tmp_path / "log")
    assert dataset.warnings == ()
    kinds = {kind for run in dataset.trajectories for kind, *_ in measured(run)}
    assert {"distance", "turn"} <= kinds
    assert not any(run.has_poses for run in dataset.trajectories)


def reread(folder: Path, **options: Any) -> Dataset:
    """A data set on disk by the importer ``dataset``."""
    return import_dataset("dataset", folder, options)


def test_the_importer_of_data_sets_keeps_references_to_the_bit(tmp_path: Path) -> None:
    write_template(tmp_path / "log", "omni3", references=True)
    dataset = import_dataset("csv", tmp_path / "log")
    save_dataset(dataset, tmp_path / "old")
    assert reread(tmp_path / "old").hash == dataset.hash
    cut = reread(tmp_path / "old", jumps="cut", start_at_rest=True, clocks="match", pose_time_offset=0.1)
    assert [len(measured(run)) for run in cut.trajectories] == [1] * 10


def test_a_data_set_read_in_other_units_has_its_references_in_them_too(tmp_path: Path) -> None:
    source = write(tmp_path / "log", a_wheels=wheel_table(), a_references="kind,value,sigma\ndistance,1010,3\n")
    assert [finding.fix for finding in check(read(source)).findings][:1] == ["position_unit=mm"]
    save_dataset(read(source), tmp_path / "old")
    (run,) = reread(tmp_path / "old", position_unit="mm").trajectories
    assert measured(run) == [("distance", 0.0, 5.0, pytest.approx(1.01))]


def test_a_run_of_a_data_set_that_is_cut_keeps_the_references_of_each_part(tmp_path: Path) -> None:
    rows = wheel_table().splitlines(keepends=True)
    with_gap = "".join(row for row in rows if not row.startswith(("2.1", "2.2", "2.3")))
    table = "kind,t0,t1,value,sigma\ndistance,0.5,2,0.3,0.003\ndistance,3,4.5,0.3,0.003\ndistance,,,1,0.003\n"
    save_dataset(read(write(tmp_path / "log", a_wheels=with_gap, a_references=table)), tmp_path / "old")
    runs = reread(tmp_path / "old", longest_gap=0.2).trajectories
    assert [(run.id, len(measured(run))) for run in runs] == [("a#1", 1), ("a#2", 1)]


def test_a_data_set_with_times_in_ms_has_its_references_in_seconds_too(tmp_path: Path) -> None:
    table = "kind,t0,t1,value,sigma\ndistance,500,2000,0.3,0.003\ndistance,,,1,0.003\n"
    run = the_run(write(tmp_path / "log", a_wheels=wheel_table(), a_references=table), pose_time_unit="ms")
    slow = replace(run, references=replace(run.references, t0=run.references.t0 * 1e3, t1=run.references.t1 * 1e3))
    options = DatasetOptions(robot=ROBOT, wheel_time_unit="ms", pose_time_unit="ms")
    dataset = Dataset("slow", ROBOT, 1.0, (replace(slow, times=run.times * 1e3),))
    recordings = recordings_of(dataset, options)
    (mended,) = dataset_of(recordings, options, []).trajectories
    assert measured(mended) == [(kind, pytest.approx(t0), pytest.approx(t1), v) for kind, t0, t1, v in measured(run)]
