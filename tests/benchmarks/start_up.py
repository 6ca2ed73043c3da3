"""How long ``omnibench --help`` takes beside a Python that only imports Typer and Rich.

``python tests/benchmarks/start_up.py [--runs 20]`` runs the two in turn, each in a process of its own, and prints the
medians of the wall time and of the processor time (user and system), in ms, and their ratios.
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


def times(command: tuple[str, ...]) -> tuple[float, float]:
    """Wall and processor time of one process, in ms."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return 1000 * wall, 1000 * (after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)


def main() -> None:
    """Print the medians and their ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20, help="Of each of the two.")
    runs = parser.parse_args().runs
    for command in (HELP, BARE):  # once each, so that the files are in the disk's cache
        times(command)
    pairs = [(times(HELP), times(BARE)) for _ in range(runs)]
    for index, kind in enumerate(("wall time", "processor time")):
        ours, bare = (median(pair[which][index] for pair in pairs) for which in (0, 1))
        print(f"{kind}: omnibench --help {ours:.0f} ms, import typer, rich {bare:.0f} ms, ratio {ours / bare:.2f}")


if __name__ == "__main__":
    main()
