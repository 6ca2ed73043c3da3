"""Second-order cone programs: sums of norms in a box."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from omnibench.fit.sum_of_norms import SolverError, SumOfNormsProgram
from omnibench.robot.kinematics import Array


def test_the_geometric_median_minimises_the_sum_of_distances() -> None:
    # Of an isosceles triangle with an angle of 90 degrees: the point that sees every side under 120 degrees.
    corners = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    jacobian = np.tile(np.eye(2), (3, 1, 1))
    program = SumOfNormsProgram(-corners, jacobian, np.full(2, -2.0), np.full(2, 2.0))
    np.testing.assert_allclose(program.step(np.ones(3)), [0.0, 1 / np.sqrt(3)], atol=1e-9)


def test_a_share_above_the_others_draws_the_step_to_its_point() -> None:
    corners = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    program = SumOfNormsProgram(-corners, np.tile(np.eye(2), (3, 1, 1)), np.full(2, -2.0), np.full(2, 2.0))
    np.testing.assert_allclose(program.step(np.array([5.0, 1.0, 1.0])), corners[0], atol=1e-9)


def test_a_share_of_zero_leaves_a_point_out() -> None:
    corners = np.array([[-1.0, 0.0], [1.0, 0.5], [0.3, 1.0]])
    everything = np.full(2, -2.0), np.full(2, 2.0)
    all_but_one = SumOfNormsProgram(-corners, np.tile(np.eye(2), (3, 1, 1)), *everything).step(
        np.array([0.0, 2.0, 1.0])
    )
    np.testing.assert_allclose(all_but_one, corners[1], atol=1e-9)


def test_steps_stay_in_the_box() -> None:
    corners = np.array([[3.0, 4.0], [3.0, 4.0]])
    program = SumOfNormsProgram(-corners, np.tile(np.eye(2), (2, 1, 1)), np.array([-1.0, 0.0]), np.array([1.0, 0.0]))
    np.testing.assert_allclose(program.step(np.ones(2)), [1.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1.0, 1e3])
def test_the_step_does_not_depend_on_the_unit_of_the_residuals(scale: float) -> None:
    corners = scale * np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    jacobian = scale * np.tile(np.eye(2), (3, 1, 1))
    program = SumOfNormsProgram(-corners, jacobian, np.full(2, -2.0), np.full(2, 2.0))
    np.testing.assert_allclose(program.step(np.ones(3)), [0.0, 1 / np.sqrt(3)], atol=1e-8)


def test_a_program_that_cannot_be_solved_says_so() -> None:
    empty = SumOfNormsProgram(np.ones((2, 2)), np.ones((2, 2, 2)), np.full(2, 1.0), np.full(2, -1.0))
    with pytest.raises(SolverError, match="Clarabel ended with status 'infeasible'"):
        empty.step(np.ones(2))


def test_a_long_recording_needs_no_memory_that_grows_with_its_square() -> None:
    stamps = 12_000
    residuals, jacobian = a_regression(stamps)
    tracemalloc.start()
    step = SumOfNormsProgram(residuals, jacobian, np.full(3, -1.0), np.full(3, 1.0)).step(np.ones(stamps))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(step, [0.3, -0.2, 0.1], atol=1e-3)
    assert peak < 200e6


def a_regression(count: int) -> tuple[Array, Array]:
    """Residuals that a step of (0.3, -0.2, 0.1) makes vanish but for noise of 0.01."""
    rng = np.random.default_rng(1)
    jacobian = rng.normal(size=(count, 3, 3))
    return -jacobian @ [0.3, -0.2, 0.1] + 0.01 * rng.normal(size=(count, 3)), jacobian
