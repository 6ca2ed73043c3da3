"""Joining the data sets of one robot: nothing is mistaken for something else, and what does not fit is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from drive_samples import DIFF, PERIOD, dataset, drive, trajectory

from omnibench.data.dataset import Dataset, make_dataset
from omnibench.data.splits import joined
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError
from omnibench.robot.kinematics import Robot
from omnibench.slam.import_dataset import import_dataset


def recording(seed: int, **changes: str) -> Dataset:
    """A recording of one run, ``run1``."""
    return replace(dataset(replace(trajectory("run1", drive(seed)), **changes)), name=f"day{seed}")


def test_runs_and_sessions_of_the_same_name_stay_apart() -> None:
    both = joined(recording(1, session="s1"), [recording(2, session="s1"), recording(3)])
    assert [(run.id, run.session) for run in both.trajectories] == [
        ("run1", "s1"),
        ("day2/run1", "day2/s1"),
        ("day3/run1", "day3"),
    ]
    assert both.name == "day1"


def test_splits_and_numbers_stay() -> None:
    first, second = recording(1), recording(2, split="validation")
    both = joined(first, [second])
    assert [run.split for run in both.trajectories] == ["train", "validation"]
    assert both.trajectories[1].fingerprint == second.trajectories[0].fingerprint


def test_another_robot_is_refused() -> None:
    other = make_dataset("wide", Robot.model_validate(wide()), PERIOD, recording(2).trajectories)
    with pytest.raises(DataError, match="its robot is not that of day1"):
        joined(recording(1), [other])


def test_other_samples_are_refused() -> None:
    other = make_dataset("slow", recording(1).robot, 1.5 * PERIOD, recording(2).trajectories)
    with pytest.raises(DataError, match=r"its wheels were sampled every 0.03 s"):
        joined(recording(1), [other])


def wide() -> dict[str, object]:
    """The robot with wheels farther apart."""
    return {**DIFF, "wheels": [{**wheel, "y": 1.1 * wheel["y"]} for wheel in DIFF["wheels"]]}


def test_data_sets_are_joined_as_one_is_read_again(tmp_path: Path) -> None:
    for seed in (1, 2):
        save_dataset(recording(seed), tmp_path / f"day{seed}")
    both = import_dataset("dataset", tmp_path / "day1", {"name": "both", "join": str(tmp_path / "day2")})
    save_dataset(both, tmp_path / "both")
    assert [run.id for run in load_dataset(tmp_path / "both").trajectories] == ["run1", "day2/run1"]
