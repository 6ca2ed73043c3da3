"""Calibrators of plugins/: published methods, optimisers, and the model that discover finds."""

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import published_methods
import pytest
from discovery_samples import named, nothing, simulated
from hypothesis import given, settings
from hypothesis import strategies as st
from published_methods import of_kind
from real_recordings import diff, mean_errors, omni3, omni4, tricyc

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.errors import ConfigError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.fit.evaluate import evaluate
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.fit.problem import Budget, CalibrationProblem
from omnibench.progress import Progress
from omnibench.registry import calibrators
from omnibench.robot.calibration import read_calibration, write_calibration
from omnibench.robot.kinematics import Array, Mount, Robot, Wheel
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryBatch
from omnibench.testing import (
    CalibratorConformance,
    run_cases,
    synthetic_problem,
    synthetic_robot,
    synthetic_trajectories,
)
from omnibench.testing.synthetic import synthetic_robots

ROBOTS = {robot.name.removeprefix("synthetic "): robot for robot in synthetic_robots()}
PLUGINS = (
    *("optiodom", "kallasi", "lin", "maddahi", "censi", "ivanjko", "jung_chung", "umbmark"),
    *("cmaes", "differential_evolution", "discovered"),
)
FITTED = ("omni", "mecanum", "differential", "tricycle")


@pytest.mark.parametrize(
    ("name", "solved"),
    [
        ("optiodom", 0.2),
        ("kallasi", 0.5),  # the wheel's true distance from the axle is not the designed one, which it cannot see
        ("lin", 0.02),
        ("maddahi", 0.6),
        *((name, 1e-9) for name in ("censi", "ivanjko")),
        ("jung_chung", 0.4),
        ("umbmark", 0.2),
        pytest.param("cmaes", 1e-7, marks=pytest.mark.slow),
        ("differential_evolution", 1e-7),
    ],
)
def test_a_plugin_keeps_the_contract_of_calibrators(name: str, solved: float) -> None:
    results = run_cases(type("Suite", (CalibratorConformance,), {"name": name, "solved": solved})())
    assert [result for result in results if not result.passed] == []


def module() -> Any:
    return sys.modules[type(calibrators.create("optiodom")).__module__]


def driven(
    robot: Robot, matrix: Array, integration: Integration = "arc", every: bool = False
) -> tuple[Trajectory, ...]:
    """The synthetic recordings of a robot whose matrix (3, M) is another one; every: with a pose at every sample."""
    model, runs = OdometryModel(robot, matrix, integration), synthetic_trajectories(robot, integration)
    if every:
        runs = tuple(replace(run, pose_times=np.append(0.0, run.times)) for run in runs)
    return tuple(
        replace(run, poses=model.poses([replace(run.log(run.pose_times), start=run.start)])[0]) for run in runs
    )


def fit(calibrator: str, robot: Robot, runs: Sequence[Trajectory], seconds: float = 600.0, **options: Any) -> RunResult:
    return solved(calibrator, synthetic_problem(robot=robot, trajectories=runs, seconds=seconds), **options)


@settings(max_examples=3, deadline=None)
@given(st.lists(st.floats(-0.03, 0.03), min_size=5, max_size=5))
@pytest.mark.parametrize("name", FITTED)
def test_length_diameters_and_offset_are_found_to_some_of_the_smallest_steps(name: str, shares: list[float]) -> None:
    geometry = module().Geometry.of(ROBOTS[name])
    change = np.array(shares[: len(geometry.start)])
    truth = np.where(geometry.start == 0, change, geometry.start * (1 + change))
    runs = driven(ROBOTS[name], geometry.matrix(truth)[0], every=True)[::2]
    result = fit("optiodom", ROBOTS[name], runs)
    before, after = mean_errors(geometry.design, runs)[0], mean_errors(result.matrix, runs)[0]
    assert after < 0.002 + 0.1 * before  # the steps of a tricycle are 0.1 mm and 1 mrad at least


