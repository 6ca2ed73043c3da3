"""The csv importer's layouts: a pair a run, a table a run, one table, three; blank cells, names and units."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from drive_samples import DIFF, PERIOD, drive, odometry_error

from omnibench.config import parse_settings
from omnibench.data.dataset import Dataset
from omnibench.errors import ConfigError, DataError
from omnibench.robot.kinematics import Array
from omnibench.slam.import_dataset import import_dataset

FITS = 0.03  # m: noise of the start's heading over the way of a drive


def read(source: Path, **options: Any) -> Dataset:
    return import_dataset("csv", source, {"robot": DIFF} | options)


def wheels(seed: int, **names: str) -> pl.DataFrame:
    """Wheel rates of a drive, at 50 Hz."""
    of = drive(seed)
    frame = pl.DataFrame({"t": of.times, "omega_left": of.rates[:, 0], "omega_right": of.rates[:, 1]})
    return frame.rename(names)


def poses(seed: int, **names: str) -> pl.DataFrame:
    """Poses of a drive, at 10 Hz."""
    of = drive(seed)
    x, y, theta = of.poses.T
    return pl.DataFrame({"t": of.pose_times, "x": x, "y": y, "theta": theta}).rename(names)


def both(seed: int) -> pl.DataFrame:
    """Wheels and poses in one table, blank where a stream has no sample."""
    joined = pl.concat([_stamped(wheels(seed)), _stamped(poses(seed))], how="diagonal")
    columns = [pl.col(name).drop_nulls().first() for name in joined.columns if name != "t"]
    return joined.group_by("t", maintain_order=True).agg(columns).sort("t")


def _stamped(frame: pl.DataFrame) -> pl.DataFrame:
    return frame.with_columns(pl.col("t").round(6))


def quarter_ticks(seed: int, turn: int = 1000) -> Array:
    """Counts of both wheels at the ends of the samples."""
    of = drive(seed)
    return np.floor(np.cumsum(of.rates * PERIOD, axis=0) / (2 * np.pi) * turn)


def ids(data: Dataset) -> list[str]:
    return [run.id for run in data.trajectories]


def write_pair(folder: Path, seed: int, turning: float = 0.0) -> None:
    """A run's two tables, with wheels that turn by so much, rad/s, all the time."""
    of = wheels(seed).with_columns(pl.col("omega_left", "omega_right") + turning)
    of.write_csv(folder / f"run{seed}_wheels.csv")
    poses(seed).write_csv(folder / f"run{seed}_poses.csv")


def test_runs_that_never_rest_are_left_out_where_runs_begin_at_rest(tmp_path: Path) -> None:
    write_pair(tmp_path, 1, turning=1.0)
    write_pair(tmp_path, 2)
    data = read(tmp_path, start_at_rest=True)
    assert ids(data) == ["run2"]
    assert any(warning.startswith("run1: left out: it never stands still") for warning in data.warnings)


def test_no_run_that_rests_is_said_with_the_option_that_asks_for_it(tmp_path: Path) -> None:
    write_pair(tmp_path, 1, turning=1.0)
    with pytest.raises(DataError, match="no run stands still before it drives, so that start_at_rest leaves none"):
        read(tmp_path, start_at_rest=True)


def test_a_robot_that_is_not_named_is_said(tmp_path: Path) -> None:
    write_pair(tmp_path, 1)
    with pytest.raises(ConfigError, match=r"robot: nothing is given; name the robot's YAML file, as robot=robot\.yaml"):
        read(tmp_path, robot=None)


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
    for make, name in ((wheels, "wheels"), (poses, "poses")):
        pl.concat([make(seed).with_columns(run=pl.lit(seed)) for seed in (1, 2, 3)]).write_csv(tmp_path / f"{name}.csv")
    (tmp_path / "runs.csv").write_text(
        "run,command,repetition,split,session\n1,curve,2,train,day1\n2,curve,1,validation,day1\n3,line,1,train,\n"
    )
    data = read(tmp_path)
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


