"""How sure a calibration is: covariance of the elements and of the geometry behind them, and resampled intervals."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import bootstrap_coverage
import numpy as np
import pytest
import uncertainty_coverage
from fit_samples import make_problem
from hypothesis import given
from hypothesis import strategies as st
from motions import FLOWER, RING, driven

from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError, DataError
from omnibench.fit.bootstrap import bootstrap_intervals
from omnibench.fit.calibrator import RunResult, run_calibrator
from omnibench.fit.calibrators.closed_form import cone_program
from omnibench.fit.geometry import WheelGeometry
from omnibench.fit.identifiability import geometry_of
from omnibench.fit.information import information_of_run, information_of_runs
from omnibench.fit.parameterisation import ExplicitBox
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.fit.uncertainty import NoCovarianceError, Uncertainty, uncertainty_of
from omnibench.registry import calibrators, costs
from omnibench.robot.calibration import Noise, matrix_rows
from omnibench.robot.kinematics import Array, inverse_kinematic_matrices
from omnibench.robot.odometry import OdometryBatch
from omnibench.simulate.simulate import simulate_dataset
from omnibench.simulate.source import read_simulation
from omnibench.testing.synthetic import synthetic_robot, true_robot

ROBOT = synthetic_robot()
TRUTH = true_robot(ROBOT).inverse_kinematic_matrix
NOISE = Noise(pose_position=0.004, pose_heading=0.006, walk_position=0.002, bias_heading=0.003)


def solved(problem: CalibrationProblem, calibrator: str = "closed_form") -> RunResult:
    result = run_calibrator(calibrators.create(calibrator), problem)
    assert result.vector is not None, result.reason
    return result


def found(runs: list[Trajectory], **changes: str) -> Uncertainty:
    problem = make_problem(runs, **changes)
    return uncertainty_of(problem, solved(problem))


@cache
def flower_problem(repetitions: int | None = None) -> tuple[CalibrationProblem, RunResult]:
    """The flower of the paper's comparison in a box that holds its truth, and its optimum."""
    flower = read_simulation(uncertainty_coverage.CONFIG).config
    changes = {"validation": None} | ({} if repetitions is None else {"repetitions": repetitions})
    dataset = simulate_dataset(flower.model_copy(update=changes)).dataset
    problem = CalibrationProblem(
        dataset.robot,
        dataset.split("train"),
        costs.create("final_pose"),
        make_parameterisation("matrix", dataset.robot, dataset.split("train"), box="row"),
        integration="euler",
        budget=Budget(),
        seed=1,
    )
    return problem, solved(problem)


def shares(uncertainty: Uncertainty) -> Array:
    """Standard deviations (3, N) as a share of the row's largest element."""
    return uncertainty.standard_deviations / np.abs(ROBOT.inverse_kinematic_matrix).max(axis=1, keepdims=True)


class TestInformation:
    """Fisher information of the elements."""

    @pytest.mark.parametrize("stamps", ["reference", "final"])
    def test_it_is_that_of_the_residuals_covariance(self, stamps: str) -> None:
        run = driven(FLOWER[:1], repetitions=1)[0]
        log = run.final_log if stamps == "final" else run.reference_log
        jacobian = OdometryBatch([log], "arc").jacobian(TRUTH).reshape(len(log.stamps), 3, 9)
        steps = np.minimum.outer(log.stamps, log.stamps)
        position = 0.004**2 * np.eye(len(steps)) + 0.002**2 * steps
        heading = 0.006**2 * np.eye(len(steps)) + 0.003**2
        expected = sum(
            jacobian[:, row].T @ np.linalg.solve(covariance, jacobian[:, row])
            for row, covariance in enumerate((position, position, heading))
        )
        information = information_of_run(run, TRUTH, "arc", NOISE, stamps=stamps)
        np.testing.assert_allclose(information, expected, rtol=1e-9, atol=1e-6)

    def test_that_of_many_runs_is_each_one_s_and_needs_no_recording(self) -> None:
        runs = driven(FLOWER[:3], repetitions=1)
        each = information_of_runs(runs, TRUTH, "arc", NOISE)
        assert each.shape == (3, 9, 9)
        for source in (runs[1], runs[1].reference_log):
            np.testing.assert_array_equal(each[1], information_of_run(source, TRUTH, "arc", NOISE))
        assert information_of_runs([], TRUTH, "arc", NOISE).shape == (0, 9, 9)


