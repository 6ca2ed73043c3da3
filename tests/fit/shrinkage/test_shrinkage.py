"""Shrinkage of a calibration to the design."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from motions import FLOWER, TURNS, driven
from sample_robots import APR_02, DIFFERENTIAL, MECANUM, SKID, TRICYCLE
from shrink_coverage import ANSWERS, covered
from wheeled_recordings import PERIOD, recorded

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.errors import ConfigError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.certify import certify_optimum
from omnibench.fit.prior import TOLERANCES, default_mount, default_unidentified, prior_root, tolerance_of
from omnibench.robot.kinematics import Array
from omnibench.testing.synthetic import synthetic_robot

ROBOT = synthetic_robot(3)
DESIGN = ROBOT.inverse_kinematic_matrix


def recording(runs: Sequence[Trajectory]) -> Dataset:
    return make_dataset("flower", ROBOT, 0.1, runs, simulated=True)


RECORDING = recording(driven(FLOWER + TURNS, noise=0.01))


def shrunk(tolerance: float | None = None, **choices: Any) -> CalibrationRun:
    return calibrate(RECORDING, unidentified="shrink", tolerance=tolerance, **choices)


def distance(matrix: Array) -> float:
    """Distance from the design, in the rows' largest elements."""
    return float(np.linalg.norm((matrix - DESIGN) / ROBOT.row_scales[:, None]))


def test_the_better_the_design_is_known_the_closer_to_it_is_the_answer() -> None:
    kept = calibrate(RECORDING, unidentified="keep").calibration.matrix_array
    np.testing.assert_allclose(shrunk(1e3).calibration.matrix_array, kept, rtol=0, atol=1e-8)
    np.testing.assert_allclose(shrunk(1e-9).calibration.matrix_array, DESIGN, rtol=0, atol=1e-9)
    distances = [distance(shrunk(tolerance).calibration.matrix_array) for tolerance in (0.001, 0.003, 0.01, 0.03)]
    assert distances == sorted(distances)
    assert shrunk(0.001, calibrator="theoretical").result.shrinkage is None  # which is not fitted


