"""Load, faults and time: the live system's processes under random faults, and an account of every sample.

    python tests/studies/chaos.py [--minutes 3] [--hours N] [--seed N]

A node, a replay, a recorder, a listener, a router and a TCP proxy between them run as processes, and two robots send
samples that nobody acknowledges. Processor hogs, SIGSTOP, SIGKILL and SIGTERM, links that are cut, stalled and slowed,
full disks, stamps that jump, junk, floods of queries and calibrations that are swapped come at random. After every
round the faults end, and each sample sent is accounted for: taken, refused and counted, counted as missing, or lost
with a killed process. Needs no rights of root. Exits 1 when a check failed; Ctrl-C and SIGTERM end it
in order.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial

from chaos.run import run

from omnibench.live.stopping import stop_on_signals


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--hours", type=float, help="in place of --minutes")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    minutes = arguments.minutes if arguments.hours is None else 60 * arguments.hours
    with stop_on_signals() as stop:
        return 0 if run(60 * minutes, arguments.seed, partial(print, flush=True), stop=stop) else 1


if __name__ == "__main__":
    sys.exit(main())
