"""Seconds and peak memory of `omnibench import csv` for long tables, beside polars' own read_csv.

    python tests/studies/table_speed.py [--rows 720000 10000000] [--folder DIR]

Each table is one file of several runs at 100 Hz with ticks of two wheels and a pose in each row. It is read in
processes of their own: by polars, by the import without its check, and by the import as a user types it. Prints a line
a process.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import polars as pl

ROOT = Path(__file__).resolve().parents[2]
_PERIOD, _RUN, _RADIUS, _HALF, _TICKS = 0.01, 20_000, 0.05, 0.15, 4096  # s; rows; m; m; of a turn
_WHEEL = "  - {{name: {}, type: fixed, radius: {}, x: 0, y: {}}}\n"
_ROBOT = f"name: cart\nwheels:\n{_WHEEL.format('left', _RADIUS, _HALF)}{_WHEEL.format('right', _RADIUS, -_HALF)}"
_POLARS = "import polars as pl, sys; print(pl.read_csv(sys.argv[1]).height)"


def write_table(folder: Path, rows: int) -> Path:
    """A table of ``rows`` rows and its robot.yaml: speeds and turns that vary slowly, arcs summed here."""
    rng, parts = np.random.default_rng(rows), []
    for number, first in enumerate(range(0, rows, _RUN)):
        count = min(_RUN, rows - first)
        t = np.arange(count) * _PERIOD
        v, w = (size * np.sin(2 * np.pi * rate * t + number) for size, rate in ((0.4, 0.05), (0.8, 0.031)))
        heading = np.append(0.0, np.cumsum(w[1:] * _PERIOD))
        place = np.append(0.0, np.cumsum(v[1:] * _PERIOD * np.exp(1j * (heading[1:] + heading[:-1]) / 2)))
        ways = [np.append(0.0, np.cumsum((v - side * _HALF * w)[1:] * _PERIOD)) / _RADIUS for side in (1.01, -1.01)]
        ticks = [np.floor(way / (2 * np.pi) * _TICKS).astype(int) for way in ways]
        x, y, theta = np.array([place.real, place.imag, heading]) + rng.normal(0, 0.002, (3, count))
        columns = {"t": t, "ticks_left": ticks[0], "ticks_right": ticks[1], "x": x, "y": y, "theta": theta}
        parts.append(pl.DataFrame({"run": [f"run_{number:04d}"] * count} | columns))
    (folder / "robot.yaml").write_text(_ROBOT)
    pl.concat(parts).write_csv(folder / "log.csv", float_precision=5)
    return folder / "log.csv"


def timed(words: list[str]) -> tuple[int, float, float]:
    """Status, seconds and peak memory (MB) of a process."""
    begin = time.monotonic()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, env=os.environ | {"PYTHONPATH": str(ROOT)})
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, time.monotonic() - begin, usage.ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, nargs="+", default=[720_000, 10_000_000])
    parser.add_argument("--folder", type=Path, help="where the tables are written; default: a temporary folder")
    given = parser.parse_args()
    print(f"{'rows':>10}{'MB':>7}  {'process':24}{'s':>8}{'peak MB':>9}{'million rows a s':>18}")
    for rows in given.rows:
        with tempfile.TemporaryDirectory(dir=given.folder) as scratch:
            file = write_table(Path(scratch), rows)
            line = [sys.executable, "-m", "omnibench", "import", "csv", str(file), "-o", f"{scratch}/ds", "--force"]
            line += ["--set", "wheel_unit=ticks", "--set", f"ticks_per_turn={_TICKS}"]
            for name, words in (
                ("polars read_csv", [sys.executable, "-c", _POLARS, str(file)]),
                ("import --no-check", [*line, "--no-check"]),
                ("import", line),
            ):
                status, seconds, peak = timed(words)
                size = file.stat().st_size / 1e6
                ended = f"{rows / seconds / 1e6:18.2f}" if status == 0 else f"  ended with {status}"
                print(f"{rows:10}{size:7.0f}  {name:24}{seconds:8.1f}{peak:9.0f}{ended}", flush=True)


if __name__ == "__main__":
    main()
