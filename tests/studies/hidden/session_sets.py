"""Data sets of sessions whose wheels differ, or do not."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from omnibench.data.dataset import Dataset, make_dataset

from .disturbances import DISTURBANCES
from .experiment import DESIGNS, ROBOT, SAMPLE, plan, true_matrix
from .forms import FORMS
from .motion import Correction, Grid
from .sets import recorded


def session_set(
    design: str,
    seed: int,
    *,
    change: float = 0.0,
    wheels: Sequence[str] = ROBOT.wheel_names,
    effect: str = "",
    noise: str = "plain",
    repetitions: int = 5,
    validation: str = "",
) -> Dataset:
    """A training session, or several, and one to validate, in which the radii of some wheels are larger by a share.

    design, validation: of DESIGNS; the second is the first if it is empty, and then both drive the same commands.
    effect: one of FORMS in its catalogue's form and largest plausible size, alike in all sessions. noise: one of
    DISTURBANCES.
    """
    rng = np.random.default_rng([zlib.crc32(f"sessions {design} {validation} {effect}".encode()), seed])
    matrix = true_matrix(rng)
    runs = tuple(
        run
        for split, name in (("train", design), ("validation", validation or design))
        for run in plan(DESIGNS[name], rng)
        if run.split == split and run.repetition <= repetitions
    )
    grid = Grid(runs, matrix)
    later = grid.of_run([run.split == "validation" for run in runs])
    larger = change * np.isin(ROBOT.wheel_names, list(wheels))
    correction = Correction(wheel=grid.rates * np.outer(later, larger))
    if effect:
        correction += FORMS[effect].matched(grid, FORMS[effect].direction(rng), rng)
    return make_dataset(
        "recording", ROBOT, SAMPLE, recorded(grid, correction, DISTURBANCES[noise], rng), simulated=True
    )
