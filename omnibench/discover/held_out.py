"""Held-out runs: cross-validation of a fit, errors of the validation split, the gap of a model, and extrapolation.

Cross-validation predicts runs of a fit from the runs of the other folds. With I the information X'X and s the scores
X'e of whitened columns X against whitened residuals e, summed over all runs, and I_f, s_f those over the runs of fold
f, least squares of all runs but these give the values

    b_f = (I - I_f)^+ (s - s_f),                                                                                    (1)

which leave a run z of the fold the chi-square

    Q_z = |e_z - X_z b_f|^2.                                                                                        (2)

With g_z the fall of Q_z by further columns, over Z runs, these are confirmed if

    mean of g_z > c sd of g_z / sqrt(Z).                                                                            (3)

Sessions of training and validation runs are compared by the discovery's model. Where both sessions are trained on,
tyre_wear is an effect of the catalogue as any other. Where one is held out, the change that explains its deviation is
fitted here, beside the model.

The gap is what a model errs beyond what repetitions allow. Let b_z and a_z be the errors of Z runs by the plain and by
the extended model, and f_i those that D differences between repetitions of a command leave to any model, the floor. The
gap, its standard error and the share that is closed are

    G = mean b - mean f,    sigma = sqrt(var b / Z + var f / D),    (mean b - mean a) / G.                          (4)

Where G is within two standard errors of nothing, no share is closed. Where a model errs less than the differences
scatter, by chance or because the repetitions were no repetitions, their mean is no floor, and all of a gap is closed.

Extrapolation: held-out runs drive motions outside the training domain. The models c that the data cannot tell apart
have weights w_c, which add up to 1, and predict that a run ends at e_c; the model in use, which is their average and
fades outside the training domain, predicts e. With S_c the mean square error of the final positions of commands that
were held out of the fit of c, and J_c, C_c the derivatives of e_c by the numbers of c and their covariance, the mean
square error of the prediction is

    V = sum of w_c |e_c - e|^2 + sum of w_c (S_c + tr(J_c C_c J_c')).                                               (5)

The circle that holds 95 % of normal errors of variance V / 2 in each coordinate has the radius

    sqrt(-2 ln 0.05) sqrt(V / 2).                                                                                   (6)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.discover.fit import (
    Extended,
    Fit,
    at_runs,
    columns_at,
    inliers_of,
    model_with,
    most_probable,
    values_of_other_folds,
)
from omnibench.discover.result import Extrapolation, Gap, HeldOut, Step
from omnibench.discover.significance import Group
from omnibench.errors import DataError
from omnibench.fit.evaluate import final_errors
from omnibench.fit.noise import grouped, repeating_runs, whiteners
from omnibench.fit.sessions import SessionComparison, compare_sessions, sessions_of
from omnibench.fit.trajectory_fit import (
    Whitened,
    differences_without_nuisances,
    in_start_frames,
    usable_runs,
    whitened,
)
from omnibench.robot.corrections import Fade, extrapolated_share, kinds_of_motion, motions_of, representatives
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel

# Times, and s more than, the latest training run, from where on a session's time counts as new. Nothing but a warning
# hangs on them.
_LATER, _LATER_S = 1.1, 60


@dataclass(frozen=True, eq=False)
class ValidationRuns:
    """Runs of the validation split that the model can predict, which of their poses are outliers, and warnings.

    inliers: True (K,) for the poses of each run that are none; empty if none is an outlier.
    """

    runs: tuple[Trajectory, ...]
    inliers: tuple[NDArray[np.bool_], ...]
    warnings: tuple[str, ...]
    _fits: dict[OdometryModel, Fit] = field(default_factory=dict)

    def under(self, fit: Fit) -> Fit:
        """The model of a fit at the runs; each model is evaluated once."""
        there = self._fits.setdefault(fit.model, at_runs(fit, self.runs))
        nuisances = replace(there.nuisances, deviations=fit.nuisances.deviations)
        again = there.changed(noise=fit.noise, nuisances=nuisances, inliers=self.inliers)
        _ = again.residuals
        self._fits[fit.model] = again
        return again


def validation_runs(dataset: Dataset, fit: Fit) -> ValidationRuns:
    """Runs of the validation split that hold all that the effects of a fit need; jumps are told by its residuals."""
    recorded = [run for run in dataset.split("validation") if len(run.pose_times) > 1]
    # Runs that hold all that the effects of the model need
    needs = {need for term in fit.model.terms for need in term.effect.needs}
    able = []
    for run in recorded:
        missing = {
            "wheel_angles": run.angles is None,
            "session_time": run.started_at is None,
            "session": run.session is None,
        }
        if not any(missing.get(need, False) for need in needs):
            able.append(run)
    warnings = list(_beyond_training(fit, able))
    if len(able) < len(recorded):
        warnings.append(f"{len(recorded) - len(able)} held-out runs lack what an effect of the model needs: left out.")
    if not able:
        return ValidationRuns((), (), tuple(warnings))
    try:
        runs = usable_runs(able, "validation")
    except DataError as error:
        warnings.append(f"{error}; nothing is compared on it.")
        return ValidationRuns((), (), tuple(warnings))
    there = at_runs(fit, runs)
    there = there.changed(inliers=inliers_of(runs, in_start_frames(runs, there.residuals), fit.noise.noise))
    if there.jumps:
        warnings.append(f"{there.jumps} held-out poses contradict their neighbours; whitened χ² is without them.")
    return ValidationRuns(runs, there.inliers, tuple(warnings), {fit.model: there})


def noise_runs(runs: Sequence[Trajectory], dataset: Dataset) -> tuple[Trajectory, ...]:
    """Runs of the validation split that repeat training runs in their session, where no training run does."""
    try:
        return usable_runs(repeating_runs(runs, dataset.split("validation")), "validation")
    except DataError:
        return ()


def _beyond_training(fit: Fit, runs: Sequence[Trajectory]) -> Iterator[str]:
    """Warnings of sessions, and times in a session, that effects need and that no training run covers."""
    needs = {need: term.name for term in fit.model.terms for need in term.effect.needs}
    known = {run.session for run in fit.runs}
    if "session" in needs and (new := sorted({str(run.session) for run in runs} - {str(name) for name in known})):
        yield f"{needs['session']} says nothing of sessions that were not trained on: {', '.join(new[:3])}."
    latest = max((run.started_at or 0.0 for run in fit.runs), default=0.0)
    late = [run.id for run in runs if (run.started_at or 0.0) > _LATER * latest + _LATER_S]
    if "session_time" in needs and late:
        yield (
            f"{needs['session_time']} was fitted to the first {latest:.0f} s of a session; {len(late)} held-out runs "
            "are later, where it is not known to hold."
        )


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


def held_out_residuals(extended: Extended, folds: NDArray[np.intp]) -> list[Array]:
    """Residuals (k, 3) of each run's inliers, to first order, by the model fitted to all folds but the run's own.

    Nothing is fitted to the run itself, nor are its nuisances.
    """
    left = left_by(extended, extended.steps_without(folds))
    return [residuals[inliers] for residuals, inliers in zip(left, extended.fit.masks, strict=True)]


def left_by(extended: Extended, values: Array) -> list[Array]:
    """Residuals (K, 3) of each run, to first order, by values (Z, p) of all columns, others for each run."""
    return [
        residuals - columns @ value
        for residuals, columns, value in zip(
            extended.fit.nuisance_free_residuals, extended.columns, values, strict=True
        )
    ]


def squares_left_by(data: Whitened, index: Sequence[int], values: Array) -> Array:
    """Chi-square (Z,) of each run by values (Z, n) of the columns ``index``, others for each run."""
    of_runs = zip(data.residuals, data.columns, values, strict=True)
    left = [residuals - columns[:, list(index)] @ value for residuals, columns, value in of_runs]
    return np.array([float(np.square(of_run).sum()) for of_run in left])  # Eq. (2)


def held_out_chi_square(data: Whitened, before: Sequence[int], after: Sequence[int], folds: NDArray[np.intp]) -> Array:
    """Chi-square difference (Z,) of each run between the columns ``before`` and ``after``, its fold held out."""
    every = sorted({*before, *after})
    few, place = data.only(every), {column: row for row, column in enumerate(every)}
    places = [[place[each] for each in index] for index in (before, after)]
    first, last = (squares_left_by(few, index, values_of_other_folds(few, index, folds)) for index in places)
    return first - last


def is_confirmed(data: Whitened, before: Sequence[int], new: Sequence[int], folds: NDArray[np.intp]) -> bool:
    """True if the columns ``new`` lower the chi-square of held-out runs beyond ``before``, by two standard errors."""
    return is_gain(held_out_chi_square(data, before, [*before, *new], folds))


def is_gain(gains: Array) -> bool:
    """True if the gains (Z,) of runs are more than chance in the mean, Eq. (3)."""
    return float(gains.mean()) > STANDARD_ERRORS * float(gains.std()) / np.sqrt(len(gains))


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
    steps = extended.steps_without(folds)
    finals = np.array([residuals[-1] for residuals in left_by(extended, steps)])
    squares = squares_left_by(extended.data, range(steps.shape[1]), steps)
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
    closed = min((first - last) / gap, 1.0) if gap > STANDARD_ERRORS * error else None  # Eq. (4)
    return Gap(metric, first, last, least if least <= min(first, last) else None, closed, error)


def waterfall_steps(
    baseline: Extended, likeliest: Extended, extended: Extended, validation: ValidationRuns
) -> tuple[Step, ...]:
    """The plain matrix (baseline), then the models with one effect more each; all under the extended model's noise.

    likeliest: the model whose effects are added one after another. extended: the last model, which may be the average
    of that one and others.
    """
    models = [("plain matrix", baseline)]
    for count in group_counts(likeliest.groups) if extended.groups else ():
        model, groups = extended, likeliest.groups[:count]
        if count < len(likeliest.groups):
            model = most_probable(
                baseline.fit, groups, likeliest.values[: sum(len(group.parameters) for group in groups)]
            )
        models.append((f"+ {step_name(groups[-1])}", model))
    return tuple(_step(name, model.fit, extended.fit, validation) for name, model in models)


def group_counts(groups: Sequence[Group]) -> list[int]:
    """The number of groups after each step: named effects come one by one, terms without a name all at once."""
    named = sum(group.basis is None for group in groups)
    return [*range(1, named + 1), *([len(groups)] if len(groups) > named else [])]


def step_name(group: Group) -> str:
    """The name of the step that adds a group."""
    return group.name if group.basis is None else f"unnamed, over {group.basis.covariate}"


def _step(name: str, fit: Fit, extended: Fit, validation: ValidationRuns) -> Step:
    """Errors of a step's model; on held-out runs as ``compare_held_out`` has them."""
    errors = errors_on(replace(extended, model=fit.model), validation) if validation.runs else None
    under_noise = fit.changed(noise=extended.noise)
    white = np.concatenate(
        [weigh(values) for weigh, values in zip(under_noise.weightings, under_noise.residuals, strict=True)]
    )
    return Step(
        name,
        float(np.square(white).mean()),
        None if errors is None else float(errors.chi2.mean()),
        float(np.mean([np.linalg.norm(values[-1]) for values in fit.nuisance_free_residuals])),
        None if errors is None else float(errors.eq6.mean()),
    )


