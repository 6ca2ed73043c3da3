"""An effect is named in another form than the textbook's, and the model holds the member that was fitted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hidden.disturbances import PLAIN
from hidden.experiment import DESIGNS, ROBOT, SAMPLE, plan, true_matrix
from hidden.motion import Correction, Grid
from hidden.sets import recorded

from omnibench.data.dataset import Dataset, make_dataset
from omnibench.discover.discover import discover_effects
from omnibench.discover.result import Discovery
from omnibench.robot.calibration import read_calibration, write_calibration


def lagging(limit: float) -> Dataset:
    """60 + 60 runs of a robot that falls behind while it accelerates. limit: where its slip saturates, m/s2."""
    rng = np.random.default_rng(12)
    runs, matrix = plan(DESIGNS["small"], rng), true_matrix(rng)
    grid = Grid(runs, matrix)
    size = np.linalg.norm(grid.acceleration, axis=1, keepdims=True)
    slip = -0.8 * grid.acceleration / (1 + size / limit)
    correction = Correction(body=np.column_stack([slip, np.zeros(len(slip))]))
    return make_dataset("lagging", ROBOT, SAMPLE, recorded(grid, correction, PLAIN, rng), simulated=True)


@pytest.fixture(scope="module")
def saturating() -> Discovery:
    return discover_effects(lagging(0.15))


def test_a_slip_that_saturates_has_the_name_of_its_family(saturating: Discovery) -> None:
    assert [effect.name for effect in saturating.effects] == ["acceleration_slip"]
    assert saturating.effects[0].weight > 0.95


def test_the_fitted_member_is_said_and_held_by_the_model(saturating: Discovery, tmp_path: Path) -> None:
    (effect,) = saturating.effects
    assert effect.form.startswith("0.")
    assert effect.form.endswith("times as large at large accelerations as at the other end")
    write_calibration(saturating.extended, tmp_path / "model.yaml")
    (term,) = (each for each in read_calibration(tmp_path / "model.yaml").effects if each.name == effect.name)
    assert {"k", "k:acceleration:1", "acceleration:high"} <= set(term.parameters)
