"""Local scores: how much better the residuals would be explained by changes of the motion in single samples.

An error of the motion in one sample, a displacement d and a turn e (paths.py, Eq. (1), from the run's start), moves the
pose at every later stamp j by d + i z_j e and by e. Let h_j be the inverse covariance of the residuals times these, by
which half the chi-square falls as the pose at stamp j moves. The motion in a sample before stamp k then lowers it by

    g_d = sum over j >= k of h_j,    g_e = sum over j >= k of h_j(heading) + Re(conj(i z_j) h_j),                  (1)

and the score of a function f of a covariate in a mode m of motion (along the way, across it, turning per way or by the
rate of turn) is the sum of f m g over a run's samples: one product of matrices for all functions, however many.

With s_z the scores of run z for the d columns of a basis, s their sum over Z runs and S = sum of s_z s_z',

    Q = q / (1 - q / Z),    q = s' S^-1 s                                                                          (2)

is the statistic of Hotelling ("The generalization of Student's ratio", Annals of Mathematical Statistics 2, 1931), of d
degrees of freedom where nothing is missing, whatever the noise is taken for. S stays the same where signs are flipped.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.discover.fitting.model_fit import Fit
from omnibench.discover.regressors.paths import Paths
from omnibench.robot.effects.smooth.motion import MODES
from omnibench.robot.kinematics import Array

_ROUNDING = 1e-16  # share of the largest column's square below which a column is what rounding leaves
_RANK = 1e-6  # share of a column's square that must be left beyond the others of its basis


def pull_in_modes(fit: Fit, paths: Paths) -> Array:
    """The pull (F, 4) of changes of each sample's motion in the modes in which smooth effects act."""
    return pull_by(fit, paths, [paths.by_modes[mode] for mode in MODES])


def pull_by(fit: Fit, paths: Paths, changes: Sequence[Array]) -> Array:
    """The pull (F, m): by how much half the chi-square falls with m changes (F, 3) of (z, theta) in each sample."""
    pull = np.zeros((len(paths.owner), len(changes)))
    first = 0
    for log, part, gradient in zip(paths.logs, paths.parts, fit.weighted_residuals, strict=True):
        rows = slice(first, first + len(log.times))
        first = rows.stop
        lever = paths.lever[part]
        swing = lever[:, 0] * gradient[:, 1] - lever[:, 1] * gradient[:, 0] + gradient[:, 2]
        later = np.column_stack([gradient[:, :2], swing])[::-1].cumsum(axis=0)[::-1]
        stamp = np.searchsorted(log.stamps, log.times - paths.signals.durations[rows] / 2)
        moved = np.vstack([later, np.zeros(3)])[stamp]
        for mode, change in enumerate(changes):
            pull[rows, mode] = (change[rows] * moved).sum(axis=1)  # Eq. (1)
    return pull


def independent_scores(scores: Array) -> list[Array]:
    """Scores (Z, B, d) of B bases as independent ones (Z, d) whose sums have unit variance, Eq. (2)."""
    of_bases = np.ascontiguousarray(scores.transpose(1, 0, 2))
    square = of_bases.transpose(0, 2, 1) @ of_bases
    sizes_of = np.diagonal(square, axis1=1, axis2=2)
    there = sizes_of > _ROUNDING * sizes_of.max(initial=0.0)  # a function that is the same everywhere leaves no more
    scale = np.where(there, 1 / np.sqrt(np.maximum(sizes_of, 1e-300)), 0.0)
    sizes, vectors = np.linalg.eigh(square * scale[:, :, None] * scale[:, None, :])
    known = sizes > _RANK
    independent = of_bases @ (scale[:, :, None] * vectors / np.sqrt(np.where(known, sizes, 1.0))[:, None, :])
    return [of_runs[:, rows] for of_runs, rows in zip(independent, known, strict=True)]
