"""Bags of robots that steer whose joints are not measured, not stamped, not there, or in another unit."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_samples import EPOCH, SLAM, WHEELS, Sent, changed, edited, header, joint_state, pose, slam_pose, write_mcap
from bag_samples import read as read_bag
from tricycle_samples import TRICYCLE, tricycle_drive

from omnibench.data.dataset import Dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.robot.model import OdometryModel

DRIVE = tricycle_drive()
STAMPS = EPOCH + np.round((DRIVE["t"] - 100) * 1e9).astype(np.int64)
NAMES = ["front_steering_joint", "front_wheel_joint"]
JOINTS = [
    joint_state(stamp, (phi, angle), names=NAMES)
    for stamp, phi, angle in zip(STAMPS, DRIVE["phi"], DRIVE["angle"], strict=True)
]
PLACES = [
    slam_pose(stamp, (x, y, theta))
    for stamp, x, y, theta in zip(STAMPS, *(DRIVE[key].tolist() for key in ("x", "y", "theta")), strict=True)
]
NOT_MEASURED = (
    r"without a finite position of every joint that steers \(first: message 1\); set steering_joints or steering_topic "
    r"to those that are measured \(joints found: front_steering_joint, front_wheel_joint\)"
)


def steering(edit: Callable[[float], float]) -> list[Sent]:
    """The drive with other positions of the steering joint."""
    turned = [
        changed(each, position=[edit(each.content["position"][0]), each.content["position"][1]]) for each in JOINTS
    ]
    return [*turned, *PLACES]


def read(tmp_path: Path, sent: list[Sent], **options: Any) -> Dataset:
    return read_bag(write_mcap(tmp_path / "drive", sent), robot=TRICYCLE, **options)


def odometry_error(data: Dataset) -> float:
    """Largest difference of the design's odometry from the reference."""
    model = OdometryModel.of_design(data.robot, "arc")
    return max(float(np.abs(model.poses([run.reference_log])[0] - run.poses[1:]).max()) for run in data.trajectories)


def unstamped(sent: list[Sent], topic: str) -> list[Sent]:
    return edited(sent, topic, lambda each: changed(each, header=header(0)))


@pytest.mark.parametrize("placeholder", [math.nan, math.inf])
def test_placeholders_of_a_steering_joint_are_refused_with_the_options_that_choose_another(
    tmp_path: Path, placeholder: float
) -> None:
    with pytest.raises(DataError, match=NOT_MEASURED):
        read(tmp_path, steering(lambda _: placeholder))


def test_joints_without_positions_are_refused_with_the_options_that_choose_others(tmp_path: Path) -> None:
    speeds = edited([*JOINTS, *PLACES], WHEELS, lambda each: changed(each, position=[], velocity=[0.0, 8.0]))
    with pytest.raises(DataError, match=NOT_MEASURED):
        read(tmp_path, speeds)


def test_placeholders_of_a_wheel_name_the_option_that_forces_positions(tmp_path: Path) -> None:
    speeds = edited(
        [*JOINTS, *PLACES],
        WHEELS,
        lambda each: changed(each, position=[each.content["position"][0], math.nan], velocity=[math.nan, 8.0]),
    )
    with pytest.raises(
        DataError, match=r"without a finite position of every wheel .*; leave use=positions out, or set"
    ):
        read(tmp_path, speeds, use="positions")


def test_a_steering_joint_that_a_driver_fills_in_is_warned_of(tmp_path: Path) -> None:
    data = read(tmp_path, steering(lambda _: 0.0))
    assert "the steering angle of wheel front never changes, though the reference shows" in data.warnings[-1]


@pytest.mark.parametrize("topic", [WHEELS, SLAM])
def test_topics_without_header_stamps_may_have_the_times_of_recording(tmp_path: Path, topic: str) -> None:
    sent = unstamped([*JOINTS, *PLACES], topic)
    with pytest.raises(DataError, match=rf"header stamp .*; set recorded_stamps=\[{topic}\] to take the times of"):
        read(tmp_path, sent)
    data = read(tmp_path, sent, recorded_stamps=topic)
    late = 0.003 if topic == WHEELS else 0.2  # s after the stamps these were recorded
    assert odometry_error(data) < 2 * late


def test_each_topic_without_stamps_is_added_to_those_that_are_named(tmp_path: Path) -> None:
    sent = unstamped(unstamped([*JOINTS, *PLACES], WHEELS), SLAM)
    with pytest.raises(DataError, match=rf"set recorded_stamps=\[{WHEELS},{SLAM}\] to take"):
        read(tmp_path, sent, recorded_stamps=WHEELS)
    assert odometry_error(read(tmp_path, sent, recorded_stamps=[WHEELS, SLAM])) < 0.4


