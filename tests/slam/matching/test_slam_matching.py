"""Scan matching: lines of walls, small_gicp on a planar map, deskewing, and errors that are carried along."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omnibench.data.scans import Ranges
from omnibench.data.true_poses import TruePath
from omnibench.robot.kinematics import Array, compose, relative
from omnibench.simulate.floor_plan import RoomPlan, make_plan
from omnibench.simulate.lidar import Lidar, measure_scans
from omnibench.slam import scan_matching
from omnibench.slam.motion_prior import MotionWithinScan
from omnibench.slam.slam_dataset import FLOOR, PoseErrors
from omnibench.slam.slam_options import SlamOptions

EXACT = Lidar(noise=0.0, far_noise=0.0, dropouts=0.0, resolution=1e-6)
SCANNER = Lidar().scanner
OPTIONS = SlamOptions()
metres, radians = st.floats(-0.12, 0.12), st.floats(-0.1, 0.1)


def ranges_at(place: Array, twist: Array | None = None, seed: int = 0, lidar: Lidar = EXACT) -> Ranges:
    """A scan from a pose of the furnished room's start frame, moving with a twist."""
    plan = make_plan(RoomPlan(plan="furnished_room"), "room")
    times = np.linspace(0.0, 0.025, 26)
    still = np.zeros(3) if twist is None else twist
    poses = np.array([compose(compose(plan.start, place), _along(still, time)) for time in times])
    return measure_scans(plan, lidar, TruePath(times, poses), np.zeros(1), np.random.default_rng(seed)).ranges[0]


def _along(twist: Array, time: float) -> Array:
    """The pose after a constant twist."""
    half = twist[2] * time / 2
    way = (twist[0] + 1j * twist[1]) * time * np.sinc(half / np.pi) * np.exp(1j * half)
    return np.array([way.real, way.imag, 2 * half])


def points_of(ranges: Ranges, twist: Array | None = None) -> scan_matching.ScanPoints:
    within = MotionWithinScan.steady(np.zeros(3) if twist is None else twist, float(SCANNER.delays[-1]))
    return scan_matching.scan_points(ranges, SCANNER, 1.0, within)


@cache
def room_map() -> scan_matching.ScanMap:
    surroundings = scan_matching.ScanMap(OPTIONS.spacing)
    surroundings.add(points_of(ranges_at(np.zeros(3))).lines, np.zeros(3), keyframe=0)
    return surroundings


def test_the_noise_of_a_map_of_one_scan_counts_as_much_as_that_of_the_scan_that_is_matched() -> None:
    """Both see every wall with as many rays; the gradient's covariance is the information for one of them alone."""
    pairs = scan_matching.Correspondences(room_map(), points_of(ranges_at(np.zeros(3))), np.zeros(3))
    np.testing.assert_allclose(np.diag(pairs.scatter()), 2 * np.diag(pairs.information()), rtol=0.1)


@given(x=metres, y=metres, heading=radians, seed=st.integers(0, 50), far=st.booleans())
def test_any_small_motion_is_found(x: float, y: float, heading: float, seed: int, far: bool) -> None:
    true = np.array([x, y, heading])
    scan = points_of(ranges_at(true))
    start = true + np.random.default_rng(seed).uniform(-1, 1, 3) * [0.1, 0.1, 0.05]
    if far:
        start = true + np.array([0.3, -0.25, 0.25])
    found = scan_matching.search(room_map(), scan, start, OPTIONS)
    np.testing.assert_allclose(found, true, atol=0.015)  # corners pull at small_gicp's pose
    match = scan_matching.refine(room_map(), scan, found, start, OPTIONS)
    np.testing.assert_allclose(match.pose, true, atol=1e-3)
    np.testing.assert_allclose(match.gain, np.eye(3), atol=1e-3)  # of the start nothing remains


def test_what_is_in_the_map_is_not_added_again() -> None:
    surroundings = scan_matching.ScanMap(OPTIONS.spacing)
    lines = points_of(ranges_at(np.zeros(3), lidar=Lidar())).lines
    assert surroundings.add(lines, np.zeros(3), keyframe=0) > 100
    again = points_of(ranges_at(np.zeros(3), seed=1, lidar=Lidar())).lines
    assert surroundings.add(again, np.zeros(3), keyframe=1) < 0.1 * len(surroundings)


