"""SLAM in rooms whose shape hides the heading, and with scans that cannot be those of the robot's motion."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from slam_study import ROBOT, Run, drive, flower_command

from omnibench.data.dataset import Trajectory, make_dataset
from omnibench.data.scans import Scanner, ScansInMemory, TrajectoryScans
from omnibench.data.true_poses import TruePath
from omnibench.robot.kinematics import Array
from omnibench.simulate.floor_plan import FloorPlan, RoomPlan, make_plan
from omnibench.simulate.lidar import Lidar, measure_scans
from omnibench.slam.map import ScanMap
from omnibench.slam.motion_prior import MotionWithinScan
from omnibench.slam.scan_matching import Correspondences, ScanPoints, scan_points
from omnibench.slam.slam_dataset import slam_dataset
from omnibench.slam.slam_options import SlamOptions
from omnibench.slam.slam_run import SlamPath, run_slam

LIDAR = Lidar()
LAST_POSE = SlamOptions(start="last_pose")
MM, DEGREE = 1e-3, np.radians(1.0)
DISAGREE = r"poses and odometry disagree by \d+ % of the motion: is the scanner mirrored, or is its mount or the robot"


@cache
def polygon(corners: int, radius: float = 3.0, stretch: float = 1.0, start: tuple[float, float] = (0, 0)) -> FloorPlan:
    """A regular polygon about the origin, stretched along x."""
    angles = 2 * np.pi * np.arange(corners) / corners
    boundary = tuple((float(stretch * radius * np.cos(at)), float(radius * np.sin(at))) for at in angles)
    return make_plan(RoomPlan(boundary=boundary, start=(*start, 0.0)), "room")


@cache
def furnished() -> FloorPlan:
    return make_plan(RoomPlan(plan="furnished_room"), "room")


@cache
def driven(plan: FloorPlan, number: int, lidar: Lidar = LIDAR) -> Run:
    return drive(plan, lidar, flower_command(number), np.random.default_rng([5, number]), distance=0.9)


def located(run: Run, options: SlamOptions | None = None, scanner: Scanner = LIDAR.scanner) -> SlamPath:
    return run_slam(run.scans, scanner, options or SlamOptions(), np.zeros(3), run.odometry)


def mirrored(run: Run) -> Run:
    return replace(run, scans=TrajectoryScans(run.scans.times, np.ascontiguousarray(run.scans.ranges[:, ::-1])))


def problems(path: SlamPath) -> list[str]:
    return [str(warning) for warning in path.warnings]


def since_start(headings: Array) -> Array:
    turned: Array = headings - headings[0]
    return turned


ROUND = [
    pytest.param(polygon(400), LIDAR, id="centre"),
    pytest.param(polygon(72), LIDAR, id="72_corners"),
    pytest.param(polygon(400, radius=1.5), LIDAR, id="small"),
    pytest.param(polygon(400, radius=8.0), LIDAR, id="large"),
    pytest.param(polygon(400), Lidar(noise=0.002, far_noise=0.002), id="precise"),
    pytest.param(polygon(400), Lidar(rays=361), id="few_rays"),
]


class TestRoundRoom:
    """It tells where the robot is, but not how it is turned."""

    @pytest.mark.parametrize(("plan", "lidar"), ROUND)
    def test_the_heading_stays_that_of_the_odometry(self, plan: FloorPlan, lidar: Lidar) -> None:
        for number in (0, 2):  # whose odometry ends 6 deg off
            run = driven(plan, number, lidar)
            turned = since_start(located(run, scanner=lidar.scanner).poses[:, 2])
            wrong = since_start(run.odometry(run.scans.times)[:, 2])
            assert np.abs(wrong - run.true[:, 2])[-1] > 5 * DEGREE
            assert np.abs(turned - wrong).max() < 0.6 * DEGREE

    @pytest.mark.parametrize(("plan", "lidar"), ROUND)
    def test_its_covariance_holds_the_error(self, plan: FloorPlan, lidar: Lidar) -> None:
        run = driven(plan, 2, lidar)
        path = located(run, scanner=lidar.scanner)
        stated = np.sqrt(path.covariances[1:, 2, 2])
        assert (np.abs(path.poses - run.true)[1:, 2] < 2 * stated).all()
        assert stated[-1] > 5 * DEGREE

    @pytest.mark.parametrize(("plan", "lidar"), ROUND)
    def test_it_is_said(self, plan: FloorPlan, lidar: Lidar) -> None:
        path = located(driven(plan, 1, lidar), scanner=lidar.scanner)
        assert problems(path) == ["scans tell too little of the heading"]

    def test_off_its_centre_the_heading_is_no_worse_than_the_odometrys(self) -> None:
        for number in range(3):  # its way about the centre tells of the heading, too
            run = driven(polygon(400, start=(1.0, 0.5)), number)
            path = located(run)
            wrong = since_start(run.odometry(run.scans.times)[:, 2]) - run.true[:, 2]
            assert np.abs(path.poses - run.true)[-1, 2] < abs(wrong[-1]) + 0.6 * DEGREE
            assert np.sqrt(path.covariances[-1, 2, 2]) > 5 * DEGREE
            assert problems(path) == ["scans tell too little of the heading"]

    def test_where_the_robot_is_in_it_stays_known(self) -> None:
        run = driven(polygon(400), 1)  # straight, and its odometry keeps the heading
        found = (located(run).poses - run.true)[:, :2]
        assert np.hypot(*found.T).max() < 5 * MM


class TestNearlyRoundRoom:
    @pytest.mark.parametrize(
        "plan", [polygon(8), polygon(400, stretch=1.2), polygon(400, stretch=2.0)], ids=["octagon", "oval", "ellipse"]
    )
    def test_the_heading_is_told_by_its_shape(self, plan: FloorPlan) -> None:
        for number in range(3):
            run = driven(plan, number)
            path = located(run)
            assert np.abs(path.poses - run.true)[-1, 2] < 0.2 * DEGREE
            assert path.covariances[-1, 2, 2] < (0.2 * DEGREE) ** 2
            assert path.warnings == ()


def scan_of(plan: FloorPlan, seed: int) -> ScanPoints:
    """A noisy scan from the room's start."""
    track = TruePath(np.linspace(0.0, 0.025, 2), np.tile(plan.start, (2, 1)))
    ranges = measure_scans(plan, LIDAR, track, np.zeros(1), np.random.default_rng(seed)).ranges[0]
    return scan_points(ranges, LIDAR.scanner, 1.0, MotionWithinScan.steady(np.zeros(3), 0.025))


