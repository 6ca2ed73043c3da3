"""Odometry of arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from wheeled_samples import DIFF, TRICYCLE, driven

import omnibench
from omnibench.errors import OmnibenchError
from omnibench.robot.model import OdometryModel

T = np.arange(1, 51) * 0.02


@given(forward=st.floats(-10, 10), turn=st.floats(-10, 10))
def test_the_end_of_an_arc_is_where_its_radius_says(forward: float, turn: float) -> None:
    rates = np.tile([forward + turn, forward - turn], (50, 1))  # right, left
    x, y, heading = omnibench.odometry(DIFF, T, rates)[-1]
    way, angle = 0.042 * forward, 0.042 * turn / 0.1
    chord = np.sinc(angle / 2 / np.pi) * way  # over 1 s
    np.testing.assert_allclose(
        [x, y, heading], [chord * np.cos(angle / 2), chord * np.sin(angle / 2), angle], atol=1e-9
    )


def test_it_is_the_odometry_of_data_sets() -> None:
    dataset = driven(TRICYCLE)
    run = dataset.trajectories[0]
    (wanted,) = OdometryModel.of_design(TRICYCLE, "arc").poses([run.log(run.pose_times)])
    given_arrays = {"steering": run.steering, "start": run.start, "stamps": run.pose_times}
    assert run.steering is not None
    np.testing.assert_array_equal(omnibench.odometry(TRICYCLE, run.times, run.rates, **given_arrays), wanted)


def test_a_calibration_brings_its_matrix_and_integration() -> None:
    run = driven(DIFF).trajectories[0]
    calibration = omnibench.calibrate(driven(DIFF), integration="euler").calibration
    (wanted,) = calibration.model.poses([run.log(run.times)])
    np.testing.assert_array_equal(omnibench.odometry(calibration, run.times, run.rates, start=run.start), wanted)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"rates": np.ones((50, 3))}, r"rates has shape \(50, 3\), expected \(50, 2\): .* wheels right, left"),
        ({"rates": np.ones(50)}, r"rates has shape \(50,\), expected \(rows, columns\)"),
        ({"rates": [["fast"] * 2] * 50}, "rates: expected numbers"),
        ({"rates": np.r_[np.ones((3, 2)), np.full((47, 2), np.nan)]}, "rates, row 4: it holds a value that is missing"),
        ({"times": T - 0.02}, "times, row 1: it is 0; times increase and are > 0"),
        ({"times": T[::-1]}, "times, row 2: it is 0.98; times increase"),
        ({"stamps": [-1.0]}, "stamps, row 1: it is -1; times increase and are >= 0"),
        ({"start": [0, 0]}, r"start has shape \(2,\), expected \(3,\): x, y in m and heading in rad"),
        ({"robot": "robot.yaml"}, "expected a Calibration, found 'robot.yaml'; .*, or a Robot with"),
        ({"robot": TRICYCLE, "rates": np.ones((50, 1))}, r"steering is missing: angles \(F, 1\) of the wheels front"),
    ],
)
def test_what_does_not_fit_is_named(given: dict[str, Any], message: str) -> None:
    call: dict[str, Any] = {"robot": DIFF, "times": T, "rates": np.ones((50, 2))} | given
    with pytest.raises(OmnibenchError, match=message):
        omnibench.odometry(**call)