_QUANTILE = 2.45  # sqrt(-2 ln 0.05), Eq. (6)


def training_domain(extended: Extended) -> Array:
    """Representative motions (k, 3) of the runs of a fit, m/s, m/s, rad/s."""
    model = extended.fit.model
    motions = [motions_of(model.matrix, run.times, run.signals) for run in extended.fit.runs]
    return representatives(model.robot, np.concatenate(motions))


def faded(extended: Extended, baseline: Extended) -> Extended:
    """The fit with a model whose corrections fade outside the training domain. baseline: the plain matrix, fitted."""
    model = extended.fit.model
    if not model.terms:
        return extended
    change, domain = model.matrix - baseline.fit.model.matrix, training_domain(extended)
    fade = Fade(model.robot, change, domain, model.terms, extended.covariance_of_terms)
    return replace(extended, fit=replace(extended.fit, model=replace(model, fade=fade)))


def extrapolations_of(
    runs: Sequence[Trajectory], plain: Extended, extended: Extended, members: Sequence[tuple[float, Extended]]
) -> tuple[Extrapolation, ...]:
    """One entry for every command of ``runs`` that leaves the training domain.

    members: the models of which the extended one is the average, with their weights; where these disagree the bound is
    wide.
    """
    model, domain = plain.fit.model, training_domain(plain)
    extrapolations = []
    for repetitions in grouped([run.command or run.id for run in runs]):
        of_command = [runs[index] for index in repetitions]
        motions = np.concatenate([motions_of(model.matrix, run.times, run.signals) for run in of_command])
        share, words = extrapolated_share(model.robot, domain, motions)
        if share:
            extrapolations.append(
                Extrapolation(
                    of_command[0].command or of_command[0].id,
                    f"{100 * share:.0f} % of its time it drives what no training run drove, such as {words}",
                    _bound(of_command, plain, [(1.0, plain)]),
                    _bound(of_command, extended, members),
                )
            )
    return tuple(extrapolations)


def _bound(runs: Sequence[Trajectory], used: Extended, members: Sequence[tuple[float, Extended]]) -> float:
    """95 % bound on the error of the final positions of some runs by a model, m, Eq. (6) with their mean V."""
    end, squares = _ends(used, runs), np.zeros(len(runs))
    for weight, model in members:
        residuals = held_out_residuals(model, folds_of_commands(model.fit.runs))
        scatter = float(np.mean([np.square(of_run[-1, :2]).sum() for of_run in residuals]))
        squares += weight * (np.square(_ends(model, runs) - end).sum(axis=1) + scatter)
        for row, columns in enumerate(columns_at(model, runs)):
            last = columns[-1, :2]
            squares[row] += weight * float(np.trace(last @ model.covariance.matrix @ last.T))  # Eq. (5)
    return float(_QUANTILE * np.sqrt(np.mean(squares) / 2))  # Eq. (6)


def _ends(model: Extended, runs: Sequence[Trajectory]) -> Array:
    """Final positions (R, 2) of runs by a model, m."""
    return np.array([poses[-1, :2] for poses in model.fit.model.reported([run.reference_log for run in runs])])