class TestCovariance:
    """The sandwich of a sum of norms."""

    @pytest.mark.slow
    def test_it_agrees_with_the_bootstrap_on_the_flower(self) -> None:
        problem, result = flower_problem()
        said = uncertainty_of(problem, result).standard_deviations
        intervals = bootstrap_intervals(problem, result.vector, resamples=150, rng=np.random.default_rng(0))
        drawn = (intervals.high - intervals.low) / (2 * 1.96)
        # Of 150 resamples a 95 % range is uncertain by 8 %; of 180 runs each estimate by as much again.
        np.testing.assert_allclose(said / drawn, 1, atol=0.2)
        assert np.mean(said / drawn) == pytest.approx(1, abs=0.1)

    @pytest.mark.slow
    def test_about_95_percent_of_the_intervals_hold_the_hidden_robot(self) -> None:
        covered = [uncertainty_coverage.covered(seed, repetitions=2) for seed in range(4)]
        hits = np.array([np.concatenate([each.elements, each.parameters]) for each in covered])
        # 36 intervals of elements: 95 % of them leaves fewer than 29 inside with a probability of about 3e-4.
        assert hits[:, :9].sum() >= 29
        assert hits[:, 9:].sum() >= 29

    @pytest.mark.parametrize("cost", ["final_pose", "final_position", "trajectory"])
    def test_every_cost_that_is_a_sum_of_norms_has_one(self, cost: str) -> None:
        deviations = shares(found(driven(FLOWER), cost=cost))
        assert (deviations > 1e-5).all()
        assert (deviations < 0.02).all()

    def test_a_cost_of_headings_says_nothing_of_rows_1_and_2(self) -> None:
        uncertainty = found(driven(FLOWER), cost="final_heading")
        assert not uncertainty.covariance[:6].any()
        assert (uncertainty.standard_deviations[2] > 0).all()

    def test_an_element_that_the_box_holds_has_no_variance_and_no_interval(self) -> None:
        problem = make_problem(driven(FLOWER), box="paper")
        result = solved(problem)
        uncertainty = uncertainty_of(problem, result)
        assert uncertainty.standard_deviations[0, 1] == 0
        assert np.count_nonzero(uncertainty.standard_deviations) == 8
        drawn = bootstrap_intervals(problem, result.vector, resamples=60, rng=np.random.default_rng(1))
        for intervals in (uncertainty.intervals, drawn):
            assert np.argwhere(np.isnan(intervals.low)).tolist() == [[0, 1]]

    def test_what_depends_on_an_element_on_a_bound_has_no_interval(self) -> None:
        truth, wide = TRUTH[1, 2], np.abs(ROBOT.inverse_kinematic_matrix)
        lower, upper = ROBOT.inverse_kinematic_matrix - wide - 0.1, ROBOT.inverse_kinematic_matrix + wide + 0.1
        design = ROBOT.inverse_kinematic_matrix[1, 2]
        (upper if truth > design else lower)[1, 2] = (truth + design) / 2
        box = ExplicitBox(lower=matrix_rows(lower), upper=matrix_rows(upper))
        problem = make_problem(driven(FLOWER), box=box)
        result = solved(problem)
        assert result.at_bounds == ("m23",)
        drawn = bootstrap_intervals(problem, result.vector, resamples=60, rng=np.random.default_rng(1))
        uncertainty = uncertainty_of(problem, result)
        for intervals in (uncertainty.intervals, drawn):
            assert np.argwhere(np.isnan(intervals.low)).tolist() == [[1, 2]]
            assert np.argwhere(np.isnan(intervals.high)).tolist() == [[1, 2]]
        told = {each.untold for each in uncertainty.parameters}
        assert told == {"no interval"}

    def test_resamples_that_a_bound_stops_have_no_interval(self) -> None:
        free = solved(make_problem(driven(FLOWER)))
        wide = np.abs(ROBOT.inverse_kinematic_matrix).max() + np.zeros((3, 3))
        lower, upper = free.matrix - wide, free.matrix + wide
        above = free.matrix[0, 0] > ROBOT.inverse_kinematic_matrix[0, 0]
        (upper if above else lower)[0, 0] = free.matrix[0, 0] + (1e-5 if above else -1e-5)
        problem = make_problem(driven(FLOWER), box=ExplicitBox(lower=matrix_rows(lower), upper=matrix_rows(upper)))
        result = solved(problem)
        assert result.at_bounds == ()
        drawn = bootstrap_intervals(problem, result.vector, resamples=60, rng=np.random.default_rng(1))
        assert np.argwhere(np.isnan(drawn.low)).tolist() == [[0, 0]]

    def test_directions_that_are_kept_have_no_variance_and_their_parameters_none_at_all(self) -> None:
        uncertainty = found(driven(RING, slip=0.02))
        turn = np.kron(np.eye(3), np.ones(3))
        np.testing.assert_allclose(turn @ uncertainty.covariance @ turn.T, 0, atol=1e-18)
        assert (uncertainty.standard_deviations > 0).all()
        untold = [each.name for each in uncertainty.parameters if each.standard_deviation is None]
        assert untold == ["distance_a", "distance_b", "distance_c"]

    @pytest.mark.parametrize(("freedom", "quantile"), [(None, 1.960), (np.full(9, 4.0), 2.776)])
    def test_a_calibrator_s_own_covariance_and_freedom_are_taken(self, freedom: Array | None, quantile: float) -> None:
        problem, deviations = make_problem(driven(FLOWER)), np.sqrt(np.arange(1.0, 10.0)) * 1e-4
        own = replace(solved(problem), covariance=np.diag(deviations**2), degrees_of_freedom=freedom, noise=NOISE)
        uncertainty = uncertainty_of(problem, own)
        np.testing.assert_allclose(uncertainty.standard_deviations.ravel(), deviations)
        assert (uncertainty.basis, uncertainty.noise) == ("likelihood", NOISE)
        half_widths = (uncertainty.intervals.high - uncertainty.intervals.low).ravel() / 2
        np.testing.assert_allclose(half_widths, quantile * deviations, rtol=2e-4)