@pytest.mark.parametrize("integration", ["arc", "euler"])
@pytest.mark.parametrize("name", FITTED)
def test_derivatives_are_those_of_finite_differences(name: str, integration: Integration) -> None:
    robot = ROBOTS[name].model_copy(update={"mount": Mount(x=0.1, y=-0.05, yaw=0.3)})
    geometry = module().Geometry.of(robot)
    runs = driven(robot, 1.03 * geometry.design, integration, every=True)
    segments = module().Segments(runs, geometry.design, 0.4, integration)
    at = geometry.start + 1e-3

    def cost(parameters: Array) -> float:
        return segments.cost(geometry.matrix(parameters)[0])[0]

    matrix, slopes = geometry.matrix(at)
    derivatives = np.tensordot(slopes, segments.cost(matrix)[1], 2)
    steps = 1e-6 * np.eye(len(at))
    assert derivatives == pytest.approx([(cost(at + s) - cost(at - s)) / 2e-6 for s in steps], rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("integration", ["arc", "euler"])
def test_the_objective_is_that_of_the_odometry_that_judges_it(integration: Integration) -> None:
    robot = ROBOTS["tricycle"]
    matrix = robot.inverse_kinematic_matrix
    runs = driven(robot, 1.03 * matrix, integration, every=True)
    segments = module().Segments(runs, matrix, 0.0, integration)  # a segment ends at every pose
    batch = OdometryBatch([run.reference_log for run in runs], integration)
    off = (batch.poses(matrix[None])[0] - np.concatenate([run.poses[1:] for run in runs]))[:, :2]
    assert segments.cost(matrix)[0] == pytest.approx((off**2).sum(), rel=1e-9)
    assert segments.cost(1.03 * matrix)[0] == pytest.approx(0.0, abs=1e-18)


def test_the_length_of_each_robot_is_the_authors() -> None:
    lengths = {name: module().Geometry.of(ROBOTS[name]).start[0] for name in FITTED}
    assert lengths == pytest.approx({"omni": 0.195, "mecanum": 0.45, "differential": 0.4, "tricycle": 0.5})


def test_the_parameters_are_reported() -> None:
    reason = fit("optiodom", ROBOTS["tricycle"], synthetic_trajectories(ROBOTS["tricycle"])).reason
    assert reason.startswith("at rest after ")
    assert all(word in reason for word in ("mm rms: length 5", "diameters front 16", "steering offset "))


@pytest.mark.parametrize(("limit", "words"), [({"seconds": 1e-9}, "time budget"), ({"steps": 7}, "not at rest")])
def test_a_search_that_is_cut_short_does_not_claim_to_have_converged(limit: dict[str, Any], words: str) -> None:
    result = fit("optiodom", ROBOTS["differential"], synthetic_trajectories(ROBOTS["differential"]), **limit)
    assert (result.outcome, words in result.reason) == (Outcome.BUDGET, True)


@pytest.mark.parametrize(
    ("calibrator", "dataset", "circles", "squares"),
    [
        ("optiodom", diff, (0.0130, 1.77), (0.0346, 2.36)),
        # The search rests before the minimum, where details of the odometry count (module's docstring).
        pytest.param("optiodom", tricyc, (0.0398, 4.80), (0.0821, 3.39), marks=pytest.mark.slow),
        # The authors' step turns an exact arc by another half angle, which the odometry here does not.
        pytest.param("optiodom", omni3, (0.0621, 4.50), (0.1487, 7.43), marks=pytest.mark.slow),
        ("kallasi", tricyc, (0.0481, 3.33), (0.0880, 2.93)),
        ("lin", omni3, (0.0515, 3.67), (0.1070, 5.31)),
        # 24 of the authors' 68 runs, whose figures are .0507 m and 4.97 deg; the design has .154 m and 17.5 deg.
        pytest.param("lin", omni4, (0.0357, 3.30), None, marks=pytest.mark.slow),
    ],
)
def test_the_figures_of_the_authors_of_optiodom_are_reached(
    calibrator: str, dataset: Callable[[], Dataset], circles: tuple[float, float], squares: tuple[float, float] | None
) -> None:
    data = dataset()
    matrix = fit(calibrator, data.robot, of_kind(data, "circular")).matrix
    rests_early = calibrator == "optiodom" and dataset is not diff
    assert mean_errors(matrix, of_kind(data, "circular")) == pytest.approx(circles, rel=0.07 if rests_early else 0.02)
    if squares is not None:
        assert mean_errors(matrix, of_kind(data, "square")) == pytest.approx(squares, rel=0.02)


@pytest.mark.parametrize(
    ("calibrator", "robots", "named"),
    [
        ("optiodom", FITTED, "differential drives, tricycles"),
        ("kallasi", ("tricycle",), "tricycles"),
        ("lin", ("omni", "mecanum"), "omni robots with three wheels and mecanum bases"),
    ],
)
def test_other_robots_are_refused(calibrator: str, robots: tuple[str, ...], named: str) -> None:
    for name in ROBOTS.keys() - robots:
        result = fit(calibrator, ROBOTS[name], synthetic_trajectories(ROBOTS[name]))
        assert result.outcome is Outcome.NOT_APPLICABLE
        assert named in result.reason


@pytest.mark.parametrize(
    ("calibrator", "name", "named"),
    [
        ("optiodom", "differential", "paths that turn"),
        ("kallasi", "tricycle", "paths that turn"),
        ("lin", "omni", "ahead, aside and turn"),
    ],
)
def test_straight_lines_are_refused(calibrator: str, name: str, named: str) -> None:
    straight = [run for run in synthetic_trajectories(ROBOTS[name]) if abs(run.poses[-1, 2]) < 0.2]
    result = fit(calibrator, ROBOTS[name], [replace(run, poses=run.poses * [1, 1, 0]) for run in straight])
    assert (result.outcome, named in result.reason) == (Outcome.NOT_APPLICABLE, True)


def tricycle(mount: Mount | None = None) -> Robot:
    return ROBOTS["tricycle"].model_copy(update={"mount": mount})


def turned(robot: Robot, share: float, offset: float) -> tuple[tuple[Trajectory, ...], Array]:
    """The synthetic recordings with another radius and a steering offset, rad, and the matrix (3, 2) that they have."""
    cosine, sine = math.cos(offset), math.sin(offset)
    matrix = share * robot.inverse_kinematic_matrix @ np.array([[cosine, -sine], [sine, cosine]])
    return driven(robot, matrix), matrix


@settings(max_examples=10, deadline=None)
@given(st.floats(0.9, 1.1), st.floats(-0.1, 0.1), st.sampled_from([None, Mount(x=0.3, y=-0.1, yaw=0.2)]))
def test_scale_and_offset_are_found(share: float, offset: float, mount: Mount | None) -> None:
    robot = tricycle(mount)
    runs, truth = turned(robot, share, offset)
    assert fit("kallasi", robot, runs).matrix == pytest.approx(truth, rel=1e-8, abs=1e-10)


def test_they_are_reported() -> None:
    runs, _ = turned(tricycle(), 1.05, math.radians(2))
    reason = fit("kallasi", tricycle(), runs).reason
    assert "+2.000 deg" in reason
    assert "0.08400 m per rad (1.0500 of the design)" in reason


@settings(max_examples=10, deadline=None)
@given(st.lists(st.floats(0.93, 1.07), min_size=6, max_size=6))
def test_wheel_factors_and_any_third_row_are_found(shares: list[float]) -> None:
    robot = synthetic_robot()
    truth = robot.inverse_kinematic_matrix * np.array([shares[:3], shares[:3], shares[3:]])
    matrix = fit("lin", robot, driven(robot, truth)).matrix
    assert matrix[2] == pytest.approx(truth[2], rel=1e-9)
    assert matrix[:2] == pytest.approx(truth[:2], rel=5e-4, abs=1e-9)  # chords are shorter than arcs


@pytest.mark.parametrize("shares", [[1.02, 0.98, 1.01, 0.99], [0.95, 0.95, 0.95, 0.95]])
def test_four_mecanum_wheels_keep_the_design_where_no_path_drives_them(shares: list[float]) -> None:
    robot = synthetic_robot(4)
    runs = driven(robot, robot.inverse_kinematic_matrix * shares)
    result = fit("lin", robot, runs)
    assert mean_errors(result.matrix, runs) == pytest.approx((0.0, 0.0), abs=1e-3)


def test_runs_without_reference_poses_and_the_geometry_are_refused() -> None:
    robot = synthetic_robot()
    blind = [replace(run, pose_times=run.pose_times[:1], poses=run.poses[:1]) for run in synthetic_trajectories(robot)]
    assert fit("lin", robot, blind).outcome is Outcome.NOT_APPLICABLE
    result = solved("lin", synthetic_problem("geometry"))
    assert (result.outcome, "parameterisation: matrix" in result.reason) == (Outcome.FAILED, True)


def with_radii(shares: list[float]) -> tuple[Trajectory, ...]:
    """Recordings of the synthetic robot when nothing but its wheel radii are not as designed."""
    return driven(synthetic_robot(), synthetic_robot().inverse_kinematic_matrix * shares)


PARAMETERISATIONS: tuple[ParameterisationName, ...] = ("matrix", "geometry")


def maddahi(
    runs: Sequence[Trajectory], parameterisation: ParameterisationName = "matrix", **changes: bool
) -> RunResult:
    return solved("maddahi", synthetic_problem(parameterisation, trajectories=runs, evaluations=20_000, **changes))


@settings(max_examples=10, deadline=None)
@given(st.lists(st.floats(0.93, 1.07), min_size=3, max_size=3))
def test_wheel_radii_that_differ_from_the_design_are_found(shares: list[float]) -> None:
    result = maddahi(with_radii(shares))
    assert result.matrix == pytest.approx(synthetic_robot().inverse_kinematic_matrix * shares, rel=1e-6)


def test_both_parameterisations_give_the_same_matrix() -> None:
    of_matrix, of_geometry = (maddahi(synthetic_trajectories(synthetic_robot()), each) for each in PARAMETERISATIONS)
    assert of_geometry.matrix == pytest.approx(of_matrix.matrix, rel=1e-6, abs=1e-9)


def test_the_indices_are_reported_with_a_lateral_mean_of_one() -> None:
    result = maddahi(with_radii([1.05, 1.02, 0.99]))
    assert result.reason == "longitudinal index 1.0200, lateral indices a 1.0294, b 1.0000, c 0.9706"


def test_radii_outside_the_box_stop_at_its_bound() -> None:
    result = maddahi(with_radii([1.15, 1.0, 1.0]), fixed=True)
    assert result.outcome is Outcome.CONVERGED
    assert {"m11", "m21", "m31"} <= set(result.at_bounds)


def test_a_wheel_that_the_box_holds_fixed_keeps_its_design_value() -> None:
    problem = synthetic_problem()
    lower, upper = problem.lower.copy(), problem.upper.copy()
    lower[0] = upper[0] = problem.start[0]
    problem.lower, problem.upper, problem.free = lower, upper, upper > lower
    result = run_calibrator(calibrators.create("maddahi"), problem)
    assert np.array_equal(result.vector[[0, 3, 6]], problem.start[[0, 3, 6]])
    assert result.cost < problem.values(problem.start[None])[0]


# Published methods for differential drives, in ``plugins/``: censi, ivanjko, jung_chung and umbmark.

LEFT, RIGHT, OMNI = synthetic_robots()[2].wheels[0], synthetic_robots()[2].wheels[1], synthetic_robots()[0]
ROBOT = Robot(name="plain", wheels=(LEFT, RIGHT))
# The same axle with its wheels in the other order, one of them the other way round, and its middle neither the robot's
# centre nor the tracked point.
MOVED = Robot(
    name="moved",
    wheels=(
        Wheel(name="right", type="fixed", radius=0.08, x=0.1, y=-0.15, angle=np.pi),
        Wheel(name="left", type="fixed", radius=0.08, x=0.1, y=0.25),
    ),
    mount=Mount(x=0.2, y=-0.1, yaw=0.3),
)


def worn(robot: Robot, left: float, right: float, wheelbase: float) -> Robot:
    """The robot with radii of the left and right wheel, and the wheelbase about its middle, times factors."""
    middle = np.mean([wheel.position for wheel in robot.wheels], axis=0)
    wheels = []
    for wheel in robot.wheels:
        x, y = (middle + wheelbase * (np.array(wheel.position) - middle)).tolist()
        share = left if wheel.name == "left" else right
        wheels.append(wheel.model_copy(update={"radius": wheel.radius * share, "x": x, "y": y}))
    return robot.model_copy(update={"wheels": tuple(wheels)})


def runs_of(robot: Robot, true: Robot, *commands: str) -> tuple[Trajectory, ...]:
    """Noise-free runs of the true robot, driven by the design ``robot`` (ROBOT or MOVED).

    commands: only the runs whose command begins with one of these.
    """
    model, chosen = OdometryModel(robot, true.inverse_kinematic_matrix, "arc"), list[Trajectory]()
    for run in synthetic_trajectories(ROBOT):
        if not commands or (run.command or "").startswith(commands):
            left, right = run.rates.T
            driven = replace(run, rates=run.rates if robot.wheels[0] == LEFT else np.column_stack([-right, left]))
            chosen.append(replace(driven, poses=model.poses([driven.log(run.pose_times)])[0]))
    return tuple(chosen)


def solved(calibrator: str, problem: CalibrationProblem, **options: Any) -> RunResult:
    """The result of a calibrator with these options."""
    return run_calibrator(calibrators.create(calibrator, options), problem)


def solved_on(calibrator: str, robot: Robot, true: Robot, *commands: str) -> RunResult:
    """The result on the runs of a true robot with these commands."""
    return solved(calibrator, synthetic_problem(robot=robot, trajectories=runs_of(robot, true, *commands)))


def ratios(matrix: Array, design: Robot = ROBOT) -> tuple[float, float]:
    """Wheelbase over that of the design, and right radius over left radius, of a plain robot's matrix (left, right)."""
    wheelbase = 2 * matrix[0, 1] / matrix[2, 1]
    return float(wheelbase / sum(abs(wheel.position[1]) for wheel in design.wheels)), float(matrix[0, 1] / matrix[0, 0])


ARTICLES = ("ivanjko", "jung_chung", "umbmark")  # which calibrate from the runs of one session
METHODS = ("censi", *ARTICLES)
factors = st.floats(0.95, 1.05)


def assert_not_for(result: RunResult, *named: str) -> None:
    assert result.outcome is Outcome.NOT_APPLICABLE
    for part in named:
        assert part in result.reason


@settings(max_examples=10)
@given(st.tuples(*[st.floats(0.9, 1.1)] * 3), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-1.5, 1.5))
def test_censi_finds_radii_axle_and_mount_exactly(shares: tuple[float, ...], x: float, y: float, yaw: float) -> None:
    for robot in (ROBOT, MOVED):
        true = worn(robot, *shares).model_copy(update={"mount": Mount(x=x, y=y, yaw=yaw)})
        result = solved_on("censi", robot, true)
        assert result.outcome is Outcome.CONVERGED
        assert result.vector == pytest.approx(true.inverse_kinematic_matrix.ravel(), rel=1e-6, abs=1e-8)


