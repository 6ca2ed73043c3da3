"""How well plain and extended model predict runs that they were not fitted to, and what repetitions allow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting.extend import Extended
from omnibench.discover.fitting.model_fit import Fit, at_runs
from omnibench.discover.fitting.usable_runs import in_start_frames
from omnibench.discover.regressors.whitened import Whitened, whitened
from omnibench.discover.result import Gap, HeldOut
from omnibench.fit.least_squares.repetitions import differences_between_repetitions, grouped
from omnibench.robot.kinematics import Array

_FOLDS = 5
HELD_OUT = 2.0  # standard errors by which runs that are held out must gain


def folds_of(runs: Sequence[Trajectory]) -> NDArray[np.intp]:
    """A fold (Z,) of each run: repetitions of a command go to different ones."""
    folds = np.zeros(len(runs), dtype=np.intp)
    for number, members in enumerate(grouped([(run.session, run.command) for run in runs])):
        for rank, index in enumerate(members):
            folds[index] = (rank + (number if len(members) < _FOLDS else 0)) % _FOLDS
    return folds


def folds_by_lot(runs: Sequence[Trajectory]) -> NDArray[np.intp]:
    """The same, but by lot which repetition goes where: in their order, all that came early in a session would be held
    out together, and a function of its time be extrapolated."""
    folds, rng = folds_of(runs), np.random.default_rng(0)
    for members in grouped([(run.session, run.command) for run in runs]):
        own = list(members)
        folds[own] = rng.permutation(folds[own]) if len(own) >= _FOLDS else (folds[own] + rng.integers(_FOLDS)) % _FOLDS
    return folds


def predictions(data: Whitened, index: Sequence[int], folds: NDArray[np.intp]) -> Array:
    """Values (Z, n) of columns ``index`` that each run is predicted with: fitted to all folds but its own."""
    index = list(index)
    found = np.zeros((len(folds), len(index)))
    own = [columns[:, index] for columns in data.columns]
    for fold in np.unique(folds):
        train = [columns for columns, each in zip(own, folds, strict=True) if each != fold]
        stacked = np.concatenate(train) if train else np.zeros((0, len(index)))
        target = [each for each, other in zip(data.residuals, folds, strict=True) if other != fold]
        found[folds == fold] = _solved(stacked, target)
    return found


def _solved(columns: Array, residuals: Sequence[Array]) -> Array:
    if not len(columns):
        return np.zeros(columns.shape[1])
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    information = (columns / size).T @ (columns / size)
    score = (columns / size).T @ np.concatenate(list(residuals))
    answer: Array = np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ score / size
    return answer


def held_out_residuals(extended: Extended, folds: NDArray[np.intp]) -> list[Array]:
    """What a model leaves of each run (K, 3), to first order, when all folds but the run's are fitted.

    Nothing is fitted to the run itself: its nuisances are put back.
    """
    values = _values_of_others(extended, folds)
    return [
        own - columns @ value
        for own, columns, value in zip(extended.fit.nuisance_free_residuals, extended.columns, values, strict=True)
    ]


def _values_of_others(extended: Extended, folds: NDArray[np.intp]) -> Array:
    return predictions(extended.data, range(extended.data.information.shape[0]), folds)


def gains_on_held_out(data: Whitened, before: Sequence[int], after: Sequence[int], folds: NDArray[np.intp]) -> Array:
    """By how much further columns lower each run's chi2 (Z,) when its fold is predicted from the others."""
    return _chi2(data, before, folds) - _chi2(data, after, folds)


def confirmation(data: Whitened, folds: NDArray[np.intp]) -> Callable[[Sequence[int], Sequence[int]], bool]:
    """Whether runs that are held out gain by columns (second) beyond others (first), by two standard errors."""

    def confirmed(before: Sequence[int], new: Sequence[int]) -> bool:
        gains = gains_on_held_out(data, before, [*before, *new], folds)
        return float(gains.mean()) > HELD_OUT * float(gains.std()) / np.sqrt(len(gains))

    return confirmed


