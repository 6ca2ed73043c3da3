"""Bags beside poses: scans with their scanner, and fixes, compasses and gyros as references."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
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
    TRUTH,
    Sent,
    changed,
    edited,
    header,
    messages,
    part,
    pose,
    read,
    stamp_of,
    stamped,
    write_mcap,
    write_rosbag2,
)
from commands import refused
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

from omnibench.data.dataset import Trajectory
from omnibench.data.importers.rosbag import east_north
from omnibench.data.scans import Mount
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.fit.calibrate import calibrate
from omnibench.registry import importers
from omnibench.robot.kinematics import Array
from omnibench.testing import ImporterConformance


def with_scans(extra: Sequence[Sent] = (MOUNTED,), **options: Any) -> list[Sent]:
    return [*part(SECONDS), *scans(SECONDS, **options), *extra]


@FORMATS
def test_scans_come_with_runs_from_every_format(tmp_path: Path, write: Callable[[Path, Sequence[Sent]], Path]) -> None:
    data = read(write(tmp_path / "drive", with_scans(noise=0.0)))
    assert data.warnings == ()
    assert data.scans.trajectories == ("001", "002")
    for run in data.trajectories:
        found = data.scans.of(run.id)
        np.testing.assert_array_equal(found.times, data.scans.times(run.id))
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
    scanner = data.scans.scanner
    assert (scanner.name, scanner.rays) == (SCAN, RAYS)
    found = (scanner.angle_min, scanner.angle_increment, scanner.time_increment, scanner.range_min, scanner.range_max)
    np.testing.assert_allclose(found, (ANGLE_MIN, INCREMENT, 1e-4, RANGE_MIN, RANGE_MAX), rtol=1e-6)
    mount = (scanner.mount.x, scanner.mount.y, scanner.mount.yaw)
    np.testing.assert_allclose(mount, MOUNT, rtol=0, atol=1e-12)


def test_what_is_no_measurement_becomes_nothing_seen(tmp_path: Path) -> None:
    odd = [math.nan, 0.0, math.inf, -1.0, 0.05, 31.0, -math.inf]
    sent = edited(with_scans(), SCAN, lambda each: changed(each, ranges=[*odd, *each.content["ranges"][len(odd) :]]))
    data = read(write_mcap(tmp_path / "drive", sent))
    ranges = data.scans.of("001").ranges
    assert np.isposinf(ranges[:, : len(odd)]).all()
    assert np.isfinite(ranges[:, len(odd) :]).all()
    assert data.scans.scanner.valid(ranges).sum() == ranges[:, len(odd) :].size


def test_empty_scans_are_left_out_and_counted(tmp_path: Path) -> None:
    sent = edited(with_scans(), SCAN, lambda each: changed(each, ranges=[math.inf] * RAYS), every=5)
    data = read(write_mcap(tmp_path / "drive", sent))
    count = len(scans(SECONDS))
    assert f"topic {SCAN}: {count // 5} of {count} messages left out: {count // 5} without a range" in data.warnings[0]
    assert all(np.isfinite(found.ranges).any(axis=1).all() for _, found in data.scans)


def test_scans_are_saved_and_loaded_with_the_data_set_and_change_neither_wheels_nor_poses(tmp_path: Path) -> None:
    without = read(write_mcap(tmp_path / "drive", part(SECONDS)))
    assert without.scans is None
    data = read(write_mcap(tmp_path / "drive", with_scans()))
    assert data.hash == without.hash
    assert data.referenced
    save_dataset(data, tmp_path / "data")
    loaded = load_dataset(tmp_path / "data")
    assert loaded.scans.scanner == data.scans.scanner
    for run, expected in data.scans:
        np.testing.assert_array_equal(loaded.scans.of(run).times, expected.times)
        np.testing.assert_array_equal(loaded.scans.of(run).ranges, expected.ranges)


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
    late = edited(sent, SCAN, lambda each: replace(each, logged=each.logged + 450_000_000), 4)
    twice = [*late, *scans(SECONDS)[10:13]]
    data = read(write_mcap(tmp_path / "late", twice))
    plain = read(write_mcap(tmp_path / "plain", sent))
    assert f"topic {SCAN}: 3 of {len(scans(SECONDS)) + 3} messages left out" in data.warnings[0]
    assert "recorded late, and sorted" in data.warnings[1]
    for run, expected in plain.scans:
        np.testing.assert_array_equal(data.scans.of(run).ranges, expected.ranges)


@pytest.mark.parametrize(
    ("every", "change", "message"),
    [
        (9, {"ranges": [1.0] * 7}, ", message 9: a scan has 7 ranges, expected 361"),
        (9, {"angle_min": -1.0}, r", message 9: angle_min is -1, expected -2\.35619"),
        (9, {"angle_increment": 0.02}, r", message 9: angle_increment is 0\.02, expected 0\.01309"),
        (9, {"range_min": 0.2}, r", message 9: range_min is 0\.2, expected 0\.1"),
        (9, {"range_max": 12.0}, ", message 9: range_max is 12, expected 30"),
        (1, {"range_max": 0.01}, ".*(without a range|is not below range_max).*scans=false"),
        (1, {"angle_increment": 0.0}, ".*angle_increment is 0.*scans=false"),
        (1, {"angle_increment": 1.0}, ".*361 rays, 1 rad apart.*scans=false"),
        (1, {"time_increment": -1e-4}, ".*time_increment: .*scans=false"),
        (1, {"angle_min": math.inf}, ".*angle_min.*scans=false"),
        (1, {"ranges": []}, ".*without a range.*scans=false"),
        (1, {"header": header(0)}, ".*without a header stamp.*scans=false"),
    ],
)
def test_scans_that_cannot_be_are_refused(tmp_path: Path, every: int, change: dict[str, Any], message: str) -> None:
    sent = edited(with_scans(), SCAN, lambda each: changed(each, **change), every)
    with refused(DataError, match=rf"topic {SCAN}{message}"):
        read(write_mcap(tmp_path / "drive", sent))


def test_scans_by_another_clock_are_refused(tmp_path: Path) -> None:
    sent = edited(with_scans(), SCAN, lambda each: changed(each, header=header(each.logged - EPOCH + 10**9, "laser")))
    with pytest.raises(DataError, match=r"no two messages of /robot/scan while the wheels"):
        read(write_mcap(tmp_path / "drive", sent))


def test_a_time_between_rays_that_varies_is_averaged_and_one_that_is_not_told_is_said(tmp_path: Path) -> None:
    paces = iter([1e-4, 1.5e-4, 0.8e-4] * 1000)
    sent = edited(with_scans(), SCAN, lambda each: changed(each, time_increment=next(paces)))
    data = read(write_mcap(tmp_path / "drive", sent))
    assert "time_increment varies from 8e-05 to 0.00015 s" in data.warnings[0]
    assert data.scans.scanner.time_increment == pytest.approx(1e-4)
    sent = edited(with_scans(), SCAN, lambda each: changed(each, scan_time=0.1))
    (warning,) = read(write_mcap(tmp_path / "told", sent)).warnings
    assert "time_increment is 0" in warning
    assert "scan_time is 0.1 s" in warning


def test_a_mount_that_nothing_tells_is_said_and_can_be_given(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", with_scans(extra=()))
    data = read(source)
    assert "it is unknown where the scanner (laser) is mounted" in data.warnings[0]
    assert "--set 'scanner_mount={x: 0.1, y: 0, yaw: 0}'" in data.warnings[0]
    assert data.scans.scanner.mount == Mount()
    given = read(source, scanner_mount={"x": 0.1, "yaw": 3.0})
    assert given.warnings == ()
    assert given.scans.scanner.mount == Mount(x=0.1, yaw=3.0)
    with pytest.raises(ConfigError, match=r"unknown key 'scanner_mount\.jaw'; did you mean 'yaw'"):
        read(source, scanner_mount={"jaw": 3.0})


def test_a_chain_of_fixed_transforms_is_followed(tmp_path: Path) -> None:
    chain = tf_static(
        transform("top", "robot/laser", 0.1, 0.0, 0.5),
        transform("/robot/base_link", "top", 0.2, 0.3, math.pi / 2),
        transform("map", "robot/base_link", 9.0, 9.0, 1.0),
    )
    sent = edited(with_scans([chain]), SCAN, lambda each: changed(each, header=header(stamp_of(each), "robot/laser")))
    mount = read(write_mcap(tmp_path / "drive", sent)).scans.scanner.mount
    np.testing.assert_allclose((mount.x, mount.y, mount.yaw), (0.2, 0.4, math.pi / 2 + 0.5), rtol=0, atol=1e-9)
    ring = tf_static(transform("a", "laser", 0, 0, 0), transform("laser", "a", 0, 0, 0))
    assert "it is unknown where" in read(write_mcap(tmp_path / "ring", with_scans(extra=[ring]))).warnings[0]


def test_a_scanner_that_hangs_upside_down_counts_its_rays_the_other_way(tmp_path: Path) -> None:
    hanging = tf_static(transform("base_link", "laser", *MOUNT, roll=math.pi))
    upright = read(write_mcap(tmp_path / "upright", with_scans(noise=0.0)))
    flipped = edited(
        with_scans(extra=[hanging], noise=0.0), SCAN, lambda each: changed(each, ranges=each.content["ranges"][::-1])
    )
    data = read(write_mcap(tmp_path / "hanging", flipped))
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
    assert back.scans.scanner.name == SCAN
    beside = read(write_mcap(tmp_path / "beside", [*with_scans(), *elsewhere("/other/scan")]))
    assert beside.scans.scanner.name == SCAN
    two = [*part(SECONDS), MOUNTED, *elsewhere("/front"), *elsewhere("/rear")]
    source = write_mcap(tmp_path / "two", two)
    with pytest.raises(ConfigError, match=r"could be the scan_topic; --set scan_topic=NAME, one of: /front"):
        read(source)
    assert read(source, scan_topic="rear").scans.scanner.name == "/rear"
    for named, message in ((SLAM, "expected sensor_msgs/msg/LaserScan"), ("raer", "did you mean '/rear'")):
        with pytest.raises(ConfigError, match=f"scan_topic: .*{message}"):
            read(source, scan_topic=named)


def test_bags_of_one_scanner_make_one_data_set(tmp_path: Path) -> None:
    (tmp_path / "days").mkdir()
    write_mcap(tmp_path / "days" / "one", with_scans())
    write_mcap(tmp_path / "days" / "two", with_scans())
    data = read(tmp_path / "days")
    assert data.scans.trajectories == ("one/001", "one/002", "two/001", "two/002")
    np.testing.assert_array_equal(data.scans.of("one/002").ranges, data.scans.of("two/002").ranges)
    moved = tf_static(transform("base_link", "laser", 0.5, 0.0, 0.0))
    write_mcap(tmp_path / "days" / "three", with_scans(extra=[moved]))
    with pytest.raises(DataError, match=r"three\.mcap|two\.mcap"):
        read(tmp_path / "days")


def test_a_bag_that_is_gone_when_its_scans_are_wanted_is_told(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", with_scans())
    data = read(source)
    write_mcap(tmp_path / "drive", [*part(SECONDS), *scans(2.0), MOUNTED])
    with pytest.raises(DataError, match=r"the bag has changed"):
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
    with pytest.raises(DataError, match=r"it has no reference poses; .*omnibench\.import_dataset"):
        save_dataset(data, tmp_path / "data")
    with pytest.raises(DataError, match="no messages of type geometry_msgs"):
        read(tmp_path / "drive.mcap", scans=False)


def test_drives_without_two_scans_give_no_run(tmp_path: Path) -> None:
    few = [each for each in without_poses(seconds=7) if each.topic != SCAN or each.logged < EPOCH + 0.5e9]
    with pytest.raises(DataError, match=r"1 of 1 run left out: 1 with fewer than two scans.*; nothing is left"):
        read(write_mcap(tmp_path / "drive", few))


def test_bags_with_and_without_poses_are_imported_apart(tmp_path: Path) -> None:
    (tmp_path / "days").mkdir()
    write_mcap(tmp_path / "days" / "with", with_scans())
    write_mcap(tmp_path / "days" / "without", without_poses())
    with pytest.raises(DataError, match=r"without\.mcap: .*no topic holds reference poses, as it does in other bags"):
        read(tmp_path / "days")


def test_wheels_and_scans_of_the_whole_drive_are_read_one_run_at_a_time(tmp_path: Path) -> None:
    data = read(write_mcap(tmp_path / "drive", [*messages(DRIVE), *scans(1e6), MOUNTED]))
    assert len(data.scans.trajectories) == len(DRIVE.begins)
    assert sum(len(found.times) for _, found in data.scans) > 20 * len(DRIVE.begins)


class TestRosbagWithScansConforms(ImporterConformance):
    name = "rosbag"
    options: ClassVar[dict[str, Any]] = {"robot": ROBOT.model_dump()}

    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def _sample(cls, tmp_path_factory: pytest.TempPathFactory) -> None:
        cls.source = write_mcap(tmp_path_factory.mktemp("bags") / "drive", with_scans())


FIX, IMU = "/gps/fix", "/imu/data"
NAVSAT, INERTIAL = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
LATITUDE, LONGITUDE, HEIGHT = 41.617, 0.628, 160.0
WITHOUT_POSES = [each for each in messages(DRIVE) if each.topic != SLAM]


def degrees_at(places: Array) -> tuple[Array, Array]:
    """Latitudes and longitudes of places (K, 2), m east and north, by the ellipsoid's radii of curvature."""
    a, e2 = 6378137.0, 6.69437999014e-3
    root = math.sqrt(1 - e2 * math.sin(math.radians(LATITUDE)) ** 2)
    meridian, normal = a * (1 - e2) / root**3, a / root
    east = (normal + HEIGHT) * math.cos(math.radians(LATITUDE))
    return LATITUDE + np.degrees(places[:, 1] / (meridian + HEIGHT)), LONGITUDE + np.degrees(places[:, 0] / east)


