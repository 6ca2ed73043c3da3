"""Discovering what a model lacks: all steps, in their order.

Fit the plain matrix; screen its residuals for all that could explain them; select the effects of the catalogue that do;
extend the model by these; confirm them once the noise is known better; compare plain and extended model on runs that
were held out; conclude.

The conclusion is the verdict of a discovery, in words, beside what its steps returned.
"""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.discover import held_out as validating
from omnibench.discover import result
from omnibench.discover.experiments import experiments_for
from omnibench.discover.fitting import Extended, Fit, extend, fit_matrix, in_windows, without_effects
from omnibench.discover.regressors.fine_structure import fine_structure
from omnibench.discover.regressors.significance import Significance, together
from omnibench.discover.report.tables import weight_in_words
from omnibench.discover.selection import competing_models as rivals
from omnibench.discover.selection.evidence import check_names
from omnibench.discover.selection.model_selection import (
    CHANCE,
    SURE,
    Screening,
    Selection,
    covariate_dependences,
    screen_again,
    screen_extended,
    screen_plain,
    select_effects,
    select_motor_effects,
    significance_left,
    without_smooth_term,
)
from omnibench.discover.selection.unknown_term import add_smooth_terms
from omnibench.environment import package_versions
from omnibench.errors import DataError, computable, require_type
from omnibench.fit.calibrator import calibration_of_fit
from omnibench.fit.path_errors import slip_of
from omnibench.fit.prior import default_mount
from omnibench.fit.sessions import SessionComparison
from omnibench.fit.trajectory_fit import usable_runs
from omnibench.progress import Reporter, Stages, no_progress
from omnibench.registry import costs
from omnibench.robot.calibration import Calibration, EffectTerm, covariance_rows, matrix_rows
from omnibench.robot.kinematics import Array
from omnibench.robot.physical import read_matrix

_Dependences = Sequence[result.CovariateDependence]
_PLACES = 2  # covariates that a headline names, as what shows in one often shows in another, too (chosen)


def verdict_of(effects: Sequence[result.NamedEffect], where: _Dependences, left: _Dependences) -> result.Verdict:
    """The verdict. where, left: what the residuals depend on before and after the effects.

    Motors are a stage of their own: naming what they do explains nothing that the odometry gets wrong. What a
    controller does without a name is reported in words, and is nothing that the odometry lacks.
    """
    of_odometry = _of_stage(effects, where, left, motors=False)
    if of_odometry != "none":
        return of_odometry
    of_motors = _of_stage(effects, where, left, motors=True)
    whole: dict[result.Verdict, result.Verdict] = {"unknown": "none", "incomplete": "named"}
    return whole.get(of_motors, of_motors)


def lacks_a_name(verdict: result.Verdict) -> bool:
    """True if something is missing that no effect explains."""
    return verdict in ("unknown", "incomplete")


def _of_stage(
    effects: Sequence[result.NamedEffect], where: _Dependences, left: _Dependences, *, motors: bool
) -> result.Verdict:
    """The verdict on the motors alone, or on the odometry alone."""
    of_stage = [effect for effect in effects if (effect.stage == "actuator") == motors]
    before, after = (
        any(_counts(dependence) and (dependence.stage == "actuator") == motors for dependence in dependences)
        for dependences in (where, left)
    )
    if not of_stage:
        return "unknown" if before else "none"
    if all(effect.weight >= SURE for effect in of_stage):
        return "incomplete" if after else "named"
    if all(effect.class_weight >= SURE for effect in of_stage):
        return "class"
    return "incomplete" if any(effect.weight >= SURE for effect in of_stage) else "unknown"


def _counts(dependence: result.CovariateDependence) -> bool:
    """True if a dependence is neither chance nor possibly encoder quantisation."""
    return dependence.p_value < CHANCE and not dependence.within_ticks


