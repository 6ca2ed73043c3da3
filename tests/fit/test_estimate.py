"""The most probable model: its rows' weights, exact data, nuisances, references alone, and the names that map had."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import reference_coverage as study
from fit_samples import make_problem
from hypothesis import given, settings
from hypothesis import strategies as st
from lanes import slow
from motions import RING, driven
from real_recordings import omni3
from sample_robots import APR02, DIFFERENTIAL, WHEELED

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.references import Reference, References
from omnibench.errors import ConfigError, DataError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.calibrator import Outcome, RunResult, model_of_answer, run_calibrator
from omnibench.fit.estimate import HEADING, PLACE, EstimateProblem, Nuisances, Unknown, estimate
from omnibench.fit.evaluate import final_errors
from omnibench.fit.prior import physical_prior_root, physical_tolerance
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array, Mount, Robot, published_matrix
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.robot.physical import EstimatedCovariance
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset
from omnibench.testing import synthetic_problem
from omnibench.testing.synthetic import synthetic_robot

PERIOD, SAMPLES = 0.1, 150
TWISTS = [(0.3, 0.0), (-0.1, 0.0), (0.2, 0.5), (0.1, -0.2), (0.0, 0.6), (0.0, -0.2)]  # m/s, rad/s
SPREAD = np.array([0.02, -0.01, 0.03, -0.04, 0.01, -0.01])  # m: of six errors


def two_wheels(shares: Sequence[float], lost: float = 0.0, noise: float = 0.0) -> tuple[Trajectory, ...]:
    """Runs of a differential drive whose elements are off, and whose turning wheels lose a rate, rad/s."""
    matrix = DIFFERENTIAL.inverse_kinematic_matrix * np.array(shares).reshape(3, 2)
    inverse = np.linalg.pinv(matrix)
    rng = np.random.default_rng(1)
    times: Array = PERIOD * np.arange(1, SAMPLES + 1)
    stamps = np.append(0.0, times[4::5])
    runs = []
    for number, (speed, turn) in enumerate(TWISTS):
        true = np.tile(inverse @ (speed, 0.0, turn), (SAMPLES, 1))
        poses = OdometryModel(DIFFERENTIAL, matrix, "arc").poses([WheelLog(times, true, np.zeros(3), stamps)])[0]
        poses[1:] += rng.normal(0.0, noise, poses[1:].shape)
        runs.append(Trajectory(f"{number}", "train", times, true + lost * np.sign(true), stamps, poses))
    return tuple(runs)


def solved(runs: Sequence[Trajectory], **options: object) -> RunResult:
    problem = synthetic_problem(robot=DIFFERENTIAL, trajectories=runs)
    return run_calibrator(calibrators.create("map", options), problem)


def problem_of(runs: Sequence[Trajectory], root: Array | None = None, **choices: Any) -> EstimateProblem:
    """The estimate of a differential drive; root: default, that of the class's prior."""
    if root is None:
        root = physical_prior_root(DIFFERENTIAL, physical_tolerance(DIFFERENTIAL))
    return EstimateProblem(DIFFERENTIAL, runs, root, "arc", PERIOD, **choices)


# The weights of the rows, Eq. (2) and (4), where nothing can be fitted and the errors stand in the data.


def standing(errors: Array, sigma: float = 0.0) -> list[Trajectory]:
    """Runs whose wheels stand: a tape, which says how far, errs by errors (Z,), each times as often as its row."""
    times = PERIOD * np.arange(1, 11)
    poses = np.zeros((1, 3))
    runs = []
    for number, of_run in enumerate(errors):
        measured = [Reference("turn", float(error), sigma, float(t)) for error, t in zip(of_run, times, strict=False)]
        given = References.of(measured, 1.0)
        runs.append(Trajectory(str(number), "train", times, np.zeros((10, 2)), np.zeros(1), poses, references=given))
    return runs


def excess_of(errors: Array, sigma: float) -> float:
    """The excess error, rad, of turns that were measured with sigma."""
    found = estimate(problem_of(standing(errors, sigma), np.zeros((6, 1)), loss="squares"))
    (excess,) = found.excess.values()
    return excess


