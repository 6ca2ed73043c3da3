"""The calibrator censi of ``plugins/``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import published_methods
import pytest
from differential_runs import MOVED, OMNI, ROBOT, runs_of, solved, solved_on, worn
from hypothesis import given, settings
from hypothesis import strategies as st
from real_recordings import diff

from omnibench.fit.calibrator import Outcome
from omnibench.robot.kinematics import Mount
from omnibench.testing import CalibratorConformance, load_plugin, synthetic_problem


@pytest.fixture(autouse=True, scope="module")
def plugin(registries_as_before_the_module: None) -> None:  # noqa: ARG001
    load_plugin(Path(__file__).parents[2] / "plugins" / "censi.py")


class TestCensi(CalibratorConformance):
    """The cases of every calibrator."""

    name = "censi"
    solved = 1e-09


@settings(max_examples=10)
@given(
    st.tuples(*[st.floats(0.9, 1.1)] * 3),
    st.floats(-0.3, 0.3),
    st.floats(-0.3, 0.3),
    st.floats(-1.5, 1.5),
)
def test_radii_axle_and_mount_are_found_exactly(shares: tuple[float, ...], x: float, y: float, yaw: float) -> None:
    for robot in (ROBOT, MOVED):
        left, right, wheelbase = shares
        true = worn(robot, left, right, wheelbase).model_copy(update={"mount": Mount(x=x, y=y, yaw=yaw)})
        result = solved_on("censi", robot, true)
        assert result.outcome is Outcome.CONVERGED
        assert result.vector == pytest.approx(true.inverse_kinematic_matrix.ravel(), rel=1e-6, abs=1e-8)


def test_the_answer_is_told_in_words() -> None:
    true = worn(ROBOT, 1.0, 0.99, 1.02).model_copy(update={"mount": Mount(x=0.1, y=-0.05, yaw=np.radians(3.0))})
    assert solved_on("censi", ROBOT, true).reason == (
        "radii left 80.000, right 79.200 mm, axle 408.0 mm, tracked point 100.0 mm ahead and -50.0 mm to the left of "
        "its middle, turned by 3.00 deg, from 60 intervals"
    )


def test_noise_moves_the_answer_about_as_little_as_a_least_squares_fit_of_the_whole_trajectories() -> None:
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


@pytest.mark.parametrize("commands", [("forward", "backward"), ("turn",), ("curve left",)])
def test_runs_that_leave_parameters_open_are_refused(commands: tuple[str, ...]) -> None:
    result = solved_on("censi", ROBOT, ROBOT, *commands)
    assert result.outcome is Outcome.NOT_APPLICABLE
    assert result.reason == (
        "it needs runs that both drive and turn, and these leave parameters open (the two wheels cannot be told apart)"
    )


def test_an_axle_that_noise_hides_is_refused() -> None:
    rng = np.random.default_rng(0)
    runs = tuple(
        replace(run, poses=run.poses + 0.3 * rng.standard_normal(run.poses.shape))
        for run in runs_of(ROBOT, ROBOT, "tight curve", "turn")
    )
    result = solved("censi", synthetic_problem(robot=ROBOT, trajectories=runs))
    assert result.outcome is Outcome.NOT_APPLICABLE
    assert "standard error" in result.reason


def test_runs_without_poses_are_refused() -> None:
    problem = synthetic_problem(robot=ROBOT)
    problem.trajectories = tuple(
        replace(run, pose_times=run.pose_times[:1], poses=run.poses[:1]) for run in runs_of(ROBOT, ROBOT)
    )
    result = solved("censi", problem)
    assert result.outcome is Outcome.NOT_APPLICABLE
    assert result.reason == "it needs reference poses, and these runs have none after the start"


def test_it_is_not_for_robots_on_omni_wheels() -> None:
    result = solved("censi", synthetic_problem(robot=OMNI))
    assert result.outcome is Outcome.NOT_APPLICABLE
    assert result.reason == "it is for differential drives with two measured wheels, and synthetic omni is none"


def test_another_parameterisation_is_refused() -> None:
    result = solved("censi", synthetic_problem("geometry", robot=ROBOT))
    assert (result.outcome, result.reason) == (Outcome.FAILED, "censi gives a matrix; say parameterisation: matrix")


def test_the_figures_that_are_known_on_real_recordings_come_out(monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = diff()
    monkeypatch.setattr(published_methods, "recordings", lambda robot: dataset)  # noqa: ARG005
    method = published_methods.method_called("censi")
    for kind, here in published_methods.figures(method).items():
        assert here == pytest.approx(method.known[kind], rel=0.04), kind
