"""How good a calibration is on a data set."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from fit_samples import noisy_trajectories

from omnibench.data.dataset import Dataset, make_dataset
from omnibench.errors import DataError
from omnibench.fit.evaluate import ModelErrors, evaluate
from omnibench.robot.calibration import Calibration, EffectTerm, matrix_rows
from omnibench.robot.kinematics import Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration
from omnibench.testing.synthetic import synthetic_robot, true_robot

ROBOT = synthetic_robot()
TRUTH = true_robot(ROBOT).inverse_kinematic_matrix


def dataset(validating: int = 4) -> Dataset:
    """Twelve runs, the last of which validate."""
    runs = noisy_trajectories()
    split = len(runs) - validating
    held_out = (replace(run, split="validation") for run in runs[split:])
    return make_dataset("synthetic", ROBOT, 0.2, [*runs[:split], *held_out], simulated=True)


def calibration(robot: Robot = ROBOT, integration: Integration = "arc") -> Calibration:
    return Calibration(name="truth", robot=robot, sample_period=0.2, matrix=matrix_rows(TRUTH), integration=integration)


def test_errors_are_those_of_the_final_pose() -> None:
    runs = dataset().trajectories
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
    found = evaluate(calibration(), dataset())
    assert {name: errors.trajectories for name, errors in found.splits.items()} == {
        "train": 8,
        "validation": 4,
        "all": 12,
    }
    assert found.splits["all"].cost == pytest.approx(
        (8 * found.splits["train"].cost + 4 * found.splits["validation"].cost) / 12
    )
    assert (found.dataset, found.simulated, found.trajectories) == ("synthetic", True, 12)


def test_a_split_that_is_empty_is_left_out() -> None:
    assert set(evaluate(calibration(), dataset(validating=0)).splits) == {"train", "all"}


def test_the_design_is_evaluated_beside_the_calibration() -> None:
    found = evaluate(calibration(), dataset())
    design = ModelErrors.of(OdometryModel.of_design(ROBOT, "arc"), dataset().trajectories).on(dataset().trajectories)
    assert found.design["all"] == design
    assert found.splits["all"].cost < 0.5 * design.cost


def test_the_calibrations_own_integration_is_used() -> None:
    euler, arc = (evaluate(calibration(integration=each), dataset()) for each in ("euler", "arc"))
    assert euler.splits["all"].cost != arc.splits["all"].cost
    assert euler.design["all"].cost != arc.design["all"].cost


def test_a_calibration_of_other_wheels_is_refused_in_one_line() -> None:
    renamed = tuple(wheel.model_copy(update={"name": f"{wheel.name}1"}) for wheel in ROBOT.wheels)
    other = ROBOT.model_copy(update={"wheels": renamed})
    with pytest.raises(DataError) as refusal:
        evaluate(calibration(other), dataset())
    assert str(refusal.value).startswith(
        "calibration 'truth' is for wheels a1, b1, c1, the data set synthetic has a, b, c; "
    )


def test_a_calibration_with_effects_is_judged_by_what_its_reference_reports() -> None:
    effects = (
        EffectTerm(name="quadratic_rotation_slip", parameters={"k": 0.05}),
        EffectTerm(name="reference_time_offset", parameters={"tau": 0.3}),
        EffectTerm(name="lidar_lever_arm", parameters={"x": 0.05, "y": -0.02}),
    )
    extended, recordings = calibration().model_copy(update={"effects": effects}), dataset()
    model = extended.model
    seen = [
        replace(run, poses=np.vstack([run.start, model.reported([run.reference_log])[0]]))
        for run in recordings.trajectories
    ]
    reported = make_dataset("reported", ROBOT, 0.2, seen, simulated=True)
    assert evaluate(extended, reported).splits["all"].cost < 1e-12
    assert evaluate(calibration(), reported).splits["all"].cost > 0.05


def test_sessions_that_cannot_be_compared_are_said_with_the_reason() -> None:
    (sentence,) = evaluate(calibration(), dataset()).sessions
    assert sentence.startswith("Whether the sessions differ cannot be said: no session repeats a command")
    assert evaluate(calibration(), dataset(validating=0)).sessions == ()


def test_a_data_set_that_lacks_what_an_effect_needs_is_refused_in_one_line() -> None:
    drifting = (EffectTerm(name="thermal_radius_drift", parameters={"k": 1e-5}),)
    with pytest.raises(DataError, match=r"^effect 'thermal_radius_drift' needs the time since the session's start"):
        evaluate(calibration().model_copy(update={"effects": drifting}), dataset())


def test_motions_that_the_effects_were_not_fitted_to_are_warned_of() -> None:
    slip = (EffectTerm(name="centripetal_slip", parameters={"k": 0.01}),)
    extended = calibration().model_copy(update={"effects": slip, "driven": ((0.3, 0.0, 0.0),)})
    (warning,) = evaluate(extended, dataset()).warnings
    assert "of 12 runs drive motions that calibration 'truth' was not fitted to" in warning
    assert evaluate(extended.model_copy(update={"driven": None}), dataset()).warnings == ()


def test_the_share_of_time_outside_of_what_was_driven_is_told_of_every_split() -> None:
    recorded = dataset()
    known = tuple((*map(float, motion),) for run in recorded.split("train") for motion in run.signals @ TRUTH.T)
    errors = evaluate(calibration().model_copy(update={"driven": known}), recorded).splits
    assert errors["train"].outside == 0.0
    assert errors["validation"].outside == pytest.approx(3 * (errors["all"].outside or 0.0))  # 4 runs of 12, as long
    assert 0 < (errors["validation"].outside or 0.0) <= 1
    assert "outside" not in evaluate(calibration(), recorded).splits["all"].model_dump()
