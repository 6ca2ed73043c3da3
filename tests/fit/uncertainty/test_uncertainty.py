"""How sure a calibration is: covariance of the elements and of the geometry behind them, and intervals of ratios."""

import math
from dataclasses import replace
from typing import Any

import improvement_coverage
import numpy as np
import pytest
from fit_samples import make_problem, noisy_trajectories
from motions import FLOWER, RING, SPEED, TURNS, Twist, driven
from sample_robots import CAR, DIFFERENTIAL
from scipy import stats
from wheeled_samples import driven as curves

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.errors import DataError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.calibrator import RunResult, run_calibrator
from omnibench.fit.geometry import WheelGeometry
from omnibench.fit.identifiability import (
    Identifiability,
    deviations_along,
    identifiability,
    identified_parameters,
    inseparable_in_words,
    inseparable_parameters,
    warnings_of_calibration,
)
from omnibench.fit.inspect import inspect_dataset
from omnibench.fit.intervals import Bootstrap, Clusters, RatioIntervals, units_of
from omnibench.fit.parameterisation import ExplicitBox
from omnibench.fit.problem import Budget, CalibrationProblem
from omnibench.fit.span import aligned, driven_span, unidentified_directions
from omnibench.fit.trajectory_fit import information_of_runs
from omnibench.fit.uncertainty import NoCovarianceError, Uncertainty, physical_parameters, uncertainty_of
from omnibench.registry import calibrators
from omnibench.robot.calibration import Noise, matrix_rows
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import OdometryBatch
from omnibench.robot.physical import EstimatedCovariance, PhysicalParameter
from omnibench.testing.synthetic import synthetic_robot, true_robot

ROBOT = synthetic_robot()
TRUTH = true_robot(ROBOT).inverse_kinematic_matrix
NOISE = Noise(pose_position=0.004, pose_heading=0.006, walk_position=0.002, bias_heading=0.003)


def solved(problem: CalibrationProblem, calibrator: str = "closed_form") -> RunResult:
    result = run_calibrator(calibrators.create(calibrator), problem)
    assert result.vector is not None, result.reason
    return result


def wheels(problem: CalibrationProblem, calibrator: str = "closed_form") -> tuple[PhysicalParameter, ...]:
    """The physical parameters of an answer."""
    result = solved(problem, calibrator)
    return physical_parameters(problem, result, uncertainty_of(problem, result)).parameters


def found(runs: list[Trajectory], **changes: str) -> Uncertainty:
    problem = make_problem(runs, **changes)
    return uncertainty_of(problem, solved(problem))


def shares(uncertainty: Uncertainty) -> Array:
    """Standard deviations (3, N) as a share of the row's largest element."""
    return uncertainty.standard_deviations / np.abs(ROBOT.inverse_kinematic_matrix).max(axis=1, keepdims=True)


# Fisher information of the elements.


@pytest.mark.parametrize("stamps", ["reference", "final"])
def test_the_information_is_that_of_the_residuals_covariance(stamps: str) -> None:
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
    (information,) = information_of_runs([run], TRUTH, "arc", NOISE, stamps=stamps)
    np.testing.assert_allclose(information, expected, rtol=1e-9, atol=1e-6)


# The scatter of the runs about the minimum of a sum of norms.


@pytest.mark.parametrize("cost", ["final_pose", "final_position", "trajectory"])
def test_every_cost_that_is_a_sum_of_norms_has_a_covariance(cost: str) -> None:
    deviations = shares(found(driven(FLOWER), cost=cost))
    assert (deviations > 1e-5).all()
    assert (deviations < 0.02).all()


def test_a_cost_of_headings_says_nothing_of_rows_1_and_2() -> None:
    uncertainty = found(driven(FLOWER), cost="final_heading")
    assert not uncertainty.covariance[:6].any()
    assert (uncertainty.standard_deviations[2] > 0).all()


