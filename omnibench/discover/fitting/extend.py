"""The plain matrix, and matrix and effects, fitted in turn with the noise and the nuisances that they leave.

The covariance of matrix elements and parameters is that of every trajectory fit
(fit/least_squares/trajectory_covariance.py).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting.model_fit import (
    Fit,
    at_model,
    at_runs,
    first_fit,
    model_with,
    paths_in_parts,
    with_noise,
)
from omnibench.discover.regressors.column_group import Group
from omnibench.discover.regressors.effect_slopes import slopes_by
from omnibench.discover.regressors.paths import Paths
from omnibench.fit.calibrators.trajectory_ml import FitCovariance
from omnibench.fit.information import EstimatedCovariance
from omnibench.fit.noise import is_near
from omnibench.fit.trajectory_fit import Whitened, given
from omnibench.robot.effects.effect import MotionEffect, ReferenceEffect, Term
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import split_by

# tests/studies/constants.py varies each number by 0.5 and 2: on a small set with heading drift no verdict and no
# name changes.
_ROUNDS = 12  # rounds, at most, that fit model, noise and outliers by turns; recordings here settle in three
_NEAR = 0.02  # share of the largest component of the noise by which two noises may differ, see is_near
_STEPS = 4  # Gauss-Newton steps, at most
_HALVINGS = 10  # tries of a step that leads too far, each half of the one before: at last 1 / 512 of it
_ROUNDING = 1e-6  # share of chi-square by which a step of an ended fit may raise it, as numbers are rounded
_STILL = 0.05  # standard errors: a smaller step, which no interval shows, ends the fit


@dataclass(frozen=True, eq=False)
class Extended:
    """A fit with effects.

    data: whitened columns of the matrix elements, then of the effects' linear parameters. columns (K, 3, p): each run's
    columns, before whitening. values (n,): the effects' linear parameters. covariance (p, p): of matrix elements and
    parameters.
    """

    fit: Fit
    groups: tuple[Group, ...]
    data: Whitened
    columns: tuple[Array, ...]
    values: Array
    covariance: EstimatedCovariance

    @property
    def residuals_without_effects(self) -> list[Array]:
        """Nuisance-free residuals (K, 3) of each run with the effects' share put back, to first order.

        Of effects on steering angles, most of which the matrix can take up, only the rest is put back: to first order
        the whole would lead too far.
        """
        elements = self.fit.model.matrix.size
        put_back = np.concatenate([np.zeros(elements), self.values])
        if _bends(self.groups):
            information = self.data.information[:elements]
            put_back[:elements] = -np.linalg.pinv(information[:, :elements]) @ information[:, elements:] @ self.values
        first = 0 if _bends(self.groups) else elements
        return [
            residuals + columns[..., first:] @ put_back[first:]
            for residuals, columns in zip(self.fit.nuisance_free_residuals, self.columns, strict=True)
        ]

    @property
    def covariance_of_terms(self) -> Array:
        """Covariance (n, n) of the matrix and of all values of the terms; 0 for shapes, which are not fitted."""
        elements = self.fit.model.matrix.size
        fitted = list(range(elements))
        count = elements
        for group in self.groups:
            fitted += range(count, count + len(group.parameters))
            count += len(group.parameters) + len(group.shapes)
        covariance = np.zeros((count, count))
        covariance[np.ix_(fitted, fitted)] = (self.covariance.matrix + self.covariance.matrix.T) / 2
        return covariance


def fit_matrix(
    runs: Sequence[Trajectory],
    robot: Robot,
    sample_period: float,
    start: Array,
    noise_runs: Sequence[Trajectory] = (),
) -> Fit:
    """Fit the plain matrix from a start (3, N), and with it noise, nuisances and outliers.

    noise_runs: repetitions of the runs that the noise alone sees.
    """
    first = replace(first_fit(runs, robot, sample_period, start), noise_runs=tuple(noise_runs))
    return _in_turn(first, ())[0]


def extend(plain: Fit, groups: Sequence[Group]) -> Extended:
    """Fit matrix and effects together, from the plain matrix and effects of 0; noise stays where there are none."""
    fit, values, data, columns = _in_turn(plain, groups) if groups else _descend(plain, (), np.zeros(0))
    return Extended(fit, tuple(groups), data, columns, values, _covariance(fit, data))


def _in_turn(fit: Fit, groups: Sequence[Group]) -> tuple[Fit, Array, Whitened, tuple[Array, ...]]:
    """Matrix and effects fitted, then noise, outliers and these by turns until the outliers and the noise stay.

    Outliers that come back in a circle end it, too.
    """
    fit, values, data, columns = _descend(fit, groups, np.zeros(sum(len(group.parameters) for group in groups)))
    seen: set[bytes] = set()
    for _ in range(_ROUNDS):
        before = fit.noise.noise
        seen.add(np.concatenate(fit.masks).tobytes())
        fit, values, data, columns = _descend(with_noise(fit), groups, values)
        same_noise = is_near(before.model_dump(), fit.noise.noise.model_dump(), _NEAR)
        if same_noise and np.concatenate(fit.masks).tobytes() in seen:
            break
    return fit, values, data, columns


def without_effects(plain: Fit, extended: Extended) -> Extended:
    """The plain matrix fitted to the inliers, noise and nuisances of an extended model, to be compared with it."""
    return extend(at_model(extended.fit, plain.model), ()) if extended.groups else extended


def terms_of(groups: Sequence[Group], values: Array) -> list[Term]:
    """The effects as terms of a model. values: all their linear parameters in turn."""
    terms, first = [], 0
    for group in groups:
        linear = {each.name: float(value) for each, value in zip(group.parameters, values[first:], strict=False)}
        first += len(group.parameters)
        assert group.effect is not None
        terms.append(Term(group.effect, linear | dict(group.shapes)))
    return terms


def columns_of(fit: Fit, groups: Sequence[Group]) -> tuple[Array, ...]:
    """Slopes (K, 3, n) of each run's poses by matrix elements and by the effects' parameters, about a fit."""
    columns = fit.matrix_jacobian()
    if not groups:
        return tuple(columns)
    needs = frozenset().union(*(group.effect.needs for group in groups if group.effect is not None))
    of_groups: list[Array] = []
    for paths in paths_in_parts(fit, needs):
        slopes = np.concatenate(list(_of_groups(paths, groups)), axis=2)
        of_groups += split_by(slopes, [log.stamps for log in paths.logs])
    return tuple(np.concatenate(both, axis=2) for both in zip(columns, of_groups, strict=True))


def columns_at(extended: Extended, runs: Sequence[Trajectory]) -> list[Array]:
    """Slopes (K, 3, n) of other runs' poses by matrix elements and by the effects' parameters."""
    ordered = sorted(range(len(runs)), key=lambda index: str(runs[index].session))
    parts = columns_of(at_runs(extended.fit, [runs[index] for index in ordered]), extended.groups)
    return [part for _, part in sorted(zip(ordered, parts, strict=True), key=lambda pair: pair[0])]


def _of_groups(paths: Paths, groups: Sequence[Group]) -> Iterator[Array]:
    for group in groups:
        assert isinstance(group.effect, MotionEffect | ReferenceEffect)
        base = {each.name: 0.0 for each in group.parameters} | dict(group.shapes)
        yield slopes_by(paths, group.effect, [each.name for each in group.parameters], base)


def _descend(fit: Fit, groups: Sequence[Group], values: Array) -> tuple[Fit, Array, Whitened, tuple[Array, ...]]:
    columns = columns_of(fit, groups)
    elements = fit.model.matrix.size
    data = fit.whitened(columns)
    for _ in range(_STEPS):
        step, covariance = given(data, []).estimate(range(elements + len(values)))
        before, least = (fit, values, data), _chi_square(data) * (1 + _ROUNDING)
        for share in 0.5 ** np.arange(_HALVINGS):
            values = before[1] + share * step[elements:]
            matrix = before[0].model.matrix + (share * step[:elements]).reshape(fit.model.matrix.shape)
            fit = at_model(before[0], model_with(before[0].model, matrix, terms_of(groups, values)))
            data = fit.whitened(columns)
            if _chi_square(data) <= least:
                break
        else:
            fit, values, data = before
            break
        deviations = np.maximum(np.sqrt(np.diag(covariance)), 1e-300)
        if float((np.abs(step) / deviations).max()) < _STILL:
            break
    return fit, values, data, columns


def _bends(groups: Sequence[Group]) -> bool:
    """True if a motion is not linear in an effect beyond small sizes: steering angles act by their tangents."""
    return any(group.effect is not None and group.effect.stage == "steering" for group in groups)


def _chi_square(data: Whitened) -> float:
    return sum(float(np.square(of_run).sum()) for of_run in data.residuals)


def _covariance(fit: Fit, data: Whitened) -> EstimatedCovariance:
    """Covariance (p, p) of the fitted numbers: by the noise model, or by the runs where they scatter more."""
    unit = given(data, []).scale(range(len(data.information)))
    covariance = FitCovariance(data, fit.runs, fit.noise, unit)
    return covariance.chosen(covariance.scatter_stands)[0]
