"""The pages on simulations, typed one after the other: the second goes on with the data of the first."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from newcomer import PAGES, ten_minutes, typed


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of somebody who has typed the README and the page on simulations."""
    return typed(PAGES["simulate"], shutil.copytree(ten_minutes(), tmp_path_factory.mktemp("reader") / "after"))


def test_the_page_on_simulations_runs_after_the_readme(reader: Path) -> None:
    assert (reader / "data" / "chain" / "dataset.yaml").is_file()


def test_the_page_on_slam_goes_on_with_its_data(reader: Path) -> None:
    assert typed(PAGES["slam"], reader) == reader
