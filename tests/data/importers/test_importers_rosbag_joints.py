"""Joints of bags as any driver publishes them: in any unit, as plain numbers, one topic a wheel, steered."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_samples import (
    DRIVE,
    EPOCH,
    SLAM,
    WHEELS,
    Sent,
    changed,
    edited,
    joint_state,
    messages,
    odometry_error,
    part,
    read,
    slam_pose,
    write_mcap,
    write_rosbag1,
)
from tricycle_samples import TRICYCLE, tricycle_drive

from omnibench.data.dataset import Dataset
from omnibench.errors import ConfigError, DataError
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel

TRACKER = [each for each in messages(DRIVE) if each.topic == SLAM]
TURN = 2 * math.pi
TICKS = {"wheel_unit": "ticks", "ticks_per_turn": 4096}


def numbers(topic: str, kind: str, rows: Sequence[Any], late: int = 0) -> list[Sent]:
    """Plain numbers at the stamps of the drive, without a header."""
    layout = {"layout": {"dim": [], "data_offset": 0}} if kind.endswith("Array") else {}
    return [
        Sent(topic, f"std_msgs/msg/{kind}", {"data": row} | layout, int(stamp) + late)
        for stamp, row in zip(DRIVE.stamps, rows, strict=True)
    ]


def ticks(angles: Array, gear: float = 1.0) -> Any:
    return np.round(angles * gear * 4096 / TURN).astype(int)


@pytest.mark.parametrize(
    ("per_radian", "options"),
    [
        (180 / math.pi, {"wheel_unit": "deg"}),
        (np.array([10, 20, 30]) / TURN, {"wheel_unit": "rev", "gear_ratio": [10, 20, 30]}),
        (np.array([100, 200, 300]) / TURN, {"wheel_unit": "ticks", "ticks_per_turn": [100, 200, 300]}),
    ],
)
def test_positions_of_joints_have_any_unit_and_gear(tmp_path: Path, per_radian: Any, options: dict[str, Any]) -> None:
    other = edited(
        part(12.4),
        WHEELS,
        lambda each: changed(each, position=(np.array(each.content["position"]) * per_radian).tolist()),
    )
    assert odometry_error(read(write_mcap(tmp_path / "drive", other), **options)) < 1e-9


def test_velocities_of_joints_may_be_in_rpm_of_the_motor(tmp_path: Path) -> None:
    factor = 25 * 60 / TURN
    rpm = edited(
        messages(DRIVE, velocities=True),
        WHEELS,
        lambda each: changed(each, velocity=[factor * rate for rate in each.content["velocity"]]),
    )
    data = read(write_mcap(tmp_path / "drive", rpm), wheel_unit="rpm", gear_ratio=25)
    assert odometry_error(data) < 1e-9


def test_all_wheels_may_come_as_plain_numbers(tmp_path: Path) -> None:
    rows = np.column_stack([np.zeros(len(DRIVE.stamps), dtype=int), ticks(DRIVE.angles[:, [2, 0, 1]])])
    source = write_rosbag1(tmp_path / "drive", [*TRACKER, *numbers("/enc", "Int32MultiArray", rows)])
    with pytest.raises(ConfigError, match=r"--set wheel_topic=NAME of plain numbers, or a list .*: /enc \(std_msgs"):
        read(source)
    with pytest.raises(
        ConfigError, match=r"--set joints=.* \(numbers of elements\), in that order; joints found: 0, 1, 2, 3"
    ):
        read(source, wheel_topic="/enc", **TICKS)
    data = read(source, wheel_topic="/enc", joints=[2, 3, 1], **TICKS)
    assert odometry_error(data) < 2e-3
    assert f"{source}: topic /enc: its messages have no stamps; they have the times of recording" in data.warnings


def test_every_wheel_may_have_a_topic_of_its_own_at_other_times(tmp_path: Path) -> None:
    topics = [f"/{wheel}/ticks" for wheel in "abc"]
    sent = [
        message
        for index, topic in enumerate(topics)
        for message in numbers(topic, "Int64", ticks(DRIVE.angles[:, index]), late=3_000_000 * index)
    ]
    data = read(write_mcap(tmp_path / "drive", [*TRACKER, *sent]), wheel_topic=topics, **TICKS)
    assert len(data.trajectories) == len(DRIVE.begins)
    assert odometry_error(data) < 0.02  # wheels b and c are 3 and 6 ms late


def test_increments_of_every_message_are_added(tmp_path: Path) -> None:
    steps = np.diff(DRIVE.angles, axis=0, prepend=DRIVE.angles[:1])
    source = write_mcap(tmp_path / "drive", [*TRACKER, *numbers("/steps", "Float64MultiArray", steps)])
    data = read(source, wheel_topic="/steps", wheel_unit="rad/sample")
    assert data.trajectories[0].angles is None
    assert odometry_error(data) < 1e-9


STEERED = tricycle_drive()
STAMPS = EPOCH + np.round((STEERED["t"] - 100) * 1e9).astype(np.int64)
PLACES = [
    slam_pose(stamp, row)
    for stamp, row in zip(STAMPS, zip(*(STEERED[key] for key in ("x", "y", "theta")), strict=True), strict=True)
]  # type: ignore[arg-type]


def steered_error(data: Dataset) -> float:
    model = OdometryModel.of_design(data.robot, "arc")
    return max(float(np.abs(model.poses([run.reference_log])[0] - run.poses[1:]).max()) for run in data.trajectories)


def test_a_steering_joint_is_known_by_its_name(tmp_path: Path) -> None:
    names = ["front_steering_joint", "front_wheel_joint"]
    joints = [
        joint_state(stamp, (math.degrees(phi) / 360 * 8192 % 8192, angle), names=names)
        for stamp, phi, angle in zip(STAMPS, STEERED["phi"], STEERED["angle"], strict=True)
    ]
    options = {"steering_unit": "ticks", "steering_ticks_per_turn": 8192}
    data = read(write_mcap(tmp_path / "drive", [*joints, *PLACES]), robot=TRICYCLE, **options)
    assert steered_error(data) < 1e-9
    unnamed = edited(joints, WHEELS, lambda each: changed(each, name=["m1", "front"]))
    source = write_mcap(tmp_path / "other", [*unnamed, *PLACES])
    with pytest.raises(
        ConfigError,
        match=r"which joints steer the wheels front; --set steering_joints=.*steering_topic.*m1, front",
    ):
        read(source, robot=TRICYCLE, **options)
    assert steered_error(read(source, robot=TRICYCLE, steering_joints="m1", **options)) < 1e-9


def test_steering_angles_of_another_topic_are_interpolated_and_its_gaps_end_runs(tmp_path: Path) -> None:
    wheels = [joint_state(*each, names=["front"]) for each in zip(STAMPS, STEERED["angle"][:, None], strict=True)]
    times = np.arange(0, 20.01, 0.02)
    angles = [
        Sent("/steer", "std_msgs/msg/Float32", {"data": math.degrees(phi)}, EPOCH + int(time * 1e9))
        for time, phi in zip(times, np.interp(times, STEERED["t"] - 100, STEERED["phi"]), strict=True)
    ]
    options: dict[str, Any] = {"robot": TRICYCLE, "steering_topic": "/steer", "steering_unit": "deg"}
    data = read(write_mcap(tmp_path / "drive", [*wheels, *angles, *PLACES]), **options)
    assert steered_error(data) < 1e-3  # corners between two messages are cut
    hole = [each for each in angles if not 8 < (each.logged - EPOCH) / 1e9 < 10]
    data = read(write_mcap(tmp_path / "hole", [*wheels, *hole, *PLACES]), **options)
    assert "wheel samples are missing 1 time while the wheels turned, up to 2" in data.warnings[1]
    assert len(data.trajectories) == 2
    assert steered_error(data) < 5e-3  # of a first sample only the angle at its end is known


def test_topics_that_never_meet_are_named(tmp_path: Path) -> None:
    topics = ["/a", "/b", "/c"]
    sent = [
        each
        for topic in topics
        for each in numbers(topic, "Int64", ticks(DRIVE.angles[:, 0]), late=10**12 * (topic == "/b"))
    ]
    source = write_mcap(tmp_path / "drive", [*TRACKER, *sent])
    with pytest.raises(
        DataError, match=r"topics /a, /b, /c hold no messages of one time; all must be stamped by one clock"
    ):
        read(source, wheel_topic=topics, **TICKS)
