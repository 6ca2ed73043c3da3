"""Recordings that are not as they should be, and what the rosbag importer makes of them."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from bag_samples import (
    EPOCH,
    FORMATS,
    SLAM,
    WHEELS,
    Sent,
    changed,
    edited,
    header,
    odometry_error,
    part,
    pose,
    read,
    write_mcap,
    write_rosbag2,
)
from mcap.writer import IndexType

from omnibench.errors import DataError, OmnibenchError


def test_messages_recorded_out_of_order_are_sorted_and_counted(tmp_path: Path) -> None:
    late = edited(
        part(12.4), WHEELS, lambda each: Sent(each.topic, each.kind, each.content, each.logged + 50_000_000), every=9
    )
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
        (
            WHEELS,
            lambda each: changed(each, position=[1.0, float("nan"), 1.0]),
            "without a finite position of every wheel",
        ),
        (WHEELS, lambda each: changed(each, position=[1.0, 1e300, 1.0]), "without a finite position of every wheel"),
        (WHEELS, lambda each: changed(each, position=[1.0]), "without a finite position of every wheel"),
        (WHEELS, lambda each: changed(each, header=header(0)), r"without a header stamp \(it is 0\)"),
        (WHEELS, lambda each: Sent(each.topic, each.kind, b"\0\1\0\0garbage", each.logged), "that cannot be decoded"),
        (SLAM, lambda each: changed(each, header=header(0)), r"without a header stamp \(it is 0\)"),
        (SLAM, lambda each: changed(each, pose={"pose": pose((float("inf"), 0, 0))}), "without a finite position"),
        (SLAM, lambda each: changed(each, pose={}), "with a wrong orientation, as quaternion has length 0, expected 1"),
        (
            SLAM,
            lambda each: changed(each, pose={"pose": {"orientation": {"x": 0.5**0.5, "w": 0.5**0.5}}}),
            r"with a wrong orientation, as pose is tilted by 90 degrees; give poses of the robot's body \(z up\)",
        ),
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


def test_a_publisher_that_never_stamps_is_told_what_to_do(tmp_path: Path) -> None:
    bare = edited(part(7), SLAM, lambda each: changed(each, header=header(0)))
    with pytest.raises(DataError, match=r"the publisher must fill header\.stamp"):
        read(write_mcap(tmp_path / "drive", bare))


def test_a_clock_that_was_set_back_is_refused(tmp_path: Path) -> None:
    again = [Sent(each.topic, each.kind, each.content, each.logged + 20 * 10**9) for each in part(12)]
    with pytest.raises(DataError, match=r"message \d+: the stamps go back by 12 s and stay behind: the clock was set"):
        read(write_mcap(tmp_path / "drive", [*part(12), *again]))


def test_clocks_that_do_not_meet_are_named(tmp_path: Path) -> None:
    other = edited(part(12.4), SLAM, lambda each: changed(each, header=header(each.logged - EPOCH)))
    with pytest.raises(DataError, match=r"no two poses while the wheels were recorded, .*both must be stamped by one"):
        read(write_mcap(tmp_path / "drive", other))


def test_positions_in_degrees_are_refused(tmp_path: Path) -> None:
    degrees = edited(
        part(5), WHEELS, lambda each: changed(each, position=np.degrees(each.content["position"]).tolist())
    )
    with pytest.raises(DataError, match=r"wheels, read in rad, turn at up to \d+ rad/s; --set wheel_unit"):
        read(write_mcap(tmp_path / "drive", degrees))


def test_a_robot_that_never_moves_gives_no_run(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"the wheels rest all the time .*; nothing is left"):
        read(write_mcap(tmp_path / "drive", part(1.4)))


def test_drives_without_two_poses_give_no_run(tmp_path: Path) -> None:
    few = [each for each in part(7) if each.topic == WHEELS or each.logged < EPOCH + 0.9e9]
    with pytest.raises(
        DataError, match=r"1 of 1 drive left out: 1 with fewer than two reference poses.*; nothing is left"
    ):
        read(write_mcap(tmp_path / "drive", few))


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
def test_a_bag_that_was_cut_off_is_refused_in_one_line(
    tmp_path: Path, write: Callable[[Path, Sequence[Sent]], Path]
) -> None:
    source = write(tmp_path / "drive", part(7))
    file = source if source.is_file() else max(source.iterdir(), key=lambda each: each.stat().st_size)
    content = file.read_bytes()
    for length in (0, 20, len(content) // 3, len(content) * 9 // 10):
        file.write_bytes(content[:length])
        with pytest.raises(DataError, match=r"drive\S*: cannot be read as a bag: .*broke off") as caught:
            read(source)
        assert "\n" not in str(caught.value)


@FORMATS
def test_damage_never_shows_as_a_traceback(tmp_path: Path, write: Callable[[Path, Sequence[Sent]], Path]) -> None:
    source = write(tmp_path / "drive", part(7))
    files = [source] if source.is_file() else sorted(source.iterdir())
    rng, refused = random.Random(7), 0
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
            refused += 1
        file.write_bytes(content)
    assert refused


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
