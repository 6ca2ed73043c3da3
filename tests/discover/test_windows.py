"""Long drives are cut into windows that drive as they did."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discovery_samples import simulated
from hypothesis import given
from hypothesis import strategies as st

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting import in_windows
from omnibench.robot.model import OdometryModel

ROBOT_MODEL = simulated(()).robot


def drive(seed: int, seconds: float = 60.0) -> Trajectory:
    """A drive whose poses are those of its own odometry."""
    rng, times = np.random.default_rng(seed), np.arange(1, int(seconds / 0.04) + 1) * 0.04
    rates = np.cumsum(rng.normal(0, 0.05, (len(times), 3)), axis=0)
    stamps = np.append(0.0, times[4::5])
    run = Trajectory("drive", "train", times, rates, stamps, np.zeros((len(stamps), 3)), started_at=7.0)
    (poses,) = OdometryModel.of_design(ROBOT_MODEL, "arc").poses([run.log(stamps[1:])])
    return replace(run, poses=np.vstack([run.start, poses]))


@given(seed=st.integers(0, 2**32 - 1))
def test_the_odometry_of_every_window_ends_where_the_drive_does(seed: int) -> None:
    windows = in_windows([drive(seed)])
    assert len(windows) == 15  # of 4 s
    model = OdometryModel.of_design(ROBOT_MODEL, "arc")
    for window, poses in zip(windows, model.poses([window.reference_log for window in windows]), strict=True):
        np.testing.assert_allclose(poses, window.poses[1:], atol=1e-9)
    assert windows[3].started_at == pytest.approx(7.0 + 12.0, abs=0.2)


def test_repetitions_and_many_runs_are_not_cut() -> None:
    repeated = [replace(drive(seed), id=str(seed), command="c") for seed in (1, 2)]
    assert in_windows(repeated) == tuple(repeated)
    many = [replace(drive(1, 9.0), id=str(number)) for number in range(30)]
    assert in_windows(many) == tuple(many)