@cache
def pairs_at_start(plan: FloorPlan) -> Correspondences:
    """A scan on the map of another."""
    surroundings = ScanMap(SlamOptions().spacing)
    surroundings.add(scan_of(plan, 0).lines, np.zeros(3), keyframe=0)
    return Correspondences(surroundings, scan_of(plan, 1), np.zeros(3))


class TestRise:
    """What slopes promise, tried out some way along a direction."""

    @given(st.floats(0, 2 * np.pi), st.floats(0.03, 0.1), st.floats(0.02, 0.05), st.integers(100, 1000))
    def test_a_room_with_corners_keeps_the_promise(self, way: float, far: float, turned: float, most: int) -> None:
        step = np.array([far * np.cos(way), far * np.sin(way), turned])
        assert 0.9 < pairs_at_start(furnished()).rise(step, most) < 1.1

    @given(st.floats(0.03, 0.06), st.integers(150, 1000))
    def test_a_round_room_breaks_it_for_turns(self, turned: float, most: int) -> None:
        assert abs(pairs_at_start(polygon(400)).rise(np.array([0.0, 0.0, turned]), most)) < 0.5

    @given(st.floats(0, 2 * np.pi), st.floats(0.03, 0.1))
    def test_a_round_room_keeps_it_for_ways(self, way: float, far: float) -> None:
        step = np.array([far * np.cos(way), far * np.sin(way), 0.0])
        assert pairs_at_start(polygon(400)).rise(step, 200) > 0.9


class TestDisagreementWithTheOdometry:
    @pytest.mark.parametrize("options", [SlamOptions(), LAST_POSE], ids=["odometry", "last_pose"])
    @pytest.mark.parametrize("number", [0, 1, 3])
    def test_of_a_mirrored_scanner_is_said(self, number: int, options: SlamOptions) -> None:
        (problem,) = problems(located(mirrored(driven(furnished(), number)), options))
        assert re.match(DISAGREE, problem)

    def test_of_a_scanner_mounted_backwards_is_said(self) -> None:
        scanner = LIDAR.scanner
        turned = scanner.model_copy(update={"mount": scanner.mount.model_copy(update={"yaw": np.pi})})
        (problem,) = problems(located(driven(furnished(), 1), scanner=turned))
        assert re.match(DISAGREE, problem)

    def test_of_wheels_that_stood_still_is_said_as_what_it_is_at_most(self) -> None:
        run = driven(furnished(), 1)
        path = run_slam(run.scans, LIDAR.scanner, SlamOptions(), np.zeros(3), lambda times: np.zeros((len(times), 3)))
        (problem,) = problems(path)
        assert "disagree by 1000 % of the motion" in problem

    @pytest.mark.parametrize("scale", [0.8, 1.25])
    @pytest.mark.parametrize("options", [SlamOptions(), LAST_POSE], ids=["odometry", "last_pose"])
    def test_within_what_wheels_may_be_wrong_by_is_not_said(self, options: SlamOptions, scale: float) -> None:
        for number in range(3):
            run = driven(furnished(), number)

            def odometry(times: Array, run: Run = run) -> Array:
                return run.odometry(times) * np.array([scale, scale, 1.0])

            assert run_slam(run.scans, LIDAR.scanner, options, np.zeros(3), odometry).warnings == ()

    def test_along_what_scans_do_not_tell_is_not_said(self) -> None:
        run = driven(make_plan(RoomPlan(plan="corridor"), "room"), 0)
        (problem,) = problems(located(run, LAST_POSE))
        assert problem.startswith("scans tell too little along")

    def test_of_many_runs_is_one_sentence_with_its_mean(self) -> None:
        shares, trajectories, scans = [], [], {}
        for number in (0, 1, 3):
            run = mirrored(driven(furnished(), number))
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
