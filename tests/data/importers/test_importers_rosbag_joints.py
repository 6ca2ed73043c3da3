"""Wheels and poses of bags by joints and fields of any message; recordings that are not as they should be; odometry."""

import math
import random
import re
import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_samples import (
    DRIVE,
    EPOCH,
    FORMATS,
    ROBOT,
    ROS1,
    ROS2,
    RUN,
    SLAM,
    TRUTH,
    WHEELS,
    Sent,
    changed,
    edited,
    header,
    joint_state,
    messages,
    odometry,
    odometry_error,
    part,
    pose,
    read,
    slam_pose,
    stamp_of,
    stamped,
    text,
    transform,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)
from commands import refused
from mcap.writer import IndexType
from rosbags.typesys import get_types_from_msg
from tricycle_samples import TRICYCLE, tricycle_drive

from omnibench.check.check import check
from omnibench.data.dataset import Dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.robot.kinematics import Array, compose, relative
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, WheelLog

TRACKER = [each for each in messages(DRIVE) if each.topic == SLAM]
WHEELS_ONLY = [each for each in messages(DRIVE) if each.topic == WHEELS]
TURN = 2 * math.pi
TICKS: dict[str, Any] = {"wheel_unit": "ticks", "ticks_per_turn": 4096}


def noisy(poses: Array) -> Array:
    return poses + np.random.default_rng(0).normal(0, (1e-3, 1e-3, 2e-3), poses.shape)


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
        (25 * 60 / TURN, {"wheel_unit": "rpm", "gear_ratio": 25}),
    ],
)
def test_joints_have_any_unit_and_gear(tmp_path: Path, per_radian: Any, options: dict[str, Any]) -> None:
    rates = options["wheel_unit"] == "rpm"
    key = "velocity" if rates else "position"
    other = edited(
        messages(DRIVE, velocities=True) if rates else part(12.4),
        WHEELS,
        lambda each: changed(each, **{key: (np.array(each.content[key]) * per_radian).tolist()}),
    )
    assert odometry_error(read(write_mcap(tmp_path / "drive", other), **options)) < 1e-9


def test_all_wheels_may_come_as_plain_numbers(tmp_path: Path) -> None:
    rows = np.column_stack([np.zeros(len(DRIVE.stamps), dtype=int), ticks(DRIVE.angles[:, [2, 0, 1]])])
    source = write_rosbag1(tmp_path / "drive", [*TRACKER, *numbers("/enc", "Int32MultiArray", rows)])
    with pytest.raises(DataError, match=r"topics found: /enc \(std_msgs.*are the wheels in --set wheel_topic=/enc\?"):
        read(source)
    with pytest.raises(ConfigError, match=r"--set joints=.*joints found: 0, 1, 2, 3"):
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


def test_topics_that_never_meet_are_named(tmp_path: Path) -> None:
    topics = ["/a", "/b", "/c"]
    sent = [
        each
        for topic in topics
        for each in numbers(topic, "Int64", ticks(DRIVE.angles[:, 0]), late=10**12 * (topic == "/b"))
    ]
    source = write_mcap(tmp_path / "drive", [*TRACKER, *sent])
    with pytest.raises(DataError, match=r"topics /a, /b, /c "):
        read(source, wheel_topic=topics, **TICKS)


STEERED = tricycle_drive()
STAMPS = EPOCH + np.round((STEERED["t"] - 100) * 1e9).astype(np.int64)
NAMES = ["front_steering_joint", "front_wheel_joint"]
JOINTS = [
    joint_state(stamp, (phi, angle), names=NAMES)
    for stamp, phi, angle in zip(STAMPS, STEERED["phi"], STEERED["angle"], strict=True)
]
PLACES = [
    slam_pose(stamp, place)
    for stamp, *place in zip(STAMPS, *(STEERED[key].tolist() for key in ("x", "y", "theta")), strict=True)
]
BOTH = [*JOINTS, *PLACES]


def steering(edit: Callable[[float], float]) -> list[Sent]:
    """The drive with other positions of the steering joint."""
    return edited(
        BOTH,
        WHEELS,
        lambda each: changed(each, position=[edit(each.content["position"][0]), *each.content["position"][1:]]),
    )


def read_steered(tmp_path: Path, sent: Sequence[Sent], **options: Any) -> Dataset:
    return read(write_mcap(tmp_path / "drive", sent), robot=TRICYCLE, **options)


