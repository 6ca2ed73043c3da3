"""Calibrating one robot from one data set."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fit_samples import noisy_trajectories
from motions import RING, driven
from rich.console import Console

from omnibench.cli.terminal.calibration_tables import print_calibration
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.environment import package_versions
from omnibench.errors import ConfigError, DataError, UnknownNameError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.calibrator import Outcome
from omnibench.fit.evaluate import evaluate
from omnibench.fit.geometry import GeometryLimits
from omnibench.fit.problem import Budget
from omnibench.progress import Progress
from omnibench.registry import costs
from omnibench.robot.calibration import read_calibration, write_calibration
from omnibench.testing.synthetic import synthetic_robot

ROBOT = synthetic_robot()


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    """Eight runs to train and four to validate."""
    runs = noisy_trajectories()
    held_out = (replace(run, split="validation") for run in runs[8:])
    return make_dataset("synthetic", ROBOT, 0.2, [*runs[:8], *held_out], simulated=True)


def test_the_provenance_tells_where_a_calibration_comes_from(dataset: Dataset) -> None:
    run = calibrate(dataset, "crs", options={"tolerance": 1e-3}, cost="trajectory", box="paper", seed=7)
    origin = run.calibration.provenance
    assert origin is not None
    assert (origin.dataset, origin.dataset_hash, origin.simulated) == ("synthetic", dataset.hash, True)
    assert (origin.calibrator, origin.seed, origin.cost, origin.box) == ("crs", 7, "trajectory", "paper")
    assert origin.options == {"population": None, "tolerance": 1e-3, "step": 1e-8}
    assert origin.versions == package_versions()
    assert (origin.outcome, origin.reason) == ("converged", run.result.reason)


@pytest.mark.parametrize("cost", ["final_pose", "final_position", "final_heading", "trajectory"])
def test_the_costs_of_the_provenance_are_of_the_cost_it_names(dataset: Dataset, cost: str) -> None:
    run = calibrate(dataset, cost=cost)
    origin = run.calibration.provenance
    assert origin is not None
    assert origin.training_cost == run.result.cost
    objective = costs.create(cost)
    batch = objective.batch(dataset.split("validation"), "arc")
    errors = batch.poses(run.calibration.matrix_array[None]) - objective.reference(dataset.split("validation"))
    assert origin.validation_cost == pytest.approx(objective.combine(errors, batch.trajectory)[0], rel=1e-12)


def test_eq_6_of_the_provenance_is_that_of_evaluate(dataset: Dataset) -> None:
    calibration = calibrate(dataset).calibration
    splits = evaluate(calibration, dataset).splits
    assert calibration.provenance is not None
    assert calibration.provenance.training_cost == pytest.approx(splits["train"].cost, rel=1e-12)
    assert calibration.provenance.validation_cost == pytest.approx(splits["validation"].cost, rel=1e-12)


def test_without_validation_runs_there_is_no_validation_cost() -> None:
    calibration = calibrate(make_dataset("train only", ROBOT, 0.2, noisy_trajectories())).calibration
    assert calibration.provenance is not None
    assert calibration.provenance.validation_cost is None


def test_the_calibration_has_the_robot_the_matrix_and_the_integration(dataset: Dataset) -> None:
    run = calibrate(dataset, integration="euler")
    assert (run.calibration.robot, run.calibration.sample_period) == (ROBOT, 0.2)
    assert run.calibration.integration == "euler"
    np.testing.assert_array_equal(run.calibration.matrix_array, run.result.matrix)


def test_a_calibration_can_be_written_and_read(dataset: Dataset, tmp_path: Path) -> None:
    calibration = calibrate(dataset).calibration
    write_calibration(calibration, tmp_path / "calibration.yaml")
    assert read_calibration(tmp_path / "calibration.yaml") == calibration


def test_only_training_runs_matter(dataset: Dataset) -> None:
    spoilt = [
        replace(run, poses=run.poses * [1.2, 1.0, 1.0]) if run.split == "validation" else run
        for run in dataset.trajectories
    ]
    other = make_dataset("spoilt", ROBOT, 0.2, spoilt)
    first, second = (calibrate(each).calibration.matrix for each in (dataset, other))
    assert first == second


def test_the_same_seed_gives_the_same_calibration(dataset: Dataset) -> None:
    matrices = [
        calibrate(dataset, "crs", seed=seed, budget=Budget(evaluations=500)).calibration.matrix for seed in (1, 1, 2)
    ]
    assert matrices[0] == matrices[1] != matrices[2]


def test_a_spent_budget_still_gives_a_calibration(dataset: Dataset) -> None:
    run = calibrate(dataset, "crs", budget=Budget(evaluations=100))
    assert run.result.outcome is Outcome.BUDGET
    assert run.calibration.provenance is not None
    assert run.calibration.provenance.outcome == "budget"


def test_parametric_searches_the_geometry_without_being_told(dataset: Dataset) -> None:
    limits = GeometryLimits(radius=0.05, distance=0.1, angle_deg=0.0)
    run = calibrate(dataset, "parametric", limits=limits, budget=Budget(evaluations=300))
    assert run.calibration.provenance is not None
    assert run.calibration.provenance.box == "limits"
    assert run.result.vector is not None
    np.testing.assert_array_equal(run.result.vector[6:], [wheel.angle for wheel in ROBOT.wheels])


def test_any_search_can_take_either_parameterisation(dataset: Dataset) -> None:
    run = calibrate(dataset, "crs", parameterisation="geometry", budget=Budget(evaluations=300))
    assert run.result.vector is not None
    assert run.result.vector[0] == pytest.approx(0.148, rel=0.1)


def test_intervals_are_drawn_on_demand(dataset: Dataset) -> None:
    assert calibrate(dataset).intervals is None
    intervals = calibrate(dataset, intervals=True).intervals
    assert intervals is not None
    assert (intervals.low <= intervals.high).all()


def test_many_runs_of_two_commands_have_no_resampled_intervals_and_it_is_said(dataset: Dataset) -> None:
    runs = [replace(run, command=f"{index % 2}") for index, run in enumerate(dataset.split("train"))]
    run = calibrate(make_dataset("two", ROBOT, 0.2, runs), intervals=True)
    assert run.intervals is None
    assert "no resampled intervals: no interval from 2 commands; 3 are needed" in run.warnings
    three = [replace(each, command=f"{index % 3}") for index, each in enumerate(runs)]
    found = calibrate(make_dataset("three", ROBOT, 0.2, three), intervals=True)
    assert found.intervals is not None
    assert found.units.words == "Student's t over 3 commands"


def test_noise_and_covariance_are_written_with_the_calibration(dataset: Dataset) -> None:
    run = calibrate(dataset)
    assert run.uncertainty is not None
    assert run.calibration.noise == run.uncertainty.noise
    np.testing.assert_array_equal(run.calibration.covariance, run.uncertainty.covariance)
    assert run.warnings == ()


def test_a_matrix_that_was_not_fitted_has_no_covariance_and_needs_no_word_of_it(dataset: Dataset) -> None:
    run = calibrate(dataset, "theoretical")
    assert (run.uncertainty, run.calibration.noise, run.calibration.covariance, run.warnings) == (None, None, None, ())


def test_a_search_that_stops_far_from_the_minimum_has_no_covariance_and_says_why(dataset: Dataset) -> None:
    run = calibrate(dataset, "random_search", options={"candidates": 20})
    assert run.uncertainty is None
    assert run.warnings[0].startswith("no covariance: the answer does not minimise the cost (a better one is at least ")
    assert run.warnings[0].endswith(" standard deviations away); search longer or take another calibrator")


def test_runs_that_are_fitted_exactly_have_no_intervals(dataset: Dataset) -> None:
    few = make_dataset("few", dataset.robot, dataset.sample_period, dataset.split("train")[:2])
    run = calibrate(few, intervals=True)
    assert run.uncertainty is None
    assert run.intervals is None


@pytest.mark.parametrize("calibrator", ["closed_form", "crs"])
def test_what_the_data_do_not_identify_is_kept_and_told(calibrator: str) -> None:
    runs = driven(RING, slip=0.02)
    run = calibrate(make_dataset("straight", ROBOT, 0.1, runs), calibrator, budget=Budget(evaluations=500))
    change = run.calibration.matrix_array - ROBOT.inverse_kinematic_matrix
    np.testing.assert_allclose(change.sum(axis=1), 0, atol=1e-15)
    assert run.warnings[0].endswith("kept at the design values")


def test_told_to_fit_it_calibration_fits_it_and_says_what_that_rests_on() -> None:
    run = calibrate(make_dataset("straight", ROBOT, 0.1, driven(RING, slip=0.02)), unidentified="fit")
    change = run.calibration.matrix_array - ROBOT.inverse_kinematic_matrix
    assert np.abs(change.sum(axis=1)).max() > 1e-4
    assert run.warnings[0].endswith("what was fitted there rests on slip and noise")


def test_a_searched_geometry_cannot_keep_it_and_says_so() -> None:
    straight = make_dataset("straight", ROBOT, 0.1, driven(RING, slip=0.02))
    run = calibrate(straight, "parametric", budget=Budget(evaluations=500))
    assert "the geometry cannot keep design values there" in run.warnings[0]


def test_progress_is_shown(dataset: Dataset) -> None:
    shown: list[Progress] = []

    def enough(event: Progress) -> None:
        shown.append(event)
        if len(shown) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        calibrate(dataset, "random_search", budget=Budget(evaluations=10**9), watch=enough)
    assert {event.task for event in shown} == {"random_search"}
    assert [event.done for event in shown] == sorted(event.done for event in shown)


def refused(dataset: Dataset, error: type[Exception], **arguments: Any) -> str:
    with pytest.raises(error) as refusal:
        calibrate(dataset, **arguments)
    assert "\n" not in str(refusal.value)
    return str(refusal.value)


def test_an_empty_training_split_is_refused_in_one_line() -> None:
    held_out = [replace(run, split="validation") for run in noisy_trajectories()]
    message = refused(make_dataset("held out", ROBOT, 0.2, held_out), DataError)
    assert message == ("data set held out: the training split is empty; set split to train for some trajectories")


def test_an_unknown_calibrator_is_answered_with_the_nearest_and_all(dataset: Dataset) -> None:
    message = refused(dataset, UnknownNameError, calibrator="closed_from")
    assert message.startswith("unknown calibrator 'closed_from'; did you mean 'closed_form'? known: ")
    for name in ("crs", "genetic", "isres", "parametric", "theoretical"):
        assert name in message


def test_an_unknown_cost_is_answered_with_all(dataset: Dataset) -> None:
    assert "unknown cost 'final'; " in refused(dataset, UnknownNameError, cost="final")


def test_an_unknown_option_is_answered_with_the_nearest(dataset: Dataset) -> None:
    message = refused(dataset, ConfigError, calibrator="crs", options={"populations": 3})
    assert "calibrator 'crs': unknown key 'populations'; did you mean 'population'?" in message


def test_a_calibrator_that_gives_no_answer_says_why(dataset: Dataset) -> None:
    message = refused(dataset, ConfigError, parameterisation="geometry")
    assert message.startswith("calibrator 'closed_form' gave no answer (failed): closed_form works on the matrix")


def test_intervals_of_a_search_are_refused_before_it_runs(dataset: Dataset) -> None:
    shown: list[Progress] = []
    message = refused(dataset, ConfigError, calibrator="crs", intervals=True, watch=shown.append)
    assert "use the calibrator closed_form" in message
    assert not shown


def printed(run: CalibrationRun) -> str:
    """What ``calibrate`` prints of a run."""
    stream = io.StringIO()
    print_calibration(Console(file=stream, width=160), run)
    return stream.getvalue()


def test_intervals_that_hold_only_if_kept_values_are_right_are_marked_on_their_row() -> None:
    straight = make_dataset("straight", ROBOT, 0.1, driven(RING, slip=0.02))
    told = printed(calibrate(straight))
    (row,) = [line for line in told.splitlines() if line.startswith("  95 %")][:1]
    assert row.count("*") == 3
    assert "* only if the design values are right along a + b + c (turning on the spot)" in told
    assert "*" not in printed(calibrate(straight, unidentified="fit"))


def test_an_angle_deviates_in_degrees(dataset: Dataset) -> None:
    run = calibrate(dataset)
    assert run.uncertainty is not None
    assert run.uncertainty.parameters is not None
    angle = next(each for each in run.uncertainty.parameters if each.name == "angle_a")
    row = next(line for line in printed(run).splitlines() if line.startswith("angle_a"))
    assert f" {math.degrees(angle.value - ROBOT.wheels[0].angle):+.3f} deg " in row
    assert "%" not in row