def headline_of(
    verdict: result.Verdict,
    effects: Sequence[result.NamedEffect],
    where: _Dependences,
    left: _Dependences,
    few: str = "",
    *,
    differ: bool = False,
    untested: bool = False,
) -> str:
    """One or two sentences for the top of a report.

    few: the training runs in words if they can show hardly anything. differ: True if sentences on sessions that deviate
    stand before these. untested: True if sessions could not be compared.
    """
    names = "; ".join(" or ".join((effect.name, *effect.confusable_with)) for effect in effects)
    with_weights = " and ".join(f"{effect.name} ({weight_in_words(effect.weight)})" for effect in effects)
    where, left = [each for each in where if _counts(each)], [each for each in left if _counts(each)]
    of_odometry = [each for each in where if each.stage != "actuator"]
    surest = _places(of_odometry or where)
    found = "Nothing else was found" if differ else "Nothing was found"
    odometry = "Nothing is missing in the odometry that these recordings could show"
    if differ or untested:
        odometry = f"{found} in the odometry of the training runs"
    if verdict == "none" and where:
        return f"{odometry}. How the motors follow their targets has no name: {surest}."
    if verdict == "none" and few:
        return f"{found}, but {few} can show hardly anything: that nothing was found says little."
    if verdict == "none" and (differ or untested):
        return f"{found}: what the matrix leaves of the training runs looks like its noise."
    if verdict == "none":
        return "Nothing is missing that these recordings could show: what the matrix leaves looks like its noise."
    remains = f" Something else is left: {_places(left)}." if left else ""
    if verdict == "named" and all(effect.stage == "actuator" for effect in effects):
        more = f" Beyond that, {_places(left)}." if left else ""
        return f"{odometry}. Between targets and measured wheel rates: {with_weights}.{more}"
    if verdict == "named":
        return f"Missing: {with_weights}. With it the model predicts the training runs to within their noise."
    if verdict == "incomplete":
        return f"Missing: {with_weights}.{remains}"
    if verdict == "class":
        return f"Missing: {names}. These recordings cannot tell which.{remains}"
    if effects and all(effect.stage == "actuator" for effect in effects):
        return f"Something is missing that has no name: {surest}. Of the motors: {with_weights}."
    if effects:
        return f"Something is missing that has no sure name ({with_weights} at best): {surest}."
    return f"Something is missing that the catalogue has no name for: {surest}."


def _places(dependences: _Dependences) -> str:
    """The likeliest covariate or, where there are several, the likeliest two with their probabilities."""
    likeliest = sorted(dependences, key=lambda each: -each.weight)[:_PLACES]
    if len(likeliest) < _PLACES:
        return likeliest[0].description if likeliest else ""
    first, second = likeliest
    other = f"on {second.description.partition('depends on ')[2]} ({weight_in_words(second.weight)})"
    return f"{first.description} ({weight_in_words(first.weight)}) or {other}"


def worn(comparison: SessionComparison, trained: Collection[str | None]) -> bool:
    """True if all wheels differ, as by tyre_wear, between sessions that do not all train."""
    return any(
        each.kind == "all wheels" and not {each.session, *each.others} <= set(trained)
        for each in comparison.differences
    )


def sessions_in_words(
    verdict: result.Verdict,
    comparison: SessionComparison,
    held_out: Sequence[result.HeldOut],
    eq6_of_sessions: float | None,
    trained: Collection[str | None] = (),
) -> list[str]:
    """Sentences on sessions that differ, and on what their own matrices make of the validation split.

    Where other commands may be the cause, a verdict that something is missing says it already. trained: the sessions
    of the training runs.
    """
    sentences = list(comparison.sentences)
    if verdict != "none":
        sentences = sentences[: len(comparison.differences)]
    of_split = [held.eq6 for held in held_out if held.data == "session"]
    if eq6_of_sessions is not None and of_split:
        least = of_split[0].floor
        floor = "" if least is None or least > eq6_of_sessions else f" (floor {least:.3g})"
        wear = (
            " (tyre_wear, which is an effect of the model if both sessions train)" if worn(comparison, trained) else ""
        )
        sentences.append(
            f"With {'these changes' if len(comparison.differences) > 1 else 'this change'}{wear}, fitted to the same "
            f"runs, Eq. (6) of the held-out runs goes from {of_split[0].after:.3g} to {eq6_of_sessions:.3g}{floor}."
        )
    return sentences


_WORSE = 1.05  # times the plain matrix's error; nothing but a warning hangs on it


def _of_inliers(fit: Fit, residuals: Sequence[Array]) -> tuple[Array, ...]:
    """Residuals (k, 3) of the fit's inliers, of those (K, 3) of all poses."""
    return tuple(of_run[inliers] for of_run, inliers in zip(residuals, fit.masks, strict=True))


def _whitened(fit: Fit, residuals: Sequence[Array]) -> tuple[Array, ...]:
    """Residuals (k, 3) of the fit's inliers, independent and of unit variance under its noise."""
    return tuple(whiten(of_run) for whiten, of_run in zip(fit.weightings, residuals, strict=True))


