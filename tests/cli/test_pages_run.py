"""Every command of the README and of the handbook, run in order, as written."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import yaml
from commands import RECORDINGS, ROOT
from tricycle_samples import TRICYCLE, tricycle_drive
from typed_pages import shell_commands, terminal

from omnibench.cli.handbook_topics import HANDBOOK

PAGES = {page.stem: page for page in sorted(HANDBOOK.rglob("*.md")) if shell_commands(page.read_text(encoding="utf-8"))}
GOES_ON = {"slam": "simulate"}  # pages that are typed where another one ended


def log_of_ticks(folder: Path) -> None:
    """The sample's log as another robot's: counts of 4096 a turn that add up, ms, mm and degrees."""
    shutil.copytree(folder / "log", folder / "raw")
    for file in (folder / "log").glob("*_?.csv"):
        table = pl.read_csv(file)
        counts = [(pl.col(f"ticks_{side}") * 4096 / 2796.8).cum_sum().round().cast(int) for side in ("left", "right")]
        table.with_columns(
            *counts,
            (1000 * pl.col("t")).alias("t"),
            (1000 * pl.col("x")).alias("x"),
            (1000 * pl.col("y")).alias("y"),
            pl.col("theta").degrees().alias("theta"),
        ).write_csv(folder / "raw" / file.name)


def log_of_text(folder: Path) -> None:
    """A tricycle's drive as lines of words and numbers, its wheel and its steering in ticks."""
    drive = tricycle_drive()
    steering = np.round(drive["phi"] * 8192 / (2 * np.pi)).astype(int) % 8192
    wheel = np.round(drive["angle"] * 5000 / (2 * np.pi)).astype(int)
    rows = zip(drive["t"], steering, wheel, drive["x"], drive["y"], drive["theta"], strict=True)
    lines = (f"time: {t:.3f} ticks: {phi} {angle} pose: {x:.5f} {y:.5f} {h:.5f}" for t, phi, angle, x, y, h in rows)
    (folder / "log.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "robot.yaml").write_text(yaml.safe_dump(TRICYCLE), encoding="utf-8")


def cloned_recordings(folder: Path) -> None:
    """OptiOdom's recordings, as ``git clone`` would have brought them; without them the page ends here."""
    if not (RECORDINGS / "optiodom").is_dir():
        pytest.skip(f"the recordings are not at {RECORDINGS / 'optiodom'}")
    (folder / "optiodom").mkdir()
    (folder / "optiodom" / "data").symlink_to(RECORDINGS / "optiodom")


# What a reader has, or does, before he types a command that begins so.
BEFORE: dict[str, Callable[[Path], None]] = {
    "omnibench import csv raw": log_of_ticks,
    "omnibench import csv log.txt": log_of_text,
    "omnibench compare configs/omni3.yaml": cloned_recordings,
}


def prepare(command: str, folder: Path) -> None:
    for beginning, prepared in BEFORE.items():
        if command.startswith(beginning):
            prepared(folder)


def typed(page: Path, folder: Path) -> Path:
    """Type a page's commands in a folder; the folder in which the reader then is."""
    with terminal(folder, prepare) as typing:
        for line in shell_commands(page.read_text(encoding="utf-8")):
            typing.type(line)
        return typing.folder


@pytest.fixture(scope="module")
def ten_minutes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which a newcomer has typed the README, from its first command to its last."""
    return typed(ROOT / "README.md", tmp_path_factory.mktemp("newcomer"))


@pytest.fixture(scope="module")
def ended() -> dict[str, Path]:
    """The folders in which pages ended, by the pages' names."""
    return {}


def test_the_readme_runs_from_its_first_command_to_its_last(ten_minutes: Path) -> None:
    assert (ten_minutes / "calibration.yaml").is_file()


@pytest.mark.parametrize("name", sorted(PAGES, key=lambda name: name in GOES_ON))
def test_a_page_of_the_handbook_runs_after_the_readme(
    name: str, ten_minutes: Path, ended: dict[str, Path], tmp_path: Path
) -> None:
    if name in GOES_ON and GOES_ON[name] not in ended:
        ended[GOES_ON[name]] = typed(PAGES[GOES_ON[name]], shutil.copytree(ten_minutes, tmp_path / "first"))
    begun = ended[GOES_ON[name]] if name in GOES_ON else shutil.copytree(ten_minutes, tmp_path / "after")
    ended[name] = typed(PAGES[name], begun)
