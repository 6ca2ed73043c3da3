"""Comparisons with a loss that bounds the influence of reference poses that are far off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import compared_here, prepare, small, summary
from contamination import with_jumps

from omnibench.compare.result import ComparisonResult
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.fit.calibrate import calibrate

_SHARE, _OFF = 0.1, 1.0  # of the poses; m


def jumping(folder: Path) -> Dataset:
    """The small recordings, a tenth of whose training poses are a metre off, written to a folder."""
    dataset = load_dataset(prepare().data)
    spoilt = with_jumps(dataset.split("train"), _SHARE, _OFF, np.random.default_rng(3))
    runs = [*spoilt, *dataset.split("validation")]
    made = make_dataset("jumping", dataset.robot, dataset.sample_period, runs, simulated=True)
    save_dataset(made, folder)
    return made


def compared(folder: Path, **changes: object) -> ComparisonResult:
    config = small(datasets={"jumping": {"path": str(folder / "data")}}, calibrators=["theoretical", "closed_form"])
    return compared_here(folder / str(changes.get("loss", "squares")), **(config | changes))


def closed_form(result: ComparisonResult) -> float:
    (run,) = [run for run in result.runs if run.record.label == "closed_form"]
    assert run.record.validation_cost is not None
    return run.record.validation_cost


def test_a_robust_loss_is_better_on_runs_without_jumps_and_is_said(tmp_path: Path) -> None:
    jumping(tmp_path / "data")
    squares = compared(tmp_path, cost="trajectory")
    robust = compared(tmp_path, cost="trajectory", loss="huber")
    assert closed_form(robust) < closed_form(squares)
    assert "loss" not in summary(squares.output)
    assert summary(robust.output)["loss"] == "huber"
    assert robust.config.objective == "trajectory, loss huber"


def test_the_answer_is_that_of_calibrate(tmp_path: Path) -> None:
    dataset = jumping(tmp_path / "data")
    result = compared(tmp_path, loss="huber", integration="arc", box="row")
    (run,) = [run for run in result.runs if run.record.label == "closed_form"]
    alone = calibrate(dataset, loss="huber", cost="final_pose", unidentified="keep")
    assert run.record.matrix is not None
    np.testing.assert_array_equal(run.record.matrix, alone.calibration.matrix)


@pytest.mark.parametrize("loss", ["squares", "huber"])
def test_runs_whose_ends_were_taken_from_other_poses_are_named(tmp_path: Path, loss: str) -> None:
    dataset = jumping(tmp_path / "data")
    result = compared(tmp_path, loss=loss)
    told = [warning for warning in result.warnings if "is far from what the poses beside it say" in warning]
    if loss == "squares":
        assert told == []
        return
    (warning,) = told
    alone = next(each for each in calibrate(dataset, loss="huber", cost="final_pose").warnings if "beside it" in each)
    assert warning == f"data set jumping: {alone}"


def test_nothing_is_proven_of_a_robust_loss(tmp_path: Path) -> None:
    jumping(tmp_path / "data")
    result = compared(tmp_path, loss="student_t", certificate={"gap": 0.5, "seconds": 5})
    assert result.certificates == ()


def test_without_jumps_no_end_is_moved(tmp_path: Path) -> None:
    dataset = load_dataset(prepare().data)
    copy = replace(dataset, name="jumping")
    save_dataset(copy, tmp_path / "data")
    assert not [warning for warning in compared(tmp_path, loss="huber").warnings if "beside it say" in warning]
