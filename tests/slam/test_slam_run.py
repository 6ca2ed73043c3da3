"""SLAM of runs and data sets: accurate, unbiased and honest where scans tell the pose, and honest where they do not."""

import math
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from bag_samples import DRIVE, EPOCH, Sent, header, odometry_error, pose, read, text, write_mcap, write_rosbag1
from hypothesis import given
from hypothesis import strategies as st
from lanes import slow
from scan_samples import MOUNTED, SECONDS, without_poses
from slam_study import ROBOT, Run, drive, flower_command

from omnibench.config import validate
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.scans import Ranges, Scanner, ScansInMemory, TrajectoryScans
from omnibench.data.true_poses import TruePath
from omnibench.errors import ConfigError, DataError
from omnibench.progress import Progress
from omnibench.robot.kinematics import Array, compose, published_matrix, relative
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import advance
from omnibench.simulate.commands import Command
from omnibench.simulate.floor_plan import FloorPlan, RoomPlan, make_plan
from omnibench.simulate.lidar import Lidar, LidarMount
from omnibench.slam.import_dataset import import_dataset
from omnibench.slam.motion_prior import LastPosePrior, OdometryPrior, smoothed
from omnibench.slam.slam_dataset import (
    FLOOR,
    SlamPath,
    distances,
    run_errors,
    run_slam,
    slam_accuracy,
    slam_dataset,
    slam_paths,
)
from omnibench.slam.slam_options import SlamOptions
from omnibench.testing.synthetic import synthetic_dataset

LIDAR = Lidar()
SLOW = Lidar(turn_time=0.2)
FAST = Command(0.5, 0.6, 1.0)
DEFAULT = SlamOptions()
LAST_POSE = SlamOptions(start="last_pose")
MM, DEGREE = 1e-3, np.radians(1.0)


@cache
def room(name: str) -> FloorPlan:
    return make_plan(RoomPlan(plan=name), name)


@cache
def driven(name: str, number: int, lidar: Lidar = LIDAR) -> Run:
    return drive(room(name), lidar, flower_command(number), np.random.default_rng([11, number]))


@cache
def located(run: Run, options: SlamOptions = DEFAULT, scanner: Scanner = LIDAR.scanner) -> SlamPath:
    return run_slam(run.scans, scanner, options, np.zeros(3), run.odometry)


def changed(run: Run, change: Callable[[Ranges], None]) -> Run:
    ranges = run.scans.ranges.copy()
    change(ranges)
    return replace(run, scans=TrajectoryScans(run.scans.times, ranges))


def errors(path: SlamPath, run: Run) -> Array:
    return path.poses - run.true


def problems(path: SlamPath) -> list[str]:
    return [str(warning) for warning in path.warnings]


def nees(path: SlamPath, run: Run) -> Array:
    """Of the poses after the first."""
    found = errors(path, run)[1:, :, None]
    return (found * np.linalg.solve(path.covariances[1:], found)).sum(axis=(1, 2))


# In the furnished room, where 1 cm and 0.3 deg in the mean at the end of a run are required.


@pytest.mark.parametrize(
    "options", [DEFAULT, pytest.param(LAST_POSE, marks=pytest.mark.slow)], ids=["odometry", "last_pose"]
)
def test_flower_runs_end_within_2_mm_and_0_05_deg_and_covariances_say_so(options: SlamOptions) -> None:
    runs = [driven("furnished_room", number) for number in range(8)]
    final = np.array([errors(located(run, options), run)[-1] for run in runs])
    assert np.hypot(final[:, 0], final[:, 1]).mean() < 2 * MM
    assert np.abs(final[:, 2]).mean() < 0.05 * DEGREE
    assert 1.5 < np.mean([nees(located(run, options), run).mean() for run in runs]) < 5
    assert problems(located(runs[2])) == []


@pytest.mark.slow
def test_the_odometry_does_not_pull_at_the_poses() -> None:
    for number in (1, 2, 5):
        run = driven("furnished_room", number)

        def shorter(times: Array, run: Run = run) -> Array:
            return 0.9 * run.odometry(times)

        found = run_slam(run.scans, LIDAR.scanner, SlamOptions(), np.zeros(3), shorter)
        moved = np.abs(found.poses - located(run).poses).max(axis=0)
        assert moved[:2].max() < 0.3 * MM
        assert moved[2] < 0.01 * DEGREE


def test_a_fast_robot_is_found_from_its_last_pose() -> None:
    run = drive(room("furnished_room"), LIDAR, FAST, np.random.default_rng(1), distance=1.1)
    assert np.abs(np.diff(run.true[:, 2])).max() > 0.2  # rad from scan to scan
    found = errors(located(run, LAST_POSE), run)
    assert np.abs(found[:, :2]).max() < 6 * MM
    assert np.abs(found[:, 2]).max() < 0.2 * DEGREE


def test_deskewing_takes_the_motion_within_a_scan_out() -> None:
    run = drive(room("furnished_room"), LIDAR, FAST, np.random.default_rng(2), distance=1.1)
    moving = slice(3, -4)
    with_it, without = (errors(located(run, SlamOptions(deskew=on)), run)[moving] for on in (True, False))
    assert np.abs(with_it[:, 2]).mean() < 0.2 * np.abs(without[:, 2]).mean()