def steered_error(data: Dataset) -> float:
    """Largest difference of the design's odometry from the reference."""
    return odometry_error(data, OdometryModel.of_design(data.robot, "arc"))


def test_a_steering_joint_is_known_by_its_name_and_comes_back_from_disk(tmp_path: Path) -> None:
    data = read_steered(tmp_path, BOTH)
    assert steered_error(data) < 1e-9
    save_dataset(data, tmp_path / "data")
    assert load_dataset(tmp_path / "data").hash == data.hash
    unnamed = edited(BOTH, WHEELS, lambda each: changed(each, name=["m1", "front"]))
    with pytest.raises(ConfigError, match=r"--set steering_joints=.*steering_topic.*m1, front"):
        read_steered(tmp_path, unnamed)
    assert steered_error(read_steered(tmp_path, unnamed, steering_joints="m1")) < 1e-9


def test_steering_angles_of_another_topic_are_interpolated_and_its_gaps_end_runs(tmp_path: Path) -> None:
    wheels = [joint_state(*each, names=["front"]) for each in zip(STAMPS, STEERED["angle"][:, None], strict=True)]
    times = np.arange(0, 20.01, 0.02)
    angles = [
        Sent("/steer", "std_msgs/msg/Float32", {"data": math.degrees(phi)}, EPOCH + int(time * 1e9))
        for time, phi in zip(times, np.interp(times, STEERED["t"] - 100, STEERED["phi"]), strict=True)
    ]
    options: dict[str, Any] = {"steering_topic": "/steer", "steering_unit": "deg"}
    data = read_steered(tmp_path, [*wheels, *angles, *PLACES], **options)
    assert steered_error(data) < 1e-3  # corners between two messages are cut
    hole = [each for each in angles if not 8 < (each.logged - EPOCH) / 1e9 < 10]
    data = read_steered(tmp_path, [*wheels, *hole, *PLACES], **options)
    assert "wheel samples are missing 1 time while the wheels turned, up to 2" in data.warnings[1]
    assert len(data.trajectories) == 2
    assert steered_error(data) < 5e-3  # of a first sample only the angle at its end is known


def only_speeds(each: Sent) -> Sent:
    return changed(each, position=[], velocity=[0.0, 8.0])


def no_wheel(each: Sent) -> Sent:
    return changed(each, position=[each.content["position"][0], math.nan], velocity=[math.nan, 8.0])


def no_steering(each: Sent) -> Sent:
    return changed(each, name=NAMES[1:], position=each.content["position"][1:])


@pytest.mark.parametrize(
    ("sent", "options", "message"),
    [
        (steering(lambda _: math.nan), {}, "steering_joints or steering_topic .*found: front_steering_joint, front_wh"),
        (edited(BOTH, WHEELS, only_speeds), {}, "steering_joints or steering_topic .*found: front_steering_joint"),
        (edited(BOTH, WHEELS, no_wheel), {"use": "positions"}, "every wheel .*use=positions"),
        (edited(BOTH, WHEELS, no_steering), {}, "--set steering_joints.*found: front_wheel_joint"),
        (BOTH, {"recorded_stamps": "/joint_states"}, "recorded_stamps: .*'/joint_states'.*/robot/joint_states"),
        (BOTH, {"steering_joints": "front_steer_joint"}, "'front_steer_joint'; did you mean 'front_steering_joint'"),
        (BOTH, {"joints": "front_whel_joint"}, "'front_whel_joint'; did you mean 'front_wheel_joint'"),
        (BOTH, {"steering_topic": "/robot/joint_state"}, "steering_topic: .*did you mean '/robot/joint_states'"),
    ],
)
def test_missing_joints_are_refused(tmp_path: Path, sent: list[Sent], options: dict[str, Any], message: str) -> None:
    with pytest.raises((ConfigError, DataError), match=message):
        read_steered(tmp_path, sent, **options)


def unstamped(sent: list[Sent], topic: str) -> list[Sent]:
    return edited(sent, topic, lambda each: changed(each, header=header(0)))


