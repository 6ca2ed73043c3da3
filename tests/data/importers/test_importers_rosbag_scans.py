"""Scans in ROS recordings: they come into the data set with their scanner."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from bag_samples import (
    DRIVE,
    EPOCH,
    FORMATS,
    ROBOT,
    SLAM,
    Sent,
    changed,
    edited,
    header,
    messages,
    part,
    read,
    write_mcap,
)
from scan_samples import (
    ANGLE_MIN,
    INCREMENT,
    MOUNT,
    MOUNTED,
    RANGE_MAX,
    RANGE_MIN,
    RAYS,
    SCAN,
    SCANS,
    SECONDS,
    scans,
    seen,
    tf_static,
    transform,
    true_places,
    without_poses,
)

from omnibench.data.dataset import Dataset
from omnibench.data.scans import Mount, Scanner
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.registry import importers
from omnibench.testing import ImporterConformance


def with_scans(extra: Sequence[Sent] = (MOUNTED,), **options: Any) -> list[Sent]:
    return [*part(SECONDS), *scans(SECONDS, **options), *extra]


def scanner_of(data: Dataset) -> Scanner:
    assert data.scans is not None
    return data.scans.scanner


@FORMATS
def test_scans_come_with_the_runs_from_every_format(
    tmp_path: Path, write: Callable[[Path, Sequence[Sent]], Path]
) -> None:
    data = read(write(tmp_path / "drive", with_scans(noise=0.0)))
    assert data.warnings == ()
    assert data.scans is not None
    assert data.scans.trajectories == ("001", "002")
    for run in data.trajectories:
        found = data.scans.of(run.id)
        np.testing.assert_array_equal(found.times, data.scans.times(run.id))
        assert run.started_at is not None
        stamps = EPOCH + np.round((run.started_at + found.times) * 1e9).astype(np.int64)
        assert set(stamps.tolist()) <= {each.logged - 30_000_000 for each in scans(SECONDS)}
        assert 0 <= found.times[0] < 0.2
        assert run.times[-1] - 0.2 < found.times[-1] <= run.times[-1]
        np.testing.assert_allclose(np.diff(found.times), 0.2, atol=1e-6)
        for stamp, ranges in zip(stamps, found.ranges, strict=True):
            np.testing.assert_allclose(ranges, seen(true_places(DRIVE, [stamp])[0]), atol=1e-5)


def test_the_scanner_is_the_one_of_the_messages(tmp_path: Path) -> None:
    sent = [changed(each, time_increment=1e-4, scan_time=0.1) if each.topic == SCAN else each for each in with_scans()]
    data = read(write_mcap(tmp_path / "drive", sent))
    assert data.warnings == ()
    scanner = scanner_of(data)
    assert (scanner.name, scanner.rays) == (SCAN, RAYS)
    found = (scanner.angle_min, scanner.angle_increment, scanner.time_increment, scanner.range_min, scanner.range_max)
    np.testing.assert_allclose(found, (ANGLE_MIN, INCREMENT, 1e-4, RANGE_MIN, RANGE_MAX), rtol=1e-6)
    mount = (scanner.mount.x, scanner.mount.y, scanner.mount.yaw)
    np.testing.assert_allclose(mount, MOUNT, rtol=0, atol=1e-12)


def test_what_is_no_measurement_becomes_nothing_seen(tmp_path: Path) -> None:
    odd = [math.nan, 0.0, math.inf, -1.0, 0.05, 31.0, -math.inf]
    sent = edited(with_scans(), SCAN, lambda each: changed(each, ranges=[*odd, *each.content["ranges"][len(odd) :]]))
    data = read(write_mcap(tmp_path / "drive", sent))
    assert data.scans is not None
    ranges = data.scans.of("001").ranges
    assert np.isposinf(ranges[:, : len(odd)]).all()
    assert np.isfinite(ranges[:, len(odd) :]).all()
    assert data.scans.scanner.valid(ranges).sum() == ranges[:, len(odd) :].size


def test_empty_scans_are_left_out_and_counted(tmp_path: Path) -> None:
    sent = edited(with_scans(), SCAN, lambda each: changed(each, ranges=[math.inf] * RAYS), every=5)
    data = read(write_mcap(tmp_path / "drive", sent))
    count = len(scans(SECONDS))
    assert f"topic {SCAN}: {count // 5} of {count} messages left out: {count // 5} without a range" in data.warnings[0]
    assert data.scans is not None
    assert all(np.isfinite(found.ranges).any(axis=1).all() for _, found in data.scans)


def test_scans_are_saved_and_loaded_with_the_data_set(tmp_path: Path) -> None:
    data = read(write_mcap(tmp_path / "drive", with_scans()))
    save_dataset(data, tmp_path / "data")
    loaded = load_dataset(tmp_path / "data")
    assert data.scans is not None
    assert loaded.scans is not None
    assert loaded.scans.scanner == data.scans.scanner
    for run, expected in data.scans:
        np.testing.assert_array_equal(loaded.scans.of(run).times, expected.times)
        np.testing.assert_array_equal(loaded.scans.of(run).ranges, expected.ranges)


def test_scans_do_not_change_wheels_and_poses(tmp_path: Path) -> None:
    without = read(write_mcap(tmp_path / "drive", part(SECONDS)))
    assert without.scans is None
    data = read(write_mcap(tmp_path / "drive", with_scans()))
    assert data.scans is not None
    assert data.hash == without.hash


def test_scans_can_be_left_out(tmp_path: Path) -> None:
    broken = edited(with_scans(), SCAN, lambda each: changed(each, ranges=[1.0]), every=7)
    source = write_mcap(tmp_path / "drive", broken)
    with pytest.raises(DataError, match="scans=false leaves the scans out"):
        read(source)
    assert read(source, scans=False).scans is None
    with pytest.raises(ConfigError, match="leave scan_topic and scanner_mount out, too"):
        read(source, scans=False, scan_topic=SCAN)


def test_messages_that_are_recorded_late_or_twice_come_in_order(tmp_path: Path) -> None:
    sent = with_scans()
    late = edited(sent, SCAN, lambda each: Sent(each.topic, each.kind, each.content, each.logged + 450_000_000), 4)
    twice = [*late, *scans(SECONDS)[10:13]]
    data = read(write_mcap(tmp_path / "late", twice))
    plain = read(write_mcap(tmp_path / "plain", sent))
    assert [warning.partition(f"topic {SCAN}: ")[2] for warning in data.warnings] == [
        f"3 of {len(scans(SECONDS)) + 3} messages left out: 3 with a repeated stamp (first: message "
        + data.warnings[0].rpartition("message ")[2],
        data.warnings[1].partition(f"topic {SCAN}: ")[2],
    ]
    assert "were recorded late and sorted by their stamps" in data.warnings[1]
    assert data.scans is not None
    assert plain.scans is not None
    for run, expected in plain.scans:
        np.testing.assert_array_equal(data.scans.of(run).ranges, expected.ranges)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ranges": [1.0] * 7}, "a scan has 7 ranges, expected 361 as in the messages before"),
        ({"angle_min": -1.0}, r"angle_min is -1, expected -2\.35619 as in"),
        ({"angle_increment": 0.02}, r"angle_increment is 0\.02, expected 0\.01309 as in"),
        ({"angle_increment": math.nan}, r"angle_increment is nan, expected 0\.01309 as in"),
        ({"range_min": 0.2}, r"range_min is 0\.2, expected 0\.1 as in"),
        ({"range_max": 12.0}, "range_max is 12, expected 30 as in"),
    ],
)
def test_scans_of_two_shapes_are_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    sent = edited(with_scans(), SCAN, lambda each: changed(each, **change), every=9)
    with pytest.raises(DataError, match=rf"topic {SCAN}, message 9: {message}"):
        read(write_mcap(tmp_path / "drive", sent))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"range_max": 0.01}, "without a range|is not below range_max"),
        ({"angle_increment": 0.0}, "angle_increment is 0; all rays would point the same way"),
        ({"angle_increment": 1.0}, "361 rays, 1 rad apart, are more than a whole turn"),
        ({"time_increment": -1e-4}, "time_increment: .*greater than or equal to 0"),
        ({"angle_min": math.inf}, "angle_min"),
        ({"ranges": []}, "without a range"),
        ({"header": header(0)}, "without a header stamp"),
    ],
)
def test_a_scanner_that_cannot_be_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    sent = edited(with_scans(), SCAN, lambda each: changed(each, **change))
    with pytest.raises(DataError, match=rf"topic {SCAN}.*({message}).*scans=false") as told:
        read(write_mcap(tmp_path / "drive", sent))
    assert "\n" not in str(told.value)


def test_scans_by_another_clock_are_refused(tmp_path: Path) -> None:
    sent = edited(with_scans(), SCAN, lambda each: changed(each, header=header(each.logged - EPOCH + 10**9, "laser")))
    with pytest.raises(DataError, match=r"no two scans while the wheels were recorded, .*stamped by one clock"):
        read(write_mcap(tmp_path / "drive", sent))


def test_a_time_between_rays_that_is_measured_anew_is_averaged(tmp_path: Path) -> None:
    paces = iter([1e-4, 1.5e-4, 0.8e-4] * 1000)
    sent = edited(with_scans(), SCAN, lambda each: changed(each, time_increment=next(paces)))
    data = read(write_mcap(tmp_path / "drive", sent))
    assert "time_increment varies from 8e-05 to 0.00015 s; its median, 0.0001 s, is taken" in data.warnings[0]
    assert scanner_of(data).time_increment == pytest.approx(1e-4)


def test_a_scan_that_takes_time_but_does_not_say_from_ray_to_ray_is_told(tmp_path: Path) -> None:
    sent = edited(with_scans(), SCAN, lambda each: changed(each, scan_time=0.1))
    (warning,) = read(write_mcap(tmp_path / "drive", sent)).warnings
    assert "time_increment is 0, so that each scan counts as taken at one instant, though scan_time is 0.1 s" in warning


def test_a_mount_that_nothing_tells_is_said_and_can_be_given(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", with_scans(extra=()))
    data = read(source)
    assert "it is unknown where the scanner (laser) is mounted" in data.warnings[0]
    assert "--set 'scanner_mount={x: 0.1, y: 0, yaw: 0}'" in data.warnings[0]
    assert scanner_of(data).mount == Mount()
    given = read(source, scanner_mount={"x": 0.1, "yaw": 3.0})
    assert given.warnings == ()
    assert scanner_of(given).mount == Mount(x=0.1, yaw=3.0)
    with pytest.raises(ConfigError, match=r"unknown key 'scanner_mount\.jaw'; did you mean 'yaw'"):
        read(source, scanner_mount={"jaw": 3.0})


def test_a_chain_of_fixed_transforms_is_followed(tmp_path: Path) -> None:
    chain = tf_static(
        transform("top", "robot/laser", 0.1, 0.0, 0.5),
        transform("/robot/base_link", "top", 0.2, 0.3, math.pi / 2),
        transform("map", "robot/base_link", 9.0, 9.0, 1.0),
    )
    sent = edited(
        with_scans(extra=[chain]), SCAN, lambda each: changed(each, header=header(_stamp(each), "robot/laser"))
    )
    mount = scanner_of(read(write_mcap(tmp_path / "drive", sent))).mount
    np.testing.assert_allclose((mount.x, mount.y, mount.yaw), (0.2, 0.4, math.pi / 2 + 0.5), rtol=0, atol=1e-9)


def _stamp(sent: Sent) -> int:
    stamp = sent.content["header"]["stamp"]
    return int(stamp["sec"]) * 10**9 + int(stamp["nanosec"])


def test_a_ring_of_fixed_transforms_ends(tmp_path: Path) -> None:
    ring = tf_static(transform("a", "laser", 0, 0, 0), transform("laser", "a", 0, 0, 0))
    assert "it is unknown where" in read(write_mcap(tmp_path / "drive", with_scans(extra=[ring]))).warnings[0]


def test_a_scanner_that_hangs_upside_down_counts_its_rays_the_other_way(tmp_path: Path) -> None:
    hanging = tf_static(transform("base_link", "laser", *MOUNT, roll=math.pi))
    upright = read(write_mcap(tmp_path / "upright", with_scans(noise=0.0)))
    flipped = edited(
        with_scans(extra=[hanging], noise=0.0), SCAN, lambda each: changed(each, ranges=each.content["ranges"][::-1])
    )
    data = read(write_mcap(tmp_path / "hanging", flipped))
    assert data.scans is not None
    assert upright.scans is not None
    assert data.scans.scanner.mount.yaw == pytest.approx(MOUNT[2])
    np.testing.assert_allclose(data.scans.scanner.angles[::-1], upright.scans.scanner.angles, atol=1e-5)
    np.testing.assert_array_equal(data.scans.of("001").ranges[:, ::-1], upright.scans.of("001").ranges)


def test_a_tilted_scanner_is_refused(tmp_path: Path) -> None:
    tilted = tf_static(transform("base_link", "laser", 0, 0, 0, roll=1.2))
    source = write_mcap(tmp_path / "drive", with_scans(extra=[tilted]))
    with pytest.raises(DataError, match=r"the scanner's frame laser is tilted by 69 degrees.*set scanner_mount"):
        read(source)
    assert read(source, scanner_mount={}).scans is not None


def test_the_topic_ending_in_scan_is_taken_and_else_one_must_be_named(tmp_path: Path) -> None:
    def elsewhere(name: str) -> list[Sent]:
        return [Sent(name, SCANS, each.content, each.logged) for each in scans(SECONDS)]

    back = read(write_mcap(tmp_path / "back", [*with_scans(), *elsewhere("/robot/scan_back")]))
    assert scanner_of(back).name == SCAN
    beside = read(write_mcap(tmp_path / "beside", [*with_scans(), *elsewhere("/other/scan")]))
    assert scanner_of(beside).name == SCAN
    two = [*part(SECONDS), MOUNTED, *elsewhere("/front"), *elsewhere("/rear")]
    source = write_mcap(tmp_path / "two", two)
    with pytest.raises(ConfigError, match=r"could be the scan_topic; --set scan_topic=NAME, one of: /front"):
        read(source)
    assert scanner_of(read(source, scan_topic="rear")).name == "/rear"
    with pytest.raises(ConfigError, match=r"scan_topic: /robot/slam_pose is .*, expected sensor_msgs/msg/LaserScan"):
        read(source, scan_topic=SLAM)
    with pytest.raises(ConfigError, match=r"scan_topic: unknown topic 'raer'; did you mean '/rear'"):
        read(source, scan_topic="raer")


def test_bags_of_one_scanner_make_one_data_set(tmp_path: Path) -> None:
    (tmp_path / "days").mkdir()
    write_mcap(tmp_path / "days" / "one", with_scans())
    write_mcap(tmp_path / "days" / "two", with_scans())
    data = read(tmp_path / "days")
    assert data.scans is not None
    assert data.scans.trajectories == ("one/001", "one/002", "two/001", "two/002")
    np.testing.assert_array_equal(data.scans.of("one/002").ranges, data.scans.of("two/002").ranges)
    moved = tf_static(transform("base_link", "laser", 0.5, 0.0, 0.0))
    write_mcap(tmp_path / "days" / "three", with_scans(extra=[moved]))
    with pytest.raises(DataError, match=r"three\.mcap|two\.mcap"):
        read(tmp_path / "days")


def test_a_bag_that_is_gone_when_its_scans_are_wanted_is_told(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", with_scans())
    data = read(source)
    assert data.scans is not None
    write_mcap(tmp_path / "drive", [*part(SECONDS), *scans(2.0), MOUNTED])
    with pytest.raises(DataError, match=r"the bag has changed since it was opened; import it again"):
        data.scans.of("002")
    with pytest.raises(DataError, match="trajectory 003 has no scans"):
        data.scans.of("003")


def test_without_poses_the_data_set_has_placeholders_and_cannot_be_saved(tmp_path: Path) -> None:
    importer = importers.create("rosbag", {"robot": ROBOT.model_dump()})
    data = importer.read(write_mcap(tmp_path / "drive", without_poses()))
    assert not data.referenced
    assert data.warnings == ()
    for run in data.trajectories:
        np.testing.assert_array_equal(run.poses[0], 0.0)
        assert run.pose_covariances is None
    with pytest.raises(DataError, match=r"data set rosbag: it has no reference poses; .*omnibench\.import_dataset"):
        save_dataset(data, tmp_path / "data")


def test_with_poses_the_data_set_says_so(tmp_path: Path) -> None:
    assert read(write_mcap(tmp_path / "drive", with_scans())).referenced


def test_without_poses_and_scans_the_bag_is_refused(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", without_poses())
    with pytest.raises(DataError, match="no topic of type geometry_msgs"):
        read(source, scans=False)


def test_drives_without_two_scans_give_no_run(tmp_path: Path) -> None:
    few = [each for each in without_poses(seconds=7) if each.topic != SCAN or each.logged < EPOCH + 0.5e9]
    with pytest.raises(DataError, match=r"1 of 1 drive left out: 1 with fewer than two scans.*; nothing is left"):
        read(write_mcap(tmp_path / "drive", few))


def test_bags_with_and_without_poses_are_imported_apart(tmp_path: Path) -> None:
    (tmp_path / "days").mkdir()
    write_mcap(tmp_path / "days" / "with", with_scans())
    write_mcap(tmp_path / "days" / "without", without_poses())
    with pytest.raises(DataError, match=r"without\.mcap: no topic holds reference poses, as it does in other bags"):
        read(tmp_path / "days")


def test_wheels_and_scans_of_the_whole_drive_are_read_one_run_at_a_time(tmp_path: Path) -> None:
    data = read(write_mcap(tmp_path / "drive", [*messages(DRIVE), *scans(1e6), MOUNTED]))
    assert data.scans is not None
    assert len(data.scans.trajectories) == len(DRIVE.begins)
    assert sum(len(found.times) for _, found in data.scans) > 20 * len(DRIVE.begins)


class TestRosbagWithScansConforms(ImporterConformance):
    name = "rosbag"
    options: ClassVar[dict[str, Any]] = {"robot": ROBOT.model_dump()}

    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def _sample(cls, tmp_path_factory: pytest.TempPathFactory) -> None:
        cls.source = write_mcap(tmp_path_factory.mktemp("bags") / "drive", with_scans())
