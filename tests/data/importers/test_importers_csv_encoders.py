"""The csv importer on other people's logs: one table of wheels and poses, steered wheels, counters of any kind."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corelli import CORELLI, CORELLI_OPTIONS, corelli_dataset
from tricycle_samples import PERIOD, TRICYCLE, tricycle_drive

from omnibench.data.checks.finding import findings_of
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.slam.import_dataset import import_dataset

DRIVE = tricycle_drive()


def write_table(file: Path, columns: Mapping[str, Array], rows: Any = slice(None)) -> Path:
    lines = [",".join(f"{value:.12g}" for value in row) for row in np.column_stack(list(columns.values()))[rows]]
    file.write_text("\n".join([",".join(columns), *lines]) + "\n")
    return file


def log(folder: Path, rows: Any = slice(None), **columns: Array) -> Path:
    """The drive as a table, with other columns."""
    return write_table(folder / "log.csv", dict(DRIVE) | columns, rows)


def read(source: Path, **options: Any) -> Dataset:
    """A table with the columns of ``tricycle_drive``, unless the options say otherwise."""
    named = {"robot": TRICYCLE, "wheel_columns": "angle", "steering_columns": "phi", "wheel_unit": "rad"}
    given = {name: value for name, value in (named | options).items() if value is not None}
    return import_dataset("csv", source, given)


def odometry_error(data: Dataset, runs: int = 1) -> float:
    """Largest difference of the design's odometry from the reference at any pose."""
    assert len(data.trajectories) == runs
    model = OdometryModel.of_design(data.robot, "arc")
    return max(float(np.abs(model.poses([run.reference_log])[0] - run.poses[1:]).max()) for run in data.trajectories)


def test_one_table_may_hold_wheels_steering_and_poses(tmp_path: Path) -> None:
    columns = {"t": DRIVE["t"], "phi_front": DRIVE["angle"], "steer_front": DRIVE["phi"]}
    poses = {key: DRIVE[key] for key in ("x", "y", "theta")}
    unnamed = {"wheel_columns": None, "steering_columns": None}
    data = read(write_table(tmp_path / "log.csv", columns | poses), **unnamed)
    assert odometry_error(data) < 1e-9
    assert data.trajectories[0].id == "log"
    whole = read(tmp_path, wheel_suffix=".csv", pose_suffix=".csv", **unnamed)
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
        (INCREMENTS / PERIOD * 30 * 60 / TURN, {"wheel_unit": "rpm", "gear_ratio": 30}),
        (np.degrees(INCREMENTS) / PERIOD, {"wheel_unit": "deg/s"}),
        (INCREMENTS / TURN, {"wheel_unit": "rev/sample"}),
        (INCREMENTS * 4096 / TURN, {"wheel_unit": "ticks/sample", "ticks_per_turn": 4096}),
    ],
)
def test_positions_rates_and_steps_in_any_unit_agree(tmp_path: Path, angle: Array, options: dict[str, Any]) -> None:
    data = read(log(tmp_path, angle=angle), **options)
    assert odometry_error(data) < 1e-8
    kept, positions = data.trajectories[0].angles, options.get("wheel_unit") in ("rev", "deg", "ticks", None)
    assert (kept is not None) == positions
    if positions:
        np.testing.assert_allclose(np.diff(kept[:, 0]), np.diff(DRIVE["angle"][1:]), atol=1e-9)


@pytest.mark.parametrize(("bits", "signed", "option"), [(16, False, "auto"), (16, True, "2^16"), (32, True, "auto")])
def test_counters_begin_again_at_any_power_of_two(tmp_path: Path, bits: int, signed: bool, option: str) -> None:
    ticks = np.floor(DRIVE["angle"] * 30 * 2048 / (2 * math.pi))
    ticks = (ticks + 2**bits - 20000) % 2**bits - (2 ** (bits - 1) if signed else 0)
    options = {"wheel_unit": "ticks", "ticks_per_turn": 2048, "gear_ratio": 30, "wraps_at": option}
    data = read(log(tmp_path, angle=ticks), **options)
    assert odometry_error(data) < 1e-3
    said = f"wheel positions begin again after {2**bits} ticks and were counted on (wraps_at={2**bits} says so)"
    assert (said in data.warnings) == (option == "auto" and np.ptp(ticks) > 2 ** (bits - 1))


