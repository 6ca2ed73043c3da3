"""Real recordings reduced to distances, angles, displacements and positions, beside the fit to all of their poses.

    python tests/benchmarks/reference_recordings.py

Printed is how far apart the two calibrations are along what the references tell, in units of both their intervals
(95 %, added), and how many are within: 1 is the edge.
"""

from __future__ import annotations

import argparse

import numpy as np
from reference_coverage import KINDS, reduced

from omnibench.data.dataset import Dataset
from omnibench.fit.calibrate import calibrate
from omnibench.slam.import_dataset import import_dataset

DATA = "../shared/data/optiodom"
ROBOTS = {"omni3": "omni3", "diff": "diff"}


def apart(dataset: Dataset, kind: str) -> np.ndarray:
    """Distances of the reduced fit from the full one, element by element, over the sum of both intervals' reaches."""
    full = calibrate(dataset, "trajectory_ml", unidentified="keep")
    part = calibrate(reduced(dataset, kind, np.random.default_rng(1)), unidentified="keep")
    assert full.uncertainty is not None
    assert part.uncertainty is not None
    reaches = [(each.intervals.high - each.intervals.low) / 2 for each in (full.uncertainty, part.uncertainty)]
    away = np.abs(full.calibration.matrix_array - part.calibration.matrix_array) / (reaches[0] + reaches[1])
    return away[np.isfinite(away)]


def main() -> None:
    """Print the distances of every robot and kind."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS))
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    arguments = parser.parse_args()
    for robot in arguments.robots:
        folder = ROBOTS[robot]
        dataset = import_dataset("optiodom", f"{DATA}/{folder}")
        for kind in arguments.kinds:
            away = apart(dataset, kind)
            print(
                f"{robot}, {kind}: {(away <= 1).sum()} of {len(away)} within; farthest {away.max(initial=0):.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
