"""What the tests of the data room share."""

from pathlib import Path

import pytest
from storage_samples import FORMATS, Format, everything_known

from omnibench.data.storage import save_dataset


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[Format, Path]:
    """A sound data set in both formats."""
    folders = {fmt: tmp_path_factory.mktemp(fmt) / "dataset" for fmt in FORMATS}
    for fmt, folder in folders.items():
        save_dataset(everything_known(), folder, fmt)
    return folders
