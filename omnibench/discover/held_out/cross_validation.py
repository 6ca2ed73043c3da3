"""Cross-validation: runs of a fit predicted from the runs of the other folds.

With I the information X'X and s the scores X'e of whitened columns X against whitened residuals e, summed over all
runs, and I_f, s_f those over the runs of fold f, least squares of all runs but these give the values

    b_f = (I - I_f)^+ (s - s_f),                                                                                    (1)

which leave a run z of the fold the chi-square

    Q_z = |e_z - X_z b_f|^2.                                                                                        (2)

With g_z the fall of Q_z by further columns, over Z runs, these are confirmed if

    mean of g_z > c sd of g_z / sqrt(Z).                                                                            (3)

Sessions of training and validation runs are compared by the discovery's model. Where both sessions are trained on,
tyre_wear is an effect of the catalogue as any other. Where one is held out, the change that explains its deviation is
fitted here, beside the model.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting.extend import Extended
from omnibench.discover.fitting.model_fit import Fit, model_with
from omnibench.discover.held_out.validation_runs import ValidationRuns
from omnibench.fit.evaluate import final_errors
from omnibench.fit.noise import grouped
from omnibench.fit.sessions import SessionComparison, compare_sessions, sessions_of
from omnibench.fit.trajectory_fit import Given, Whitened
from omnibench.robot.corrections import kinds_of_motion
from omnibench.robot.kinematics import Array


def compare_with_validation(extended: Extended, validation: ValidationRuns) -> SessionComparison:
    """Comparison of all sessions by the extended model, as ``evaluate`` compares them."""
    fit = extended.fit
    held_out = validation.under(fit).at_inliers.runs if validation.runs else ()
    return compare_sessions(fit.model, [*fit.at_inliers.runs, *held_out])


def eq6_with_changes(extended: Extended, runs: Sequence[Trajectory], comparison: SessionComparison) -> float | None:
    """Eq. (6) on validation runs, m and rad, with the matrices of sessions that differ changed; None if none does."""
    names = sessions_of([*extended.fit.runs, *runs])[len(extended.fit.runs) :]
    changes = {each.session: np.array(each.matrix) for each in comparison.differences}
    if not changes.keys() & set(names):
        return None
    model, errors = extended.fit.model, list[float]()
    for name in dict.fromkeys(names):
        changed = model_with(model, model.matrix + changes.get(name, 0.0), model.terms)
        of_session = [run for run, other in zip(runs, names, strict=True) if other == name]
        errors += np.linalg.norm(final_errors(changed, of_session), axis=1).tolist()
    return float(np.mean(errors))


_FOLDS = 5  # Hastie, Tibshirani and Friedman, Elements of Statistical Learning, 2009, section 7.10.1: five or ten
# c, Eq. (3), standard errors: a difference that exceeds them where there is none is one of 44, if it is normal.
STANDARD_ERRORS = 2.0


def folds_of_repetitions(runs: Sequence[Trajectory]) -> NDArray[np.intp]:
    """A fold (Z,) for each run: repetitions of a command go to different folds."""
    folds = np.zeros(len(runs), dtype=np.intp)
    for number, members in enumerate(grouped([(run.session, run.command) for run in runs])):
        for rank, index in enumerate(members):
            folds[index] = (rank + (number if len(members) < _FOLDS else 0)) % _FOLDS
    return folds


def random_folds_of_repetitions(runs: Sequence[Trajectory], rng: np.random.Generator) -> NDArray[np.intp]:
    """A fold (Z,) for each run: repetitions of a command go to different folds, at random which to which.

    In their order, all runs from early in a session would be held out together, and a function of the session's time
    would be extrapolated.
    """
    folds = folds_of_repetitions(runs)
    for members in grouped([(run.session, run.command) for run in runs]):
        rows = list(members)
        if len(rows) >= _FOLDS:
            folds[rows] = rng.permutation(folds[rows])
        else:
            folds[rows] = (folds[rows] + rng.integers(_FOLDS)) % _FOLDS
    return folds


def folds_of_commands(runs: Sequence[Trajectory]) -> NDArray[np.intp]:
    """A fold (Z,) for each run: all runs of a command go to the same one."""
    folds = np.zeros(len(runs), dtype=np.intp)
    for number, members in enumerate(grouped([run.command or run.id for run in runs])):
        folds[list(members)] = number % _FOLDS
    return folds


def kinds_of_runs(fit: Fit) -> NDArray[np.intp]:
    """The number (Z,) of the kind of motion of each run of a fit: all runs of a command are of one.

    Commands are of one kind if the means and the spreads of their twists are near to each other.
    """
    twists = [run.signals @ fit.model.matrix.T for run in fit.runs]
    commands = [list(members) for members in grouped([run.command or run.id for run in fit.runs])]
    means, spreads = (
        np.array([np.mean([of(twists[run], axis=0) for run in members], axis=0) for members in commands])
        for of in (np.mean, np.std)
    )
    kinds = np.zeros(len(fit.runs), dtype=np.intp)
    for members, kind in zip(commands, kinds_of_motion(fit.model.robot, means, spreads), strict=True):
        kinds[members] = kind
    return kinds


def folds_of_kinds(fit: Fit) -> NDArray[np.intp]:
    """A fold (Z,) for each run of a fit: all runs of a kind of motion go to the same one."""
    return kinds_of_runs(fit) % _FOLDS


def without_runs(data: Whitened, held_out: NDArray[np.bool_]) -> Given:
    """The columns over all runs but those (Z,) that are held out."""
    columns = np.concatenate([data.columns[run] for run in np.flatnonzero(held_out).tolist()])
    return Given(data.information - columns.T @ columns, data.scores[~held_out], np.diag(data.information))


def values_of_other_folds(data: Whitened, index: Sequence[int], folds: NDArray[np.intp]) -> Array:
    """Values (Z, n) of the columns ``index``: for each run, those fitted to the runs of all folds but its own."""
    index = list(index)
    few = data.only(index)
    values = np.zeros((len(folds), len(index)))
    for fold in np.unique(folds):
        values[folds == fold] = without_runs(few, folds == fold).estimate(range(len(index)))[0]  # Eq. (1)
    return values


def held_out_residuals(extended: Extended, folds: NDArray[np.intp]) -> list[Array]:
    """Residuals (k, 3) of each run's inliers, to first order, by the model fitted to all folds but the run's own.

    Nothing is fitted to the run itself, nor are its nuisances.
    """
    left = left_by(extended, values_of_other_folds(extended.data, range(len(extended.data.information)), folds))
    return [residuals[inliers] for residuals, inliers in zip(left, extended.fit.masks, strict=True)]


def left_by(extended: Extended, values: Array) -> list[Array]:
    """Residuals (K, 3) of each run, to first order, by values (Z, p) of all columns, others for each run."""
    return [
        residuals - columns @ value
        for residuals, columns, value in zip(
            extended.fit.nuisance_free_residuals, extended.columns, values, strict=True
        )
    ]


def held_out_squares(data: Whitened, index: Sequence[int], folds: NDArray[np.intp]) -> Array:
    """Chi-square (Z,) of each run by the columns ``index`` as fitted to all folds but the run's own."""
    return squares_left_by(data, index, values_of_other_folds(data, index, folds))


