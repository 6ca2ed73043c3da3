"""The verdict of a discovery, and its headline."""

from __future__ import annotations

from collections.abc import Sequence

from omnibench.discover.result import CovariateDependence, NamedEffect, Verdict
from omnibench.discover.selection.model_selection import CHANCE, SURE

_Dependences = Sequence[CovariateDependence]


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


def headline_of(verdict: Verdict, effects: Sequence[NamedEffect], where: _Dependences, left: _Dependences) -> str:
    """One or two sentences for the top of a report."""
    names = "; ".join(" or ".join((effect.name, *effect.confusable_with)) for effect in effects)
    with_weights = " and ".join(f"{effect.name} ({_percent(effect.weight)})" for effect in effects)
    where, left = [each for each in where if _counts(each)], [each for each in left if _counts(each)]
    of_odometry = [each for each in where if each.stage != "actuator"]
    surest = (of_odometry or where)[0].description if where else ""
    if verdict == "none" and where:
        return (
            "Nothing is missing in the odometry that these recordings could show. How the motors follow their targets "
            f"has no name: {surest}."
        )
    if verdict == "none":
        return "Nothing is missing that these recordings could show: what the matrix leaves looks like its noise."
    remains = f" Something else is left: {left[0].description}." if left else ""
    if verdict == "named" and all(effect.stage == "actuator" for effect in effects):
        more = f" Beyond that, {left[0].description}." if left else ""
        return (
            "Nothing is missing in the odometry that these recordings could show. Between targets and measured wheel "
            f"rates: {with_weights}.{more}"
        )
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


def _percent(weight: float) -> str:
    return "> 99.9 %" if weight > 0.999 else f"{100 * weight:.1f} %"