@settings(max_examples=10)
@given(factors, factors, factors)
def test_ivanjko_finds_radii_and_wheelbase_exactly(left: float, right: float, wheelbase: float) -> None:
    for robot in (ROBOT, MOVED):
        true = worn(robot, left, right, wheelbase)
        result = solved_on("ivanjko", robot, true, "forward", "turn", "square")
        assert result.outcome is Outcome.CONVERGED
        assert result.matrix == pytest.approx(true.inverse_kinematic_matrix, rel=1e-6, abs=1e-8)


@settings(max_examples=15)
@given(st.floats(-0.05, 0.05))
def test_jung_chung_finds_the_wheelbase_exactly_where_the_wheels_are_equal(longer: float) -> None:
    wheelbase, wheels = ratios(solved_on("jung_chung", ROBOT, worn(ROBOT, 1.0, 1.0, 1 + longer), "square").matrix)
    assert (wheelbase, wheels) == pytest.approx((1 + longer, 1.0), abs=1e-9)


@pytest.mark.parametrize(("method", "share", "second_order"), [("jung_chung", 0.5, 2.0), ("umbmark", 0.0, 8.0)])
@settings(max_examples=15)
@given(longer=st.floats(-0.02, 0.02), unequal=st.floats(-0.02, 0.02))
def test_squares_tell_geometry(method: str, share: float, second_order: float, longer: float, unequal: float) -> None:
    """jung_chung takes half of what the wheels differ by for a longer wheelbase."""
    unequal *= 1.0 if method == "jung_chung" else 0.5
    true = worn(ROBOT, 1 - unequal / 2, 1 + unequal / 2, 1 + longer)
    wheelbase, wheels = ratios(solved_on(method, ROBOT, true, "square").matrix)
    missed = second_order * (abs(longer) + abs(unequal)) ** 2 + 1e-9
    assert wheelbase == pytest.approx((1 + longer) * (1 + share * unequal), abs=missed)
    assert wheels == pytest.approx(1 + unequal, abs=missed)