def test_topics_of_two_clocks_may_have_the_times_of_recording(tmp_path: Path) -> None:
    sent = edited([*JOINTS, *PLACES], SLAM, lambda each: changed(each, header=header(each.logged - EPOCH + 1)))
    with pytest.raises(DataError, match=rf"by one clock, or set recorded_stamps=\[{WHEELS},{SLAM}\] to take"):
        read(tmp_path, sent)
    assert odometry_error(read(tmp_path, sent, recorded_stamps=[WHEELS, SLAM])) < 0.4


def test_a_topic_to_take_the_times_of_recording_of_must_be_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"recorded_stamps: unknown topic '/joint_states'.*/robot/joint_states"):
        read(tmp_path, [*JOINTS, *PLACES], recorded_stamps="/joint_states")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"steering_joints": "front_steer_joint"},
            r"no joint 'front_steer_joint'; did you mean 'front_steering_joint'?",
        ),
        ({"joints": "front_whel_joint"}, r"no joint 'front_whel_joint'; did you mean 'front_wheel_joint'?"),
        ({"steering_topic": "/robot/joint_state"}, r"steering_topic: .*did you mean '/robot/joint_states'"),
    ],
)
def test_a_joint_or_topic_that_is_missing_is_answered_with_the_nearest_name(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        read(tmp_path, [*JOINTS, *PLACES], **options)


def test_a_bag_without_steering_joints_lists_the_joints_that_it_has(tmp_path: Path) -> None:
    bare = edited(
        [*JOINTS, *PLACES], WHEELS, lambda each: changed(each, name=NAMES[1:], position=each.content["position"][1:])
    )
    with pytest.raises(ConfigError, match=r"joints steer the wheels front; --set steering_joints.*found: front_wh"):
        read(tmp_path, bare)


@pytest.mark.parametrize("every", [1, 4])
def test_a_steering_joint_in_degrees_is_named_however_rarely_it_is_sent(tmp_path: Path, every: int) -> None:
    """At 5 Hz it turns by more than 3 degrees between messages, which are not half turns of radians."""
    turned = steering(math.degrees)
    data = read(tmp_path, [*turned[: len(JOINTS) : every], *PLACES])
    assert "steering angles look like degrees; " in data.warnings[-1]
    assert "steering_unit=deg" in data.warnings[-1]


@pytest.mark.parametrize("signed", [True, False])
@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_ticks_of_a_steering_joint_taken_for_an_angle_are_refused(tmp_path: Path, signed: bool, unit: str) -> None:
    def ticks(angle: float) -> int:
        shown = round(angle * 8192 / (2 * math.pi))
        return shown if signed else shown % 8192

    sent = steering(ticks)
    with pytest.raises(
        DataError, match=rf"read in {unit}, are whole numbers .* --set steering_unit=ticks --set steering_t"
    ):
        read(tmp_path, sent, steering_unit=unit)
    data = read(tmp_path, sent, steering_unit="ticks", steering_ticks_per_turn=8192)
    assert odometry_error(data) < 0.05


def test_an_imported_robot_that_steers_comes_back_from_disk(tmp_path: Path) -> None:
    data = read(tmp_path, [*JOINTS, *PLACES])
    save_dataset(data, tmp_path / "data")
    loaded = load_dataset(tmp_path / "data")
    assert loaded.hash == data.hash
    assert odometry_error(loaded) == odometry_error(data) < 1e-9
    np.testing.assert_array_equal(loaded.trajectories[0].steering, data.trajectories[0].steering)


def test_odometry_that_a_robot_made_of_its_steering_is_refused(tmp_path: Path) -> None:
    """Its wheelbase is wrong, and it takes the newest steering angle."""
    rates, phi = np.diff(DRIVE["angle"]), DRIVE["phi"][1:]
    heading = np.append(0.0, np.cumsum(0.097 * rates * np.sin(phi) / 1.3))
    steps = 0.097 * rates * np.cos(phi) * np.exp(1j * heading[:-1])
    place = np.append(0.0, np.cumsum(steps))
    own = [
        Sent("/odom", "nav_msgs/msg/Odometry", {"header": header(stamp), "pose": {"pose": pose(row)}}, int(stamp))
        for stamp, row in zip(STAMPS, np.column_stack([place.real, place.imag, heading]), strict=True)
    ]
    with pytest.raises(
        ConfigError, match=r"the only poses are /odom .* if one is independent of the wheels, set pose_t"
    ):
        read(tmp_path, [*JOINTS, *own])
    with pytest.raises(
        DataError, match=r"/odom is the robot's own odometry: .* --set pose_topic=NAME of an independent refer"
    ):
        read(tmp_path, [*JOINTS, *own], pose_topic="/odom")