class TestBasis:
    """What the covariance rests on, chosen by rule and said in words."""

    def test_repetitions_are_used_where_there_are_some_and_runs_scatter_about_zero_elsewhere(self) -> None:
        assert "48 runs of 16 commands" in found(driven(FLOWER)).source
        once = found(driven(FLOWER, repetitions=1))
        unnamed = found([replace(run, command=None) for run in driven(FLOWER)])
        assert "16 runs: no command is repeated" in once.source
        assert "no command is repeated" in unnamed.source

    def test_commands_that_no_matrix_fits_at_once_scatter_as_a_whole(self) -> None:
        hits = 0
        for seed in range(5):
            rng = np.random.default_rng(seed)
            pulls = 0.02 * rng.standard_normal((16, 3))
            uncertainty = found(
                [
                    replace(run, poses=run.poses + np.outer(run.pose_times, pulls[int(run.command or 0)]))
                    for run in driven(FLOWER, seed=seed)
                ]
            )
            assert "16 commands" in uncertainty.source
            hits += int(((uncertainty.intervals.low < TRUTH) & (uncertainty.intervals.high > TRUTH)).sum())
        assert hits >= 38  # of 45; with the repetitions' scatter alone it would be a few

    def test_sessions_that_differ_scatter_as_a_whole(self) -> None:
        rng = np.random.default_rng(1)
        runs = []
        for session in range(8):
            scale = 1 + 0.03 * rng.standard_normal()  # the reference's length, say
            runs += [
                replace(run, id=f"{session}-{run.id}", session=str(session), poses=run.poses * [scale, scale, 1.0])
                for run in driven(FLOWER, repetitions=2, seed=session)
            ]
        uncertainty = found(runs)
        assert uncertainty.source.startswith("the scatter between 8 sessions, ")

    @pytest.mark.parametrize(
        ("runs", "cost", "reason"),
        [
            (driven(RING[1:3], repetitions=1), "trajectory", "too few"),
            (driven(FLOWER, noise=0.0), "final_pose", "exactly"),
            ([replace(run, rates=0 * run.rates) for run in driven(FLOWER)], "final_pose", "free"),
        ],
    )
    def test_few_still_or_exact_runs_have_no_covariance(self, runs: list[Trajectory], cost: str, reason: str) -> None:
        with pytest.raises(NoCovarianceError, match=reason):
            found(runs, cost=cost)

    def test_an_answer_that_is_no_minimum_is_told(self) -> None:
        problem = make_problem(driven(FLOWER))
        best = solved(problem)
        off = replace(best, vector=best.vector * 1.02, matrix=problem.matrix(best.vector * 1.02))
        with pytest.raises(NoCovarianceError, match="standard deviations away"):
            uncertainty_of(problem, off)