def test_the_poses_are_the_robots_wherever_the_scanner_sits() -> None:
    lidar = Lidar(mount=LidarMount(x=-0.2, y=0.15, yaw_deg=70.0))
    run = driven("furnished_room", 2, lidar)
    found = errors(located(run, scanner=lidar.scanner), run)
    assert np.hypot(found[:, 0], found[:, 1]).max() < 4 * MM


def test_poses_begin_at_the_start_pose_and_headings_go_on_beyond_a_turn() -> None:
    command = Command(0.05, 0.0, 1.2)
    run = drive(room("furnished_room"), LIDAR, command, np.random.default_rng(4), distance=0.35)
    start = np.array([5.0, -3.0, 2.0])
    path = run_slam(run.scans, LIDAR.scanner, SlamOptions(), start, run.odometry)
    np.testing.assert_array_equal(path.poses[0], start)
    assert run.true[-1, 2] > 7
    assert path.poses[-1, 2] - 2.0 == pytest.approx(run.true[-1, 2], abs=0.2 * DEGREE)
    way = (run.true[-1, 0] + 1j * run.true[-1, 1]) * np.exp(2j)
    assert path.poses[-1, :2] == pytest.approx([5.0 + way.real, -3.0 + way.imag], abs=4 * MM)


# A slow scanner: the robot drives 4 cm or more in a scan, and none when it has stopped.


def test_a_slow_scanners_covariances_are_honest_and_its_poses_as_good_as_a_fast_ones() -> None:
    runs = [driven("furnished_room", number, SLOW) for number in range(4)]
    paths = [located(run, scanner=SLOW.scanner) for run in runs]
    position = np.concatenate([np.hypot(*errors(path, run)[1:, :2].T) for path, run in zip(paths, runs, strict=True)])
    assert position.mean() < 1.5 * MM
    assert 1 < np.mean([nees(path, run).mean() for path, run in zip(paths, runs, strict=True)]) < 5


@pytest.mark.slow
@pytest.mark.parametrize("turn_time", [0.025, 0.2])
def test_coarse_encoders_do_not_make_covariances_dishonest(turn_time: float) -> None:
    tick, lidar = 2 * np.pi / 400, Lidar(turn_time=turn_time)
    found = []
    for number in range(6):
        run = driven("furnished_room", number, lidar)
        phases = np.random.default_rng(number).uniform(size=3)  # a wheel stands anywhere between two ticks
        counts = np.floor(np.cumsum(run.log.rates * 0.01, axis=0) / tick + phases)
        rates = np.diff(counts, axis=0, prepend=0.0) * tick / 0.01
        coarse = replace(run, log=replace(run.log, rates=rates))
        found.append(nees(located(coarse, scanner=lidar.scanner), coarse).mean())
    assert 1 < np.mean(found) < 6


# A corridor does not tell how far along it the robot is.


def test_along_a_corridor_odometry_is_kept_the_covariance_grows_with_the_way_and_it_is_said() -> None:
    run = driven("corridor", 3)
    path = located(run)
    found, stated = errors(path, run), np.sqrt(np.diagonal(path.covariances, axis1=1, axis2=2))
    odometry = run.odometry(run.scans.times)
    assert np.abs(path.poses[:, 0] - odometry[:, 0]).max() < 25 * MM  # its axis is that of the run, within degrees
    assert np.abs(found[:, 0]).max() > 20 * MM  # which is as wrong as the odometry is
    assert stated[-1, 0] > 50 * MM
    assert (np.diff(stated[1:, 0]) > -0.01 * MM).all()
    assert stated[-1, 1] < stated[-1, 0] / 10
    assert np.abs(found[:, 2]).max() < 0.05 * DEGREE
    (problem,) = problems(path)  # the robot stands along it, within some degrees
    assert re.fullmatch(r"scans tell too little along ([0-6]|17\d) deg of the run's frame", problem)


@pytest.mark.parametrize(
    ("name", "count", "options", "lidar", "least", "most"),
    [
        ("corridor", 6, DEFAULT, LIDAR, 1, 5),
        pytest.param("corridor", 6, LAST_POSE, LIDAR, 1, 5, marks=pytest.mark.slow),
        pytest.param("hall", 4, DEFAULT, LIDAR, 1.5, 5, marks=pytest.mark.slow),
        pytest.param("furnished_room", 4, SlamOptions(deskew=False), LIDAR, 0, 5, marks=pytest.mark.slow),
        pytest.param("furnished_room", 4, LAST_POSE, SLOW, 1, 6, marks=pytest.mark.slow),
    ],
    ids=["corridor", "corridor from the last pose", "hall", "not deskewed", "slow scanner from the last pose"],
)
def test_stated_covariances_hold_the_errors(
    name: str, count: int, options: SlamOptions, lidar: Lidar, least: float, most: float
) -> None:
    runs = [driven(name, number, lidar) for number in range(count)]
    assert least < np.mean([nees(located(run, options, lidar.scanner), run).mean() for run in runs]) < most


@pytest.mark.slow
def test_in_a_hall_poses_are_accurate() -> None:
    final = np.array([errors(located(run), run)[-1] for run in (driven("hall", number) for number in range(4))])
    assert np.hypot(final[:, 0], final[:, 1]).mean() < 3 * MM


