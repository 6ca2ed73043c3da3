"""The verdict of a discovery, and its headline."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from omnibench.discover.result import CovariateDependence, HeldOut, NamedEffect, Verdict
from omnibench.discover.selection.model_selection import CHANCE, SURE
from omnibench.fit.sessions import SessionComparison

_Dependences = Sequence[CovariateDependence]
_PLACES = 2  # covariates that a headline names, as what shows in one often shows in another, too (chosen)


def verdict_of(effects: Sequence[NamedEffect], where: _Dependences, left: _Dependences) -> Verdict:
    """The verdict. where, left: what the residuals depend on before and after the effects.

    Motors are a stage of their own: naming what they do explains nothing that the odometry gets wrong. What a
    controller does without a name is reported in words, and is nothing that the odometry lacks.
    """
    of_odometry = _of_stage(effects, where, left, motors=False)
    if of_odometry != "none":
        return of_odometry
    of_motors = _of_stage(effects, where, left, motors=True)
    whole: dict[Verdict, Verdict] = {"unknown": "none", "incomplete": "named"}
    return whole.get(of_motors, of_motors)


def lacks_a_name(verdict: Verdict) -> bool:
    """True if something is missing that no effect explains."""
    return verdict in ("unknown", "incomplete")


def _of_stage(effects: Sequence[NamedEffect], where: _Dependences, left: _Dependences, *, motors: bool) -> Verdict:
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


def _counts(dependence: CovariateDependence) -> bool:
    """True if a dependence is neither chance nor possibly encoder quantisation."""
    return dependence.p_value < CHANCE and not dependence.within_ticks


def headline_of(
    verdict: Verdict,
    effects: Sequence[NamedEffect],
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
    with_weights = " and ".join(f"{effect.name} ({_percent(effect.weight)})" for effect in effects)
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
    other = f"on {second.description.partition('depends on ')[2]} ({_percent(second.weight)})"
    return f"{first.description} ({_percent(first.weight)}) or {other}"


def worn(comparison: SessionComparison, trained: Collection[str | None]) -> bool:
    """True if all wheels differ, as by tyre_wear, between sessions that do not all train."""
    return any(
        each.kind == "all wheels" and not {each.session, *each.others} <= set(trained)
        for each in comparison.differences
    )


def sessions_in_words(
    verdict: Verdict,
    comparison: SessionComparison,
    held_out: Sequence[HeldOut],
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


def _percent(weight: float) -> str:
    if weight < 0.001:
        return "< 0.1 %"
    return "> 99.9 %" if weight > 0.999 else f"{100 * weight:.1f} %"
