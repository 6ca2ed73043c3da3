"""One look at what a model leaves: everything that could explain it, what does, and what that leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.discover.fitting.extend import Extended
from omnibench.discover.fitting.model_fit import Fit, paths_of, split_runs
from omnibench.discover.held_out.gaps import confirmation, folds_of
from omnibench.discover.selection.encoder_quantisation import Rounding
from omnibench.discover.regressors.significance import Gains, gains_of
from omnibench.discover.regressors.whitened import Whitened, given
from omnibench.discover.selection.candidate_groups import Groups, make_groups
from omnibench.discover.selection.model_selection import Named, name_effects
from omnibench.robot.kinematics import Array

_COARSE = 0.03  # s; what is looked for varies more slowly, and the fit itself takes every sample


@dataclass(frozen=True, eq=False)
class Look:
    """What was looked at and found. data: all columns against what the plain matrix leaves; places: before any effect.

    columns (K, 3, p): of every run, not whitened. folds (Z,): by which runs are held out. rounding: what the encoders'
    ticks may have to do with it.
    """

    groups: Groups
    columns: tuple[Array, ...]
    data: Whitened
    folds: NDArray[np.intp]
    named: Named
    places: Gains
    rounding: Rounding


def look_at(
    fit: Fit, extended: Extended | None, groups: Groups | None, without: Sequence[str], rng: np.random.Generator
) -> Look:
    """Look at what the plain matrix leaves, with the noise, nuisances and poses of a fit.

    extended: the fit with effects, whose noise is better known; their share is put back into the residuals. groups:
    of an earlier look at the same poses.
    """
    if groups is None or len(groups.columns) != sum(len(own) for own in fit.residuals):
        groups = make_groups(paths_of(fit, _COARSE), fit.runs, without)
    residuals = fit.nuisance_free_residuals
    if extended is not None:
        elements = fit.model.matrix.size
        residuals = [
            own + columns[..., elements:] @ extended.values
            for own, columns in zip(residuals, extended.columns, strict=True)
        ]
    columns = tuple(split_runs(groups.columns, fit.runs))
    data, folds = fit.whitened(columns, residuals), folds_of(fit.runs)
    rounding = Rounding(fit, columns)
    named = name_effects(data, groups, confirmation(data, folds), rng)
    if doubtful := _within_ticks(data, groups, named, rounding):
        others = tuple(group for group in groups.effects if group.name not in doubtful)
        named = name_effects(data, replace(groups, effects=others), confirmation(data, folds), rng)
    places = gains_of(data, groups.matrix.index, groups.places, rng)
    return Look(groups, columns, data, folds, named, places, rounding)


def _within_ticks(data: Whitened, groups: Groups, named: Named, rounding: Rounding) -> set[str]:
    """Names that explain no more than rounding to encoder ticks can make."""
    beyond = groups.matrix.index
    start = given(data, beyond)
    chosen = (*named.chosen, *named.tentative)
    return {group.name for group in chosen if start.gain(group.index) <= rounding.gain(group.index, beyond)}
