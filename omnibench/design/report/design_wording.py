"""A design in words: commands, efforts and sentences that the terminal and the report share."""

from __future__ import annotations

import math
from collections.abc import Mapping

from omnibench.design.config import Per, Use
from omnibench.design.result import Candidate, Design, Effort, SetDesign
from omnibench.report.motions import motion_in_words
from omnibench.report.numbers import count, fixed, listing, percent, significant
from omnibench.words import noun_for, plural

USE_IN_WORDS: Mapping[Use, str] = {"final": "final poses", "trajectory": "whole trajectories"}
UNIT_OF_COST: Mapping[Per, str] = {"run": "runs", "second": "s", "metre": "m of wheel"}


def command_in_words(candidate: Candidate) -> str:
    return motion_in_words(candidate.name, candidate.speed, candidate.direction, candidate.turn_rate)


def drive_in_words(candidate: Candidate) -> str:
    """A command as a person drives it: ``forward 2 m at 0.5 m/s, turning left with radius 1.2 m``."""
    speed, direction, rate = candidate.speed, candidate.direction, candidate.turn_rate
    if speed is None or direction is None or rate is None:
        return candidate.name
    turned = math.degrees(abs(rate) * candidate.duration_s)
    turns = plural(round(turned / 360), "full turn") if turned > 359 else f"{fixed(turned, 0)}°"
    side = "left" if rate > 0 else "right"
    if not speed:
        return f"on the spot {turns} to the {side} at {significant(abs(rate), 2)} rad/s"
    driven = f"{_way_in_words(direction)} {significant(candidate.distance_m, 2)} m at {significant(speed, 2)} m/s"
    if not rate:
        return driven
    return f"{driven}, turning {side} by {turns} with radius {significant(speed / abs(rate), 2)} m"


def _way_in_words(direction: float) -> str:
    """A direction, rad, as ``forward``, ``backward``, ``sideways to the left`` or with its angle."""
    degrees = round(math.degrees(direction), 3) % 360
    words = {0.0: "forward", 90.0: "sideways to the left", 180.0: "backward", 270.0: "sideways to the right"}
    side = "left" if degrees < 180 else "right"
    return words.get(degrees, f"at {fixed(min(degrees, 360 - degrees), 0)}° to the {side} of forward,")


def plan_in_words(design: Design, of_set: SetDesign) -> tuple[str, ...]:
    """What to drive of a set, a line for each chosen command, with how often."""
    return tuple(
        f"{drive_in_words(design.candidate(chosen.command))}, {plural(chosen.runs, 'time')}" for chosen in of_set.chosen
    )


def motions_in_words(of_set: SetDesign) -> str:
    """Precision of odometry that the chosen runs promise, in words."""
    left = [
        f"{significant(each.position_mm, 2)} mm and {significant(each.heading_deg, 2)}° after {each.motion}"
        for each in of_set.step.motions
    ]
    return f"Calibrated from these runs, the matrix leaves an error of {listing(left)} (standard deviations)."


def duration_in_words(seconds: float) -> str:
    """A duration of driving, in s, or in min from 120 s on."""
    return f"{significant(seconds, 3)} s" if seconds < 120 else f"{fixed(seconds / 60, 1)} min"


def effort_in_words(effort: Effort) -> str:
    """An effort as ``6 runs, 33.5 s, 6.7 m``."""
    runs = plural(effort.runs, "run")
    return f"{runs}, {duration_in_words(effort.seconds)}, {significant(effort.metres, 3)} m"


def origin_in_words(design: Design) -> str:
    """Origin of candidates and noise, so that nobody takes an assumption for a measurement."""
    if design.recorded:
        kind = "simulated recordings" if design.simulated else "recordings"
        return f"candidates: commands of {kind}; noise {design.noise_source}"
    return f"candidates: commands as designed, nothing recorded; noise {design.noise_source}"


def choice_in_words(design: Design, of_set: SetDesign) -> str:
    """Efficiency of a set's chosen runs against the bound that no design exceeds, in words."""
    runs = plural(of_set.step.effort.runs, "run")
    share = percent(of_set.step.efficiency, 2)
    lost = percent(1 - of_set.step.efficiency, 2)
    bound = f"{share} of the bound that no design from these {plural(len(of_set.commands), 'command')} exceeds"
    if design.runs_asked is not None:
        return f"{runs}, as asked for, reach {bound}."
    if of_set.reached:
        return f"{runs} are within 1 % of the D-optimum: they reach {bound} (at most {lost} is lost)."
    return f"No design found is within 1 % of the bound; the best, of {runs}, reaches {bound}."


def equal_in_words(design: Design, of_set: SetDesign, use: Use) -> str:
    """Number of runs of a set that give as much information as the baseline, in words."""
    equal = next(equal for equal in of_set.equivalents if equal.use == use)
    if equal.least is None:
        return "none: they leave part of the matrix undetermined"
    least = f"{least_in_words(equal.least)} {UNIT_OF_COST[design.per]}"
    if equal.effort is None:
        return f"none within the repetitions allowed (no design does it below {least})"
    return f"{effort_in_words(equal.effort)} (no design does it below {least})"


def headline(design: Design) -> str:
    """The answer, a sentence for each set."""
    return " ".join(_verdict(design, of_set) for of_set in design.sets)


def _verdict(design: Design, of_set: SetDesign) -> str:
    equal = next(equal for equal in of_set.equivalents if equal.use == design.use)
    runs, chosen = plural(of_set.step.effort.runs, "run"), plural(len(of_set.chosen), "command")
    words = f"{drive(design, of_set)} {runs} of {chosen}; together they give "
    if of_set.reached:
        commands = f"{len(of_set.commands)} {noun_for(len(of_set.commands), 'command')}"
        words += f"as much information per {design.per} as the best design from {commands}, within 1 %"
    else:
        words += f"{percent(of_set.step.efficiency)} of the best design's information per {design.per}"
    if equal.effort is not None:
        give = "gives" if equal.effort.runs == 1 else "give"
        runs = count(equal.effort.runs)
        words += f"; {runs} of the best runs {give} as much as the baseline's {baseline_runs(design)}"
    return words + "."


def drive(design: Design, of_set: SetDesign) -> str:
    """``Drive``, with the name of the set where there are several."""
    return f"{of_set.name}: drive" if len(design.sets) > 1 else "Drive"


def least_in_words(least: float) -> str:
    """A lower bound to a tenth, rounded down so that it stays one."""
    return fixed(math.floor(10 * least) / 10, 1)


def baseline_runs(design: Design) -> str:
    """Number of the baseline's runs."""
    return count(design.baseline.precision.effort.runs)
