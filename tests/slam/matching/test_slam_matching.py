"""Scan matching: small_gicp on a planar map, deskewing, and errors that are carried along."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import small_gicp
from hypothesis import given
from hypothesis import strategies as st

from omnibench.data.scans import Ranges
from omnibench.data.true_poses import TruePath
from omnibench.robot.kinematics import Array, compose, relative
from omnibench.simulate.floor_plan import RoomPlan, make_plan
from omnibench.simulate.lidar import Lidar, measure_scans
from omnibench.slam.map import ScanMap
from omnibench.slam.motion_prior import MotionWithinScan
from omnibench.slam.pose_errors import FLOOR, PoseErrors
from omnibench.slam.scan_matching import Correspondences, Match, ScanPoints, noise_factor, refine, scan_points, search
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


def points_of(ranges: Ranges, twist: Array | None = None) -> ScanPoints:
    within = MotionWithinScan.steady(np.zeros(3) if twist is None else twist, float(SCANNER.delays[-1]))
    return scan_points(ranges, SCANNER, 1.0, within)


@cache
def room_map() -> ScanMap:
    surroundings = ScanMap(OPTIONS.spacing)
    surroundings.add(points_of(ranges_at(np.zeros(3))).lines, np.zeros(3), keyframe=0)
    return surroundings


def test_the_noise_of_a_map_of_one_scan_counts_as_much_as_that_of_the_scan_that_is_matched() -> None:
    """Both see every wall with as many rays; the gradient's covariance is the information for one of them alone."""
    pairs = Correspondences(room_map(), points_of(ranges_at(np.zeros(3))), np.zeros(3))
    np.testing.assert_allclose(np.diag(pairs.scatter()), 2 * np.diag(pairs.information()), rtol=0.1)


class TestSmallGicp:
    def test_a_planar_cloud_alone_would_keep_it_where_it_began(self) -> None:
        """Why the map is made of crosses; when this fails, small_gicp has learnt to do without."""
        points = points_of(ranges_at(np.zeros(3))).points
        flat = small_gicp.PointCloud(np.column_stack([points, np.zeros(len(points))]))
        tree = small_gicp.KdTree(flat)
        small_gicp.estimate_normals(flat, tree, 10)
        moved = small_gicp.PointCloud(np.column_stack([points + np.array([0.05, 0.0]), np.zeros(len(points))]))
        found = small_gicp.align(flat, moved, tree, registration_type="PLANE_ICP")
        np.testing.assert_allclose(found.T_target_source, np.eye(4), atol=1e-9)
        assert found.converged

    @given(x=metres, y=metres, heading=radians, seed=st.integers(0, 50))
    def test_any_small_motion_is_found_from_anywhere_near(self, x: float, y: float, heading: float, seed: int) -> None:
        true = np.array([x, y, heading])
        scan = points_of(ranges_at(true))
        start = true + np.random.default_rng(seed).uniform(-1, 1, 3) * [0.1, 0.1, 0.05]
        found = search(room_map(), scan, start, OPTIONS)
        np.testing.assert_allclose(found, true, atol=0.01)  # corners pull at small_gicp's pose
        match = refine(room_map(), scan, found, start, OPTIONS)
        np.testing.assert_allclose(match.pose, true, atol=1e-3)
        np.testing.assert_allclose(match.gain, np.eye(3), atol=1e-3)  # of the start nothing remains

    def test_a_start_that_is_far_off_is_put_right(self) -> None:
        true = np.array([0.1, -0.1, 0.05])
        scan = points_of(ranges_at(true))
        found = search(room_map(), scan, true + np.array([0.3, -0.25, 0.25]), OPTIONS)
        np.testing.assert_allclose(found, true, atol=0.01)


class TestMap:
    def test_what_is_there_is_not_added_again(self) -> None:
        surroundings = ScanMap(OPTIONS.spacing)
        lines = points_of(ranges_at(np.zeros(3), lidar=Lidar())).lines
        assert surroundings.add(lines, np.zeros(3), keyframe=0) > 100
        again = points_of(ranges_at(np.zeros(3), seed=1, lidar=Lidar())).lines
        assert surroundings.add(again, np.zeros(3), keyframe=1) < 0.1 * len(surroundings)

    def test_what_a_turned_robot_sees_behind_it_is_new(self) -> None:
        surroundings = ScanMap(OPTIONS.spacing)
        surroundings.add(points_of(ranges_at(np.zeros(3))).lines, np.zeros(3), keyframe=0)
        before, turned = len(surroundings), np.array([0.0, 0.0, np.pi])
        assert surroundings.add(points_of(ranges_at(turned)).lines, turned, keyframe=1) > 0.2 * before
        assert set(surroundings.surface.keyframe) == {0, 1}

    def test_both_sides_of_a_thin_wall_are_kept_apart(self) -> None:
        surroundings = ScanMap(OPTIONS.spacing)
        scan = points_of(ranges_at(np.zeros(3)))
        surroundings.add(scan.lines, np.zeros(3), keyframe=0)
        behind = compose(np.zeros(3), np.array([0.0, 0.0, np.pi]))
        pairs = Correspondences(surroundings, scan, behind)  # surfaces that face away from the scanner are not matched
        assert pairs.matched < 0.3