def walk(ranges: Ranges) -> None:
    """People walk about."""
    for first, step, distance in ((200, 20, 1.2), (500, -15, 0.9), (900, -30, 1.5)):
        width = round(0.2 / distance / LIDAR.scanner.angle_increment)
        for number, scan in enumerate(ranges):
            begin = max(0, first + step * number)
            body = scan[begin : begin + 2 * width]
            round_ = np.sqrt(1 - np.linspace(-0.99, 0.99, len(body)) ** 2)
            np.minimum(body, (distance - 0.2 * round_).astype(np.float32), out=body)


def blind_at_first(ranges: Ranges) -> None:
    """Of the first scan hardly anything is seen: the map begins with those that follow, where the odometry led."""
    ranges[0, :] = np.inf
    ranges[0, 500:520] = 2.0


def lose(ranges: Ranges) -> None:
    """Returns are lost."""
    ranges[np.random.default_rng(1).uniform(size=ranges.shape) < 0.3] = np.inf


@pytest.mark.parametrize(("change", "most"), [(walk, 15), (blind_at_first, 20), (lose, 5)])
def test_people_lost_returns_and_a_blind_first_scan_cost_little(change: Callable[[Ranges], None], most: int) -> None:
    run = changed(driven("furnished_room", 4), change)
    found = errors(located(run), run)
    assert np.hypot(found[:, 0], found[:, 1]).max() < most * MM


def test_a_scan_with_a_few_returns_keeps_the_start_and_says_so() -> None:
    def nearly_blind(ranges: Ranges) -> None:
        ranges[6, :] = np.inf
        ranges[6, 500:503] = 2.0

    run = changed(driven("furnished_room", 4), nearly_blind)
    path = located(run)
    assert path.matched[6] == 0
    assert path.covariances[6, 0, 0] > 4 * path.covariances[7, 0, 0]
    assert np.hypot(*errors(path, run)[7, :2]) < 4 * MM
    (problem,) = problems(path)
    assert "less than a fifth" in problem


@pytest.mark.slow
def test_ranges_noisier_than_the_scanner_says_are_noticed() -> None:
    runs = [driven("furnished_room", number, Lidar(noise=0.03, far_noise=0.06)) for number in range(4)]
    assert np.mean([nees(located(run), run).mean() for run in runs]) < 5


def test_the_odometry_is_asked_for_increasing_times() -> None:
    run = driven("furnished_room", 4)

    def increasing(times: Array) -> Array:
        assert (np.diff(times) > 0).all()
        return run.odometry(times)

    for options in (DEFAULT, LAST_POSE):
        found = run_slam(run.scans, LIDAR.scanner, options, np.zeros(3), increasing)
        np.testing.assert_array_equal(found.poses, located(run, options).poses)


def test_what_cannot_be_located_is_named() -> None:
    run = driven("furnished_room", 4)
    none = TrajectoryScans(np.zeros(0), np.zeros((0, 1080), dtype=np.float32))
    few = TrajectoryScans(run.scans.times, run.scans.ranges[:, :500])
    blind = run.scans.ranges.copy()
    blind[3] = np.inf
    for scans, odometry, named in (
        (none, run.odometry, "there is no scan"),
        (few, run.odometry, r"\(\d+, 500\), expected \(\d+, 1080\)"),
        (TrajectoryScans(run.scans.times, blind), run.odometry, rf"scan at {run.scans.times[3]:g} s is empty"),
        (run.scans, None, "start: last_pose"),
    ):
        with pytest.raises(DataError, match=named):
            run_slam(scans, LIDAR.scanner, SlamOptions(), np.zeros(3), odometry)
    with pytest.raises(ConfigError, match=r"search_distance 0\.1 m .*match_distance 0\.5 m"):
        validate(SlamOptions, {"search_distance": 0.1, "match_distance": 0.5}, "config")


def test_a_scanner_that_is_tilted_to_the_floor_is_located_as_well_as_a_horizontal_one() -> None:
    lidar = LIDAR.model_copy(update={"mount": LidarMount(pitch_deg=10.0, height=0.4)})
    run = driven("furnished_room", 4, lidar)
    walls = ~lidar.scanner.on_floor(run.scans.ranges)
    assert 0.05 < 1 - walls.mean() < 0.5  # a part of every scan is floor
    path = located(run, DEFAULT, lidar.scanner)
    assert np.abs(errors(path, run)[:, :2]).max() < 8 * MM
    assert np.abs(errors(path, run)[:, 2]).max() < 0.3 * DEGREE
    assert np.abs(errors(located(run), run)[:, :2]).max() > np.abs(errors(path, run)[:, :2]).max()


TIMES = np.array([1.0, 1.25, 1.5])


def circle(speed: float, turn_rate: float, start: Sequence[float] = (0.0, 0.0, 0.0)) -> Callable[[Array], Array]:
    """Odometry of a constant twist."""
    twist = np.array([speed, 0.0, turn_rate])
    return lambda times: np.array([advance(np.array(start), twist * time, "arc") for time in times])


@given(
    speed=st.floats(-1, 1), turn_rate=st.floats(-2, 2), heading=st.floats(-4, 4), duration=st.sampled_from([0.02, 0.2])
)
def test_a_steady_twist_is_found(speed: float, turn_rate: float, heading: float, duration: float) -> None:
    path = circle(speed, turn_rate, (1.0, 2.0, heading))
    (_, within, _), coarse = smoothed(path, TIMES, duration)
    np.testing.assert_allclose(within.mean, [speed, 0.0, turn_rate], atol=1e-6)
    np.testing.assert_allclose(within.at(np.array([duration])), [duration * within.mean], atol=1e-9)
    np.testing.assert_allclose([coarse, within.deviations], 0.0, atol=1e-6)
    found, coarse = smoothed(path, TIMES, 0.0)
    assert not np.any([each.mean for each in found])
    assert not coarse.any()