def test_what_a_turned_robot_sees_behind_it_is_new() -> None:
    surroundings = scan_matching.ScanMap(OPTIONS.spacing)
    surroundings.add(points_of(ranges_at(np.zeros(3))).lines, np.zeros(3), keyframe=0)
    before, turned = len(surroundings), np.array([0.0, 0.0, np.pi])
    assert surroundings.add(points_of(ranges_at(turned)).lines, turned, keyframe=1) > 0.2 * before
    assert set(surroundings.surface.keyframe) == {0, 1}


def test_both_sides_of_a_thin_wall_are_kept_apart() -> None:
    surroundings = scan_matching.ScanMap(OPTIONS.spacing)
    scan = points_of(ranges_at(np.zeros(3)))
    surroundings.add(scan.lines, np.zeros(3), keyframe=0)
    behind = compose(np.zeros(3), np.array([0.0, 0.0, np.pi]))
    pairs = scan_matching.Correspondences(
        surroundings, scan, behind
    )  # surfaces that face away from the scanner are not matched
    assert pairs.matched < 0.3


@given(x=st.floats(-0.5, 0.5), y=st.floats(-0.5, 0.5), turn=st.floats(-1, 1), heading=st.floats(-np.pi, np.pi))
def test_a_scan_on_the_way_becomes_one_at_rest(x: float, y: float, turn: float, heading: float) -> None:
    twist, place = np.array([x, y, turn]), np.array([0.1, 0.2, heading])
    moving = points_of(ranges_at(place, twist), twist)
    surroundings = scan_matching.ScanMap(OPTIONS.spacing)
    surroundings.add(points_of(ranges_at(place)).lines, place, keyframe=0)
    match = scan_matching.refine(surroundings, moving, place, place, OPTIONS)
    # Corners cost half a millimetre; the motion within the scan, up to 7 mm and 1 deg, is gone.
    np.testing.assert_allclose(match.pose, place, atol=1e-3)


def test_a_twist_may_be_put_right_afterwards() -> None:
    twist, less = np.array([0.3, -0.2, 0.8]), np.array([0.25, -0.1, 0.7])
    ranges = ranges_at(np.zeros(3), twist)
    once, twice = points_of(ranges, twist), points_of(ranges, less).deskewed(twist - less)
    second_order = 0.1 * 0.8 * 0.01875**2
    np.testing.assert_allclose(twice.points, once.points, atol=second_order)
    np.testing.assert_allclose(twice.rays, once.rays, atol=second_order)


def test_noise_beyond_what_the_scanner_says_is_measured() -> None:
    scans = np.array([ranges_at(np.zeros(3), seed=seed, lidar=Lidar(noise=0.03)) for seed in range(5)])
    assert scan_matching.noise_factor(scans, SCANNER) == pytest.approx(3.0, rel=0.1)
    quiet = np.array([ranges_at(np.zeros(3), seed=seed, lidar=Lidar(noise=0.003)) for seed in range(5)])
    assert scan_matching.noise_factor(quiet, SCANNER) == 1.0
    assert scan_matching.noise_factor(np.full((2, 1080), np.inf, dtype=np.float32), SCANNER) == 1.0