def fixes(**content: Any) -> list[Sent]:
    """A fix at each reference pose of the drive."""
    said = {
        "status": {"status": 0, "service": 1},
        "altitude": HEIGHT,
        "position_covariance": np.diag([4e-4, 9e-4, 1e-2]).ravel().tolist(),
        "position_covariance_type": 2,
    }
    places = zip(*degrees_at(DRIVE.poses[:, :2]), strict=True)
    contents = [said | {"latitude": float(north), "longitude": float(east)} | content for north, east in places]
    return stamped(FIX, NAVSAT, DRIVE.pose_stamps, contents, late=50_000_000)


def inertial(rate: float, heading: float | None = None, variance: float = 1e-4) -> dict[str, Any]:
    """The content of a message of an inertial sensor; without a heading it tells no orientation."""
    return {
        "orientation": pose((0.0, 0.0, heading or 0.0))["orientation"],
        "orientation_covariance": [-1.0, *[0.0] * 8] if heading is None else np.diag([1e-4, 1e-4, variance]).ravel(),
        "angular_velocity": {"x": 0.0, "y": 0.0, "z": float(rate)},
        "angular_velocity_covariance": [0.0] * 9,
        "linear_acceleration": {"x": 0.0, "y": 0.0, "z": 9.81},
        "linear_acceleration_covariance": [0.0] * 9,
    }


