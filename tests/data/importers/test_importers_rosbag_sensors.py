"""Bags without reference poses: satellite fixes, compasses and gyros are references, each with its own uncertainty."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_samples import (
    DRIVE,
    EPOCH,
    ROBOT,
    SLAM,
    TRUTH,
    Sent,
    changed,
    header,
    messages,
    part,
    pose,
    read,
    write_mcap,
    write_rosbag2,
)

from omnibench.data.dataset import Trajectory
from omnibench.data.importers.rosbag.sensor_references import east_north
from omnibench.errors import ConfigError, DataError
from omnibench.fit.calibrate import calibrate
from omnibench.robot.kinematics import Array

FIX, IMU = "/gps/fix", "/imu/data"
NAVSAT, INERTIAL = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
LATITUDE, LONGITUDE, HEIGHT = 41.617, 0.628, 160.0
WHEELS_ONLY = [each for each in messages(DRIVE) if each.topic != SLAM]


def degrees_at(places: Array) -> tuple[Array, Array]:
    """Latitudes and longitudes of places (K, 2), m east and north, by the ellipsoid's radii of curvature."""
    a, e2 = 6378137.0, 6.69437999014e-3
    root = math.sqrt(1 - e2 * math.sin(math.radians(LATITUDE)) ** 2)
    meridian, normal = a * (1 - e2) / root**3, a / root
    east = (normal + HEIGHT) * math.cos(math.radians(LATITUDE))
    return LATITUDE + np.degrees(places[:, 1] / (meridian + HEIGHT)), LONGITUDE + np.degrees(places[:, 0] / east)


def fix(stamp: int, latitude: float, longitude: float, **content: Any) -> Sent:
    said = {
        "header": header(stamp, "gps"),
        "status": {"status": 0, "service": 1},
        "latitude": float(latitude),
        "longitude": float(longitude),
        "altitude": HEIGHT,
        "position_covariance": np.diag([4e-4, 9e-4, 1e-2]).ravel().tolist(),
        "position_covariance_type": 2,
    }
    return Sent(FIX, NAVSAT, said | content, int(stamp) + 50_000_000)


def fixes(**content: Any) -> list[Sent]:
    """A fix at each reference pose of the drive."""
    latitudes, longitudes = degrees_at(DRIVE.poses[:, :2])
    triples = zip(DRIVE.pose_stamps, latitudes, longitudes, strict=True)
    return [fix(stamp, latitude, longitude, **content) for stamp, latitude, longitude in triples]


def imu(stamp: int, rate: float, heading: float | None = None, variance: float = 1e-4) -> Sent:
    """A message of an inertial sensor; without a heading it tells no orientation."""
    turn = pose((0.0, 0.0, heading or 0.0))["orientation"]
    content = {
        "header": header(stamp, "imu"),
        "orientation": turn,
        "orientation_covariance": [-1.0, *[0.0] * 8] if heading is None else np.diag([1e-4, 1e-4, variance]).ravel(),
        "angular_velocity": {"x": 0.0, "y": 0.0, "z": float(rate)},
        "angular_velocity_covariance": [0.0] * 9,
        "linear_acceleration": {"x": 0.0, "y": 0.0, "z": 9.81},
        "linear_acceleration_covariance": [0.0] * 9,
    }
    return Sent(IMU, INERTIAL, content, int(stamp) + 2_000_000)


def gyro(offset: float) -> list[Sent]:
    """A gyro's messages with the wheels', whose rates of turn have an offset, rad/s."""
    turning = DRIVE.rates @ TRUTH[2] + offset
    middle = (DRIVE.stamps[:-1] + DRIVE.stamps[1:]) // 2
    return [imu(stamp, rate) for stamp, rate in zip(middle, turning, strict=True)]


def compass(**content: Any) -> list[Sent]:
    pairs = zip(DRIVE.pose_stamps, DRIVE.poses[:, 2], strict=True)
    return [imu(stamp, 0.0, heading, **content) for stamp, heading in pairs]


