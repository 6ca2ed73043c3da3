"""The calibrator ``discovered`` of ``plugins/``."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from discovery_samples import named, nothing, simulated

from omnibench.data.dataset import Dataset
from omnibench.errors import ConfigError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.calibrator import Outcome
from omnibench.fit.evaluate import evaluate
from omnibench.fit.problem import Budget
from omnibench.progress import Progress
from omnibench.robot.calibration import read_calibration, write_calibration

PLUGINS = ("discovered",)


@cache
def fitted() -> CalibrationRun:
    return calibrate(simulated(), calibrator="discovered", integration="arc")


def without_validation(dataset: Dataset) -> Dataset:
    return replace(dataset, trajectories=dataset.split("train"))


@pytest.mark.slow
def test_the_answer_is_the_extended_model_of_discover() -> None:
    assert [term.name for term in fitted().calibration.effects] == [effect.name for effect in named().effects]
    found, own = named().extended, fitted().calibration
    np.testing.assert_allclose(own.matrix_array, found.matrix_array, rtol=1e-3, atol=1e-4)
    assert own.plain is not None
    assert own.driven is not None
    assert own.covariance is not None


@pytest.mark.slow
def test_the_costs_of_the_file_are_those_of_the_model_with_effects(tmp_path: Path) -> None:
    write_calibration(fitted().calibration, tmp_path / "c.yaml")
    found = evaluate(read_calibration(tmp_path / "c.yaml"), simulated())
    origin = fitted().calibration.provenance
    assert origin.training_cost == pytest.approx(found.splits["train"].cost, rel=1e-12)
    assert origin.validation_cost == pytest.approx(found.splits["validation"].cost, rel=1e-12)
    plain = calibrate(simulated()).calibration.provenance
    assert origin.training_cost < 0.8 * plain.training_cost


@pytest.mark.slow
def test_where_nothing_is_found_the_answer_is_that_of_closed_form() -> None:
    assert not nothing().effects
    run, plain = calibrate(simulated(()), calibrator="discovered"), calibrate(simulated(()))
    assert not run.calibration.effects
    assert run.calibration.matrix == plain.calibration.matrix
    assert "the matrix alone: discover names no effect (none)" in run.result.reason


def test_spent_seconds_leave_the_matrix_alone() -> None:
    def at_a_step(event: Progress) -> None:
        if event.unit == "step":
            time.sleep(2.0)

    calibrate(simulated())  # so that compiling and reading are not part of the seconds
    run = calibrate(simulated(), calibrator="discovered", budget=Budget(seconds=2.0), watch=at_a_step)
    assert run.result.outcome is Outcome.TIME
    assert "s spent while" in run.result.reason
    assert not run.calibration.effects


def test_euler_steps_are_not_for_it() -> None:
    with pytest.raises(ConfigError, match="Euler steps look like slip; set integration to arc"):
        calibrate(simulated(), calibrator="discovered", integration="euler")
