"""The rosbag importer: MCAP, rosbag2 and ROS 1 recordings give back the wheels and reference poses that were sent."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import yaml
from bag_samples import (
    DRIVE,
    EPOCH,
    FORMATS,
    PERIOD,
    ROBOT,
    TRUTH,
    WHEELS,
    Sent,
    changed,
    edited,
    header,
    messages,
    odometry_error,
    part,
    pose,
    read,
    slam_pose,
    transform,
    write_mcap,
    write_rosbag2,
)
from commands import Command, assert_refused
from timing import PATIENCE

from omnibench.data.storage import load_dataset
from omnibench.fit.calibrate import calibrate
from omnibench.testing import ImporterConformance


@FORMATS
def test_every_format_gives_back_wheels_and_poses_exactly(
    tmp_path: Path, write: Callable[[Path, Sequence[Sent]], Path]
) -> None:
    data = read(write(tmp_path / "drive", messages(DRIVE)))
    assert len(data.trajectories) == len(DRIVE.begins)
    assert data.warnings == ()
    assert data.sample_period == PERIOD / 1e9
    for run in data.trajectories:
        assert run.started_at is not None
        assert run.angles is not None
        first = round((run.started_at + run.times[0]) * 1e9) // PERIOD
        rows = slice(first, first + len(run.times))
        np.testing.assert_allclose(run.started_at + run.times, (DRIVE.stamps[rows] - EPOCH) / 1e9, rtol=0, atol=1e-9)
        np.testing.assert_allclose(run.angles, DRIVE.angles[rows], rtol=0, atol=1e-9)
        np.testing.assert_allclose(run.rates, DRIVE.rates[first - 1 : first - 1 + len(run.times)], rtol=0, atol=1e-9)
        seen = np.searchsorted(DRIVE.pose_stamps, EPOCH + np.round((run.started_at + run.pose_times) * 1e9))
        np.testing.assert_allclose(run.poses[:, :2], DRIVE.poses[seen, :2], rtol=0, atol=1e-9)
        np.testing.assert_allclose(np.exp(1j * run.poses[:, 2]), np.exp(1j * DRIVE.poses[seen, 2]), atol=1e-9)


@FORMATS
def test_calibration_on_an_imported_bag_gives_the_true_matrix(
    tmp_path: Path, write: Callable[[Path, Sequence[Sent]], Path]
) -> None:
    data = read(write(tmp_path / "drive", messages(DRIVE)))
    assert odometry_error(data) < 1e-9
    np.testing.assert_allclose(calibrate(data, "closed_form").calibration.matrix, TRUTH, rtol=0, atol=1e-9)


def test_velocities_are_accepted_where_there_are_no_positions(tmp_path: Path) -> None:
    data = read(write_mcap(tmp_path / "drive", messages(DRIVE, velocities=True)))
    assert len(data.trajectories) == len(DRIVE.begins)
    assert data.trajectories[0].angles is None
    assert odometry_error(data) < 1e-9


def test_positions_are_preferred_to_velocities(tmp_path: Path) -> None:
    wrong = edited(messages(DRIVE), WHEELS, lambda each: changed(each, velocity=[9.0, 9.0, 9.0]))
    assert odometry_error(read(write_mcap(tmp_path / "drive", wrong))) < 1e-9


def test_velocities_are_used_where_positions_are_only_filled_in(tmp_path: Path) -> None:
    filled = edited(messages(DRIVE, velocities=True), WHEELS, lambda each: changed(each, position=[0.0, 0.0, 0.0]))
    assert odometry_error(read(write_mcap(tmp_path / "drive", filled))) < 1e-9


def test_velocities_can_be_asked_for(tmp_path: Path) -> None:
    both = [
        changed(each, position=[1.0, 2.0, float(index)]) if each.topic == WHEELS else each
        for index, each in enumerate(messages(DRIVE, velocities=True))
    ]
    assert odometry_error(read(write_mcap(tmp_path / "drive", both), use="velocities")) < 1e-9


def test_positions_that_begin_again_are_unwrapped(tmp_path: Path) -> None:
    turn = 2 * np.pi

    def wrapped(each: Sent) -> Sent:
        return changed(each, position=[(angle + np.pi) % turn - np.pi for angle in each.content["position"]])

    source = write_mcap(tmp_path / "drive", edited(messages(DRIVE), WHEELS, wrapped))
    data = read(source, wraps_at=turn)
    assert data.warnings == ()
    assert odometry_error(data) < 1e-9
    angles = np.concatenate([run.angles for run in data.trajectories if run.angles is not None])
    assert np.ptp(angles, axis=0).max() > turn
    recognised = read(source)
    assert recognised.hash == data.hash
    assert recognised.warnings[0].startswith("wheel positions begin again after 6.283185307 rad and were counted on")


def test_joints_that_count_the_other_way_round_are_turned(tmp_path: Path) -> None:
    turned = edited(
        messages(DRIVE),
        WHEELS,
        lambda each: changed(each, position=[-each.content["position"][0], *each.content["position"][1:]]),
    )
    data = read(write_mcap(tmp_path / "drive", turned), joint_signs=[-1, 1, 1])
    assert odometry_error(data) < 1e-9


def test_covariances_of_the_plane_are_kept(bag: Path) -> None:
    covariances = read(bag).trajectories[0].pose_covariances
    assert covariances is not None
    expected = [[1e-4, 0, 1e-5], [0, 2e-4, 0], [1e-5, 0, 3e-4]]
    np.testing.assert_array_equal(covariances, np.broadcast_to(expected, covariances.shape))


def test_covariances_of_zeros_mean_that_they_are_not_known(tmp_path: Path) -> None:
    wheels = [each for each in messages(DRIVE) if each.topic == WHEELS]
    poses = [slam_pose(*each, variances=(0, 0, 0)) for each in zip(DRIVE.pose_stamps, DRIVE.poses, strict=True)]
    assert read(write_mcap(tmp_path / "drive", [*wheels, *poses])).trajectories[0].pose_covariances is None


@pytest.mark.parametrize("variance", [1.797e308, 0.0, -1.0, np.nan, np.inf])
def test_poses_of_unknown_covariance_are_read_and_pose_sigma_counts_for_them(tmp_path: Path, variance: float) -> None:
    wheels = [each for each in messages(DRIVE) if each.topic == WHEELS]
    poses = [slam_pose(*each) for each in zip(DRIVE.pose_stamps, DRIVE.poses, strict=True)]
    poses[3:] = [changed(each, pose=each.content["pose"] | {"covariance": [variance] * 36}) for each in poses[3:]]
    bag, unusable = write_mcap(tmp_path / "drive", [*wheels, *poses]), f"{len(poses) - 3} of {len(poses)} poses"
    without = read(bag)
    assert all(run.pose_covariances is None for run in without.trajectories)
    assert any(f"{unusable} have no usable covariance, so that" in warning for warning in without.warnings)
    data = read(bag, pose_sigma=[0.2, 3.0])
    covariances = np.concatenate([run.pose_covariances for run in data.trajectories])
    np.testing.assert_allclose(covariances[-1], np.diag([0.04, 0.04, np.radians(3.0) ** 2]))
    assert any(f"{unusable} have no usable covariance: 0.2 m and 3 deg count" in warning for warning in data.warnings)


@pytest.mark.parametrize("kind", ["PoseStamped", "TransformStamped"])
def test_other_types_of_poses_are_read(tmp_path: Path, kind: str) -> None:
    poses = []
    for stamp, place in zip(DRIVE.pose_stamps, DRIVE.poses, strict=True):
        body = {"pose": pose(place)} if kind == "PoseStamped" else {"transform": transform(place)}
        content = {"header": header(stamp)} | body
        poses.append(Sent("/tracker/robot", f"geometry_msgs/msg/{kind}", content, int(stamp)))
    wheels = [each for each in messages(DRIVE) if each.topic == WHEELS]
    assert odometry_error(read(write_rosbag2(tmp_path / "drive", [*wheels, *poses]))) < 1e-9


def test_the_stamps_of_the_headers_count_and_not_when_it_was_recorded(tmp_path: Path) -> None:
    late = [Sent(each.topic, each.kind, each.content, EPOCH + 77 * index) for index, each in enumerate(messages(DRIVE))]
    assert odometry_error(read(write_mcap(tmp_path / "drive", late))) < 1e-9


def test_samples_that_were_lost_do_not_matter_to_positions(tmp_path: Path) -> None:
    kept = edited(messages(DRIVE), WHEELS, lambda _: None, every=3)
    assert odometry_error(read(write_mcap(tmp_path / "drive", kept))) < 1e-3  # the robot sets off within a sample


def test_the_command_imports_a_bag(command: Command, tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", part(12.4))
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(ROBOT.model_dump(mode="json")))
    run = command("import", "rosbag", source, "-o", "data", "--set", "robot=robot.yaml", "--set", "name=lab")
    assert run.returncode == 0
    assert run.stderr.startswith("training 1 run, validation 1 run, ")
    assert "\ndata holds 2 runs of " in run.stderr
    assert "2 trajectories: data" in run.stdout
    data = load_dataset(tmp_path / "data")
    assert data.name == "lab"
    assert odometry_error(data) < 1e-9


def test_the_command_lists_candidates_in_one_line(command: Command, tmp_path: Path) -> None:
    two = [Sent(each.topic.replace("robot", "r2"), each.kind, each.content, each.logged) for each in part(3)]
    source = write_mcap(tmp_path / "drive", [*part(3), *two])
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(ROBOT.model_dump(mode="json")))
    run = command("import", "rosbag", source, "-o", "data", "--set", "robot=robot.yaml")
    assert_refused(run, "--set wheel_topic=NAME, one of", "/r2/joint_states", "/robot/joint_states")


def test_looking_the_importers_up_does_not_load_rosbags() -> None:
    script = (
        "import sys\nfrom omnibench.registry import importers\nimporters.entries()\nassert 'rosbags' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=PATIENCE)


class TestRosbagConforms(ImporterConformance):
    name = "rosbag"
    options: ClassVar[dict[str, Any]] = {"robot": ROBOT.model_dump()}

    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def _sample(cls, bag: Path) -> None:
        cls.source = bag
