"""The calibration problem: what it counts, keeps and shows, and what nobody can see through it."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from commands import refused
from fit_samples import Scripted, box_between, make_problem, noisy_trajectories
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02, CAR, DIFFERENTIAL, SKID, SWERVE, TRICYCLE, WHEELED

from omnibench.config import validate
from omnibench.data.dataset import make_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.calibrator import Outcome, RunResult, Solution, run_calibrator
from omnibench.fit.cost import Cost
from omnibench.fit.geometry import GeometryLimits, WheelGeometry
from omnibench.fit.parameterisation import Box, MatrixElements, make_bounds
from omnibench.fit.problem import BudgetSpent, CalibrationProblem
from omnibench.registry import costs
from omnibench.robot.kinematics import Array, Mount, Robot, inverse_kinematic_matrix, published_matrix
from omnibench.testing.synthetic import synthetic_robot


def population(problem: CalibrationProblem, count: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return problem.from_unit(rng.uniform(size=(count, int(problem.free.sum()))))


def test_every_candidate_counts_but_those_that_are_only_valued() -> None:
    problem = make_problem()
    problem.values(population(problem, 7))
    assert (problem.evaluations, problem.best_cost) == (0, np.inf)
    problem.cost(problem.start)
    problem.cost(population(problem, 7))
    assert (problem.evaluations, problem.remaining) == (8, 60_000 - 8)


def test_a_population_is_cut_at_the_budget_and_what_was_evaluated_is_kept() -> None:
    problem, unlimited = make_problem(evaluations=5), make_problem()
    candidates = population(problem, 9)
    for _ in range(2):  # nothing is evaluated beyond it
        with pytest.raises(BudgetSpent, match="5 evaluations") as spent:
            problem.cost(candidates)
        assert (spent.value.kind, problem.evaluations) == ("budget", 5)
    assert problem.best_cost == pytest.approx(unlimited.cost(candidates)[:5].min(), rel=1e-12)
    assert make_problem(evaluations=5).cost(candidates[:5]).shape == (5,)


def test_nothing_is_evaluated_when_the_time_is_spent() -> None:
    problem = make_problem(seconds=1e-9)
    with pytest.raises(BudgetSpent, match="1e-09 s") as spent:
        problem.cost(problem.start)
    assert (spent.value.kind, problem.evaluations) == ("time", 0)


@pytest.mark.parametrize("wheels", [3, 4])
@pytest.mark.parametrize("parameterisation", ["matrix", "geometry"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, 1e300])
def test_a_candidate_without_a_cost_leaves_the_others_alone(wheels: Any, parameterisation: Any, value: float) -> None:
    problem = make_problem(wheels=wheels, parameterisation=parameterisation)
    candidates = np.tile(problem.start, (3, 1))
    candidates[1] = value
    costs = problem.cost(candidates)
    assert costs[0] == pytest.approx(problem.values(problem.start[None])[0], rel=1e-12)
    assert costs[2] == pytest.approx(costs[0], rel=1e-14)  # some processors' BLAS rounds rows of a product apart
    assert not costs[1] <= costs[0]


def test_candidates_of_another_shape_are_a_programming_error() -> None:
    problem = make_problem()
    with pytest.raises(ValueError, match=r"\(2, 8\)"):
        problem.cost(np.zeros((2, 8)))
    assert problem.evaluations == 0


def test_candidates_are_left_unchanged_and_answers_do_not_depend_on_them_later() -> None:
    problem = make_problem()
    candidates = population(problem, 4)
    kept = candidates.copy()
    problem.cost(candidates)
    np.testing.assert_array_equal(candidates, kept)
    best = problem.best_vector.copy()
    candidates[:] = 0.0
    np.testing.assert_array_equal(problem.best_vector, best)


@given(sizes=st.lists(st.integers(1, 6), min_size=1, max_size=8), seed=st.integers(0, 2**16))
def test_the_best_of_all_batches_is_kept_and_the_history_says_when_it_was_found(sizes: list[int], seed: int) -> None:
    problem = make_problem(RUNS)
    batches = [population(problem, size, seed + index) for index, size in enumerate(sizes)]
    values = np.concatenate([problem.cost(batch) for batch in batches])
    costs = [step.cost for step in problem.history]
    seconds = [step.seconds for step in problem.history]
    assert [values[step.evaluations - 1] for step in problem.history] == costs == sorted(set(costs), reverse=True)
    assert seconds == sorted(seconds)
    assert costs[-1] == problem.best_cost == values.min()
    np.testing.assert_array_equal(problem.best_vector, np.concatenate(batches)[values.argmin()])
    assert problem.evaluations == sum(sizes)


RUNS = noisy_trajectories()


@pytest.mark.parametrize("name", ["start", "lower", "upper", "free", "reference", "best_vector"])
@pytest.mark.parametrize("evaluated", [0, 4])
def test_what_a_calibrator_is_given_cannot_be_overwritten(name: str, evaluated: int) -> None:
    problem = make_problem(RUNS)
    problem.cost(population(problem, evaluated))
    assert (problem.best_cost < np.inf) == (evaluated > 0)
    with pytest.raises(ValueError, match="read-only"):
        getattr(problem, name)[0] = 0


# Searches work in the unit cube of the elements that are free.


def test_corners_of_the_unit_cube_are_the_box_and_what_is_outside_comes_to_its_surface() -> None:
    problem = make_problem(RUNS)
    np.testing.assert_allclose(problem.from_unit(np.zeros(9))[0], problem.lower, rtol=1e-15)
    np.testing.assert_allclose(problem.from_unit(np.ones(9))[0], problem.upper, rtol=1e-15)
    np.testing.assert_array_equal(problem.to_unit(problem.upper + 1.0)[0], np.ones(9))


@given(seed=st.integers(0, 2**16), box=st.sampled_from(["row", "paper"]))
def test_points_of_the_unit_cube_come_back(seed: int, box: Any) -> None:
    problem = make_problem(RUNS, box=box)
    points = np.random.default_rng(seed).uniform(size=(5, int(problem.free.sum())))
    np.testing.assert_allclose(problem.to_unit(problem.from_unit(points)), points, atol=1e-13)


@given(points=st.lists(st.floats(-1e3, 1e3), min_size=9, max_size=9))
def test_the_unit_cube_never_leads_outside_the_box(points: list[float]) -> None:
    problem = make_problem(RUNS)
    vectors = problem.from_unit(np.array(points))
    assert ((vectors >= problem.lower) & (vectors <= problem.upper)).all()


# Inside of the box, and on its surface.


def test_corners_of_the_box_are_inside_and_rounding_is_forgiven_and_no_more() -> None:
    problem = make_problem(RUNS)
    assert problem.inside(np.array([problem.lower, problem.upper, problem.start])).all()
    assert problem.inside(problem.upper * (1 + 1e-14 * np.sign(problem.upper)))
    beyond = problem.upper.copy()
    beyond[4] += 1e-9
    outside = [beyond, np.full(9, np.nan), np.full(9, np.inf)]
    assert not problem.inside(np.array(outside)).any()


def test_elements_on_a_bound_are_named_but_not_frozen_ones() -> None:
    problem = make_problem(RUNS)
    vector = problem.start.copy()
    vector[[1, 8]] = problem.upper[1], problem.lower[8]
    assert problem.at_bounds(vector) == ("m12", "m33")
    frozen = make_problem(RUNS, box="paper")
    assert frozen.at_bounds(frozen.start) == ()


def test_no_trajectories_are_refused() -> None:
    with pytest.raises(DataError, match="no trajectories"):
        make_problem(())


def test_elements_that_the_cost_does_not_see_keep_their_start_values() -> None:
    dataset = make_dataset("synthetic", synthetic_robot(3), 0.2, noisy_trajectories())
    run = calibrate(dataset, "genetic", cost="final_heading", options={"generations": 30})
    design = dataset.robot.inverse_kinematic_matrix
    assert run.result.held == ("m11", "m12", "m13", "m21", "m22", "m23")
    assert np.array_equal(run.calibration.matrix_array[:2], design[:2])
    assert not np.array_equal(run.calibration.matrix_array[2], design[2])


# What is searched and in which box: matrix elements, and the wheel geometry of every kind of robot.

DESIGN = APR_02.inverse_kinematic_matrix


def elements(box: Box, robot: Robot = APR_02) -> MatrixElements:
    return MatrixElements(robot, box, np.zeros((0, len(robot.wheels))))


def bounds(box: Box) -> tuple[Array, Array]:
    found = elements(box).bounds
    return found.lower.reshape(3, 3), found.upper.reshape(3, 3)


def test_the_papers_box_has_ten_per_cent_of_every_element_on_either_side() -> None:
    lower, upper = bounds("paper")
    np.testing.assert_allclose(upper - DESIGN, 0.1 * np.abs(DESIGN), rtol=1e-12, atol=0)
    np.testing.assert_allclose(DESIGN - lower, 0.1 * np.abs(DESIGN), rtol=1e-12, atol=0)
    assert lower[0, 1] == upper[0, 1] == 0.0
    published = [published_matrix(name) for name in ("palacin2023_eq9", "palacin2023_eq8")]
    assert [bool(((matrix >= lower) & (matrix <= upper)).all()) for matrix in published] == [True, False]


def test_the_row_box_has_a_quarter_of_the_rows_largest_element_on_either_side() -> None:
    lower, upper = bounds("row")
    width = np.tile(0.25 * np.abs(DESIGN).max(axis=1, keepdims=True), 3)
    np.testing.assert_allclose(upper - DESIGN, width, rtol=1e-12)
    np.testing.assert_allclose(DESIGN - lower, width, rtol=1e-12)


def with_m11(value: float) -> Array:
    matrix = DESIGN.copy()
    matrix[0, 0] = value
    return matrix


@pytest.mark.parametrize(
    ("lower", "upper", "named"),
    [
        (with_m11(0.06), with_m11(0.09), "of m11 is outside [0.06, "),
        (with_m11(0.5), with_m11(-0.5), "m11"),
        (np.full((3, 2), -1.0), np.full((3, 2), 1.0), "3 rows of 3 values"),
        (np.full((2, 3), -1.0), np.full((2, 3), 1.0), "3 rows of 3 values"),
    ],
)
def test_a_box_that_cannot_be_is_refused_by_its_element_or_shape(lower: Array, upper: Array, named: str) -> None:
    with refused(ConfigError, named, start="box: "):
        make_problem(box=box_between(lower, upper))  # the robot of the samples has the design of the APR-02


@given(seed=st.integers(0, 2**16))
def test_along_undriven_directions_the_design_is_kept(seed: int) -> None:
    robot = synthetic_robot(4)
    design = robot.inverse_kinematic_matrix
    rng = np.random.default_rng(seed)
    null = np.linalg.qr(rng.normal(size=(4, 4)))[0][:1]
    vectors = design.ravel() + rng.normal(0, 0.1, (5, 12))
    matrices = MatrixElements(robot, "row", null).matrices(vectors)
    np.testing.assert_allclose(matrices @ null[0], np.tile(design @ null[0], (5, 1)), atol=1e-14)
    driven = np.eye(4) - null.T @ null
    np.testing.assert_allclose(matrices @ driven, vectors.reshape(-1, 3, 4) @ driven, atol=1e-14)


# Radius, distance and angle of every wheel within physical limits.


@pytest.mark.parametrize(
    ("limits", "radius", "distance", "angle_deg"),
    [
        (GeometryLimits(), (0.9, 1.1), (0.8, 1.2), (-3.0, 3.0)),
        (
            GeometryLimits(radius=(-0.02, 0.05), distance=(0.0, 0.3), angle_deg=(-1.0, 0.5)),
            (0.98, 1.05),
            (1.0, 1.3),
            (-1.0, 0.5),
        ),
    ],
)
def test_limits_are_shares_of_radius_and_distance_and_degrees(
    limits: GeometryLimits, radius: Any, distance: Any, angle_deg: Any
) -> None:
    geometry = WheelGeometry(APR_02, limits)
    ends = (geometry.bounds.lower, geometry.bounds.upper)
    for end, of_radius, of_distance, degrees in zip(ends, radius, distance, angle_deg, strict=True):
        found = end.reshape(3, 3)
        np.testing.assert_allclose(found[:2], [[of_radius * 0.148] * 3, [of_distance * 0.195] * 3], rtol=1e-12)
        np.testing.assert_allclose(found[2], np.radians(np.array([60, 180, 300]) + degrees), rtol=1e-12)


@pytest.mark.parametrize("wheels", [3, 4])
def test_vectors_mean_the_matrix_of_a_robot_built_like_that(wheels: Any) -> None:
    robot = synthetic_robot(wheels)
    rng = np.random.default_rng(2)
    geometry = WheelGeometry(robot)
    vectors = rng.uniform(geometry.bounds.lower, geometry.bounds.upper, (6, 3 * wheels))
    for vector, matrix in zip(vectors, geometry.matrices(vectors), strict=True):
        built = tuple(
            wheel.model_copy(update={"radius": r, "distance": d, "angle": a})
            for wheel, r, d, a in zip(robot.wheels, *vector.reshape(3, -1), strict=True)
        )
        np.testing.assert_allclose(matrix, inverse_kinematic_matrix(built), rtol=1e-12, atol=1e-16)


@pytest.mark.parametrize("limits", [{"radius": (0.01, 0.1)}, {"distance": (0.1, -0.1)}])
def test_limits_that_exclude_the_design_or_are_the_wrong_way_round_are_refused_by_name(limits: Any) -> None:
    (name,) = limits
    with pytest.raises(ConfigError, match=f"of {name}_a is "):
        make_problem(parameterisation="geometry", limits=GeometryLimits(**limits))


@pytest.mark.parametrize("limits", [{"radius": 1.5}, {"distance": [-1.0, 0.2]}, {"radius": math.nan}, {"radii": 0.1}])
def test_limits_that_cannot_be_are_refused_in_one_line(limits: dict[str, Any]) -> None:
    with refused(ConfigError, match=r"^limits: "):
        validate(GeometryLimits, limits, "limits")


def test_the_derivatives_of_matrix_elements_are_zero_along_directions_that_are_kept() -> None:
    slopes = MatrixElements(APR_02, "row", np.array([[0.6, 0.8, 0.0]])).slopes(DESIGN.ravel())
    kept = np.array([[0.64, -0.48, 0.0], [-0.48, 0.36, 0.0], [0.0, 0.0, 1.0]])  # 1 - n n'
    np.testing.assert_allclose(slopes, np.kron(np.eye(3), kept), rtol=0, atol=1e-15)


def test_a_robot_that_turns_by_half_of_its_track_is_in_the_box_where_it_skids_and_not_where_it_cannot() -> None:
    for robot, turns_by_half in ((SKID, True), (DIFFERENTIAL, False)):
        matrix = robot.inverse_kinematic_matrix * [[1.0], [1.0], [0.5]]
        box = make_bounds(robot, "row")
        assert bool(((matrix.ravel() >= box.lower) & (matrix.ravel() <= box.upper)).all()) is turns_by_half


def with_wheels(robot: Robot, change: Callable[[Any], dict[str, float]]) -> Robot:
    """A robot with other design values of its measured wheels."""
    return robot.model_copy(
        update={
            "wheels": tuple(
                wheel.model_copy(update=change(wheel)) if wheel in robot.measured else wheel for wheel in robot.wheels
            )
        }
    )


@pytest.mark.parametrize("robot", [pytest.param(robot, id=robot.name) for robot in (APR_02, *WHEELED)])
@pytest.mark.parametrize("fitted_mount", [False, True])
def test_the_design_values_have_the_design_matrix(robot: Robot, fitted_mount: bool) -> None:
    mounted = robot.model_copy(update={"mount": Mount(x=0.3, y=0.1, yaw=0.2)})
    geometry = WheelGeometry(mounted, fitted_mount=fitted_mount)
    found = geometry.matrices(geometry.start[None])[0]
    np.testing.assert_allclose(found, mounted.inverse_kinematic_matrix, rtol=0, atol=1e-15)
    assert ("mount_x" in geometry.names) == (fitted_mount and not robot.slides)


@pytest.mark.parametrize(
    ("robot", "kind", "change"),
    [
        (DIFFERENTIAL, "radius", lambda wheel: {"radius": 1.1 * wheel.radius}),
        (DIFFERENTIAL, "distance", lambda wheel: {"y": 1.2 * wheel.y}),
        (SKID, "distance", lambda wheel: {"y": 1.2 * wheel.y}),
        (TRICYCLE, "x", lambda wheel: {"x": wheel.x + 0.1}),
        (TRICYCLE, "y", lambda wheel: {"y": wheel.y + 0.1}),
        (SWERVE, "radius", lambda wheel: {"radius": 1.1 * wheel.radius}),
        (SWERVE, "x", lambda wheel: {"x": wheel.x + 0.1}),
    ],
)
def test_a_changed_number_has_the_matrix_of_a_robot_that_is_changed_so(
    robot: Robot, kind: str, change: Callable[[Any], dict[str, float]]
) -> None:
    changed = with_wheels(robot, change)
    vector = WheelGeometry(changed).start
    others = [index for index, name in enumerate(WheelGeometry(robot).names) if not name.startswith(kind)]
    np.testing.assert_array_equal(vector[others], WheelGeometry(robot).start[others])
    found = WheelGeometry(robot).matrices(vector[None])[0]
    np.testing.assert_allclose(found, changed.inverse_kinematic_matrix, rtol=0, atol=1e-15)


def test_an_offset_turns_the_signals_of_its_wheel() -> None:
    geometry = WheelGeometry(TRICYCLE)
    vector = geometry.start.copy()
    vector[geometry.names.index("offset_front")] = 0.1
    measured, true = np.array([[0.3]]), np.array([[0.4]])
    found = geometry.matrices(vector[None])[0] @ TRICYCLE.drive.signals(np.array([[2.0]]), measured)[0]
    expected = TRICYCLE.inverse_kinematic_matrix @ TRICYCLE.drive.signals(np.array([[2.0]]), true)[0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)


def test_a_longer_wheelbase_turns_a_car_less() -> None:
    geometry = WheelGeometry(CAR)
    longer = geometry.matrices((geometry.start * [1.0, 1.25])[None])[0]
    np.testing.assert_allclose(longer, CAR.inverse_kinematic_matrix * [[1.0], [1.0], [0.8]], rtol=0, atol=1e-15)


# However a calibrator ends, its run is a row with an outcome and a reason.


def run(script: Callable[[CalibrationProblem], Any], **changes: Any) -> RunResult:
    return run_calibrator(Scripted(script), make_problem(RUNS, **changes))


def answering(vector: Callable[[CalibrationProblem], Any]) -> Callable[[CalibrationProblem], Solution]:
    return lambda problem: Solution(vector(problem), "done")


def for_ever(problem: CalibrationProblem) -> Solution:
    while True:
        problem.cost(problem.from_unit(problem.rng.uniform(size=(7, int(problem.free.sum())))))


def raising(error: BaseException) -> Callable[[CalibrationProblem], Solution]:
    def script(problem: CalibrationProblem) -> Solution:
        problem.cost(problem.start)
        raise error

    return script


def test_an_answer_by_the_calibrators_own_rule_has_converged() -> None:
    result = run(answering(lambda problem: problem.start * 1.01))
    assert (result.outcome, result.reason) == (Outcome.CONVERGED, "done")
    problem = make_problem(RUNS)
    assert result.cost == problem.values(result.vector[None])[0]
    np.testing.assert_array_equal(result.matrix, problem.matrix(result.vector))


def test_one_number_of_degrees_of_freedom_is_that_of_every_variance() -> None:
    result = run(lambda problem: Solution(problem.start, "done", covariance=np.eye(problem.size), degrees_of_freedom=7))
    np.testing.assert_array_equal(result.degrees_of_freedom, np.full(9, 7.0))


@pytest.mark.parametrize(
    ("freedom", "outcome"),
    [(np.ones(10), Outcome.FAILED), *((value, Outcome.INVALID) for value in (np.nan, 0.0, -3.0))],
)
def test_degrees_of_freedom_of_another_size_or_not_above_0_are_no_answer(freedom: Any, outcome: Outcome) -> None:
    result = run(lambda problem: Solution(problem.start, "done", degrees_of_freedom=freedom))
    assert (result.outcome, result.vector, result.degrees_of_freedom) == (outcome, None, None)
    assert "degrees_of_freedom" in result.reason or outcome is Outcome.FAILED


@pytest.mark.parametrize(
    ("limit", "outcome"), [({"evaluations": 40}, Outcome.BUDGET), ({"seconds": 0.05}, Outcome.TIME)]
)
def test_a_spent_budget_gives_the_best_candidate_so_far(limit: dict[str, Any], outcome: Outcome) -> None:
    result = run(for_ever, **limit)
    assert result.outcome is outcome
    assert "spent" in result.reason
    assert result.evaluations == 40 or 0.05 <= result.seconds < 5
    assert result.cost == pytest.approx(result.history[-1].cost, rel=1e-12)
    assert result.matrix is not None


@pytest.mark.parametrize("candidate", [np.nan, 1e-3])
def test_a_budget_spent_without_a_finite_cost_in_the_box_is_invalid(candidate: float) -> None:
    def outside(problem: CalibrationProblem) -> Solution:
        while True:
            problem.cost(np.tile(problem.upper + candidate, (5, 1)))

    result = run(outside, evaluations=20)
    assert (result.outcome, result.vector, result.cost) == (Outcome.INVALID, None, None)
    assert "no candidate" in result.reason


class NastyError(Exception):
    """An error whose own text raises."""

    def __str__(self) -> str:
        raise RuntimeError("not even this works")


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ConfigError("cannot be solved this way"), "cannot be solved this way"),
        (MemoryError(), "MemoryError"),
        (np.linalg.LinAlgError("singular"), "LinAlgError: singular"),
        (NastyError(), "NastyError"),
    ],
)
def test_whatever_a_calibrator_raises_its_run_has_failed_with_the_reason(error: BaseException, reason: str) -> None:
    result = run(raising(error))
    assert (result.outcome, result.reason) == (Outcome.FAILED, reason)
    assert (result.vector, result.matrix, result.cost) == (None, None, None)
    assert result.evaluations == 1


INVALID: dict[str, tuple[Callable[[CalibrationProblem], Any], str]] = {
    "infinity": (lambda _: np.full(9, np.inf), "NaN or infinity"),
    "one NaN": (lambda problem: np.append(problem.start[:8], np.nan), "NaN or infinity"),
    "too short": (lambda problem: problem.start[:8], "shape (8,)"),
    "a population": (lambda problem: problem.start[None], "shape (1, 9)"),
    "nothing": (lambda _: None, "shape ()"),
    "text": (lambda _: "none found", "not a vector of numbers"),
    "ragged": (lambda _: [[1.0], [1.0, 2.0]], "not a vector of numbers"),
    "outside": (lambda problem: problem.start + np.isin(problem.names, ["m21", "m33"]), "(m21, m33)"),
}


@pytest.mark.parametrize("case", INVALID)
def test_an_answer_that_is_no_calibration_is_invalid(case: str) -> None:
    answer, reason = INVALID[case]
    result = run(answering(answer))
    assert (result.outcome, result.vector, result.matrix, result.cost) == (Outcome.INVALID, None, None, None)
    assert reason in result.reason


def test_an_answer_in_a_box_without_width_must_match_it() -> None:
    result = run(answering(lambda problem: problem.start + 1e-9 * np.isin(problem.names, ["m12"])), box="paper")
    assert result.outcome is Outcome.INVALID
    assert "(m12)" in result.reason


class Unbounded(Scripted):
    bounded = False


def test_a_calibrator_without_bounds_may_answer_outside_the_box_but_not_with_a_matrix_of_zeros() -> None:
    beyond = run_calibrator(Unbounded(answering(lambda problem: problem.upper + 1e-3)), make_problem(RUNS))
    assert (beyond.outcome, beyond.at_bounds) == (Outcome.CONVERGED, ())
    zeros = run_calibrator(Unbounded(answering(lambda problem: 0 * problem.start)), make_problem(RUNS))
    assert zeros.outcome is Outcome.INVALID
    assert "zeros" in zeros.reason


def test_rounding_on_the_boxs_surface_is_forgiven_and_an_answer_on_a_bound_is_flagged() -> None:
    rounded = run(answering(lambda problem: problem.upper * (1 + 1e-15 * np.sign(problem.upper))))
    assert rounded.outcome is Outcome.CONVERGED
    result = run(answering(lambda problem: np.append(problem.start[:8], problem.lower[8])))
    assert result.at_bounds == ("m33",)


def test_an_answer_whose_cost_is_not_finite_is_invalid_and_a_cost_that_raises_fails_the_run() -> None:
    @costs.register("undefined")
    class Undefined(Cost):
        """NaN everywhere."""

        def combine(self, errors: Array, trajectory: Any) -> Array:  # noqa: ARG002
            return np.full(len(errors), np.nan)

    @costs.register("broken")
    class Broken(Cost):
        """Raises."""

        def combine(self, errors: Array, trajectory: Any) -> Array:  # noqa: ARG002
            raise RuntimeError("no cost today")

    result = run(answering(lambda problem: problem.start), cost="undefined")
    assert (result.outcome, result.cost) == (Outcome.INVALID, None)
    for script in (answering(lambda problem: problem.start), for_ever):
        result = run(script, cost="broken")
        assert (result.outcome, result.reason) == (Outcome.FAILED, "RuntimeError: no cost today")


@pytest.mark.parametrize("answer", [None, np.zeros(9), (1, 2)])
def test_something_else_than_a_solution_is_a_failure_that_says_what_it_was(answer: Any) -> None:
    result = run(lambda _: answer)
    assert result.outcome is Outcome.FAILED
    assert type(answer).__name__ in result.reason


def test_the_answer_is_a_copy() -> None:
    kept: list[Array] = []

    def script(problem: CalibrationProblem) -> Solution:
        kept.append(problem.start * 1.01)
        return Solution(kept[0], "done")

    result = run(script)
    before = kept[0].copy()
    kept[0][:] = 0.0
    np.testing.assert_array_equal(result.vector, before)


def test_a_reason_of_several_lines_becomes_one() -> None:
    assert run(lambda problem: Solution(problem.start, "first\nsecond")).reason == "first second"