@pytest.mark.parametrize(
    ("method", "parts"),
    [
        ("ivanjko", ("left 80.000, right 80.000 mm", "wheelbase 400.0 mm", "4 straight lines, 2 turns to the left")),
        *(
            (method, ("wheelbase 400.0 mm (E_b 1.0000)", "(E_d 1.0000)", "2 clockwise and 2 counter-clockwise squares"))
            for method in ("jung_chung", "umbmark")
        ),
        ("censi", ("left 80.000, right 79.200 mm", "axle 408.0 mm", "100.0 mm ahead and -50.0 mm", "by 3.00 deg")),
    ],
)
def test_the_answer_is_told_in_words(method: str, parts: tuple[str, ...]) -> None:
    moved = {"mount": Mount(x=0.1, y=-0.05, yaw=np.radians(3.0))}
    true = worn(ROBOT, 1.0, 0.99, 1.02).model_copy(update=moved) if method == "censi" else ROBOT
    result = solved_on(method, ROBOT, true)
    for part in parts:
        assert part in result.reason


@pytest.mark.parametrize("method", ["jung_chung", "umbmark"])
def test_order_and_direction_of_wheels_and_place_of_the_tracked_point_make_no_difference(method: str) -> None:
    plain = solved_on(method, ROBOT, worn(ROBOT, 1.004, 0.996, 1.01), "square")
    result = solved_on(method, MOVED, worn(MOVED, 1.004, 0.996, 1.01), "square")
    wheelbase, wheels = ratios(plain.matrix)
    share = {"left": 2 / (1 + wheels), "right": 2 / (1 + 1 / wheels)}
    expected = worn(MOVED, share["left"], share["right"], wheelbase).inverse_kinematic_matrix
    assert result.matrix == pytest.approx(expected, rel=1e-3, abs=1e-5)