def test_errors_beyond_what_measures_them_alone_are_the_excess_by_runs_less_one() -> None:
    expected = np.sqrt(np.square(SPREAD).sum() / 5 - 0.01**2)
    assert excess_of(SPREAD[:, None], 0.01) == pytest.approx(expected, rel=1e-9)
    assert excess_of(SPREAD[:, None], 0.1) == 0.0


def test_a_run_that_is_measured_more_often_counts_as_one() -> None:
    often = [[error] * (5 if number == 2 else 1) for number, error in enumerate(SPREAD)]
    once = excess_of(SPREAD[:, None], 0.01)
    times = [np.array(each) for each in often]
    found = estimate(problem_of(standing(times, 0.01), np.zeros((6, 1)), loss="squares"))  # type: ignore[arg-type]
    (excess,) = found.excess.values()
    assert excess == pytest.approx(once, rel=1e-9)


def test_a_run_that_is_far_off_pulls_in_proportion_under_hubers_loss() -> None:
    far = np.append(SPREAD, 1.0)[:, None]
    squares, huber = (
        estimate(problem_of(standing(far, 0.01), np.zeros((6, 1)), loss=loss)).excess for loss in ("squares", "huber")
    )
    assert next(iter(huber.values())) < 0.5 * next(iter(squares.values()))


def test_errors_along_a_path_count_with_three_millimetres_at_least() -> None:
    excess = estimate(problem_of(two_wheels([1.0] * 6))).excess
    assert excess == {PLACE: 0.003, HEADING: 0.003}


# Exact data, the prior, effects and jumps.


@settings(max_examples=10, deadline=None)
@given(st.floats(0.95, 1.05), st.floats(0.95, 1.05), st.floats(0.9, 1.1))
def test_radii_and_track_are_found(left: float, right: float, track: float) -> None:
    shares = [left, right, 1.0, 1.0, left / track, right / track]
    found = solved(two_wheels(shares), lost_rate=0.0).matrix[[0, 2]]
    found = found / DIFFERENTIAL.inverse_kinematic_matrix[[0, 2]]
    assert found == pytest.approx(np.array([[left, right], [left / track, right / track]]), abs=5e-3)


def test_exact_poses_and_a_design_that_is_hardly_known_give_the_truth() -> None:
    shares = np.array([1.02, 0.99, 1.0, 1.0, 1.05, 1.02])
    wide = np.diag(np.abs(DIFFERENTIAL.inverse_kinematic_matrix).ravel() * 10.0)
    found = estimate(problem_of(two_wheels(shares.tolist()), wide)).matrix
    np.testing.assert_allclose(found.ravel(), DIFFERENTIAL.inverse_kinematic_matrix.ravel() * shares, atol=1e-6)


def test_the_rate_that_turning_wheels_lose_is_found_and_the_cost_is_that_of_the_model_with_it() -> None:
    problem = synthetic_problem(robot=DIFFERENTIAL, trajectories=two_wheels([1.0] * 6, lost=0.02))
    result = run_calibrator(calibrators.create("map", {"lost_rate": 0.05}), problem)
    (effect,) = result.extension.effects
    assert effect.parameters["c"] == pytest.approx(-0.02, rel=0.05)
    assert "lose 0.0" in result.reason
    model = model_of_answer(problem, result.matrix, result.extension)
    assert result.cost == problem.objective.of_model(model, problem.trajectories)


def test_a_calibration_keeps_the_estimate_without_effects_beside_that_with_them() -> None:
    runs = two_wheels([1.0] * 6, lost=0.02)
    plain = np.array(solved(runs).extension.plain)
    np.testing.assert_allclose(plain, solved(runs, lost_rate=0.0).matrix, rtol=1e-4)


def test_what_the_runs_hardly_tell_stays_near_the_design() -> None:
    straight = two_wheels([1.03] * 6, noise=0.005)[:2]
    found = solved(straight).matrix[[0, 2]] / DIFFERENTIAL.inverse_kinematic_matrix[[0, 2]]
    assert found[0] == pytest.approx([1.03, 1.03], abs=0.01)
    assert found[1].mean() == pytest.approx(1.0, abs=0.05)


