"""Comparisons with a loss that bounds the influence of reference poses that are far off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from commands import compared_here, prepare, summary
from contamination import with_jumps

from omnibench.compare.result import ComparisonResult
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.fit.calibrate import calibrate

_SHARE, _OFF = 0.1, 1.0  # of the poses; m


@pytest.fixture(scope="module")
def jumping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small recordings, a tenth of whose training poses are a metre off, and comparisons of them beside them."""
    folder = tmp_path_factory.mktemp("jumping")
    dataset = load_dataset(prepare().data)
    spoilt = with_jumps(dataset.split("train"), _SHARE, _OFF, np.random.default_rng(3))
    runs = [*spoilt, *dataset.split("validation")]
    save_dataset(make_dataset("jumping", dataset.robot, dataset.sample_period, runs, simulated=True), folder / "data")
    return folder


def compared(data: Path, folder: Path, **changes: object) -> ComparisonResult:
    sets, entries = {"jumping": {"path": str(data)}}, ["theoretical", "closed_form"]
    return compared_here(folder / str(changes["loss"]), datasets=sets, calibrators=entries, **changes)


@pytest.fixture(scope="module")
def squares(jumping: Path) -> ComparisonResult:
    return compared(jumping / "data", jumping, loss="squares")


@pytest.fixture(scope="module")
def huber(jumping: Path) -> ComparisonResult:
    return compared(jumping / "data", jumping, loss="huber")


def far_ends(result: ComparisonResult) -> list[str]:
    """Warnings of runs whose ends were taken from other poses."""
    return [warning for warning in result.warnings if "beside it say" in warning]


def test_a_robust_loss_is_better_on_runs_without_jumps_and_is_said(
    squares: ComparisonResult, huber: ComparisonResult
) -> None:
    robust, other = (result.runs[1].record.validation_cost for result in (huber, squares))
    assert robust is not None
    assert other is not None
    assert robust < other
    assert "loss" not in summary(squares.output)
    assert summary(huber.output)["loss"] == "huber"
    assert huber.config.objective == "final_pose, loss huber"


def test_answer_and_warning_are_those_of_calibrate(squares: ComparisonResult, huber: ComparisonResult) -> None:
    dataset: Dataset = huber.datasets["jumping"]
    alone = calibrate(dataset, loss="huber", cost="final_pose", unidentified="keep")
    np.testing.assert_array_equal(np.array(huber.runs[1].record.matrix), alone.calibration.matrix)
    (of_calibrate,) = (warning for warning in alone.warnings if "beside it say" in warning)
    assert far_ends(huber) == [f"data set jumping: {of_calibrate}"]
    assert far_ends(squares) == []


def test_nothing_is_proven_of_a_robust_loss_and_without_jumps_no_end_is_moved(tmp_path: Path) -> None:
    result = compared(prepare().data, tmp_path, loss="student_t", certificate={"gap": 0.5, "seconds": 5})
    assert result.certificates == ()
    assert far_ends(result) == []
