"""Coverage of the 95 % intervals of a calibration for matrix and geometry, over many simulated flowers.

    python tests/studies/uncertainty_coverage.py --seeds 200

The box is ``row``: the paper's box holds m12 at 0 and so does not contain the hidden matrix. Integration is that of the
simulated robot, arcs: the paper's Euler steps move row 3 by half a standard deviation, which no repetition shows.
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from omnibench.fit.calibrate import calibrate
from omnibench.robot.physical import read_matrix
from omnibench.simulate.source import read_simulation, simulate_dataset

CONFIG = Path(__file__).parents[2] / "configs" / "apr02.yaml"


@dataclass(frozen=True, eq=False)
class Coverage:
    """One seed: which intervals of the elements (9,) and of the geometry (9,) hold the truth.

    errors and deviations (9,): of the elements, and what their standard deviations are said to be.
    """

    elements: np.ndarray
    parameters: np.ndarray
    errors: np.ndarray
    deviations: np.ndarray
    source: str


def covered(seed: int, calibrator: str = "closed_form", repetitions: int = 5) -> Coverage:
    """Calibrate one simulated flower and compare it with its truth."""
    flower = read_simulation(CONFIG).config
    session = flower.train.model_copy(update={"seed": 20_000 + seed})
    changes = {"train": session, "validation": None, "repetitions": repetitions}
    simulation = simulate_dataset(flower.model_copy(update=changes))
    run = calibrate(simulation.dataset, calibrator, integration=flower.integration, seed=seed)
    found = run.uncertainty
    assert found is not None, run.warnings
    truth = np.array(simulation.truth.matrix)
    geometry = [each.value for each in read_matrix(simulation.dataset.robot, truth).parameters]
    inside = (truth >= found.intervals.low) & (truth <= found.intervals.high)
    held = [each.low <= value <= each.high for each, value in zip(run.parameters, geometry, strict=True)]
    errors = (run.calibration.matrix_array - truth).ravel()
    return Coverage(inside.ravel(), np.array(held), errors, found.standard_deviations.ravel(), found.source)


def main() -> None:
    """Print the coverage of every element and parameter, and of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--calibrator", default="closed_form")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    study = partial(covered, calibrator=arguments.calibrator, repetitions=arguments.repetitions)
    with ProcessPoolExecutor(arguments.workers) as pool:
        found = list(pool.map(study, range(arguments.seeds)))
    for name in ("elements", "parameters"):
        hits = np.array([getattr(each, name) for each in found])
        print(f"coverage of {name} of the hidden robot (simulated data), %:")
        print(np.round(100 * hits.mean(axis=0).reshape(3, 3), 1))
        print(f"all: {100 * hits.mean():.1f} % of {hits.size} intervals")
    one = binomtest(round(0.95 * arguments.seeds), arguments.seeds).proportion_ci(0.95, "wilson")
    print(f"95 % interval of one coverage, if it is 95 %: {100 * one.low:.1f} to {100 * one.high:.1f} %")
    seen = np.std([each.errors for each in found], axis=0)
    said = np.sqrt(np.mean(np.square([each.deviations for each in found]), axis=0))
    print("standard deviations of the elements, said over seen:")
    print(np.round((said / seen).reshape(3, 3), 3))
    for source, count in Counter(each.source for each in found).most_common(3):
        print(f"{count} of {arguments.seeds}: {source}")


if __name__ == "__main__":
    main()
