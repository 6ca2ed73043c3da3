"""Coverage of the 95 % intervals of shrunk calibrations: robots of every class, drawn from the stated prior.

    python tests/benchmarks/shrink_coverage.py --sets 1000

Every set is a robot of its own, its matrix drawn from the prior of its class (fit/shrinkage/prior.py). What is counted
is whether the interval of each row along each direction that the commands drive holds the truth. The recordings are
those of tests/wheeled_recordings.py.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from sample_robots import APR_02, WHEELED
from wheeled_recordings import PERIOD, recorded

from omnibench.data.dataset import make_dataset
from omnibench.fit.calibrate import calibrate
from omnibench.fit.shrinkage.prior import prior_root, tolerance_of
from omnibench.fit.span import driven_span
from omnibench.fit.uncertainty.intervals import EstimatedCovariance
from omnibench.robot.kinematics import Array, Robot

ROBOTS = {robot.name: robot for robot in (APR_02, *WHEELED)}


def drawn_matrix(robot: Robot, rng: np.random.Generator) -> Array:
    """A matrix (3, M) from the prior, of a robot whose wheels do not slide where they must not."""
    root = prior_root(robot, tolerance_of(robot))
    deviation = (root @ rng.standard_normal(root.shape[1])).reshape(3, -1)
    guided = not robot.slides and robot.name == "diff"  # those whose tracked point is known
    return robot.inverse_kinematic_matrix + (robot.allowed_twists @ deviation if guided else deviation)


def covered(seed: int, name: str) -> tuple[Array, Array]:
    """Which rows (3, D) along the driven directions hold the truth, and the errors in standard deviations (3, D)."""
    robot, rng = ROBOTS[name], np.random.default_rng([seed, len(name)])
    matrix = drawn_matrix(robot, rng)
    dataset = make_dataset(name, robot, PERIOD, recorded(robot, matrix, rng), simulated=True)
    run = calibrate(dataset, unidentified="shrink")
    result = run.result
    assert result.covariance is not None
    assert result.degrees_of_freedom is not None
    driven = driven_span(dataset.trajectories).strong
    known = EstimatedCovariance(result.covariance, result.degrees_of_freedom).of(np.kron(np.eye(3), driven))
    errors = ((run.calibration.matrix_array - matrix) @ driven.T).ravel()
    free = known.standard_deviations > 0
    inside = np.where(free, np.abs(errors) <= known.reach, np.nan)
    scaled = np.where(free, errors / np.where(free, known.standard_deviations, 1.0), np.nan)
    return inside.reshape(3, -1), scaled.reshape(3, -1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=1000)
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS))
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    with ProcessPoolExecutor(arguments.workers) as pool:
        for name in arguments.robots:
            results = list(pool.map(partial(covered, name=name), range(arguments.sets), chunksize=5))
            inside = np.array([each for each, _ in results])
            scaled = np.array([each for _, each in results])
            rows = " ".join(
                f"{100 * np.nanmean(inside[:, row]):.1f}" for row in range(3) if not np.isnan(inside[:, row]).all()
            )
            print(
                f"{name}: {len(inside)} sets, {100 * np.nanmean(inside):.1f} % of the intervals hold the truth "
                f"(rows {rows}), errors {np.sqrt(np.nanmean(scaled**2)):.2f} standard deviations",
                flush=True,
            )


if __name__ == "__main__":
    main()