def _warnings(held_out: Sequence[result.HeldOut], *, session: bool) -> Iterator[str]:
    """A warning for each kind of held-out runs that the extended model predicts worse than the plain matrix.

    session: True if the validation split is known to be of another session.
    """
    for held in held_out:
        where = "repetitions that were held out"
        if held.data == "session":
            where = "the held-out session" if session else "the held-out runs"
        sizes: list[tuple[str, float, float, str]] = [
            ("in the cost of Eq. (6)", held.eq6.before, held.eq6.after, ""),
            ("in position", 1e3 * held.position_m[0], 1e3 * held.position_m[1], " mm"),
            ("in heading", math.degrees(held.heading_rad[0]), math.degrees(held.heading_rad[1]), " deg"),
        ]
        worse = [
            f"{name} ({after:.3g}{unit}, {before:.3g}{unit} before)"
            for name, before, after, unit in sizes
            if after > _WORSE * before
        ]
        if worse:
            yield f"Beware: on {where} the extended model is worse than the plain matrix {' and '.join(worse)}."


def _notes(fit: Fit, screening: Screening, sums: Sequence[tuple[str, Sequence[str]]]) -> Iterator[str]:
    """Notes on the noise, the encoders, the nuisances, and effects that several others (sums) could imitate."""
    yield f"Noise: {fit.noise.description}."
    if fit.noise.source != "repetitions":
        yield "Without repetitions of a command nothing says how small the errors could be: no gap is closed."
    if fit.jumps:
        contradict = "pose that contradicts its neighbours was"
        if fit.jumps > 1:
            contradict = "poses that contradict their neighbours were"
        yield f"{fit.jumps} reference {contradict} left out."
    quantisation = screening.quantisation
    if quantisation is not None and quantisation.steps.any():
        yield (
            f"The wheels were read in ticks of {np.degrees(quantisation.steps.max()):.2g} deg; what is left by "
            "no more than rounding to them can make counts as nothing missing."
        )
    heading, offset, slope = fit.nuisances.deviations
    for size, words in (
        (heading, f"start headings scatter from run to run by {np.degrees(heading):.2g} deg"),
        (offset, f"offsets of the reference's clock scatter from run to run by {1e3 * offset:.2g} ms"),
        (slope, f"the reference's clock gains or loses {60e3 * slope:.0f} ms a minute, differently from run to run"),
    ):
        if size:
            yield f"{words[0].upper()}{words[1:]}; estimated for each run."
    for name, others in sums:
        yield f"{name} could be imitated by {' and '.join(others)} together."


def _calibration_of(
    dataset: Dataset,
    extended: Extended,
    name: str,
    choices: Mapping[str, Any],
    plain: Extended | None = None,
) -> Calibration:
    """The calibration of a fit with its noise, covariance and provenance.

    choices: options and seed, and why the fit ended. plain: the fit of the plain matrix, to which the effects of a
    model fade.
    """
    terms = tuple(EffectTerm.of(term) for term in extended.fit.model.terms)
    provenance = {
        "calibrator": "discover",
        "cost": "final_pose",
        "box": "none",
        "versions": package_versions(),
        "training_cost": _cost(extended, dataset.split("train")),
        "validation_cost": _cost(extended, dataset.split("validation")),
        "outcome": "converged",
        **choices,
    }
    robot, matrix, covariance = dataset.robot, extended.fit.model.matrix, extended.covariance_of_terms
    reading = read_matrix(robot, matrix, covariance, effects=terms, fitted_mount=default_mount(robot) == "fit")
    calibration = calibration_of_fit(
        f"{dataset.name} {name}",
        dataset,
        matrix,
        provenance,
        integration=extended.fit.model.integration,
        effects=terms,
        noise=extended.fit.noise.noise,
        parameters={each.name: each for each in reading.parameters},
        covariance=covariance_rows(covariance),
        session=extended.fit.runs[0].session,
        driven=tuple(tuple(float(value) for value in motion) for motion in validating.training_domain(extended)),
        plain=matrix_rows(plain.fit.model.matrix) if plain is not None and terms else None,
    )
    with suppress(DataError):  # runs may lack what an effect needs: no slip then
        return calibration.model_copy(update={"slip": slip_of(calibration, dataset.split("train"))})
    return calibration


def _cost(extended: Extended, runs: Sequence[Trajectory]) -> float | None:
    """Eq. (6), m and rad, of runs as recorded; None without runs, or where they lack what an effect needs."""
    if not runs:
        return None
    try:
        return costs.create("final_pose").of_model(extended.fit.model, runs)
    except DataError:
        return None


# Effects that the first selection gave up are kept if, once they are fitted in full, less than this share of the
# chi-square that they left to first order remains. tests/studies/constants.py varies it by 0.5 and 2, and no verdict
# changes.
_EXPLAINED = 0.5


