"""What the tests of the data room share."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from bag_samples import DRIVE, messages, write_mcap

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))  # the study of SLAM drives the runs of its tests, too


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive as an MCAP file."""
    return write_mcap(tmp_path_factory.mktemp("bags") / "drive", messages(DRIVE))
