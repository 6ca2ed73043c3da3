"""Share of the third forms' signatures that the catalogue's forms cannot make.

    python tests/studies/form_shares.py [--draws 8] [--form third] [NAME ...]

Each draw is of another recording plan, another matrix, other values and other shape constants, and as strong as the
exam's strong sets. The share is chi2 left after the best values of the catalogue's form over the whole chi2, both
whitened and beyond the matrix. No discovery is run.
"""

from __future__ import annotations

import argparse
import math
import zlib

import numpy as np
from hidden.disturbances import PLAIN, scaled
from hidden.experiment import DESIGNS, plan, true_matrix
from hidden.form import Form, Make
from hidden.forms import FORMS
from hidden.sets import LEVELS
from hidden.signature import Sight, projected


def main() -> None:
    """Print one line for every effect and design."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="effects; all if none is named")
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--form", choices=["third", "blind"], default="third")
    arguments = parser.parse_args()
    print(f"{'effect':32}{'design':10}{'median':>8}{'least':>8}{'most':>8}{'size':>7}")
    for name in arguments.names or FORMS:
        form = FORMS[name]
        make = form.third if arguments.form == "third" else form.blind
        for design in form.designs:
            found = np.array([_share(name, form, make, design, draw) for draw in range(arguments.draws)])
            shares, sizes = found.T
            told = "".join(f"{share:8.1%}" for share in (np.median(shares), shares.min(), shares.max()))
            print(f"{name:32}{design:10}{told}{np.median(sizes):7.2f}", flush=True)


def _share(name: str, form: Form, make: Make, design: str, draw: int) -> tuple[float, float]:
    """The share, and the size of the effect in plausible ranges."""
    seed = [zlib.crc32(f"shares {name} {design}".encode()), draw]
    rng = np.random.default_rng(seed)
    training = [run for run in plan(DESIGNS[design], rng) if run.split == "train"]
    matrix = true_matrix(rng)
    sight = Sight(training, matrix, scaled(PLAIN, DESIGNS[design].noise).known(matrix))
    direction, size = form.direction(rng), 0.1
    for _ in range(4):
        values = form.scaled(direction, size)
        signature = sight.of(make(sight.grid, values, np.random.default_rng(seed)))
        whole = float(signature @ signature)
        size *= math.sqrt(LEVELS["strong"] / whole)
    shapes = form.shapes or {}
    choices = [{key: choice} for key, each in shapes.items() for choice in each] if len(shapes) == 1 else [{}]
    if name == "roller_ripple":  # another number of rollers is no nearer
        choices = [{"rollers": values["rollers"]}]
    return min(projected(sight, form, choice, signature)[1] for choice in choices) / whole, size


if __name__ == "__main__":
    main()