def at(run: Trajectory) -> Array:
    """The true poses (R, 3) at the times of a run's references."""
    assert run.references is not None
    assert run.started_at is not None
    times = (DRIVE.pose_stamps - EPOCH) / 1e9
    return np.column_stack([np.interp(run.references.t1 + run.started_at, times, row) for row in DRIVE.poses.T])


def test_fixes_are_positions_east_and_north_of_the_first(tmp_path: Path) -> None:
    data = read(write_mcap(tmp_path / "drive", WHEELS_ONLY + fixes()))
    assert len(data.trajectories) == 12
    for run in data.trajectories:
        assert not run.has_poses
        assert run.references is not None
        assert set(run.references.kinds) == {"position"}
        assert np.abs(run.references.values - (at(run) - DRIVE.poses[0])[:, :2]).max() < 1e-3
        assert run.references.sigmas == pytest.approx(np.tile([0.02, 0.03], (len(run.references), 1)))


def test_one_fix_a_period_is_taken(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", WHEELS_ONLY + fixes())
    each, every = (read(source, reference_period=period).trajectories[0].references for period in (1.0, 0.25))
    assert each is not None
    assert every is not None
    assert (np.diff(each.t1) > 0.7).all()
    assert len(every) > 3 * len(each)


def test_messages_without_a_fix_are_left_out(tmp_path: Path) -> None:
    sent = fixes()
    lost = [changed(each, status={"status": -1, "service": 1}, latitude=0.0) for each in sent[5:25]]
    data = read(write_mcap(tmp_path / "drive", WHEELS_ONLY + sent[:5] + lost + sent[25:]))
    assert any("20 without a fix (status -1)" in warning for warning in data.warnings)
    assert all(np.abs(run.references.values).max() < 10 for run in data.trajectories if run.references is not None)


def test_fixes_without_a_covariance_need_the_option(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", WHEELS_ONLY + fixes(position_covariance_type=0))
    with pytest.raises(DataError, match=r"its fixes have no covariance; .*--set fix_sigma=1\.5"):
        read(source)
    references = read(source, fix_sigma=0.5).trajectories[0].references
    assert references is not None
    assert (references.sigmas == 0.5).all()


def test_an_orientation_is_a_heading_with_its_covariance(tmp_path: Path) -> None:
    data = read(write_mcap(tmp_path / "drive", WHEELS_ONLY + compass()))
    for run in data.trajectories:
        assert run.references is not None
        assert set(run.references.kinds) == {"heading"}
        assert run.references.fixed_frame.all()
        turned = run.references.values[:, 0] - at(run)[:, 2]
        assert np.abs(turned - turned[0]).max() < 1e-6
        assert run.references.sigmas[:, 0] == pytest.approx(0.01)


def test_an_orientation_without_a_covariance_needs_the_option(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", WHEELS_ONLY + compass(variance=0.0))
    with pytest.raises(DataError, match=r"--set heading_sigma_deg=2, or .* --set imu=gyro"):
        read(source)
    references = read(source, heading_sigma_deg=2).trajectories[0].references
    assert references is not None
    assert references.sigmas[:, 0] == pytest.approx(math.radians(2))


@pytest.mark.parametrize("offset", [0.0, 0.02])
def test_a_gyro_gives_turned_angles_without_its_offset_at_rest(tmp_path: Path, offset: float) -> None:
    data = read(write_rosbag2(tmp_path / "drive", WHEELS_ONLY + gyro(offset)), gyro_noise_deg=0.2)
    times = (DRIVE.pose_stamps - EPOCH) / 1e9
    for run in data.trajectories:
        assert run.references is not None
        assert set(run.references.kinds) == {"turn"}
        assert run.started_at is not None
        begin, end = run.started_at + run.references.t0[0], run.started_at + run.references.t1[-1]
        truth = np.interp([begin, end], times, DRIVE.poses[:, 2])
        assert run.references.values[:, 0].sum() == pytest.approx(truth[1] - truth[0], abs=2e-3)
        spans = run.references.t1 - run.references.t0
        assert run.references.sigmas[:, 0] == pytest.approx(math.radians(0.2) * np.sqrt(spans))


def test_the_offset_of_a_gyro_is_the_less_known_the_shorter_it_rests(tmp_path: Path) -> None:
    data = read(write_rosbag2(tmp_path / "drive", WHEELS_ONLY + gyro(0.0)), gyro_noise_deg=0.2)
    (sigma,) = {run.references.rate_sigma for run in data.trajectories if run.references is not None}
    rested = (math.radians(0.2) / sigma) ** 2
    still = (np.abs(DRIVE.rates).max(axis=1) < 0.01) @ np.diff(DRIVE.stamps) / 1e9
    assert rested == pytest.approx(still, rel=0.1)


def test_a_gyro_that_never_rests_needs_the_size_of_its_offset(tmp_path: Path) -> None:
    sent = part(4.0, WHEELS_ONLY + gyro(0.0))
    source = write_mcap(tmp_path / "drive", sent)
    options = {"least_rest": 100.0, "cut": "none"}
    with pytest.raises(DataError, match=r"never rests.*--set gyro_offset_deg=0\.5"):
        read(source, **options)
    (run,) = read(source, gyro_offset_deg=0.5, **options).trajectories
    assert run.references is not None
    assert run.references.rate_sigma == pytest.approx(math.radians(0.5))


def test_a_sensor_mounted_upside_down_is_turned_by_the_signs(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", part(20.0, WHEELS_ONLY + gyro(0.0)))
    upright, turned = (read(source, **options).trajectories for options in ({}, {"pose_signs": (1, 1, -1)}))
    for one, other in zip(upright, turned, strict=True):
        assert one.references is not None
        assert other.references is not None
        assert (one.references.values[:, 0] == -other.references.values[:, 0]).all()


def test_sensors_count_beside_poses_only_where_they_are_named(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", messages(DRIVE) + fixes() + gyro(0.0))
    assert all(run.references is None for run in read(source).trajectories)
    named = read(source, references=(FIX,)).trajectories[0]
    assert named.has_poses
    assert named.references is not None
    assert set(named.references.kinds) == {"position"}


def test_a_bag_with_fixes_and_a_gyro_calibrates_to_the_truth(tmp_path: Path) -> None:
    data = read(write_mcap(tmp_path / "drive", WHEELS_ONLY + fixes() + gyro(0.005)), validation=("012",))
    matrix = calibrate(data).calibration.matrix
    error = np.abs(matrix[2] / TRUTH[2] - 1).max()
    assert error < np.abs(ROBOT.inverse_kinematic_matrix[2] / TRUTH[2] - 1).max()


def test_an_unknown_reference_topic_names_the_nearest(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "drive", part(10.0, WHEELS_ONLY + fixes()))
    with pytest.raises(ConfigError, match="did you mean '/gps/fix'"):
        read(source, references=("/gps/fixs",))


def test_several_sensors_of_a_kind_are_asked_for(tmp_path: Path) -> None:
    others = [Sent("/gps2/fix", each.kind, each.content, each.logged) for each in fixes()]
    source = write_mcap(tmp_path / "drive", WHEELS_ONLY + fixes() + others)
    with pytest.raises(ConfigError, match=r"several topics could be the reference: .*--set references=\[/gps/fix\]"):
        read(source)


def test_a_bag_without_any_reference_names_all_that_could_be_one(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nor another reference .*NavSatFix or Imu"):
        read(write_mcap(tmp_path / "drive", part(10.0, WHEELS_ONLY)))


def test_the_plane_keeps_distances_and_directions_near_its_origin() -> None:
    places = np.array([[0.0, 0.0], [300.0, 0.0], [0.0, 400.0], [-200.0, 150.0]])
    assert east_north(*degrees_at(places), (LATITUDE, LONGITUDE), HEIGHT) == pytest.approx(places, abs=0.02)
