"""Runs without motion capture: references in memory and on disk, and what is refused of them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from sample_robots import APR_02
from storage_samples import FORMATS, Format, a_trajectory, everything_known

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.references import Reference, References
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError
from omnibench.robot.kinematics import Robot

ALL_KINDS = (
    Reference("distance", 0.09, 0.002),
    Reference("turn", 0.2, 0.01, t0=0.1),
    Reference("displacement", (0.08, 0.04), (0.002, 0.003)),
    Reference("position", (3.0, 4.0), 0.01, t1=0.2),
    Reference("heading", 1.7, 0.05, t1=0.3),
)


def measured(identity: str = "run-1", *references: Reference, **known: bool) -> Trajectory:
    """A run without poses."""
    run = a_trajectory(identity, 0.5)
    given = References.of(references or ALL_KINDS, run.times[-1], **known)
    return replace(run, pose_times=np.zeros(1), poses=np.zeros((1, 3)), references=given)


def a_set(*runs: Trajectory) -> Dataset:
    return make_dataset("tape", APR_02, 0.1, runs)


@pytest.mark.parametrize("fmt", FORMATS)
def test_references_come_back_from_disk_as_they_were(tmp_path: Path, fmt: Format) -> None:
    turns = measured("run-3", Reference("turn", 0.2, 0.1))
    turns = replace(turns, references=replace(turns.references, rate_sigma=0.01))  # the offset that turns share
    dataset = a_set(measured(), a_trajectory("run-2", 0.1), turns)
    save_dataset(dataset, tmp_path / "tape", fmt)
    again = load_dataset(tmp_path / "tape")
    assert again.hash == dataset.hash
    assert [run.fingerprint for run in again.trajectories] == [run.fingerprint for run in dataset.trajectories]
    assert [run.start_known for run in again.trajectories] == [False, True, False]
    assert again.trajectories[2].references.rate_sigma == 0.01


def test_a_data_set_without_any_pose_has_no_table_of_poses(tmp_path: Path) -> None:
    save_dataset(everything_known(), tmp_path / "tape")
    save_dataset(a_set(measured()), tmp_path / "tape", overwrite=True)
    assert not (tmp_path / "tape" / "poses.parquet").exists()
    (run,) = load_dataset(tmp_path / "tape").trajectories
    assert not run.has_poses
    assert run.start.tolist() == [0.0, 0.0, 0.0]


def test_a_start_pose_alone_makes_the_frame_of_positions_known(tmp_path: Path) -> None:
    run = replace(measured("run-1", start_known=True), poses=np.array([[1.0, 2.0, 0.3]]))
    save_dataset(a_set(run), tmp_path / "gps")
    (again,) = load_dataset(tmp_path / "gps").trajectories
    assert again.start_known
    assert again.start.tolist() == [1.0, 2.0, 0.3]


def test_a_table_may_say_a_sigma_for_both_axes_and_leave_out_the_times_of_the_whole_run(tmp_path: Path) -> None:
    save_dataset(a_set(measured()), tmp_path / "tape")
    rows = {"trajectory": ["run-1"] * 2, "kind": ["displacement", "distance"], "value": [None, 0.09]}
    frame = pl.DataFrame(rows | {"value_x": [0.08, None], "value_y": [0.04, None], "sigma": [0.002, 0.001]})
    frame.write_parquet(tmp_path / "tape" / "references.parquet")
    references = load_dataset(tmp_path / "tape").trajectories[0].references
    assert references.t0.tolist() == [0.0, 0.0]
    assert references.t1.tolist() == [0.4, 0.4]
    np.testing.assert_array_equal(references.sigmas, [[0.002, 0.002], [0.001, np.nan]])


def test_a_data_set_without_references_keeps_hash_and_fingerprint_to_the_bit() -> None:
    sides = {"left": 0.15, "right": -0.15}
    wheels = [{"name": name, "type": "fixed", "radius": 0.05, "x": 0.0, "y": y} for name, y in sides.items()]
    robot = Robot.model_validate({"name": "diff", "wheels": wheels})
    rates, poses = np.array([[1.0, 1.0], [2.0, 1.5]]), np.array([[0.0, 0.0, 0.0], [0.0625, 0.0, -0.125]])
    run = Trajectory("run-1", "train", np.array([0.5, 1.0]), rates, np.array([0.0, 1.0]), poses)
    # By the version before there were references.
    assert run.fingerprint == "76cfe729fb32936f"
    assert make_dataset("plain", robot, 0.5, [run]).hash.startswith("009e3e0aa644d6a83e59c5d2da3b502c")


REFUSED = [
    (Reference("distanse", 1.0, 0.1), "kind is 'distanse'; did you mean 'distance'?"),  # type: ignore[arg-type]
    (Reference("turn", 1.0, 0.1, t1=9.0), "t1 is 9"),
    (Reference("turn", 1.0, 0.1, t0=-1.0), "t0 is -1"),
    (Reference("turn", 1.0, 0.1, t0=0.2, t1=0.2), "t0 < t1"),
    (Reference("position", (1, 1), 0.1, t0=0.1, t1=0.2), "a position is that at t1"),
    (Reference("heading", 1.0, 0.1, t0=0.1, t1=0.2), "take kind turn"),
    (Reference("distance", 1.0, math.nan), "sigma is missing"),
    (Reference("displacement", (1.0, 0.0), (0.1, 0.0)), "sigma_y is 0"),
    (Reference("position", (1.0, math.nan), 0.1), "value_y is missing"),
    (Reference("distance", -1.0, 0.1), "not negative"),
    (Reference("turn", 1e12, 0.1), "which no robot can reach"),
]


@pytest.mark.parametrize(("reference", "words"), REFUSED)
def test_references_that_cannot_be_right_are_refused_in_one_line(reference: Reference, words: str) -> None:
    with pytest.raises(DataError) as caught:
        a_set(measured("run-1", reference))
    assert str(caught.value).startswith("data set tape: trajectory run-1: references, row 1: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_refusal_on_reading_names_file_and_row(tmp_path: Path) -> None:
    save_dataset(a_set(measured()), tmp_path / "tape", "csv")
    file = tmp_path / "tape" / "references.csv"
    frame = pl.read_csv(file)
    frame.with_columns(sigma=pl.when(pl.col("kind") == "turn").then(0.0).otherwise("sigma")).write_csv(file)
    with pytest.raises(DataError, match=r"references\.csv, row \d: sigma is 0"):
        load_dataset(tmp_path / "tape")
    frame.with_columns(sigma_rate=-0.01).write_csv(file)
    with pytest.raises(DataError, match=r"sigma_rate is -0\.01"):
        load_dataset(tmp_path / "tape")


def test_a_run_with_neither_poses_nor_references_is_refused(tmp_path: Path) -> None:
    save_dataset(a_set(measured(), measured("run-2")), tmp_path / "tape", "csv")
    file = tmp_path / "tape" / "references.csv"
    pl.read_csv(file).filter(pl.col("trajectory") == "run-1").write_csv(file)
    with pytest.raises(DataError, match=r"row 2: trajectory run-2 has neither references nor, .*poses"):
        load_dataset(tmp_path / "tape")


def test_wrapped_headings_of_a_compass_become_continuous() -> None:
    run = a_trajectory("run-1", 0.5)
    times = 2.0 * np.arange(1, 21)
    rates = np.tile(run.rates[0], (20, 1))
    true = 0.5 * times + 2.0
    wrapped = np.angle(np.exp(1j * true))
    given = [Reference("heading", float(value), 0.1, t1=float(at)) for at, value in zip(times, wrapped, strict=True)]
    still = replace(run, times=times, rates=rates, pose_times=np.zeros(1), poses=np.zeros((1, 3)))
    (read,) = a_set(replace(still, references=References.of(given, 40.0))).trajectories
    np.testing.assert_allclose(np.diff(read.references.values[:, 0]), np.diff(true), atol=1e-9)


@pytest.mark.parametrize(
    ("reference", "unit"),
    [
        (Reference("distance", 90.0, 1.0), "mm"),
        (Reference("displacement", (8.0, 4.0), 0.1), "cm"),
        (Reference("turn", 11.5, 0.1), "degrees"),
    ],
)
def test_references_in_other_units_are_warned_of(reference: Reference, unit: str) -> None:
    (warning,) = a_set(measured("run-1", reference)).warnings
    assert f"as if they were in {unit}" in warning


def test_references_of_a_data_set_and_of_a_run_are_tables() -> None:
    dataset = a_set(a_trajectory("run-1", 0.1), measured("run-2"))
    assert dataset.to_frame("references")["trajectory"].to_list() == ["run-2"] * len(ALL_KINDS)
    run = dataset.trajectories[1]
    assert run.to_frame("references")["kind"].to_list() == dataset.to_frame("references")["kind"].to_list()
    assert repr(run).splitlines()[1].endswith(f"{len(ALL_KINDS)} references")
    assert len(repr(run.references).splitlines()) <= 20
