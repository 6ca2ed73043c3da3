"""Errors of plain and extended model on held-out runs, and the gap between them and what repetitions allow.

Let b_z and a_z be the errors of Z runs by the plain and by the extended model, and f_i those that D differences between
repetitions of a command leave to any model, the floor. The gap, its standard error and the share that is closed are

    G = mean b - mean f,    sigma = sqrt(var b / Z + var f / D),    (mean b - mean a) / G.                          (1)

Where G is within two standard errors of nothing, no share is closed. Where a model errs less than the differences
scatter, by chance or because the repetitions were no repetitions, their mean is no floor, and all of a gap is closed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.discover.fitting.extend import Extended
from omnibench.discover.fitting.model_fit import Fit
from omnibench.discover.held_out.cross_validation import (
    STANDARD_ERRORS,
    left_by,
    squares_left_by,
    values_of_other_folds,
)
from omnibench.discover.held_out.validation_runs import ValidationRuns
from omnibench.discover.result import Gap, HeldOut
from omnibench.fit.noise import whiteners
from omnibench.fit.trajectory_fit import differences_without_nuisances, whitened
from omnibench.robot.kinematics import Array


def compare_held_out(
    plain: Extended, extended: Extended, validation: ValidationRuns, folds: NDArray[np.intp]
) -> tuple[HeldOut, ...]:
    """Errors of plain and extended model on held-out repetitions, and on the validation split if it has runs.

    folds (Z,): the fold in which each training run is held out. If all are in one, none is: no other run predicts it.
    """
    floor = floor_of(extended.fit)
    held_out = []
    if len(np.unique(folds)) > 1:
        before, after = (errors_of_repetitions(model, folds) for model in (plain, extended))
        held_out.append(_compared("repetitions", before, after, floor))
    if validation.runs:
        before, after = (errors_on(model.fit, validation) for model in (plain, extended))
        of_session = floor_of(validation.under(extended.fit))
        held_out.append(_compared("session", before, after, of_session or floor))
    return tuple(held_out)


def training_gap(plain: Extended, extended: Extended) -> Gap:
    """The gap in Eq. (6) on the runs of the fit, as fitted to them."""
    before, after = (
        np.array([np.linalg.norm(each[-1]) for each in model.fit.nuisance_free_residuals])
        for model in (plain, extended)
    )
    floor = floor_of(extended.fit)
    return gap_between("eq6", before, after, None if floor is None else floor.eq6)


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of a model on Z runs.

    finals (Z, 3): errors of the final poses, m, m, rad. chi2 (Z,): whitened chi-square per number, over all poses.
    """

    finals: Array
    chi2: Array

    @property
    def eq6(self) -> Array:
        """Norms (Z,) of the final errors."""
        norms: Array = np.linalg.norm(self.finals, axis=1)
        return norms


def errors_of_repetitions(extended: Extended, folds: NDArray[np.intp]) -> Errors:
    """Errors on the runs of the fit, each predicted from the other folds."""
    every = range(len(extended.data.information))
    values = values_of_other_folds(extended.data, every, folds)
    finals = np.array([residuals[-1] for residuals in left_by(extended, values)])
    squares = squares_left_by(extended.data, every, values)
    return Errors(finals, squares / [len(residuals) for residuals in extended.data.residuals])


def errors_on(fit: Fit, validation: ValidationRuns) -> Errors:
    """Errors on the validation split: of all final poses, and the chi-square of the poses that are no outliers."""
    there = validation.under(fit)
    white = there.whitened([np.zeros((*residuals.shape, 0)) for residuals in there.residuals]).residuals
    finals = np.array([residuals[-1] for residuals in there.residuals])
    return Errors(finals, np.array([float(np.square(residuals).mean()) for residuals in white]))


@dataclass(frozen=True, eq=False)
class Floor:
    """Errors that the scatter between repetitions of a command leaves to any model.

    eq6 (D,): norms of D final differences, m and rad. chi2 (D,): their whitened chi-square per number.
    """

    eq6: Array
    chi2: Array


def floor_of(fit: Fit) -> Floor | None:
    """The floor of a fit's runs; None where no command is repeated."""
    known = np.flatnonzero(fit.nuisances.estimated)
    differences = differences_without_nuisances(fit.with_noise_runs.at_inliers, list(known))
    if differences.source != "repetitions":
        return None
    each = differences.each
    white = whitened(
        [difference.values for difference in each],
        [np.zeros((*difference.values.shape, 0)) for difference in each],
        whiteners(fit.noise.noise, [difference.stamps for difference in each]),
        [difference.slopes[..., known] for difference in each],
        fit.nuisances.deviations[known],
    )
    return Floor(
        np.array([float(np.linalg.norm(difference.values[-1])) for difference in each]),
        np.array([float(np.square(values).mean()) for values in white.residuals]),
    )


def _compared(data: Literal["repetitions", "session"], before: Errors, after: Errors, floor: Floor | None) -> HeldOut:
    """The gaps in Eq. (6) of the final poses and in whitened chi-square."""
    position = [float(np.hypot(errors.finals[:, 0], errors.finals[:, 1]).mean()) for errors in (before, after)]
    heading = [float(np.abs(errors.finals[:, 2]).mean()) for errors in (before, after)]
    return HeldOut(
        data=data,
        runs=len(before.finals),
        eq6=gap_between("eq6", before.eq6, after.eq6, None if floor is None else floor.eq6),
        chi2=gap_between("chi2", before.chi2, after.chi2, None if floor is None else floor.chi2),
        position_m=(position[0], position[1]),
        heading_rad=(heading[0], heading[1]),
    )


def gap_between(metric: Literal["eq6", "chi2"], before: Array, after: Array, floor: Array | None) -> Gap:
    """The gap between errors (Z,) and a floor (D,); without a floor no share is closed."""
    first, last = float(before.mean()), float(after.mean())
    if floor is None:
        scatter = float(before.std() / np.sqrt(len(before))) if len(before) > 1 else None
        return Gap(metric, first, last, None, None, scatter)
    error, least = float(np.sqrt(before.var() / len(before) + floor.var() / len(floor))), float(floor.mean())
    gap = first - least
    closed = min((first - last) / gap, 1.0) if gap > STANDARD_ERRORS * error else None  # Eq. (1)
    return Gap(metric, first, last, least if least <= min(first, last) else None, closed, error)