@pytest.mark.parametrize(
    ("sent", "named", "missing"),
    [
        (unstamped(BOTH, WHEELS), [], [WHEELS]),
        (unstamped(BOTH, SLAM), [], [SLAM]),
        (unstamped(unstamped(BOTH, WHEELS), SLAM), [WHEELS], [WHEELS, SLAM]),
    ],
    ids=["wheels", "poses", "both"],
)
def test_topics_without_header_stamps_may_have_the_times_of_recording(
    tmp_path: Path, sent: list[Sent], named: list[str], missing: list[str]
) -> None:
    with pytest.raises(DataError, match=rf"set recorded_stamps=\[{','.join(missing)}\]"):
        read_steered(tmp_path, sent, recorded_stamps=named)
    # Wheels are recorded 3 ms after their stamps, poses 0.2 s.
    late = 0.003 if missing == [WHEELS] else 0.2
    assert steered_error(read_steered(tmp_path, sent, recorded_stamps=missing)) < 2 * late


def test_a_steering_joint_in_degrees_or_ticks_is_named_with_its_unit(tmp_path: Path) -> None:
    findings = check(read_steered(tmp_path, steering(math.degrees))).findings
    assert "steering_unit=deg" in {finding.fix for finding in findings}
    sent = steering(lambda angle: round(angle * 8192 / TURN) % 8192)
    with pytest.raises(DataError, match=r"read in rad, .*--set steering_unit=ticks --set steering_t"):
        read_steered(tmp_path, sent)
    data = read_steered(tmp_path, sent, steering_unit="ticks", steering_ticks_per_turn=8192)
    assert steered_error(data) < 0.05


def test_odometry_that_a_robot_made_of_its_steering_is_refused(tmp_path: Path) -> None:
    """Its wheelbase is wrong, and it takes the newest steering angle."""
    rates, phi = np.diff(STEERED["angle"]), STEERED["phi"][1:]
    heading = np.append(0.0, np.cumsum(0.097 * rates * np.sin(phi) / 1.3))
    steps = 0.097 * rates * np.cos(phi) * np.exp(1j * heading[:-1])
    place = np.append(0.0, np.cumsum(steps))
    own = odometry(np.column_stack([place.real, place.imag, heading]), STAMPS, "/odom")
    with pytest.raises(ConfigError, match=r"the only poses are /odom .*pose_t"):
        read_steered(tmp_path, [*JOINTS, *own])
    with pytest.raises(DataError, match=r"/odom is the robot's own odometry: .*--set pose_topic=NAME"):
        read_steered(tmp_path, [*JOINTS, *own], pose_topic="/odom")


TILTED = {"x": 0.5**0.5, "w": 0.5**0.5}


def test_messages_recorded_out_of_order_are_sorted_and_counted(tmp_path: Path) -> None:
    late = edited(part(12.4), WHEELS, lambda each: replace(each, logged=each.logged + 50_000_000), every=9)
    data = read(write_mcap(tmp_path / "drive", late))
    count = sum(each.topic == WHEELS for each in part(12.4)) // 9
    assert f"topic {WHEELS}: {count} messages recorded late, and sorted" in data.warnings[0]
    assert odometry_error(data) < 1e-9


def test_repeated_messages_are_left_out_and_counted(tmp_path: Path) -> None:
    data = read(write_mcap(tmp_path / "drive", [*part(12.4), *part(12.4)[10:15]]))
    assert "5 of 625 messages left out: 5 with a repeated stamp (first: message " in data.warnings[0]
    assert odometry_error(data) < 1e-9


@pytest.mark.parametrize(
    ("topic", "edit", "message"),
    [
        (WHEELS, lambda each: changed(each, position=[1.0, math.nan, 1.0]), "without a finite position of every wheel"),
        (WHEELS, lambda each: changed(each, position=[1.0, 1e300, 1.0]), "without a finite position of every wheel"),
        (WHEELS, lambda each: changed(each, position=[1.0]), "without a finite position of every wheel"),
        (WHEELS, lambda each: changed(each, header=header(0)), "without a header stamp"),
        (WHEELS, lambda each: replace(each, content=b"\0\1\0\0garbage"), "that cannot be decoded"),
        (SLAM, lambda each: changed(each, header=header(0)), "without a header stamp"),
        (SLAM, lambda each: changed(each, pose={"pose": pose((math.inf, 0, 0))}), "without a finite position"),
        (SLAM, lambda each: changed(each, pose={}), "with a wrong orientation, as quaternion has length 0"),
        (SLAM, lambda each: changed(each, pose={"pose": {"orientation": TILTED}}), "with a wrong orientation, .*90 "),
    ],
)
def test_useless_messages_are_left_out_and_too_many_are_refused(
    tmp_path: Path, topic: str, edit: Callable[[Sent], Sent], message: str
) -> None:
    data = read(write_mcap(tmp_path / "some", edited(part(12.4), topic, edit, every=7)))
    assert len(data.warnings) == 1
    assert re.search(rf"some\.mcap: topic {topic}: .*left out: \d+ {message}", data.warnings[0])
    assert odometry_error(data) < 1e-3
    with pytest.raises(DataError, match=rf"all\.mcap: topic {topic}: (\d+) of \1 messages left out: \1 {message}"):
        read(write_mcap(tmp_path / "all", edited(part(12.4), topic, edit)))


