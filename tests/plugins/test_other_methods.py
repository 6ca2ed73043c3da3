"""Published methods for other robots, in ``plugins/``: kallasi, lin, maddahi and optiodom."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from real_recordings import diff, mean_errors, omni3, omni4, tricyc

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array, Mount, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryBatch
from omnibench.testing import (
    CalibratorConformance,
    synthetic_problem,
    synthetic_robot,
    synthetic_trajectories,
)
from omnibench.testing.synthetic import synthetic_robots

ROBOTS = {robot.name.removeprefix("synthetic "): robot for robot in synthetic_robots()}
PLUGINS = ("optiodom", "kallasi", "lin", "maddahi")
FITTED = ("omni", "mecanum", "differential", "tricycle")


class TestOptiOdom(CalibratorConformance):
    """The cases of every calibrator."""

    name = "optiodom"
    solved = 0.2


@pytest.mark.slow
class TestOptiOdomOnMecanumWheels(TestOptiOdom):
    """The same of another robot."""

    def problem(self, *arguments: Any, **changes: Any) -> Any:
        return super().problem(*arguments, **{"wheels": 4} | changes)


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


def of_kind(dataset: Dataset, kind: str) -> list[Trajectory]:
    return [run for run in dataset.trajectories if run.id.startswith(kind)]


def fit(calibrator: str, robot: Robot, runs: Sequence[Trajectory], seconds: float = 600.0, **options: Any) -> RunResult:
    problem = synthetic_problem(robot=robot, trajectories=runs, seconds=seconds)
    return run_calibrator(calibrators.create(calibrator, options), problem)


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


class TestKallasi(CalibratorConformance):
    """The cases of every calibrator."""

    name = "kallasi"
    solved = 0.5  # the wheel's true distance from the axle is not the designed one, which the method cannot see


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


class TestLin(CalibratorConformance):
    """The cases of every calibrator."""

    name = "lin"
    solved = 0.02


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


def test_runs_without_reference_poses_are_refused() -> None:
    robot = synthetic_robot()
    blind = [replace(run, pose_times=run.pose_times[:1], poses=run.poses[:1]) for run in synthetic_trajectories(robot)]
    assert fit("lin", robot, blind).outcome is Outcome.NOT_APPLICABLE


def test_the_geometry_is_refused() -> None:
    problem = synthetic_problem("geometry")
    result = run_calibrator(calibrators.create("lin"), problem)
    assert (result.outcome, "parameterisation: matrix" in result.reason) == (Outcome.FAILED, True)


class TestMaddahi(CalibratorConformance):
    """The cases of every calibrator."""

    name = "maddahi"
    solved = 0.6


def with_radii(shares: list[float]) -> tuple[Trajectory, ...]:
    """Recordings of the synthetic robot when nothing but its wheel radii are not as designed."""
    return driven(synthetic_robot(), synthetic_robot().inverse_kinematic_matrix * shares)


def maddahi(
    runs: Sequence[Trajectory], parameterisation: ParameterisationName = "matrix", **changes: bool
) -> RunResult:
    problem = synthetic_problem(parameterisation, trajectories=runs, evaluations=20_000, **changes)
    return run_calibrator(calibrators.create("maddahi"), problem)


@settings(max_examples=10, deadline=None)
@given(st.lists(st.floats(0.93, 1.07), min_size=3, max_size=3))
def test_wheel_radii_that_differ_from_the_design_are_found(shares: list[float]) -> None:
    result = maddahi(with_radii(shares))
    assert result.matrix == pytest.approx(synthetic_robot().inverse_kinematic_matrix * shares, rel=1e-6)


@pytest.mark.parametrize("parameterisation", ["matrix", "geometry"])
def test_both_parameterisations_give_the_same_matrix(parameterisation: ParameterisationName) -> None:
    result = maddahi(synthetic_trajectories(synthetic_robot()), parameterisation)
    reference = maddahi(synthetic_trajectories(synthetic_robot()), "matrix")
    assert result.matrix == pytest.approx(reference.matrix, rel=1e-6, abs=1e-9)


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