def test_a_table_of_runs_must_list_every_run(tmp_path: Path) -> None:
    both(1).write_csv(tmp_path / "drive1.csv")
    (tmp_path / "runs.csv").write_text("run,command\ndrive2,curve\n")
    with pytest.raises(DataError, match="does not list run 'drive1'; did you mean 'drive2'"):
        read(tmp_path)


def test_a_misspelt_column_of_the_table_of_runs_is_said(tmp_path: Path) -> None:
    both(1).write_csv(tmp_path / "drive1.csv")
    (tmp_path / "runs.csv").write_text("run,comand,driver\ndrive1,curve,me\n")
    assert read(tmp_path).warnings == (f"{tmp_path}/runs.csv: column 'comand' is not read; did you mean 'command'?",)


def test_any_column_is_named_by_a_mapping(tmp_path: Path) -> None:
    made = both(1).rename({"t": "clock", "omega_left": "l", "omega_right": "r", "x": "px", "y": "py", "theta": "h"})
    made.write_csv(tmp_path / "log.csv")
    columns = {"t": "clock", "omega_left": "l", "right": "r", "x": "px", "y": "py", "theta": "h"}
    assert odometry_error(read(tmp_path / "log.csv", columns=columns)) < FITS


def test_ticks_millimetres_degrees_and_milliseconds_are_units(tmp_path: Path) -> None:
    counts = quarter_ticks(1)
    frame = wheels(1).with_columns(ticks_left=counts[:, 0], ticks_right=counts[:, 1], t=pl.col("t") * 1e3 + 1.7e12)
    frame.write_csv(tmp_path / "a_wheels.csv")
    poses(1).select(
        t=pl.col("t") * 1e6 + 1.7e15, x=pl.col("x") * 1e3, y=pl.col("y") * 1e3, yaw=pl.col("theta").degrees()
    ).write_csv(tmp_path / "a_poses.csv")
    units = {"wheel_unit": "ticks", "ticks_per_turn": 1000, "wheel_time_unit": "ms", "pose_time_unit": "us"}
    assert odometry_error(read(tmp_path, position_unit="mm", heading_unit="deg", **units)) < FITS


