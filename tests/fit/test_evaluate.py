"""Observations of references, and evaluations of calibrations on them."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import reference_coverage as study
from fit_samples import noisy_trajectories
from lanes import slow
from sample_robots import APR_02

import omnibench.robot.stored_odometry as odometry_of_stored
from omnibench import check
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.references import Reference, References
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.certify import certify_optimum
from omnibench.fit.evaluate import ModelErrors, evaluate, final_errors, judge, verdict_on
from omnibench.fit.inspect import inspect_dataset
from omnibench.fit.motion_windows import MotionWindows, motions_in_windows
from omnibench.fit.problem import Budget
from omnibench.fit.reference_rows import ReferenceBatch, reference_rows
from omnibench.robot.calibration import Calibration, EffectTerm, HeldOutVerdict, matrix_rows
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, WheelLog
from omnibench.testing.synthetic import synthetic_robot, true_robot

ROBOT = synthetic_robot()
TRUTH = true_robot(ROBOT).inverse_kinematic_matrix


def recordings(validating: int = 4, name: str = "synthetic") -> Dataset:
    """Twelve runs, the last of which validate."""
    every = noisy_trajectories()
    split = len(every) - validating
    held_out = (replace(run, split="validation") for run in every[split:])
    return make_dataset(name, ROBOT, 0.2, [*every[:split], *held_out], simulated=True)


def calibration(robot: Robot = ROBOT, integration: Integration = "arc") -> Calibration:
    return Calibration(name="truth", robot=robot, sample_period=0.2, matrix=matrix_rows(TRUTH), integration=integration)


def test_errors_are_those_of_the_final_pose() -> None:
    runs = recordings().trajectories
    model = OdometryModel(ROBOT, TRUTH, "arc")
    errors = [model.poses([run.final_log])[0][0] - run.poses[-1] for run in runs]
    positions = [math.hypot(error[0], error[1]) for error in errors]
    headings = [abs(error[2]) for error in errors]
    found = ModelErrors.of(model, runs).on(runs)
    assert found.trajectories == 12
    assert found.cost == pytest.approx(np.mean([math.hypot(*error) for error in errors]), abs=1e-14)
    assert found.position_mean_m == pytest.approx(np.mean(positions), abs=1e-14)
    assert found.position_max_m == pytest.approx(max(positions), abs=1e-14)
    assert found.heading_mean_rad == pytest.approx(np.mean(headings), abs=1e-14)
    assert found.heading_max_rad == pytest.approx(max(headings), abs=1e-14)


def test_every_split_that_is_there_is_evaluated_and_all_together() -> None:
    found = evaluate(calibration(), recordings())
    counts = {name: errors.trajectories for name, errors in found.splits.items()}
    costs = {name: errors.cost for name, errors in found.splits.items()}
    assert counts == {"train": 8, "validation": 4, "all": 12}
    assert costs["all"] == pytest.approx((8 * costs["train"] + 4 * costs["validation"]) / 12)
    assert (found.dataset, found.simulated, found.trajectories) == ("synthetic", True, 12)
    assert set(evaluate(calibration(), recordings(validating=0)).splits) == {"train", "all"}
    every = recordings().trajectories
    design = ModelErrors.of(OdometryModel.of_design(ROBOT, "arc"), every).on(every)
    assert found.design["all"] == design
    assert costs["all"] < 0.5 * design.cost
    euler = evaluate(calibration(integration="euler"), recordings())  # the calibration's own
    assert euler.splits["all"].cost != costs["all"]
    assert euler.design["all"].cost != design.cost


def test_a_calibration_of_other_wheels_and_data_without_what_an_effect_needs_are_refused() -> None:
    renamed = tuple(wheel.model_copy(update={"name": f"{wheel.name}1"}) for wheel in ROBOT.wheels)
    with pytest.raises(DataError, match="'truth' is for wheels a1, b1, c1"):
        evaluate(calibration(ROBOT.model_copy(update={"wheels": renamed})), recordings())
    drifting = (EffectTerm(name="thermal_radius_drift", parameters={"k": 1e-5}),)
    with pytest.raises(DataError, match="'thermal_radius_drift'"):
        evaluate(calibration().model_copy(update={"effects": drifting}), recordings())


def test_a_calibration_with_effects_is_judged_by_what_its_reference_reports() -> None:
    effects = (
        EffectTerm(name="quadratic_rotation_slip", parameters={"k": 0.05}),
        EffectTerm(name="reference_time_offset", parameters={"tau": 0.3}),
        EffectTerm(name="lidar_lever_arm", parameters={"x": 0.05, "y": -0.02}),
    )
    extended, recorded = calibration().model_copy(update={"effects": effects}), recordings()
    model = extended.model
    seen = [
        replace(run, poses=np.vstack([run.start, model.reported([run.reference_log])[0]]))
        for run in recorded.trajectories
    ]
    reported = make_dataset("reported", ROBOT, 0.2, seen, simulated=True)
    assert evaluate(extended, reported).splits["all"].cost < 1e-12
    assert evaluate(calibration(), reported).splits["all"].cost > 0.05


def test_sessions_that_cannot_be_compared_are_said_with_the_reason() -> None:
    (sentence,) = evaluate(calibration(), recordings()).sessions
    assert "no session repeats a command" in sentence
    assert evaluate(calibration(), recordings(validating=0)).sessions == ()


def test_motions_that_the_effects_were_not_fitted_to_are_warned_of() -> None:
    slip = (EffectTerm(name="centripetal_slip", parameters={"k": 0.01}),)
    extended = calibration().model_copy(update={"effects": slip, "driven": ((0.3, 0.0, 0.0),)})
    (warning,) = evaluate(extended, recordings()).warnings
    assert "of 12 runs drive motions that calibration 'truth' was not fitted to" in warning
    assert evaluate(extended.model_copy(update={"driven": None}), recordings()).warnings == ()


def test_the_share_of_time_outside_of_what_was_driven_is_told_of_every_split() -> None:
    recorded = recordings()
    known = tuple((*map(float, motion),) for run in recorded.split("train") for motion in run.signals @ TRUTH.T)
    errors = evaluate(calibration().model_copy(update={"driven": known}), recorded).splits
    assert errors["train"].outside == 0.0
    assert errors["validation"].outside == pytest.approx(3 * (errors["all"].outside or 0.0))  # 4 runs of 12, as long
    assert 0 < (errors["validation"].outside or 0.0) <= 1
    assert "outside" not in evaluate(calibration(), recorded).splits["all"].model_dump()


def runs(commands: int, repetitions: int = 1) -> list[Trajectory]:
    """Runs of commands, each driven some times."""
    (run, *_) = noisy_trajectories()
    return [
        replace(run, id=f"c{command}-{repetition}", command=f"c{command}", repetition=repetition)
        for command in range(commands)
        for repetition in range(repetitions)
    ]


def errors(sizes: Sequence[float]) -> Array:
    """Final pose errors (Z, 3) of some lengths, m, with a heading of a tenth of them, rad."""
    return np.outer(sizes, [0.6, 0.8, 0.1])


def verdict(calibration: Calibration) -> HeldOutVerdict:
    """The verdict in a calibration file."""
    return calibration.provenance.held_out


@pytest.mark.parametrize(
    ("before", "after", "verdict", "words"),
    [
        ([0.020, 0.022, 0.024], [0.031, 0.033, 0.036], "worse", "do not use"),
        (np.linspace(0.1, 0.2, 12), np.linspace(0.02, 0.06, 12), "better", "better than the design"),
        ([0.02, 0.03, 0.04, 0.05], [0.03, 0.01, 0.06, 0.03], "undecided", "chance alone can explain"),
        ([0.02, 0.03, 0.04, 0.05], [0.02, 0.03, 0.04, 0.05], "undecided", "the same as the design"),
        ([0.0] * 4, [0.01, 0.01, 0.02, 0.01], "undecided", "no error there to be improved"),
    ],
)
def test_errors_of_held_out_runs_that_fall_rise_or_vary_by_chance_have_their_verdict(
    before: Sequence[float], after: Sequence[float], verdict: str, words: str
) -> None:
    found = judge(errors(before), errors(after), runs(len(before)))
    assert found.verdict == verdict
    assert words in found.sentence


def test_the_sentence_of_a_verdict_holds_errors_in_mm_and_degrees_and_its_detail_the_interval_and_runs() -> None:
    found = judge(errors([0.020, 0.022, 0.024]), errors([0.031, 0.033, 0.036]), runs(3))
    assert "held out (3 runs): 22 mm -> 33 mm, 0.13 deg -> 0.19 deg" in found.sentence
    for part in ("51.5 % (95 % interval", "Student's t over 3 runs", "runs: c0-0, c1-0, c2-0"):
        assert part in found.detail
    found = judge(errors(np.linspace(0.1, 0.2, 12)), errors(np.linspace(0.02, 0.06, 12)), runs(12))
    assert (found.method, found.unit, found.units) == ("bootstrap", "run", 12)
    assert 0 < found.low < found.improvement < found.high < 1
    assert judge(np.zeros((4, 3)), errors([0.01] * 4), runs(4)).improvement is None


@pytest.mark.parametrize("commands", [1, 2])
def test_many_runs_of_one_or_two_commands_leave_it_undecided_without_an_interval(commands: int) -> None:
    number = 20 * commands
    found = judge(errors(np.full(number, 0.2)), errors(np.linspace(0.01, 0.02, number)), runs(commands, 20))
    assert (found.verdict, found.unit, found.units, found.low) == ("undecided", "command", commands, None)
    assert f"no interval from {commands} command" in found.detail


def test_without_held_out_runs_and_too_few_to_cross_validate_it_cannot_be_said_and_how_to_get_some_is() -> None:
    three = make_dataset("few", ROBOT, 0.2, noisy_trajectories()[:3], simulated=True)
    found = verdict(calibrate(three).calibration)
    assert (found.verdict, found.runs) == ("unknown", ())
    assert "--set validation=" in found.detail
    assert "omnibench evaluate" in found.detail


@pytest.mark.parametrize(("validating", "basis"), [(0, "cross_validation"), (3, "cross_validation"), (10, "held_out")])
def test_check_calibrate_and_evaluate_end_with_the_same_verdict(validating: int, basis: str) -> None:
    dataset = recordings(validating)
    calibration = calibrate(dataset).calibration
    found = verdict(calibration)
    assert found.basis == basis
    assert found == evaluate(calibration, dataset).held_out
    report = check(dataset)
    assert report.gain.partition("): ")[0] == found.sentence.partition("): ")[0]
    assert report.needed == {"better": True, "undecided": None}[found.verdict]  # undecided: by more than a tenth


def test_cross_validation_decides_where_three_runs_are_held_out_and_both_are_said() -> None:
    dataset = recordings(validating=3)
    calibration, held_out = calibrate(dataset).calibration, dataset.split("validation")
    found, design = verdict(calibration), OdometryModel.of_design(ROBOT, "arc")
    alone = judge(final_errors(design, held_out), final_errors(calibration.model, held_out), held_out)
    assert (alone.verdict, found.verdict, found.units) == ("undecided", "better", 12)
    assert found.sentence.startswith("cross-validated (12 runs): ")
    assert f"too little was held out to decide: {alone.sentence}" in found.detail


@pytest.mark.parametrize("calibrator", ["theoretical", "random_search"])
def test_cross_validation_of_fits_does_not_stand_for_a_calibration_that_fits_worse(calibrator: str) -> None:
    run = calibrate(recordings(validating=3), calibrator, budget=Budget(evaluations=2))
    assert verdict(run.calibration).basis == "held_out"


def driven(split: str, turns: bool, matrix: Array) -> list[Trajectory]:
    """Three runs each of five straight or turning commands, by the odometry of a matrix and with noise."""
    rng, model, runs = np.random.default_rng(3), OdometryModel(ROBOT, matrix, "arc"), []
    backwards = np.linalg.pinv(ROBOT.inverse_kinematic_matrix)
    times = 0.2 * np.arange(1, 31)
    for command, repetition in product(range(5), range(3)):
        twist = (0, 0, 0.3 + 0.1 * command) if turns else (0.3 * math.cos(command), 0.3 * math.sin(command), 0)
        log = WheelLog(times, np.tile(backwards @ twist, (30, 1)), np.zeros(3), np.append(0.0, times[4::5]))
        poses = model.poses([log])[0]
        poses[1:] += 0.003 * rng.standard_normal(poses[1:].shape)
        name = f"{split}{turns}{command}"
        runs.append(Trajectory(f"{name}-{repetition}", split, times, log.rates, log.stamps, poses, command=name))
    return runs


def test_a_calibration_that_changes_nothing_on_the_held_out_runs_is_not_called_better() -> None:
    """It was fitted to straight runs, and turns were held out; fits that see the turns would correct them."""
    design = ROBOT.inverse_kinematic_matrix
    truth, fitted = design * [[1.03], [1.03], [0.95]], design * [[1.03], [1.03], [1.0]]
    model = OdometryModel(ROBOT, fitted, "arc")
    found = verdict_on(model, driven("train", False, truth), driven("validation", True, truth))
    assert (found.basis, found.verdict) == ("held_out", "undecided")


def test_held_out_runs_that_err_more_by_far_are_not_outvoted() -> None:
    """In the session that was held out the wheels are as drawn, in the other one they are not."""
    design = ROBOT.inverse_kinematic_matrix
    runs = [*driven("train", False, 1.03 * design), *driven("validation", False, 0.99 * design)]
    found = verdict(calibrate(make_dataset("x", ROBOT, 0.2, runs)).calibration)
    assert (found.basis, found.verdict) == ("held_out", "worse")


def test_all_runs_of_another_recording_are_held_out() -> None:
    calibration = calibrate(recordings(validating=0)).calibration
    found = evaluate(calibration, recordings(validating=0, name="another day")).held_out
    assert found.basis == "cross_validation"  # the same content: these runs were fitted, and none is held out
    other = make_dataset("synthetic", ROBOT, 0.2, noisy_trajectories(seed=1), simulated=True)
    found = evaluate(calibration, other).held_out  # though both data sets have one name
    assert (found.verdict, len(found.runs)) == ("better", 12)


def without_fingerprints(calibration: Calibration) -> Calibration:
    """A calibration as versions wrote it that did not know of fingerprints."""
    return calibration.model_copy(update={"provenance": calibration.provenance.model_copy(update={"fitted": None})})


def swapped(dataset: Dataset) -> Dataset:
    """A data set whose training runs validate and whose validation runs train."""
    every = [replace(run, split="train" if run.split == "validation" else "validation") for run in dataset.trajectories]
    return make_dataset(dataset.name, ROBOT, 0.2, every, simulated=dataset.simulated)


@pytest.mark.parametrize("name", ["synthetic", "again"])
def test_fitted_runs_whose_reference_was_made_anew_or_rounded_are_not_held_out(name: str) -> None:
    calibration = calibrate(recordings(validating=0)).calibration
    again = [replace(run, poses=run.poses + 0.001) for run in noisy_trajectories()]
    found = evaluate(calibration, make_dataset(name, ROBOT, 0.2, again, simulated=True)).held_out
    assert found.verdict == "unknown"
    assert f"every run of {name} has the wheel samples" in found.sentence


def test_runs_whose_wheel_samples_do_not_tell_them_apart_are_known_by_their_poses() -> None:
    first, *others = (noisy_trajectories(seed=seed, encoder=0.0) for seed in (1, 2, 3))
    repeated = [*first, *(replace(run, id=f"{run.id}-2") for run in others[0])]
    calibration = calibrate(make_dataset("synthetic", ROBOT, 0.2, repeated)).calibration
    third = make_dataset("again", ROBOT, 0.2, [*others[1], *(replace(run, id=f"{run.id}-1") for run in first)])
    assert evaluate(calibration, third).held_out.runs == tuple(run.id for run in others[1])


def test_fitted_runs_that_are_made_validation_runs_after_the_fit_are_not_called_held_out() -> None:
    dataset = recordings(validating=6)
    calibration = calibrate(dataset).calibration
    assert evaluate(calibration, swapped(dataset)).held_out == verdict(calibration)


def test_a_fitted_run_that_also_validates_under_another_name_is_not_held_out() -> None:
    dataset = recordings(validating=6)
    (first, *_) = dataset.split("train")
    twice = [*dataset.trajectories, replace(first, id="copy", split="validation")]
    calibration = calibrate(make_dataset("twice", ROBOT, 0.2, twice)).calibration
    assert sorted(verdict(calibration).runs) == sorted(run.id for run in dataset.trajectories)


def test_of_a_changed_data_set_nothing_is_held_out_where_a_calibration_knows_no_runs() -> None:
    dataset = recordings(validating=6)
    calibration = without_fingerprints(calibrate(dataset).calibration)
    found = evaluate(calibration, swapped(dataset)).held_out
    assert (found.verdict, found.runs) == ("unknown", ())
    assert "synthetic" in found.sentence
    assert evaluate(calibration, swapped(dataset)).unfitted is None
    assert evaluate(calibration, dataset).unfitted == {"train": 0, "validation": 6, "all": 6}
    assert evaluate(calibration, dataset).held_out.verdict == "better"


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


@pytest.mark.parametrize("calibrator", ["closed_form", *slow("least_squares")])
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


@pytest.mark.parametrize("loss", ["squares", *slow("huber")])
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


def test_only_map_has_intervals_where_positions_do_not_tell_how_runs_start() -> None:
    dataset = reduced("diff", 6, "position")
    assert calibrate(dataset).uncertainty is not None
    run = calibrate(dataset, "closed_form")
    assert run.uncertainty is None
    assert any("positions of 8 runs" in warning and "map does not" in warning for warning in run.warnings)


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
    run = calibrate(dataset, "closed_form")
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
    for calibrator in ("map", "closed_form"):
        found = calibrate(dataset, calibrator).calibration.matrix_array
        np.testing.assert_allclose(found, truth, atol=2e-3 * np.abs(truth).max())


def test_what_needs_poses_says_so() -> None:
    dataset = reduced("diff", 5, "turn")
    with pytest.raises(ConfigError, match="reference poses"):
        certify_optimum(calibrate(dataset).calibration, dataset)
    with pytest.raises(DataError, match="final_position"):
        calibrate(dataset, cost="final_position")


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