def test_an_element_that_the_box_holds_has_no_variance_and_no_interval() -> None:
    problem = make_problem(driven(FLOWER), box="paper")
    result = solved(problem)
    uncertainty = uncertainty_of(problem, result)
    assert uncertainty.standard_deviations[0, 1] == 0
    assert np.count_nonzero(uncertainty.standard_deviations) == 8
    assert np.argwhere(np.isnan(uncertainty.intervals.low)).tolist() == [[0, 1]]


def test_what_depends_on_an_element_on_a_bound_has_no_interval() -> None:
    truth, wide = TRUTH[1, 2], np.abs(ROBOT.inverse_kinematic_matrix)
    lower, upper = ROBOT.inverse_kinematic_matrix - wide - 0.1, ROBOT.inverse_kinematic_matrix + wide + 0.1
    design = ROBOT.inverse_kinematic_matrix[1, 2]
    (upper if truth > design else lower)[1, 2] = (truth + design) / 2
    box = ExplicitBox(lower=matrix_rows(lower), upper=matrix_rows(upper))
    problem = make_problem(driven(FLOWER), box=box)
    result = solved(problem)
    assert result.at_bounds == ("m23",)
    uncertainty = uncertainty_of(problem, result)
    assert np.argwhere(np.isnan(uncertainty.intervals.low)).tolist() == [[1, 2]]
    assert np.argwhere(np.isnan(uncertainty.intervals.high)).tolist() == [[1, 2]]
    told = [each.name for each in physical_parameters(problem, result, uncertainty).parameters if each.low is not None]
    assert told == ["distance_c", "angle_c"]  # which m23 of the design does not move


def test_directions_that_are_kept_have_no_variance_and_their_parameters_none_at_all() -> None:
    problem = make_problem(driven(RING, slip=0.02))
    uncertainty = uncertainty_of(problem, solved(problem))
    turn = np.kron(np.eye(3), np.ones(3))
    np.testing.assert_allclose(turn @ uncertainty.covariance @ turn.T, 0, atol=1e-18)
    assert (uncertainty.standard_deviations > 0).all()
    untold = [each.name for each in wheels(problem) if each.low is None]
    assert untold == ["distance_a", "distance_b", "distance_c"]


@pytest.mark.parametrize(("freedom", "quantile"), [(None, 1.960), (np.full(9, 4.0), 2.776)])
def test_a_calibrator_s_own_covariance_and_freedom_are_taken(freedom: Array | None, quantile: float) -> None:
    problem, deviations = make_problem(driven(FLOWER)), np.sqrt(np.arange(1.0, 10.0)) * 1e-4
    own = replace(solved(problem), covariance=np.diag(deviations**2), degrees_of_freedom=freedom, noise=NOISE)
    uncertainty = uncertainty_of(problem, own)
    np.testing.assert_allclose(uncertainty.standard_deviations.ravel(), deviations)
    assert (uncertainty.basis, uncertainty.noise) == ("likelihood", NOISE)
    half_widths = (uncertainty.intervals.high - uncertainty.intervals.low).ravel() / 2
    np.testing.assert_allclose(half_widths, quantile * deviations, rtol=2e-4)


# What the covariance rests on, chosen by rule and said in words.


def test_an_interval_says_what_it_rests_on() -> None:
    assert found(driven(FLOWER)).source == "jackknife over 16 commands, of one session alone"
    assert found(driven(FLOWER, repetitions=1)).source == "jackknife over 16 runs, of one session alone"


@pytest.mark.parametrize(
    ("runs", "cost", "reason"),
    [
        (driven(RING[1:3], repetitions=1), "trajectory", "too few"),
        (driven(FLOWER, noise=0.0), "final_pose", "exactly"),
        (driven(FLOWER[:5], repetitions=1), "final_heading", "exactly through half of the poses"),
        ([replace(run, rates=0 * run.rates) for run in driven(FLOWER)], "final_pose", "free"),
    ],
)
def test_few_still_or_exact_runs_have_no_covariance(runs: list[Trajectory], cost: str, reason: str) -> None:
    with pytest.raises(NoCovarianceError, match=reason):
        found(runs, cost=cost)