def squares_left_by(data: Whitened, index: Sequence[int], values: Array) -> Array:
    """Chi-square (Z,) of each run by values (Z, n) of the columns ``index``, others for each run."""
    of_runs = zip(data.residuals, data.columns, values, strict=True)
    left = [residuals - columns[:, list(index)] @ value for residuals, columns, value in of_runs]
    return np.array([float(np.square(of_run).sum()) for of_run in left])  # Eq. (2)


def held_out_chi_square(data: Whitened, before: Sequence[int], after: Sequence[int], folds: NDArray[np.intp]) -> Array:
    """Chi-square difference (Z,) of each run between the columns ``before`` and ``after``, its fold held out."""
    every = sorted({*before, *after})
    few, place = data.only(every), {column: row for row, column in enumerate(every)}
    first, last = (held_out_squares(few, [place[each] for each in index], folds) for index in (before, after))
    return first - last


def is_confirmed(data: Whitened, before: Sequence[int], new: Sequence[int], folds: NDArray[np.intp]) -> bool:
    """True if the columns ``new`` lower the chi-square of held-out runs beyond ``before``, by two standard errors."""
    return is_gain(held_out_chi_square(data, before, [*before, *new], folds))


def is_gain(gains: Array) -> bool:
    """True if the gains (Z,) of runs are more than chance in the mean, Eq. (3)."""
    return float(gains.mean()) > STANDARD_ERRORS * float(gains.std()) / np.sqrt(len(gains))
