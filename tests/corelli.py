"""The tricycle of tricycle_corelli, imported by options alone."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from commands import RECORDINGS

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.slam.import_dataset import import_dataset

CORELLI = RECORDINGS / "tricycle_corelli" / "dataset.txt"
REAR = {"type": "fixed", "radius": 0.1, "x": 0, "measured": False}
# Its authors' first guesses: 0.0106141 m for a revolution of the
# traction encoder of 5000 ticks, which is a wheel of 0.0106141 / (2 pi) = 0.00168929 m on the encoder's axle; a tenth
# of the steering encoder's angle; 1.4 m between the axles; a tracked point 1.5 m ahead of the rear one.
CORELLI_OPTIONS: dict[str, Any] = {
    "robot": {
        "name": "corelli",
        "mount": {"x": 1.5},
        "wheels": [
            {"name": "front", "type": "steered", "radius": 0.0106141 / (2 * math.pi), "x": 1.4, "y": 0},
            {"name": "left", "y": 0.3, **REAR},
            {"name": "right", "y": -0.3, **REAR},
        ],
    },
    "separator": "blanks",
    "header_lines": 0,
    "wheel_time_column": 2,
    "wheel_columns": 5,
    "wheel_unit": "ticks",
    "ticks_per_turn": 5000,
    "steering_columns": 4,
    "steering_unit": "ticks",
    "steering_ticks_per_turn": 8192,
    "steering_scale": 0.1,
    "pose_columns": [11, 12, 13],
}


def corelli_dataset(**options: Any) -> Dataset:
    """The drive as one run, with other options where these are given; the test is skipped where it is not at hand."""
    if not CORELLI.is_file():
        pytest.skip(f"the recording is not at {CORELLI}")
    return import_dataset("csv", CORELLI, CORELLI_OPTIONS | options)


def half(run: Trajectory, begin: float, end: float) -> Trajectory:
    """The part of a drive between two times, s, from its own start."""
    assert run.steering is not None
    shown = (run.pose_times >= begin) & (run.pose_times <= end) & np.isin(run.pose_times, [0.0, *run.times])
    zero, last = run.pose_times[shown][[0, -1]]
    driven = (run.times > zero) & (run.times <= last)
    return replace(
        run, times=run.times[driven] - zero, rates=run.rates[driven], steering=run.steering[driven], angles=None,
        pose_times=run.pose_times[shown] - zero, poses=run.poses[shown],
    )  # fmt: skip