def in_degrees(each: Sent) -> Sent:
    return changed(each, position=np.degrees(each.content["position"]).tolist())


@pytest.mark.parametrize(
    ("sent", "message"),
    [
        (edited(part(7), SLAM, lambda each: changed(each, header=header(0))), r"the publisher must fill header\.stamp"),
        (
            [*part(12), *(replace(each, logged=each.logged + 20 * 10**9) for each in part(12))],
            r"message \d+: the stamps go back by 12 s",
        ),
        (edited(part(5), WHEELS, in_degrees), r"wheels, read in rad, turn at up to \d+ rad/s; --set wheel_unit"),
        (part(1.4), "the wheels rest all the time"),
        (
            [each for each in part(7) if each.topic == WHEELS or each.logged < EPOCH + 0.9e9],
            "1 with fewer than two poses",
        ),
    ],
    ids=["no stamps", "clock set back", "degrees", "no motion", "no poses"],
)
def test_a_recording_without_one_sound_run_is_refused(tmp_path: Path, sent: list[Sent], message: str) -> None:
    with pytest.raises(DataError, match=message):
        read(write_mcap(tmp_path / "drive", sent))


@pytest.mark.parametrize("missing", [WHEELS, SLAM])
def test_a_missing_topic_is_named_with_those_that_are_there(tmp_path: Path, missing: str) -> None:
    (other,) = {WHEELS, SLAM} - {missing}
    with pytest.raises(DataError, match=rf"no messages of type \S.*; topics found: {other} \("):
        read(write_mcap(tmp_path / "drive", [each for each in part(7) if each.topic == other]))


def test_an_empty_topic_is_named(tmp_path: Path) -> None:
    source = write_rosbag2(tmp_path / "drive", [each for each in part(7) if each.topic == WHEELS], empty=[SLAM])
    with pytest.raises(DataError, match=r"no messages of type .*found: .*/robot/slam_pose \(\S+, 0 messages\)"):
        read(source)
    with pytest.raises(DataError, match=r"pose_topic: topic /robot/slam_pose has no messages"):
        read(source, pose_topic=SLAM)


