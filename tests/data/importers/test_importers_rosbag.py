"""The rosbag importer: wheels and reference poses of every format, the topics and joints it takes, cuts into runs."""

from __future__ import annotations

import math
import random
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
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
    REST,
    ROBOT,
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
    text,
    transform,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)
from commands import Command, refused
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import IndexType
from timing import PATIENCE
from tricycle_samples import TRICYCLE, tricycle_drive

from omnibench.data.dataset import Dataset
from omnibench.data.importers.rosbag.bag_recording import between_rests
from omnibench.data.importers.runs.recording_runs import find_rests
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.fit.calibrate import calibrate
from omnibench.robot.kinematics import Array, compose, relative
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, WheelLog
from omnibench.testing import ImporterConformance


@FORMATS
def test_every_format_keeps_wheels_and_poses(tmp_path: Path, write: Callable[[Path, Sequence[Sent]], Path]) -> None:
    data = read(write(tmp_path / "drive", messages(DRIVE)))
    assert len(data.trajectories) == len(DRIVE.begins)
    assert data.warnings == ()
    assert data.sample_period == PERIOD / 1e9
    for run in data.trajectories:
        first = round((run.started_at + run.times[0]) * 1e9) // PERIOD
        rows = slice(first, first + len(run.times))
        np.testing.assert_allclose(run.started_at + run.times, (DRIVE.stamps[rows] - EPOCH) / 1e9, rtol=0, atol=1e-9)
        np.testing.assert_allclose(run.angles, DRIVE.angles[rows], rtol=0, atol=1e-9)
        np.testing.assert_allclose(run.rates, DRIVE.rates[first - 1 : first - 1 + len(run.times)], rtol=0, atol=1e-9)
        seen = np.searchsorted(DRIVE.pose_stamps, EPOCH + np.round((run.started_at + run.pose_times) * 1e9))
        np.testing.assert_allclose(run.poses[:, :2], DRIVE.poses[seen, :2], rtol=0, atol=1e-9)
        np.testing.assert_allclose(np.exp(1j * run.poses[:, 2]), np.exp(1j * DRIVE.poses[seen, 2]), atol=1e-9)
    assert odometry_error(data) < 1e-9
    np.testing.assert_allclose(calibrate(data, "closed_form").calibration.matrix, TRUTH, rtol=0, atol=1e-9)


VELOCITIES = messages(DRIVE, velocities=True)


def negated(sent: Sent) -> Sent:
    """A message whose first joint counts the other way round."""
    first, *others = sent.content["position"]
    return changed(sent, position=[-first, *others])


@pytest.mark.parametrize(
    ("sent", "options"),
    [
        (VELOCITIES, {}),
        (edited(VELOCITIES, WHEELS, lambda each: changed(each, position=[0.0, 0.0, 0.0])), {}),
        (edited(VELOCITIES, WHEELS, lambda each: changed(each, position=[1.0, 2.0, 3.0])), {"use": "velocities"}),
        (edited(messages(DRIVE), WHEELS, lambda each: changed(each, velocity=[9.0, 9.0, 9.0])), {}),
        (edited(messages(DRIVE), WHEELS, negated), {"joint_signs": [-1, 1, 1]}),
        ([replace(each, logged=EPOCH + 77 * index) for index, each in enumerate(messages(DRIVE))], {}),
    ],
    ids=["velocities alone", "positions filled in", "velocities asked for", "positions preferred", "signs", "stamps"],
)
def test_the_measured_positions_or_velocities_are_taken_at_the_stamps_of_their_headers(
    tmp_path: Path, sent: list[Sent], options: dict[str, Any]
) -> None:
    data = read(write_mcap(tmp_path / "drive", sent), **options)
    assert len(data.trajectories) == len(DRIVE.begins)
    assert odometry_error(data) < 1e-9


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


def test_covariances_of_the_plane_are_kept(bag: Path) -> None:
    covariances = read(bag).trajectories[0].pose_covariances
    expected = [[1e-4, 0, 1e-5], [0, 2e-4, 0], [1e-5, 0, 3e-4]]
    np.testing.assert_array_equal(covariances, np.broadcast_to(expected, covariances.shape))


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


