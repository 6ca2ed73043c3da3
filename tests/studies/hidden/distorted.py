"""Forms that are distorted further: a blind form times a factor over time, speed or turning, other for each wheel.

By the author of the catalogue's families, to measure what right names leave beside these; the exam has none of them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .form import Make, Values
from .motion import Correction, Grid


def distorted(make: Make) -> Make:
    """The correction of a form with a size that varies by more than half over the runs."""

    def further(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
        turning = grid.twist[:, 2]
        constant = rng.uniform(1, 3)  # s
        course = (
            np.exp(-grid.elapsed / constant),
            grid.speed / 0.3,
            np.abs(turning) / 0.5,
            (np.sign(turning) + 1) / 2,
        )[rng.integers(4)]
        factor = (1 + rng.choice([-0.7, 1.2]) * np.clip(course, 0, 1.5))[:, None]
        of_wheels = rng.uniform(0.6, 1.4, grid.rates.shape[1])
        correction = make(grid, values, rng)
        return replace(
            correction,
            wheel=None if correction.wheel is None else correction.wheel * factor * of_wheels,
            body=None if correction.body is None else correction.body * factor,
            world=None if correction.world is None else correction.world * factor,
        )

    return further
