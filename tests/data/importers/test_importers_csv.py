"""The csv importer: rates, angles and ticks in any units and epoch, its layouts, blank cells and names."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from drive_samples import DIFF, MODEL, PERIOD, ROBOT, drive, odometry_error

from omnibench.config import parse_settings
from omnibench.data.dataset import Dataset
from omnibench.data.importers.tum import write_tum
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
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
    joined = pl.concat([_stamped(wheels(seed)), _stamped(poses(seed))], how="diagonal")
    columns = [pl.col(name).drop_nulls().first() for name in joined.columns if name != "t"]
    return joined.group_by("t", maintain_order=True).agg(columns).sort("t")


def _stamped(frame: pl.DataFrame) -> pl.DataFrame:
    return frame.with_columns(pl.col("t").round(6))


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
    with pytest.raises(DataError, match=rf"run1_{file}\.csv[:,] {message}") as caught:
        read(tmp_path)
    assert "\n" not in str(caught.value)


def test_wheels_without_poses_and_poses_without_wheels_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no tables below it; .* import csv --template DIR"):
        read(tmp_path)
    write_exact(tmp_path)
    poses(1).write_csv(tmp_path / "run2_poses.csv")
    with pytest.raises(DataError, match=r"run 'run2' has no run2_wheels\.csv"):
        read(tmp_path)
    (tmp_path / "run2_poses.csv").unlink()
    later(poses(1), 1e9).write_csv(tmp_path / "run1_poses.csv")
    with pytest.raises(DataError, match=r"no two poses while the wheels were recorded") as refused:
        read(tmp_path)
    offset = str(refused.value).partition("--set pose_time_offset=")[2].split()[0]
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
    with pytest.raises(ConfigError, match=message) as caught:
        read(tmp_path, **options)
    assert "\n" not in str(caught.value)


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
    assert "look like ms: --set pose_time_unit=ms" in refusal(tmp_path)


@pytest.mark.parametrize("names", [{}, {"columns": {"omega_left": "l", "phi_right": "r"}}])
def test_columns_named_for_another_unit_are_taken_where_the_unit_is_said(tmp_path: Path, names: dict[str, Any]) -> None:
    made = both(1).rename({"omega_left": "l", "omega_right": "r"} if names else {})
    for column in made.columns[1:3]:
        made = made.with_columns(pl.col(column) * 60 / (2 * np.pi))
    shown = made if names else made.rename({"omega_left": "phi_left", "omega_right": "phi_right"})
    shown.write_csv(tmp_path / "log.csv")
    assert odometry_error(read(tmp_path, wheel_unit="rpm", **names)) < FITS


def test_names_that_look_like_repetitions_are_told_with_the_pattern_to_type(tmp_path: Path) -> None:
    for seed, name in enumerate(("left_1", "left_2", "right_1", "right_2")):
        both(seed).write_csv(tmp_path / f"{name}.csv")
    (told,) = read(tmp_path).warnings
    assert "look like repetitions of 2 commands" in told
    pattern = told.partition("command_pattern=")[2].partition("'")[0]
    runs = read(tmp_path, command_pattern=pattern).trajectories
    assert [run.command for run in runs] == ["left", "left", "right", "right"]


def test_dates_in_parquet_files_are_seconds(tmp_path: Path) -> None:
    start = pl.datetime(2024, 1, 1)
    for name, made in (("wheels", wheels(1)), ("poses", poses(1))):
        dated = made.with_columns((start + pl.duration(microseconds=(1e6 * pl.col("t")).round())).alias("t"))
        dated.write_parquet(tmp_path / f"run1_{name}.parquet")
    data = read(tmp_path, wheel_suffix="_wheels.parquet", pose_suffix="_poses.parquet")
    assert data.sample_period == pytest.approx(PERIOD, rel=1e-3)
    assert odometry_error(data) < FITS


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