def test_noise_moves_censi_about_as_little_as_a_least_squares_fit_of_the_whole_trajectories() -> None:
    rng = np.random.default_rng(0)
    true = worn(ROBOT, 1.01, 0.99, 1.02)
    errors = []
    for _ in range(20):
        runs = tuple(
            replace(run, poses=run.poses + [0.001, 0.001, 0.002] * rng.standard_normal(run.poses.shape))
            for run in runs_of(ROBOT, true)
        )
        matrix = solved("censi", synthetic_problem(robot=ROBOT, trajectories=runs)).matrix
        errors.append(matrix / np.where(true.inverse_kinematic_matrix == 0, 1, true.inverse_kinematic_matrix))
    spread, bias = np.std(errors, axis=0)[[0, 2]], np.mean(errors, axis=0)[[0, 2]] - 1
    assert spread.max() < 2e-3
    assert np.abs(bias).max() < 1e-3


@pytest.mark.parametrize(
    ("method", "commands", "found"),
    [
        *(("censi", commands, "open") for commands in (("forward", "backward"), ("turn",), ("curve left",))),
        ("ivanjko", ("square", "curve"), "no straight lines and no turns on the spot to the left and no turns"),
        ("ivanjko", ("forward", "turn left"), "no turns on the spot to the right"),
        ("ivanjko", ("turn",), "no straight lines"),
        *(
            (method, *case)
            for method in ("jung_chung", "umbmark")
            for case in (
                (("curve", "forward", "turn"), "found: none"),
                (("square left", "forward"), "2 squares among 4 runs, none clockwise"),
                (("square right",), "2 squares among 2 runs, none counter-clockwise"),
            )
        ),
    ],
)
def test_paths_that_leave_something_open_are_refused(method: str, commands: tuple[str, ...], found: str) -> None:
    assert_not_for(solved_on(method, ROBOT, worn(ROBOT, 1.01, 0.99, 1.0), *commands), found)


