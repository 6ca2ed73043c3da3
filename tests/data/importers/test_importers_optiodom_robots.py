"""The optiodom importer on the recordings of a differential drive, a tricycle and a mecanum base."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from real_recordings import OPTIODOM

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.fit.linear_fit import linear_fit
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch

pytestmark = pytest.mark.skipif(not OPTIODOM.is_dir(), reason=f"the OptiOdom recordings are not at {OPTIODOM}")


@pytest.fixture
def dataset(request: pytest.FixtureRequest) -> Dataset:
    found: Dataset = request.getfixturevalue(request.param)
    return found


def group(dataset: Dataset, name: str) -> list[Trajectory]:
    return [run for run in dataset.trajectories if run.id.startswith(f"{name}_")]


def final_errors(matrix: Array, runs: list[Trajectory]) -> tuple[float, float]:
    """Mean final error of a matrix: m and degrees."""
    batch = OdometryBatch([run.final_log for run in runs], "arc")
    errors = batch.poses(matrix[None])[0] - np.array([run.final_pose for run in runs])
    return float(np.hypot(errors[:, 0], errors[:, 1]).mean()), float(np.degrees(np.abs(errors[:, 2]).mean()))


@pytest.mark.parametrize(
    ("dataset", "name", "runs", "metres", "degrees"),
    [
        ("diff", "circular", 54, 0.0657, 9.24),
        ("diff", "square", 44, 0.0385, 3.19),
        ("diff", "ivanjko", 66, 0.0052, 1.19),
        ("tricyc", "circular", 14, 0.6647, 64.86),
        ("tricyc", "square", 14, 0.7707, 39.79),
        ("omni4", "circular", 24, 0.1540, 17.52),
    ],
    indirect=["dataset"],
)
def test_the_design_matrix_leaves_the_known_errors(
    dataset: Dataset, name: str, runs: int, metres: float, degrees: float
) -> None:
    found = group(dataset, name)
    assert len(found) == runs
    errors = final_errors(dataset.robot.inverse_kinematic_matrix, found)
    assert errors == (pytest.approx(metres, abs=6e-5), pytest.approx(degrees, abs=0.006))


def test_a_free_matrix_of_the_mecanum_base_is_far_better(omni4: Dataset) -> None:
    runs = list(omni4.trajectories)
    odometry = OdometryBatch([run.final_log for run in runs], "arc")
    finals = np.array([run.final_pose for run in runs])
    matrix = linear_fit(odometry, runs, finals, omni4.robot.inverse_kinematic_matrix, np.eye(4))
    assert final_errors(matrix, runs) == (pytest.approx(0.0323, abs=6e-5), pytest.approx(3.20, abs=0.006))


@pytest.mark.parametrize(
    ("dataset", "expected"),
    [
        ("diff", [[0.021, 0.021], [0, 0], [0.21, -0.21]]),
        ("tricyc", [[0.0325, 0], [0, 0], [0, 0.0325 / 0.15]]),
        (
            "omni4",
            0.03 / 4 * np.array([[1, 1, 1, 1], [-1, 1, 1, -1], np.array([-1, 1, -1, 1]) / 0.2]),
        ),
    ],
    indirect=["dataset"],
)
def test_the_design_matrix_is_that_of_the_authors(dataset: Dataset, expected: Array) -> None:
    np.testing.assert_allclose(dataset.robot.inverse_kinematic_matrix, expected, atol=1e-15)
    assert dataset.robot.mount is None


@pytest.mark.parametrize(
    ("dataset", "period", "note"),
    [
        (
            "diff",
            0.05,
            "sessions state different dimensions of the robot: those of 23 of 29 are taken, L 0.2 m, D 0.084 m "
            "(others: L 0.205 m, D 0.084 m in 3; L 0.205 m, D 0.085 m in 3)",
        ),
        ("tricyc", 0.05, None),
        (
            "omni4",
            0.01,
            "4 of 5 sessions have no log (080920201547, 080920201911, 231220200453, 231220200502): commands are named "
            "after the motion by the wheels there, and absolute wheel angles are left out of all runs",
        ),
    ],
    indirect=["dataset"],
)
def test_what_was_chosen_is_said_and_nothing_else_looks_wrong(dataset: Dataset, period: float, note: str) -> None:
    assert dataset.warnings == ((note,) if note else ())
    assert note is None or note[1:] in dataset.description
    assert dataset.sample_period == period


def test_the_wheels_of_the_mecanum_base_stand_at_its_corners(omni4: Dataset) -> None:
    corners = [(0.1, 0.1), (0.1, -0.1), (-0.1, 0.1), (-0.1, -0.1)]
    assert [wheel.position for wheel in omni4.robot.wheels] == corners
    assert [round(math.degrees(wheel.roller_angle)) for wheel in omni4.robot.wheels] == [45, -45, -45, 45]


def test_the_tricycle_steers_by_the_angles_of_its_encoder(tricyc: Dataset) -> None:
    assert tricyc.robot.wheel_names == tricyc.robot.drive.steered == ("front",)
    for run in tricyc.trajectories:
        assert run.steering is not None
        turned = np.degrees(run.signals @ tricyc.robot.inverse_kinematic_matrix[2] @ np.diff(run.times, prepend=0.0))
        assert run.command is not None
        assert turned == pytest.approx(float(run.command.split("turn")[1].split("_")[0]), abs=5)


@pytest.mark.parametrize(
    ("dataset", "counts", "commands"),
    [
        (
            "diff",
            [1] * 10 + [3] * 14 + [7] * 2 + [8] * 10 + [9] * 2,
            ["circular_a0_turn-720_v0.11_r0.85x0.9_b0.2d0.084", "square_a0_turn+360_v0.057_l0.75_b0.205d0.085"],
        ),
        ("tricyc", [7] * 4, ["circular_a0_turn-720_r0.85x0.9", "square_a0_turn+360_l1.5"]),
        ("omni4", [1] * 12 + [3] * 4, ["circular_a90_turn+720_5.8m", "circular_a0_turn-180_v0.075_r0.8x0.9"]),
    ],
    indirect=["dataset"],
)
def test_runs_of_one_path_share_a_command(dataset: Dataset, counts: list[int], commands: list[str]) -> None:
    found = Counter(run.command for run in dataset.trajectories)
    assert sorted(found.values()) == counts
    assert set(commands) <= set(found)


def test_the_commands_of_the_differential_drive_are_those_of_its_logs(diff: Dataset) -> None:
    turning = next(run for run in diff.trajectories if run.command == "ivanjko_a0_turn+180_v0_l2_b0.2d0.084")
    assert (turning.v, turning.omega) == (0.0, pytest.approx(1.0))
    first = diff.trajectories[0]
    assert first.omega == pytest.approx(-0.006634 / 0.05)
    assert first.distance == pytest.approx(9.39, abs=0.01)
    assert first.angles is not None
    np.testing.assert_allclose(np.diff(first.angles, axis=0), first.rates[1:] * 0.05, atol=1e-6)


def test_runs_of_every_robot_go_on_from_one_another_where_the_session_was_logged(tricyc: Dataset) -> None:
    first, second = tricyc.trajectories[:2]
    assert (first.session, first.started_at) == (second.session, 0.0)
    assert second.started_at == pytest.approx(207.95 - 89.2, abs=0.1)
