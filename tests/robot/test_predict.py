"""Poses that a calibration predicts from a run or a table of wheel rates, and runs of a data set by their names."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import polars as pl
import pytest
from export_samples import calibration
from sample_robots import CAR, DIFFERENTIAL, TRICYCLE
from wheeled_samples import driven

from omnibench.data.storage import tables_of
from omnibench.errors import DataError, UnknownNameError
from omnibench.robot.calibration import EffectTerm, odometry
from omnibench.robot.kinematics import Robot


@pytest.mark.parametrize("robot", [DIFFERENTIAL, TRICYCLE, CAR], ids=lambda robot: robot.name)
def test_a_run_is_predicted_from_its_start_as_odometry_does(robot: Robot) -> None:
    run = driven(robot)["run-1"]
    fitted = calibration(robot, 1.02 * robot.inverse_kinematic_matrix)
    poses = fitted.predict(run)
    assert poses.columns == ["t", "x", "y", "theta"]
    np.testing.assert_array_equal(poses["t"], [0.0, *run.times])
    np.testing.assert_allclose(poses.select("x", "y", "theta").row(0), run.start, rtol=0, atol=1e-12)
    expected = odometry(fitted, run.times, run.rates, steering=run.steering, start=run.start)
    np.testing.assert_array_equal(poses.select("x", "y", "theta")[1:], expected)


def test_a_table_of_several_runs_gives_the_poses_of_each() -> None:
    dataset, fitted = driven(TRICYCLE), calibration(TRICYCLE)
    poses = fitted.predict(tables_of(dataset)["wheels"])
    assert poses["trajectory"].unique(maintain_order=True).to_list() == [run.id for run in dataset]
    alone = fitted.predict(dataset["run-2"], start=(0.0, 0.0, 0.0))
    assert poses.filter(pl.col("trajectory") == "run-2").drop("trajectory").equals(alone)


@pytest.mark.parametrize("frame", [pl.DataFrame, pd.DataFrame, dict])
def test_frames_and_dicts_give_the_same_and_pandas_gets_pandas(frame: Any) -> None:
    table = {"t": [0.5, 1.0], "omega_left": [4.0, 4.0], "omega_right": [4.0, 4.0]}
    poses = calibration(DIFFERENTIAL).predict(frame(table), start=(1.0, 0.0, 0.0))
    assert isinstance(poses, pd.DataFrame if frame is pd.DataFrame else pl.DataFrame)
    np.testing.assert_allclose(poses["x"], [1.0, 1.1, 1.2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(poses["theta"], 0.0, atol=1e-12)


def test_effects_and_angles_count() -> None:
    terms = (
        EffectTerm(
            name="wheel_eccentricity", parameters=dict.fromkeys(("a_left", "b_left", "a_right", "b_right"), 0.1)
        ),
    )
    fitted, t = calibration(DIFFERENTIAL, effects=terms), 0.1 * np.arange(1, 21)
    table = {"t": t, "omega_left": np.full(20, 3.0), "omega_right": np.full(20, 3.0)}
    poses = fitted.predict({**table, "phi_left": 3 * t, "phi_right": 3 * t})
    expected = odometry(fitted, t, np.full((20, 2), 3.0), angles=np.column_stack([3 * t, 3 * t]))
    np.testing.assert_array_equal(poses.select("x", "y", "theta")[1:], expected)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (
            {"t": [1.0], "omega_left": [1.0]},
            "wheels: column omega_right is missing; a table has t, omega_left",
        ),
        ({"t": [1.0, 0.5], "omega_left": [1.0, 1.0], "omega_right": [1.0, 1.0]}, "times, row 2"),
        ([1.0, 2.0], "wheels: expected a data frame or a dict of arrays, found list"),
    ],
)
def test_a_table_that_is_none_is_refused_in_one_line(table: Any, words: str) -> None:
    with pytest.raises(DataError, match=words):
        calibration(DIFFERENTIAL).predict(table)


def test_a_run_of_another_robot_is_refused() -> None:
    with pytest.raises(DataError, match="steering is missing"):
        calibration(TRICYCLE).predict(driven(DIFFERENTIAL)["run-0"])


def test_a_data_set_is_a_collection_of_its_runs() -> None:
    dataset = driven(DIFFERENTIAL)
    assert len(dataset) == 6
    assert [run.id for run in dataset] == [f"run-{number}" for number in range(6)]
    assert dataset["run-3"] is dataset[3] is dataset.trajectories[3]
    assert "run-3" in dataset
    assert "run-9" not in dataset
    with pytest.raises(UnknownNameError, match=r"data set diff: unknown run 'run-9'; did you mean"):
        dataset["run-9"]
    assert bool(replace(dataset, trajectories=())) is False


def test_tables_are_pandas_frames_where_that_is_asked_for() -> None:
    dataset = driven(DIFFERENTIAL)
    ours, theirs = dataset.to_frame("poses"), dataset.to_frame("poses", pandas=True)
    assert isinstance(theirs, pd.DataFrame)
    assert list(theirs.columns) == ours.columns
    np.testing.assert_array_equal(theirs["x"], ours["x"])
    parameters = calibration(DIFFERENTIAL).to_frame("parameters", pandas=True)
    assert parameters["low"].isna().all()
    assert set(parameters["unit"]) == {"m"}
