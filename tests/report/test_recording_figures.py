"""What the figures of a recording show: which runs, where walls are, and how the wheels turned."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_samples import COMMANDS, NOISE, TICK, Sample, sample
from wheeled_samples import ROBOTS, driven

from omnibench.data.scans import Mount, Scanner, ScansInMemory, TrajectoryScans
from omnibench.report.figures import is_placed
from omnibench.report.recording.player import player
from omnibench.report.recording.recording_figures import (
    ODOMETRY_ITEM,
    all_runs,
    rate_step,
    representative_runs,
    scan_points,
    thinned,
    wheel_rates,
)
from omnibench.robot.kinematics import Robot, Wheel
from omnibench.robot.model import OdometryModel
from omnibench.slam.slam_request import run_errors


@pytest.fixture(scope="module")
def made() -> Sample:
    return sample()


def test_one_run_of_each_kind_of_motion_is_shown(made: Sample) -> None:
    chosen = representative_runs(made.dataset)
    assert [name.split(":")[0] for name in chosen] == ["straight", "turning left", "turning right", "on the spot"]
    assert [run.command for run in chosen.values()] == list(COMMANDS)


def test_of_each_kind_the_run_of_median_odometry_error_is_shown() -> None:
    runs = sample(repetitions=3, duration=1.0).dataset
    wrong = {"left-0": 0.5, "left-1": 0.3, "left-2": -0.4}  # m that the reference is moved by at the end
    moved = [
        replace(run, poses=run.poses + np.outer(run.pose_times == run.pose_times[-1], [wrong.get(run.id, 0), 0, 0]))
        for run in runs.trajectories
    ]
    chosen = representative_runs(replace(runs, trajectories=tuple(moved)))
    assert [run.id for name, run in chosen.items() if name.startswith("turning left")] == ["left-2"]


def test_runs_without_scans_are_not_shown_where_others_have_them(made: Sample) -> None:
    scans = made.dataset.scans
    assert scans is not None
    only = ScansInMemory(scans.scanner, {"left-1": scans.of("left-1")})
    assert [run.id for run in representative_runs(replace(made.dataset, scans=only)).values()] == ["left-1"]


@given(
    x=st.floats(-2, 2),
    y=st.floats(-5, 5),
    heading=st.floats(-0.5, 0.5),
    turn=st.floats(-0.3, 0.3),
    speed=st.floats(-0.5, 0.5),
    mount=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
)
def test_points_of_a_wall_lie_on_it_however_the_robot_moves(
    x: float, y: float, heading: float, turn: float, speed: float, mount: tuple[float, float, float]
) -> None:
    scanner = Scanner(
        rays=31,
        angle_min=-0.4,
        angle_increment=0.8 / 30,
        time_increment=0.02,
        range_max=1e3,
        mount=Mount(x=mount[0], y=mount[1], yaw=mount[2]),
    )
    begin, velocity = np.array([x, y, heading]), np.array([speed, -speed, turn])
    stamp, wall = 0.2, 10.0
    poses = begin + np.outer(stamp + scanner.delays, velocity)
    cosine, sine = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    place = poses[:, 0] + cosine * mount[0] - sine * mount[1]
    ranges = (wall - place) / np.cos(poses[:, 2] + mount[2] + scanner.angles)
    reference = np.array([begin, begin + velocity])
    run = replace(sample().dataset.trajectories[0], pose_times=np.array([0.0, 1.0]), poses=reference)
    scans = TrajectoryScans(np.array([stamp]), ranges[None].astype(np.float32))
    points = scan_points(run, scanner, scans, 0)
    assert len(points) == 31
    np.testing.assert_allclose(points[:, 0], wall, atol=1e-4)


def test_rays_that_saw_nothing_make_no_points(made: Sample) -> None:
    scans, run = made.dataset.scans, made.dataset.trajectories[0]
    assert scans is not None
    found = scans.of(run.id)
    ranges = found.ranges.copy()
    ranges[0, ::2] = np.inf
    assert len(scan_points(run, scans.scanner, TrajectoryScans(found.times, ranges), 0)) == 45


def test_thinning_keeps_points_far_apart_and_below_the_limit() -> None:
    points = np.random.default_rng(1).uniform(0, 1, (5000, 2))
    kept = thinned(points, 300)
    assert 150 < len(kept) <= 300
    assert {tuple(point) for point in kept} <= {tuple(point) for point in points}


def test_encoder_ticks_are_found_in_quantised_rates(made: Sample) -> None:
    assert rate_step(made.dataset.trajectories[0]) == pytest.approx(TICK)


def test_the_mean_over_100_ms_is_that_of_the_samples(made: Sample) -> None:
    run = made.dataset.trajectories[0]
    figure = wheel_rates(run, made.dataset.robot).figures[0].plot
    mean = next(trace for trace in figure.data if trace.legendgroup == "mean")
    np.testing.assert_allclose(mean.y[:5], run.rates[:50, 0].reshape(5, 10).mean(axis=1), atol=1e-4)
    np.testing.assert_allclose(mean.x[:5], 0.05 + 0.1 * np.arange(5), atol=1e-9)


def test_the_error_is_measured_minus_target(made: Sample) -> None:
    run = made.dataset.trajectories[0]
    slow = replace(run, rates=np.asarray(run.targets) - 0.25)
    _, error = wheel_rates(slow, made.dataset.robot).figures
    assert error.title == "Measured − target: mean −0.25, RMS 0.25 rad/s"
    assert all(np.allclose(trace.y, -0.25) for trace in error.plot.data)


def test_errors_do_not_depend_on_where_the_reference_has_its_origin(made: Sample) -> None:
    run = made.dataset.trajectories[2]
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = run.poses @ turn.T + [3.0, -1.0, math.pi / 2]
    narrow = np.tile(np.diag(NOISE**2 * [1, 9, 1]), (len(run.poses), 1, 1))
    here = run_errors(replace(run, pose_covariances=narrow), made.truth[run.id])
    there = run_errors(replace(run, poses=moved, pose_covariances=turn @ narrow @ turn.T), made.truth[run.id])
    np.testing.assert_allclose(there.position, here.position, atol=1e-12)
    np.testing.assert_allclose(there.nees, here.nees, rtol=1e-9)


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_measured_rates_and_steering_angles_have_a_row_each(robot: Robot) -> None:
    run = driven(robot, runs=1, samples=20).trajectories[0]
    plots = [figure.plot for figure in wheel_rates(run, robot).figures if not figure.title.startswith("Measured")]
    titles = [axis.title.text for plot in plots for axis in plot.select_yaxes()]
    assert titles == [f"{name} (rad/s)" for name in robot.wheel_names] + [f"{name} (°)" for name in robot.drive.steered]
    steering = [trace.y for plot in plots for trace in plot.data if trace.legendgroup == "steering"]
    if run.steering is not None:
        np.testing.assert_allclose(steering, np.degrees(run.steering.T), atol=0.01)


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_the_player_draws_every_wheel_where_it_stands_and_turns_those_that_steer(robot: Robot) -> None:
    dataset = driven(robot, runs=1, samples=20)
    run = dataset.trajectories[0]
    played = player(dataset, {"run": run}, OdometryModel.of_design(robot, "arc"), {}, {}).runs["run"]
    assert played["rated"] == robot.wheel_names
    assert [tuple(wheel["at"]) for wheel in played["wheels"]] == [wheel.position for wheel in robot.wheels]
    turned = [wheel["steered"] for wheel in played["wheels"] if wheel["steered"] is not None]
    assert turned == list(range(len(robot.drive.steered)))
    assert (played["steering"] is None) == (run.steering is None)
    assert run.steering is None or len(played["steering"]) == len(played["times"])


def test_a_mecanum_wheel_given_by_its_lever_arm_only_is_not_drawn(made: Sample) -> None:
    rollers = {"roller_angle_deg": 45}
    placed = Wheel.model_validate({"name": "a", "radius": 0.05, "x": 0.1, "y": 0.1} | rollers)
    lever = Wheel.model_validate({"name": "a", "radius": 0.05, "distance": 0.2, "angle_deg": 90} | rollers)
    assert [is_placed(wheel) for wheel in (placed, lever, *made.dataset.robot.wheels)] == [True, False, *[True] * 3]


def test_without_reference_poses_the_overview_shows_the_odometry(made: Sample) -> None:
    runs = tuple(
        replace(run, pose_times=run.pose_times[:1], poses=run.poses[:1], pose_covariances=None)
        for run in made.dataset.trajectories
    )
    drawn = all_runs(replace(made.dataset, trajectories=runs, scans=None), runs[0], ())
    assert drawn.legend[0] == ODOMETRY_ITEM
    assert np.ptp([x for x in drawn.figures[0].plot.data[0].x if x is not None]) > 0.5
