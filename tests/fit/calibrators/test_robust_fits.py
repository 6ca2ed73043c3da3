"""Calibrators with a robust loss, where reference poses jump."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from commands import RECORDINGS, ROOT
from contamination import with_jumps
from fit_samples import make_problem
from wheeled_recordings import recorded
from wheeled_samples import DIFF, TRICYCLE

from omnibench.data.dataset import Dataset, make_dataset
from omnibench.errors import ConfigError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.calibrator import Outcome, run_calibrator
from omnibench.fit.evaluate import final_errors
from omnibench.fit.least_squares.usable_runs import usable_runs
from omnibench.fit.loss.losses import LossName
from omnibench.fit.loss.robust_cost import RobustCost, with_loss
from omnibench.fit.problem import Budget
from omnibench.registry import calibrators, costs, load_plugin_file
from omnibench.robot.kinematics import Robot
from omnibench.robot.model import OdometryModel
from omnibench.slam.import_dataset import import_dataset

ROBUST: tuple[LossName, ...] = ("huber", "student_t")


@cache
def recording(robot: Robot) -> tuple[Dataset, Dataset, Dataset]:
    """Simulated runs to train, the same with 5 % of their poses off by 1 m, and others to judge."""
    rng = np.random.default_rng(1)
    design = robot.inverse_kinematic_matrix
    truth = design * (1 + 0.02 * rng.standard_normal(design.shape))
    train, judged = (recorded(robot, truth, rng, samples=120) for _ in range(2))
    moved = with_jumps(train, 0.05, 1.0, np.random.default_rng(2))
    clean, jumping, others = (make_dataset(robot.name, robot, 0.1, runs) for runs in (train, moved, judged))
    return clean, jumping, others


def error(run: CalibrationRun, judged: Dataset) -> float:
    """Mean error of the final pose, Eq. (6)."""
    model = OdometryModel(judged.robot, run.calibration.matrix_array, "arc")
    return float(np.linalg.norm(final_errors(model, judged.trajectories), axis=1).mean())


@cache
def on_clean(robot: Robot, calibrator: str, cost: str) -> float:
    clean, _, judged = recording(robot)
    return error(calibrate(clean, calibrator, cost=cost, budget=Budget(evaluations=8000)), judged)


@pytest.mark.parametrize("loss", ROBUST)
@pytest.mark.parametrize("cost", ["trajectory", "final_pose"])
@pytest.mark.parametrize("calibrator", ["least_squares", "trajectory_ml", "closed_form", "crs"])
@pytest.mark.parametrize("robot", [DIFF, TRICYCLE], ids=["diff", "tricycle"])
def test_five_percent_of_poses_off_by_a_metre_cost_five_percent_at_most(
    robot: Robot, calibrator: str, cost: str, loss: LossName
) -> None:
    _, jumping, judged = recording(robot)
    run = calibrate(jumping, calibrator, cost=cost, loss=loss, budget=Budget(evaluations=8000))
    assert error(run, judged) <= 1.05 * on_clean(robot, calibrator, cost)


@pytest.mark.parametrize("calibrator", ["least_squares", "trajectory_ml"])
def test_without_a_robust_loss_the_same_poses_spoil_least_squares(calibrator: str) -> None:
    _, jumping, judged = recording(DIFF)
    assert error(calibrate(jumping, calibrator, cost="trajectory"), judged) > 1.1 * on_clean(
        DIFF, calibrator, "trajectory"
    )


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


@pytest.mark.parametrize("calibrator", ["least_squares", "trajectory_ml", "closed_form"])
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


@pytest.mark.parametrize("loss", ROBUST)
def test_closed_form_reaches_what_a_long_search_finds(loss: LossName) -> None:
    found = {}
    for name in ("closed_form", "crs"):
        problem = make_problem(cost="trajectory", loss=loss)
        result = run_calibrator(calibrators.create(name), problem)
        assert result.outcome is Outcome.CONVERGED, result.reason
        found[name] = result.cost
    assert found["closed_form"] == pytest.approx(found["crs"], rel=1e-6)


@pytest.mark.parametrize("loss", ROBUST)
def test_intervals_of_a_robust_fit_are_about_as_wide_as_those_of_squares_on_normal_errors(loss: LossName) -> None:
    clean, jumping, _ = recording(DIFF)
    usual = calibrate(clean, "trajectory_ml", unidentified="keep").uncertainty
    assert usual is not None
    for dataset in (clean, jumping):
        for calibrator in ("least_squares", "trajectory_ml"):
            run = calibrate(dataset, calibrator, cost="trajectory", loss=loss, unidentified="keep")
            assert run.uncertainty is not None, run.warnings
            ratio = run.uncertainty.standard_deviations[[0, 2]] / usual.standard_deviations[[0, 2]]
            assert (ratio > 0.6).all()
            assert (ratio < 2.5).all()


def test_starts_that_were_taken_from_other_poses_are_named() -> None:
    _, jumping, _ = recording(DIFF)
    (warning,) = [
        words
        for words in calibrate(jumping, "least_squares", cost="trajectory", loss="huber").warnings
        if "at the start is far" in words
    ]
    assert warning.startswith(("1 run of 36", "2 runs of 36", "3 runs of 36", "4 runs of 36"))


def test_a_cost_that_is_no_sum_of_norms_has_no_robust_loss() -> None:
    from omnibench.fit.cost import Cost

    class Odd(Cost):
        name = "odd"

        def combine(self, errors: Any, trajectory: Any) -> Any:  # noqa: ARG002
            return errors[:, 0, 0]

    with pytest.raises(ConfigError, match="no sum of norms"):
        with_loss(Odd(None), "huber")
    assert isinstance(with_loss(costs.create("trajectory"), "huber"), RobustCost)


def test_resampled_intervals_of_a_robust_fit_are_refused() -> None:
    clean, _, _ = recording(DIFF)
    with pytest.raises(ConfigError, match="leave out the loss huber"):
        calibrate(clean, "closed_form", loss="huber", intervals=True, unidentified="keep")
