"""What is certified holds for every matrix of the box, however it is searched and whenever the proof is stopped."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import numpy as np
import pytest
from commands import CONFIGS
from fit_samples import box_between, make_problem, noisy_trajectories
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from scipy.optimize import minimize

from omnibench.cli.terminal.calibration_tables import print_certificate
from omnibench.compare.config import read_compare_config
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.certify import LowerBounds, certify_optimum, prove
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.parameterisation import Box
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.sum_of_norms import SumOfNormsProgram
from omnibench.progress import Progress
from omnibench.registry import Options, calibrators
from omnibench.robot.calibration import Calibration, EffectTerm, matrix_rows
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration
from omnibench.testing.synthetic import PERIOD, synthetic_dataset, synthetic_robot, synthetic_trajectories, true_robot

COSTS = ("final_pose", "final_position", "final_heading", "trajectory")


def random_box(wheels: int, rng: np.random.Generator) -> Box:
    """A box about the design, of random widths, some of them none."""
    matrix = synthetic_robot(4 if wheels == 4 else 3).inverse_kinematic_matrix
    size = np.abs(matrix).max(axis=1, keepdims=True)
    below, above = (rng.uniform(0, 0.3, matrix.shape) * size * (rng.random(matrix.shape) > 0.15) for _ in range(2))
    return box_between(matrix - below, matrix + above)


def random_problem(seed: int, cost: str, integration: Integration, wheels: int) -> CalibrationProblem:
    """Few noisy runs, some of them alone, in a random box."""
    rng = np.random.default_rng(seed)
    runs = noisy_trajectories(
        4 if wheels == 4 else 3, noise=float(10 ** rng.uniform(-4, -1)), seed=seed, integration=integration
    )
    chosen = rng.permutation(len(runs))[: rng.integers(1, 8)]
    return make_problem(
        [runs[index] for index in chosen],
        wheels=4 if wheels == 4 else 3,
        cost=cost,
        integration=integration,
        box=random_box(wheels, rng),
        evaluations=10**6,
    )


def best_found(problem: CalibrationProblem, rng: np.random.Generator) -> float:
    """The lowest cost that random search, the exact minimiser and a local search find: what a bound must stay below."""
    free = int(problem.free.sum())
    candidates = [problem.from_unit(rng.uniform(size=(500, free))), problem.start[None]]
    truth = true_robot(problem.robot).inverse_kinematic_matrix.ravel()
    candidates.append(np.clip(truth, problem.lower, problem.upper)[None])
    exact = calibrators.create("closed_form").calibrate(problem).vector
    candidates.append(exact[None])
    if free:
        near = minimize(
            lambda point: float(problem.values(problem.from_unit(point))[0]),
            problem.to_unit(exact)[0],
            method="Nelder-Mead",
            options={"maxfev": 200},
            bounds=[(0, 1)] * free,
        )
        candidates.append(problem.from_unit(near.x))
    return float(problem.values(np.concatenate(candidates)).min())


@settings(max_examples=24, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    cost=st.sampled_from(COSTS),
    integration=st.sampled_from(["euler", "arc"]),
    wheels=st.sampled_from([3, 4]),
    stopped=st.booleans(),
)
def test_no_matrix_of_the_box_costs_less_than_the_bound(
    seed: int, cost: str, integration: Integration, wheels: int, stopped: bool
) -> None:
    problem = random_problem(seed, cost, integration, wheels)
    proof = prove(problem, problem.start, gap=1e-2, seconds=np.inf, parts=1 if stopped else 15)
    assert 0 <= proof.lower_bound <= best_found(problem, np.random.default_rng(seed))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), cost=st.sampled_from(COSTS), integration=st.sampled_from(["euler", "arc"]))
def test_each_part_of_the_box_bounds_the_matrices_in_it(seed: int, cost: str, integration: Integration) -> None:
    problem = random_problem(seed, cost, integration, 3)
    bounds = LowerBounds(problem)
    rng = np.random.default_rng(seed)
    part = bounds.root(problem.start)
    for _ in range(12):
        deviations = rng.uniform(part.lower, part.upper, size=(200, *part.lower.shape))
        vectors = np.array([bounds.vector(one) for one in deviations])
        assert part.bound <= problem.values(vectors).min()
        part = bounds.split(part)[int(rng.integers(2))]


def one_free_element(cost: str) -> tuple[CalibrationProblem, int]:
    """A problem with one free element of row 3 and all of rows 1 and 2, and that element's place."""
    robot = synthetic_robot()
    lower, upper = (robot.inverse_kinematic_matrix * factor for factor in (1.0, 1.0))
    lower[:2] -= 0.02
    upper[:2] += 0.02
    lower[2, 1] -= 0.05
    upper[2, 1] += 0.05
    return make_problem(noisy_trajectories(noise=0.03), cost=cost, box=box_between(lower, upper)), 7


