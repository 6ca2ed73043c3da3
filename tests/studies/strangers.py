"""Strangers' robots: what `omnibench check` and the importers say of their recordings, and whether that mends them.

    python tests/studies/strangers.py [--kinds 1 2 ...] [--only PATTERN] [--shared DIR] [--jobs N] [--list] [--keep DIR]

Recordings come from a simulation of the study's own (strangers/motion.py, 1 kHz, contact velocities) and, where the
folder of shared cases is there, from the makers of these. strangers/table.yaml says of each how it is made, what is
typed and what is right. The judge (strangers/judge.py) types `omnibench check ... --json`, then the command that it
prints, at most twice, then imports and calibrates what came out, and compares that with the true motions or lengths.
A variant is passed where nothing was wrong. Prints a line a variant as it ends, all that was wrong, and a table of
passes by kind.
"""

from __future__ import annotations

import sys

from strangers.exam import main

if __name__ == "__main__":
    sys.exit(main(__doc__))
