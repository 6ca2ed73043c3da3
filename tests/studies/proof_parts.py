"""Parts of the box that a proof needs, from which ``certify`` says beforehand about how long it takes.

    python tests/studies/proof_parts.py [--seconds 120]

For every data set, box and cost: the number of parts after which the gap was below 10, 1 and 0.1 %, and the mean time
of a part. All data sets are simulated. Of the real omni3: 901 parts in the box ``paper``, above 1,500 in ``row``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np

from omnibench.data.dataset import Dataset
from omnibench.fit.calibrate import calibrate
from omnibench.fit.certify import certify_optimum
from omnibench.progress import Progress
from omnibench.simulate.source import read_simulation, simulate_dataset

CONFIGS = Path(__file__).parents[2] / "configs"
GAPS = (0.1, 0.01, 0.001)


def datasets() -> Iterator[tuple[str, Dataset, tuple[str, ...]]]:
    """Names, recordings to train and costs to prove bounds of."""
    for name, changes, costs in (
        ("small", {}, ("final_pose", "trajectory")),
        ("apr02", {}, ("final_pose",)),
        ("apr02", {"repetitions": 1}, ("final_pose", "trajectory")),
        ("mecanum", {}, ("final_pose",)),
    ):
        simulation = read_simulation(CONFIGS / f"{name}.yaml").config
        chosen = simulation.model_copy(update={"validation": None, **changes})
        yield f"{name}{' once' if changes else ''}", simulate_dataset(chosen).dataset, costs


def main() -> None:
    """Print a line a proof, and the least, the middle and the largest number of parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=120.0)
    arguments = parser.parse_args()
    print(f"parts at a gap of {' '.join(f'{gap:g}' for gap in GAPS)}; time of a part")
    last = []
    for (name, dataset, costs), box in product(datasets(), ("row", "paper")):
        for cost in costs:
            calibration = calibrate(dataset, box=box, cost=cost).calibration
            bounds: list[tuple[int, float]] = []

            def watch(event: Progress, seen: list[tuple[int, float]] = bounds) -> None:
                if event.task == "proof" and event.best:
                    seen.append((event.done, 1 - float(event.note.split()[1]) / event.best))

            certified = certify_optimum(calibration, dataset, box=box, seconds=arguments.seconds, watch=watch)
            needed = [next((done for done, gap in bounds if gap <= wanted + 1e-5), None) for wanted in GAPS]
            proof = certified.proof
            last += [proof.boxes] * proof.finished
            print(f"{name:12s} {box:5s} {cost:10s} {needed}  {proof.seconds / proof.boxes:.3f} s a part", flush=True)
    print("parts of all that were finished: least, middle, most:", np.percentile(last, [0, 50, 100]))


if __name__ == "__main__":
    main()
