"""Recordings of real robots, where they are at hand: read once a run of the suite. Tests take them as fixtures."""

from collections.abc import Sequence

import numpy as np
import pytest
from commands import RECORDINGS, ROOT
from shared_results import made_once

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.registry import load_plugin_file
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch
from omnibench.slam.import_dataset import import_dataset

OPTIODOM = RECORDINGS / "optiodom"
OMNI3 = OPTIODOM / "omni3"
ROBOTINO = RECORDINGS / "robotino"


@made_once
def omni3() -> Dataset:
    """OptiOdom's robot on three wheels: circles to train, squares to validate."""
    return _of_optiodom("omni3")


@made_once
def diff() -> Dataset:
    """OptiOdom's differential drive: circles to train, squares and single legs to validate."""
    return _of_optiodom("diff")


@made_once
def tricyc() -> Dataset:
    """OptiOdom's tricycle: circles to train, squares to validate."""
    return _of_optiodom("tricyc")


@made_once
def omni4() -> Dataset:
    """OptiOdom's mecanum base on circles."""
    return _of_optiodom("omni4")


def _of_optiodom(robot: str) -> Dataset:
    if not (OPTIODOM / robot).is_dir():
        pytest.skip(f"the recordings are not at {OPTIODOM / robot}")
    return import_dataset("optiodom", OPTIODOM / robot)


@made_once
def robotino() -> Dataset:
    """A Robotino on a table: translation only."""
    if not ROBOTINO.is_dir():
        pytest.skip(f"the recordings are not at {ROBOTINO}")
    assert load_plugin_file(ROOT / "plugins" / "robotino.py") is None
    return import_dataset("robotino", ROBOTINO)


def mean_errors(matrix: Array, runs: Sequence[Trajectory]) -> tuple[float, float]:
    """Mean errors of the final pose by a matrix, m and degrees."""
    batch = OdometryBatch([run.final_log for run in runs], "arc")
    errors = batch.poses(matrix[None])[0] - np.array([run.final_pose for run in runs])
    return float(np.hypot(errors[:, 0], errors[:, 1]).mean()), float(np.degrees(np.abs(errors[:, 2])).mean())