@pytest.mark.parametrize("cost", ["final_pose", "final_position", "trajectory"])
def test_the_bound_is_close_below_the_least_cost_of_a_dense_search(cost: str) -> None:
    problem, place = one_free_element(cost)
    values = np.linspace(problem.lower[place], problem.upper[place], 41)
    least = min(least_cost_of_the_rest(problem, place, value) for value in values)
    proof = prove(problem, problem.start, gap=1e-3, seconds=np.inf, parts=2000)
    assert proof.finished
    assert 0.995 * least <= proof.lower_bound <= least


def least_cost_of_the_rest(problem: CalibrationProblem, place: int, value: float) -> float:
    """The least cost with one element of row 3 at a value: a cone program, as poses are linear in rows 1 and 2."""
    objective = problem.objective
    assert isinstance(objective, SumOfNorms)
    vector = problem.start.copy()
    vector[place] = value
    weights, rows_12 = np.array(objective.weights), slice(0, 6)
    errors = (problem.odometry.poses(problem.matrix(vector)[None])[0] - problem.reference) * weights
    slopes = (problem.odometry.jacobian(problem.matrix(vector)) * weights[:, None, None]).reshape(len(errors), 3, -1)
    step = (problem.lower - vector)[rows_12], (problem.upper - vector)[rows_12]
    program = SumOfNormsProgram(errors, slopes[:, :, rows_12], *step)
    vector[rows_12] += program.step(objective.shares(problem.odometry.trajectory))
    return float(problem.values(vector[None])[0])


@pytest.fixture(scope="module")
def flower() -> Dataset:
    config = read_compare_config(CONFIGS / "apr02.yaml")
    ((name, source),) = config.datasets.items()
    return source.load(name)


@pytest.mark.parametrize("box", ["paper", "row"])
def test_on_the_papers_flower_closed_form_is_proven_to_a_tenth_of_a_per_cent(flower: Dataset, box: Box) -> None:
    found = calibrate(flower, box=box, integration="euler").calibration
    certified = certify_optimum(found, flower, box=box, seconds=np.inf, parts=2000)
    assert certified.proof.finished
    assert certified.inside
    assert 0 <= certified.certificate.gap <= 1e-3
    assert certified.certificate.box == box


def test_the_design_values_are_told_how_much_could_be_gained(flower: Dataset) -> None:
    certified = certify_optimum(design_of(flower), flower, gap=0.05, seconds=np.inf, parts=2000)
    assert 0.80 < certified.certificate.gap < 0.86  # the paper's 82 %


def design_of(dataset: Dataset, integration: Integration = "euler") -> Calibration:
    robot = dataset.robot
    return Calibration(
        name="design",
        robot=robot,
        sample_period=dataset.sample_period,
        matrix=matrix_rows(robot.inverse_kinematic_matrix),
        integration=integration,
    )


def test_a_wider_box_is_never_bounded_higher() -> None:
    runs = noisy_trajectories(noise=0.02)
    narrow, wide = make_problem(runs, box="paper"), make_problem(runs, box="row")
    proofs = [prove(problem, problem.start, gap=2e-2, seconds=np.inf, parts=2000) for problem in (narrow, wide)]
    assert proofs[1].lower_bound <= proofs[0].best_cost
    assert all(proof.finished for proof in proofs)


def test_a_box_without_width_is_bounded_by_its_only_cost() -> None:
    matrix = synthetic_robot().inverse_kinematic_matrix
    problem = make_problem(box=box_between(matrix, matrix))
    proof = prove(problem, problem.start)
    cost = float(problem.values(problem.start[None])[0])
    assert proof.finished
    assert cost - 2e-9 <= proof.lower_bound <= cost  # arcs are summed to 1e-9 m


def test_a_better_matrix_than_the_given_one_is_found_on_the_way() -> None:
    problem = make_problem()
    proof = prove(problem, problem.start, gap=1e-3, seconds=np.inf, parts=2000)
    exact = calibrators.create("closed_form").calibrate(problem).vector
    assert proof.best_cost <= problem.values(exact[None])[0] * 1.001


def test_a_proof_that_is_stopped_says_so_and_still_holds() -> None:
    problem = make_problem(noisy_trajectories(noise=0.02))
    proof = prove(problem, problem.start, gap=1e-9, seconds=np.inf, parts=3)
    exact = calibrators.create("closed_form").calibrate(problem).vector
    assert not proof.finished
    assert proof.lower_bound <= problem.values(exact[None])[0]


