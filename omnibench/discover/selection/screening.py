"""Screening: all that could explain what the plain matrix leaves, as whitened columns against its residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.discover.fitting.extend import Extended
from omnibench.discover.fitting.model_fit import Fit, paths_of
from omnibench.discover.held_out.cross_validation import folds_of_repetitions, is_confirmed, kinds_of_runs
from omnibench.discover.regressors.column_group import Group
from omnibench.discover.regressors.column_store import ColumnStore
from omnibench.discover.regressors.significance import Significance, significance_of
from omnibench.discover.selection.candidate_groups import Groups, make_groups
from omnibench.discover.selection.encoder_quantisation import EncoderQuantisation
from omnibench.fit.trajectory_fit import Given, Whitened, given
from omnibench.robot.kinematics import Array

# s: shorter wheel samples are merged up to this duration, as covariates vary more slowly. tests/studies/constants.py
# varies it by 0.5 and 2: on a small set with heading drift no verdict and no name changes.
_COARSE = 0.03


@dataclass(frozen=True, eq=False)
class Screening:
    """Columns of all candidates against the residuals of the plain matrix.

    folds (Z,): by which runs are held out. quantisation: the encoders', None where it does not matter. kinds: number of
    kinds of motion that the runs drive, None where these do not matter.
    """

    groups: Groups
    data: Whitened
    folds: NDArray[np.intp]
    quantisation: EncoderQuantisation | None = None
    kinds: int | None = None

    def beyond_matrix(self) -> Given:
        """Schur complement of all columns once the matrix is fitted."""
        return given(self.data, self.groups.matrix.index)

    def index_with(self, chosen: Sequence[Group]) -> list[int]:
        """The column numbers of the matrix, then those of the chosen groups."""
        return [*self.groups.matrix.index, *(index for group in chosen for index in group.index)]

    def confirms(self, others: Sequence[Group], group: Group) -> bool:
        """True if held-out runs gain significantly by a group beyond the matrix and others."""
        return is_confirmed(self.data, self.index_with(others), group.index, self.folds)

    def quantisation_chi_square(self, group: Group, beyond: Sequence[Group] = ()) -> float:
        """The chi-square difference that encoder quantisation could make for a group, beyond the matrix and others."""
        if self.quantisation is None:
            return 0.0
        return self.quantisation.chi_square(group.index, self.index_with(beyond))


def screen_plain(plain: Fit, without: Sequence[str]) -> Screening:
    """Screen the residuals of the plain matrix. without: names of effects that are not to be tried."""
    return _screened(plain, plain.nuisance_free_residuals, _groups_at(plain, without))


def screen_extended(extended: Extended, without: Sequence[str]) -> Screening:
    """Screen with the noise, nuisances and poses of an extended model, its effects put back into the residuals."""
    return _screened(extended.fit, extended.residuals_without_effects, _groups_at(extended.fit, without))


def screen_again(extended: Extended, earlier: Screening) -> Screening:
    """Screen as ``screen_extended``, with the columns of an earlier screening."""
    return _screened(extended.fit, extended.residuals_without_effects, earlier.groups)


def significance_left(extended: Extended, screening: Screening, rng: np.random.Generator) -> Significance:
    """Significance of the generic bases beyond all that an extended model holds, smooth terms among it."""
    fit, groups = extended.fit, screening.groups
    data = _whitened(fit, groups, fit.nuisance_free_residuals, extended.columns)
    width = extended.columns[0].shape[2]
    first = groups.bases[0].index[0] if groups.bases else 0
    bases = [replace(group, index=tuple(width + column - first for column in group.index)) for group in groups.bases]
    found = significance_of(data, range(width), bases, rng)
    return replace(found, groups=groups.bases)


def _groups_at(fit: Fit, without: Sequence[str]) -> Groups:
    return make_groups(paths_of(fit, _COARSE), fit.runs, without)


def _screened(fit: Fit, residuals: Sequence[Array], groups: Groups) -> Screening:
    data = _whitened(fit, groups, residuals)
    kinds = len(set(kinds_of_runs(fit).tolist()))
    return Screening(groups, data, folds_of_repetitions(fit.runs), EncoderQuantisation(fit, data), kinds)


def _whitened(fit: Fit, groups: Groups, residuals: Sequence[Array], fitted: Sequence[Array] | None = None) -> Whitened:
    """The groups' columns and residuals (K, 3), whitened, some runs at a time.

    fitted (K, 3, n): of a model; then its columns and those of the generic bases alone.
    """
    left, columns, scores, information = list[Array](), ColumnStore(), list[Array](), np.zeros(())
    first = groups.bases[0].index[0] if groups.bases else None
    for runs, steps in groups.columns.blocks():
        if fitted is not None:
            of_model = [np.diff(of_run, axis=0, prepend=0.0) for of_run in fitted[runs]]
            of_bases = [of_run[..., first:] for of_run in steps]
            steps = [np.concatenate(both, axis=2) for both in zip(of_model, of_bases, strict=True)]
        white = fit.whitened_steps(steps, residuals, runs)
        left += white.residuals
        scores.append(white.scores)
        information = information + white.information
        columns.append(np.concatenate(white.columns), [len(of_run) for of_run in white.columns])
    return Whitened(left, columns, information, np.concatenate(scores))