def _chi2(data: Whitened, index: Sequence[int], folds: NDArray[np.intp]) -> Array:
    values = predictions(data, index, folds)
    return np.array(
        [
            float(np.square(own - columns[:, list(index)] @ each).sum())
            for own, columns, each in zip(data.residuals, data.columns, values, strict=True)
        ]
    )


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of a model on some runs: of their final poses (Z, 3), m, m, rad, and whitened chi2 (Z,) per number."""

    finals: Array
    chi2: Array


def errors_of_repetitions(extended: Extended) -> Errors:
    """Of the runs of a fit, each predicted from the others."""
    folds = folds_by_lot(extended.fit.runs)
    finals = np.array([own[-1] for own in held_out_residuals(extended, folds)])
    values = _values_of_others(extended, folds)
    left = [
        own - columns @ value
        for own, columns, value in zip(extended.data.residuals, extended.data.columns, values, strict=True)
    ]
    return Errors(finals, np.array([float(np.square(own).mean()) for own in left]))


def errors_on(extended: Extended, runs: Sequence[Trajectory], without_jumps: Sequence[Trajectory]) -> Errors:
    """Of other runs; their poses that jump count in the final errors alone."""
    finals = np.array([own[-1] for own in at_runs(extended.fit, runs).residuals])
    kept = at_runs(extended.fit, without_jumps)
    white = kept.whitened([np.zeros((*own.shape, 0)) for own in kept.residuals]).residuals
    return Errors(finals, np.array([float(np.square(own).mean()) for own in white]))


@dataclass(frozen=True, eq=False)
class Floor:
    """What repetitions of a command allow: norms of final differences (D,) and whitened chi2 (D,) per number."""

    eq6: Array
    chi2: Array


def floor_of(fit: Fit) -> Floor | None:
    """The floor of a fit's runs; None where no command is repeated."""
    residuals, slopes = (in_start_frames(fit.runs, each) for each in (fit.nuisance_free_residuals, fit.slopes))
    found = differences_between_repetitions(fit.runs, residuals)
    if found.source != "repetitions":
        return None
    kinds = [
        differences_between_repetitions(fit.runs, residuals, [each[..., kind] for each in slopes]).each
        for kind in range(3)
    ]
    white = whitened(
        [each.values for each in found.each],
        [np.zeros((*each.values.shape, 0)) for each in found.each],
        [each.stamps for each in found.each],
        fit.noise.noise,
        [np.stack([each.companion for each in same], axis=-1) for same in zip(*kinds, strict=True)],
        fit.nuisances.deviations,
    )
    return Floor(
        np.array([float(np.linalg.norm(each.values[-1])) for each in found.each]),
        np.array([float(np.square(own).mean()) for own in white.residuals]),
    )


def compared(data: Literal["repetitions", "session"], before: Errors, after: Errors, floor: Floor | None) -> HeldOut:
    """The gaps in Eq. (6) of the final poses and in whitened chi2; without a floor none is said to be closed."""
    norms = [np.linalg.norm(each.finals, axis=1) for each in (before, after)]
    position = [float(np.hypot(each.finals[:, 0], each.finals[:, 1]).mean()) for each in (before, after)]
    heading = [float(np.abs(each.finals[:, 2]).mean()) for each in (before, after)]
    return HeldOut(
        data=data,
        runs=len(before.finals),
        eq6=_gap("eq6", norms[0], norms[1], None if floor is None else floor.eq6),
        chi2=_gap("chi2", before.chi2, after.chi2, None if floor is None else floor.chi2),
        position_m=(position[0], position[1]),
        heading_rad=(heading[0], heading[1]),
    )


def _gap(metric: Literal["eq6", "chi2"], before: Array, after: Array, floor: Array | None) -> Gap:
    first, last = float(before.mean()), float(after.mean())
    if floor is None:
        return Gap(metric, first, last, min(first, last), None, float(before.std() / np.sqrt(len(before))))
    error = float(np.sqrt(before.var() / len(before) + floor.var() / len(floor)))
    gap = first - float(floor.mean())
    return Gap(metric, first, last, float(floor.mean()), (first - last) / gap if gap > 2 * error else None, error)
