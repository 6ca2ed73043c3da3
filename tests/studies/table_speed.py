"""Seconds and peak memory of `omnibench import csv` for long tables, beside polars' own read_csv.

    python tests/studies/table_speed.py [--rows 720000 10000000] [--layouts runs files continuous] [--folder DIR]

The tables hold ticks of two wheels and a pose in each row, at 100 Hz: one file of several runs that a column names
(`runs`), a file a run (`files`), or one file of one recording without an end, which is cut at its rests (`continuous`).
They are read in processes of their own: by polars, by the import without its check, and by the import as a user types
it. Prints a line a process; processor seconds count where others share the machine.
"""

from __future__ import annotations

import argparse
import itertools
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
_REST = 100  # rows at the end of each part of a recording without an end in which the robot stands
_WHEEL = "  - {{name: {}, type: fixed, radius: {}, x: 0, y: {}}}\n"
_ROBOT = f"name: cart\nwheels:\n{_WHEEL.format('left', _RADIUS, _HALF)}{_WHEEL.format('right', _RADIUS, -_HALF)}"
_POLARS = "import polars as pl, sys; print(sum(pl.read_csv(file).height for file in sys.argv[1:]))"


LAYOUTS = ("runs", "files", "continuous")


def write_table(folder: Path, rows: int, layout: str = "runs") -> Path:
    """Tables of ``rows`` rows and their robot.yaml: speeds and turns that vary slowly, arcs summed here.

    Returns the file, or the folder of files. A recording without an end rests for a second after every 200 s.
    """
    rng, parts = np.random.default_rng(rows), []
    place, angle, ways, begin = 0j, 0.0, [0.0, 0.0], 0.0
    for number, first in enumerate(range(0, rows, _RUN)):
        count = min(_RUN, rows - first)
        t = np.arange(count) * _PERIOD
        v, w = (size * np.sin(2 * np.pi * rate * t + number) for size, rate in ((0.4, 0.05), (0.8, 0.031)))
        if layout == "continuous":
            v[-_REST:], w[-_REST:] = 0.0, 0.0
        else:
            place, angle, ways, begin = 0j, 0.0, [0.0, 0.0], 0.0
        heading = angle + np.append(0.0, np.cumsum(w[1:] * _PERIOD))
        middle = (heading[1:] + heading[:-1]) / 2
        places = place + np.append(0.0, np.cumsum(v[1:] * _PERIOD * np.exp(1j * middle)))
        driven = [np.append(0.0, np.cumsum((v - side * _HALF * w)[1:] * _PERIOD)) / _RADIUS for side in (1.01, -1.01)]
        turned = [way + angles for way, angles in zip(ways, driven, strict=True)]
        ticks = [np.floor(angles / (2 * np.pi) * _TICKS).astype(int) for angles in turned]
        x, y, theta = np.array([places.real, places.imag, heading]) + rng.normal(0, 0.002, (3, count))
        columns = {"t": begin + t, "ticks_left": ticks[0], "ticks_right": ticks[1], "x": x, "y": y, "theta": theta}
        parts.append(pl.DataFrame(({"run": [f"run_{number:04d}"] * count} if layout == "runs" else {}) | columns))
        place, angle, ways = places[-1], heading[-1], [float(angles[-1]) for angles in turned]
        begin += count * _PERIOD
    (folder / "robot.yaml").write_text(_ROBOT)
    if layout == "files":
        (folder / "log").mkdir()
        for number, part in enumerate(parts):
            part.write_csv(folder / "log" / f"run_{number:04d}.csv", float_precision=5)
        return folder / "log"
    pl.concat(parts).write_csv(folder / "log.csv", float_precision=5)
    return folder / "log.csv"


def timed(words: list[str]) -> tuple[int, float, float, float]:
    """Status, seconds, processor seconds and peak memory (MB, of 10^6 bytes) of a process."""
    begin = time.monotonic()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, env=os.environ | {"PYTHONPATH": str(ROOT)})
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds, processor = time.monotonic() - begin, usage.ru_utime + usage.ru_stime
    return process.returncode, seconds, processor, usage.ru_maxrss * 1024 / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, nargs="+", default=[720_000, 10_000_000])
    parser.add_argument("--layouts", nargs="+", choices=LAYOUTS, default=LAYOUTS)
    parser.add_argument("--folder", type=Path, help="where the tables are written; default: a temporary folder")
    given = parser.parse_args()
    print(f"{'rows':>10} {'layout':12}{'MB':>5}  {'process':18}{'s':>8}{'CPU s':>8}{'peak MB':>9}")
    for rows, layout in itertools.product(given.rows, given.layouts):
        with tempfile.TemporaryDirectory(dir=given.folder) as scratch:
            source = write_table(Path(scratch), rows, layout)
            files = sorted(source.iterdir()) if source.is_dir() else [source]
            line = [sys.executable, "-m", "omnibench", "import", "csv", str(source), "-o", f"{scratch}/ds", "--force"]
            line += ["--set", "wheel_unit=ticks", "--set", f"ticks_per_turn={_TICKS}"]
            line += ["--set", "cut=rests"] if layout == "continuous" else []
            for name, words in (
                ("polars read_csv", [sys.executable, "-c", _POLARS, *map(str, files)]),
                ("import --no-check", [*line, "--no-check"]),
                ("import", line),
            ):
                status, seconds, processor, peak = timed(words)
                size = sum(file.stat().st_size for file in files) / 1e6
                ended = f"  ended with {status}" if status else ""
                print(
                    f"{rows:10} {layout:12}{size:5.0f}  {name:18}{seconds:8.1f}{processor:8.1f}{peak:9.0f}{ended}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
