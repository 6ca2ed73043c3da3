"""Calibrating one robot from one data set."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import refused
from fit_samples import noisy_trajectories
from motions import RING, driven
from rich.console import Console

from omnibench.cli.terminal.calibration_tables import print_calibration
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.environment import package_versions
from omnibench.errors import ConfigError, DataError, UnknownNameError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.calibrator import Outcome, calibration_of_fit
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
    assert (origin.dataset, origin.dataset_hash, origin.simulated) == ("synthetic", dataset.hash, True)
    assert (origin.calibrator, origin.seed, origin.cost, origin.box) == ("crs", 7, "trajectory", "paper")
    assert origin.options == {"population": None, "tolerance": 1e-3, "step": 1e-8}
    assert origin.versions == package_versions()
    assert (origin.outcome, origin.reason) == ("converged", run.result.reason)


@pytest.mark.parametrize("cost", ["final_pose", "final_position", "final_heading", "trajectory"])
def test_the_costs_of_the_provenance_are_of_the_cost_it_names(dataset: Dataset, cost: str) -> None:
    run = calibrate(dataset, cost=cost)
    origin = run.calibration.provenance
    assert origin.training_cost == run.result.cost
    objective = costs.create(cost)
    batch = objective.batch(dataset.split("validation"), "arc")
    errors = batch.poses(run.calibration.matrix_array[None]) - objective.reference(dataset.split("validation"))
    assert origin.validation_cost == pytest.approx(objective.combine(errors, batch.trajectory)[0], rel=1e-12)


def test_eq_6_of_the_provenance_is_that_of_evaluate_and_its_file_comes_back(dataset: Dataset, tmp_path: Path) -> None:
    calibration = calibrate(dataset).calibration
    splits = evaluate(calibration, dataset).splits
    assert calibration.provenance.training_cost == pytest.approx(splits["train"].cost, rel=1e-12)
    assert calibration.provenance.validation_cost == pytest.approx(splits["validation"].cost, rel=1e-12)
    write_calibration(calibration, tmp_path / "calibration.yaml")
    assert read_calibration(tmp_path / "calibration.yaml") == calibration


def test_the_calibration_has_the_robot_the_matrix_and_the_integration(dataset: Dataset) -> None:
    run = calibrate(dataset, integration="euler")
    assert (run.calibration.robot, run.calibration.sample_period) == (ROBOT, 0.2)
    assert run.calibration.integration == "euler"
    np.testing.assert_array_equal(run.calibration.matrix_array, run.result.matrix)


def test_values_that_no_robot_has_lead_back_to_the_recordings(dataset: Dataset) -> None:
    choices = {"calibrator": "crs", "seed": 1, "cost": "final_pose", "box": "row", "outcome": "converged"}
    with pytest.raises(DataError, match=r"^calibration 'far': matrix.*; check the recordings for poses and rates far"):
        calibration_of_fit("far", dataset, np.full((3, 3), 1e9), choices, integration="arc")


def test_only_training_runs_matter(dataset: Dataset) -> None:
    spoilt = [
        replace(run, poses=run.poses * [1.2, 1.0, 1.0]) if run.split == "validation" else run
        for run in dataset.trajectories
    ]
    alone = make_dataset("train only", ROBOT, 0.2, dataset.split("train"))
    first, second, third = (
        calibrate(each).calibration for each in (dataset, make_dataset("x", ROBOT, 0.2, spoilt), alone)
    )
    assert first.matrix == second.matrix == third.matrix
    assert third.provenance.validation_cost is None


def test_the_same_seed_gives_the_same_calibration(dataset: Dataset) -> None:
    matrices = [
        calibrate(dataset, "crs", seed=seed, budget=Budget(evaluations=500)).calibration.matrix for seed in (1, 1, 2)
    ]
    assert matrices[0] == matrices[1] != matrices[2]


def test_a_spent_budget_still_gives_a_calibration(dataset: Dataset) -> None:
    run = calibrate(dataset, "crs", budget=Budget(evaluations=100))
    assert run.result.outcome is Outcome.BUDGET
    assert run.calibration.provenance.outcome == "budget"


def test_parametric_searches_the_geometry_without_being_told_and_any_search_can(dataset: Dataset) -> None:
    limits = GeometryLimits(radius=0.05, distance=0.1, angle_deg=0.0)
    run = calibrate(dataset, "parametric", limits=limits, budget=Budget(evaluations=300))
    assert run.calibration.provenance.box == "limits"
    np.testing.assert_array_equal(run.result.vector[6:], [wheel.angle for wheel in ROBOT.wheels])
    other = calibrate(dataset, "crs", parameterisation="geometry", budget=Budget(evaluations=300))
    assert other.result.vector[0] == pytest.approx(0.148, rel=0.1)


def test_many_runs_of_two_commands_have_no_resampled_intervals_and_it_is_said(dataset: Dataset) -> None:
    runs = dataset.split("train")
    two, three = ([replace(run, command=f"{k % commands}") for k, run in enumerate(runs)] for commands in (2, 3))
    run = calibrate(make_dataset("two", ROBOT, 0.2, two), intervals=True)
    assert run.intervals is None
    assert any("2 commands" in warning for warning in run.warnings)
    found = calibrate(make_dataset("three", ROBOT, 0.2, three), intervals=True)
    assert found.intervals is not None
    assert found.units.words == "Student's t over 3 commands"
    assert calibrate(dataset).intervals is None
    exact = calibrate(make_dataset("few", ROBOT, 0.2, runs[:2]), intervals=True)
    assert (exact.uncertainty, exact.intervals) == (None, None)


def test_noise_and_covariance_are_written_with_a_calibration_that_was_fitted(dataset: Dataset) -> None:
    run = calibrate(dataset)
    assert run.calibration.noise == run.uncertainty.noise
    np.testing.assert_array_equal(run.calibration.covariance, run.uncertainty.covariance)
    assert run.warnings == ()
    design = calibrate(dataset, "theoretical")
    assert (design.uncertainty, design.calibration.noise, design.calibration.covariance) == (None, None, None)
    assert design.warnings == ()
    short = calibrate(dataset, "random_search", options={"candidates": 20})
    assert short.uncertainty is None
    assert "standard deviations away" in short.warnings[0]


def straight() -> Dataset:
    """Runs that translate only."""
    return make_dataset("straight", ROBOT, 0.1, driven(RING, slip=0.02))


@pytest.mark.parametrize("calibrator", ["closed_form", "crs"])
def test_what_the_data_do_not_identify_is_kept_and_told(calibrator: str) -> None:
    run = calibrate(straight(), calibrator, budget=Budget(evaluations=500))
    change = run.calibration.matrix_array - ROBOT.inverse_kinematic_matrix
    np.testing.assert_allclose(change.sum(axis=1), 0, atol=1e-15)
    assert run.warnings[0].endswith("kept at the design values")


def test_what_is_fitted_all_the_same_rests_on_slip_and_noise() -> None:
    run = calibrate(straight(), unidentified="fit")
    change = run.calibration.matrix_array - ROBOT.inverse_kinematic_matrix
    assert np.abs(change.sum(axis=1)).max() > 1e-4
    geometry = calibrate(straight(), "parametric", budget=Budget(evaluations=500))
    for warnings in (run.warnings, geometry.warnings):
        assert "rests on slip and noise" in warnings[0]


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


@pytest.mark.parametrize(
    ("arguments", "error", "named"),
    [
        ({"calibrator": "closed_from"}, UnknownNameError, ("'closed_from'", "'closed_form'", "genetic", "theoretical")),
        ({"cost": "final"}, UnknownNameError, ("'final'", "final_pose")),
        ({"calibrator": "crs", "options": {"populations": 3}}, ConfigError, ("'crs'", "'populations'", "'population'")),
        ({"parameterisation": "geometry"}, ConfigError, ("'closed_form'",)),
        ({"calibrator": "crs", "intervals": True}, ConfigError, ("closed_form",)),
    ],
)
def test_what_cannot_be_calibrated_so_is_refused_in_one_line_before_a_search(
    dataset: Dataset, arguments: dict[str, Any], error: type[Exception], named: tuple[str, ...]
) -> None:
    shown: list[Progress] = []
    with refused(error, *named):
        calibrate(dataset, **arguments, watch=shown.append)
    assert not shown


def test_an_empty_training_split_is_refused() -> None:
    held_out = [replace(run, split="validation") for run in noisy_trajectories()]
    with pytest.raises(DataError, match="held out: the training split is empty"):
        calibrate(make_dataset("held out", ROBOT, 0.2, held_out))


def printed(run: CalibrationRun) -> str:
    """What ``calibrate`` prints of a run."""
    stream = io.StringIO()
    print_calibration(Console(file=stream, width=160), run)
    return stream.getvalue()


def test_intervals_that_hold_only_if_kept_values_are_right_are_marked_on_their_row() -> None:
    told = printed(calibrate(straight()))
    row = next(line for line in told.splitlines() if line.startswith("  95 %"))
    assert row.count("*") == 3
    assert "* only if the design values are right along a + b + c" in told
    assert "*" not in printed(calibrate(straight(), unidentified="fit"))


def test_an_angle_deviates_in_degrees(dataset: Dataset) -> None:
    run = calibrate(dataset)
    angle = next(each for each in run.uncertainty.parameters if each.name == "angle_a")
    row = next(line for line in printed(run).splitlines() if line.startswith("angle_a"))
    assert f" {math.degrees(angle.value - ROBOT.wheels[0].angle):+.3f} deg " in row
    assert "%" not in row
