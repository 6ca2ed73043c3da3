"""How long ``omnibench --help`` takes beside a Python that only imports Typer and Rich, and ``import omnibench`` beside
``import numpy``.

``python tests/studies/start_up.py [--runs 20]`` runs each pair in turn, each in a process of its own, and prints the
ratios of the medians of the wall time and of the processor time (user and system).
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from statistics import median

# What the installed script does; ``python -m`` would import more of Python's own modules.
HELP = (sys.executable, "-c", "from omnibench.__main__ import main; main()", "--help")
BARE = (sys.executable, "-c", "import typer, rich")
PACKAGE, NUMPY = ((sys.executable, "-c", f"import {name}") for name in ("omnibench", "numpy"))


def times(command: tuple[str, ...]) -> tuple[float, float]:
    """Wall and processor time of one process, in ms."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return 1000 * wall, 1000 * (after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)


def ratio(ours: tuple[str, ...], other: tuple[str, ...], runs: int) -> tuple[float, float]:
    """Ratio of the medians of the wall time and of the processor time of two commands that run in turn."""
    for command in (ours, other):  # once each, so that the files are in the disk's cache
        times(command)
    pairs = [(times(ours), times(other)) for _ in range(runs)]
    medians = [[median(pair[which][index] for pair in pairs) for which in (0, 1)] for index in (0, 1)]
    return medians[0][0] / medians[0][1], medians[1][0] / medians[1][1]


def main() -> None:
    """Print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20, help="Of each of the two.")
    runs = parser.parse_args().runs
    for words, pair in {
        "omnibench --help : import typer, rich": (HELP, BARE),
        "import omnibench : import numpy": (PACKAGE, NUMPY),
    }.items():
        wall, processor = ratio(*pair, runs)
        print(f"{words}: {wall:.2f} of the wall time, {processor:.2f} of the processor time")


if __name__ == "__main__":
    main()