class TestParameters:
    """Radius, distance and angle of each wheel."""

    @given(seed=st.integers(0, 2**16))
    def test_geometries_near_the_design_survive_the_way_to_the_matrix_and_back(self, seed: int) -> None:
        design = WheelGeometry(ROBOT).start
        geometry = design * (1 + 0.05 * np.random.default_rng(seed).standard_normal(9))
        matrix = inverse_kinematic_matrices(*geometry.reshape(3, 1, 3))[0]
        np.testing.assert_allclose(geometry_of(matrix, ROBOT), geometry, rtol=1e-9)

    def test_the_slopes_are_those_of_the_way_back(self) -> None:
        geometry = geometry_of(TRUTH, ROBOT)
        step = 1e-6 * np.random.default_rng(0).standard_normal((3, 3))
        moved = geometry_of(TRUTH + step, ROBOT) - geometry_of(TRUTH - step, ROBOT)
        np.testing.assert_allclose(
            WheelGeometry(ROBOT).slopes(geometry) @ moved / 2, step.ravel(), rtol=1e-5, atol=1e-12
        )

    @pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.ones((3, 3))])
    def test_a_matrix_that_no_wheels_have_is_refused(self, matrix: Array) -> None:
        with pytest.raises(DataError, match="no wheels have it"):
            geometry_of(matrix, ROBOT)

    def test_the_matrix_of_four_wheels_means_no_one_geometry(self) -> None:
        problem = make_problem(driven(FLOWER, wheels=4), wheels=4)
        assert uncertainty_of(problem, solved(problem)).parameters is None
        with pytest.raises(DataError, match="three omni wheels"):
            geometry_of(np.zeros((3, 4)), synthetic_robot(4))

    @pytest.mark.slow
    def test_both_ways_to_the_geometry_agree(self) -> None:
        runs = driven(FLOWER, noise=0.01)
        by_matrix = found(runs).parameters
        problem = make_problem(runs, parameterisation="geometry")
        by_geometry = uncertainty_of(problem, solved(problem, "parametric")).parameters
        for one, other in zip(by_matrix, by_geometry, strict=True):
            assert one.name == other.name
            assert one.value == pytest.approx(other.value, rel=1e-4)
            assert one.standard_deviation == pytest.approx(other.standard_deviation, rel=1e-3)


def test_a_resampled_optimum_differs_from_a_full_refit_by_far_less_than_the_intervals_width() -> None:
    problem, result = flower_problem(repetitions=1)
    optimum = result.vector
    intervals = bootstrap_intervals(problem, optimum, resamples=100, rng=np.random.default_rng(0))
    width = (intervals.high - intervals.low).ravel()
    drawn = np.random.default_rng(5).multinomial(36, np.full(36, 1 / 36))
    shares = problem.objective.shares(problem.odometry.trajectory) * drawn
    linearised = optimum + cone_program(problem, problem.objective, optimum).step(shares)
    refitted = linearised
    for _ in range(6):  # each about the last answer: where it no longer moves, the poses are not linearised any more
        refitted = refitted + cone_program(problem, problem.objective, refitted).step(shares)
    assert np.abs(linearised - optimum).max() > 0.01 * width.max()
    assert (np.abs(refitted - linearised) < 0.01 * width).all()
    more_problem, more_result = flower_problem(repetitions=4)
    more = bootstrap_intervals(more_problem, more_result.vector, resamples=100, rng=np.random.default_rng(0))
    assert np.median(more.high - more.low) == pytest.approx(np.median(width) / 2, rel=0.35)


@pytest.mark.slow
def test_about_95_percent_of_the_resampled_intervals_hold_the_hidden_matrix() -> None:
    hits = np.array([bootstrap_coverage.covered(seed, resamples=150) for seed in range(3)])
    # Binomial, 27 intervals: 95 % of them leaves fewer than 21 inside with a probability of about 4e-4.
    assert hits.sum() >= 21


def test_the_geometry_has_no_resampled_intervals() -> None:
    problem = make_problem(parameterisation="geometry")
    with pytest.raises(ConfigError, match="matrix parameterisation"):
        bootstrap_intervals(problem, problem.start, rng=np.random.default_rng(0))
