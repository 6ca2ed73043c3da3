"""The calibration problem: what it counts, keeps and shows, and what nobody can see through it."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from dataclasses import replace
from types import BuiltinFunctionType, FunctionType, MethodDescriptorType, ModuleType
from typing import Any

import numpy as np
import pytest
from fit_samples import box_between, make_problem, noisy_trajectories
from hypothesis import given
from hypothesis import strategies as st

from omnibench.data.dataset import Trajectory, make_dataset
from omnibench.errors import DataError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.geometry import GeometryLimits
from omnibench.fit.problem import BudgetSpent, CalibrationProblem
from omnibench.progress import Progress
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array
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


def test_candidates_that_are_nan_cost_nan_and_are_never_the_best() -> None:
    problem = make_problem()
    assert np.isnan(problem.cost(np.full((2, 9), np.nan))).all()
    assert problem.best_cost == np.inf
    np.testing.assert_array_equal(problem.best_vector, problem.start)


def test_a_candidate_outside_the_box_costs_but_is_never_the_best() -> None:
    problem = make_problem(box="paper")
    outside = problem.start.copy()
    outside[0] = problem.lower[0] - 1e-6
    assert np.isfinite(problem.cost(outside)[0])
    assert problem.best_cost == np.inf


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


def test_the_seed_decides_the_random_numbers() -> None:
    draws = [make_problem(RUNS, seed=seed).rng.random(3).tolist() for seed in (4, 4, 5)]
    assert draws[0] == draws[1] != draws[2]


def test_progress_is_shown_while_candidates_are_evaluated() -> None:
    shown: list[Progress] = []
    problem = make_problem(evaluations=50_000, watch=shown.append)
    while not shown:
        problem.cost(problem.start)
    assert shown[0] == Progress("search", problem.evaluations, 50_000, "evaluation", problem.best_cost)


@pytest.mark.parametrize("name", ["start", "lower", "upper", "free", "reference", "best_vector"])
@pytest.mark.parametrize("evaluated", [0, 4])
def test_what_a_calibrator_is_given_cannot_be_overwritten(name: str, evaluated: int) -> None:
    problem = make_problem(RUNS)
    problem.cost(population(problem, evaluated))
    assert (problem.best_cost < np.inf) == (evaluated > 0)
    with pytest.raises(ValueError, match="read-only"):
        getattr(problem, name)[0] = 0


class TestUnitCube:
    """Searches work in the unit cube of the elements that are free."""

    def test_its_corners_are_the_box_and_what_is_outside_comes_to_its_surface(self) -> None:
        problem = make_problem(RUNS)
        np.testing.assert_allclose(problem.from_unit(np.zeros(9))[0], problem.lower, rtol=1e-15)
        np.testing.assert_allclose(problem.from_unit(np.ones(9))[0], problem.upper, rtol=1e-15)
        np.testing.assert_array_equal(problem.to_unit(problem.upper + 1.0)[0], np.ones(9))

    @given(seed=st.integers(0, 2**16), box=st.sampled_from(["row", "paper"]))
    def test_points_come_back(self, seed: int, box: Any) -> None:
        problem = make_problem(RUNS, box=box)
        points = np.random.default_rng(seed).uniform(size=(5, int(problem.free.sum())))
        np.testing.assert_allclose(problem.to_unit(problem.from_unit(points)), points, atol=1e-13)

    @given(points=st.lists(st.floats(-1e3, 1e3), min_size=9, max_size=9))
    def test_it_never_leads_outside_the_box(self, points: list[float]) -> None:
        problem = make_problem(RUNS)
        vectors = problem.from_unit(np.array(points))
        assert ((vectors >= problem.lower) & (vectors <= problem.upper)).all()

    def test_frozen_elements_keep_their_start(self) -> None:
        problem = make_problem(box="paper")
        frozen = np.flatnonzero(~problem.free)
        assert problem.names[frozen[0]] == "m12"
        assert len(frozen) == 1
        vectors = problem.from_unit(np.random.default_rng(0).uniform(size=(4, 8)))
        np.testing.assert_array_equal(vectors[:, frozen], np.tile(problem.start[frozen], (4, 1)))

    def test_a_box_without_any_width_has_one_point(self) -> None:
        design = synthetic_robot().inverse_kinematic_matrix
        problem = make_problem(box=box_between(design, design))
        np.testing.assert_array_equal(problem.from_unit(np.zeros((2, 0))), [problem.start, problem.start])


class TestBox:
    """Inside, and on the surface."""

    def test_its_corners_are_inside_and_rounding_is_forgiven_and_no_more(self) -> None:
        problem = make_problem(RUNS)
        assert problem.inside(np.array([problem.lower, problem.upper, problem.start])).all()
        assert problem.inside(problem.upper * (1 + 1e-14 * np.sign(problem.upper)))
        beyond = problem.upper.copy()
        beyond[4] += 1e-9
        outside = [beyond, np.full(9, np.nan), np.full(9, np.inf)]
        assert not problem.inside(np.array(outside)).any()

    def test_elements_on_a_bound_are_named_but_not_frozen_ones(self) -> None:
        problem = make_problem(RUNS)
        vector = problem.start.copy()
        vector[[1, 8]] = problem.upper[1], problem.lower[8]
        assert problem.at_bounds(vector) == ("m12", "m33")
        frozen = make_problem(RUNS, box="paper")
        assert frozen.at_bounds(frozen.start) == ()


def test_limits_of_the_geometry_are_its_box() -> None:
    problem = make_problem(RUNS, parameterisation="geometry", limits=GeometryLimits(angle_deg=0.0))
    frozen = [name for name, free in zip(problem.names, problem.free, strict=True) if not free]
    assert (problem.box, frozen) == ("limits", ["angle_a", "angle_b", "angle_c"])


def test_no_trajectories_are_refused() -> None:
    with pytest.raises(DataError, match="no trajectories"):
        make_problem(())


# What a module, class or function drags along is the program, not the problem's data.
_PROGRAM = (ModuleType, type, FunctionType, BuiltinFunctionType, MethodDescriptorType)


def reachable(root: object) -> Iterator[object]:
    """Every object that attributes, items, closures and array bases lead to."""
    seen: set[int] = set()
    waiting: list[object] = [root]
    while waiting:
        item = waiting.pop()
        if id(item) in seen:
            continue
        seen.add(id(item))
        yield item
        if isinstance(item, np.ndarray):
            waiting.append(item.base)
        if isinstance(item, FunctionType):
            waiting += [cell.cell_contents for cell in item.__closure__ or ()]
        elif not isinstance(item, _PROGRAM):
            waiting += gc.get_referents(item)


def arrays_of(runs: tuple[Trajectory, ...]) -> list[Array]:
    return [array for run in runs for array in (run.rates, run.poses, run.angles, run.targets) if array is not None]


def holds(owner: Array, array: Array) -> bool:
    """Whether the numbers of ``array`` lie somewhere in ``owner``."""
    if owner.dtype != array.dtype or owner.size < array.size:
        return False
    return np.ascontiguousarray(array).tobytes() in np.ascontiguousarray(owner).tobytes()


class TestValidationData:
    """A calibrator cannot see the validation data, whatever it follows from its problem."""

    @pytest.fixture
    def seen(self) -> tuple[CalibrationProblem, tuple[Trajectory, ...], tuple[Trajectory, ...]]:
        """The problem that a calibrator was given, and the runs of both splits."""
        problems: list[CalibrationProblem] = []

        @calibrators.register("spy")
        class Spy(Calibrator):
            """Keeps its problem."""

            def calibrate(self, problem: CalibrationProblem) -> Solution:
                problems.append(problem)
                problem.cost(problem.start)
                return Solution(problem.start, "seen enough")

        train = noisy_trajectories(seed=1)
        held_out = [replace(run, id=f"v{run.id}", split="validation") for run in noisy_trajectories(seed=2)]
        runs = [
            replace(run, rates=run.rates + 1e-6 * index, angles=np.cumsum(run.rates, axis=0) + index)
            for index, run in enumerate((*train, *held_out))
        ]
        dataset = make_dataset("both", synthetic_robot(), 0.2, runs)
        calibrate(dataset, "spy")
        return problems[0], dataset.split("train"), dataset.split("validation")

    def test_training_runs_are_reachable_and_no_array_of_a_validation_run_is(self, seen: Any) -> None:
        problem, training, validation = seen
        items = list(reachable(problem))
        arrays = [item for item in items if isinstance(item, np.ndarray)]
        for hidden in arrays_of(validation):
            assert not any(np.shares_memory(array, hidden) or holds(array, hidden) for array in arrays)
        for shown in arrays_of(training):
            assert any(holds(array, shown) for array in arrays)
        assert {run.id for run in items if isinstance(run, Trajectory)} == {run.id for run in training}


def test_elements_that_the_cost_does_not_see_keep_their_start_values() -> None:
    dataset = make_dataset("synthetic", synthetic_robot(3), 0.2, noisy_trajectories())
    run = calibrate(dataset, "genetic", cost="final_heading", options={"generations": 30})
    design = dataset.robot.inverse_kinematic_matrix
    assert run.result.held == ("m11", "m12", "m13", "m21", "m22", "m23")
    assert np.array_equal(run.calibration.matrix_array[:2], design[:2])
    assert not np.array_equal(run.calibration.matrix_array[2], design[2])
