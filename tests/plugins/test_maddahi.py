"""The calibrator maddahi of ``plugins/``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omnibench.data.dataset import Trajectory
from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.registry import calibrators
from omnibench.robot.model import OdometryModel
from omnibench.testing import (
    CalibratorConformance,
    load_plugin,
    synthetic_problem,
    synthetic_robot,
    synthetic_trajectories,
)


@pytest.fixture(autouse=True, scope="module")
def plugin(registries_as_before_the_module: None) -> None:  # noqa: ARG001
    load_plugin(Path(__file__).parents[2] / "plugins" / "maddahi.py")


class TestMaddahi(CalibratorConformance):
    """The cases of every calibrator."""

    name = "maddahi"
    solved = 0.6


def worn(shares: list[float]) -> tuple[Trajectory, ...]:
    """Recordings of the synthetic robot when nothing but its wheel radii are not as designed."""
    robot = synthetic_robot()
    matrix = robot.inverse_kinematic_matrix * shares
    model = OdometryModel(robot, matrix, "arc")
    return tuple(replace(run, poses=model.poses([run.log(run.pose_times)])[0]) for run in synthetic_trajectories(robot))


def run(runs: tuple[Trajectory, ...], parameterisation: ParameterisationName = "matrix", **changes: bool) -> RunResult:
    problem = synthetic_problem(parameterisation, trajectories=runs, evaluations=20_000, **changes)
    return run_calibrator(calibrators.create("maddahi"), problem)


@settings(max_examples=10, deadline=None)
@given(st.lists(st.floats(0.93, 1.07), min_size=3, max_size=3))
def test_wheel_radii_that_differ_from_the_design_are_found(shares: list[float]) -> None:
    result = run(worn(shares))
    assert result.matrix == pytest.approx(synthetic_robot().inverse_kinematic_matrix * shares, rel=1e-6)


@pytest.mark.parametrize("parameterisation", ["matrix", "geometry"])
def test_both_parameterisations_give_the_same_matrix(parameterisation: ParameterisationName) -> None:
    result = run(synthetic_trajectories(synthetic_robot()), parameterisation)
    reference = run(synthetic_trajectories(synthetic_robot()), "matrix")
    assert result.matrix == pytest.approx(reference.matrix, rel=1e-6, abs=1e-9)


def test_the_indices_are_reported_with_a_lateral_mean_of_one() -> None:
    result = run(worn([1.05, 1.02, 0.99]))
    assert result.reason == "longitudinal index 1.0200, lateral indices a 1.0294, b 1.0000, c 0.9706"


def test_radii_outside_the_box_stop_at_its_bound() -> None:
    result = run(worn([1.15, 1.0, 1.0]), fixed=True)
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
