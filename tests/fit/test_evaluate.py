"""How good a calibration is on a data set, and the verdict of held-out runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from fit_samples import noisy_trajectories

from omnibench import check
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.errors import DataError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.evaluate import ModelErrors, evaluate, final_errors, judge, verdict_on
from omnibench.fit.problem import Budget
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


def errors_on(dataset: Dataset, calibration: Calibration) -> tuple[Array, Array]:
    """Final errors (Z, 3) of the validation runs, by the design values and by a calibration."""
    models = (OdometryModel.of_design(ROBOT, "arc"), calibration.model)
    before, after = (final_errors(model, dataset.split("validation")) for model in models)
    return before, after


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
    assert report.needed == {"better": True, "undecided": False}[found.verdict]  # undecided: by less than a tenth


def test_cross_validation_decides_where_three_runs_are_held_out_and_both_are_said() -> None:
    dataset = recordings(validating=3)
    found = verdict(calibrate(dataset).calibration)
    alone = judge(*errors_on(dataset, calibrate(dataset).calibration), dataset.split("validation"))
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


def test_cross_validation_does_not_stand_for_a_model_with_effects() -> None:
    dataset = recordings(validating=3)
    plain = calibrate(dataset).calibration.model
    slip = EffectTerm(name="centripetal_slip", parameters={"k": 0.0}).term(ROBOT)
    found = [
        verdict_on(model, dataset.split("train"), dataset.split("validation")).basis
        for model in (plain, replace(plain, terms=(slip,), sample_period=0.2))
    ]
    assert found == ["cross_validation", "held_out"]


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
