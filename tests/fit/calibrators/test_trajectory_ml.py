"""trajectory_ml finds the matrix from all reference poses, and start poses and clocks do not lead it astray."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fit_samples import make_problem, noisy_trajectories
from numpy.testing import assert_array_equal

from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.fit.calibrators.trajectory_ml import TrajectoryML, TrajectoryMLOptions
from omnibench.fit.parameterisation import MatrixElements
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.fit.trajectory_fit import TURN
from omnibench.registry import calibrators, costs
from omnibench.robot.kinematics import Array, published_matrix
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset

TRUTH = published_matrix("palacin2023_eq8")
ANGLES = (np.pi / 3, np.pi, 5 * np.pi / 3)


def flower(seed: int = 1, distance: float = 1.1, **noise: float) -> CalibrationProblem:
    """A small simulated flower of the APR-02 robot, as a problem."""
    wheels = [{"name": n, "radius": 0.148, "distance": 0.195, "angle": a} for n, a in zip("abc", ANGLES, strict=True)]
    config = FlowerConfig.model_validate(
        {
            "robot": {"name": "APR-02", "wheels": wheels},
            "sample_period": 0.05,
            "commands": {"directions_deg": [0, 90, 180, 270], "turn_rates": [-0.35, 0.0, 0.35]},
            "repetitions": 3,
            "truth": {"published": "palacin2023_eq8"},
            "noise": noise or {"pose_position": 0.005, "pose_heading": 0.005, "walk_position": 0.003},
            "train": {"seed": seed, "distance": distance},
        }
    )
    return problem_of(simulate_dataset(config).dataset.trajectories, config)


def problem_of(runs: tuple[Trajectory, ...], config: FlowerConfig) -> CalibrationProblem:
    return CalibrationProblem(
        config.robot,
        runs,
        costs.create("final_pose"),
        make_parameterisation("matrix", config.robot, runs, box="row"),
        integration="arc",
        budget=Budget(),
        seed=0,
    )


def changed(problem: CalibrationProblem, runs: list[Trajectory]) -> CalibrationProblem:
    """The same problem on other runs."""
    return CalibrationProblem(
        problem.robot,
        runs,
        problem.objective,
        problem.parameterisation,
        integration="arc",
        budget=Budget(),
        seed=0,
    )


def solved(problem: CalibrationProblem, **options: object) -> RunResult:
    result = run_calibrator(calibrators.create("trajectory_ml", options), problem)
    assert result.outcome is Outcome.CONVERGED, result.reason
    return result


def misses(result: RunResult) -> Array:
    """How far the elements (9,) are off the hidden matrix, in their own standard deviations."""
    assert result.matrix is not None
    assert result.covariance is not None
    found: Array = (result.matrix - TRUTH).ravel() / np.sqrt(np.diag(result.covariance))
    return found


def test_it_comes_closer_to_the_truth_than_final_poses_do() -> None:
    def mean_miss(name: str) -> float:
        found = [run_calibrator(calibrators.create(name), flower(seed)).matrix for seed in range(6)]
        return float(np.mean([np.square(matrix - TRUTH).sum() for matrix in found if matrix is not None]))

    assert mean_miss("trajectory_ml") < 0.8 * mean_miss("closed_form")


def test_its_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    inside = np.concatenate([np.abs(misses(solved(flower(seed)))) < 1.96 for seed in range(12)])
    # 108 intervals in 12 independent sets: three standard deviations of the mean, were each set's all alike.
    assert inside.mean() > 0.95 - 3 * np.sqrt(0.95 * 0.05 / 12)


def test_noise_and_covariance_come_with_the_answer() -> None:
    result = solved(flower(pose_position=0.006, pose_heading=0.004))
    assert result.noise is not None
    assert result.noise.pose_position == pytest.approx(0.006, rel=0.1)
    assert result.covariance is not None
    assert np.linalg.eigvalsh(result.covariance).min() > 0


@pytest.mark.parametrize("clock", ["offset", "offset_and_slope"])
def test_a_shifted_clock_of_the_reference_does_not_spoil_the_matrix(clock: str) -> None:
    problem = flower(distance=2.2, pose_position=0.001, pose_heading=0.001)
    rng = np.random.default_rng(5)
    runs = []
    for run in problem.trajectories:
        late = rng.normal(0, 0.1)
        moving = np.stack([np.interp(run.pose_times + late, run.pose_times, column) for column in run.poses.T], axis=1)
        runs.append(replace(run, poses=np.vstack([run.poses[:1], moving[1:]])))
    shifted = changed(problem, runs)
    without, with_clock = solved(shifted), solved(shifted, clock=clock)
    assert without.matrix is not None
    assert with_clock.matrix is not None
    assert np.abs(with_clock.matrix - TRUTH).max() < 0.7 * np.abs(without.matrix - TRUTH).max()


def test_start_poses_that_are_off_are_taken_for_nuisances() -> None:
    problem = flower()
    rng = np.random.default_rng(3)

    def with_start_off(run: Trajectory) -> Trajectory:
        poses = run.poses.copy()
        poses[0] += 0.03 * rng.standard_normal(3)
        return replace(run, poses=poses)

    runs = [with_start_off(run) for run in problem.trajectories]
    assert np.abs(misses(solved(changed(problem, runs)))).max() < 4


def test_how_far_start_headings_are_off_is_measured() -> None:
    problem = flower(pose_position=0.002, pose_heading=0.002)
    rng = np.random.default_rng(4)
    runs = []
    for run in problem.trajectories:
        poses = run.poses.copy()
        poses[0, 2] += 0.03 * rng.standard_normal()
        runs.append(replace(run, poses=poses))

    def start_heading(problem: CalibrationProblem) -> float:
        return float(TrajectoryML(TrajectoryMLOptions()).estimate(problem).nuisances.deviations[TURN])

    # Three standard deviations with 24 differences.
    assert start_heading(changed(problem, runs)) == pytest.approx(0.03, rel=0.45)
    assert start_heading(problem) < 0.003


def bent(problem: CalibrationProblem) -> CalibrationProblem:
    """The problem with references that no matrix explains: commands to the left and the right differ in length."""
    runs = []
    for run in problem.trajectories:
        assert run.alpha is not None
        poses = run.poses.copy()
        poses[:, :2] *= 1 + 0.05 * np.sin(3 * run.alpha + 1)
        runs.append(replace(run, poses=poses))
    return changed(problem, runs)


def test_where_no_matrix_fits_the_cost_weighs_and_the_intervals_are_those_of_the_scatter() -> None:
    problem = bent(flower())
    found, by_noise = solved(problem), solved(problem, weights="noise", covariance="model")
    assert "weighted by the cost" in found.reason
    assert "the noise model" in by_noise.reason
    assert found.cost is not None
    assert by_noise.cost is not None
    assert found.cost < by_noise.cost
    assert found.covariance is not None
    assert by_noise.covariance is not None
    assert np.trace(found.covariance) > 2 * np.trace(by_noise.covariance)


def test_where_a_matrix_fits_the_noise_weighs() -> None:
    assert "the noise model" in solved(flower()).reason


def test_poses_without_noise_that_the_model_explains_show_no_lack_of_fit() -> None:
    assert "the noise model" in solved(flower(pose_position=0.0)).reason


def test_intervals_of_the_scatter_can_be_asked_for() -> None:
    problem = flower()
    scatter, model = solved(problem, covariance="robust"), solved(problem)
    assert "the scatter between repetitions (36 runs of 12 commands)" in scatter.reason
    assert scatter.vector == pytest.approx(model.vector)
    assert scatter.covariance is not None
    assert model.covariance is not None
    # The same variances but for chance; each is known from 24 differences.
    ratios = np.diag(scatter.covariance) / np.diag(model.covariance)
    assert np.exp(np.abs(np.log(ratios)).max()) < 3


def test_without_repetitions_the_scatter_of_the_runs_states_the_intervals() -> None:
    problem = flower()
    once = changed(problem, [run for run in problem.trajectories if run.repetition == 1])
    asked, by_itself = solved(once, covariance="robust"), solved(once)
    assert by_itself.covariance is not None
    assert asked.covariance is not None
    assert_array_equal(by_itself.covariance, asked.covariance)
    assert "the scatter between 12 runs: no command is repeated" in by_itself.reason


def test_intervals_of_as_few_runs_as_the_numbers_take_are_wide() -> None:
    problem = flower()
    result = solved(changed(problem, [problem.trajectories[index] for index in (0, 15, 30)]))
    assert result.degrees_of_freedom is not None
    assert_array_equal(result.degrees_of_freedom, 1.0)


def test_a_covariance_of_the_noise_does_not_go_with_weights_of_the_cost() -> None:
    with pytest.raises(ConfigError, match="use robust"):
        calibrators.create("trajectory_ml", {"covariance": "model", "weights": "cost"})


def test_too_few_runs_for_their_scatter_are_refused_with_the_way_out() -> None:
    problem = flower()
    result = run_calibrator(
        calibrators.create("trajectory_ml", {"covariance": "robust"}), changed(problem, list(problem.trajectories[:3]))
    )
    assert result.outcome is Outcome.FAILED
    assert "too few runs for a covariance from their scatter; use covariance: model" in result.reason


def test_the_box_is_kept() -> None:
    problem = make_problem(box="paper")
    result = solved(problem)
    assert result.vector is not None
    assert problem.inside(result.vector[None])[0]


def test_directions_that_are_not_driven_keep_the_design() -> None:
    problem = make_problem(noisy_trajectories(4), wheels=4)
    result = solved(problem)
    assert result.matrix is not None
    assert isinstance(problem.parameterisation, MatrixElements)
    (null,) = problem.parameterisation.null
    assert np.abs((result.matrix - problem.robot.inverse_kinematic_matrix) @ null).max() < 1e-9


def test_an_unknown_clock_is_refused() -> None:
    with pytest.raises(Exception, match="clock"):
        calibrators.create("trajectory_ml", {"clock": "offse"})
