"""Waves of the wheels' angles, any number of times a turn: gears and belts turn otherwise than the wheels they drive.

With phi the angle of a wheel and g_z the pull of a change of its rate in proportion to the rate (local_scores.py), the
scores of run z for n waves a turn are

    s_z(n) = sum over samples of g_z exp(i n phi) = exp(i n phi_0) sum over bins b of G_zb exp(i n b w),            (1)

with phi_0 the angle at the start of the run and G_zb the sum of g_z where phi - phi_0 is in bin b of width w. Waves
with different n are told apart if they fall out of step over all angles that the wheel had.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from omnibench.discover.fitting.model_fit import Fit
from omnibench.discover.regressors.column_group import Group
from omnibench.discover.regressors.covariate_bases import Basis
from omnibench.discover.regressors.local_scores import independent_scores, pull_by
from omnibench.discover.regressors.paths import Paths
from omnibench.robot.kinematics import Array

_LOW, _HIGH = 0.1, 6.0  # waves a turn; slower ones look like radii, for faster ones there are whole columns (chosen)
_MOST = 1500  # numbers of waves; over angles that tell more apart, the higher ones are left out (chosen)
_WIDTH = 0.1  # w, rad: the fastest wave moves on by 0.6 rad, by which it shows at 98 % (chosen)
_TOGETHER = 300_000  # scores of runs and numbers of waves that are computed at once (chosen)
_TURNS = 10  # over all runs, from which on waves a turn can be told from a radius (chosen)


def waves_of_wheels(fit: Fit, paths: Paths) -> Iterator[tuple[Group, Array]]:
    """Groups of waves of all wheels, each so many times a turn, and their scores (Z, d)."""
    angles = paths.signals.wheel_angles
    if angles is None:
        return
    span = float(np.ptp(angles, axis=0).max())
    if span < 2 * np.pi * _TURNS:
        return
    numbers = np.arange(_LOW, _HIGH, np.pi / span)[:_MOST]
    rates = paths.signals.rates
    changes = [paths.changes(paths.by_rates(rates * unit)) for unit in np.eye(rates.shape[1])]
    pull, at_once = pull_by(fit, paths, changes), max(1, _TOGETHER // len(paths.logs))
    for first in range(0, len(numbers), at_once):
        some = numbers[first : first + at_once]
        waves = [_scores(paths, angles[:, wheel], pull[:, wheel], some) for wheel in range(rates.shape[1])]
        parts = [part[..., None] for scores in waves for part in (scores.real, scores.imag)]
        independent = independent_scores(np.concatenate(parts, axis=2))
        for number, of_runs in zip(some.tolist(), independent, strict=True):
            if of_runs.shape[1]:
                detail, tries = f"the angle of the wheels, {number:.3g} times a turn", len(numbers)
                basis = Basis("wheel angle", "wheel", detail, None, tries, "smooth_wheel_angle", {"harmonic": number})
                yield Group("covariate", "wheel angle", (), tries=tries, basis=basis), of_runs.astype(np.float32)


def _scores(paths: Paths, angles: Array, pull: Array, numbers: Array) -> Array:
    """Scores (Z, B) of waves of one wheel, B numbers of times a turn, Eq. (1)."""
    firsts = np.searchsorted(paths.owner, np.arange(len(paths.logs)))
    start = angles[firsts]
    bins = np.round((angles - start[paths.owner]) / _WIDTH).astype(np.intp)
    low = bins.min()
    count = int(bins.max() - low) + 1
    cells = np.bincount(paths.owner * count + bins - low, pull, len(firsts) * count).reshape(-1, count)
    waves = np.exp(1j * _WIDTH * (low + np.arange(count))[:, None] * numbers)
    scores: Array = np.exp(1j * start[:, None] * numbers) * (cells @ waves)
    return scores
