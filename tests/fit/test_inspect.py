"""What is in a data set, and what can be identified from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fit_samples import noisy_trajectories
from sample_robots import WHEELED

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.tables import make_dataset as dataset_of_tables
from omnibench.fit.inspect import Inspection, inspect_dataset
from omnibench.robot.kinematics import Robot
from omnibench.testing.synthetic import synthetic_robot


@pytest.mark.parametrize("robot", WHEELED, ids=lambda robot: robot.name)
def test_wheels_that_never_turn_tell_nothing_of_any_robot(robot: Robot) -> None:
    t, poses = np.arange(1, 21) * 0.1, {"t": [0.0, 1.0, 2.0]} | dict.fromkeys(("x", "y", "theta"), np.zeros(3))
    names = [f"omega_{wheel}" for wheel in robot.wheel_names] + [f"steer_{wheel}" for wheel in robot.drive.steered]
    still = dataset_of_tables("still", robot, wheels={"t": t} | dict.fromkeys(names, np.zeros(20)), poses=poses)
    inspection = inspect_dataset(still)
    assert inspection.driven_directions == 0
    assert not any(parameter.told for parameter in inspection.identifiability.parameters)
    assert {direction.state for direction in inspection.identifiability.directions} == {"undriven"}


def dataset(runs: list[Trajectory], wheels: int = 3) -> Dataset:
    robot = synthetic_robot(4 if wheels == 4 else 3)
    return make_dataset("synthetic", robot, 0.2, runs, description="d", source="s", licence="l", simulated=True)


def commanded() -> list[Trajectory]:
    """Twelve runs: eight to train of three commands in two sessions, four to validate of one."""
    commands = ["a", "a", "a", "b", "b", "c", "c", "c", "a", "a", "a", "a"]
    return [
        replace(
            run,
            command=command,
            split="train" if index < 8 else "validation",
            session="morning" if index < 5 else "evening",
            angles=np.cumsum(run.rates, axis=0),
        )
        for index, (run, command) in enumerate(zip(noisy_trajectories(), commands, strict=True))
    ]


@pytest.fixture(scope="module")
def found() -> Inspection:
    """The inspection of the commanded runs."""
    return inspect_dataset(dataset(commanded()))


def test_the_header_is_repeated(found: Inspection) -> None:
    assert (found.dataset, found.description, found.source, found.licence) == ("synthetic", "d", "s", "l")
    assert found.simulated
    assert (found.robot, found.wheels) == ("synthetic omni", ("a", "b", "c"))


def test_samples_and_poses_are_counted(found: Inspection) -> None:
    runs = noisy_trajectories()
    assert found.trajectories == 12
    assert found.wheel_samples == sum(len(run.times) for run in runs)
    assert found.reference_poses == sum(len(run.poses) for run in runs)


def test_periods_are_measured(found: Inspection) -> None:
    assert found.sample_period_s == 0.2
    np.testing.assert_allclose(found.sample_period_range_s, [0.2, 0.2], rtol=1e-9)
    assert found.pose_period_s == pytest.approx(0.8)


def test_irregular_periods_are_shown_with_their_range() -> None:
    first, *rest = commanded()
    irregular = replace(first, times=first.times + 0.05 * (np.arange(len(first.times)) == 3))
    periods = inspect_dataset(dataset([irregular, *rest])).sample_period_range_s
    assert periods == pytest.approx((0.15, 0.25))


def test_commands_repetitions_and_sessions_are_counted_by_split(found: Inspection) -> None:
    train, validation = found.splits["train"], found.splits["validation"]
    assert (train.trajectories, train.commands, train.repetitions_min, train.repetitions_max) == (8, 3, 2, 3)
    assert (validation.trajectories, validation.commands, validation.repetitions_max) == (4, 1, 4)
    assert (train.sessions, validation.sessions) == (2, 1)


def test_lengths_and_turns_are_summed_by_split(found: Inspection) -> None:
    runs = commanded()[8:]
    content = found.splits["validation"]
    assert content.duration_s == pytest.approx(sum(run.times[-1] for run in runs))
    paths = [np.linalg.norm(np.diff(run.poses[:, :2], axis=0), axis=1).sum() for run in runs]
    assert content.distance_m == pytest.approx(sum(paths))
    assert content.turned_rad == pytest.approx(sum(abs(run.poses[-1, 2] - run.poses[0, 2]) for run in runs))


def test_what_every_run_has_is_told(found: Inspection) -> None:
    assert (found.has_angles, found.has_targets) == (True, False)
    first, *rest = commanded()
    assert not inspect_dataset(dataset([replace(first, angles=None), *rest])).has_angles


def test_nothing_is_found_where_everything_is_in_order(found: Inspection) -> None:
    assert (found.findings, found.warnings, found.undriven) == ((), (), ())
    assert found.driven_directions == 3


def test_the_direction_that_mecanum_wheels_cannot_drive_is_named_as_expected() -> None:
    runs = [replace(run, command="c") for run in noisy_trajectories(4)]
    inspection = inspect_dataset(dataset(runs, wheels=4))
    assert inspection.undriven == ("fl - fr - rl + rr",)
    assert inspection.driven_directions == 3
    assert inspection.driven_shares[3] < 1e-2 < inspection.driven_shares[2]
    assert inspection.findings[0] == (
        "no run drives the wheels along fl - fr - rl + rr, as for any robot on four wheels that does not slip: "
        "the matrix is not determined along it, and calibration keeps the design values there"
    )


def test_straight_runs_of_three_wheels_leave_the_common_turn() -> None:
    straight = [run for index, run in enumerate(commanded()) if index % 3 == 1]
    inspection = inspect_dataset(dataset(straight))
    assert inspection.undriven == ("a + b + c",)
    assert inspection.findings[0] == (
        "no run drives the wheels along a + b + c (turning on the spot): the matrix is not determined along it, "
        "and calibration keeps the design values there; record turns, on the spot or while driving"
    )


@pytest.mark.parametrize(
    ("split", "finding"),
    [
        ("train", "no trajectory is marked validation: calibrations cannot be judged on other data"),
        ("validation", "no trajectory is marked train: nothing can be calibrated"),
    ],
)
def test_a_split_that_is_empty_is_told(split: str, finding: str) -> None:
    runs = [replace(run, split="train" if split == "train" else "validation") for run in commanded()]
    inspection = inspect_dataset(dataset(runs))
    assert inspection.findings == (finding,)
    assert set(inspection.splits) == {split}


def test_missing_commands_are_told() -> None:
    inspection = inspect_dataset(dataset([replace(run, command=None) for run in commanded()]))
    assert inspection.findings == ("no commands are named: repetitions are unknown",)
    assert inspection.splits["train"].commands == 0


def test_warnings_of_the_data_set_are_passed_on() -> None:
    millimetres = [replace(run, poses=run.poses * [1000, 1000, 1]) for run in commanded()]
    (warning,) = inspect_dataset(dataset(millimetres)).warnings
    assert warning.startswith("positions look like mm; x and y must be m")


def test_a_real_recording_of_hours_is_inspected(omni3: Dataset) -> None:
    inspection = inspect_dataset(omni3)
    assert inspection.trajectories == 67
    assert inspection.driven_directions == 3
    assert inspection.findings == ()


@pytest.mark.parametrize(
    ("left", "beginning"),
    [(0.05, "these recordings hardly turn the robot: they drive"), (0.25, "the runs drive")],
)
def test_a_motion_that_is_hardly_driven_is_told_with_its_share(left: float, beginning: str) -> None:
    runs = [replace(run, rates=run.rates - (1 - left) * run.rates.mean(axis=1, keepdims=True)) for run in commanded()]
    inspection = inspect_dataset(dataset(runs))
    turning = next(each for each in inspection.identifiability.directions if each.motion == "turning on the spot")
    finding = inspection.findings[0]
    assert finding.startswith(f"{beginning} the wheels along a + b + c (turning on the spot) with ")
    assert f" {100 * turning.share:.1f} % of the strongest motion" in finding


def test_what_can_be_told_is_part_of_the_json_document(found: Inspection) -> None:
    document = found.model_dump(mode="json")["identifiability"]
    assert [each["state"] for each in document["directions"]] == ["driven"] * 3
    assert len(document["parameters"]) == 9
    assert document["sentences"] == []


def test_without_training_runs_all_runs_are_judged() -> None:
    runs = [replace(run, split="validation") for run in commanded()]
    assert len(inspect_dataset(dataset(runs)).identifiability.directions) == 3