def test_censi_refuses_an_axle_that_noise_hides_and_runs_without_poses() -> None:
    rng = np.random.default_rng(0)
    noisy = tuple(
        replace(run, poses=run.poses + 0.3 * rng.standard_normal(run.poses.shape))
        for run in runs_of(ROBOT, ROBOT, "tight curve", "turn")
    )
    assert_not_for(solved("censi", synthetic_problem(robot=ROBOT, trajectories=noisy)), "standard error")
    problem = synthetic_problem(robot=ROBOT)
    problem.trajectories = tuple(
        replace(run, pose_times=run.pose_times[:1], poses=run.poses[:1]) for run in runs_of(ROBOT, ROBOT)
    )
    assert_not_for(solved("censi", problem), "reference poses")


@pytest.mark.parametrize("method", METHODS)
def test_other_robots_parameterisations_and_runs_of_several_sessions_are_refused(method: str) -> None:
    assert_not_for(solved(method, synthetic_problem(robot=OMNI)), "differential drives", "synthetic omni")
    result = solved(method, synthetic_problem("geometry", robot=ROBOT))
    assert (result.outcome, f"{method} gives a matrix" in result.reason) == (Outcome.FAILED, True)
    if method in ARTICLES:
        runs = [replace(run, session=f"session {number % 2}") for number, run in enumerate(runs_of(ROBOT, ROBOT))]
        assert_not_for(solved(method, synthetic_problem(robot=ROBOT, trajectories=runs)), "one session", "these are 2")


