"""What the tests of the data room share."""

from pathlib import Path

import pytest
from bag_samples import DRIVE, messages, write_mcap


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive as an MCAP file."""
    return write_mcap(tmp_path_factory.mktemp("bags") / "drive", messages(DRIVE))
