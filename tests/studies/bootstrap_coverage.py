"""Coverage of closed_form's 95 % bootstrap intervals, over many seeds of the simulated flower.

    python tests/studies/bootstrap_coverage.py --seeds 100

The box is ``row``: the paper's box holds m12 at 0 and so does not contain the hidden matrix.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import binom

from omnibench.compare.config import read_compare_config
from omnibench.fit.bootstrap import bootstrap_intervals
from omnibench.fit.calibrator import run_calibrator
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.fit.ratio_intervals import UnitName, units_of
from omnibench.registry import calibrators, costs
from omnibench.simulate.source import read_simulation, simulate_dataset

CONFIG = Path(__file__).parents[2] / "configs" / "apr02.yaml"


def covered(seed: int, resamples: int, unit: UnitName = "run") -> np.ndarray:
    """Which elements (3, 3) of the hidden matrix lie in their intervals, for one seed of the simulation."""
    config = read_compare_config(CONFIG)
    flower = read_simulation(CONFIG).config
    session = flower.train.model_copy(update={"seed": 10_000 + seed})
    simulation = simulate_dataset(flower.model_copy(update={"train": session, "validation": None}))
    dataset = simulation.dataset
    training = dataset.split("train")
    problem = CalibrationProblem(
        dataset.robot,
        training,
        costs.create("final_pose"),
        make_parameterisation("matrix", dataset.robot, training, box="row"),
        integration=config.integration,
        budget=Budget(),
        seed=seed,
    )
    result = run_calibrator(calibrators.create("closed_form"), problem)
    assert result.vector is not None, result.reason
    units = units_of(training, unit)
    rng = np.random.default_rng(seed)
    intervals = bootstrap_intervals(problem, result.vector, units=units, resamples=resamples, rng=rng)
    truth = np.array(simulation.truth.matrix)
    return (truth >= intervals.low) & (truth <= intervals.high)


def main() -> None:
    """Print the coverage of every element and of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--resamples", type=int, default=400)
    parser.add_argument("--unit", choices=["command", "run"], default="command", help="what is resampled")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    chosen = partial(covered, resamples=arguments.resamples, unit=arguments.unit)
    with ProcessPoolExecutor(arguments.workers) as pool:
        hits = np.array(list(pool.map(chosen, range(arguments.seeds))))
    print("coverage of the elements of the hidden matrix (simulated data), %:")
    print(np.round(100 * hits.mean(axis=0), 1))
    low, high = binom.interval(0.95, arguments.seeds, 0.95)
    print(f"all: {100 * hits.mean():.1f} % of {hits.size} intervals")
    print(f"expected of one element, if its coverage is 95 %: {low:.0f} to {high:.0f} of {arguments.seeds}")


if __name__ == "__main__":
    main()