def test_a_wrong_wrap_and_ticks_taken_for_radians_or_without_their_gear_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"log\.csv: wraps_at is 100, but positions span \d+\.\d+ rad"):
        read(log(tmp_path), wraps_at=100)
    source = log(tmp_path, angle=np.floor(DRIVE["angle"] * 30 * 2048 / TURN))
    with pytest.raises(DataError, match=r"log\.csv: .*--set wheel_unit=ticks --set ticks_per"):
        read(source)
    with pytest.raises(DataError, match=r"turn at up to 330 rad/s; --set ticks_per_turn=N, gear_ratio=N"):
        read(source, wheel_unit="ticks", ticks_per_turn=2048)


def test_a_counter_that_is_set_to_zero_ends_a_run(tmp_path: Path) -> None:
    angle = DRIVE["angle"] - np.where(np.arange(401) >= 200, DRIVE["angle"][200], 0)
    data = read(log(tmp_path, angle=angle))
    assert odometry_error(data, runs=2) < 0.01
    assert [(run.id, run.session) for run in data.trajectories] == [("log#1", "log"), ("log#2", "log")]
    assert "the positions begin anew 1 time, faster than any wheel turns" in data.warnings[0]
    assert "counter_restart" in {finding.kind for finding in findings_of(data.warnings)}


def test_rows_that_repeat_a_time_or_the_wheels_while_they_turned_are_left_out_and_said(tmp_path: Path) -> None:
    twice = np.sort(np.append(np.arange(401), [7, 7, 50]))
    data = read(log(tmp_path, twice))
    assert data.warnings[0].endswith("log.csv: 3 rows that repeat the t of the one before left out")
    assert odometry_error(data) < 1e-9
    with pytest.raises(DataError, match=r"log\.csv, row 2 \(line 3\): t is repeated: 100 after 100"):
        read(log(tmp_path, t=np.floor(DRIVE["t"])))
    before = np.arange(401)
    before[[60, 150]] -= 1
    data = read(log(tmp_path, angle=DRIVE["angle"][before], phi=DRIVE["phi"][before]))
    assert "log.csv: 2 rows that repeat the ones before" in data.warnings[0]
    assert len(data.trajectories[0].times) == 398
    assert odometry_error(data) < 0.01


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
    data = read(log(tmp_path, phi=shown), **options)
    steering = data.trajectories[0].steering
    np.testing.assert_allclose(steering[:, 0], DRIVE["phi"][1:], atol=2e-4)


@pytest.mark.parametrize("step", [1, 5])
def test_a_steering_column_in_degrees_is_named_however_coarse_the_samples_are(tmp_path: Path, step: int) -> None:
    data = read(log(tmp_path, slice(None, None, step), phi=np.degrees(DRIVE["phi"])))
    assert any(warning.startswith("steering angles look like degrees; ") for warning in data.warnings)


def test_a_recording_is_cut_into_equal_runs_and_the_robot_s_own_odometry_is_warned_of(tmp_path: Path) -> None:
    data = read(log(tmp_path))
    assert "the robot's odometry, or simulated without noise" in data.warnings[-1]
    save_dataset(data, tmp_path / "data")
    assert load_dataset(tmp_path / "data").hash == data.hash
    data = read(log(tmp_path), window=9)
    assert [run.id for run in data.trajectories] == ["log#1", "log#2"]
    assert odometry_error(data, runs=2) < 0.01
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
    with pytest.raises(DataError, match=message) as caught:
        read(log(tmp_path), **(unnamed | options))
    assert "\n" not in str(caught.value)


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
    if not CORELLI.is_file():
        pytest.skip(f"the recording is not at {CORELLI}")
    *_, warning = import_dataset("csv", CORELLI, CORELLI_OPTIONS).warnings
    assert warning.startswith("steering angles look about 5 times too small")
    assert "--set steering_scale=4.96, times the present ones" in warning
    *_, last = import_dataset("csv", CORELLI, CORELLI_OPTIONS | {"steering_scale": 0.5}).warnings
    assert "steering" not in last


def test_the_first_guesses_of_another_laboratory_s_tricycle_are_far_off() -> None:
    data = corelli_dataset()
    for warning, part in zip(
        data.warnings, ("4294967296 ticks", "4 steps of wheel positions ran back", "51 rows that repeat"), strict=False
    ):
        assert part in warning
    restarts = [finding.what for finding in findings_of(data.warnings) if finding.kind == "counter_restart"]
    assert restarts == [data.warnings[1]]
    (run,) = data.trajectories
    assert (len(run.times), len(run.pose_times)) == (2382, 2434)
    assert errors(run, CORELLI_OPTIONS["robot"]).mean() == pytest.approx(14.33, abs=0.01)
