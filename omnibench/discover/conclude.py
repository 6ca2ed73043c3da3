"""Step 6, conclude: the verdict in words, what is better on held-out runs, what to drive next, and the calibrations."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.discover import held_out as validating
from omnibench.discover import result
from omnibench.discover.confirm import Confirmed, candidates_of
from omnibench.discover.experiments import experiments_for
from omnibench.discover.fit import Extended, Fit
from omnibench.discover.propose import hidden_sizes
from omnibench.discover.report.tables import weight_in_words
from omnibench.discover.screening import Screening
from omnibench.environment import package_versions
from omnibench.errors import DataError
from omnibench.fit.calibrator import calibration_of_fit
from omnibench.fit.estimate import LOST_RATE
from omnibench.fit.path_errors import slip_of
from omnibench.fit.prior import default_mount
from omnibench.fit.sessions import SessionComparison
from omnibench.registry import costs
from omnibench.robot.calibration import Calibration, EffectTerm, covariance_rows, matrix_rows
from omnibench.robot.kinematics import Array
from omnibench.robot.physical import read_matrix

_PLACES = 2  # covariates that a headline names, as what shows in one often shows in another, too (chosen)


def conclude(confirmed: Confirmed, choices: Mapping[str, Any]) -> result.Discovery:
    """Judge plain and extended model on held-out runs, and say what was found. choices: options and seed."""
    selected, screening, models = confirmed.selected, confirmed.screening, confirmed.models
    proposal, selection = selected.proposal, models.selection
    dataset = proposal.located.plain.dataset
    baseline, extended, folds = confirmed.baseline, confirmed.extended, confirmed.folds
    fit, effects, where, left = extended.fit, confirmed.effects, confirmed.where, confirmed.left

    validation = validating.validation_runs(dataset, fit)
    held_out = validating.compare_held_out(baseline, extended, validation, folds)
    sessions = validating.compare_with_validation(extended, validation)
    eq6_of_sessions = validating.eq6_with_changes(extended, validation.runs, sessions)
    verdict, above = result.verdict_of(effects, where, left), None
    if verdict == "none":  # not while errors are above their floor, which sessions that differ would explain, too
        same = not sessions.differences and sessions.other_commands is None
        gaps = (held.eq6 for held in held_out if held.data == "repetitions" or same)
        above = next((gap for gap in gaps if gap.beyond_chance), None)
        verdict = "none" if above is None else "unknown"

    # Sentences on sessions and models for the top of the report, and notes
    inliers, few = fit.at_inliers.runs, result.few_in_words(fit.runs)
    trained = {run.session for run in fit.runs}
    of_sessions = sessions_in_words(verdict, sessions, held_out, eq6_of_sessions, trained)
    differ, untested = bool(of_sessions), bool(sessions.doubts)
    of_model = headline_of(verdict, effects, where, left, few, above, differ=differ, untested=untested)
    doubts = sessions.doubts if verdict == "none" else ()
    warnings = _warnings(held_out, session=result.is_other_session(fit.runs, validation.runs))
    headline = " ".join([*of_sessions, of_model, *doubts, *warnings])
    notes: list[str] = []
    if verdict != "none":  # else the headline says it
        notes += [*sessions.of_other_commands, *sessions.doubts]
        notes += [f"These are {few}: so little can show hardly anything."] if few else []
    notes += [f"The extended model holds {LOST_RATE[0]}, as what calibrate gives does: robots of this class lose it."
              for term in fit.model.terms if term.effect.name == LOST_RATE[0] and LOST_RATE[0] not in
              {name for effect in effects for name in (effect.name, *effect.confusable_with)}]  # fmt: skip
    notes += [*_notes(fit, screening, proposal.sums), *confirmed.notes, *filter(None, [confirmed.average.note])]
    absorbed = tuple(each for each in proposal.absorbed if each.name != "tyre_wear" or not worn(sessions, trained))
    needs_session = any("session" in term.effect.needs for term in fit.model.terms)
    confusable = [name for names in selection.confusable for name in names]
    spread = float(np.median(selection.left.spread))
    choices = {**choices, "reason": headline}
    return result.Discovery(
        dataset=replace(dataset, trajectories=(*inliers, *validation.runs)),
        dataset_hash=dataset.hash,
        simulated=dataset.simulated,
        verdict=verdict,
        headline=headline,
        effects=effects,
        candidates=candidates_of(selection),
        where=where,
        left=left,
        absorbed=tuple(effect.name for effect in absorbed),
        measurements=absorbed,
        not_looked_for=tuple(result.NotLookedFor(name, lack.value) for name, lack in proposal.not_looked_for),
        classes=proposal.classes,
        hidden=hidden_sizes(screening, selection.chosen, confusable, spread),
        gap=held_out[0 if needs_session else -1].eq6 if held_out else validating.training_gap(baseline, extended),
        held_out=held_out,
        steps=validating.waterfall_steps(baseline, confirmed.likeliest, extended, validation),
        extrapolations=validating.extrapolations_of(validation.runs, baseline, extended, confirmed.average.members),
        experiments=experiments_for(dataset, effects, models.weighted),
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
        seconds=0.0,
    )


def headline_of(
    verdict: result.Verdict,
    effects: Sequence[result.NamedEffect],
    where: Sequence[result.CovariateDependence],
    left: Sequence[result.CovariateDependence],
    few: str = "",
    above: result.Gap | None = None,
    *,
    differ: bool = False,
    untested: bool = False,
) -> str:
    """One or two sentences for the top of a report.

    few: the training runs in words if they can show hardly anything. above: the gap, where nothing else shows that
    something is missing. differ: True if sentences on sessions that deviate
    stand before these. untested: True if sessions could not be compared.
    """
    names = "; ".join(" or ".join((effect.name, *effect.confusable_with)) for effect in effects)
    with_weights = " and ".join(f"{effect.name} ({weight_in_words(effect.weight)})" for effect in effects)
    where, left = [each for each in where if each.counts], [each for each in left if each.counts]
    of_odometry = [each for each in where if each.stage != "actuator"]
    surest = _places(of_odometry or where)
    found = "Nothing else was found" if differ else "Nothing was found"
    odometry = "Nothing is missing in the odometry that these recordings could show"
    if differ or untested:
        odometry = f"{found} in the odometry of the training runs"
    if above is not None:
        return (
            f"Something is missing that depends on nothing that was tried: Eq. (6) of held-out runs is "
            f"{above.before:.3g}, and repetitions leave {above.floor:.3g}."
        )
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


def _places(dependences: Sequence[result.CovariateDependence]) -> str:
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
    driven = tuple(tuple(float(value) for value in motion) for motion in validating.training_domain(extended))
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
        driven=driven if plain is None or extended.fit.model.fade is not None else None,
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
