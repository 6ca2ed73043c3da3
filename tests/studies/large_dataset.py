"""Time and memory of data sets larger than memory, and whether parts and workers give what the whole gives.

    python tests/studies/large_dataset.py FOLDER --samples 1e8 [--workers 2] [--parts]

The recordings are simulated in pieces, a day of 2 million wheel samples at a time: runs of a minute at 100 Hz of a base
on three omni wheels, whose radii, distances and angles are off, with wheels that slip and encoders that count; poses
once a second, noisy. Its arcs are summed here, by code that shares nothing with omnibench. Days that are there are not
simulated again. Then `calibrate --intervals`, `check` and `evaluate` are run as a user does, and their seconds and peak
memory told.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
import yaml

SECONDS, RATE, RUNS_A_DAY, COMMANDS = 60, 100, 333, 24
ANGLES = np.radians([60.0, 180.0, 300.0])
RADIUS, DISTANCE = 0.05, 0.2  # m, of the design
TICK = 2 * np.pi / 4096  # rad of a wheel that an encoder tells
NOISE = np.array([0.003, 0.003, 0.003])  # m, m, rad of a pose


def wheel_equations() -> np.ndarray:
    """Rates (3, 3) of the true wheels by twist, rad/s by m/s and rad/s."""
    radii = RADIUS * np.array([1.02, 0.985, 1.01])
    distances = DISTANCE * np.array([1.015, 0.99, 1.005])
    angles = ANGLES + np.radians([0.7, -0.5, 0.4])
    return np.column_stack([-np.sin(angles), np.cos(angles), distances]) / radii[:, None]


def run_of(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Wheel rates (F, 3), rad/s, and poses (K, 4) with their times, of one run."""
    chance, command = np.random.default_rng(number), np.random.default_rng(1_000_000 + number % COMMANDS)
    period, count = 1 / RATE, SECONDS * RATE
    middle = (np.arange(count) + 0.5) * period
    frequencies, phases = command.uniform(0.02, 0.1, 3), command.uniform(0, 2 * np.pi, 3)
    sizes = command.uniform(0.5, 1, 3) * [0.3, 0.3, 0.5]
    twists = sizes * np.sin(2 * np.pi * frequencies * middle[:, None] + phases) + [0.1, 0, 0.1 * (-1) ** number]
    start = chance.normal(0, 1, 3)
    turns = twists[:, 2] * period
    headings = start[2] + np.append(0.0, np.cumsum(turns))
    chords = np.sinc(turns / (2 * np.pi)) * period  # an arc's chord: sin(h)/h with h half the turn
    steps = (twists[:, 0] + 1j * twists[:, 1]) * chords * np.exp(1j * (headings[:-1] + turns / 2))
    places = start[0] + 1j * start[1] + np.append(0.0, np.cumsum(steps))
    slip = 1 + 0.01 * np.repeat(chance.normal(0, 1, (SECONDS, 3)), RATE, axis=0)
    rates = np.round(twists @ wheel_equations().T * slip * period / TICK) * TICK / period
    seen = np.arange(0, count + 1, RATE)
    poses = np.column_stack([places.real, places.imag, headings])[seen] + chance.normal(0, 1, (len(seen), 3)) * NOISE
    return rates, np.column_stack([seen * period, poses])