def test_a_robot_that_speeds_up_is_followed_through_the_scan() -> None:
    def speeding(times: Array) -> Array:
        return np.column_stack([0.25 * times**2, 0.05 * times**2, 0 * times])

    (_, within, _), _ = smoothed(speeding, TIMES, 0.2)
    delays = np.linspace(0.0, 0.2, 5)
    expected = speeding(1.25 + delays) - speeding(np.array([1.25]))
    np.testing.assert_allclose(within.at(delays), expected, atol=1e-9)


def test_a_scan_without_ticks_is_as_uncertain_as_scans_are_in_the_mean() -> None:
    """A robot that stands at first shows no ticks then, and has them all the same."""

    def ticking_later(times: Array) -> Array:
        return np.column_stack([0.002 * np.floor(0.137 * np.maximum(times - 2.0, 0.0) / 0.002), 0 * times, 0 * times])

    motions, _ = smoothed(ticking_later, np.array([1.0, 3.0, 3.5]), 0.2)
    still, *moving = (motion.deviations[0] ** 2 for motion in motions)
    assert still > 0
    assert sum(moving) / 3 <= still <= min(moving) * (1 + 1e-9)


def test_ticks_are_smoothed_out_and_what_they_hide_is_said() -> None:
    tick = 0.002

    def ticking(times: Array) -> Array:
        return np.column_stack([tick * np.floor(0.137 * times / tick), 0 * times, 0 * times])

    times = 1.0 + 0.23 * np.arange(40)
    found, coarse = smoothed(ticking, times, 0.02)
    assert coarse[0] == pytest.approx(tick / np.sqrt(12), rel=0.2)
    missed = np.array([within.mean[0] - 0.137 for within in found])
    assert np.abs(missed).max() < 0.02  # while the ticks within 20 ms tell 0.1 or 0.2 m/s
    assert (np.abs(missed) < 3 * np.array([within.deviations[0] for within in found])).all()


# What the pose found tells of an odometry that is wrong in scale.


LAST = np.array([0.4, -0.3, 1.0])


def test_odometry_that_is_short_is_put_right_within_the_scan() -> None:
    motion = OdometryPrior(circle(0.27, 0.9), TIMES, 0.1, SlamOptions())  # of 0.3 m/s and 1 rad/s
    found = compose(LAST, advance(np.zeros(3), np.array([0.3, 0.0, 1.0]) * 0.25, "arc"))
    twist, deviations = motion.correct(1, LAST, found, np.array([0.03, 0.0, 0.1]))
    np.testing.assert_allclose(twist, [0.03, 0.0, 0.1], rtol=0.05, atol=1e-6)
    assert (deviations < [0.01, 0.01, 0.05]).all()


def test_of_a_robot_that_only_now_begins_to_move_nothing_is_known_but_the_odometrys_error() -> None:
    def begins(times: Array) -> Array:
        return np.column_stack([0.5 * np.maximum(times - 1.25, 0.0) ** 2, 0 * times, 0 * times])

    motion = OdometryPrior(begins, TIMES, 0.2, SlamOptions(odometry_error=0.1))
    twist, deviations = motion.correct(1, LAST, compose(LAST, np.array([1e-3, 0.0, 0.0])), np.zeros(3))
    speed = motion.predict(1, LAST).within.mean[0]
    assert 0.05 < speed < 0.15
    assert np.abs(twist).max() < 1e-3
    assert deviations[0] > 0.1 * speed


def test_a_twist_between_scans_is_that_of_the_arc_and_not_of_its_chord() -> None:
    motion = LastPosePrior(TIMES, 0.1, SlamOptions())
    path = circle(0.3, 1.0)(TIMES)
    assert motion.predict(1, path[0]).within.mean == pytest.approx(0.0)
    twist, _ = motion.correct(1, path[0], path[1], np.zeros(3))
    then = motion.predict(2, path[1]).within.mean
    np.testing.assert_allclose(then, [0.3, 0.0, 1.0], atol=1e-12)
    twist, _ = motion.correct(2, path[1], path[2], np.zeros(3))
    np.testing.assert_allclose(twist, 0.0, atol=1e-12)
    assert abs(relative(path[0], path[1])[1]) > 0.009  # m, which a chord would take for a motion to the left


@cache
def polygon(corners: int, radius: float = 3.0, stretch: float = 1.0, start: tuple[float, float] = (0, 0)) -> FloorPlan:
    """A regular polygon about the origin, stretched along x."""
    angles = 2 * np.pi * np.arange(corners) / corners
    boundary = tuple((float(stretch * radius * np.cos(at)), float(radius * np.sin(at))) for at in angles)
    return make_plan(RoomPlan(boundary=boundary, start=(*start, 0.0)), "room")


@cache
def driven_in(plan: FloorPlan, number: int, lidar: Lidar = LIDAR) -> Run:
    return drive(plan, lidar, flower_command(number), np.random.default_rng([5, number]), distance=0.9)


def mirrored(run: Run) -> Run:
    return replace(run, scans=TrajectoryScans(run.scans.times, np.ascontiguousarray(run.scans.ranges[:, ::-1])))


