"""Real recordings reduced to distances, angles, displacements and positions, beside the fit to all of their poses.

    python tests/studies/reference_recordings.py [--robots diff] [--kinds distance turn] [--chords] [--clocks none]

Printed is how far apart the two calibrations are along what the references tell, in units of both their intervals
(95 %, added), and how many are within: 1 is the edge.

A tape measures the way that was driven, the poses of a camera a longer one: noise of 0.3 mm, 25 times a second, makes
the sum of the chords between them 2 % longer on diff's curves, and 1.4 m of the 0.3 m of a turn on the spot. Positions
are therefore smoothed before they become distances. --chords leaves them as they are, which shows how much it matters.

The clocks of these recordings were matched by hand, and drift by 0.1 s a minute. A run ends at rest, so that what is
measured at its end does not hang on the clock; the poses on the way do, which makes row 3 of the full fit of diff 0.1 %
smaller. The full fit therefore finds offset and slope of each run's clock. --clocks none takes the clocks as they are.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from reference_coverage import KINDS, reduced
from scipy.signal import savgol_filter

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.slam.import_dataset import import_dataset

DATA = "../shared/data/optiodom"
ROBOTS = {"omni3": "omni3", "diff": "diff"}
WINDOW, ORDER = 1.0, 3  # s, degree: polynomials by which positions are smoothed


def smoothed(dataset: Dataset) -> Dataset:
    """A data set whose positions are values of local cubics over a second."""
    runs = [_smoothed(run) for run in dataset.trajectories]
    return make_dataset("smoothed", dataset.robot, dataset.sample_period, runs)


def _smoothed(run: Trajectory) -> Trajectory:
    """Positions of a run along which the way is that of the robot."""
    period = float(np.median(np.diff(run.pose_times)))
    count = min(2 * round(WINDOW / period / 2) + 1, (len(run.poses) - 1) // 2 * 2 + 1)
    places = savgol_filter(run.poses[:, :2], count, ORDER, axis=0)
    return replace(run, poses=np.column_stack([places, run.poses[:, 2]]))


def apart(dataset: Dataset, kind: str, full: CalibrationRun, chords: bool) -> np.ndarray:
    """Distances of the reduced fit from the full one, element by element, over the sum of both intervals' reaches."""
    source = dataset if chords or "distance" not in kind else smoothed(dataset)
    part = calibrate(reduced(source, kind, np.random.default_rng(1)))
    away = np.abs(full.calibration.matrix_array - part.calibration.matrix_array) / (_reach(full) + _reach(part))
    return away[np.isfinite(away)]


def _reach(run: CalibrationRun) -> np.ndarray:
    """Half-widths of a calibration's intervals."""
    assert run.uncertainty is not None, run.warnings
    return (run.uncertainty.intervals.high - run.uncertainty.intervals.low) / 2


def main() -> None:
    """Print the distances of every robot and kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS))
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--clocks", default="offset_and_slope", help="what the full fit finds of them; or none, offset")
    parser.add_argument("--chords", action="store_true", help="distances are the chords between poses as they are")
    arguments = parser.parse_args()
    for robot in arguments.robots:
        dataset = import_dataset("optiodom", f"{DATA}/{ROBOTS[robot]}")
        full = calibrate(dataset, "map", options={"clock": arguments.clocks})
        for kind in arguments.kinds:
            away = apart(dataset, kind, full, arguments.chords)
            print(
                f"{robot}, {kind}: {(away <= 1).sum()} of {len(away)} within; farthest {away.max(initial=0):.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
