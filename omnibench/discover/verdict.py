"""What is said in the end, and in words."""

from __future__ import annotations

from collections.abc import Sequence

from omnibench.discover.naming import CHANCE, SURE
from omnibench.discover.result import NamedEffect, Place, Verdict


def verdict_of(effects: Sequence[NamedEffect], sure_of_class: Sequence[float], left: Sequence[Place],
               where: Sequence[Place]) -> Verdict:  # fmt: skip
    """The verdict. sure_of_class: of each effect, the weight of its name and of those that it is confusable with."""
    if not effects:
        return "unknown" if any(place.p_value < CHANCE for place in where) else "none"
    something_left = any(place.p_value < CHANCE for place in left)
    if all(effect.weight >= SURE for effect in effects):
        return "incomplete" if something_left else "named"
    if all(weight >= SURE for weight in sure_of_class):
        return "class"
    return "unknown"


def headline_of(verdict: Verdict, effects: Sequence[NamedEffect], where: Sequence[Place], left: Sequence[Place]) -> str:
    """One or two sentences for the top of a report."""
    names = " and ".join(f"{effect.name} ({effect.weight:.0%})" for effect in effects)
    place = where[0].description if where else ""
    if verdict == "none":
        return "Nothing is missing that these recordings could show: what the matrix leaves looks like its noise."
    if verdict == "named":
        return f"Missing: {names}. With it the model predicts these recordings to within their noise."
    if verdict == "incomplete":
        return f"Missing: {names}. Something else is left: {left[0].description}."
    if verdict == "class":
        others = [f"{effect.name} or {' or '.join(effect.confusable_with)}" for effect in effects]
        return f"Missing: {'; and '.join(others)}. These recordings cannot tell which."
    if effects:
        return f"Something is missing that has no sure name ({names} at best): {place}."
    return f"Something is missing that the catalogue has no name for: {place}."