class TestDeskewing:
    @given(x=st.floats(-0.5, 0.5), y=st.floats(-0.5, 0.5), turn=st.floats(-1, 1), heading=st.floats(-np.pi, np.pi))
    def test_a_scan_on_the_way_becomes_that_of_a_robot_at_rest(
        self, x: float, y: float, turn: float, heading: float
    ) -> None:
        twist, place = np.array([x, y, turn]), np.array([0.1, 0.2, heading])
        moving = points_of(ranges_at(place, twist), twist)
        surroundings = ScanMap(OPTIONS.spacing)
        surroundings.add(points_of(ranges_at(place)).lines, place, keyframe=0)
        match = refine(surroundings, moving, place, place, OPTIONS)
        # Corners cost half a millimetre; the motion within the scan, up to 7 mm and 1 deg, is gone.
        np.testing.assert_allclose(match.pose, place, atol=1e-3)

    def test_a_twist_may_be_put_right_afterwards(self) -> None:
        twist, less = np.array([0.3, -0.2, 0.8]), np.array([0.25, -0.1, 0.7])
        ranges = ranges_at(np.zeros(3), twist)
        once, twice = points_of(ranges, twist), points_of(ranges, less).deskewed(twist - less)
        second_order = 0.1 * 0.8 * 0.01875**2
        np.testing.assert_allclose(twice.points, once.points, atol=second_order)
        np.testing.assert_allclose(twice.rays, once.rays, atol=second_order)


def test_noise_beyond_what_the_scanner_says_is_measured() -> None:
    scans = np.array([ranges_at(np.zeros(3), seed=seed, lidar=Lidar(noise=0.03)) for seed in range(5)])
    assert noise_factor(scans, SCANNER) == pytest.approx(3.0, rel=0.1)
    quiet = np.array([ranges_at(np.zeros(3), seed=seed, lidar=Lidar(noise=0.003)) for seed in range(5)])
    assert noise_factor(quiet, SCANNER) == 1.0
    assert noise_factor(np.full((2, 1080), np.inf, dtype=np.float32), SCANNER) == 1.0


class TestErrors:
    """A scan that tells nothing leaves the motion's error; one that tells all, the keyframe's."""

    @staticmethod
    def match(pose: Array, gain: float, noise: float = 0.0) -> Match:
        information = np.eye(3)
        return Match(
            pose, gain * np.eye(3), np.full(3, gain), np.eye(3), gain * np.eye(3), information,
            {0: information}, noise**2 * np.eye(3), np.zeros((3, 3)), 1.0,
        )  # fmt: skip

    def test_untold_poses_are_as_wrong_as_the_motion_which_adds_up(self) -> None:
        errors = PoseErrors(np.zeros(3))
        errors.keep()
        for number in range(1, 5):
            pose = np.array([0.1 * number, 0.0, 0.0])
            covariance = errors.step(self.match(pose, 0.0), np.array([0.01, 0.005, 0.0]), np.zeros(3))
        np.testing.assert_allclose(np.diag(covariance - FLOOR), [0.04**2, 0.02**2, 0.0], atol=1e-15)

    def test_an_error_of_heading_swings_the_poses_that_follow(self) -> None:
        errors = PoseErrors(np.zeros(3))
        errors.keep()
        errors.step(self.match(np.zeros(3), 0.0), np.array([0.0, 0.0, 0.01]), np.zeros(3))
        covariance = errors.step(self.match(np.array([2.0, 0.0, 0.0]), 0.0), np.zeros(3), np.zeros(3))
        np.testing.assert_allclose(np.diag(covariance - FLOOR), [0.0, 0.02**2, 0.01**2], atol=1e-15)

    def test_a_match_to_an_exact_keyframe_has_the_noise_of_the_scans_alone(self) -> None:
        errors = PoseErrors(np.zeros(3))
        errors.keep()
        errors.step(self.match(np.ones(3), 0.0), np.full(3, 0.1), np.zeros(3))
        covariance = errors.step(self.match(np.array([1.0, 2.0, 0.3]), 1.0, 0.002), np.full(3, 0.1), np.zeros(3))
        np.testing.assert_allclose(covariance - FLOOR, 0.002**2 * np.eye(3), atol=1e-15)

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
    def test_even_a_robot_that_stands_in_the_dark_has_a_regular_covariance(
        self, x: float, y: float, heading: float
    ) -> None:
        pose = np.array([x, y, heading])
        errors = PoseErrors(pose)
        errors.keep()
        for _ in range(3):
            covariance = errors.step(self.match(pose, 0.0), np.zeros(3), np.zeros(3))
        assert np.linalg.eigvalsh(covariance)[0] > 0.5e-10

    def test_the_oldest_keyframes_are_merged_into_the_next(self) -> None:
        errors, surroundings = PoseErrors(np.zeros(3)), ScanMap(OPTIONS.spacing)
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
        second = errors.step(Match(**{**again.__dict__, "by_keyframe": {1: np.eye(3)}}), np.zeros(3), np.zeros(3))
        np.testing.assert_allclose(second, first, atol=1e-12)
        np.testing.assert_allclose(relative(pose, again.pose), np.zeros(3), atol=1e-12)
