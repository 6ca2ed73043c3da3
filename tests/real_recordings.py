"""Recordings of real robots, where they are at hand: read once a run of the suite. Tests take them as fixtures."""

from __future__ import annotations

import pytest
from commands import RECORDINGS, ROOT
from shared_results import made_once

from omnibench.data.dataset import Dataset
from omnibench.registry import load_plugin_file
from omnibench.slam.import_dataset import import_dataset

OMNI3 = RECORDINGS / "optiodom" / "omni3"
ROBOTINO = RECORDINGS / "robotino"


@made_once
def omni3() -> Dataset:
    """OptiOdom's robot on three wheels: circles to train, squares to validate."""
    if not OMNI3.is_dir():
        pytest.skip(f"the recordings are not at {OMNI3}")
    return import_dataset("optiodom", OMNI3)


@made_once
def robotino() -> Dataset:
    """A Robotino on a table: translation only."""
    if not ROBOTINO.is_dir():
        pytest.skip(f"the recordings are not at {ROBOTINO}")
    assert load_plugin_file(ROOT / "plugins" / "robotino.py") is None
    return import_dataset("robotino", ROBOTINO)
