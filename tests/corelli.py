"""The tricycle of tricycle_corelli, imported by options alone."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from commands import RECORDINGS

from omnibench.cli.fetch import find_recording
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.slam.import_dataset import import_dataset

CORELLI = RECORDINGS / "tricycle_corelli" / "dataset.txt"
# The authors' first guesses, as ``omnibench fetch corelli`` imports the drive, but in one run.
CORELLI_OPTIONS: dict[str, Any] = {
    key: value for key, value in find_recording("corelli").datasets[0].options.items() if key != "window"
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
