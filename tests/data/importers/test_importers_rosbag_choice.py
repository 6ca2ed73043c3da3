"""Which topics and joints the rosbag importer takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from bag_samples import (
    DRIVE,
    SLAM,
    WHEELS,
    Sent,
    changed,
    edited,
    header,
    joint_state,
    messages,
    odometry_error,
    part,
    pose,
    read,
    write_mcap,
)

from omnibench.errors import ConfigError


def test_topics_are_found_among_others(tmp_path: Path) -> None:
    odometry = [
        Sent(
            "/robot/odom",
            "nav_msgs/msg/Odometry",
            {"header": header(stamp), "pose": {"pose": pose((0, 0, 0))}},
            int(stamp),
        )
        for stamp in DRIVE.pose_stamps
    ]
    goals = [Sent("/goal", each.kind, each.content, each.logged) for each in messages(DRIVE) if each.topic == SLAM][:2]
    arms = [
        Sent("/arm/states", each.kind, each.content, each.logged) for each in messages(DRIVE) if each.topic == WHEELS
    ]
    data = read(write_mcap(tmp_path / "drive", [*messages(DRIVE), *odometry, *goals, *arms]))
    assert odometry_error(data) < 1e-9


def test_several_candidates_are_listed(tmp_path: Path) -> None:
    two = [Sent(each.topic.replace("robot", "r2"), each.kind, each.content, each.logged) for each in part(7)]
    source = write_mcap(tmp_path / "drive", [*part(7), *two])
    with pytest.raises(ConfigError) as caught:
        read(source)
    assert "several topics could be the wheel_topic; --set wheel_topic=NAME, one of: " in str(caught.value)
    count = sum(each.topic == WHEELS for each in part(7))
    assert f"/r2/joint_states (sensor_msgs/msg/JointState, {count} messages), /robot/joint_states" in str(caught.value)
    assert odometry_error(read(source, wheel_topic="/r2/joint_states")) < 1e-9  # its own slam_pose goes with it


@pytest.mark.parametrize(
    "names",
    [
        ["wheel_a", "wheel_b", "wheel_c"],
        ["a_wheel_joint", "b_wheel_joint", "c_wheel_joint"],
        ["apr02/A", "apr02/B", "apr02/C"],
        ["joint-c", "joint-a", "joint-b"],
        ["gripper", "c", "b", "a", "a_steering"],
    ],
)
def test_joints_are_recognised_by_usual_names_in_any_order(tmp_path: Path, names: list[str]) -> None:
    where = [next((i for i, wheel in enumerate("abc") if wheel == core(name)), None) for name in names]

    def renamed(each: Sent) -> Sent:
        angles = each.content["position"]
        return changed(each, name=names, position=[7.0 if i is None else angles[i] for i in where])

    assert odometry_error(read(write_mcap(tmp_path / "drive", edited(part(12.4), WHEELS, renamed)))) < 1e-9


def core(name: str) -> str:
    """The wheel that a joint of the test above means."""
    for word in ("wheel", "joint", "apr02", "_", "-", "/"):
        name = name.replace(word, "")
    return name.lower()


def test_joints_can_be_named(tmp_path: Path) -> None:
    sent = edited(part(12.4), WHEELS, lambda each: changed(each, name=["m3", "m1", "m2"]))
    source = write_mcap(tmp_path / "drive", sent)
    assert odometry_error(read(source, joints=["m3", "m1", "m2"])) < 1e-9
    with pytest.raises(ConfigError, match=r"which joints are the wheels a, b, c; --set joints.*found: m3, m1, m2"):
        read(source)
    with pytest.raises(ConfigError, match=r"no joint 'm4'; did you mean 'm3'\? found: m3, m1, m2"):
        read(source, joints=["m4", "m1", "m2"])


def test_other_joints_may_come_by_the_same_topic(tmp_path: Path) -> None:
    arm = [joint_state(each.logged, [1.0], names=["elbow"]) for each in part(12.4) if each.topic == WHEELS]
    data = read(write_mcap(tmp_path / "drive", [*part(12.4), *arm]))
    assert data.warnings == ()
    assert odometry_error(data) < 1e-9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"wheel_topic": "/robot/joint_state"}, r"wheel_topic: unknown topic .* did you mean '/robot/joint_states'\?"),
        ({"pose_topic": "/slam"}, r"pose_topic: unknown topic '/slam'; .*known: /robot/joint_states, /robot/slam_pose"),
        ({"wheel_topic": SLAM}, r"wheel_topic: /robot/slam_pose is geometry_msgs/\S+, expected sensor_msgs/msg/Joint"),
        ({"pose_topic": WHEELS}, r"pose_topic: /robot/joint_states is sensor_msgs/\S+, expected geometry_msgs"),
        ({"cut": "topic", "cut_topic": "/go"}, r"cut_topic: unknown topic '/go'"),
        ({"cut": "topic"}, "cut=topic and cut_topic belong together; give both or none"),
        ({"cut_topic": "/go"}, "cut=topic and cut_topic belong together"),
        ({"window": 3}, "cut=windows and window belong together"),
        ({"joints": ["a", "b"]}, "joints has 2 values, expected 3, one for each wheel"),
        ({"joints": ["a", "b", "b"]}, "joints names one joint twice"),
        ({"joint_signs": [1, -1]}, "joint_signs has 2 values, expected 3"),
        ({"joint_signs": [1, 0, 1]}, "joint_signs"),
        ({"wraps_at": 6, "use": "velocities"}, "wraps_at is for positions"),
        ({"wheel_unit": "rpm", "use": "positions"}, "wheel_unit rpm is not one of positions; leave use out"),
        ({"pose_frames": "map"}, r"pose_frames has 1 value, expected 2: \[world, robot\]"),
        ({"wheel_topic": [WHEELS, WHEELS]}, "wheel_topic has 2 values, expected 3, one for each wheel"),
        ({"least_rest": 0}, "least_rest: .*greater than 0"),
        ({"wheel_topc": "/a"}, r"unknown key 'wheel_topc'; did you mean 'wheel_topic'\?"),
        ({"train": "7*"}, r"train: no run matches '7\*'"),
    ],
)
def test_wrong_options_are_refused_in_one_line(bag: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        read(bag, **options)
    assert "\n" not in str(caught.value)