def test_the_better_the_design_is_known_the_closer_to_it_is_the_answer() -> None:
    robot = synthetic_robot()
    dataset = make_dataset("flower", robot, 0.1, driven(RING, noise=0.01), simulated=True)
    found = [calibrate(dataset, tolerance=each).calibration.matrix_array for each in (1e-7, 1e-3, 1e-2, 1e-1)]
    apart = [float(np.linalg.norm(matrix - robot.inverse_kinematic_matrix)) for matrix in found]
    assert apart == sorted(apart)
    assert apart[0] < 1e-5 < 1e-3 < apart[-1]


def test_motions_that_were_not_driven_are_known_by_the_design_and_its_tolerance() -> None:
    robot = synthetic_robot()
    run = calibrate(make_dataset("straight", robot, 0.1, driven(RING, slip=0.02), simulated=True))
    assert run.kept == ()
    (warning,) = [each for each in run.warnings if "turning on the spot" in each]
    assert warning.endswith("there the matrix is known by the design and its tolerance")
    widths = run.uncertainty.intervals.high - run.uncertainty.intervals.low
    assert (widths[2] > 0.02 * np.abs(robot.inverse_kinematic_matrix[2])).all()  # of the class's 2 % of a radius


def test_poses_that_have_jumped_do_not_move_the_answer() -> None:
    runs = two_wheels([1.02, 0.99, 1.0, 1.0, 1.05, 1.02], noise=0.002)
    clean = solved(runs).matrix
    spoilt = []
    for number, run in enumerate(runs):
        poses = run.poses.copy()
        poses[3 + number % 3] += (1.0, -1.0, 0.0)
        spoilt.append(replace(run, poses=poses))
    assert np.abs(solved(spoilt).matrix - clean).max() < 0.003 * np.abs(clean).max()


def test_steering_is_not_fitted_of_a_robot_without() -> None:
    result = solved(two_wheels([1.0] * 6), steering="fit")
    assert result.outcome is Outcome.FAILED
    assert "robot diff has none" in result.reason


def test_runs_that_hold_nothing_but_their_start_are_refused() -> None:
    blind = [replace(run, pose_times=run.pose_times[:1], poses=run.poses[:1]) for run in two_wheels([1.0] * 6)]
    with pytest.raises(DataError, match="no trajectory has a reference"):
        estimate(problem_of(blind))


@pytest.mark.parametrize("robot", WHEELED, ids=lambda robot: robot.name)
def test_the_prior_knows_every_class_of_robot(robot: Robot) -> None:
    root = physical_prior_root(robot, physical_tolerance(robot))
    deviations = np.sqrt(np.square(root).sum(axis=1)).reshape(robot.inverse_kinematic_matrix.shape)
    moving = robot.inverse_kinematic_matrix != 0
    shares = deviations[moving] / np.abs(robot.inverse_kinematic_matrix)[moving]
    assert shares.min() > 0.01
    assert np.isfinite(root).all()


def test_the_prior_holds_a_tracked_point_that_stands_elsewhere() -> None:
    tricycle = next(robot for robot in WHEELED if robot.name == "tricycle")
    moved = tricycle.model_copy(update={"mount": Mount(x=0.03, y=-0.02, yaw=0.02)})
    change = moved.inverse_kinematic_matrix - tricycle.inverse_kinematic_matrix
    root = physical_prior_root(tricycle, physical_tolerance(tricycle))
    of_motions = np.tile([False, True, False], (change.shape[1], 1)).T.ravel()  # row 2, which no wheel drives
    numbers = np.linalg.pinv(root[of_motions]) @ change.ravel()[of_motions]
    assert root[of_motions] @ numbers == pytest.approx(change.ravel()[of_motions], abs=1e-4)
    assert np.linalg.norm(numbers) == pytest.approx(np.hypot(0.03 / 0.05, 0.02 / 0.035), rel=0.02)


@pytest.mark.slow
def test_trained_on_circles_it_predicts_the_squares_of_a_real_robot() -> None:
    """OptiOdom's omni robot: the best matrix alone errs by 0.10 m there, and discover's named effect by 0.035 m."""
    dataset = omni3()
    run = calibrate(dataset)
    errors = final_errors(run.calibration.model, dataset.split("validation"))
    assert np.hypot(errors[:, 0], errors[:, 1]).mean() < 0.05
    assert [effect.name for effect in run.calibration.effects] == ["wheel_dead_zone"]