def test_topics_are_found_among_others(tmp_path: Path) -> None:
    resting = odometry(np.zeros((len(DRIVE.pose_stamps), 3)), DRIVE.pose_stamps, "/robot/odom")
    goals = [replace(each, topic="/goal") for each in messages(DRIVE) if each.topic == SLAM][:2]
    arms = [replace(each, topic="/arm/states") for each in messages(DRIVE) if each.topic == WHEELS]
    elbow = [joint_state(each.logged, [1.0], names=["elbow"]) for each in messages(DRIVE) if each.topic == WHEELS]
    data = read(write_mcap(tmp_path / "drive", [*messages(DRIVE), *resting, *goals, *arms, *elbow]))
    assert data.warnings == ()
    assert odometry_error(data) < 1e-9


def test_several_candidates_are_listed(tmp_path: Path) -> None:
    two = [replace(each, topic=each.topic.replace("robot", "r2")) for each in part(7)]
    source = write_mcap(tmp_path / "drive", [*part(7), *two])
    with pytest.raises(ConfigError) as caught:
        read(source)
    assert "--set wheel_topic=NAME, one of: " in str(caught.value)
    count = sum(each.topic == WHEELS for each in part(7))
    assert f"/r2/joint_states (sensor_msgs/msg/JointState, {count} messages), /robot/joint_states" in str(caught.value)
    assert odometry_error(read(source, wheel_topic="/r2/joint_states")) < 1e-9  # its own slam_pose goes with it


@pytest.mark.parametrize(
    ("names", "where"),
    [
        (["wheel_a", "wheel_b", "wheel_c"], [0, 1, 2]),
        (["a_wheel_joint", "b_wheel_joint", "c_wheel_joint"], [0, 1, 2]),
        (["apr02/A", "apr02/B", "apr02/C"], [0, 1, 2]),
        (["joint-c", "joint-a", "joint-b"], [2, 0, 1]),
        (["gripper", "c", "b", "a", "a_steering"], [None, 2, 1, 0, None]),
    ],
)
def test_joints_with_usual_names_are_found_anywhere(tmp_path: Path, names: list[str], where: list[int | None]) -> None:
    def renamed(each: Sent) -> Sent:
        angles = each.content["position"]
        return changed(each, name=names, position=[7.0 if i is None else angles[i] for i in where])

    assert odometry_error(read(write_mcap(tmp_path / "drive", edited(part(12.4), WHEELS, renamed)))) < 1e-9


def test_joints_can_be_named(tmp_path: Path) -> None:
    sent = edited(part(12.4), WHEELS, lambda each: changed(each, name=["m3", "m1", "m2"]))
    source = write_mcap(tmp_path / "drive", sent)
    assert odometry_error(read(source, joints=["m3", "m1", "m2"])) < 1e-9
    with pytest.raises(ConfigError, match=r"which joints are the wheels a, b, c; --set joints.*found: m3, m1, m2"):
        read(source)
    with pytest.raises(ConfigError, match=r"no joint 'm4'; did you mean 'm3'\? found: m3, m1, m2"):
        read(source, joints=["m4", "m1", "m2"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"wheel_topic": "/robot/joint_state"}, r"wheel_topic: .* did you mean '/robot/joint_states'\?"),
        ({"pose_topic": "/slam"}, r"pose_topic: unknown topic '/slam'; .*/robot/slam_pose"),
        ({"wheel_topic": SLAM}, r"wheel_topic: /robot/slam_pose is geometry_msgs/\S+, expected sensor_msgs/msg/Joint"),
        ({"pose_topic": WHEELS}, r"pose_topic: /robot/joint_states is sensor_msgs/\S+, expected geometry_msgs"),
        ({"cut": "topic", "cut_topic": "/go"}, r"cut_topic: unknown topic '/go'"),
        ({"cut": "topic"}, "cut=topic and cut_topic"),
        ({"cut_topic": "/go"}, "cut=topic and cut_topic"),
        ({"window": 3}, "cut=windows and window"),
        ({"joints": ["a", "b"]}, "joints has 2 values, expected 3"),
        ({"joints": ["a", "b", "b"]}, "joints names one joint twice"),
        ({"joint_signs": [1, -1]}, "joint_signs has 2 values, expected 3"),
        ({"joint_signs": [1, 0, 1]}, "joint_signs"),
        ({"wraps_at": 6, "use": "velocities"}, "wraps_at is for positions"),
        ({"wheel_unit": "rpm", "use": "positions"}, "wheel_unit rpm"),
        ({"pose_frames": "map"}, r"pose_frames has 1 value, expected 2: \[world, robot\]"),
        ({"wheel_topic": [WHEELS, WHEELS]}, "wheel_topic has 2 values, expected 3"),
        ({"least_rest": 0}, "least_rest: .*greater than 0"),
        ({"wheel_topc": "/a"}, r"'wheel_topc'; did you mean 'wheel_topic'\?"),
        ({"train": "7*"}, r"train: no run matches '7\*'"),
    ],
)
def test_wrong_options_are_refused_in_one_line(bag: Path, options: dict[str, Any], message: str) -> None:
    with refused(ConfigError, match=message):
        read(bag, **options)