def test_the_proof_tells_how_it_gets_on() -> None:
    seen: list[Progress] = []
    problem = make_problem()
    proof = prove(problem, problem.start, gap=1e-2, seconds=np.inf, parts=2000, watch=seen.append)
    assert len(seen) > 3
    assert [event.done for event in seen] == sorted(event.done for event in seen)
    bounds = [float(event.note.removeprefix("bound ")) for event in seen]
    assert bounds == sorted(bounds)
    assert (seen[-1].done, seen[-1].best, bounds[-1]) == (proof.boxes, proof.best_cost, round(proof.lower_bound, 6))


def test_about_how_long_a_proof_takes_is_said_after_its_first_parts() -> None:
    seen: list[Progress] = []
    dataset = synthetic_dataset()
    certified = certify_optimum(
        design_of(dataset, "arc"), dataset, gap=0.01, seconds=1e9, parts=2000, watch=seen.append
    )
    (place,) = [index for index, event in enumerate(seen) if event.task == "duration"]
    assert seen[place - 1].done == 3
    words = seen[place].result
    assert words is not None
    assert words.startswith("a proof to within 0.01 of the cost takes about ")
    fewest, most = (float(number) for number in re.search(r"(\d+) to (\d+) parts", words).groups())
    assert fewest <= certified.proof.boxes <= most
    assert words.endswith("it ends after 1e+09 s or 2000 parts at the latest")


def test_a_proof_without_a_gap_goes_on_to_its_limit_and_foretells_nothing() -> None:
    seen: list[Progress] = []
    dataset = make_dataset("noisy", synthetic_robot(), PERIOD, list(noisy_trajectories()), simulated=True)
    certified = certify_optimum(calibrate(dataset).calibration, dataset, gap=0.0, parts=20, watch=seen.append)
    assert 20 <= certified.proof.boxes <= 21
    assert [event for event in seen if event.task == "duration"] == []


def test_where_nothing_is_left_but_rounding_there_is_nothing_to_gain() -> None:
    runs = synthetic_trajectories(synthetic_robot(), "arc")[:2]
    dataset = make_dataset("exact", synthetic_robot(), 0.2, runs, simulated=True)
    run = calibrate(dataset)
    assert run.result.cost < 1e-9
    certified = certify_optimum(run.calibration, dataset, parts=5)
    assert certified.certificate.gap == 0.0
    console = Console(file=io.StringIO(), width=120)
    print_certificate(console, certified)
    told = console.file.getvalue()
    assert "There is nothing to gain: what is left is rounding" in told
    assert "to gain on this calibration" not in told


def test_a_calibration_outside_the_box_is_said_to_be_outside() -> None:
    dataset = synthetic_dataset()
    outside = design_of(dataset, "arc").model_copy(
        update={"matrix": matrix_rows(1.5 * dataset.robot.inverse_kinematic_matrix)}
    )
    assert not certify_optimum(outside, dataset, parts=1).inside


class Worst(Cost):
    """The largest error."""

    name = "worst"

    def combine(self, errors: Array, trajectory: Array) -> Array:  # noqa: ARG002
        return np.asarray(np.linalg.norm(errors, axis=-1).max(axis=-1))


def test_a_cost_that_is_no_sum_of_norms_is_refused() -> None:
    problem = make_problem()
    problem.objective = Worst(Options())
    with pytest.raises(ConfigError, match="sum of norms"):
        LowerBounds(problem)


def test_a_wheel_geometry_is_refused() -> None:
    with pytest.raises(ConfigError, match="matrix parameterisation"):
        LowerBounds(make_problem(parameterisation="geometry"))


def test_other_wheels_are_refused() -> None:
    with pytest.raises(DataError, match="wheels fl, fr, rl, rr"):
        certify_optimum(design_of(synthetic_dataset(4), "arc"), synthetic_dataset())


def test_a_calibration_with_effects_is_refused_as_a_bound_is_of_matrices() -> None:
    dataset, drift = synthetic_dataset(), EffectTerm(name="heading_drift", parameters={"b": 0.001})
    extended = design_of(dataset, "arc").model_copy(update={"effects": (drift,)})
    with pytest.raises(DataError, match=r"'design' has effects \(heading_drift\), and a bound is proven for a matrix"):
        certify_optimum(extended, dataset)


def test_recordings_without_a_training_split_are_refused() -> None:
    runs: list[Trajectory] = [replace(run, split="validation") for run in noisy_trajectories()]
    dataset = make_dataset("none", synthetic_robot(), PERIOD, runs)
    with pytest.raises(DataError, match="training split is empty"):
        certify_optimum(design_of(dataset, "arc"), dataset)