def gyro(offset: float) -> list[Sent]:
    """A gyro's messages with the wheels', whose rates of turn have an offset, rad/s."""
    middle = (DRIVE.stamps[:-1] + DRIVE.stamps[1:]) // 2
    contents = [inertial(rate) for rate in DRIVE.rates @ TRUTH[2] + offset]
    return stamped(IMU, INERTIAL, middle, contents, late=2_000_000)


def compass(**content: Any) -> list[Sent]:
    contents = [inertial(0.0, heading, **content) for heading in DRIVE.poses[:, 2]]
    return stamped(IMU, INERTIAL, DRIVE.pose_stamps, contents, late=2_000_000)


def at(run: Trajectory) -> Array:
    """The true poses (R, 3) at the times of a run's references."""
    times = (DRIVE.pose_stamps - EPOCH) / 1e9
    return np.column_stack([np.interp(run.references.t1 + run.started_at, times, row) for row in DRIVE.poses.T])


def test_fixes_are_positions_east_and_north_of_the_first(tmp_path: Path) -> None:
    data = read(write_mcap(tmp_path / "drive", WITHOUT_POSES + fixes()))
    assert len(data.trajectories) == 12
    for run in data.trajectories:
        assert not run.has_poses
        assert set(run.references.kinds) == {"position"}
        assert np.abs(run.references.values - (at(run) - DRIVE.poses[0])[:, :2]).max() < 1e-3
        assert run.references.sigmas == pytest.approx(np.tile([0.02, 0.03], (len(run.references), 1)))