def since_start(headings: Array) -> Array:
    return headings - headings[0]


ROUND = [
    pytest.param(polygon(400), LIDAR, id="centre"),
    pytest.param(polygon(72), LIDAR, id="72_corners", marks=pytest.mark.slow),
    pytest.param(polygon(400, radius=1.5), LIDAR, id="small", marks=pytest.mark.slow),
    pytest.param(polygon(400, radius=8.0), LIDAR, id="large", marks=pytest.mark.slow),
    pytest.param(polygon(400), Lidar(noise=0.002, far_noise=0.002), id="precise", marks=pytest.mark.slow),
    pytest.param(polygon(400), Lidar(rays=361), id="few_rays", marks=pytest.mark.slow),
]


# A round room tells where the robot is, but not how it is turned.


@pytest.mark.parametrize(("plan", "lidar"), ROUND)
def test_in_a_round_room_the_heading_is_the_odometrys_and_said_uncertain(plan: FloorPlan, lidar: Lidar) -> None:
    for number in (0, 2):  # whose odometry ends 6 deg off
        run = driven_in(plan, number, lidar)
        path = located(run, scanner=lidar.scanner)
        wrong = since_start(run.odometry(run.scans.times)[:, 2])
        assert np.abs(wrong - run.true[:, 2])[-1] > 5 * DEGREE
        assert np.abs(since_start(path.poses[:, 2]) - wrong).max() < 0.6 * DEGREE
        stated = np.sqrt(path.covariances[1:, 2, 2])
        assert (np.abs(path.poses - run.true)[1:, 2] < 2 * stated).all()
        assert stated[-1] > 5 * DEGREE
        assert problems(path) == ["scans tell too little of the heading"]


@pytest.mark.slow
def test_off_the_centre_of_a_round_room_the_heading_is_no_worse_than_the_odometrys() -> None:
    for number in range(3):  # its way about the centre tells of the heading, too
        run = driven_in(polygon(400, start=(1.0, 0.5)), number)
        path = located(run)
        wrong = since_start(run.odometry(run.scans.times)[:, 2]) - run.true[:, 2]
        assert np.abs(path.poses - run.true)[-1, 2] < abs(wrong[-1]) + 0.6 * DEGREE
        assert np.sqrt(path.covariances[-1, 2, 2]) > 5 * DEGREE
        assert problems(path) == ["scans tell too little of the heading"]


def test_where_the_robot_is_in_a_round_room_stays_known() -> None:
    run = driven_in(polygon(400), 1)  # straight, and its odometry keeps the heading
    found = (located(run).poses - run.true)[:, :2]
    assert np.hypot(*found.T).max() < 5 * MM


@pytest.mark.parametrize(
    "plan",
    [polygon(8), *(pytest.param(polygon(400, stretch=each), marks=pytest.mark.slow) for each in (1.2, 2.0))],
    ids=["octagon", "oval", "ellipse"],
)
def test_in_a_nearly_round_room_the_heading_is_told_by_its_shape(plan: FloorPlan) -> None:
    for number in range(3):
        run = driven_in(plan, number)
        path = located(run)
        assert np.abs(path.poses - run.true)[-1, 2] < 0.2 * DEGREE
        assert path.covariances[-1, 2, 2] < (0.2 * DEGREE) ** 2
        assert path.warnings == ()


@pytest.mark.parametrize("options", [SlamOptions(), LAST_POSE], ids=["odometry", "last_pose"])
@pytest.mark.parametrize("number", [1, *slow(0, 3)])
def test_a_mirrored_or_turned_scanner_and_standing_wheels_are_said(number: int, options: SlamOptions) -> None:
    run, scanner = driven_in(room("furnished_room"), number), LIDAR.scanner
    turned = scanner.model_copy(update={"mount": scanner.mount.model_copy(update={"yaw": np.pi})})
    still = run_slam(run.scans, scanner, SlamOptions(), np.zeros(3), lambda times: np.zeros((len(times), 3)))
    for path in (located(mirrored(run), options), located(run, scanner=turned), still):
        (problem,) = problems(path)
        assert re.match(r"poses and odometry disagree by \d+ % of the motion: .*mirrored", problem)
    assert "by 1000 % of the motion" in problem  # which is the most that is said


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.8, 1.25])
@pytest.mark.parametrize("options", [SlamOptions(), LAST_POSE], ids=["odometry", "last_pose"])
def test_a_disagreement_within_what_wheels_may_be_wrong_by_is_not_said(options: SlamOptions, scale: float) -> None:
    for number in range(3):
        run = driven_in(room("furnished_room"), number)

        def odometry(times: Array, run: Run = run) -> Array:
            return run.odometry(times) * np.array([scale, scale, 1.0])

        assert run_slam(run.scans, LIDAR.scanner, options, np.zeros(3), odometry).warnings == ()


def test_a_disagreement_along_what_scans_do_not_tell_is_not_said() -> None:
    run = driven_in(room("corridor"), 0)
    (problem,) = problems(located(run, LAST_POSE))
    assert problem.startswith("scans tell too little along")


