"""Study of the kernel of fit/uncertainty.py: the stated deviation of a median, divided by the true one.

    python tests/studies/kernel_width.py [--draws 1000]

The median of n errors with the density f has the standard deviation 1 / (2 f(0) sqrt(n)) for many runs. Printed for
each distribution, number of runs and width of the kernel are the median of the stated deviation's ratio to this and,
in brackets, 80 % of its values.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

import numpy as np

import omnibench.fit.uncertainty as module
from omnibench.registry import costs
from omnibench.robot.kinematics import Array

WIDTHS = (0.35, 0.7, 1.4)
RNG = np.random.default_rng(0)
# How each distribution is drawn, and its density at zero.
ERRORS: dict[str, tuple[Callable[[int], Array], float]] = {
    "normal": (RNG.standard_normal, 1 / math.sqrt(2 * math.pi)),
    "Laplace": (lambda count: RNG.laplace(size=count), 0.5),
    "uniform": (lambda count: RNG.uniform(-1, 1, count), 0.5),
    "Student, 3": (lambda count: RNG.standard_t(3, count), 2 / (math.pi * math.sqrt(3))),
}


def ratios(draw: Callable[[int], Array], density: float, count: int, draws: int) -> Array:
    """Ratios (draws,) of the stated to the true standard deviation of the median of ``count`` headings."""
    objective, run = costs.create("final_heading"), np.arange(count)
    found = []
    for _ in range(draws):
        errors, jacobian = np.zeros((count, 3)), np.zeros((count, 3, 1))
        errors[:, 2], jacobian[:, 2] = draw(count), 1.0
        errors[:, 2] -= np.median(errors[:, 2])
        hessian = module.sum_of_norms(objective, run, errors, jacobian)[1].sum()
        found.append(2 * density / hessian)  # the Hessian is twice the density that the kernel estimates
    return np.array(found)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=1000, help="medians of each kind")
    arguments = parser.parse_args()
    for name, (draw, density) in ERRORS.items():
        for count in (12, 36, 144):
            row = []
            for width in WIDTHS:
                module._KERNEL = width
                values = ratios(draw, density, count, arguments.draws)
                low, middle, high = np.quantile(values, [0.1, 0.5, 0.9])
                row.append(f"{width}: {middle:.2f} [{low:.2f} {high:.2f}]")
            print(f"{name:10} {count:4} runs  {'   '.join(row)}", flush=True)


if __name__ == "__main__":
    main()