@computable
def discover_effects(
    dataset: Dataset,
    *,
    without: Sequence[str] = (),
    unknown_term: bool = True,
    seed: int = 0,
    watch: Reporter = no_progress,
    calibration: Calibration | None = None,
) -> result.Discovery:
    """Find where the odometry of a data set's training split disagrees with its reference, and which effect is missing.

    without: effects that are not to be tried. unknown_term: where no name is sure, close the gap by a term without a
    name, over the covariate that the residuals depend on. calibration: the plain matrix is fitted from this one's
    matrix on, by default from the robot's design values. The validation split is used when all is decided, and only to
    say how well the models predict it; but where no session of the training split repeats a command, runs of the
    validation split that do are used for the noise, and a note says so. watch: told of every step as it begins and
    ends.

    Raises UnknownNameError for a name in ``without`` that is no effect's, DataError for a training split without
    reference poses or another robot's calibration.
    """
    require_type(dataset, Dataset, "load_dataset")
    if calibration is not None:
        require_type(calibration, Calibration, "read_calibration")
    began, progress = time.monotonic(), Stages(watch)
    check_names(without)
    rng = np.random.default_rng(seed)
    runs = usable_runs(in_windows([run for run in dataset.split("train") if run.has_poses]) or dataset.split("train"))
    start = _start_matrix(dataset, calibration)

    progress.begin("fitting the plain matrix")
    plain = fit_matrix(runs, dataset.robot, dataset.sample_period, start, validating.noise_runs(runs, dataset))

    screening, selection, extended = _select(plain, without, rng, progress)
    models = rivals.competing_models(plain, selection, extended)
    models = rivals.with_fitted_forms(plain, screening, models)
    baseline = without_effects(plain, models.used)
    selection = located(models.selection, screening, baseline, models.used, rng)

    progress.begin("looking at the motors")
    motors = select_motor_effects(runs, dataset.robot, without, rng)

    dependences = covariate_dependences(screening, selection, motors)
    effects = rivals.named_effects(models, motors)
    verdict = verdict_of(effects, dependences.where, dependences.left)
    folds = validating.random_folds_of_repetitions(runs, rng)
    term_notes: tuple[str, ...] = ()
    if unknown_term and lacks_a_name(verdict):
        progress.begin("closing the gap without a name")
        smooth = add_smooth_terms(
            plain, screening, models, selection.left, lambda model: all_left(model, screening, rng), folds
        )
        if smooth.models is not models:
            dependences = without_smooth_term(dependences, smooth.left, screening, selection)
        models, term_notes = smooth.models, smooth.notes
        effects = rivals.named_effects(models, motors)

    progress.begin("comparing on runs that were held out")
    average = rivals.averaged(models.weighted)
    baseline = without_effects(plain, average.extended)
    extended = validating.faded(average.extended, baseline)
    validation = validating.validation_runs(dataset, extended.fit)
    held_out = validating.compare_held_out(baseline, extended, validation, folds)
    steps = validating.waterfall_steps(plain, baseline, models.used, extended, validation)
    sessions = validating.compare_with_validation(extended, validation)
    eq6_of_sessions = validating.eq6_with_changes(extended, validation.runs, sessions)
    extrapolations = validating.extrapolations_of(validation.runs, baseline, extended, average.members)
    detectability = rivals.detectability_of(screening, models.selection)

    if any(effect.confusable_with for effect in effects):
        progress.begin("choosing runs that tell the look-alikes apart")
    experiments = experiments_for(dataset, effects, models.weighted)

    progress.end()

    # The conclusion: sentences on sessions and models for the top of the report, notes, and calibrations.
    fit, where, left = extended.fit, dependences.where, dependences.left
    inliers, few = fit.at_inliers.runs, result.few_in_words(fit.runs)
    trained = {run.session for run in fit.runs}
    of_sessions = sessions_in_words(verdict, sessions, held_out, eq6_of_sessions, trained)
    differ, untested = bool(of_sessions), bool(sessions.doubts)
    of_model = headline_of(verdict, effects, where, left, few, differ=differ, untested=untested)
    doubts = sessions.doubts if verdict == "none" else ()
    warnings = _warnings(held_out, session=result.is_other_session(fit.runs, validation.runs))
    headline = " ".join([*of_sessions, of_model, *doubts, *warnings])
    notes: list[str] = []
    if verdict != "none":  # else the headline says it
        notes += [*sessions.of_other_commands, *sessions.doubts]
        notes += [f"These are {few}: so little can show hardly anything."] if few else []
    notes += [*_notes(fit, screening, detectability.sums), *term_notes, *filter(None, [average.note])]
    absorbed = tuple(each for each in detectability.absorbed if each.name != "tyre_wear" or not worn(sessions, trained))
    needs_session = any("session" in term.effect.needs for term in fit.model.terms)
    options = {"without": list(without), "unknown_term": unknown_term}
    choices = {"options": options, "seed": seed, "reason": headline}
    return result.Discovery(
        dataset=replace(dataset, trajectories=(*inliers, *validation.runs)),
        dataset_hash=dataset.hash,
        simulated=dataset.simulated,
        verdict=verdict,
        headline=headline,
        effects=effects,
        candidates=rivals.candidates_of(selection),
        where=where,
        left=left,
        absorbed=tuple(effect.name for effect in absorbed),
        measurements=absorbed,
        not_looked_for=tuple(result.NotLookedFor(name, lack.value) for name, lack in detectability.not_looked_for),
        classes=detectability.classes,
        hidden=detectability.hidden,
        gap=held_out[0 if needs_session else -1].eq6 if held_out else validating.training_gap(baseline, extended),
        held_out=held_out,
        steps=steps,
        extrapolations=extrapolations,
        experiments=experiments,
        notes=(*notes, *validation.warnings),
        noise=fit.noise,
        outliers=fit.jumps,
        poses=sum(len(run.pose_times) - 1 for run in inliers),
        plain=_calibration_of(dataset, baseline, "plain", choices),
        extended=_calibration_of(dataset, extended, "extended", choices, baseline),
        trajectories=tuple(run.id for run in fit.runs),
        before=_of_inliers(fit, baseline.fit.residuals),
        after=_of_inliers(fit, fit.residuals),
        whitened_before=_whitened(fit, baseline.fit.residuals),
        whitened_after=_whitened(fit, fit.residuals),
        sessions=sessions,
        eq6_of_sessions=eq6_of_sessions,
        seconds=time.monotonic() - began,
    )