@pytest.mark.slow
def test_a_disagreement_of_many_runs_is_one_sentence_with_its_mean() -> None:
    shares, trajectories, scans = [], [], {}
    for number in (0, 1, 3):
        run = mirrored(driven_in(room("furnished_room"), number))
        shares += [warning.share for warning in located(run).warnings if warning.share is not None]
        ends = np.array([0.0, float(run.log.times[-1])])
        trajectories.append(
            Trajectory(f"run-{number}", "train", run.log.times, run.log.rates, ends, np.zeros((2, 3)), command="")
        )
        scans[f"run-{number}"] = run.scans
    held = ScansInMemory(LIDAR.scanner, scans)
    dataset = make_dataset("mirrored", ROBOT, 0.01, trajectories, simulated=True, scans=held)
    (warning,) = [each for each in slam_dataset(dataset, SlamOptions(), workers=1).warnings if "SLAM" in each]
    assert warning.startswith(f"SLAM: poses and odometry disagree by {100 * np.mean(shares):.0f} % of the motion")
    assert warning.endswith(": 3 of 3 runs, e.g. run-0, run-1, run-3")


# SLAM of whole data sets: what becomes of them, on import too, and what is said of bad ones.

START = np.array([1.0, 2.0, 0.5])


@cache
def recorded(room: str = "furnished_room", runs: int = 3) -> tuple[Dataset, dict[str, TruePath]]:
    """Short runs whose poses are not known but for the start, and where the robot truly was, from there on."""
    plan = make_plan(RoomPlan(plan=room), room)
    trajectories, scans, truth = [], {}, {}
    for number in range(runs):
        run = drive(plan, LIDAR, flower_command(number), np.random.default_rng([3, number]), distance=0.4)
        name = f"run-{number}"
        scans[name] = run.scans
        poses = np.array([START, START])
        last = float(run.log.times[-1])
        trajectories.append(
            Trajectory(name, "train", run.log.times, run.log.rates, np.array([0.0, last]), poses, command=f"{number}")
        )
        way = (run.true[:, 0] + 1j * run.true[:, 1]) * np.exp(1j * START[2])
        true = np.column_stack([START[0] + way.real, START[1] + way.imag, START[2] + run.true[:, 2]])
        truth[name] = TruePath(run.scans.times, true)
    held = ScansInMemory(LIDAR.scanner, scans)
    return make_dataset("rooms", ROBOT, 0.01, trajectories, simulated=True, scans=held), truth


@cache
def found_alone() -> Dataset:
    """What SLAM in this process makes of them."""
    return slam_dataset(recorded()[0], SlamOptions(), workers=1)


def with_scans(dataset: Dataset, **changed: TrajectoryScans | None) -> Dataset:
    """The data set with other scans for some runs; None: with none."""
    scans = dict(dataset.scans) | {name.replace("_", "-"): found for name, found in changed.items()}
    kept = {name: found for name, found in scans.items() if found is not None}
    return replace(dataset, scans=ScansInMemory(LIDAR.scanner, kept))


def test_poses_are_found_from_the_start_pose_on_at_the_stamps_of_the_scans_and_all_else_stays() -> None:
    dataset, truth = recorded()
    found = found_alone()
    for run in found.trajectories:
        np.testing.assert_array_equal(run.pose_times, truth[run.id].times)
        np.testing.assert_array_equal(run.poses[0], START)
        assert np.abs(run.poses - truth[run.id].poses).max() < 0.004
        assert (np.linalg.eigvalsh(run.pose_covariances) > 0).all()
    assert (found.name, found.robot, found.simulated, found.scans) == ("rooms", ROBOT, True, dataset.scans)
    for before, after in zip(dataset.trajectories, found.trajectories, strict=True):
        assert after.command == before.command
        np.testing.assert_array_equal(after.rates, before.rates)
    assert found.warnings == ()


def test_paths_that_have_a_folder_need_no_temporary_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = found_alone()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "full"))
    paths = slam_paths(recorded()[0], SlamOptions(), workers=1, folder=tmp_path / "paths")
    for path, run in zip(paths, alone.trajectories, strict=True):
        np.testing.assert_array_equal(path.poses, run.poses)


def test_poses_do_not_depend_on_the_number_of_processes_and_progress_is_told_run_by_run() -> None:
    told: list[Progress] = []
    found = slam_dataset(recorded()[0], SlamOptions(), workers=2, watch=told.append)
    assert found.hash == found_alone().hash
    assert told == [Progress("SLAM", done, 3, "run") for done in range(4)]


def test_poses_do_not_depend_on_the_odometry_that_the_search_starts_from() -> None:
    dataset, _ = recorded()
    better = OdometryModel(ROBOT, published_matrix("palacin2023_eq9"), "arc")
    other = slam_dataset(dataset, SlamOptions(), model=better, workers=1)
    for one, two in zip(found_alone().trajectories, other.trajectories, strict=True):
        assert 0 < np.abs(one.poses - two.poses).max() < 0.0002


def test_poses_begin_at_t_0_when_the_first_scan_comes_later() -> None:
    dataset, truth = recorded()
    scans = dataset.scans.of("run-1")
    late = with_scans(dataset, run_1=TrajectoryScans(scans.times[1:], scans.ranges[1:]))
    run = slam_dataset(late, SlamOptions(), workers=1).trajectories[1]
    np.testing.assert_array_equal(run.pose_times, [0.0, *scans.times[1:]])
    np.testing.assert_array_equal(run.poses[0], START)
    assert len(run.pose_covariances) == len(run.poses)
    assert np.abs(run.poses - truth["run-1"].poses).max() < 0.01  # as the odometry missed until then
    np.testing.assert_array_equal(run.pose_covariances[0], FLOOR)


