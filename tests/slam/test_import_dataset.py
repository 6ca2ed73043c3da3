"""Recordings without reference poses get them from their scans on import."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bag_samples import (
    DRIVE,
    EPOCH,
    Sent,
    header,
    odometry_error,
    pose,
    read,
    text,
    write_mcap,
    write_rosbag1,
)
from scan_samples import MOUNTED, SECONDS, without_poses

from omnibench.data.dataset import Dataset
from omnibench.errors import ConfigError
from omnibench.slam.import_dataset import import_dataset


@pytest.fixture(scope="module")
def blind(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of scans and wheels, without poses."""
    return write_mcap(tmp_path_factory.mktemp("blind") / "drive", without_poses())


@pytest.fixture(scope="module")
def found(blind: Path) -> Dataset:
    return read(blind)


def test_without_poses_they_are_made_from_the_scans(found: Dataset) -> None:
    data = found
    assert "reference poses were made from the scans by SLAM, because the recording holds none" in data.warnings[0]
    assert len(data.trajectories) == 2
    for run in data.trajectories:
        np.testing.assert_array_equal(run.poses[0], 0.0)
        assert run.pose_covariances is not None
    assert odometry_error(data) < 0.005  # m and rad; the true odometry agrees with SLAM


def test_the_poses_are_the_same_whatever_the_format_of_the_recording(found: Dataset, tmp_path: Path) -> None:
    for own, other in zip(
        found.trajectories, read(write_rosbag1(tmp_path / "drive", without_poses())).trajectories, strict=True
    ):
        np.testing.assert_allclose(other.poses, own.poses, atol=1e-6)


def test_odometry_is_no_reference_where_scans_can_make_one(tmp_path: Path) -> None:
    odometry = [
        Sent(
            "/robot/odom",
            "nav_msgs/msg/Odometry",
            {"header": header(int(stamp)), "pose": {"pose": pose(place)}},
            int(stamp),
        )
        for stamp, place in zip(DRIVE.pose_stamps, DRIVE.poses * 1.1, strict=True)
        if stamp < EPOCH + SECONDS * 1e9
    ]
    data = read(write_mcap(tmp_path / "drive", without_poses([MOUNTED, *odometry])))
    assert "made from the scans by SLAM" in data.warnings[0]
    assert odometry_error(data) < 0.005


def test_runs_are_cut_by_a_topic_without_poses_too(tmp_path: Path) -> None:
    words = [text(f"go{number}", EPOCH + int(begin * 1e9)) for number, begin in enumerate(DRIVE.begins[:2])]
    data = read(
        write_mcap(tmp_path / "drive", without_poses([MOUNTED, *words])), cut="topic", cut_topic="/robot/command"
    )
    assert [run.id for run in data.trajectories] == ["001-go0", "002-go1"]
    assert odometry_error(data) < 0.005


def test_the_options_under_slam_are_those_of_slam(blind: Path, found: Dataset) -> None:
    other = read(blind, slam={"spacing": 0.3})
    assert not np.array_equal(other.trajectories[0].poses, found.trajectories[0].poses)


def test_a_wrong_option_of_slam_is_refused_before_the_recording_is_read(tmp_path: Path) -> None:
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(ConfigError, match=r"importer 'rosbag': slam: unknown key 'spacng'; did you mean 'spacing'\?"):
        read(tmp_path / "empty.mcap", slam={"spacng": 0.3})
    with pytest.raises(ConfigError, match="slam"):
        read(tmp_path / "empty.mcap", slam=3)


def test_importers_of_other_formats_have_no_options_of_slam(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="importer 'csv': unknown key 'slam'"):
        import_dataset("csv", tmp_path, {"slam": {}})
