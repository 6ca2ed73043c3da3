"""The pages on simulations, typed one after the other: the second goes on with the data of the first.

The 360 runs of the simulated experiment go through SLAM again and again, which took 21 minutes of the suite. It types
the same commands after an edit of the config that leaves 12 runs; with all they are a study.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from newcomer import PAGES, prepare, ten_minutes, typed

FEWER = {
    "directions_deg: [0, 30, 60, 90, 120, 150, 180, 210, 240, 270, 300, 330]": "directions_deg: [0, 120]",
    "repetitions: 5": "repetitions: 1",
    "seeds: [1, 2, 3, 4, 5]": "seeds: [1]",
}


def fewer_runs(command: str, folder: Path) -> None:
    """Edit the config before it is simulated."""
    config = folder / "configs" / "apr02_robot.yaml"
    if command.startswith("omnibench simulate configs/apr02_robot.yaml"):
        text = config.read_text(encoding="utf-8")
        for present, fewer in FEWER.items():
            assert text.count(present) == 1
            text = text.replace(present, fewer)
        config.write_text(text, encoding="utf-8")


@pytest.fixture(
    scope="module",
    params=[fewer_runs, pytest.param(prepare, marks=pytest.mark.slow)],
    ids=["with 12 runs", "with all runs"],
)
def reader(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of somebody who has typed the README and the page on simulations."""
    before: Callable[[str, Path], None] = request.param
    return typed(PAGES["simulate"], shutil.copytree(ten_minutes(), tmp_path_factory.mktemp("reader") / "after"), before)


def test_the_page_on_simulations_runs_after_the_readme(reader: Path) -> None:
    assert (reader / "data" / "chain" / "dataset.yaml").is_file()


def test_the_page_on_slam_goes_on_with_its_data(reader: Path) -> None:
    assert typed(PAGES["slam"], reader) == reader
