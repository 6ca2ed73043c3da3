"""Every command of the README and of the handbook, run in order, as written."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from commands import ROOT
from typed_pages import shell_commands, terminal

from omnibench.cli.handbook_topics import HANDBOOK

PAGES = [page for page in sorted(HANDBOOK.rglob("*.md")) if shell_commands(page.read_text(encoding="utf-8"))]


@pytest.fixture(scope="module")
def ten_minutes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which a newcomer has typed the README, from its first command to its last."""
    folder = tmp_path_factory.mktemp("clone")
    for part in ("configs", "plugins"):
        shutil.copytree(ROOT / part, folder / part)
    with terminal(folder) as typing:
        for line in shell_commands((ROOT / "README.md").read_text(encoding="utf-8")):
            typing.type(line)
        return typing.folder


def test_the_readme_runs_from_its_first_command_to_its_last(ten_minutes: Path) -> None:
    assert (ten_minutes / "calibration.yaml").is_file()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_of_the_handbook_runs_after_the_readme(page: Path, ten_minutes: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(ten_minutes, tmp_path / "after")
    with terminal(folder) as typing:
        for line in shell_commands(page.read_text(encoding="utf-8")):
            typing.type(line)