def write_day(folder: Path, day: int, runs: int) -> None:
    """A data set folder of one day."""
    partial = folder.with_name(f".{folder.name}")
    partial.mkdir(parents=True, exist_ok=True)
    numbers = range(day * RUNS_A_DAY, day * RUNS_A_DAY + runs)
    made = [run_of(number) for number in numbers]
    names = [f"run{number:06d}" for number in numbers]
    pl.DataFrame(
        {
            "trajectory": names,
            "command": [f"c{number % COMMANDS:02d}" for number in numbers],
            "repetition": [number // COMMANDS for number in numbers],
            "split": ["validation" if number // COMMANDS % 2 else "train" for number in numbers],
            "session": [f"day{day:03d}"] * runs,
            "started_at": [float(index * (SECONDS + 1)) for index in range(runs)],
        }
    ).write_parquet(partial / "trajectories.parquet")
    for table, columns, parts in (
        ("wheels", ("omega_a", "omega_b", "omega_c"), [rates for rates, _ in made]),
        ("poses", ("x", "y", "theta"), [poses[:, 1:] for _, poses in made]),
    ):
        times = (np.arange(SECONDS * RATE) + 1) / RATE if table == "wheels" else made[0][1][:, 0]
        frame = {"trajectory": np.repeat(names, len(times)), "t": np.tile(times, runs)}
        frame |= dict(zip(columns, np.concatenate(parts).T, strict=True))
        pl.DataFrame(frame).write_parquet(partial / f"{table}.parquet")
    wheels = [
        {"name": name, "type": "omni", "radius": RADIUS, "distance": DISTANCE, "angle": float(angle)}
        for name, angle in zip("abc", ANGLES, strict=True)
    ]
    header = {
        "format": "omnibench-dataset/1",
        "name": "fleet",
        "simulated": True,
        "robot": {"name": "base", "wheels": wheels},
        "sample_period": 1 / RATE,
        "wheels": ["a", "b", "c"],
    }
    (partial / "dataset.yaml").write_text(yaml.safe_dump(header, sort_keys=False))
    partial.rename(folder)


def joined_days(days: Sequence[str], place: Path) -> str:
    """A data set folder that holds the runs of some days, as if their recording had gone on in it."""
    folder = place / f"{Path(days[0]).name}-{len(days)}"
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(Path(days[0]) / "dataset.yaml", folder)
    for table in ("trajectories", "wheels", "poses"):
        pl.scan_parquet([f"{day}/{table}.parquet" for day in days]).sink_parquet(folder / f"{table}.parquet")
    return str(folder)


@dataclass(frozen=True)
class Spent:
    """What a command took: s, and its own peak memory in MB."""

    seconds: float
    peak_mb: float


def spent_on(*arguments: str) -> Spent:
    """Run a command of omnibench to its end."""
    began = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "omnibench", *arguments], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"omnibench {' '.join(arguments[:2])} ended with {status}")
    return Spent(time.perf_counter() - began, used.ru_maxrss / 1000)


def calibration_of(places: Sequence[str], found: str) -> list[str]:
    """The words of the command that calibrates by some folders."""
    return ["calibrate", *places, "--calibrator", "closed_form", "--intervals", "-o", found, "--force"]


def numbers_of(calibration: Path) -> np.ndarray:
    """Matrix and covariance of a calibration file in one row."""
    content = yaml.safe_load(calibration.read_text())
    return np.concatenate([np.ravel(content["matrix"]), np.ravel(content["covariance"])])


def main() -> None:
    """Simulate what is missing, run the commands, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--samples", type=float, default=1e7)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--parts", action="store_true", help="also merge from two workers, and in ten folders and one")
    given = parser.parse_args()
    runs = round(given.samples / (SECONDS * RATE))
    days = -(-runs // RUNS_A_DAY)
    for day in range(days):
        folder = given.folder / f"day{day:03d}"
        if not folder.is_dir():
            write_day(folder, day, min(RUNS_A_DAY, runs - day * RUNS_A_DAY))
            print(f"\rsimulated {day + 1} of {days} days", end="", file=sys.stderr)
    places = [str(given.folder / f"day{day:03d}") for day in range(days)]
    found = str(given.folder / "calibration.yaml")
    by = ["--backend", "processes", "--workers", str(given.workers)] if given.workers else []
    total = 0.0
    print(f"{runs * SECONDS * RATE:,} wheel samples (simulated), {runs:,} runs, {days} folders; {' '.join(by)}")
    for words in (
        calibration_of(places, found),
        ["check", *places],
        ["evaluate", found, *places],
    ):
        spent = spent_on(*words, *by)
        total += spent.seconds
        print(f"{words[0]:10} {spent.seconds:8.1f} s  peak {spent.peak_mb:7.0f} MB", flush=True)
    print(f"{'in all':10} {total:8.1f} s  {1e6 * total / (runs * SECONDS * RATE):.2f} us a sample")
    if given.parts:
        whole, other = numbers_of(Path(found)), str(given.folder / "other.yaml")
        joined = given.folder / "joined"
        tenths = [joined_days(part.tolist(), joined) for part in np.array_split(places, 10)]
        for words, folders, options in (
            ("merged from 2 workers", places, ("--backend", "processes", "--workers", "2")),
            ("appended in 10 parts", tenths, ()),
            ("in one folder", [joined_days(places, joined)], ()),
        ):
            spent_on(
                "calibrate", *folders, "--calibrator", "closed_form", "--intervals", "-o", other, "--force", *options
            )
            print(f"{words}: differs by {np.abs(numbers_of(Path(other)) / whole - 1).max():.1e} of itself", flush=True)


if __name__ == "__main__":
    main()
