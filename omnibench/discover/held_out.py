"""How well plain and extended model predict runs that they were not fitted to, and what repetitions allow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.discover.extend import Extended
from omnibench.discover.result import Gap, HeldOut
from omnibench.discover.whitened import Whitened
from omnibench.fit.noise import Whitener
from omnibench.fit.repetitions import differences_between_repetitions, grouped
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

_FOLDS = 5


def folds_of(runs: Sequence[Trajectory]) -> NDArray[np.intp]:
    """A fold (Z,) of each run: repetitions of a command go to different ones."""
    folds = np.zeros(len(runs), dtype=np.intp)
    for number, members in enumerate(grouped([(run.session, run.command) for run in runs])):
        for rank, index in enumerate(members):
            folds[index] = (rank + (number if len(members) < _FOLDS else 0)) % _FOLDS
    return folds


@dataclass(frozen=True, eq=False)
class Prediction:
    """Values (Z, n) of the fitted numbers that each run is predicted with: those of all other folds."""

    values: Array


def predictions(data: Whitened, index: Sequence[int], folds: NDArray[np.intp]) -> Prediction:
    """Fit columns ``index`` to all folds but one, for each fold."""
    index = list(index)
    found = np.zeros((len(folds), len(index)))
    own = [columns[:, index] for columns in data.columns]
    for fold in np.unique(folds):
        train = [columns for columns, each in zip(own, folds, strict=True) if each != fold]
        stacked = np.concatenate(train) if train else np.zeros((0, len(index)))
        target = [each for each, other in zip(data.residuals, folds, strict=True) if other != fold]
        found[folds == fold] = _solved(stacked, target)
    return Prediction(found)


def _solved(columns: Array, residuals: Sequence[Array]) -> Array:
    if not len(columns):
        return np.zeros(columns.shape[1])
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    information = (columns / size).T @ (columns / size)
    score = (columns / size).T @ np.concatenate(list(residuals))
    answer: Array = np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ score / size
    return answer


def held_out_residuals(extended: Extended, folds: NDArray[np.intp]) -> list[Array]:
    """What a model leaves of each run (K, 3), to first order, when all folds but the run's are fitted."""
    values = predictions(extended.data, range(extended.data.information.shape[0]), folds).values
    return [
        own - columns @ value
        for own, columns, value in zip(extended.fit.residuals, extended.columns, values, strict=True)
    ]


def gains_on_held_out(data: Whitened, before: Sequence[int], after: Sequence[int], folds: NDArray[np.intp]) -> Array:
    """By how much further columns lower each run's chi2 (Z,) when its fold is predicted from the others."""
    return _chi2(data, before, folds) - _chi2(data, after, folds)


def _chi2(data: Whitened, index: Sequence[int], folds: NDArray[np.intp]) -> Array:
    values = predictions(data, index, folds).values
    return np.array(
        [
            float(np.square(own - columns[:, list(index)] @ each).sum())
            for own, columns, each in zip(data.residuals, data.columns, values, strict=True)
        ]
    )


def compare_residuals(
    kind: str, runs: Sequence[Trajectory], before: Sequence[Array], after: Sequence[Array], noise: Noise
) -> HeldOut:
    """Gaps of residuals (K, 3) before and after, in Eq. (6) of the final poses and in whitened chi2."""
    floor = differences_between_repetitions(runs, after)
    eq6 = [np.array([float(np.linalg.norm(own[-1])) for own in each]) for each in (before, after)]
    allowed = np.array([float(np.linalg.norm(each.values[-1])) for each in floor.each])
    whiteners = [Whitener(noise, run.pose_times[1:]) for run in runs]
    chi2 = [
        np.array([float(np.square(white(own)).mean()) for white, own in zip(whiteners, each, strict=True)])
        for each in (before, after)
    ]
    unavoidable = np.array([float(np.square(Whitener(noise, each.stamps)(each.values)).mean()) for each in floor.each])
    position = tuple(float(np.mean([np.hypot(*own[-1, :2]) for own in each])) for each in (before, after))
    heading = tuple(float(np.mean([abs(own[-1, 2]) for own in each])) for each in (before, after))
    return HeldOut(
        data="session" if kind == "session" else "repetitions",
        runs=len(runs),
        eq6=_gap("eq6", eq6[0], eq6[1], allowed),
        chi2=_gap("chi2", chi2[0], chi2[1], unavoidable),
        position_m=(position[0], position[1]),
        heading_rad=(heading[0], heading[1]),
    )


def _gap(metric: str, before: Array, after: Array, floor: Array) -> Gap:
    error = float(np.sqrt(before.var() / len(before) + floor.var() / len(floor)))
    gap = float(before.mean() - floor.mean())
    closed = float(before.mean() - after.mean()) / gap if gap > 2 * error else None
    return Gap(
        "eq6" if metric == "eq6" else "chi2", float(before.mean()), float(after.mean()), float(floor.mean()), closed,
        error,
    )  # fmt: skip
