"""A newcomer who types the README and then the pages of the handbook."""

import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import yaml
from commands import RECORDINGS, ROOT, run_here
from shared_results import made_once, shared_folder
from tricycle_samples import TRICYCLE, tricycle_drive
from typed_pages import shell_commands, terminal

from omnibench.cli.handbook_topics import HANDBOOK
from omnibench.data.storage import load_dataset, save_dataset

PAGES = {page.stem: page for page in sorted(HANDBOOK.rglob("*.md")) if shell_commands(page.read_text(encoding="utf-8"))}
# Long commands of a page that are typed word for word on a page of their own.
ELSEWHERE = {
    "getting-started": {
        "omnibench compare data/robot -o compared": "compare",
        "omnibench discover data/robot -o found": "discover",
    }
}


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
    (folder / "optiodom").mkdir(parents=True)
    (folder / "optiodom" / "data").symlink_to(RECORDINGS / "optiodom")


def fetched_recordings(folder: Path) -> None:
    """OptiOdom's recordings, where ``omnibench fetch`` would have cloned them."""
    cloned_recordings(folder / "clones" / "sousarbarb")


def fleet_of_days(folder: Path) -> None:
    """The runs of the reader's robot in two folders, as of two days."""
    dataset = load_dataset(folder / "data" / "robot")
    for day in range(2):
        save_dataset(replace(dataset, trajectories=dataset.trajectories[day::2]), folder / "fleet" / f"day{day}")


# What a reader has, or does, before he types a command that begins so.
BEFORE: dict[str, Callable[[Path], None]] = {
    "omnibench import csv raw": log_of_ticks,
    "omnibench import csv log.txt": log_of_text,
    "omnibench compare configs/omni3.yaml": fetched_recordings,
    "omnibench import optiodom": cloned_recordings,
    "omnibench check fleet/day": fleet_of_days,
}


def prepare(command: str, folder: Path) -> None:
    for beginning, prepared in BEFORE.items():
        if command.startswith(beginning):
            prepared(folder)


def typed(page: Path, folder: Path, before: Callable[[str, Path], None] = prepare) -> Path:
    """Type a page's commands in a folder; the folder in which the reader then is."""
    elsewhere = ELSEWHERE.get(page.stem, {})
    with terminal(folder, before) as typing:
        for line in lines_of(page):
            if line not in elsewhere:
                typing.type(line)
        return typing.folder


def typed_here(page: Path, folder: Path, left_out: str = "omnibench compare") -> Path:
    """Type a page's commands in this process, without those that begin with ``left_out``; the reader's folder then."""
    for command in (command for line in lines_of(page) for command in line.split(" && ")):
        program, *arguments = shlex.split(command, comments=True)
        if program == "cd":
            folder = folder / arguments[0]
        elif not command.startswith(left_out):
            prepare(command, folder)
            run = run_here(*arguments, cwd=folder)
            assert run.returncode == 0, f"{command}\n{run.stderr}"
    return folder


def lines_of(page: Path) -> list[str]:
    return shell_commands(page.read_text(encoding="utf-8"))


@made_once
def ten_minutes() -> Path:
    """The folder in which a newcomer has typed the README, from its first command to its last."""
    folder = shared_folder() / "newcomer"
    shutil.rmtree(folder, ignore_errors=True)  # of a try that failed
    folder.mkdir()
    return typed(ROOT / "README.md", folder)