def test_the_posterior_weighs_design_and_data_by_their_variances() -> None:
    """Where covariances commute, by the textbook: each direction by its own variances."""
    free = calibrate(RECORDING, unidentified="keep")
    prior = np.diag(np.repeat(0.01 * ROBOT.row_scales, 3) ** 2)
    of_data = free.uncertainty.covariance
    gain = prior @ np.linalg.inv(prior + of_data)
    expected = DESIGN.ravel() + gain @ (free.calibration.matrix_array - DESIGN).ravel()
    run = shrunk(0.01)
    np.testing.assert_allclose(run.calibration.matrix_array.ravel(), expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(run.uncertainty.covariance, prior - gain @ prior, rtol=1e-5, atol=1e-12)


def test_a_posterior_variance_has_the_degrees_of_freedom_of_the_part_that_the_data_estimate() -> None:
    """Satterthwaite: 2 E^2 / Var of a sum of an exact part and one, w, whose variance is 2 w^2 / f."""
    free, shrunk_little, run = calibrate(RECORDING, unidentified="keep"), shrunk(1e3), shrunk(0.01)
    posterior = run.uncertainty.covariance
    of_data = np.diag(posterior @ np.linalg.solve(free.uncertainty.covariance, posterior))
    variance_of_estimate = 2 * of_data**2 / shrunk_little.result.degrees_of_freedom
    expected = 2 * np.diag(posterior) ** 2 / variance_of_estimate
    assert (of_data < 0.9 * np.diag(posterior)).any()
    np.testing.assert_allclose(run.result.degrees_of_freedom, expected, rtol=1e-3)


def test_the_cost_of_shrinking_is_said_and_certified() -> None:
    run = shrunk(0.003)
    origin = run.calibration.provenance
    assert (origin.unidentified, origin.tolerance) == ("shrink", 0.003)
    certificate = certify_optimum(run.calibration, RECORDING, gap=0.01).certificate
    assert certificate.gap < 0.01
    assert certificate.shrinking == pytest.approx(origin.training_cost / origin.unshrunk_cost - 1, rel=1e-6)
    assert "shrunk to the design, which changes the cost by +" in origin.reason


def test_a_fit_without_any_error_is_shrunk_and_certified_all_the_same() -> None:
    """A single final pose, which a matrix meets to the last bit."""
    (run, *_) = recorded(TRICYCLE, TRICYCLE.inverse_kinematic_matrix, np.random.default_rng(3))
    dataset = make_dataset("tricycle", TRICYCLE, PERIOD, [run], simulated=True)
    calibration = calibrate(dataset, cost="final_pose", unidentified="shrink").calibration
    assert calibration.provenance.unshrunk_cost < 1e-9
    certificate = certify_optimum(calibration, dataset, seconds=1.0).certificate
    assert certificate.cost == calibration.provenance.training_cost
    assert certificate.shrinking is None


def test_a_motion_that_is_not_driven_keeps_the_design() -> None:
    """Runs without turns say nothing of turning."""
    straight = recording(driven([(0.2, 0.0, 0.0), (0.0, 0.2, 0.0)]))
    run = calibrate(straight, unidentified="shrink")
    turning = ROBOT.signal_equations @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(run.calibration.matrix_array @ turning, DESIGN @ turning, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_search_is_shrunk_like_the_optimum() -> None:
    searched = shrunk(0.01, calibrator="crs").calibration.matrix_array
    np.testing.assert_allclose(searched, shrunk(0.01).calibration.matrix_array, rtol=0, atol=1e-5)


def test_robots_whose_wheels_say_their_type_are_shrunk_and_a_tricycle_s_tracked_point_is_fitted_by_default() -> None:
    assert [default_unidentified(robot) for robot in (APR_02, MECANUM, DIFFERENTIAL)] == ["keep", "shrink", "shrink"]
    wheels = tuple(wheel.model_copy(update={"type": "omni"}) for wheel in APR_02.wheels)
    assert default_unidentified(APR_02.model_copy(update={"wheels": wheels})) == "keep"
    assert [default_mount(robot) for robot in (DIFFERENTIAL, TRICYCLE)] == ["known", "fit"]


def test_the_prior_has_the_stated_widths() -> None:
    root = prior_root(SKID, tolerance_of(SKID))
    deviations = np.sqrt(np.diag(root @ root.T)).reshape(3, -1) / SKID.row_scales[:, None]
    elements, rows, centre = TOLERANCES["skid"].elements, TOLERANCES["skid"].rows, TOLERANCES["skid"].centre
    turning = SKID.inverse_kinematic_matrix[2]
    aside = centre * turning / SKID.row_scales[:2, None]
    np.testing.assert_allclose(deviations[0], np.sqrt(elements**2 + rows[0] ** 2 + aside[0] ** 2), rtol=1e-9)
    np.testing.assert_allclose(deviations[1], np.sqrt(elements**2 + aside[1] ** 2), rtol=1e-9)  # zeros have no factor
    np.testing.assert_allclose(deviations[2], np.hypot(elements, rows[2]), rtol=1e-9)


@pytest.mark.slow
def test_a_centre_of_turning_that_is_not_in_the_middle_leaves_a_skid_base_its_turn() -> None:
    """2 cm off, as the mass of a skid-steered base moves it; a prior that knew it to 1.5 mm bent the turn by 0.5 %."""
    turns = [[covered("skid", answer, seed, repetitions=1).errors[2] for answer in ANSWERS] for seed in range(1, 4)]
    assert np.abs(np.diff(np.array(turns), axis=1)).max() < 0.0015


def test_intervals_of_shrunk_answers_hold_the_truth_of_skid_bases() -> None:
    """Rows y and turn of five bases; 30 % held it when the centre of turning counted as known."""
    rows = [covered("skid", "shrink", seed, repetitions=1, slip=5.0) for seed in range(5)]
    ratios = np.array([row.elements[1:] for row in rows])
    assert np.mean(ratios <= 1) > 0.8


@pytest.mark.parametrize(
    "choices", [{"unidentified": "shrink", "intervals": True}, {"unidentified": "keep", "tolerance": 0.01}]
)
def test_resampled_intervals_of_shrunk_answers_and_a_tolerance_without_shrinkage_are_refused(choices: Any) -> None:
    with pytest.raises(ConfigError, match="unidentified"):
        calibrate(RECORDING, **choices)
