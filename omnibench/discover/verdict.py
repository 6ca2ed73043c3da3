"""What is said in the end, and in words."""

from __future__ import annotations

from collections.abc import Sequence

from omnibench.discover.result import NamedEffect, Place, Verdict
from omnibench.discover.selection.model_selection import CHANCE, SURE


def verdict_of(
    effects: Sequence[NamedEffect], sure_of_class: Sequence[float], left: Sequence[Place], where: Sequence[Place]
) -> Verdict:
    """The verdict. sure_of_class: of each effect, the weight of its name and of those that it is confusable with.

    Motors are a stage of their own: naming what they do explains nothing that the odometry gets wrong. A controller's
    way of following its targets, as far as it has no name, is told of, and is nothing that the odometry lacks.
    """
    of_odometry = _of_stage(effects, sure_of_class, left, where, motors=False)
    if of_odometry != "none":
        return of_odometry
    of_motors = _of_stage(effects, sure_of_class, left, where, motors=True)
    whole: dict[Verdict, Verdict] = {"unknown": "none", "incomplete": "named"}
    return whole.get(of_motors, of_motors)


def _of_stage(
    effects: Sequence[NamedEffect],
    sure_of_class: Sequence[float],
    left: Sequence[Place],
    where: Sequence[Place],
    *,
    motors: bool,
) -> Verdict:
    """The verdict on the motors alone, or on all that is behind them."""
    pairs = zip(effects, sure_of_class, strict=True)
    own = [(effect, sure) for effect, sure in pairs if (effect.stage == "actuator") == motors]
    here, after = (
        any(_counts(place) and (place.stage == "actuator") == motors for place in places) for places in (where, left)
    )
    if not own:
        return "unknown" if here else "none"
    if all(effect.weight >= SURE for effect, _ in own):
        return "incomplete" if after else "named"
    if all(sure >= SURE for _, sure in own):
        return "class"
    return "incomplete" if any(effect.weight >= SURE for effect, _ in own) else "unknown"


def _counts(place: Place) -> bool:
    return place.p_value < CHANCE and not place.within_ticks


def headline_of(verdict: Verdict, effects: Sequence[NamedEffect], where: Sequence[Place], left: Sequence[Place]) -> str:
    """One or two sentences for the top of a report."""
    names = "; ".join(" or ".join((effect.name, *effect.confusable_with)) for effect in effects)
    with_weights = " and ".join(f"{effect.name} ({_percent(effect.weight)})" for effect in effects)
    where, left = [place for place in where if _counts(place)], [place for place in left if _counts(place)]
    odometry = [place for place in where if place.stage != "actuator"]
    place = (odometry or list(where))[0].description if where else ""
    if verdict == "none" and where:
        return (
            "Nothing is missing in the odometry that these recordings could show. How the motors follow their targets "
            f"has no name: {place}."
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
        return f"Something is missing that has no name: {place}. Of the motors: {with_weights}."
    if effects:
        return f"Something is missing that has no sure name ({with_weights} at best): {place}."
    return f"Something is missing that the catalogue has no name for: {place}."


def _percent(weight: float) -> str:
    return "> 99.9 %" if weight > 0.999 else f"{100 * weight:.1f} %"