# Nuisances of a run: its start heading, and its reference's clock.

EQ_8 = published_matrix("palacin2023_eq8")


def flower(seed: int = 1, distance: float = 1.1, **noise: float) -> CalibrationProblem:
    """A small simulated flower of the APR-02 robot, as a problem."""
    config = FlowerConfig.model_validate(
        {
            "robot": APR02,
            "sample_period": 0.05,
            "commands": {"directions_deg": [0, 90, 180, 270], "turn_rates": [-0.35, 0.0, 0.35]},
            "repetitions": 3,
            "truth": {"published": "palacin2023_eq8"},
            "noise": noise or {"pose_position": 0.005, "pose_heading": 0.005, "walk_position": 0.003},
            "train": {"seed": seed, "distance": distance},
        }
    )
    return make_problem(simulate_dataset(config).dataset.trajectories, robot=config.robot)


def off(problem: CalibrationProblem, runs: Sequence[Trajectory], **options: object) -> float:
    """The largest error of an element where the runs take the place of a problem's."""
    result = run_calibrator(calibrators.create("map", options), make_problem(runs, robot=problem.robot))
    return float(np.abs(result.matrix - EQ_8).max())


@pytest.mark.parametrize("clock", ["offset", "offset_and_slope"])
def test_a_shifted_clock_of_the_reference_does_not_spoil_the_matrix(clock: str) -> None:
    problem = flower(distance=2.2, pose_position=0.001, pose_heading=0.001)
    rng = np.random.default_rng(5)
    shifted = []
    for run in problem.trajectories:
        late = run.pose_times + rng.normal(0, 0.1)
        moved = np.stack([np.interp(late, run.pose_times, column) for column in run.poses.T], axis=1)
        shifted.append(replace(run, poses=np.vstack([run.poses[:1], moved[1:-1], run.poses[-1:]])))
    assert off(problem, shifted, clock=clock) < 0.7 * off(problem, shifted, clock="none")


def test_start_headings_that_are_off_do_not_spoil_the_matrix() -> None:
    problem = flower(pose_position=0.001, pose_heading=0.001)
    rng = np.random.default_rng(3)
    turned = [
        replace(run, poses=np.vstack([run.start + np.array([0.0, 0.0, 0.03 * rng.standard_normal()]), run.poses[1:]]))
        for run in problem.trajectories
    ]
    assert off(problem, turned, start_heading=0.03) < 0.7 * off(problem, turned, start_heading=0.0)


@given(st.floats(-0.02, 0.02))
@settings(max_examples=5)
def test_a_nuisance_takes_what_an_error_of_the_start_heading_leaves(turn: float) -> None:
    runs = [
        replace(run, poses=np.vstack([run.start + np.array([0.0, 0.0, turn]), run.poses[1:]]))
        for run in two_wheels([1.0] * 6)
    ]
    nearly_known = 1e-9 * np.eye(6)
    with_it, without = (
        estimate(problem_of(runs, nearly_known, nuisances=Nuisances(start_heading=each))).excess[PLACE]
        for each in (10.0, 0.0)
    )
    assert with_it == pytest.approx(0.003, abs=1e-6)
    assert without >= with_it


@pytest.mark.slow
def test_its_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    inside = []
    for seed in range(12):
        problem = flower(seed)
        result = run_calibrator(calibrators.create("map"), problem)
        reach = EstimatedCovariance(result.covariance, result.degrees_of_freedom).reach
        inside.append(np.abs(result.matrix - EQ_8).ravel() < reach)
    # 108 intervals in 12 independent sets: three standard deviations of the mean, were each set's all alike.
    assert np.mean(inside) > 0.95 - 3 * np.sqrt(0.95 * 0.05 / 12)


# References of every kind, alone.


def reduced(robot: str, seed: int, kinds: str) -> tuple[Dataset, Array]:
    """Simulated runs with references of some kinds in the place of their poses, and the true matrix."""
    exact, truth = study.simulated(robot, seed)
    return study.reduced(exact, kinds, np.random.default_rng(seed)), truth


