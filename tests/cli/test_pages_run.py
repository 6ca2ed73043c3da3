"""Every command of the README and of the handbook, run in order, as written, and what is known of their results."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from commands import RECORDINGS, ROOT, rows, summary
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


@pytest.fixture(scope="module")
def paper(ten_minutes: Path) -> dict[str, dict[str, Any]]:
    """The entries of the README's comparison on the paper's flower."""
    return rows(ten_minutes / "results" / "apr02" / "latest")


def test_the_theoretical_matrix_costs_what_the_paper_says(paper: dict[str, dict[str, Any]]) -> None:
    assert paper["theoretical"]["train_cost"] == pytest.approx(0.1234, rel=0.02)
    assert paper["theoretical"]["validation_cost"] == pytest.approx(0.1251, rel=0.03)


@pytest.mark.parametrize("label", ["closed_form", "crs"])
def test_a_calibration_improves_as_much_as_in_the_paper(label: str, paper: dict[str, dict[str, Any]]) -> None:
    assert paper[label]["train_improvement"] >= 0.82
    assert paper[label]["validation_improvement"] >= 0.81


def test_nothing_is_below_the_exact_optimum_in_the_same_box(paper: dict[str, dict[str, Any]]) -> None:
    assert paper["crs"]["box"] == paper["closed_form"]["box"] == "paper"
    assert paper["crs"]["train_cost"] >= paper["closed_form"]["train_cost"] - 1e-9
    assert -1e-9 <= paper["crs"]["gap"] < 1e-5


def test_the_exact_optimum_takes_a_handful_of_evaluations(paper: dict[str, dict[str, Any]]) -> None:
    assert paper["closed_form"]["evaluations"] <= 10  # times are measured in tests/benchmarks
    assert paper["closed_form"]["outcome"] == "converged"


def test_a_real_robot_is_calibrated_as_well_as_was_measured(ended: dict[str, Path]) -> None:
    if "compare" not in ended:
        pytest.skip("the page on comparisons ended before the real robot's")
    results = ended["compare"] / "results" / "omni3" / "latest"
    assert summary(results)["simulated"] == {"omni3": False}
    found = rows(results)
    assert f"{100 * found['closed_form']['validation_improvement']:.1f} %" in (ROOT / "README.md").read_text("utf-8")
    assert found["closed_form"]["train_position_m"] <= 0.045
    assert np.degrees(found["closed_form"]["train_heading_rad"]) <= 3.8
    assert found["closed_form"]["validation_position_m"] <= 0.11
    assert np.degrees(found["closed_form"]["validation_heading_rad"]) <= 5.5
    for name in ("train_position_m", "train_heading_rad", "validation_position_m", "validation_heading_rad"):
        assert found["theoretical"][name] > found["closed_form"][name]
    # Other commands, other shapes: there the poses along the way, their clocks set right, are worth as much or more.
    assert found["trajectory_ml"]["validation_cost"] <= found["closed_form"]["validation_cost"]
