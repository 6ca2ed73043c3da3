"""Calibrators with a robust loss, where reference poses jump."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import RECORDINGS, ROOT
from contamination import with_jumps
from fit_samples import make_problem
from lanes import slow
from wheeled_recordings import recorded
from wheeled_samples import DIFF, TRICYCLE

from omnibench.config import read_yaml
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.calibrator import Outcome, run_calibrator
from omnibench.fit.certify import certify_optimum
from omnibench.fit.cost import Cost
from omnibench.fit.evaluate import evaluate, final_errors
from omnibench.fit.loss import LossName, RobustCost, with_loss
from omnibench.fit.problem import Budget
from omnibench.fit.trajectory_fit import usable_runs
from omnibench.registry import calibrators, costs, load_plugin_file
from omnibench.robot.calibration import read_calibration, write_calibration
from omnibench.robot.kinematics import Robot
from omnibench.robot.model import OdometryModel
from omnibench.slam.import_dataset import import_dataset

ROBUST: tuple[LossName, ...] = ("huber", "student_t")


# Simulated sets of which the mean error is compared: one alone is 5 % better or worse by chance.
SETS = {"least_squares": 16, "trajectory_ml": 3, "closed_form": 3, "crs": 2}


@cache
def recording(robot: Robot, seed: int = 1) -> tuple[Dataset, Dataset, Dataset]:
    """Simulated runs to train, the same with 5 % of their poses off by 1 m, and others to judge."""
    rng = np.random.default_rng(seed)
    design = robot.inverse_kinematic_matrix
    truth = design * (1 + 0.02 * rng.standard_normal(design.shape))
    train, judged = (recorded(robot, truth, rng, samples=120) for _ in range(2))
    moved = with_jumps(train, 0.05, 1.0, np.random.default_rng(seed + 1))
    clean, jumping, others = (make_dataset(robot.name, robot, 0.1, runs) for runs in (train, moved, judged))
    return clean, jumping, others


def error(run: CalibrationRun, judged: Dataset) -> float:
    """Mean error of the final pose, Eq. (6)."""
    model = OdometryModel(judged.robot, run.calibration.matrix_array, "arc")
    return float(np.linalg.norm(final_errors(model, judged.trajectories), axis=1).mean())


@cache
def on_clean(robot: Robot, calibrator: str, cost: str, seed: int = 1) -> float:
    clean, _, judged = recording(robot, seed)
    return error(calibrate(clean, calibrator, cost=cost, budget=Budget(evaluations=4000)), judged)


@pytest.mark.parametrize("loss", ROBUST)
@pytest.mark.parametrize(
    ("calibrator", "cost", "robot"),
    [
        pytest.param("least_squares", "trajectory", TRICYCLE, id="least_squares", marks=pytest.mark.slow),
        pytest.param("trajectory_ml", "trajectory", DIFF, id="trajectory_ml of diff", marks=pytest.mark.slow),
        pytest.param("trajectory_ml", "trajectory", TRICYCLE, id="trajectory_ml of tricycle", marks=pytest.mark.slow),
        pytest.param("closed_form", "final_pose", TRICYCLE, id="closed_form"),
        pytest.param("crs", "trajectory", DIFF, id="crs", marks=pytest.mark.slow),
    ],
)
def test_bad_poses_cost_at_most_their_share(robot: Robot, calibrator: str, cost: str, loss: LossName) -> None:
    errors, of_clean = 0.0, 0.0
    for seed in range(1, 1 + SETS[calibrator]):
        _, jumping, judged = recording(robot, seed)
        run = calibrate(jumping, calibrator, cost=cost, loss=loss, budget=Budget(evaluations=4000))
        errors += error(run, judged)
        of_clean += on_clean(robot, calibrator, cost, seed)
    assert errors <= 1.05 * of_clean


def test_without_a_robust_loss_the_same_poses_spoil_least_squares() -> None:
    _, jumping, judged = recording(DIFF)
    spoilt = error(calibrate(jumping, "least_squares", cost="trajectory"), judged)
    assert spoilt > 1.1 * on_clean(DIFF, "least_squares", "trajectory")


@pytest.mark.parametrize("loss", ROBUST)
def test_headings_that_jump_cost_five_percent_at_most(loss: LossName) -> None:
    clean, _, judged = recording(TRICYCLE)
    rng = np.random.default_rng(3)
    runs = []
    for run in clean.trajectories:
        poses = run.poses.copy()
        poses[1:, 2] += 0.7 * (rng.random(len(poses) - 1) < 0.05)
        runs.append(replace(run, poses=poses))
    jumping = replace(clean, trajectories=tuple(runs))
    run = calibrate(jumping, "least_squares", cost="trajectory", loss=loss)
    assert error(run, judged) <= 1.05 * on_clean(TRICYCLE, "least_squares", "trajectory")


@pytest.mark.parametrize("calibrator", ["closed_form", *slow("least_squares", "trajectory_ml")])
def test_real_recordings_with_jumps_are_calibrated_as_without(calibrator: str) -> None:
    if not RECORDINGS.exists():
        pytest.skip(f"no real recordings: {RECORDINGS} is not there")
    assert load_plugin_file(ROOT / "plugins" / "robotino.py") is None
    whole = import_dataset("robotino", RECORDINGS / "robotino")
    train = usable_runs([replace(run, split="train") for run in whole.trajectories[::2]])
    judged = replace(whole, trajectories=tuple(replace(run, split="train") for run in whole.trajectories[1::2]))
    moved = with_jumps(train, 0.05, 1.0, np.random.default_rng(0))
    clean, jumping = (replace(whole, trajectories=tuple(runs)) for runs in (train, moved))
    base = error(calibrate(clean, calibrator, cost="trajectory"), judged)
    assert error(calibrate(jumping, calibrator, cost="trajectory", loss="huber"), judged) <= 1.05 * base


@pytest.mark.parametrize("loss", ["huber", pytest.param("student_t", marks=pytest.mark.slow)])
def test_closed_form_reaches_what_a_long_search_finds(loss: LossName) -> None:
    found = {}
    for name in ("closed_form", "crs"):
        problem = make_problem(cost="trajectory", loss=loss)
        result = run_calibrator(calibrators.create(name), problem)
        assert result.outcome is Outcome.CONVERGED, result.reason
        found[name] = result.cost
    assert found["closed_form"] == pytest.approx(found["crs"], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["huber", "student_t"])
def test_intervals_of_a_robust_fit_are_about_as_wide_as_those_of_squares_on_normal_errors(loss: LossName) -> None:
    clean, jumping, _ = recording(DIFF)
    usual = calibrate(clean, "trajectory_ml", unidentified="keep").uncertainty
    for dataset in (clean, jumping):
        for calibrator in ("closed_form", "trajectory_ml"):
            run = calibrate(dataset, calibrator, cost="trajectory", loss=loss, unidentified="keep")
            ratio = run.uncertainty.standard_deviations[[0, 2]] / usual.standard_deviations[[0, 2]]
            assert (ratio > 0.9).all()  # of the efficient estimate
            assert (ratio < 1.7).all()


def test_starts_that_were_taken_from_other_poses_are_named() -> None:
    _, jumping, _ = recording(DIFF)
    run = calibrate(jumping, "least_squares", cost="trajectory", loss="huber")
    (warning,) = [words for words in run.warnings if "at the start is far" in words]
    assert re.match("[1-4] runs? of 36", warning)


class Odd(Cost):
    """A cost that is no sum of norms."""

    name = "odd"

    def combine(self, errors: Any, trajectory: Any) -> Any:  # noqa: ARG002
        return errors[:, 0, 0]


def test_what_does_not_go_with_a_robust_loss_is_refused() -> None:
    with pytest.raises(ConfigError, match="sum of norms"):
        with_loss(Odd(None), "huber")
    assert isinstance(with_loss(costs.create("trajectory"), "huber"), RobustCost)
    clean, _, _ = recording(DIFF)
    with pytest.raises(ConfigError, match="huber"):
        calibrate(clean, "closed_form", loss="huber", intervals=True, unidentified="keep")
    calibration = calibrate(clean, "least_squares", loss="student_t").calibration
    with pytest.raises(DataError, match="student_t"):
        certify_optimum(calibration, clean, seconds=1.0)


def test_only_a_robust_loss_is_in_the_calibration_file_and_what_evaluate_says(tmp_path: Path) -> None:
    clean, _, _ = recording(DIFF)
    written = {}
    for loss in ("squares", "huber"):
        calibration = calibrate(clean, "least_squares", loss=loss).calibration
        write_calibration(calibration, tmp_path / f"{loss}.yaml")
        assert read_calibration(tmp_path / f"{loss}.yaml") == calibration
        written[loss] = read_yaml(tmp_path / f"{loss}.yaml")["provenance"]
        assert evaluate(calibration, clean).model_dump().get("loss") == (None if loss == "squares" else loss)
    assert "loss" not in written["squares"]
    assert written["huber"]["loss"] == "huber"
    assert written["huber"]["training_cost"] == pytest.approx(written["squares"]["training_cost"], rel=0.05)