def test_an_answer_that_is_no_minimum_is_told() -> None:
    problem = make_problem(driven(FLOWER))
    best = solved(problem)
    off = replace(best, vector=best.vector * 1.02, matrix=problem.matrix(best.vector * 1.02))
    with pytest.raises(NoCovarianceError, match="standard deviations away"):
        uncertainty_of(problem, off)


# Radius, distance and angle of each wheel.


@pytest.mark.slow
def test_both_ways_to_the_geometry_agree() -> None:
    runs = driven(FLOWER, noise=0.01)
    by_geometry = make_problem(runs, parameterisation="geometry")
    for one, other in zip(wheels(make_problem(runs)), wheels(by_geometry, "parametric"), strict=True):
        assert one.name == other.name
        assert one.value == pytest.approx(other.value, rel=1e-4)
        # Degrees of freedom of what is derived are means of those of what either way has fitted
        assert one.high - one.low == pytest.approx(other.high - other.low, rel=0.1)


# Intervals by Student's t, of functions and of ratios: units, coverage, and where there is none.

MATRIX = np.array([[4.0, 1.0], [1.0, 9.0]])


def test_half_widths_are_quantiles_of_students_or_the_normal_distribution_times_the_standard_deviations() -> None:
    covariance = EstimatedCovariance(MATRIX, np.array([3.0, 10.0]))
    np.testing.assert_allclose(covariance.reach, [3.182 * 2, 2.228 * 3], rtol=2e-4)
    np.testing.assert_allclose(EstimatedCovariance(MATRIX).reach, [1.960 * 2, 1.960 * 3], rtol=2e-4)
    kept = EstimatedCovariance(np.zeros((2, 2)), np.array([1.0, 4.0])).of(np.ones((1, 2)))
    assert kept.reach == pytest.approx([0.0])  # a function of nothing that varies


def test_one_number_of_degrees_of_freedom_holds_for_all_functions() -> None:
    functions = EstimatedCovariance(MATRIX, 5).of(np.array([[1.0, 1.0], [2.0, -1.0]]))
    np.testing.assert_allclose(functions.matrix, [[15.0, 0.0], [0.0, 21.0]], atol=1e-12)
    np.testing.assert_allclose(functions.degrees_of_freedom, 5.0)


def test_the_degrees_of_freedom_of_a_sum_lie_between_those_of_its_terms() -> None:
    independent = EstimatedCovariance(np.diag([1.0, 3.0]), np.array([2.0, 6.0]))
    functions = independent.of(np.array([[1.0, 0.0], [1.0, 1.0]]))
    assert functions.degrees_of_freedom == pytest.approx([2.0, 1 / (0.25 / 2 + 0.75 / 6)])


BOOTSTRAP = Bootstrap(resamples=2000, seed=1)


def units(commands: int, repetitions: int = 1) -> Clusters:
    return Clusters("command", np.repeat(np.arange(commands), repetitions))


def test_commands_are_the_unit_where_runs_repeat_them_and_runs_elsewhere() -> None:
    (run, *_) = noisy_trajectories()
    named = [replace(run, id=f"{index}", command=name) for index, name in enumerate(["a", "b", "a", None, None])]
    assert units_of(named).name == "command"
    assert units_of(named).of_run.tolist() == [0, 1, 0, 2, 3]  # a run without a command is its own unit
    assert units_of(named, "run").of_run.tolist() == [0, 1, 2, 3, 4]
    assert (units_of(named[:2]).name, units_of(named[:2]).count) == ("run", 2)