class TestErrors:
    """A scan that tells nothing leaves the motion's error; one that tells all, the keyframe's."""

    @staticmethod
    def match(pose: Array, gain: float, noise: float = 0.0) -> scan_matching.Match:
        return match_at(pose, gain * np.eye(3), {0: np.eye(3)}, noise**2 * np.eye(3))

    def test_a_start_that_is_not_exact_hands_its_error_on_which_is_the_motions(self) -> None:
        start = np.array([0.5, -2.0, np.pi / 2])
        errors = PoseErrors(start, np.array([0.01, 0.0, 0.0]))  # along the robot's x, which is y of the run
        np.testing.assert_allclose(errors.covariance - FLOOR, np.diag([0.0, 0.01**2, 0.0]), atol=1e-15)
        errors.keep()
        told = errors.step(self.match(start, 1.0, 0.002), np.full(3, 0.1), np.zeros(3))
        np.testing.assert_allclose(told - FLOOR, np.diag([0.0, 0.01**2, 0.0]) + 0.002**2 * np.eye(3), atol=1e-15)
        further = errors.step(self.match(start, 0.0), np.array([0.02, 0.0, 0.0]), np.zeros(3))
        assert further[1, 1] - FLOOR[1, 1] == pytest.approx(0.03**2 + 0.002**2)

    @given(x=st.floats(-5, 5), y=st.floats(-5, 5), heading=st.floats(-4, 4))
    def test_a_robot_that_stands_in_the_dark_has_a_regular_covariance(self, x: float, y: float, heading: float) -> None:
        pose = np.array([x, y, heading])
        errors = PoseErrors(pose)
        errors.keep()
        for _ in range(3):
            covariance = errors.step(self.match(pose, 0.0), np.zeros(3), np.zeros(3))
        assert np.linalg.eigvalsh(covariance)[0] > 0.5e-10

    def test_the_oldest_keyframes_are_merged_into_the_next(self) -> None:
        errors, surroundings = PoseErrors(np.zeros(3)), scan_matching.ScanMap(OPTIONS.spacing)
        for keyframe, heading in enumerate((0.0, 2.0, 4.0)):
            pose = np.array([0.0, 0.0, heading])
            surroundings.add(points_of(ranges_at(pose)).lines, pose, keyframe)
            errors.keep()
        seen = surroundings.surface.keyframe
        errors.merge_oldest()
        surroundings.merge_oldest()
        assert errors.keyframes == 2
        np.testing.assert_array_equal(surroundings.surface.keyframe, np.where(seen == 2, 1, 0))

    @given(x=st.floats(-5, 5), y=st.floats(-5, 5), heading=st.floats(-4, 4))
    def test_a_keyframe_hands_its_error_on(self, x: float, y: float, heading: float) -> None:
        errors = PoseErrors(np.zeros(3))
        errors.keep()
        pose = np.array([x, y, heading])
        first = errors.step(self.match(pose, 1.0, 0.003), np.zeros(3), np.zeros(3))
        errors.keep()
        again = self.match(pose, 1.0)
        second = errors.step(
            scan_matching.Match(**{**again.__dict__, "by_keyframe": {1: np.eye(3)}}), np.zeros(3), np.zeros(3)
        )
        np.testing.assert_allclose(second, first, atol=1e-12)
        np.testing.assert_allclose(relative(pose, again.pose), np.zeros(3), atol=1e-12)


INCREMENT = np.radians(0.25)


def wall(distance: float, direction: float, rays: int, first: float) -> tuple[Array, Array]:
    """True ranges and angles of neighbouring rays to a wall whose nearest point lies along a direction."""
    angles = first + INCREMENT * np.arange(rays)
    return distance / np.cos(angles - direction), angles


def lines_of(ranges: Array, angles: Array, deviation: float = 0.01) -> scan_matching.Lines:
    points = ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    rays = np.arange(len(ranges))
    return scan_matching.fit_lines(points, np.full(len(ranges), deviation), 1e-5 * rays, rays)[0]


@given(
    distance=st.floats(0.5, 20), direction=st.floats(-np.pi, np.pi), rays=st.integers(40, 200), aside=st.floats(-0.7, 0)
)
def test_a_wall_without_noise_is_found_where_it_is(distance: float, direction: float, rays: int, aside: float) -> None:
    ranges, angles = wall(distance, direction, rays, direction + aside)
    found = lines_of(ranges, angles, deviation=0.001)
    normal = -np.array([np.cos(direction), np.sin(direction)])  # towards the scanner
    assert len(found.rays)
    np.testing.assert_allclose(found.normals, np.broadcast_to(normal, found.normals.shape), atol=1e-6)
    np.testing.assert_allclose(found.centres @ normal, -distance, rtol=1e-6)


@pytest.mark.parametrize("aside", [-1.0, -0.2, 0.6])
def test_stated_tilts_and_places_are_those_of_noisy_walls(aside: float) -> None:
    rng = np.random.default_rng(1)
    tilts, places = [], []
    for _ in range(400):
        ranges, angles = wall(2.0, 0.3, 64, 0.3 + aside)
        found = lines_of(ranges + 0.01 * rng.standard_normal(64), angles)
        if len(found.rays) != 1:
            continue
        (normal,) = found.normals
        tilt = np.arctan2(normal[1], normal[0]) - (0.3 - np.pi)
        tilts.append((tilt + np.pi) % (2 * np.pi) - np.pi)
        places.append(found.centres[0] @ [-np.cos(0.3), -np.sin(0.3)] + 2.0)
    assert len(tilts) > 350
    stated = np.sqrt(found.tilt_variances[0])
    assert abs(np.mean(tilts)) < 4 * stated / np.sqrt(len(tilts))  # not towards the scanner
    assert 0.85 < np.std(tilts) / stated < 1.15
    across = 0.01 * abs(np.cos(aside + 32 * INCREMENT)) / np.sqrt(64)
    assert abs(np.mean(places)) < 4 * across / np.sqrt(len(places))  # neither before nor behind the wall