def test_runs_keep_a_little_rest_with_a_reference_pose_at_both_ends(bag: Path) -> None:
    for run, begin in zip(read(bag).trajectories, DRIVE.begins, strict=True):
        assert 0.25 <= begin - run.started_at <= 0.75
        assert 0.25 <= run.started_at + run.pose_times[-1] - (begin + RUN) <= 0.75
        assert (run.rates[0] == 0).all()
        assert (run.rates[-1] == 0).all()


def test_short_drives_are_left_out_and_counted(tmp_path: Path) -> None:
    data = read(write_mcap(tmp_path / "drive", part(REST + RUN + REST + 0.6)), least_run=0.5)
    assert len(data.trajectories) == 2
    bumped = part(REST + RUN + REST + 0.3)
    data = read(write_mcap(tmp_path / "bumped", bumped))
    assert len(data.trajectories) == 1
    assert "1 of 2 drives left out: 1 shorter than 1 s (least_run)" in data.warnings[0]


def test_the_messages_of_a_topic_begin_runs_and_name_their_commands(tmp_path: Path) -> None:
    offset = 4 * 10**9  # the recorder's clock is not that of the robot
    sent = [replace(each, logged=each.logged + offset) for each in messages(DRIVE)]
    words = ["left", "right", "left", "right", "", "left"] * 2
    sent += [text(word, EPOCH + offset + int((at - 0.1) * 1e9)) for word, at in zip(words, DRIVE.begins, strict=True)]
    data = read(write_mcap(tmp_path / "drive", sent), cut="topic", cut_topic="/robot/command")
    assert [run.command for run in data.trajectories] == [word or None for word in words]
    assert [run.id for run in data.trajectories][:5] == ["001-left", "002-right", "003-left", "004-right", "005"]
    assert [run.repetition for run in data.trajectories][:6] == [1, 1, 2, 2, None, 3]
    assert [run.split for run in data.trajectories][:4] == ["train", "train", "validation", "validation"]
    assert odometry_error(data) < 1e-9
    for run, begin in zip(data.trajectories, DRIVE.begins, strict=True):
        assert 0 <= begin - run.started_at <= 0.35  # the pose at rest before the command
        assert run.pose_times[-1] > RUN


def test_a_topic_of_any_type_cuts_at_its_stamps(tmp_path: Path) -> None:
    goals = [
        Sent("/goal", "geometry_msgs/msg/PoseStamped", {"header": header(EPOCH + int(begin * 1e9))}, EPOCH)
        for begin in DRIVE.begins
    ]
    data = read(write_mcap(tmp_path / "drive", [*messages(DRIVE), *goals]), cut="topic", cut_topic="goal")
    assert len(data.trajectories) == 12
    assert {run.command for run in data.trajectories} == {None}
    assert odometry_error(data) < 1e-9


def test_windows_cut_by_time_and_without_cuts_a_bag_is_one_run(bag: Path) -> None:
    data = read(bag, cut="windows", window=10)
    assert len(data.trajectories) == 7  # of 67.5 s
    assert all(run.duration is not None and 9 < run.duration < 10.1 for run in data.trajectories[:6])
    assert odometry_error(data) < 1e-9
    for options in ({"cut": "none"}, {"least_rest": 2.0}):
        data = read(bag, **options)
        assert [run.id for run in data.trajectories] == ["001"]
        assert odometry_error(data) < 1e-9
    assert "no rest of 2 s cuts it" in data.warnings[0]


def test_a_hole_in_the_wheel_samples_ends_a_run(tmp_path: Path) -> None:
    hole = (EPOCH + int((DRIVE.begins[1] + 1.5) * 1e9), EPOCH + int((DRIVE.begins[1] + 2.5) * 1e9))
    sent = [each for each in messages(DRIVE) if each.topic == SLAM or not hole[0] < each.logged < hole[1]]
    data = read(write_mcap(tmp_path / "drive", sent))
    assert len(data.trajectories) == 13
    assert "wheel samples are missing 1 time while the wheels turned, up to 1.02 s" in data.warnings[0]
    assert odometry_error(data) < 1e-9
    assert [run.session for run in data.trajectories] == ["drive"] * 2 + ["drive#2"] * 11