@pytest.mark.parametrize(
    ("count", "words"),
    [
        (1, "no interval from 1 command"),
        (2, "no interval from 2 commands"),
        (3, "Student's t over 3 commands"),
        (9, "Student's t over 9 commands"),
        (10, "bootstrap over 10 commands"),
    ],
)
def test_the_number_of_units_decides_the_method_and_is_said(count: int, words: str) -> None:
    of = units(count, 2)
    costs = np.random.default_rng(0).uniform(1.0, 2.0, 2 * count)
    found = RatioIntervals(BOOTSTRAP).mean(costs, of)
    assert of.ratio_words == words
    assert (found.known is None) == words.startswith("no interval")
    assert found.value == pytest.approx(costs.mean())


@pytest.mark.parametrize(
    "differences",
    [
        np.random.default_rng(3).normal(0.2, 0.4, 7),
        *(sign * np.array([1e-4, 2e-4, 1e-4, 3e-4, 0.05]) for sign in (1, -1)),
    ],
)
def test_a_difference_over_few_units_has_the_interval_of_the_t_test_even_of_one_sign(differences: Array) -> None:
    found = RatioIntervals(BOOTSTRAP).difference(differences, units(len(differences)))
    expected = stats.ttest_1samp(differences, 0.0).confidence_interval(0.95)
    assert found.known == pytest.approx((expected.low, expected.high))
    assert found.holds(0.0) == (expected.low < 0 < expected.high)


def test_twenty_runs_of_a_command_tell_no_more_than_one_of_their_mean() -> None:
    rng = np.random.default_rng(4)
    costs, before = rng.uniform(1, 2, 12), rng.uniform(2, 4, 12)
    intervals = RatioIntervals(BOOTSTRAP)
    once = intervals.improvement(costs, before, units(12))
    repeated = intervals.improvement(np.repeat(costs, 20), np.repeat(before, 20), units(12, 20))
    assert repeated.known == pytest.approx(once.known)


def test_an_improvement_is_below_one_and_a_mean_cost_above_zero_over_few_units() -> None:
    intervals = RatioIntervals(BOOTSTRAP)
    costs, before = np.array([0.01, 0.5, 0.02]), np.array([1.0, 1.1, 0.9])
    gain, mean = intervals.improvement(costs, before, units(3)), intervals.mean(costs, units(3))
    assert gain.known[0] < gain.value < gain.known[1] < 1
    assert mean.known[0] > 0


def test_the_ends_are_where_the_paired_t_statistic_reaches_its_bootstrapped_quantiles() -> None:
    """Resampled here anew, by another generator: 2 % of noise in each quantile."""
    rng = np.random.default_rng(8)
    before = rng.uniform(1, 2, 14)
    after = before * rng.gamma(4.0, 0.2, 14)  # skewed, so that the two quantiles differ
    found = RatioIntervals(Bootstrap(resamples=20_000)).ratio(after, before, units(14))
    left = after - after.sum() / before.sum() * before
    low, high = np.percentile(stats.ttest_1samp(rng.choice(left, (20_000, 14)), 0.0, axis=1).statistic, [2.5, 97.5])
    reached = [stats.ttest_1samp(after - end * before, 0.0).statistic for end in found.known]
    assert reached == pytest.approx([high, low], rel=0.06)


def test_one_command_that_outweighs_all_others_has_no_interval_and_equal_shares_have_one_without_width() -> None:
    before = np.append(np.full(11, 1e-3), 100.0)
    gain = RatioIntervals(BOOTSTRAP).improvement(np.append(np.full(11, 2e-3), 90.0), before, units(12))
    assert (gain.known, gain.holds(0.0)) == (None, True)
    equal = RatioIntervals(BOOTSTRAP).improvement(0.25 * np.arange(1.0, 5.0), np.arange(1.0, 5.0), units(4))
    assert equal.known == pytest.approx((0.75, 0.75))