@pytest.mark.parametrize("seed", range(5))
def test_no_line_bridges_a_corner(seed: int) -> None:
    plan = make_plan(RoomPlan(boundary=((-3, -2), (3, -2), (3, 2), (-3, 2)), start=(0, 0, 0)), "room")
    lidar = Lidar()
    track = TruePath(np.zeros(1), np.array([[1.0, 0.5, 0.2 + seed]]))
    (ranges,) = measure_scans(plan, lidar, track, np.zeros(1), np.random.default_rng(seed)).ranges
    seen = np.flatnonzero(np.isfinite(ranges))
    angles = lidar.scanner.angles[seen]
    found = lines_of(ranges[seen].astype(float), angles)
    heading = 0.2 + seed
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    normals = found.normals @ turn
    tilts = np.min(np.abs(np.angle(np.exp(4j * np.arctan2(normals[:, 1], normals[:, 0]))))[:, None] / 4, axis=1)
    assert (tilts < 5 * np.sqrt(found.tilt_variances)).all()
    assert found.rays.sum() > 0.9 * len(seen)


def test_a_scanner_that_turns_clockwise_finds_the_same_lines() -> None:
    ranges, angles = wall(2.0, 0.3, 60, 0.0)
    there, back = lines_of(ranges, angles), lines_of(ranges[::-1], angles[::-1])
    np.testing.assert_allclose(there.normals[0], back.normals[0], atol=1e-9)
    np.testing.assert_allclose(there.centres[0], back.centres[0], atol=1e-9)


def test_a_single_outlier_does_not_end_a_line() -> None:
    ranges, angles = wall(2.0, 0.0, 100, -0.2)
    ranges[40] = 1.0
    assert lines_of(ranges, angles).rays.max() > 90


def test_what_is_too_short_to_have_a_direction_is_no_line_and_no_error() -> None:
    for rays in (0, 1, 7, 8):  # 7 cm at 1 cm of noise
        assert len(lines_of(*wall(2.0, 0.0, rays, 0.0)).rays) == 0
    assert len(lines_of(*wall(2.0, 0.0, 8, 0.0), deviation=0.001).rays) == 1


NONE: Array = np.zeros((3, 3))


def match_at(
    pose: Array, gain: Array, by_keyframe: dict[int, Array], scatter: Array = NONE, delayed: Array = NONE
) -> scan_matching.Match:
    """A match with a gain (3, 3) and the information of each keyframe's surfaces (3, 3)."""
    information = sum(by_keyframe.values(), np.zeros((3, 3)))
    weight = gain @ np.linalg.pinv(information)
    return scan_matching.Match(
        pose, gain, np.ones(3), np.eye(3), weight, information, by_keyframe, scatter, delayed, 1.0
    )


def test_errors_of_the_motion_are_the_same_in_every_step_and_add_up() -> None:
    """With gain g and a motion's error s the pose errs by e = (1 - g)(e + s): the steps' variances do not just add."""
    errors = PoseErrors(np.zeros(3))
    errors.keep()
    gain, moved = 0.75, np.array([0.02, 0.0, 0.0])
    error = 0.0
    for step in range(1, 6):
        match = match_at(np.array([0.1 * step, 0.0, 0.0]), gain * np.eye(3), {0: np.eye(3)})
        found = errors.step(match, moved, np.zeros(3))
        error = (1 - gain) * (error + 0.02)
        assert found[0, 0] == pytest.approx(error**2 + FLOOR[0, 0], rel=1e-12)


def test_a_pose_that_its_keyframe_determines_errs_as_the_keyframe_does() -> None:
    """However often it is matched to it: the keyframe's error is considered, and never averaged away."""
    moved = np.array([0.03, 0.01, 0.0])
    errors = PoseErrors(np.zeros(3), moved)
    errors.keep()
    for step in range(1, 30):
        found = errors.step(match_at(np.array([0.1 * step, 0.2, 0.0]), np.eye(3), {0: np.eye(3)}), moved, 0 * moved)
    np.testing.assert_allclose(np.diag(found)[:2], moved[:2] ** 2 + np.diag(FLOOR)[:2], rtol=1e-12)


def test_two_keyframes_share_the_error_by_their_information() -> None:
    """Keyframe 0 is exact, keyframe 1 has the variance s^2: with three quarters of the information on it, 9/16 s^2."""
    moved, still = np.array([0.04, 0.0, 0.0]), np.zeros(3)
    errors = PoseErrors(np.zeros(3))
    errors.keep()
    errors.step(match_at(np.zeros(3), np.zeros((3, 3)), {0: np.eye(3)}), moved, still)
    errors.keep()
    found = errors.step(match_at(np.zeros(3), np.eye(3), {0: np.eye(3), 1: 3 * np.eye(3)}), still, still)
    assert found[0, 0] == pytest.approx(9 / 16 * 0.04**2 + FLOOR[0, 0], rel=1e-12)