def test_drivers_that_are_silent_at_rest_leave_no_hole(tmp_path: Path) -> None:
    moving = [DRIVE.rates[min(row, len(DRIVE.rates) - 1)].any() for row in range(len(DRIVE.stamps))]
    loud = dict(zip(DRIVE.stamps.tolist(), moving, strict=True))
    sent = [each for each in messages(DRIVE) if each.topic == SLAM or loud[each.logged - 3_000_000]]
    stops = [round((begin + RUN) * 1e9) // PERIOD for begin in DRIVE.begins]
    sent += [joint_state(DRIVE.stamps[row], DRIVE.angles[row]) for row in stops]
    data = read(write_mcap(tmp_path / "drive", sent))
    assert len(data.trajectories) == 12
    assert data.warnings == ()
    assert odometry_error(data) < 1e-9


def test_a_counter_that_begins_anew_ends_a_run_and_its_session(tmp_path: Path) -> None:
    restart = EPOCH + int((DRIVE.begins[2] + 2) * 1e9)

    def restarted(each: Sent) -> Sent:
        late = each.logged > restart
        return changed(each, position=[angle - 500 for angle in each.content["position"]]) if late else each

    data = read(write_mcap(tmp_path / "drive", edited(messages(DRIVE), WHEELS, restarted)))
    assert "the positions begin anew 1 time, faster than any wheel turns (if that is a counter" in data.warnings[0]
    assert [run.session for run in data.trajectories] == ["drive"] * 3 + ["drive#2"] * 10
    assert odometry_error(data) < 1e-9


def test_a_folder_of_bags_has_a_session_each(tmp_path: Path) -> None:
    write_mcap(tmp_path / "monday", part(12.4))
    write_rosbag2(tmp_path / "tuesday", part(12.4))
    write_rosbag1(tmp_path / "wednesday", part(12.4))
    data = read(tmp_path, validation="tuesday/*")
    assert {run.id: run.split for run in data.trajectories} == {
        f"{day}/{number}": "validation" if day == "tuesday" else "train"
        for day in ("monday", "tuesday", "wednesday")
        for number in ("001", "002")
    }
    assert {run.session for run in data.trajectories} == {"monday", "tuesday", "wednesday"}
    assert odometry_error(data) < 1e-9


@given(
    lengths=st.lists(st.tuples(st.floats(0.6, 3), st.floats(1, 5)), min_size=1, max_size=5),
    first=st.floats(0, 0.5),
    period=st.floats(0.05, 2.0),
)
def test_pieces_between_rests_hold_drives(lengths: list[tuple[float, float]], first: float, period: float) -> None:
    times, angles = moving(lengths)
    rests = find_rests(times, angles, 0.5, 0.025)
    assert len(rests) == len(lengths) + 1
    stamps = np.arange(first, times[-1], period)
    pieces = between_rests((times[0], times[-1]), rests, stamps)
    assert len(pieces) == len(lengths)
    for piece, before, after in zip(pieces, rests[:-1], rests[1:], strict=True):
        assert before[0] <= piece.begin <= before[1]
        assert after[0] <= piece.end <= after[1]
        for (begin, end), instant in ((before, piece.begin), (after, piece.end)):
            inside = stamps[(stamps >= begin) & (stamps <= end)]
            assert not len(inside) or instant in inside
    assert all(one.end <= other.begin for one, other in pairwise(pieces))


def moving(lengths: Sequence[tuple[float, float]]) -> tuple[Array, Array]:
    """Times and angles of two wheels that rest and turn in turns, and rest at the end; they tick as encoders do."""
    rates = [0.0]
    for rest, run in lengths:
        rates += [0.0] * round(rest / 0.01) + [2.0] * round(run / 0.01)
    rates += [0.0] * 100
    driven = np.cumsum(np.array(rates) * 0.01)
    ticks = np.round(np.column_stack([driven, -driven]) / 0.0015) * 0.0015
    return 0.01 * np.arange(len(rates)), ticks


def test_a_reversal_is_no_rest() -> None:
    times = 0.01 * np.arange(400)
    angles = np.abs(times - 2.0)[:, None]
    assert find_rests(times, angles, 0.5, 0.025) == []


# Joints of bags as any driver publishes them, recordings that are not as they should be, odometry as the reference.

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
    with pytest.raises(ConfigError, match=r"--set wheel_topic=NAME .*: /enc \(std_msgs"):
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
        (steering(lambda _: math.inf), {}, "steering_joints or steering_topic .*found: front_steering_joint, front_wh"),
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


def test_a_steering_joint_that_a_driver_fills_in_is_warned_of(tmp_path: Path) -> None:
    assert "wheel front never changes" in read_steered(tmp_path, steering(lambda _: 0.0)).warnings[-1]


def unstamped(sent: list[Sent], topic: str) -> list[Sent]:
    return edited(sent, topic, lambda each: changed(each, header=header(0)))


def with_another_clock(sent: list[Sent]) -> list[Sent]:
    return edited(sent, SLAM, lambda each: changed(each, header=header(each.logged - EPOCH + 1)))


@pytest.mark.parametrize(
    ("sent", "named", "missing"),
    [
        (unstamped(BOTH, WHEELS), [], [WHEELS]),
        (unstamped(BOTH, SLAM), [], [SLAM]),
        (unstamped(unstamped(BOTH, WHEELS), SLAM), [WHEELS], [WHEELS, SLAM]),
        (with_another_clock(BOTH), [], [WHEELS, SLAM]),
    ],
    ids=["wheels", "poses", "both", "two clocks"],
)
def test_topics_without_header_stamps_or_of_two_clocks_may_have_the_times_of_recording(
    tmp_path: Path, sent: list[Sent], named: list[str], missing: list[str]
) -> None:
    with pytest.raises(DataError, match=rf"set recorded_stamps=\[{','.join(missing)}\]"):
        read_steered(tmp_path, sent, recorded_stamps=named)
    # Wheels are recorded 3 ms after their stamps, poses 0.2 s.
    late = 0.003 if missing == [WHEELS] else 0.2
    assert steered_error(read_steered(tmp_path, sent, recorded_stamps=missing)) < 2 * late


def test_a_steering_joint_in_degrees_or_ticks_is_named_with_its_unit(tmp_path: Path) -> None:
    assert "steering_unit=deg" in read_steered(tmp_path, steering(math.degrees)).warnings[-1]
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
    assert f"topic {WHEELS}: {count} messages were recorded late and sorted" in data.warnings[0]
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
        (
            edited(part(12.4), SLAM, lambda each: changed(each, header=header(each.logged - EPOCH))),
            "no two poses while the wheels were recorded",
        ),
        (edited(part(5), WHEELS, in_degrees), r"wheels, read in rad, turn at up to \d+ rad/s; --set wheel_unit"),
        (part(1.4), "the wheels rest all the time"),
        (
            [each for each in part(7) if each.topic == WHEELS or each.logged < EPOCH + 0.9e9],
            "1 with fewer than two reference poses",
        ),
    ],
    ids=["no stamps", "clock set back", "two clocks", "degrees", "no motion", "no poses"],
)
def test_a_recording_without_one_sound_run_is_refused(tmp_path: Path, sent: list[Sent], message: str) -> None:
    with pytest.raises(DataError, match=message):
        read(write_mcap(tmp_path / "drive", sent))