@pytest.mark.slow
def test_the_verdict_of_a_calibration_covers_what_its_matrix_improves_on_fresh_commands() -> None:
    found = [improvement_coverage.whole_way(12, seed) for seed in range(12)]
    # Binomial: 95 % of 12 leaves fewer than 9 inside with a probability of 2e-4.
    assert sum(interval.holds(truth) for interval, truth in found) >= 9


# What recordings can tell before anything is fitted, what they leave open, and what they cannot tell apart.

DISTANCES = ("distance_a", "distance_b", "distance_c")


def told_of(twists: tuple[Twist, ...], slip: float = 0.0, **changes: float) -> Identifiability:
    return identifiability(ROBOT, driven(twists, slip=slip, **changes))


def states(found: Identifiability) -> dict[str, str]:
    return {each.motion: each.state for each in found.directions}


def untold(found: Identifiability) -> tuple[str, ...]:
    return tuple(each.name for each in found.parameters if not each.told)


# Information matrices of two or three wheels, whose inverses are known.


def test_directions_that_are_fitted_together_share_their_information_and_kept_ones_take_none() -> None:
    correlated = np.kron(np.eye(3), [[2.0, 1.0], [1.0, 2.0]])  # its inverse is [[2, -1], [-1, 2]] / 3
    together = deviations_along(correlated, np.eye(2))
    alone = deviations_along(correlated, np.array([[1.0, 0.0]]))
    turned = deviations_along(correlated, np.array([[1.0, 1.0], [1.0, -1.0]]) / math.sqrt(2))
    np.testing.assert_allclose(together, math.sqrt(2 / 3) * np.ones((2, 3)), rtol=1e-12)
    np.testing.assert_allclose(alone, math.sqrt(1 / 2) * np.ones((1, 3)), rtol=1e-12)
    np.testing.assert_allclose(turned.T, np.tile([math.sqrt(1 / 3), 1.0], (3, 1)), rtol=1e-12)


def test_a_direction_without_information_is_open_and_leaves_the_others_as_they_are() -> None:
    deviations = deviations_along(np.diag([4.0, 0.0, 4.0, 0.0, 4.0, 0.0]), np.eye(2))
    np.testing.assert_allclose(deviations[0], 0.5, rtol=1e-12)
    assert (deviations[1] > 1e6).all()
    assert np.isfinite(deviations).all()


def test_each_parameter_needs_the_directions_in_which_it_shows() -> None:
    """Equal steps of all three wheels turn the robot: only the distances change with what it then does."""
    turn = np.full((1, 3), 1 / math.sqrt(3))
    assert identified_parameters(WheelGeometry(ROBOT), np.zeros((0, 3))) == (True,) * 9
    assert identified_parameters(WheelGeometry(ROBOT), turn) == (True,) * 3 + (False,) * 3 + (True,) * 3
    assert identified_parameters(WheelGeometry(ROBOT), np.eye(3)) == (False,) * 9


# Predicted standard deviations, against those of linear regressions that are known.


def test_headings_alone_give_row_3_the_precision_of_a_regression_on_wheel_angles() -> None:
    """With positions that tell nothing, row 3 is m3 in heading = m3.C + noise at every stamp."""
    rng = np.random.default_rng(1)
    blurred = np.array([50.0, 50.0, 0.0])
    runs = [
        replace(run, poses=run.poses + blurred * rng.standard_normal(run.poses.shape))
        for run in driven(FLOWER, repetitions=2)
    ]
    found = identifiability(ROBOT, runs)
    information = 0.0
    for run in runs:
        angles, stamps = run.rates[0] * run.pose_times[1:, None], run.pose_times[1:]
        noise = found.noise
        covariance = noise.pose_heading**2 * np.eye(len(stamps)) + noise.bias_heading**2
        covariance += noise.walk_heading**2 * np.minimum.outer(stamps, stamps)
        information = information + angles.T @ np.linalg.solve(covariance, angles)
    directions = unidentified_directions(ROBOT, driven_span(runs)), aligned(driven_span(runs).strong, ROBOT)
    basis = np.concatenate(directions)
    expected = np.sqrt(np.diag(basis @ np.linalg.inv(information) @ basis.T))
    largest = np.abs(ROBOT.inverse_kinematic_matrix[2]).max()
    predicted = [each.deviations[2] for each in found.directions if each.deviations is not None]
    np.testing.assert_allclose(predicted, expected / largest, rtol=1e-3)


