"""What is said in the end, and in words."""

from __future__ import annotations

from collections.abc import Sequence

from omnibench.discover.naming import CHANCE, SURE
from omnibench.discover.result import NamedEffect, Place, Verdict


def verdict_of(
    effects: Sequence[NamedEffect], sure_of_class: Sequence[float], left: Sequence[Place], where: Sequence[Place]
) -> Verdict:
    """The verdict. sure_of_class: of each effect, the weight of its name and of those that it is confusable with.

    Motors are a stage of their own: naming what they do explains nothing that the odometry gets wrong.
    """
    odometry = [effect for effect in effects if effect.stage != "actuator"]
    unexplained = [place for place in where if place.p_value < CHANCE and not (odometry and place.stage != "actuator")]
    if not effects:
        return "unknown" if unexplained else "none"
    if not odometry and any(place.stage != "actuator" for place in unexplained):
        return "unknown"
    something_left = any(place.p_value < CHANCE for place in left)
    if all(effect.weight >= SURE for effect in effects):
        return "incomplete" if something_left else "named"
    return "class" if all(weight >= SURE for weight in sure_of_class) else "unknown"


def headline_of(verdict: Verdict, effects: Sequence[NamedEffect], where: Sequence[Place], left: Sequence[Place]) -> str:
    """One or two sentences for the top of a report."""
    names = "; ".join(" or ".join((effect.name, *effect.confusable_with)) for effect in effects)
    with_weights = " and ".join(f"{effect.name} ({_percent(effect.weight)})" for effect in effects)
    odometry = [place for place in where if place.stage != "actuator"]
    place = (odometry or list(where))[0].description if where else ""
    if verdict == "none":
        return "Nothing is missing that these recordings could show: what the matrix leaves looks like its noise."
    if verdict == "named":
        return f"Missing: {with_weights}. With it the model predicts these recordings to within their noise."
    if verdict == "incomplete":
        return f"Missing: {with_weights}. Something else is left: {left[0].description}."
    if verdict == "class":
        return f"Missing: {names}. These recordings cannot tell which."
    if effects and all(effect.stage == "actuator" for effect in effects):
        return f"Something is missing that has no name: {place}. Of the motors: {with_weights}."
    if effects:
        return f"Something is missing that has no sure name ({with_weights} at best): {place}."
    return f"Something is missing that the catalogue has no name for: {place}."


def _percent(weight: float) -> str:
    return "> 99.9 %" if weight > 0.999 else f"{100 * weight:.1f} %"
