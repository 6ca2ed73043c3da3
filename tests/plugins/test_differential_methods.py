"""Published methods for differential drives, in ``plugins/``: censi, ivanjko, jung_chung and umbmark."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import published_methods
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from real_recordings import diff

from omnibench.data.dataset import Trajectory
from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array, Mount, Robot, Wheel
from omnibench.robot.model import OdometryModel
from omnibench.testing import CalibratorConformance, synthetic_problem, synthetic_trajectories
from omnibench.testing.synthetic import synthetic_robots

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


def solved(calibrator: str, problem: CalibrationProblem) -> RunResult:
    """The result of a calibrator with its default options."""
    return run_calibrator(calibrators.create(calibrator), problem)


def solved_on(calibrator: str, robot: Robot, true: Robot, *commands: str) -> RunResult:
    """The result on the runs of a true robot with these commands."""
    return solved(calibrator, synthetic_problem(robot=robot, trajectories=runs_of(robot, true, *commands)))


def ratios(matrix: Array, design: Robot = ROBOT) -> tuple[float, float]:
    """Wheelbase over that of the design, and right radius over left radius, of a plain robot's matrix (left, right)."""
    wheelbase = 2 * matrix[0, 1] / matrix[2, 1]
    return float(wheelbase / sum(abs(wheel.position[1]) for wheel in design.wheels)), float(matrix[0, 1] / matrix[0, 0])


ARTICLES = ("ivanjko", "jung_chung", "umbmark")  # which calibrate from the runs of one session
PLUGINS = METHODS = ("censi", *ARTICLES)
factors = st.floats(0.95, 1.05)


class TestCensi(CalibratorConformance):
    """The cases of every calibrator."""

    name = "censi"
    solved = 1e-09


class TestIvanjko(CalibratorConformance):
    """The same."""

    name = "ivanjko"
    solved = 1e-09


class TestJungChung(CalibratorConformance):
    """The same."""

    name = "jung_chung"
    solved = 0.4


class TestUmbmark(CalibratorConformance):
    """The same."""

    name = "umbmark"
    solved = 0.2


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
    assert result.outcome is Outcome.CONVERGED
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
    runs = tuple(replace(run, session=None) for run in published_methods.of_kind(diff(), kind))
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
