"""A design in words: commands, efforts and sentences that the terminal and the report share."""

from __future__ import annotations

import math
from collections.abc import Mapping

from omnibench.design.config import Per, Use
from omnibench.design.result import Candidate, Design, Effort, SetDesign
from omnibench.report.motions import motion_in_words
from omnibench.report.numbers import count, fixed, percent, significant
from omnibench.words import noun_for, plural

USE_IN_WORDS: Mapping[Use, str] = {"final": "final poses", "trajectory": "whole trajectories"}
UNIT_OF_COST: Mapping[Per, str] = {"run": "runs", "second": "s", "metre": "m of wheel"}


def command_in_words(candidate: Candidate) -> str:
    return motion_in_words(candidate.name, candidate.speed, candidate.direction, candidate.turn_rate)


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
    words = f"{of_set.name}: {plural(of_set.step.effort.runs, 'run')} of {plural(len(of_set.chosen), 'command')} give "
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


def least_in_words(least: float) -> str:
    """A lower bound to a tenth, rounded down so that it stays one."""
    return fixed(math.floor(10 * least) / 10, 1)


def baseline_runs(design: Design) -> str:
    """Number of the baseline's runs."""
    return count(design.baseline.precision.effort.runs)
