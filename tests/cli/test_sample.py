"""The sample recording in the package: small, with its licence, and what its source holds."""

from __future__ import annotations

import io

import numpy as np
import polars as pl
import pytest
from real_recordings import OPTIODOM
from rich.console import Console

import omnibench
from omnibench.cli.examples import SAMPLES
from omnibench.cli.terminal.calibration_tables import print_calibration

ROBOT = SAMPLES / "robot"
# Session of each kind of path, and the runs of each command.
SOURCES = {
    "circle_right": ("circular/231220200134", 1),
    "circle_left": ("circular/231220200134", 4),
    "straight": ("ivanjko/231220200102", 1),
    "turn_right": ("ivanjko/231220200102", 4),
    "turn_left": ("ivanjko/231220200102", 7),
    "square_right": ("square/231220200029", 1),
    "square_left": ("square/231220200029", 4),
}
RUNS = [(command, repetition) for command in SOURCES for repetition in (1, 2, 3)]


def recorded(command: str, repetition: int) -> np.ndarray:
    """The original run (rows, 6): t, x, y, theta, ticks of the right and of the left wheel."""
    session, first = SOURCES[command]
    folder = OPTIODOM / "diff" / session
    file = folder / f"{folder.name}_run-{first + repetition - 1:02d}.csv"
    return np.genfromtxt(file, delimiter=",", usecols=range(6))


def test_the_sample_is_small_and_brings_its_licence() -> None:
    files = [file for file in ROBOT.rglob("*") if file.is_file()]
    assert sum(file.stat().st_size for file in files) <= 300_000
    assert (ROBOT / "LICENSE").read_text(encoding="utf-8").startswith("MIT License")
    runs = pl.read_csv(ROBOT / "log" / "runs.csv").rows()
    assert sorted(runs) == sorted((f"{command}_{repetition}", command) for command, repetition in RUNS)
    assert {file.stem for file in files if file.suffix == ".csv"} == {"runs", *(run for run, _ in runs)}


@pytest.mark.skipif(not OPTIODOM.is_dir(), reason=f"{OPTIODOM} is absent: the recordings that the sample is made of")
@pytest.mark.parametrize(("command", "repetition"), RUNS)
def test_the_sample_holds_every_second_row_of_its_source(command: str, repetition: int) -> None:
    source = recorded(command, repetition)
    sample = pl.read_csv(ROBOT / "log" / f"{command}_{repetition}.csv")
    rows = slice(0, 2 * len(sample) - 1, 2)
    np.testing.assert_allclose(sample["t"], source[rows, 0], rtol=0, atol=0.006)
    ticks = np.cumsum(source[:, 4:6], axis=0) - source[0, 4:6]
    np.testing.assert_array_equal(np.cumsum(sample["ticks_right"]), ticks[rows, 0])
    np.testing.assert_array_equal(np.cumsum(sample["ticks_left"]), ticks[rows, 1])
    poses = sample.select("x", "y", "theta").to_numpy().astype(float)
    known = np.isfinite(poses).all(axis=1)
    assert known[::5].all()
    assert known[-1]
    np.testing.assert_allclose(poses[known], source[rows, 1:4][known], rtol=0, atol=6e-5)


def test_a_row_that_is_zero_by_design_is_called_so_and_warned_of_nowhere() -> None:
    options = {"wheel_unit": "ticks/sample", "ticks_per_turn": 2796.8}
    run = omnibench.calibrate(omnibench.import_dataset("csv", ROBOT / "log", options))
    console = Console(file=io.StringIO(), width=100)
    print_calibration(console, run)
    assert isinstance(console.file, io.StringIO)
    assert console.file.getvalue().count("by design") == 2
    assert run.result.held == ("m21", "m22")
    assert run.untouched == ()
