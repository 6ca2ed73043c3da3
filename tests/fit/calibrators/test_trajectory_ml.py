"""trajectory_ml finds the matrix from all reference poses, and start poses and clocks do not lead it astray."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from fit_samples import make_problem, noisy_trajectories
from numpy.testing import assert_array_equal

from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.fit.calibrators.trajectory_ml import TrajectoryML, TrajectoryMLOptions
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


def problem_of(runs: Sequence[Trajectory], config: FlowerConfig) -> CalibrationProblem:
    return CalibrationProblem(
        config.robot,
        runs,
        costs.create("final_pose"),
        make_parameterisation("matrix", config.robot, runs, box="row"),
        integration="arc",
        budget=Budget(),
        seed=0,
    )


def with_poses(problem: CalibrationProblem, change: Callable[[Trajectory], Array]) -> CalibrationProblem:
    """The problem with other reference poses."""
    return changed(problem, [replace(run, poses=change(run)) for run in problem.trajectories])


def changed(problem: CalibrationProblem, runs: list[Trajectory]) -> CalibrationProblem:
    """The same problem on other runs."""
    return CalibrationProblem(
        problem.robot, runs, problem.objective, problem.parameterisation, integration="arc", budget=Budget(), seed=0
    )


def solved(problem: CalibrationProblem, **options: object) -> RunResult:
    result = run_calibrator(calibrators.create("trajectory_ml", options), problem)
    assert result.outcome is Outcome.CONVERGED, result.reason
    return result


def misses(result: RunResult) -> Array:
    """How far the elements (9,) are off the hidden matrix, in their own standard deviations."""
    found: Array = (result.matrix - TRUTH).ravel() / np.sqrt(np.diag(result.covariance))
    return found


@pytest.mark.slow
def test_its_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    inside = np.concatenate([np.abs(misses(solved(flower(seed)))) < 1.96 for seed in range(12)])
    # 108 intervals in 12 independent sets: three standard deviations of the mean, were each set's all alike.
    assert inside.mean() > 0.95 - 3 * np.sqrt(0.95 * 0.05 / 12)


def test_noise_and_covariance_come_with_the_answer() -> None:
    result = solved(flower(pose_position=0.006, pose_heading=0.004))
    assert result.noise.pose_position == pytest.approx(0.006, rel=0.1)
    assert np.linalg.eigvalsh(result.covariance).min() > 0


@pytest.mark.parametrize("clock", ["offset", "offset_and_slope"])
def test_a_shifted_clock_of_the_reference_does_not_spoil_the_matrix(clock: str) -> None:
    problem = flower(distance=2.2, pose_position=0.001, pose_heading=0.001)
    rng = np.random.default_rng(5)

    def seen_late(run: Trajectory) -> Array:
        late = rng.normal(0, 0.1)
        moving = np.stack([np.interp(run.pose_times + late, run.pose_times, column) for column in run.poses.T], axis=1)
        return np.vstack([run.poses[:1], moving[1:]])

    shifted = with_poses(problem, seen_late)
    without, with_clock = solved(shifted), solved(shifted, clock=clock)
    assert np.abs(with_clock.matrix - TRUTH).max() < 0.7 * np.abs(without.matrix - TRUTH).max()


def with_starts_off(problem: CalibrationProblem, deviations: Sequence[float], seed: int) -> CalibrationProblem:
    rng = np.random.default_rng(seed)
    return with_poses(
        problem, lambda run: np.vstack([run.poses[0] + deviations * rng.standard_normal(3), run.poses[1:]])
    )


def test_start_poses_that_are_off_are_taken_for_nuisances() -> None:
    assert np.abs(misses(solved(with_starts_off(flower(), [0.03, 0.03, 0.03], 3)))).max() < 4


def test_how_far_start_headings_are_off_is_measured() -> None:
    problem = flower(pose_position=0.002, pose_heading=0.002)

    def start_heading(problem: CalibrationProblem) -> float:
        return float(TrajectoryML(TrajectoryMLOptions()).estimate(problem).nuisances.deviations[TURN])

    # Three standard deviations with 24 differences.
    assert start_heading(with_starts_off(problem, [0.0, 0.0, 0.03], 4)) == pytest.approx(0.03, rel=0.45)
    assert start_heading(problem) < 0.003


def bent(problem: CalibrationProblem) -> CalibrationProblem:
    """The problem with references that no matrix explains: commands to the left and the right differ in length."""
    return with_poses(problem, lambda run: run.poses * ([1 + 0.05 * np.sin(3 * run.alpha + 1)] * 2 + [1.0]))


def test_where_no_matrix_fits_the_cost_weighs_and_the_intervals_are_those_of_the_scatter() -> None:
    problem = bent(flower())
    found, by_noise = solved(problem), solved(problem, weights="noise", covariance="model")
    assert "weighted by the cost" in found.reason
    assert "the noise model" in by_noise.reason
    assert found.cost < by_noise.cost
    assert np.trace(found.covariance) > 2 * np.trace(by_noise.covariance)


@pytest.mark.parametrize("noise", [{}, {"pose_position": 0.0}])
def test_where_a_matrix_fits_the_noise_weighs(noise: dict[str, float]) -> None:
    assert "the noise model" in solved(flower(**noise)).reason


def test_intervals_of_the_scatter_can_be_asked_for() -> None:
    problem = flower()
    scatter, model = solved(problem, covariance="robust"), solved(problem)
    assert "36 runs of 12 commands" in scatter.reason
    assert scatter.vector == pytest.approx(model.vector)
    # The same variances but for chance; each is known from 24 differences.
    ratios = np.diag(scatter.covariance) / np.diag(model.covariance)
    assert np.exp(np.abs(np.log(ratios)).max()) < 3


def test_without_repetitions_the_scatter_of_the_runs_states_the_intervals() -> None:
    problem = flower()
    once = changed(problem, [run for run in problem.trajectories if run.repetition == 1])
    asked, by_itself = solved(once, covariance="robust"), solved(once)
    assert_array_equal(by_itself.covariance, asked.covariance)
    assert "12 runs: no command is repeated" in by_itself.reason


def test_intervals_of_as_few_runs_as_the_numbers_take_are_wide_or_refused() -> None:
    problem = flower()
    result = solved(changed(problem, [problem.trajectories[index] for index in (0, 15, 30)]))
    assert_array_equal(result.degrees_of_freedom, 1.0)
    one_command = changed(problem, problem.trajectories[:3])
    refused = run_calibrator(calibrators.create("trajectory_ml", {"covariance": "robust"}), one_command)
    assert refused.outcome is Outcome.FAILED
    assert "use covariance: model" in refused.reason


@pytest.mark.parametrize(
    ("options", "named"), [({"covariance": "model", "weights": "cost"}, "robust"), ({"clock": "offse"}, "clock")]
)
def test_options_that_do_not_go_together_or_are_unknown_are_refused(options: dict[str, str], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        calibrators.create("trajectory_ml", options)


def test_the_box_and_the_design_along_directions_that_are_not_driven_are_kept() -> None:
    boxed = make_problem(box="paper")
    assert boxed.inside(solved(boxed).vector[None])[0]
    problem = make_problem(noisy_trajectories(4), wheels=4)
    (null,) = problem.parameterisation.null
    assert np.abs((solved(problem).matrix - problem.robot.inverse_kinematic_matrix) @ null).max() < 1e-9