@pytest.mark.parametrize("kind", ["distance and turn", *slow("displacement", "position", "position and heading")])
@pytest.mark.parametrize("robot", ["diff", *slow("omni")])
def test_references_alone_lead_near_the_truth_by_their_intervals(robot: str, kind: str) -> None:
    dataset, truth = reduced(robot, 1, kind)
    run = calibrate(dataset)
    found, intervals = run.calibration.matrix_array, run.uncertainty.intervals
    assert (np.abs(found - truth) <= 0.75 * (intervals.high - intervals.low)).all()  # 1.5 times the half-width
    before = np.abs(dataset.robot.inverse_kinematic_matrix - truth)
    assert np.abs(found - truth)[2].max() < 0.3 * before[2].max()


@pytest.mark.parametrize(("kind", "told", "open_"), [("distance", 0, 2), ("turn", 2, 0), ("heading", 2, 0)])
def test_a_reference_of_one_kind_tells_its_rows_and_leaves_the_others_to_the_design(
    kind: str, told: int, open_: int
) -> None:
    dataset, truth = reduced("diff", 1, kind)
    run = calibrate(dataset)
    widths = (run.uncertainty.intervals.high - run.uncertainty.intervals.low) / dataset.robot.row_scales[:, None]
    assert widths[told].max() < 0.03
    assert widths[open_].min() > 0.03
    assert np.abs(run.calibration.matrix_array - truth)[told].max() < 0.01 * dataset.robot.row_scales[told]


def test_the_offset_of_a_gyro_is_estimated_for_a_session() -> None:
    offset, exact = 0.02, two_wheels([1.02, 0.99, 1.0, 1.0, 1.05, 1.02])
    runs = []
    for run in exact:
        stamps = run.pose_times[1:]
        seen = zip(stamps.tolist(), (run.poses[1:, 2] + offset * stamps).tolist(), strict=True)
        turns = [Reference("heading", heading, 1e-4, time, 0.0) for time, heading in seen]
        given_ = References.of(turns, float(run.times[-1]), rate_sigma=0.01)
        runs.append(replace(run, session="day", pose_times=np.zeros(1), poses=np.zeros((1, 3)), references=given_))
    found = solved(runs, lost_rate=0.0).matrix[2] / DIFFERENTIAL.inverse_kinematic_matrix[2]
    assert found == pytest.approx([1.05, 1.02], abs=2e-3)


# Former names and options.


def run_of(calibrator: str, **options: object) -> CalibrationRun:
    dataset = make_dataset("two", DIFFERENTIAL, PERIOD, two_wheels([1.02] * 6, noise=0.002), simulated=True)
    return calibrate(dataset, calibrator, options=options)


@pytest.mark.parametrize("former", ["posterior", "trajectory_ml"])
def test_a_former_name_says_the_new_one_and_gives_the_same(former: str) -> None:
    with pytest.warns(FutureWarning, match=f"calibrator {former} is now called map"):
        run = run_of(former)
    assert run.calibration.provenance.calibrator == "map"
    np.testing.assert_array_equal(run.calibration.matrix, run_of("map").calibration.matrix)


def test_options_of_a_former_name_are_taken() -> None:
    found = calibrators.create("map", {"start": "exact", "weights": "noise", "covariance": "robust"}).options
    assert found.start_heading == 0.0
    with pytest.raises(ConfigError, match="clok"):
        calibrators.create("map", {"clok": "none"})


def test_shrinking_the_answer_of_another_calibrator_is_what_map_does_and_is_said_so() -> None:
    dataset = make_dataset("two", DIFFERENTIAL, PERIOD, two_wheels([1.02] * 6, noise=0.002), simulated=True)
    with pytest.warns(FutureWarning, match="shrink is what calibrator map does"):
        run = calibrate(dataset, "closed_form", unidentified="shrink")
    assert run.calibration.provenance.unidentified == "keep"


def test_an_unknown_effect_of_wheels_is_estimated_beside_the_matrix() -> None:
    runs = two_wheels([1.0] * 6, lost=0.02)
    found = estimate(problem_of(runs, unknowns=(Unknown("wheel_dead_zone", "c", 0.05),)))
    assert found.terms[0].values["c"] == pytest.approx(-0.02, rel=0.05)
    assert found.root.shape[0] == 7