# Every direction of wheel rates, with its motion and how well it is told.


def test_runs_that_turn_and_drive_tell_everything_even_if_they_never_reverse() -> None:
    found = told_of(FLOWER)
    assert states(found) == dict.fromkeys(("turning on the spot", "moving along x", "moving along y"), "driven")
    assert (found.sentences, untold(found)) == ((), ())
    assert told_of(((SPEED, 0.0, 0.4), (0.0, SPEED, 0.4), (SPEED, SPEED, 0.4))).sentences == ()


@pytest.mark.parametrize("slip", [0.0, 0.02])
def test_translation_alone_leaves_the_turn_and_the_distances(slip: float) -> None:
    found = told_of(RING, slip)
    assert states(found)["turning on the spot"] == ("weak" if slip else "undriven")
    assert untold(found) == DISTANCES
    assert ", ".join(DISTANCES) in found.sentences[-1]


@pytest.mark.parametrize(
    ("twists", "slip", "motion"),
    [
        (TURNS, 0.02, "turning on the spot"),
        (((SPEED, 0.0, 0.0), (-SPEED, 0.0, 0.0)), 0.002, "moving along x"),
        (((SPEED, 0.0, 0.3),), 0.0, "moving along x while turning"),
    ],
)
def test_turns_lines_or_one_command_are_one_direction(twists: tuple[Twist, ...], slip: float, motion: str) -> None:
    found = told_of(twists, slip=slip)
    assert [each.motion for each in found.directions if each.state == "driven"] == [motion]
    assert {each.state for each in found.directions} <= {"driven", "weak", "undriven"}
    assert len(untold(found)) >= 8
    assert all("record" in sentence for sentence in found.sentences[:2])


def test_four_wheels_name_the_slipping_direction_apart_from_the_turn_and_slip_is_no_motion() -> None:
    still = identifiability(synthetic_robot(4), driven(RING, wheels=4))
    assert [(each.direction, each.motion) for each in still.directions[2:]] == [
        ("fl + fr + rl + rr", "turning on the spot"),
        ("fl - fr - rl + rr", ""),
    ]
    found = identifiability(synthetic_robot(4), driven(FLOWER, wheels=4, slip=0.02))
    assert [each.state for each in found.directions] == ["driven"] * 3 + ["weak"]
    (sentence,) = found.sentences
    assert f"fl - fr - rl + rr, which only slips, with {100 * found.directions[3].share:.1f} %" in sentence


# The standard deviations that the noise allows.


def test_noise_is_estimated_from_the_repetitions() -> None:
    found = told_of(FLOWER)
    assert found.noise.pose_position == pytest.approx(0.003, rel=0.1)
    assert "48 runs of 16 commands" in found.noise_source


def test_a_row_that_is_told_badly_is_named_with_its_deviation() -> None:
    found = told_of(((SPEED, 0.0, 0.4), (0.0, SPEED, 0.4), (SPEED, SPEED, -0.4)), noise=0.2, repetitions=2)
    rough = next(sentence for sentence in found.sentences if sentence.startswith("of a + b + c"))
    assert "row 1 (x) to " in rough
    assert rough.endswith("record more or longer runs")


def test_runs_without_reference_poses_are_refused() -> None:
    blind = [replace(run, pose_times=run.pose_times[:1], poses=run.poses[:1]) for run in driven(TURNS)]
    with pytest.raises(DataError, match="no trajectory has a reference pose after its start"):
        identifiability(ROBOT, blind)


