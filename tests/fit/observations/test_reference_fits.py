"""Calibrations of runs that have references in the place of poses: derivatives, truth, intervals, what stays open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sample_robots import APR_02

import omnibench.robot.stored_odometry as odometry_of_stored
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.references import Reference, References
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.certify import certify_optimum
from omnibench.fit.evaluate import evaluate
from omnibench.fit.inspect import inspect_dataset
from omnibench.fit.reference_fit import ReferenceFit
from omnibench.fit.reference_rows import ReferenceBatch, reference_rows
from omnibench.robot.odometry import Integration
from omnibench.robot.stored_odometry import StoredOdometry

STUDY = Path(__file__).parents[2] / "studies"
TIMES = 0.1 * np.arange(1, 101)


def a_run(seed: int, references: Sequence[Reference], **known: bool) -> Trajectory:
    """A run on a curve of its own, of which something was measured."""
    rng = np.random.default_rng(seed)
    rates = 2 * rng.normal(size=3) + np.sin(TIMES)[:, None] * rng.normal(size=3)
    poses = np.array([[1.0, 2.0, 0.5]]) if known else np.zeros((1, 3))
    given = References.of(references, 10.0, **known)
    return Trajectory(f"run-{seed}", "train", TIMES, rates, np.zeros(1), poses, references=given)


def every_kind(seed: int) -> list[Reference]:
    """References of every kind with values that are far off any model."""
    rng = np.random.default_rng([seed, 1])
    return [
        Reference("distance", 1.0, 0.01, t0=1.0, t1=7.03),
        Reference("turn", 0.5, 0.02, t0=1.0, t1=7.03),
        Reference("displacement", (0.3, 0.4), (0.02, 0.05), t0=2.0, t1=8.0),
        Reference("heading", 0.3, 0.1, t0=0.0, t1=9.0),
        *(Reference("position", tuple(rng.normal(size=2)), (0.02, 0.05), t1=t) for t in (1.0, 3.3, 5.0, 9.0)),
        *(Reference("heading", float(rng.normal()), 0.1, t1=t) for t in (2.0, 5.0, 8.0)),
    ]


def test_references_of_samples_that_stay_in_their_file_are_predicted_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = [a_run(seed, every_kind(seed)) for seed in range(3)]
    save_dataset(make_dataset("measured", APR_02, 0.1, held), tmp_path / "saved")
    batches = []
    for most in (10**6, 0):
        monkeypatch.setattr(odometry_of_stored, "_HELD", most)
        runs = load_dataset(tmp_path / "saved", most_in_memory=most).trajectories
        batches.append(ReferenceBatch(reference_rows(runs, "reference"), "arc"))
    matrices = APR_02.inverse_kinematic_matrix * np.array([1.0, 1.03])[:, None, None]
    np.testing.assert_allclose(batches[1].poses(matrices), batches[0].poses(matrices), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(
        batches[1].jacobian(matrices[1]), batches[0].jacobian(matrices[1]), rtol=1e-12, atol=1e-12
    )
    assert isinstance(batches[1]._odometry, StoredOdometry)


@pytest.mark.parametrize("integration", ["arc", "euler"])
def test_derivatives_hold_for_every_kind_with_known_and_unknown_starts(integration: Integration) -> None:
    runs = [a_run(0, every_kind(0), start_known=True), a_run(1, every_kind(1)), a_run(2, every_kind(2))]
    batch = ReferenceBatch(reference_rows(runs, "reference"), integration)
    matrix = 1.03 * APR_02.inverse_kinematic_matrix
    steps = 1e-6 * np.eye(9).reshape(9, 3, 3)
    differences = (batch.poses(matrix + steps) - batch.poses(matrix - steps)) / 2e-6
    np.testing.assert_allclose(
        np.moveaxis(differences, 0, 2).reshape(-1, 9), batch.jacobian(matrix).reshape(-1, 9), atol=1e-7
    )


def test_an_unknown_start_is_where_the_positions_fit_best() -> None:
    (run,) = [a_run(3, [Reference("position", (0.0, 0.0), 0.1, t1=t) for t in (2.0, 4.0, 6.0, 8.0)])]
    rows = reference_rows([run], "reference")
    batch = ReferenceBatch(rows, "arc")
    design = APR_02.inverse_kinematic_matrix[None]
    driven = batch._odometry.poses(design)[0][:, :2]
    turned = driven @ [[np.cos(2.5), np.sin(2.5)], [-np.sin(2.5), np.cos(2.5)]] + [7.0, -3.0]
    given = [
        Reference("position", (float(x), float(y)), 0.1, t1=t) for t, (x, y) in zip((2, 4, 6, 8), turned, strict=True)
    ]
    exact = ReferenceBatch(reference_rows([a_run(3, given)], "reference"), "arc")
    np.testing.assert_allclose(exact.poses(design)[0], exact.rows.observed, atol=1e-12)


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(STUDY))
    import reference_coverage

    return reference_coverage


def a_set(*kinds: Sequence[Reference]) -> Dataset:
    return make_dataset("tape", APR_02, 0.1, [a_run(seed, given) for seed, given in enumerate(kinds)])


@pytest.mark.parametrize("calibrator", ["trajectory_ml", "closed_form", "least_squares"])
def test_exact_references_give_the_true_matrix(study, calibrator: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("TAPE", "ANGLE"):
        monkeypatch.setattr(study, name, 1e-7)
    exact, truth = study.simulated("omni", 1, encoder=0.0)
    quiet = study.reduced(exact, "displacement and turn", np.random.default_rng(1))
    run = calibrate(quiet, calibrator)
    np.testing.assert_allclose(run.calibration.matrix_array, truth, atol=1e-6)


@pytest.mark.parametrize("kind", ["distance", "turn", "displacement", "position"])
def test_intervals_hold_the_truth(study, kind: str) -> None:
    found = [study.covered(study.Case("diff", kind), seed) for seed in range(6)]
    errors = np.concatenate([each.combinations for each in found])
    assert (np.abs(errors) < 1).mean() > 0.75  # the study of 300 sets is tests/studies/reference_coverage.py


def test_turns_that_share_the_offset_of_a_gyro_have_errors_within_their_intervals(study) -> None:
    offset_sigma = 0.01  # rad/s: ten times what the noise leaves of a turn of a second

    def of_gyro(run: Trajectory, offset: float, rng: np.random.Generator) -> Trajectory:
        headings = np.interp(edges := np.arange(0.0, run.pose_times[-1], 1.0), run.pose_times, run.poses[:, 2])
        turned = np.diff(headings) + offset + 0.001 * rng.normal(size=len(edges) - 1)
        turns = [Reference("turn", float(v), 0.001, t, t - 1) for v, t in zip(turned, edges[1:], strict=True)]
        given = References.of(turns, float(run.times[-1]), rate_sigma=offset_sigma)
        return replace(run, session="day", pose_times=np.zeros(1), poses=np.zeros((1, 3)), references=given)

    away = []
    for seed in range(6):
        exact, truth = study.simulated("diff", seed)
        rng = np.random.default_rng(seed)
        runs = [of_gyro(run, offset_sigma * (-1.5) ** (seed % 2), rng) for run in exact.trajectories]
        fit = calibrate(make_dataset("gyro", exact.robot, exact.sample_period, runs))
        assert fit.uncertainty is not None
        away.append((fit.calibration.matrix_array - truth)[2] / fit.uncertainty.standard_deviations[2])
    assert np.sqrt(np.mean(np.square(away))) < 2


def test_only_trajectory_ml_has_intervals_where_positions_do_not_tell_how_runs_start(study) -> None:
    exact, _ = study.simulated("diff", 6)
    dataset = study.reduced(exact, "position", np.random.default_rng(6))
    assert calibrate(dataset).uncertainty is not None
    run = calibrate(dataset, "closed_form")
    assert run.uncertainty is None
    assert any("positions of 8 runs" in warning and "trajectory_ml" in warning for warning in run.warnings)


def test_distances_alone_leave_turning_and_the_direction_of_x_open() -> None:
    dataset = a_set(*[[Reference("distance", 1.0, 0.002)]] * 8)
    said = " ".join(inspect_dataset(dataset).findings)
    assert "no reference tells of turning" in said
    assert "no reference tells which way the robot's x axis points" in said


def test_turns_alone_leave_lengths_open() -> None:
    said = " ".join(inspect_dataset(a_set(*[[Reference("turn", 1.0, 0.002)]] * 8)).findings)
    assert "no reference tells of lengths" in said
    assert "of turning" not in said


def test_what_is_left_open_keeps_the_design_and_has_no_interval(study) -> None:
    exact, _ = study.simulated("omni", 2)
    dataset = study.reduced(exact, "distance", np.random.default_rng(2))
    run = calibrate(dataset)
    assert run.uncertainty is not None
    assert np.isnan(run.uncertainty.intervals.low[2]).all()
    np.testing.assert_array_equal(run.calibration.matrix_array[2], dataset.robot.inverse_kinematic_matrix[2])
    assert any("no reference tells of turning" in warning for warning in run.warnings)


def test_errors_are_told_by_kind_and_in_sigmas(study) -> None:
    exact, _ = study.simulated("diff", 3)
    dataset = study.reduced(exact, "distance and turn", np.random.default_rng(3))
    run = calibrate(dataset)
    by_kind = {each.kind: each for each in evaluate(run.calibration, dataset).splits["train"].references}
    assert set(by_kind) == {"distance", "turn"}
    assert by_kind["turn"].unit == "rad"
    assert 0.5 < by_kind["distance"].in_sigmas < 1.6


def test_a_mixed_set_uses_poses_and_references(study) -> None:
    exact, truth = study.simulated("diff", 4)
    part = study.reduced(exact, "distance and turn", np.random.default_rng(4))
    mixed = [
        (whole if index % 2 else other)
        for index, (whole, other) in enumerate(zip(exact.trajectories, part.trajectories, strict=True))
    ]
    dataset = make_dataset("mixed", exact.robot, exact.sample_period, mixed)
    for calibrator in ("trajectory_ml", "closed_form"):
        found = calibrate(dataset, calibrator).calibration.matrix_array
        np.testing.assert_allclose(found, truth, atol=2e-3 * np.abs(truth).max())


def test_what_needs_poses_says_so_in_one_line(study) -> None:
    exact, _ = study.simulated("diff", 5)
    dataset = study.reduced(exact, "turn", np.random.default_rng(5))
    calibration = calibrate(dataset).calibration
    with pytest.raises(ConfigError, match="a lower bound is proven for reference poses alone"):
        certify_optimum(calibration, dataset)
    with pytest.raises(DataError, match="has no reference of its position, which the cost final_position needs"):
        calibrate(dataset, cost="final_position")
    with pytest.raises(ConfigError, match="weighs references that are no poses by their own sigma"):
        calibrate(dataset, "trajectory_ml", loss="huber")


@pytest.mark.parametrize("later", [0.0, 0.01])
def test_a_compass_has_its_weight_beside_positions_that_tell_no_heading_of_the_same_time(later: float) -> None:
    """Runs that turn on the spot; their positions count for nothing, whenever they were taken."""
    rates = np.tile(APR_02.signal_equations @ np.array([0.0, 0.0, 0.3]), (100, 1))
    runs = []
    for seed in range(6):
        noise = np.random.default_rng(seed).normal(0.0, 0.05, 8)
        measured = [Reference("position", (0.0, 0.0), 0.5, t1=float(t)) for t in range(1, 9)]
        measured += [Reference("heading", 0.3 * t + noise[t - 1], 0.05, t1=t + later) for t in range(1, 9)]
        given = References.of(measured, 10.0)
        runs.append(Trajectory(f"spot-{seed}", "train", TIMES, rates, np.zeros(1), np.zeros((1, 3)), references=given))
    fit = ReferenceFit.of(runs, APR_02.inverse_kinematic_matrix, "arc")
    assert fit is not None
    design = APR_02.inverse_kinematic_matrix
    _, columns = fit.whitened(design, np.eye(design.size))
    information = sum(of_run.T @ of_run for of_run in columns)[-1, -1]  # of the last wheel's share of turning
    # Of 8 headings that count from a heading of their own: the sum of squares of their turns about the mean turn.
    moments = np.arange(1, 9) + later
    turned = (0.3 / APR_02.inverse_kinematic_matrix[2].sum()) * (moments - moments.mean())
    assert information == pytest.approx(6 * np.square(turned).sum() / 0.05**2, rel=0.02)