def test_an_error_of_the_heading_swings_the_poses_that_follow() -> None:
    """A start that is wrong by a heading of s puts a pose 2 m ahead wrong by 2 s across, if no scan corrects it."""
    errors = PoseErrors(np.zeros(3), np.array([0.0, 0.0, 0.01]))
    found = errors.step(match_at(np.array([2.0, 0.0, 0.0]), NONE, {}), np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(found - FLOOR, 0.01**2 * np.outer([0, 2, 1], [0, 2, 1]), atol=1e-15)


class Drawn:
    """Poses (n, 3) of many runs whose errors are drawn, composed without linearisation."""

    def __init__(self, count: int) -> None:
        self.rng = np.random.default_rng(0)
        self.systematic = self.rng.standard_normal((count, 3))

    @staticmethod
    def composed(first: Array, second: Array) -> Array:
        way = (first[..., 0] + 1j * first[..., 1]) + (second[..., 0] + 1j * second[..., 1]) * np.exp(1j * first[..., 2])
        return np.stack([way.real, way.imag, first[..., 2] + second[..., 2]], axis=-1)

    @staticmethod
    def seen(first: Array, second: Array) -> Array:
        way = ((second - first)[0] + 1j * (second - first)[1]) * np.exp(-1j * first[2])
        return np.array([way.real, way.imag, second[2] - first[2]])

    def noise(self, covariance: Array) -> Array:
        return self.rng.multivariate_normal(np.zeros(3), covariance, len(self.systematic))


def test_the_stated_covariances_are_those_of_drawn_errors() -> None:
    """A winding path, three keyframes, gains that leave a direction to the odometry, noise of scans and of skew."""
    drawn = Drawn(40_000)
    true = np.array(
        [[0, 0, 0.3], [0.3, 0.2, 0.8], [0.4, 0.6, 1.5], [0.1, 0.9, 2.1], [-0.4, 0.7, 2.6], [-0.6, 0.2, 3.0]]
    )
    moved, skew = np.array([3e-3, 2e-3, 4e-3]), np.array([1e-3, 2e-3, 1e-3])
    surfaces = [np.diag([4.0, 1.0, 2.0]), np.array([[2.0, 0.5, 0.0], [0.5, 3.0, 0.2], [0.0, 0.2, 1.0]]), np.eye(3)]
    gains = [np.diag([0.9, 0.4, 0.8]), np.diag([0.2, 0.9, 0.7]), np.eye(3), np.diag([0.0, 0.8, 0.9]), np.eye(3)]
    scatter, delayed = 1e-5 * np.diag([1.0, 2.0, 0.5]), np.diag([0.3, 0.2, 0.1])

    errors = PoseErrors(true[0])
    errors.keep(skew)
    poses = np.tile(true[0], (len(drawn.systematic), 1))
    keyframes = [drawn.composed(poses, drawn.noise(np.diag(skew**2)))]
    for step, (here, gain) in enumerate(zip(true[1:], gains, strict=True), 1):
        parts = dict(enumerate(surfaces[: len(keyframes)]))
        match = match_at(here, gain, parts, scatter, delayed)
        found = errors.step(match, moved, skew) - FLOOR

        motion = drawn.seen(true[step - 1], here)
        start = drawn.composed(drawn.composed(poses, moved * drawn.systematic), motion)
        inverse = np.linalg.inv(match.information)
        turn = np.array([[np.cos(here[2]), -np.sin(here[2]), 0], [np.sin(here[2]), np.cos(here[2]), 0], [0, 0, 1]])
        skewed = delayed @ turn @ np.diag(skew)
        matched = here + drawn.noise(inverse @ (scatter + skewed @ skewed.T) @ inverse)
        for (number, part), places in zip(parts.items(), keyframes, strict=True):
            seen_there = drawn.composed(places, drawn.seen(true[(0, 2, 4)[number]], here))
            matched += (seen_there - here) @ (inverse @ part).T
        poses = start + (matched - start) @ gain.T
        scales = np.sqrt(np.diag(found))
        np.testing.assert_allclose(
            np.cov(poses.T) / np.outer(scales, scales), found / np.outer(scales, scales), atol=0.03
        )
        if step % 2 == 0:
            errors.keep()
            keyframes.append(poses)
