"""Forms of a hidden effect: the catalogue's (matched), two others as nature may have it (blind, third), and its size.

A form turns the steps of a grid, values and a source of chance into a correction. The chance holds what the catalogue
has no parameter for: saturation, second harmonics, jitter. It is drawn anew, and alike, at every call.
Values are named as parameters of the catalogue are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from omnibench.robot.kinematics import Array

from .experiment import ROBOT
from .motion import Correction, Grid

Values = Mapping[str, float]
Make = Callable[[Grid, Values, np.random.Generator], Correction]
WHEELS = ROBOT.wheel_names


@dataclass(frozen=True)
class Form:
    """An effect's three forms. plausible: the largest value of each parameter, in SI units. one_sided: never negative.

    shapes: parameters that are chosen and not scaled, with their choices. designs: where it can be told from others.
    """

    matched: Make
    blind: Make
    third: Make
    plausible: Mapping[str, float]
    designs: tuple[str, ...] = ("rich", "flower")
    one_sided: bool = False
    shapes: Mapping[str, tuple[float, ...]] | None = None

    def direction(self, rng: np.random.Generator) -> dict[str, float]:
        """Values of the largest plausible size, in a random direction; shapes chosen at random."""
        draws = rng.standard_normal(len(self.plausible))
        draws /= np.abs(draws).max()
        if self.one_sided:
            draws = np.abs(draws)
        values = {name: float(draw * size) for (name, size), draw in zip(self.plausible.items(), draws, strict=True)}
        return values | {name: float(rng.choice(choices)) for name, choices in (self.shapes or {}).items()}

    def scaled(self, values: Values, factor: float) -> dict[str, float]:
        """The values times the factor; shapes as they are."""
        return {name: value * factor if name in self.plausible else value for name, value in values.items()}


def of_wheels(values: Values, prefix: str) -> Array:
    """Values (N,) of the parameters ``<prefix>_<wheel>``."""
    return np.array([values[f"{prefix}_{wheel}"] for wheel in WHEELS])


def wheelwise(prefix: str, size: float) -> dict[str, float]:
    """The plausible size of the parameters ``<prefix>_<wheel>``."""
    return {f"{prefix}_{wheel}": size for wheel in WHEELS}
