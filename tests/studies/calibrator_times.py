"""Time of the calibrators on the simulated flower, in seconds and in direct evaluations of Eq. (6).

    python tests/studies/calibrator_times.py [NAME ...]

The evaluation is timed in the same process, so that the ratio holds on a busy machine.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from omnibench.compare.config import read_compare_config
from omnibench.fit.calibrator import run_calibrator
from omnibench.fit.problem import CalibrationProblem, make_parameterisation
from omnibench.registry import calibrators, costs

CONFIG = Path(__file__).parents[2] / "configs" / "apr02.yaml"
EVALUATIONS = 200


def main() -> None:
    """Print a line for every calibrator."""
    config = read_compare_config(CONFIG)
    ((name, source),) = config.datasets.items()
    dataset = source.load(name)
    training = dataset.split("train")
    for chosen in sys.argv[1:] or ["closed_form", "crs", "genetic", "isres", "parametric"]:
        calibrator = calibrators.create(chosen)
        problem = CalibrationProblem(
            dataset.robot,
            training,
            costs.create(config.cost.name),
            make_parameterisation(calibrator.parameterisation, dataset.robot, training, box="paper"),
            integration=config.integration,
            budget=config.budget,
            seed=1,
        )
        began = time.perf_counter()
        for _ in range(EVALUATIONS):
            problem.values(problem.start[None])
        one = (time.perf_counter() - began) / EVALUATIONS
        seconds = -problem.seconds
        result = run_calibrator(calibrator, problem)
        seconds += result.seconds
        cost = np.nan if result.cost is None else result.cost
        print(
            f"{chosen:12} {result.outcome}, cost {cost:.9f}, {seconds:7.2f} s, "
            f"{result.evaluations} evaluations, the time of {seconds / one:.0f} evaluations of {1000 * one:.2f} ms"
        )


if __name__ == "__main__":
    main()