# What a calibration says of the directions it could not tell.


@pytest.mark.parametrize("wheels", [3, 4])
def test_fine_data_give_no_warnings(wheels: Any) -> None:
    runs = driven(FLOWER, wheels=wheels)
    assert warnings_of_calibration(synthetic_robot(wheels), driven_span(runs), "matrix", "keep") == ()


@pytest.mark.parametrize(
    ("parameterisation", "unidentified", "end"),
    [
        ("matrix", "keep", "kept at the design values"),
        ("matrix", "fit", "what was fitted there rests on slip and noise"),
        ("geometry", "keep", "what was fitted to it rests on slip and noise"),
    ],
)
def test_each_way_to_go_on_is_said(parameterisation: str, unidentified: str, end: str) -> None:
    runs = driven(RING, slip=0.02)
    (warning,) = warnings_of_calibration(ROBOT, driven_span(runs), parameterisation, unidentified)
    assert "a + b + c (turning on the spot)" in warning
    assert f"{100 * driven_span(runs).shares[2]:.1f} %" in warning
    assert warning.endswith(end)


def test_what_is_not_driven_at_all_is_kept_whatever_is_asked() -> None:
    (warning,) = warnings_of_calibration(ROBOT, driven_span(driven(RING)), "matrix", "fit")
    assert warning.endswith("do; kept at the design values")


# The Robotino's table recordings translate only; omni3 drives everything.


def test_table_recordings_leave_the_turn_open_and_omni3_nothing(robotino: Dataset, omni3: Dataset) -> None:
    found = inspect_dataset(robotino)
    turning = found.findings[0]
    assert turning.startswith("these recordings hardly turn the robot: they drive the wheels along 1 + 2 + 3")
    assert "what row 3 (heading) says of it cannot be identified" in turning
    assert states(found.identifiability)["turning on the spot"] == "weak"
    assert untold(found.identifiability) == ("distance_1", "distance_2", "distance_3")
    assert warnings_of_calibration(omni3.robot, driven_span(omni3.split("train")), "matrix", "keep") == ()


KNOWN = np.empty((0, 2))  # no direction of wheel rates is unknown


def test_the_track_of_two_wheels_and_an_unknown_tracked_point_between_them_cannot_be_told_apart() -> None:
    geometry = WheelGeometry(DIFFERENTIAL, fitted_mount=True)
    assert inseparable_parameters(geometry, KNOWN) == (("distance_left", "distance_right", "mount_y"),)
    assert inseparable_parameters(WheelGeometry(DIFFERENTIAL), KNOWN) == ()
    of_the_left_wheel = np.array([[1.0, 0.0]])  # nothing is known of it
    sentences = inseparable_in_words(WheelGeometry(DIFFERENTIAL), of_the_left_wheel)
    assert any(sentence.startswith("these data say nothing of ") for sentence in sentences)


@pytest.mark.parametrize("robot", [DIFFERENTIAL, CAR], ids=lambda robot: robot.name)
@pytest.mark.parametrize("fitted_mount", [False, True])
def test_the_groups_hold_the_numbers_that_are_not_identified(robot: Robot, fitted_mount: bool) -> None:
    geometry = WheelGeometry(robot, fitted_mount=fitted_mount)
    kept = np.empty((0, len(robot.drive.names)))
    identified = dict(zip(geometry.names, identified_parameters(geometry, kept), strict=True))
    grouped = {name for group in inseparable_parameters(geometry, kept) for name in group}
    assert grouped == {name for name, known in identified.items() if not known}


def test_calibrate_says_which_numbers_cannot_be_told_apart() -> None:
    run = calibrate(
        curves(DIFFERENTIAL), "crs", parameterisation="geometry", mount="fit", budget=Budget(evaluations=300)
    )
    (warning,) = [each for each in run.warnings if "apart" in each]
    assert "distance_left, distance_right and mount_y" in warning