def _select(
    plain: Fit, without: Sequence[str], rng: np.random.Generator, progress: Stages
) -> tuple[Screening, Selection, Extended]:
    """Screen the plain matrix, select the effects that explain its residuals, and extend the model by them."""
    progress.begin("looking where it fails, and at the catalogue")
    screening = screen_plain(plain, without)
    selection = select_effects(screening, rng)
    extended = extend(plain, selection.chosen)
    if selection.tentative:
        # Effects that were given up are fitted in full, and kept if most of what they left is then explained: to first
        # order, an effect many times as large as the noise leaves residuals that look like another effect.
        in_full = extend(plain, selection.tentative)
        screened_in_full = screen_extended(in_full, without)
        again = select_effects(screened_in_full, rng)
        if again.chosen and again.left_share < _EXPLAINED * selection.left_share:
            screening, selection, extended = screened_in_full, again, in_full
    if selection.chosen:
        progress.begin("looking again, now that the noise is known better")
        before = selection
        screening = screen_again(extended, screening)
        selection = select_effects(screening, rng)
        if not selection.is_same_as(before):
            extended = extend(plain, selection.chosen)
    return screening, selection, extended


def _start_matrix(dataset: Dataset, calibration: Calibration | None) -> Array:
    """The matrix (3, N) to begin at, that without effects. DataError: it is not known, or the wheels are others."""
    if calibration is None:
        return dataset.robot.inverse_kinematic_matrix
    if calibration.effects and calibration.plain is None:
        names = ", ".join(term.name for term in calibration.effects)
        raise DataError(
            f"the calibration {calibration.name!r} holds effects already ({names}), and discover begins at a plain "
            "matrix; give one without effects, such as the plain.yaml beside it, or none"
        )
    calibration.check_wheels(dataset.robot, f"the data set {dataset.name}")
    return calibration.matrix_without_effects


def located(
    selection: Selection,
    screening: Screening,
    baseline: Extended,
    extended: Extended,
    rng: np.random.Generator,
) -> Selection:
    """The selection with all that the residuals depend on, before any effect and after those of an extended model.

    baseline: the plain matrix under the noise of the extended model.
    """
    where = together(selection.where, fine_structure(baseline.fit, rng))
    return replace(selection, where=where, left=all_left(extended, screening, rng) if extended.groups else where)


def all_left(extended: Extended, screening: Screening, rng: np.random.Generator) -> Significance:
    """Significance of generic bases and of fine structure beyond all that an extended model holds."""
    bases = significance_left(extended, screening, rng)
    return together(bases, fine_structure(extended.fit, rng))