def test_one_fix_a_period_is_taken(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", WITHOUT_POSES + fixes())
    each, every = (read(source, reference_period=period).trajectories[0].references for period in (1.0, 0.25))
    assert (np.diff(each.t1) > 0.7).all()
    assert len(every) > 3 * len(each)


def test_messages_without_a_fix_are_left_out(tmp_path: Path) -> None:
    sent = fixes()
    lost = [changed(each, status={"status": -1, "service": 1}, latitude=0.0) for each in sent[5:25]]
    data = read(write_mcap(tmp_path / "drive", WITHOUT_POSES + sent[:5] + lost + sent[25:]))
    assert any("20 without a fix (status -1)" in warning for warning in data.warnings)
    assert all(np.abs(run.references.values).max() < 10 for run in data.trajectories if run.references is not None)


@pytest.mark.parametrize(
    ("sent", "asked", "option", "sigma"),
    [
        (fixes(position_covariance_type=0), r"--set fix_sigma=1\.5", {"fix_sigma": 0.5}, 0.5),
        (compass(variance=0.0), "--set heading_sigma_deg=2, .*--set imu=gyro", {"heading_sigma_deg": 2}, np.radians(2)),
    ],
)
def test_sensors_without_a_covariance_need_the_option(
    tmp_path: Path, sent: list[Sent], asked: str, option: dict[str, Any], sigma: float
) -> None:
    source = write_mcap(tmp_path / "drive", WITHOUT_POSES + sent)
    with pytest.raises(DataError, match=asked):
        read(source)
    references = read(source, **option).trajectories[0].references
    assert references.sigmas[:, 0] == pytest.approx(sigma)


def test_an_orientation_is_a_heading_with_its_covariance(tmp_path: Path) -> None:
    data = read(write_mcap(tmp_path / "drive", WITHOUT_POSES + compass()))
    for run in data.trajectories:
        assert set(run.references.kinds) == {"heading"}
        assert run.references.fixed_frame.all()
        turned = run.references.values[:, 0] - at(run)[:, 2]
        assert np.abs(turned - turned[0]).max() < 1e-6
        assert run.references.sigmas[:, 0] == pytest.approx(0.01)


@pytest.mark.parametrize("offset", [pytest.param(0.0, marks=pytest.mark.slow), 0.02])
def test_a_gyro_gives_turned_angles_without_its_offset_at_rest(tmp_path: Path, offset: float) -> None:
    data = read(write_rosbag2(tmp_path / "drive", WITHOUT_POSES + gyro(offset)), gyro_noise_deg=0.2)
    times = (DRIVE.pose_stamps - EPOCH) / 1e9
    for run in data.trajectories:
        assert set(run.references.kinds) == {"turn"}
        begin, end = run.started_at + run.references.t0[0], run.started_at + run.references.t1[-1]
        truth = np.interp([begin, end], times, DRIVE.poses[:, 2])
        assert run.references.values[:, 0].sum() == pytest.approx(truth[1] - truth[0], abs=2e-3)
        spans = run.references.t1 - run.references.t0
        assert run.references.sigmas[:, 0] == pytest.approx(math.radians(0.2) * np.sqrt(spans))
    (sigma,) = {run.references.rate_sigma for run in data.trajectories if run.references is not None}
    still = (np.abs(DRIVE.rates).max(axis=1) < 0.01) @ np.diff(DRIVE.stamps) / 1e9  # the less it rests, the less known
    assert (math.radians(0.2) / sigma) ** 2 == pytest.approx(still, rel=0.1)


def test_a_gyro_that_never_rests_needs_the_size_of_its_offset(tmp_path: Path) -> None:
    sent = part(4.0, WITHOUT_POSES + gyro(0.0))
    source = write_mcap(tmp_path / "drive", sent)
    options = {"least_rest": 100.0, "cut": "none"}
    with pytest.raises(DataError, match=r"never rests.*--set gyro_offset_deg=0\.5"):
        read(source, **options)
    (run,) = read(source, gyro_offset_deg=0.5, **options).trajectories
    assert run.references.rate_sigma == pytest.approx(math.radians(0.5))


def test_a_sensor_mounted_upside_down_is_turned_by_the_signs(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", part(20.0, WITHOUT_POSES + gyro(0.0)))
    upright, turned = (read(source, **options).trajectories for options in ({}, {"pose_signs": (1, 1, -1)}))
    for one, other in zip(upright, turned, strict=True):
        assert (one.references.values[:, 0] == -other.references.values[:, 0]).all()


def test_sensors_count_beside_poses_only_where_they_are_named(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", messages(DRIVE) + fixes() + gyro(0.0))
    assert all(run.references is None for run in read(source).trajectories)
    named = read(source, references=(FIX,)).trajectories[0]
    assert named.has_poses
    assert set(named.references.kinds) == {"position"}
    two = [replace(each, topic="/imu/other") for each in gyro(0.0)]
    several = read(write_mcap(tmp_path / "two", messages(DRIVE) + gyro(0.0) + two))  # of which none is asked for
    assert all(run.references is None for run in several.trajectories)


def test_a_bag_with_fixes_and_a_gyro_calibrates_to_the_truth(tmp_path: Path) -> None:
    data = read(write_mcap(tmp_path / "drive", WITHOUT_POSES + fixes() + gyro(0.005)), validation=("012",))
    matrix = calibrate(data).calibration.matrix
    error = np.abs(matrix[2] / TRUTH[2] - 1).max()
    assert error < np.abs(ROBOT.inverse_kinematic_matrix[2] / TRUTH[2] - 1).max()


def test_references_that_are_not_there_or_several_are_asked_for(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", part(10.0, WITHOUT_POSES + fixes()))
    with pytest.raises(ConfigError, match="did you mean '/gps/fix'"):
        read(source, references=("/gps/fixs",))
    others = [replace(each, topic="/gps2/fix") for each in fixes()]
    with pytest.raises(ConfigError, match=r"--set references=NAME, one of: /gps/fix"):
        read(write_mcap(tmp_path / "two", WITHOUT_POSES + fixes() + others))
    with pytest.raises(DataError, match=r"NavSatFix or Imu"):
        read(write_mcap(tmp_path / "none", part(10.0, WITHOUT_POSES)))


def test_the_plane_keeps_distances_and_directions_near_its_origin() -> None:
    places = np.array([[0.0, 0.0], [300.0, 0.0], [0.0, 400.0], [-200.0, 150.0]])
    assert east_north(*degrees_at(places), (LATITUDE, LONGITUDE), HEIGHT) == pytest.approx(places, abs=0.02)
