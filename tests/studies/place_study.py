"""Study of places: how often what is missing depends on the likeliest covariate, and on the second.

    python tests/studies/place_study.py [--levels 150 1000] [--factors 0.5 1 1.5]      # four minutes

Blind sets with one effect each, of the catalogue and outside it, none of which may be named. The right covariate is
the one in which the catalogue, or the effect's maker, says that it shows. Beside the rates stand the probabilities that
were said, for the discrepancy of the generic bases and for multiples of it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from hidden.forms import FORMS
from hidden.outside import OUTSIDE
from hidden.sets import make_set

from omnibench.discover import locate as locating
from omnibench.discover.fit import PlainFit, fit_matrix
from omnibench.discover.locate import locate, weights_of_covariates
from omnibench.discover.result import CHANCE
from omnibench.discover.significance import Significance
from omnibench.fit.trajectory_fit import usable_runs
from omnibench.processes import one_thread
from omnibench.registry import effects


def seen(levels: list[float]) -> Iterator[tuple[str, tuple[str, ...], Significance]]:
    """Each set in which something is significant: its effect, the right covariates, and the bases' significance."""
    rng, seed = np.random.default_rng(0), 1000
    for level in levels:
        for name in (*OUTSIDE, *FORMS):
            if name == "tyre_wear":  # shows between sessions, of which these sets have one
                continue
            seed += 1
            outside = name in OUTSIDE
            design = "flower" if outside and seed % 2 else "small"
            dataset, _ = make_set("outside" if outside else "single", name, level, seed, design=design)
            runs, start = usable_runs(dataset.split("train")), dataset.robot.inverse_kinematic_matrix
            plain = fit_matrix(runs, dataset.robot, dataset.sample_period, start)
            found = locate(PlainFit(dataset, plain), [entry.name for entry in effects.entries()], rng).where
            if found.p_value(found.best) < CHANCE:
                yield name, OUTSIDE[name].covariates if outside else (effects.create(name).shows_in,), found


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--levels", type=float, nargs="+", default=[150.0, 1000.0])
    parser.add_argument("--factors", type=float, nargs="+", default=[0.5, 1.0, 1.5])
    arguments = parser.parse_args()
    usual = locating._OF_BASES
    with one_thread():
        sets = list(seen(arguments.levels))
    for factor in arguments.factors:
        locating._OF_BASES = factor * usual
        answers = []
        for name, right, found in sets:
            weights = weights_of_covariates(found)
            first, second = sorted(weights, key=lambda covariate: -weights[covariate])[:2]
            answers.append((first in right, weights[first], second in right, weights[second]))
            if factor == 1.0:
                print(f"{name:32}{', '.join(right):30}{first} {weights[first]:.2f}, {second} {weights[second]:.2f}")
        rates = 100 * np.mean(np.array(answers, dtype=float), axis=0)
        print(
            f"delta {factor * usual:.2f}, {len(sets)} sets: likeliest right {rates[0]:.0f} %, said {rates[1]:.0f} %; "
            f"second right {rates[2]:.0f} %, said {rates[3]:.0f} %"
        )


if __name__ == "__main__":
    main()