def test_poses_are_as_uncertain_as_the_odometry_until_a_first_scan_that_comes_later() -> None:
    dataset, truth = recorded()
    late = {name: TrajectoryScans(scans.times[8:], scans.ranges[8:]) for name, scans in dataset.scans}
    found = slam_dataset(replace(dataset, scans=ScansInMemory(LIDAR.scanner, late)), SlamOptions(), workers=1)
    for run in found.trajectories:
        way = np.hypot(*(run.poses[1] - START)[:2])
        assert way > 0.2
        stated = np.sqrt(np.linalg.eigvalsh(run.pose_covariances[:, :2, :2])[:, -1])
        assert stated[0] == pytest.approx(1e-4)
        assert (stated[1:] > 0.09 * way).all()
    every = slam_accuracy(found, truth).every
    assert every.nees_mean < 5
    (warning,) = found.warnings
    assert warning.startswith("SLAM: the robot moves before the first scan, whose pose is therefore as uncertain")
    assert "3 of 3 runs" in warning


def test_poses_leave_scans_before_t_0_out() -> None:
    dataset, _ = recorded()
    scans = dataset.scans.of("run-1")
    early = TrajectoryScans(np.concatenate([[-0.2], scans.times]), np.vstack([scans.ranges[:1], scans.ranges]))
    run = slam_dataset(with_scans(dataset, run_1=early), SlamOptions(), workers=1).trajectories[1]
    np.testing.assert_array_equal(run.pose_times, scans.times)


def test_a_corridor_is_named_with_its_direction_and_runs() -> None:
    dataset, _ = recorded("corridor", 2)
    (warning,) = slam_dataset(dataset, SlamOptions(), workers=1).warnings
    # The robot stands along the corridor, within some degrees; its start pose is turned by 0.5 rad, or 29 deg.
    said = r"SLAM: scans tell too little along (2[4-9]|3[0-4]) deg of the run's frame: 2 of 2 runs, e.g. run-0, run-1"
    assert re.fullmatch(said, warning)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_missing_and_empty_scans_name_the_run_whoever_found_it(workers: int) -> None:
    dataset, _ = recorded()
    scans = dataset.scans.of("run-1")
    ranges = scans.ranges.copy()
    ranges[2] = np.inf
    for changed, named in (
        (replace(dataset, scans=None), r"scans\.parquet"),
        (with_scans(dataset, run_2=None), "run-2 has no scans"),
        (with_scans(dataset, run_1=TrajectoryScans(scans.times, ranges)), "run-1: SLAM: the scan at .* is empty"),
    ):
        with pytest.raises(DataError, match=f"data set rooms: .*{named}"):
            slam_dataset(changed, SlamOptions(), workers=workers)


def test_the_accuracy_is_that_of_the_poses() -> None:
    _, truth = recorded()
    found = slam_accuracy(found_alone(), truth)
    assert found.runs == 3
    assert found.distance_m == pytest.approx(3 * 0.4, rel=0.1)
    assert found.final.poses == 3
    assert found.every.poses == sum(len(path.times) - 1 for path in truth.values())
    assert 0 < found.final.position_mean_m <= found.final.position_p95_m <= found.final.position_max_m < 0.004
    assert 0 < found.every.heading_mean_rad < found.every.heading_max_rad < 0.002
    assert 1 < found.every.nees_mean < 6


def test_growing_errors_are_drift_and_bias_in_the_robots_frame() -> None:
    dataset, truth = recorded()
    runs = []
    for run in dataset.trajectories:
        path = truth[run.id]
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path.poses[:, :2], axis=0).T))])
        left = path.poses[:, 2] + np.pi / 2
        poses = path.poses + 0.02 * way[:, None] * np.column_stack([np.cos(left), np.sin(left), 0.5 + 0 * left])
        runs.append(replace(run, pose_times=path.times, poses=poses))
    found = slam_accuracy(make_dataset("drifting", ROBOT, 0.01, runs), truth)
    assert found.drift_position == pytest.approx(0.02, rel=1e-6)
    assert found.drift_heading == pytest.approx(0.01, rel=1e-6)
    assert found.final.bias_left_m == pytest.approx(found.final.position_mean_m, rel=1e-6)
    assert found.final.bias_forward_m == pytest.approx(0, abs=1e-9)
    assert found.final.position_mean_m == pytest.approx(0.02 * found.distance_m / 3, rel=1e-6)
    assert found.every.nees_mean is None  # covariances are not known


def test_singular_covariances_of_a_foreign_data_set_are_left_out_of_the_nees() -> None:
    dataset, truth = recorded(runs=1)
    (run,) = dataset.trajectories
    path = truth[run.id]
    poses = path.poses + np.array([0.0, 0.002, 0.0])
    poses[0] = START
    flat = np.tile(np.diag([0.001, 0.001, 0.001]) ** 2, (len(poses), 1, 1))
    none = replace(run, pose_times=path.times, poses=poses, pose_covariances=0 * flat)
    assert slam_accuracy(replace(dataset, trajectories=(none,)), truth).every.nees_mean is None
    flat[4, 2, 2] = 0.0
    some = replace(none, pose_covariances=flat)
    found = slam_accuracy(replace(dataset, trajectories=(some,)), truth)
    assert found.every.nees_mean == pytest.approx(4.0)
    assert np.isnan(run_errors(some, path).nees).sum() == 1


