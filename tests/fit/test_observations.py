"""Calibrations of runs that have references in the place of poses, and windows whose motion is compared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reference_coverage as study
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
from omnibench.fit.motion_windows import MotionWindows, motions_in_windows
from omnibench.fit.reference_fit import ReferenceFit
from omnibench.fit.reference_rows import ReferenceBatch, reference_rows
from omnibench.robot.odometry import Integration

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


def test_references_of_stored_samples_are_predicted_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def reduced(robot: str, seed: int, kinds: str) -> Dataset:
    """Simulated runs with references of some kinds in the place of their poses."""
    exact, _ = study.simulated(robot, seed)
    return study.reduced(exact, kinds, np.random.default_rng(seed))


@pytest.mark.parametrize("calibrator", ["trajectory_ml", "closed_form", "least_squares"])
def test_exact_references_give_the_true_matrix(calibrator: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("TAPE", "ANGLE"):
        monkeypatch.setattr(study, name, 1e-7)
    exact, truth = study.simulated("omni", 1, encoder=0.0)
    quiet = study.reduced(exact, "displacement and turn", np.random.default_rng(1))
    run = calibrate(quiet, calibrator)
    np.testing.assert_allclose(run.calibration.matrix_array, truth, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["displacement", "distance", "turn", "position"])
def test_intervals_hold_the_truth(kind: str) -> None:
    found = [study.covered(study.Case("diff", kind), seed) for seed in range(6)]
    errors = np.concatenate([each.combinations for each in found])
    assert (np.abs(errors) < 1).mean() > 0.75  # the study of 300 sets is tests/studies/reference_coverage.py


@pytest.mark.parametrize("loss", ["squares", "huber"])
def test_intervals_of_final_errors_hold_the_truth(loss: str) -> None:
    away = []
    for seed in range(3):
        exact, truth = study.simulated("diff", seed)
        run = calibrate(
            study.reduced(exact, "distance and turn", np.random.default_rng(seed)), "closed_form", loss=loss
        )
        away.append((run.calibration.matrix_array - truth)[[0, 2]] / run.uncertainty.standard_deviations[[0, 2]])
    assert np.sqrt(np.mean(np.square(away))) < 2


@pytest.mark.slow
def test_turns_that_share_the_offset_of_a_gyro_have_errors_within_their_intervals() -> None:
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
        away.append((fit.calibration.matrix_array - truth)[2] / fit.uncertainty.standard_deviations[2])
    assert np.sqrt(np.mean(np.square(away))) < 2


def test_only_trajectory_ml_has_intervals_where_positions_do_not_tell_how_runs_start() -> None:
    dataset = reduced("diff", 6, "position")
    assert calibrate(dataset).uncertainty is not None
    run = calibrate(dataset, "closed_form")
    assert run.uncertainty is None
    assert any("positions of 8 runs" in warning and "trajectory_ml" in warning for warning in run.warnings)


@pytest.mark.parametrize(
    ("kind", "open_", "told"), [("distance", ["turning", "x axis"], "lengths"), ("turn", ["lengths"], "turning")]
)
def test_distances_alone_leave_turning_open_and_turns_alone_lengths(kind: str, open_: list[str], told: str) -> None:
    runs = [a_run(seed, [Reference(kind, 1.0, 0.002)]) for seed in range(8)]
    said = " ".join(inspect_dataset(make_dataset("tape", APR_02, 0.1, runs)).findings)
    assert all(each in said for each in ("no reference tells", *open_))
    assert f"of {told}" not in said


def test_what_is_left_open_keeps_the_design_and_has_no_interval() -> None:
    dataset = reduced("omni", 2, "distance")
    run = calibrate(dataset)
    assert np.isnan(run.uncertainty.intervals.low[2]).all()
    np.testing.assert_array_equal(run.calibration.matrix_array[2], dataset.robot.inverse_kinematic_matrix[2])
    assert any("of turning: row 3 (heading) of the matrix keeps the design" in warning for warning in run.warnings)


def test_the_direction_of_the_x_axis_is_open_only_where_the_tracked_point_is_fitted() -> None:
    dataset = reduced("diff", 2, "distance")
    known, fitted = (" ".join(calibrate(dataset, mount=mount).warnings) for mount in ("known", "fit"))
    assert "of turning: row 3 (heading) of the matrix rests on the design and its tolerance" in known
    assert "x axis points" not in known
    assert "x axis points" in fitted


def test_errors_are_told_by_kind_and_in_sigmas() -> None:
    dataset = reduced("diff", 3, "distance and turn")
    run = calibrate(dataset)
    by_kind = {each.kind: each for each in evaluate(run.calibration, dataset).splits["train"].references}
    assert set(by_kind) == {"distance", "turn"}
    assert by_kind["turn"].unit == "rad"
    assert 0.5 < by_kind["distance"].in_sigmas < 1.6


def test_a_mixed_set_uses_poses_and_references() -> None:
    exact, truth = study.simulated("diff", 4)
    part = study.reduced(exact, "distance and turn", np.random.default_rng(4))
    mixed = [*exact.trajectories[::2], *part.trajectories[1::2]]
    dataset = make_dataset("mixed", exact.robot, exact.sample_period, mixed)
    for calibrator in ("trajectory_ml", "closed_form"):
        found = calibrate(dataset, calibrator).calibration.matrix_array
        np.testing.assert_allclose(found, truth, atol=2e-3 * np.abs(truth).max())


def test_what_needs_poses_says_so() -> None:
    dataset = reduced("diff", 5, "turn")
    with pytest.raises(ConfigError, match="reference poses"):
        certify_optimum(calibrate(dataset).calibration, dataset)
    with pytest.raises(DataError, match="final_position"):
        calibrate(dataset, cost="final_position")
    with pytest.raises(ConfigError, match="sigma"):
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
    design = APR_02.inverse_kinematic_matrix
    _, columns = fit.whitened(design, np.eye(design.size))
    information = sum(of_run.T @ of_run for of_run in columns)[-1, -1]  # of the last wheel's share of turning
    # Of 8 headings that count from a heading of their own: the sum of squares of their turns about the mean turn.
    moments = np.arange(1, 9) + later
    turned = (0.3 / APR_02.inverse_kinematic_matrix[2].sum()) * (moments - moments.mean())
    assert information == pytest.approx(6 * np.square(turned).sum() / 0.05**2, rel=0.02)


RADIUS, TURN = 2.0, 0.5  # m, rad/s


def on_a_circle(seconds: float, name: str = "run") -> Trajectory:
    """A run whose only wheel turns as fast as it drives, in m, on a circle to the left."""
    times, stamps = 0.02 * np.arange(1, round(seconds / 0.02) + 1), np.append(np.arange(0.0, seconds, 0.1), seconds)
    heading = 0.3 + TURN * stamps
    poses = np.column_stack([RADIUS * np.sin(heading), -RADIUS * np.cos(heading), heading])
    return Trajectory(name, "train", times, np.full((len(times), 1), RADIUS * TURN), stamps, poses)


def test_motions_by_exact_arcs_are_the_references_own() -> None:
    windows = MotionWindows.of([on_a_circle(5.0), on_a_circle(3.03, "b")], (2.0, math.inf), 0.25, 1000)
    twists = windows.drive @ np.array([[1.0, 0.0, 1 / RADIUS]])
    moved = motions_in_windows(twists, windows.durations, windows.windows)
    np.testing.assert_allclose(moved, windows.motions, atol=1e-12)
    angle = TURN * 5.0
    whole = windows.motions[(windows.lengths == 1) & (windows.windows[:, 0] == 0)]
    np.testing.assert_allclose(whole, [[RADIUS * math.sin(angle), RADIUS * (1 - math.cos(angle)), angle]], atol=1e-12)


def test_windows_are_as_long_as_wanted_and_begin_every_half_of_it() -> None:
    windows = MotionWindows.of([on_a_circle(5.0)], (2.0,), 0.1, 1000)
    edges = np.append(0.0, np.cumsum(windows.durations[0]))
    np.testing.assert_allclose(edges[windows.windows[:, 1]], [0, 1, 2, 3], atol=1e-9)
    np.testing.assert_allclose(edges[windows.windows[:, 2]], [2, 3, 4, 5], atol=1e-9)


@pytest.mark.parametrize(("step", "most", "count"), [(0.1, 1000, 50), (0.5, 1000, 10), (0.1, 10, 10)])
def test_steps_are_as_long_as_wanted_or_as_few_as_allowed(step: float, most: int, count: int) -> None:
    assert MotionWindows.of([on_a_circle(5.0)], (math.inf,), step, most).drive.shape == (1, count, 1)