@FORMATS
def test_a_bag_cut_off_is_refused_in_one_line(tmp_path: Path, write: Callable[[Path, Sequence[Sent]], Path]) -> None:
    source = write(tmp_path / "drive", part(7))
    file = source if source.is_file() else max(source.iterdir(), key=lambda each: each.stat().st_size)
    content = file.read_bytes()
    for length in (0, 20, len(content) // 3, len(content) * 9 // 10):
        file.write_bytes(content[:length])
        with refused(DataError, match=r"drive\S*: cannot be read as a bag: .*broke off"):
            read(source)


@pytest.mark.slow
@FORMATS
def test_damage_never_shows_as_a_traceback(tmp_path: Path, write: Callable[[Path, Sequence[Sent]], Path]) -> None:
    source = write(tmp_path / "drive", part(7))
    files = [source] if source.is_file() else sorted(source.iterdir())
    rng, told = random.Random(7), 0
    for _ in range(25):
        file = rng.choice(files)
        content = file.read_bytes()
        damaged = bytearray(content)
        for _ in range(3):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        file.write_bytes(damaged)
        try:
            read(source)
        except OmnibenchError:
            told += 1
        file.write_bytes(content)
    assert told


def test_an_mcap_whose_recorder_was_killed_is_read_without_its_index(tmp_path: Path) -> None:
    options = {"use_statistics": False, "use_summary_offsets": False, "repeat_channels": False, "repeat_schemas": False}
    plain = write_mcap(tmp_path / "drive", part(12.4), index_types=IndexType.NONE, **options)
    assert odometry_error(read(plain)) < 1e-9


def test_messages_that_the_index_does_not_find_are_told(tmp_path: Path) -> None:
    lost = write_mcap(tmp_path / "drive", part(12.4), index_types=IndexType.CHUNK)
    with pytest.raises(DataError, match=r"only 0 of \d+ messages on /robot/joint_states can be found; its index"):
        read(lost)


def test_a_profile_other_than_ros2_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read as a bag: Profile is not ros2"):
        read(write_mcap(tmp_path / "drive", part(2), profile=""))


OWN = "is the robot's own odometry: .* --set pose_topic=NAME"


def transforms(parent: str, child: str, stamps: Array, poses: Array, topic: str = "/tf") -> list[Sent]:
    placed = [{"child_frame_id": child, "transform": transform(place)} for place in poses]
    stamps_of = [{"header": header(stamp, parent)} for stamp in stamps]
    contents = [{"transforms": [one | other]} for one, other in zip(placed, stamps_of, strict=True)]
    return stamped(topic, "tf2_msgs/msg/TFMessage", stamps, contents)


def test_odometry_is_no_reference_unless_named(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", [*WHEELS_ONLY, *odometry(noisy(DRIVE.poses), DRIVE.pose_stamps)])
    with pytest.raises(ConfigError, match=r"the only poses are /tracker .* set pose_topic"):
        read(source)
    assert odometry_error(read(source, pose_topic="tracker")) < 0.05


@pytest.mark.parametrize(("late", "integration"), [(0, "euler"), (20_000_000, "arc")])
def test_odometry_that_the_robot_made_itself_is_refused(tmp_path: Path, late: int, integration: Integration) -> None:
    wrong = TRUTH * np.array([[1.1], [1.1], [0.9]])  # radii and distances that the driver was told
    seconds = (DRIVE.stamps - DRIVE.stamps[0]) / 1e9
    log = WheelLog(seconds[1:], DRIVE.rates, np.zeros(3), seconds[1::3])
    (poses,) = OdometryModel(ROBOT, wrong, integration).poses([log])
    source = write_mcap(tmp_path / "drive", [*WHEELS_ONLY, *odometry(poses, DRIVE.stamps[1::3] + late)])
    with pytest.raises(DataError, match=f"/tracker {OWN}"):
        read(source, pose_topic="/tracker")


@pytest.mark.parametrize("write", [write_mcap, write_rosbag1, pytest.param(write_rosbag2, marks=pytest.mark.slow)])
def test_a_tracker_s_transform_is_a_reference_when_named(tmp_path: Path, write: Any) -> None:
    tracked = transforms("world", "tracker/robot", DRIVE.pose_stamps, noisy(DRIVE.poses))
    other = transforms("world", "tracker/cart", DRIVE.pose_stamps, DRIVE.poses * 2)
    source = write(tmp_path / "drive", [*WHEELS_ONLY, *tracked, *other])
    with pytest.raises(ConfigError, match=r"pose_frames=\[world, robot\].*found: world > tracker/.*, world > tracker/"):
        read(source, pose_topic="/tf")
    with pytest.raises(ConfigError, match=r"tracker/robt; did you mean 'tracker/robot'"):
        read(source, pose_topic="/tf", pose_frames=["world", "tracker/robt"])
    assert odometry_error(read(source, pose_topic="/tf", pose_frames=["world", "/tracker/robot"])) < 0.05


def test_transforms_between_are_composed_at_the_stamps_of_the_rarest(tmp_path: Path) -> None:
    """A localisation corrects the odometry's frame, and the body is mounted ahead of the base."""
    mount = np.array([0.1, 0.0, 0.0])
    base = compose(noisy(DRIVE.poses), -mount)
    drifting = np.cumsum(np.random.default_rng(2).normal(0, 0.01, DRIVE.poses.shape), axis=0)
    correcting = compose(base, relative(drifting, np.zeros(3)))
    sent: Sequence[Sent] = [
        *WHEELS_ONLY,
        *transforms("odom", "base", DRIVE.pose_stamps, drifting),
        *transforms("map", "odom", DRIVE.pose_stamps[::2], correcting[::2]),
        *transforms("base", "body", DRIVE.pose_stamps[:1], mount[None], "/tf_static"),
    ]
    data = read(write_mcap(tmp_path / "drive", sent), pose_topic="/tf", pose_frames=["map", "body"])
    assert odometry_error(data) < 0.05
    assert np.median(np.diff(data.trajectories[0].pose_times)) == pytest.approx(0.5)


def test_transforms_that_the_robot_made_of_its_wheels_are_refused(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", [*WHEELS_ONLY, *transforms("odom", "base", DRIVE.pose_stamps, DRIVE.poses)])
    with pytest.raises(DataError, match=f"/tf {OWN}"):
        read(source, pose_topic="/tf", pose_frames=["odom", "base"])


DEFINITIONS = {
    "base_msgs/msg/Motor": "int32 ticks\nfloat64 angle\n",
    "base_msgs/msg/Status": "std_msgs/Header header\nfloat32 battery\nbase_msgs/Motor[] motors\nfloat64[3] wheel\n",
    "base_msgs/msg/Tick": "std_msgs/Header header\nint32 data\nuint16 resolution\n",
    "base_msgs/msg/Located": "std_msgs/Header header\ngeometry_msgs/Pose place\nfloat64 x\nfloat64 y\nfloat64 yaw\n",
}
for _store in (ROS1, ROS2):
    for _name, _definition in DEFINITIONS.items():
        _store.register(get_types_from_msg(_definition, _name))
BY_PATH = ["motors.2.angle", "motors.0.angle", "motors.1.angle"]


def status() -> list[Sent]:
    """The wheels c, a, b as parts of a message of the base."""
    contents = [
        {
            "battery": 24.0,
            "motors": [{"ticks": 0, "angle": float(angles[wheel])} for wheel in (1, 2, 0)],
            "wheel": np.degrees(angles).tolist(),
        }
        for angles in DRIVE.angles
    ]
    return stamped("/status", "base_msgs/msg/Status", DRIVE.stamps, contents)


def tick_messages(late: int = 3_000_000, bits: int = 31) -> list[Sent]:
    """A message a wheel, of 4096 ticks a turn, whose counters begin again."""
    counted = np.floor(DRIVE.angles * 4096 / (2 * math.pi)).astype(int)
    shown = (counted + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1)
    sent: list[Sent] = []
    for index, wheel in enumerate("abc"):
        contents = [{"data": int(count), "resolution": 4096} for count in shown[:, index]]
        sent += stamped(f"/motor_{wheel}/tick", "base_msgs/msg/Tick", DRIVE.stamps + late * index, contents)
    return sent


def located() -> list[Sent]:
    """The reference as a pose within a message, and as three numbers, m and deg."""
    contents = [
        {"place": pose(place), "x": place[0], "y": place[1], "yaw": math.degrees(place[2])}
        for place in noisy(DRIVE.poses).tolist()
    ]
    return stamped("/camera", "base_msgs/msg/Located", DRIVE.pose_stamps, contents)


@pytest.mark.parametrize("write", [write_mcap, write_rosbag1])
def test_wheels_are_read_from_fields_of_any_message(tmp_path: Path, write: Callable[..., Path]) -> None:
    source = write(tmp_path / "drive", [*TRACKER, *status()])
    data = read(source, wheel_topic="/status", joints=BY_PATH)
    assert len(data.trajectories) == len(DRIVE.begins)
    assert data.warnings == ()
    assert odometry_error(data) < 1e-9
    others = read(source, wheel_topic="/status", joints=["wheel.0", "wheel.1", "wheel.2"], wheel_unit="deg")
    assert odometry_error(others) < 1e-9


def test_poses_are_read_from_fields_of_any_message(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", [*WHEELS_ONLY, *located(), text("go", EPOCH, "/word")])
    for options in ({"pose_columns": ["place"]}, {"pose_columns": ["x", "y", "yaw"], "heading_unit": "deg"}):
        assert odometry_error(read(source, pose_topic="/camera", **options)) < 0.05
    with pytest.raises(DataError, match=r"poses in other messages: --set pose_topic=NAME --set pose_columns"):
        read(source)
    with refused(ConfigError, match=r"pose_topic: /camera is .*or --set pose_columns=.*place,.*x, y, yaw"):
        read(source, pose_topic="/camera")
    with refused(ConfigError, match=r"pose_columns: /word .* has no field 'data'; its numbers: none"):
        read(source, pose_topic="/word", pose_columns="data")
    with refused(ConfigError, match=r"pose_columns: .* has no field 'plac'; did you mean 'place'\?"):
        read(source, pose_topic="/camera", pose_columns="plac")
    with refused(ConfigError, match="pose_columns: yaw of /camera .* is no geometry pose"):
        read(source, pose_topic="/camera", pose_columns="yaw")
    with refused(ConfigError, match="pose_columns needs pose_topic"):
        read(source, pose_columns=["x", "y", "yaw"])


def test_each_wheel_may_have_a_topic_whose_counter_begins_again(tmp_path: Path) -> None:
    """Counts between two messages of a wheel are interpolated only after they were counted on."""
    topics = [f"/motor_{wheel}/tick" for wheel in "abc"]
    source = write_mcap(tmp_path / "drive", [*TRACKER, *tick_messages(bits=12)])
    data = read(source, wheel_topic=topics, joints=["data", "data", "data"], **TICKS)
    assert any("begin again after 4096 ticks" in warning for warning in data.warnings)
    assert len(data.trajectories) == len(DRIVE.begins)
    assert odometry_error(data) < 5e-3  # of ticks
    with refused(ConfigError, match="joints names one joint twice"):
        read(source, wheel_topic=topics[0], joints=["data", "data", "data"], **TICKS)


@pytest.mark.parametrize(
    ("sent", "typed"),
    [
        (
            tick_messages(),
            r"--set wheel_topic=\[/motor_a/tick,/motor_b/tick,/motor_c/tick\] --set \"joints=\[data,data,data\]\"",
        ),
        (
            status(),
            r"--set wheel_topic=/status --set \"joints=\[motors\.0\.ticks,motors\.0\.angle,wheel\.0\]\".*battery",
        ),
    ],
    ids=["a topic each", "one topic"],
)
def test_without_a_joint_state_the_error_says_what_to_type(tmp_path: Path, sent: list[Sent], typed: str) -> None:
    source = write_mcap(tmp_path / "drive", [*TRACKER, *sent])
    with refused(DataError, match=rf"topics found: .*{sent[0].kind}.*; are the wheels in {typed}"):
        read(source)
    with refused(ConfigError, match=r"wheel_topic: \S+ is base_msgs.*--set \"joints="):
        read(source, wheel_topic=sent[0].topic)


def test_a_field_that_is_not_there_is_named(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", [*TRACKER, *status()])
    with refused(
        ConfigError, match=r"joints: /status .* has no field 'motors\.0\.angel'; did you mean 'motors\.0\.angle'"
    ):
        read(source, wheel_topic="/status", joints=["motors.0.angel", *BY_PATH[1:]])
    with refused(DataError, match="messages left out: .* that cannot be decoded"):
        read(source, wheel_topic="/status", joints=["motors.7.angle", *BY_PATH[1:]])


@pytest.mark.parametrize("inside", ["msg", ""])
def test_definitions_may_be_given_of_types_that_a_bag_does_not_define(tmp_path: Path, inside: str) -> None:
    source = write_rosbag2(tmp_path / "drive", [*TRACKER, *status()])
    with sqlite3.connect(source / "drive.db3") as connection:  # as recorders before ROS 2 Iron write it
        connection.execute("DELETE FROM message_definitions")
    options: dict[str, Any] = {"wheel_topic": "/status", "joints": BY_PATH}
    with refused(ConfigError, match=r"the bag does not define its messages; .*--set message_definitions=FOLDER"):
        read(source, **options)
    folder = tmp_path / "share" / "base_msgs" / inside
    folder.mkdir(parents=True)
    for name in ("Motor", "Status"):
        (folder / f"{name}.msg").write_text(DEFINITIONS[f"base_msgs/msg/{name}"])
    assert odometry_error(read(source, message_definitions=str(tmp_path / "share"), **options)) < 1e-9
    files = [str(file) for file in folder.iterdir()]
    assert odometry_error(read(source, message_definitions=files, **options)) < 1e-9
    (folder / "Motor.msg").write_text("int32 !\n")
    with refused(DataError, match=r"Motor\.msg: cannot be read as the definition of a message"):
        read(source, message_definitions=[str(tmp_path / "share")], **options)


def test_definitions_may_hold_messages_of_ros_that_a_bag_does_not_define(tmp_path: Path) -> None:
    source = write_rosbag2(tmp_path / "drive", [*WHEELS_ONLY, *located()])
    with sqlite3.connect(source / "drive.db3") as connection:
        connection.execute("DELETE FROM message_definitions WHERE topic_type = 'base_msgs/msg/Located'")
    folder = tmp_path / "base_msgs"
    folder.mkdir()
    (folder / "Located.msg").write_text(DEFINITIONS["base_msgs/msg/Located"])
    data = read(source, message_definitions=str(folder), pose_topic="/camera", pose_columns=["place"])
    assert len(data.trajectories) == len(DRIVE.begins)


def twists(
    sent: Sequence[tuple[float, float, float]], topic: str = "/robot/cmd_vel", stamped: bool = False
) -> list[Sent]:
    """A twist sent every 0.1 s of each run, x, y and turn; 0 at the end."""
    result = []
    for begin, (x, y, turn) in zip(DRIVE.begins, sent, strict=False):
        for step in range(round(RUN / 0.1) + 1):
            share = step * 0.1 < RUN
            content: dict[str, Any] = {
                "linear": {"x": x * share, "y": y * share, "z": 0.0},
                "angular": {"x": 0.0, "y": 0.0, "z": turn * share},
            }
            stamp = EPOCH + int((begin + 0.1 * step) * 1e9)
            if stamped:
                content = {"header": header(stamp), "twist": content}
            result.append(Sent(topic, f"geometry_msgs/msg/Twist{'Stamped' if stamped else ''}", content, stamp))
    return result


SENT = [(0.3, 0.0, 0.6), (0.3, 0.0, 0.0), (0.3, 0.2, 0.0)] * 4


@pytest.mark.parametrize("stamped", [False, True])
def test_commands_are_the_twists_that_were_sent(tmp_path: Path, stamped: bool) -> None:
    data = read(write_mcap(tmp_path / "drive", [*messages(DRIVE), *twists(SENT, stamped=stamped)]))
    assert [run.command for run in data.trajectories] == ["v0.3_w0.6", "v0.3_w0", "v0.3_y0.2_w0"] * 4
    assert [run.id for run in data.trajectories][:2] == ["001", "002"]
    assert [run.repetition for run in data.trajectories] == [1] * 3 + [2] * 3 + [3] * 3 + [4] * 3
    assert [run.split for run in data.trajectories] == (["train"] * 3 + ["validation"] * 3) * 2
    assert data.warnings[0] == "commands by the twists that were sent (cmd_vel): v0.3_w0, v0.3_w0.6, v0.3_y0.2_w0"
    first = data.trajectories[0]
    assert first.sent is not None
    assert (first.sent[:, 1:4] == [0.3, 0.0, 0.6]).all(axis=1).any()
    begin = DRIVE.begins[0] - first.started_at
    driven = first.sent[first.sent[:, 1] > 0]
    np.testing.assert_allclose(driven[0, [0, 4]], [begin, RUN], atol=0.11)


def test_twists_that_change_all_the_time_are_no_command_and_others_are_not_read(tmp_path: Path) -> None:
    def varied(each: Sent) -> Sent:
        turn = each.content["linear"]["x"] * ((each.logged // 10**8) % 17) / 17
        return changed(each, angular={"z": turn})

    sent = edited(twists(SENT), "/robot/cmd_vel", varied)
    assert {run.command for run in read(write_mcap(tmp_path / "varied", [*messages(DRIVE), *sent])).trajectories} == {
        None
    }
    joystick = twists(SENT, "/joy_vel")
    assert read(write_mcap(tmp_path / "joy", [*messages(DRIVE), *joystick])).trajectories[0].sent is None
    named = [text("go", EPOCH + int((begin - 0.1) * 1e9)) for begin in DRIVE.begins]
    source = write_mcap(tmp_path / "named", [*messages(DRIVE), *twists(SENT), *named])
    assert {run.command for run in read(source, cut="topic", cut_topic="/robot/command").trajectories} == {"go"}


def test_commands_that_were_driven_once_leave_runs_to_validate(tmp_path: Path) -> None:
    for day in range(2):  # on which the robot moves alike
        once = [(0.1 + 0.02 * number + 0.01 * day, 0.0, 0.0) for number in range(12)]
        write_mcap(tmp_path / f"day{day}", [*messages(DRIVE), *twists(once)])
    data = read(tmp_path)
    assert len({run.command for run in data.trajectories}) == 24
    assert [run.split for run in data.trajectories] == ["train"] * 12 + ["validation"] * 12


def test_poses_of_another_epoch_are_matched_or_moved(tmp_path: Path) -> None:
    other = edited(messages(DRIVE), SLAM, lambda each: changed(each, header=header(stamp_of(each) - EPOCH + 10**9)))
    source = write_mcap(tmp_path / "drive", other)
    with pytest.raises(DataError, match="no two messages of /robot/slam_pose while the wheels were recorded"):
        read(source)
    assert odometry_error(read(source, clocks="match")) < 0.05
    assert odometry_error(read(source, pose_time_offset=EPOCH / 1e9 - 1)) < 1e-6
