"""Odometry and transforms as the reference of a bag: only when named, and never the robot's own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_samples import (
    DRIVE,
    ROBOT,
    TRUTH,
    WHEELS,
    Sent,
    header,
    messages,
    odometry_error,
    pose,
    read,
    transform,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)

from omnibench.errors import ConfigError, DataError
from omnibench.robot.kinematics import Array, compose, relative
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, WheelLog

WHEELS_ONLY = [each for each in messages(DRIVE) if each.topic == WHEELS]
OWN = "is the robot's own odometry: .* --set pose_topic=NAME of an independent reference"


def odometry(poses: Array, stamps: Array = DRIVE.pose_stamps) -> list[Sent]:
    return [
        Sent("/tracker", "nav_msgs/msg/Odometry", {"header": header(stamp), "pose": {"pose": pose(place)}}, int(stamp))
        for stamp, place in zip(stamps, poses, strict=True)
    ]


def transforms(parent: str, child: str, stamps: Array, poses: Array, topic: str = "/tf") -> list[Sent]:
    return [
        Sent(
            topic,
            "tf2_msgs/msg/TFMessage",
            {"transforms": [{"header": header(stamp, parent), "child_frame_id": child, "transform": transform(place)}]},
            int(stamp),
        )
        for stamp, place in zip(stamps, poses, strict=True)
    ]


def noisy(poses: Array) -> Array:
    return poses + np.random.default_rng(0).normal(0, (1e-3, 1e-3, 2e-3), poses.shape)


def test_odometry_is_no_reference_unless_named(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", [*WHEELS_ONLY, *odometry(noisy(DRIVE.poses))])
    with pytest.raises(
        ConfigError, match=r"the only poses are /tracker \(nav_msgs/msg/Odometry.* set pose_topic to it"
    ):
        read(source)
    assert odometry_error(read(source, pose_topic="tracker")) < 0.05


@pytest.mark.parametrize("late", [0, 7_000_000, 20_000_000])
@pytest.mark.parametrize("integration", ["euler", "arc"])
def test_odometry_that_the_robot_made_of_its_wheels_is_refused(
    tmp_path: Path, late: int, integration: Integration
) -> None:
    wrong = TRUTH * np.array([[1.1], [1.1], [0.9]])  # radii and distances that the driver was told
    log = WheelLog(
        (DRIVE.stamps[1:] - DRIVE.stamps[0]) / 1e9,
        DRIVE.rates,
        np.zeros(3),
        (DRIVE.stamps[1::3] - DRIVE.stamps[0]) / 1e9,
    )
    (poses,) = OdometryModel(ROBOT, wrong, integration).poses([log])
    source = write_mcap(tmp_path / "drive", [*WHEELS_ONLY, *odometry(poses, DRIVE.stamps[1::3] + late)])
    with pytest.raises(DataError, match=f"/tracker {OWN}"):
        read(source, pose_topic="/tracker")


@pytest.mark.parametrize("write", [write_mcap, write_rosbag1, write_rosbag2])
def test_a_tracker_s_transform_is_a_reference_when_named(tmp_path: Path, write: Any) -> None:
    tracked = transforms("world", "tracker/robot", DRIVE.pose_stamps, noisy(DRIVE.poses))
    other = transforms("world", "tracker/cart", DRIVE.pose_stamps, DRIVE.poses * 2)
    source = write(tmp_path / "drive", [*WHEELS_ONLY, *tracked, *other])
    with pytest.raises(ConfigError, match=r"pose_frames=\[world, robot\].*found: world > tracker/.*, world > tracker/"):
        read(source, pose_topic="/tf")
    with pytest.raises(
        ConfigError, match=r"no transforms lead from world to tracker/robt; did you mean 'tracker/robot'"
    ):
        read(source, pose_topic="/tf", pose_frames=["world", "tracker/robt"])
    assert odometry_error(read(source, pose_topic="/tf", pose_frames=["world", "/tracker/robot"])) < 0.05


def test_transforms_between_are_composed_at_the_stamps_of_the_rarest(tmp_path: Path) -> None:
    """A localisation corrects the odometry's frame, and the body is mounted ahead of the base."""
    mount = np.array([0.1, 0.0, 0.0])
    base = compose(noisy(DRIVE.poses), -mount)
    drifting = np.cumsum(np.random.default_rng(2).normal(0, 0.01, DRIVE.poses.shape), axis=0)
    sent: Sequence[Sent] = [
        *WHEELS_ONLY,
        *transforms("odom", "base", DRIVE.pose_stamps, drifting),
        *transforms("map", "odom", DRIVE.pose_stamps[::2], inverse_of(base, drifting)[::2]),
        *transforms("base", "body", DRIVE.pose_stamps[:1], mount[None], "/tf_static"),
    ]
    data = read(write_mcap(tmp_path / "drive", sent), pose_topic="/tf", pose_frames=["map", "body"])
    assert odometry_error(data) < 0.05
    assert np.median(np.diff(data.trajectories[0].pose_times)) == pytest.approx(0.5)


def inverse_of(whole: Array, second: Array) -> Array:
    """Poses with which compose(first, second) is the whole."""
    return compose(whole, relative(second, np.zeros(3)))


def test_transforms_that_the_robot_made_of_its_wheels_are_refused(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", [*WHEELS_ONLY, *transforms("odom", "base", DRIVE.pose_stamps, DRIVE.poses)])
    with pytest.raises(DataError, match=f"/tf {OWN}"):
        read(source, pose_topic="/tf", pose_frames=["odom", "base"])