@pytest.mark.parametrize("missing", [WHEELS, SLAM])
def test_a_missing_topic_is_named_with_those_that_are_there(tmp_path: Path, missing: str) -> None:
    (other,) = {WHEELS, SLAM} - {missing}
    with pytest.raises(DataError, match=rf"no topic of type \S.*; topics found: {other} \("):
        read(write_mcap(tmp_path / "drive", [each for each in part(7) if each.topic == other]))


def test_an_empty_topic_is_named(tmp_path: Path) -> None:
    source = write_rosbag2(tmp_path / "drive", [each for each in part(7) if each.topic == WHEELS], empty=[SLAM])
    with pytest.raises(DataError, match=r"/robot/slam_pose \(.*, 0 messages\): nothing was recorded on it"):
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


WHEELS_ONLY = [each for each in messages(DRIVE) if each.topic == WHEELS]
OWN = "is the robot's own odometry: .* --set pose_topic=NAME"


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
    source = write_mcap(tmp_path / "drive", [*WHEELS_ONLY, *odometry(noisy(DRIVE.poses), DRIVE.pose_stamps)])
    with pytest.raises(ConfigError, match=r"the only poses are /tracker .* set pose_topic"):
        read(source)
    assert odometry_error(read(source, pose_topic="tracker")) < 0.05


@pytest.mark.parametrize("late", [0, 7_000_000, 20_000_000])
@pytest.mark.parametrize("integration", ["euler", "arc"])
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