def test_another_truth_is_one_line() -> None:
    dataset, truth = recorded()
    others = {name: path for name, path in truth.items() if name != "run-1"}
    with pytest.raises(DataError, match="trajectory run-1 is not in the truth"):
        slam_accuracy(dataset, others)


@pytest.fixture(scope="module")
def blind(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of scans and wheels, without poses."""
    return write_mcap(tmp_path_factory.mktemp("blind") / "drive", without_poses())


@pytest.fixture(scope="module")
def found(blind: Path) -> Dataset:
    return read(blind)


def test_without_poses_they_are_made_from_the_scans(found: Dataset) -> None:
    data = found
    assert "made from the scans by SLAM" in data.warnings[0]
    assert len(data.trajectories) == 2
    for run in data.trajectories:
        np.testing.assert_array_equal(run.poses[0], 0.0)
        assert run.pose_covariances is not None
    assert odometry_error(data) < 0.005  # m and rad; the true odometry agrees with SLAM


@pytest.mark.slow
def test_the_poses_are_the_same_whatever_the_format_of_the_recording(found: Dataset, tmp_path: Path) -> None:
    for own, other in zip(
        found.trajectories, read(write_rosbag1(tmp_path / "drive", without_poses())).trajectories, strict=True
    ):
        np.testing.assert_allclose(other.poses, own.poses, atol=1e-6)


def test_odometry_is_no_reference_where_scans_can_make_one(tmp_path: Path) -> None:
    odometry = [
        Sent(
            "/robot/odom",
            "nav_msgs/msg/Odometry",
            {"header": header(int(stamp)), "pose": {"pose": pose(place)}},
            int(stamp),
        )
        for stamp, place in zip(DRIVE.pose_stamps, DRIVE.poses * 1.1, strict=True)
        if stamp < EPOCH + SECONDS * 1e9
    ]
    data = read(write_mcap(tmp_path / "drive", without_poses([MOUNTED, *odometry])))
    assert "made from the scans by SLAM" in data.warnings[0]
    assert odometry_error(data) < 0.005


@pytest.mark.slow
def test_runs_are_cut_by_a_topic_without_poses_too(tmp_path: Path) -> None:
    words = [text(f"go{number}", EPOCH + int(begin * 1e9)) for number, begin in enumerate(DRIVE.begins[:2])]
    data = read(
        write_mcap(tmp_path / "drive", without_poses([MOUNTED, *words])), cut="topic", cut_topic="/robot/command"
    )
    assert [run.id for run in data.trajectories] == ["001-go0", "002-go1"]
    assert odometry_error(data) < 0.005


@pytest.mark.slow
def test_the_options_under_slam_are_those_of_slam(blind: Path, found: Dataset) -> None:
    other = read(blind, slam={"spacing": 0.3})
    assert not np.array_equal(other.trajectories[0].poses, found.trajectories[0].poses)


def test_wrong_options_of_slam_are_refused_before_the_recording_is_read(tmp_path: Path) -> None:
    (tmp_path / "empty.mcap").touch()
    for slam, named in (({"spacng": 0.3}, "slam: unknown key 'spacng'.*'spacing'"), (3, "slam")):
        with pytest.raises(ConfigError, match=named):
            read(tmp_path / "empty.mcap", slam=slam)
    with pytest.raises(ConfigError, match="'csv': unknown key 'slam'"):
        import_dataset("csv", tmp_path, {"slam": {}})


DATA = synthetic_dataset()


def moved(data: Dataset, by: tuple[float, float, float], turns: int = 0) -> Dataset:
    """Every pose but the first of each run moved, and the headings of all by whole turns."""
    whole = [0.0, 0.0, 2 * math.pi * turns]
    runs = [
        replace(run, poses=run.poses + np.where(run.pose_times[:, None] > 0, by, 0.0) + whole)
        for run in data.trajectories
    ]
    return replace(data, trajectories=tuple(runs))


def thinned(data: Dataset, kept: slice) -> Dataset:
    runs = [replace(run, pose_times=run.pose_times[kept], poses=run.poses[kept]) for run in data.trajectories]
    return replace(data, trajectories=tuple(runs))


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-9, 9), st.integers(-2, 2))
def test_a_shift_is_found_whatever_turns_headings_begin_with(x: float, y: float, turn: float, turns: int) -> None:
    found = distances(DATA, moved(DATA, (x, y, turn), turns))
    assert found.poses == sum(len(run.poses) - 1 for run in DATA.trajectories)
    assert found.position_mean_m == pytest.approx(math.hypot(x, y), abs=1e-9)
    assert found.position_p95_m == pytest.approx(math.hypot(x, y), abs=1e-9)
    assert found.heading_mean_rad == pytest.approx(abs(turn), abs=1e-9)
    assert found.heading_p95_rad == pytest.approx(abs(turn), abs=1e-9)


def test_the_sparser_reference_says_where_they_are_compared() -> None:
    sparse = moved(thinned(DATA, slice(None, None, 5)), (0.03, 0.04, 0.0))
    expected = sum(len(run.poses) - 1 for run in sparse.trajectories)
    for one, other in ((DATA, sparse), (sparse, DATA)):
        found = distances(one, other)
        assert found.poses == expected
        assert found.position_mean_m == pytest.approx(0.05)


def test_what_has_no_times_in_common_is_not_compared() -> None:
    assert distances(thinned(DATA, slice(0, 1)), DATA) is None