@pytest.mark.parametrize(
    ("method", "kind", "found"),
    [
        *(("ivanjko", kind, "no straight lines and no turns") for kind in ("circular", "square")),
        *((method, kind, "found: none") for method in ("jung_chung", "umbmark") for kind in ("circular", "ivanjko")),
    ],
)
def test_real_recordings_of_another_kind_are_refused(method: str, kind: str, found: str) -> None:
    runs = tuple(replace(run, session=None) for run in of_kind(diff(), kind))
    assert_not_for(solved(method, synthetic_problem(robot=diff().robot, trajectories=runs)), found)


@pytest.mark.parametrize(
    ("label", "tolerance"), [("censi", 0.04), ("ivanjko", 0.02), ("umbmark", 0.02), ("jung_chung, divided twice", 0.02)]
)
def test_figures_of_real_recordings_come_out(label: str, tolerance: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of jung_chung are of a program that divides the mean heading errors once more than the plug-in."""
    dataset = diff()
    monkeypatch.setattr(published_methods, "recordings", lambda robot: dataset)  # noqa: ARG005
    if "twice" in label:
        published_methods.register_divided_twice()
    method = published_methods.method_called(label)
    for kind, here in published_methods.figures(method).items():
        assert here == pytest.approx(method.known[kind], rel=tolerance), kind
    if "twice" in label:
        for kind, here in published_methods.figures(published_methods.method_called("jung_chung")).items():
            assert np.all(np.array(here) <= np.array(method.known[kind])), kind


# The calibrators cmaes and differential_evolution of ``plugins/``.


def test_cmaes_says_which_package_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cma", None)  # what Python itself does for a module that cannot be imported
    result = run_calibrator(calibrators.create("cmaes"), synthetic_problem())
    assert (result.outcome, "pip install cma" in result.reason) == (Outcome.FAILED, True)


def test_cmaes_refuses_a_box_with_one_free_element() -> None:
    problem = synthetic_problem()
    problem.free = np.arange(problem.size) == 0
    result = run_calibrator(calibrators.create("cmaes"), problem)
    assert result.outcome is Outcome.FAILED
    assert "two free elements or more, the box leaves 1" in result.reason


def test_cmaes_evaluates_generations_of_the_size_that_is_asked_for() -> None:
    result = solved("cmaes", synthetic_problem(evaluations=101), population=50)
    assert (result.outcome, result.evaluations) == (Outcome.BUDGET, 101)  # the start and two generations


def test_cmaes_says_which_criterion_stopped_it() -> None:
    result = run_calibrator(calibrators.create("cmaes", {"tolx": 1e-3}), synthetic_problem(evaluations=20_000))
    assert result.outcome is Outcome.CONVERGED
    assert result.reason == "pycma: tolx 0.001"


def test_differential_evolution_evaluates_whole_generations(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, sizes = synthetic_problem(evaluations=500), []
    counted = problem.cost
    monkeypatch.setattr(problem, "cost", lambda candidates: sizes.append(len(candidates)) or counted(candidates))
    run_calibrator(calibrators.create("differential_evolution", {"popsize": 10}), problem)
    assert set(sizes) == {90}


def test_differential_evolution_stops_by_its_own_rule() -> None:
    result = solved("differential_evolution", synthetic_problem(evaluations=60_000), tol=1e-2)
    assert result.outcome is Outcome.CONVERGED
    assert result.reason == "SciPy: Optimization terminated successfully."
    assert result.evaluations < 60_000


def test_differential_evolution_leaves_the_start_where_nothing_is_free() -> None:
    problem = synthetic_problem()
    problem.free = np.zeros(problem.size, dtype=bool)
    result = run_calibrator(calibrators.create("differential_evolution"), problem)
    assert np.array_equal(result.vector, problem.start)


@pytest.mark.parametrize(
    ("name", "options", "named"),
    [
        ("cmaes", {"popsize": 10}, "'popsize'"),
        ("differential_evolution", {"mutation": [0.9, 0.4]}, "0 <= low <= high < 2"),
    ],
)
def test_options_that_cannot_be_are_named(name: str, options: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        calibrators.create(name, options)


# The calibrator ``discovered`` of ``plugins/``.


@cache
def fitted() -> CalibrationRun:
    return calibrate(simulated(), calibrator="discovered", integration="arc")


@pytest.mark.slow
def test_the_answer_is_the_extended_model_of_discover() -> None:
    assert [term.name for term in fitted().calibration.effects] == [effect.name for effect in named().effects]
    found, own = named().extended, fitted().calibration
    np.testing.assert_allclose(own.matrix_array, found.matrix_array, rtol=1e-3, atol=1e-4)
    assert own.plain is not None
    assert own.driven is not None
    assert own.covariance is not None


@pytest.mark.slow
def test_the_costs_of_the_file_are_those_of_the_model_with_effects(tmp_path: Path) -> None:
    write_calibration(fitted().calibration, tmp_path / "c.yaml")
    found = evaluate(read_calibration(tmp_path / "c.yaml"), simulated())
    origin = fitted().calibration.provenance
    assert origin.training_cost == pytest.approx(found.splits["train"].cost, rel=1e-12)
    assert origin.validation_cost == pytest.approx(found.splits["validation"].cost, rel=1e-12)
    plain = calibrate(simulated(), "closed_form").calibration.provenance
    assert origin.training_cost < 0.8 * plain.training_cost


@pytest.mark.slow
def test_where_nothing_is_found_the_answer_is_that_of_closed_form() -> None:
    assert not nothing().effects
    run, plain = calibrate(simulated(()), calibrator="discovered"), calibrate(simulated(()), "closed_form")
    assert not run.calibration.effects
    assert run.calibration.matrix == plain.calibration.matrix
    assert "the matrix alone: discover names no effect (none)" in run.result.reason


def test_spent_seconds_leave_the_matrix_alone() -> None:
    def at_a_step(event: Progress) -> None:
        if event.unit == "step":
            time.sleep(2.0)

    calibrate(simulated())  # so that compiling and reading are not part of the seconds
    run = calibrate(simulated(), calibrator="discovered", budget=Budget(seconds=2.0), watch=at_a_step)
    assert run.result.outcome is Outcome.TIME
    assert "s spent while" in run.result.reason
    assert not run.calibration.effects


def test_euler_steps_are_not_for_it() -> None:
    with pytest.raises(ConfigError, match="Euler steps look like slip; set integration to arc"):
        calibrate(simulated(), calibrator="discovered", integration="euler")
