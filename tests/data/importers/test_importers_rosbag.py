"""The rosbag importer: wheels and reference poses of every format, the topics and joints it takes, cuts into runs."""

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
    stamped,
    text,
    transform,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)
from commands import Command, refused
from hypothesis import given
from hypothesis import strategies as st
from timing import PATIENCE

from omnibench.data.runs import between_rests, find_rests
from omnibench.data.storage import load_dataset
from omnibench.errors import ConfigError
from omnibench.fit.calibrate import calibrate
from omnibench.robot.kinematics import Array
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
    if kind == "PoseStamped":
        contents = [{"pose": pose(place)} for place in DRIVE.poses]
    else:
        contents = [{"transform": transform(place)} for place in DRIVE.poses]
    poses = stamped("/tracker/robot", f"geometry_msgs/msg/{kind}", DRIVE.pose_stamps, contents)
    wheels = [each for each in messages(DRIVE) if each.topic == WHEELS]
    assert odometry_error(read(write_rosbag2(tmp_path / "drive", [*wheels, *poses]))) < 1e-9


def test_the_command_imports_a_bag(command: Command, tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", part(12.4))
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(ROBOT.model_dump(mode="json")))
    run = command("import", "rosbag", source, "-o", "data", "--set", "robot=robot.yaml", "--set", "name=lab")
    assert run.returncode == 0
    assert run.stderr.startswith("training 2 runs, validation 0 runs, ")  # they move in different ways
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
        (
            {"wheel_topic": SLAM},
            r"wheel_topic: /robot/slam_pose is geometry_msgs/\S+, expected sensor_msgs/msg/Joint.*joints=",
        ),
        ({"pose_topic": WHEELS}, r"pose_topic: /robot/joint_states is sensor_msgs/\S+, expected geometry_msgs"),
        ({"cut": "topic", "cut_topic": "/go"}, r"cut_topic: unknown topic '/go'"),
        ({"cut": "topic"}, "cut=topic and cut_topic"),
        ({"cut_topic": "/go"}, "cut=topic and cut_topic"),
        ({"window": 3}, "cut=windows and window"),
        ({"joints": ["a", "b"]}, "joints has 2 values, expected 3"),
        ({"joints": ["a", "b", "b"]}, "joints names one joint twice"),
        ({"joint_signs": [1, -1]}, "wheel_signs has 2 values, expected 3"),
        ({"joint_signs": [1, 0, 1]}, "wheel_signs"),
        ({"joint_signs": [1, 1, 1], "wheel_signs": [1, 1, 1]}, "joint_signs is another name of wheel_signs"),
        ({"wheel_time_unit": "ms"}, "stamps of bags are in s"),
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
    assert "1 of 2 runs left out: 1 shorter than 1 s (least_run)" in data.warnings[0]


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
    pieces = between_rests(slice(0), (times[0], times[-1]), rests, stamps)
    assert len(pieces) == len(lengths)
    for piece, before, after in zip(pieces, rests[:-1], rests[1:], strict=True):
        assert before[0] <= piece.span[0] <= before[1]
        assert after[0] <= piece.span[1] <= after[1]
        for (begin, end), instant in zip((before, after), piece.span, strict=True):
            inside = stamps[(stamps >= begin) & (stamps <= end)]
            assert not len(inside) or instant in inside
    assert all(one.span[1] <= other.span[0] for one, other in pairwise(pieces))


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
