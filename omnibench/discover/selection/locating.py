"""Locating: generic bases and fine structure together, over which the residuals depend on something."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omnibench.discover.fitting.extend import Extended
from omnibench.discover.regressors.fine_structure import fine_structure
from omnibench.discover.regressors.significance import Significance, together
from omnibench.discover.selection.model_selection import Selection
from omnibench.discover.selection.screening import Screening, significance_left


def located(
    selection: Selection,
    screening: Screening,
    baseline: Extended,
    extended: Extended,
    rng: np.random.Generator,
) -> Selection:
    """The selection with all that the residuals depend on, before any effect and after those of an extended model.

    baseline: the plain matrix under the noise of the extended model.
    """
    where = together(selection.where, fine_structure(baseline.fit, rng))
    return replace(selection, where=where, left=all_left(extended, screening, rng) if extended.groups else where)


def all_left(extended: Extended, screening: Screening, rng: np.random.Generator) -> Significance:
    """Significance of generic bases and of fine structure beyond all that an extended model holds."""
    bases = significance_left(extended, screening, rng)
    return together(bases, fine_structure(extended.fit, rng))
