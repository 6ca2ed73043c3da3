"""Fits of robots on every kind of wheel and of their steering, on simulated recordings and on real ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reference_coverage as study
from corelli import corelli_dataset, half
from numpy.typing import NDArray
from sample_robots import APR_02, CAR, DIFFERENTIAL, TRICYCLE, WHEELED
from wheeled_recordings import PERIOD, path, recorded

import omnibench.robot.stored_odometry as odometry_of_stored
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.references import Reference, References
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.certify import certify_optimum
from omnibench.fit.cost import Cost
from omnibench.fit.evaluate import evaluate, final_errors
from omnibench.fit.geometry import WheelGeometry
from omnibench.fit.inspect import inspect_dataset
from omnibench.fit.motion_windows import MotionWindows, motions_in_windows
from omnibench.fit.reference_fit import ReferenceFit
from omnibench.fit.reference_rows import ReferenceBatch, reference_rows
from omnibench.fit.settings import FitSettings
from omnibench.fit.steering_fit import SteeringFit
from omnibench.registry import costs
from omnibench.robot.kinematics import Array, Mount, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration

EVERY = [pytest.param(robot, id=robot.name) for robot in WHEELED]


def recording(robot: Robot, matrix: Array, noise: float = 1.0) -> Dataset:
    runs = recorded(robot, matrix, np.random.default_rng(5), noise)
    return make_dataset(robot.name, robot, PERIOD, runs, simulated=True)


def off_design(robot: Robot) -> Array:
    """A matrix (3, M) a few per cent off the design, in which no fixed wheel slides."""
    deviation = 0.02 * robot.row_scales[:, None] * np.random.default_rng(6).standard_normal((3, len(robot.drive.names)))
    return robot.inverse_kinematic_matrix + (deviation if robot.slides else robot.allowed_twists @ deviation)


MOUNTED = DIFFERENTIAL.model_copy(update={"name": "mounted", "mount": Mount(x=0.2, y=0.1, yaw=0.3)})


@pytest.mark.parametrize("robot", [*EVERY, pytest.param(MOUNTED, id="mounted")])
def test_recordings_without_noise_give_the_true_motions(robot: Robot) -> None:
    """A known tracked point is no slide."""
    truth = off_design(robot)
    found = calibrate(recording(robot, truth, 0.0), unidentified="keep").calibration.matrix_array
    driven = robot.signal_equations @ robot.motions.T
    np.testing.assert_allclose(found @ driven, truth @ driven, rtol=0, atol=1e-6)


def test_a_differential_drive_does_not_slide_unless_its_tracked_point_may_be_elsewhere() -> None:
    moved = DIFFERENTIAL.model_copy(update={"mount": Mount(x=0.02, y=0.0, yaw=0.02)}).inverse_kinematic_matrix
    dataset = recording(DIFFERENTIAL, moved, 0.3)
    known, fitted = (calibrate(dataset, mount=mount) for mount in ("known", "fit"))
    assert known.result.held == ("m21", "m22")
    assert not known.calibration.matrix_array[1].any()
    np.testing.assert_allclose(fitted.calibration.matrix_array[1], moved[1], rtol=0, atol=2e-4)


@pytest.mark.parametrize(
    "robot",
    [DIFFERENTIAL, *(pytest.param(robot, marks=pytest.mark.slow) for robot in (TRICYCLE, CAR))],
    ids=lambda robot: robot.name,
)
def test_the_geometry_is_found_by_a_search(robot: Robot) -> None:
    geometry = WheelGeometry(robot)
    hidden = geometry.start + geometry.scale * 0.02 * np.random.default_rng(7).standard_normal(len(geometry.start))
    dataset = recording(robot, geometry.matrices(hidden[None])[0], 0.0)
    run = calibrate(dataset, "parametric", unidentified="keep", mount="known")
    assert run.parameters is not None
    driven = robot.signal_equations @ robot.motions.T
    np.testing.assert_allclose(
        run.calibration.matrix_array @ driven, geometry.matrices(hidden[None])[0] @ driven, rtol=0, atol=1e-5
    )


def mean_errors(matrix: Array, robot: Robot, runs: Sequence[Trajectory]) -> Array:
    """Mean errors of the final pose, m and degrees."""
    errors = final_errors(OdometryModel(robot, matrix, "arc"), runs)
    return np.array([np.hypot(*errors[:, :2].T).mean(), np.degrees(np.abs(errors[:, 2]).mean())])


def of_group(dataset: Dataset, *groups: str) -> Dataset:
    """The runs of some groups, to train."""
    runs = (run for run in dataset.trajectories if run.id.startswith(groups))
    return replace(dataset, trajectories=tuple(replace(run, split="train") for run in runs))


@pytest.mark.parametrize(
    ("name", "trained", "published"),
    [
        ("diff", "circular", {"circular": (0.0090, 1.10), "square": (0.028, 1.9), "ivanjko": (0.0055, 0.95)}),
        pytest.param("diff", "square", {"square": (0.0108, 1.05), "circular": (0.0297, 4.06)}, marks=pytest.mark.slow),
        pytest.param("tricyc", "circular", {"circular": (0.042, 3.7), "square": (0.084, 3.2)}, marks=pytest.mark.slow),
        pytest.param("omni4", "circular", {"": (0.031, 3.4)}, marks=pytest.mark.slow),
    ],
)
def test_a_real_robot_errs_less_than_by_published_methods(
    request: pytest.FixtureRequest, name: str, trained: str, published: dict[str, tuple[float, float]]
) -> None:
    dataset = request.getfixturevalue(name)
    matrix = calibrate(of_group(dataset, trained)).calibration.matrix_array
    for judged, limits in published.items():
        assert (mean_errors(matrix, dataset.robot, of_group(dataset, judged).trajectories) <= limits).all()


def misread(robot: Robot, gain: float = 1.0, zero: float = 0.0) -> Dataset:
    """Simulated runs whose true steering angle is gain times the measured one plus a zero, rad."""
    exact = recorded(robot, robot.inverse_kinematic_matrix, np.random.default_rng(3), 0.1)
    runs = [replace(run, steering=(run.steering - zero) / gain) for run in exact]
    return make_dataset(robot.name, robot, PERIOD, runs, simulated=True)


def weaving(coupling: float) -> Dataset:
    """Simulated runs of a tricycle that steers all the time, by which its wheel is turned along."""
    times, runs = PERIOD * np.arange(1, 101), []
    for number, phase in enumerate(np.linspace(0, 6, 8)):
        steering = 0.5 * np.sin(times + phase)[:, None]
        rates = np.full((100, 1), 6.0)
        middle = (np.vstack([steering[:1], steering[:-1]]) + steering) / 2
        moved = TRICYCLE.drive.signals(rates, middle) @ TRICYCLE.inverse_kinematic_matrix.T * PERIOD
        turned = np.diff(np.vstack([steering[:1], steering]), axis=0) / PERIOD
        stamps = np.concatenate([[0.0], times[9::10]])
        runs.append(
            Trajectory(
                str(number), "train", times, rates - coupling * turned, stamps, path(moved)[::10], steering=steering
            )
        )
    return make_dataset("weaving", TRICYCLE, PERIOD, runs, simulated=True)


MATRIX = {"parameterisation": "matrix", "unidentified": "keep"}  # what the search for a steering fits


class Worst(Cost):
    """The largest pose error."""

    name = "worst"

    def combine(self, errors: Array, trajectory: NDArray[np.intp]) -> Array:  # noqa: ARG002
        worst: Array = np.abs(errors).max(axis=(1, 2))
        return worst


def fitted(run: CalibrationRun) -> dict[str, float]:
    return {name: value for term in run.calibration.effects for name, value in term.parameters.items()}


@pytest.mark.parametrize("gain", [*(pytest.param(gain, marks=pytest.mark.slow) for gain in (0.4, 1.1)), 5.5])
def test_the_gain_of_a_steering_is_found_even_where_it_is_far_off_and_predicts_the_runs(gain: float) -> None:
    dataset = misread(TRICYCLE, gain)
    run = calibrate(dataset, cost="trajectory", steering="fit")
    assert fitted(run)["g"] == pytest.approx(gain - 1, abs=0.02 * gain)
    assert any("the steering was fitted first (steering gain" in warning for warning in run.warnings)
    paths = run.calibration.model.poses([each.reference_log for each in dataset.trajectories])
    errors = [poses[-1] - each.poses[-1] for poses, each in zip(paths, dataset.trajectories, strict=True)]
    assert np.abs(errors).mean() < 0.005


@pytest.mark.slow
def test_the_zero_of_a_car_s_steering_is_found() -> None:
    run = calibrate(misread(CAR, 1.0, 0.03), cost="trajectory", steering="fit")
    assert fitted(run)["c"] == pytest.approx(0.03, abs=0.003)


def test_a_steering_that_turns_its_wheel_along_is_found_and_no_bound_is_warned_of() -> None:
    run = calibrate(weaving(0.4), cost="trajectory", steering="fit")
    assert fitted(run)["k"] == pytest.approx(0.4, abs=0.02)
    assert not any("lies on the bound" in warning for warning in run.warnings)


@pytest.mark.slow
def test_a_coupling_beyond_what_is_searched_is_warned_of() -> None:
    beyond = 1.2 / float(TRICYCLE.radii[0])
    run = calibrate(weaving(beyond), cost="trajectory", steering="fit")
    assert fitted(run)["k"] == pytest.approx(beyond / 1.5)
    (warning,) = [each for each in run.warnings if "lies on the bound" in each]
    assert f"steering coupling {beyond / 1.5:.3g}" in warning


@pytest.mark.parametrize("cost", ["trajectory", "final_pose"])
@pytest.mark.parametrize("jumped", [(), (1, 4)])
def test_slopes_of_a_search_are_those_of_its_cost_where_starts_jumped_too(cost: str, jumped: tuple[int, ...]) -> None:
    runs = list(weaving(0.4).trajectories)
    for place in jumped:
        poses = runs[place].poses.copy()
        poses[0] += [0.6, -0.8, 0.3]
        runs[place] = replace(runs[place], poses=poses)
    fit = SteeringFit(TRICYCLE, tuple(runs), PERIOD, FitSettings(cost=cost, loss="huber", **MATRIX))
    vector, step = np.array([0.5, 0.1, 0.2]), 1e-3
    around = [(fit.cost(vector + moved)[0], fit.cost(vector - moved)[0]) for moved in step * np.eye(3)]
    expected = [(above - below) / (2 * step) for above, below in around]
    slopes = fit.cost(vector)[1]
    np.testing.assert_allclose(slopes, expected, rtol=0, atol=2e-3 * np.abs(expected).max())


def test_a_steering_is_fitted_by_pose_errors_of_a_robot_that_steers() -> None:
    costs.register("worst")(Worst)
    with pytest.raises(ConfigError, match="worst"):
        calibrate(misread(TRICYCLE), cost="worst", steering="fit")
    runs = recorded(DIFFERENTIAL, DIFFERENTIAL.inverse_kinematic_matrix, np.random.default_rng(3))
    dataset = make_dataset("diff", DIFFERENTIAL, PERIOD, runs, simulated=True)
    with pytest.raises(ConfigError, match="robot diff"):
        calibrate(dataset, steering="fit")


def mean_distance(run: CalibrationRun, drive: Trajectory) -> float:
    (poses,) = run.calibration.model.poses([drive.reference_log])
    return float(np.hypot(*(poses - drive.poses[1:])[:, :2].T).mean())


def test_a_real_tricycle_with_a_steering_gain_far_off_errs_less_than_its_authors_say() -> None:
    dataset = corelli_dataset()
    (drive,) = dataset.trajectories
    run = calibrate(dataset, steering="fit")
    assert run.calibration.provenance.cost == "trajectory"
    assert mean_distance(run, drive) <= 0.071


@pytest.mark.slow
def test_the_first_half_of_a_real_drive_predicts_the_second() -> None:
    dataset = corelli_dataset()
    (drive,) = dataset.trajectories
    middle, end = float(drive.pose_times[-1] / 2), float(drive.pose_times[-1])
    first = replace(dataset, trajectories=(half(drive, 0.0, middle),))
    assert mean_distance(calibrate(first, steering="fit"), half(drive, middle, end)) <= 0.15


# Calibrations of runs that have references in the place of poses, and windows whose motion is compared.

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


@pytest.mark.parametrize(
    "kind", ["displacement", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("distance", "turn", "position"))]
)
def test_intervals_hold_the_truth(kind: str) -> None:
    found = [study.covered(study.Case("diff", kind), seed) for seed in range(6)]
    errors = np.concatenate([each.combinations for each in found])
    assert (np.abs(errors) < 1).mean() > 0.75  # the study of 300 sets is tests/studies/reference_coverage.py


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
    assert any("no reference tells of turning" in warning for warning in run.warnings)


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