def test_semicolons_decimal_commas_marks_and_line_ends_of_spreadsheets_are_read(tmp_path: Path) -> None:
    text = both(1).write_csv(separator=";").replace(".", ",").replace("\n", "\r\n")
    (tmp_path / "log.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    with pytest.raises(DataError, match=r"expected a number; of decimal commas say --set decimal=comma"):
        read(tmp_path)
    assert odometry_error(read(tmp_path, decimal="comma")) < FITS


def test_all_missing_columns_are_named_with_what_to_type(tmp_path: Path) -> None:
    names = {"t": "time_ms", "omega_left": "rpm_l", "omega_right": "rpm_r", "x": "px_mm", "theta": "yaw_deg"}
    both(1).rename(names).write_csv(tmp_path / "log.csv")
    with pytest.raises(DataError) as caught:
        read(tmp_path)
    assert "'t', 'omega_left', 'omega_right', 'x' and 'theta' are missing; found: time_ms, " in str(caught.value)
    for part in ("t: time_ms", "omega_left: rpm_l", "omega_right: rpm_r", "theta: yaw_deg", "x: px_mm"):
        assert part in str(caught.value)
    units = "--set wheel_time_unit=ms --set wheel_unit=rpm --set position_unit=mm --set heading_unit=deg?"
    assert str(caught.value).endswith(units)


def test_missing_columns_of_both_files_are_named_at_once(tmp_path: Path) -> None:
    wheels(1, omega_left="speed_l").write_csv(tmp_path / "a_wheels.csv")
    poses(1, x="east").write_csv(tmp_path / "a_poses.csv")
    with pytest.raises(DataError, match=r"a_wheels\.csv: column 'omega_left' .*; and .*a_poses\.csv: column 'x' is"):
        read(tmp_path)


def test_a_row_with_some_blank_cells_of_a_stream_is_named(tmp_path: Path) -> None:
    made = both(1).with_columns(theta=pl.when(pl.col("t") == 1.0).then(None).otherwise(pl.col("theta")))
    made.write_csv(tmp_path / "log.csv")
    with pytest.raises(DataError, match=r"log\.csv, .*line \d+.*: theta is missing"):
        read(tmp_path)


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


def test_times_in_milliseconds_are_told(tmp_path: Path) -> None:
    wheels(1).with_columns(t=pl.col("t") + 1.7e9).write_csv(tmp_path / "r_wheels.csv")
    poses(1).with_columns(t=(pl.col("t") + 1.7e9) * 1e3).write_csv(tmp_path / "r_poses.csv")
    with pytest.raises(DataError, match="the poses' times look like ms: --set pose_time_unit=ms"):
        read(tmp_path)


@pytest.mark.parametrize("names", [{}, {"columns": {"omega_left": "l", "phi_right": "r"}}])
def test_columns_named_for_another_unit_are_taken_where_the_unit_is_said(tmp_path: Path, names: dict[str, Any]) -> None:
    made = both(1).rename({"omega_left": "l", "omega_right": "r"} if names else {})
    for column in made.columns[1:3]:
        made = made.with_columns(pl.col(column) * 60 / (2 * np.pi))
    shown = made if names else made.rename({"omega_left": "phi_left", "omega_right": "phi_right"})
    shown.write_csv(tmp_path / "log.csv")
    assert odometry_error(read(tmp_path, wheel_unit="rpm", **names)) < FITS


@pytest.mark.parametrize("place", [".", ".."])
def test_robot_yaml_in_the_source_or_beside_it_is_the_robot(tmp_path: Path, place: str) -> None:
    (tmp_path / "log").mkdir()
    both(1).write_csv(tmp_path / "log" / "drive1.csv")
    robot = "name: r\nwheels:\n" + "".join(
        f"  - {{name: {side}, type: fixed, radius: 0.05, x: 0, y: {y}}}\n"
        for side, y in (("left", 0.15), ("right", -0.15))
    )
    (tmp_path / "log" / place / "robot.yaml").write_text(robot)
    assert odometry_error(import_dataset("csv", tmp_path / "log")) < FITS


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


@pytest.mark.parametrize(("table", "rows"), [("wheels", 1), ("poses", 1)])
def test_a_table_of_one_row_is_said_to_be_one(tmp_path: Path, table: str, rows: int) -> None:
    write_pair(tmp_path, 1)
    file = tmp_path / f"run1_{table}.csv"
    pl.read_csv(file).head(rows).write_csv(file)
    with pytest.raises(DataError, match=f"{table}: has one row; two are needed"):
        read(tmp_path)


def test_wheels_that_end_before_their_first_pose_are_refused_in_a_line(tmp_path: Path) -> None:
    write_pair(tmp_path, 1)
    wheels(1).head(15).write_csv(tmp_path / "run1_wheels.csv")
    with pytest.raises(DataError, match="run1"):
        read(tmp_path, wheel_time_unit="us")


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


def test_three_tables_with_capital_letters_are_told_and_share_the_name_of_their_times(tmp_path: Path) -> None:
    for make, name in ((wheels, "Wheels"), (poses, "Poses")):
        made = pl.concat([make(seed, t="Clock").with_columns(Trial=pl.lit(seed)) for seed in (1, 2)])
        made.write_csv(tmp_path / f"{name}.CSV")
    (tmp_path / "Runs.csv").write_text("Trial,Command\n1,curve\n2,line\n")
    data = read(tmp_path, columns={"t": "Clock"})
    assert [(run.id, run.command) for run in data.trajectories] == [("1", "curve"), ("2", "line")]
    assert odometry_error(data) < FITS


def test_wheels_and_poses_apart_under_other_names_are_refused_with_the_endings_to_say(tmp_path: Path) -> None:
    wheels(1).write_csv(tmp_path / "encoders.csv")
    poses(1).write_csv(tmp_path / "camera.csv")
    assert "encoders.csv holds wheels and camera.csv poses; call them" in refusal(tmp_path)
    assert odometry_error(read(tmp_path, wheel_suffix="encoders.csv", pose_suffix="camera.csv")) < FITS
