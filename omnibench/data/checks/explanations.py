"""Explanations by units and wheels: mistakes of these in a recording, and the misfit that remains if they were made."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import numpy as np

from omnibench.data.checks.misfit import Explanation, Recording
from omnibench.data.checks.misreading import (
    POSITION_UNITS,
    RATE_UNITS,
    Misreading,
    Reading,
    arrangements,
    headings_in_degrees,
    positions_in,
    scaled,
    wrong_unit,
)
from omnibench.data.checks.steering_readings import DEGREE, in_degrees, simple_readings

# An explanation that changes more must fit better by this share than a simpler one (chosen); wheels on one side of a
# skid-steered robot turn almost alike.
_AS_GOOD = 1.1
# Factors of rates about the one by which the reference moves less than the wheels (chosen: its way is cut short and
# noisy); and the largest: a robot whose wheels turn slower by less than 1.8 has another radius.
_FINER, _LEAST_FACTOR = np.geomspace(0.6, 1.6, 31), 0.55

_Unit = tuple[float, tuple[Misreading, ...]]
"""A unit in SI units, and the mistake of having recorded in it."""


def odd_units(recording: Recording) -> list[Explanation]:
    """Every choice of units of rates, positions, headings and steering angles; not of steering angles alone."""
    names = recording.robot.drive.steered
    rates = _or_right((1 / size, wrong_unit(unit)) for size, unit in RATE_UNITS)
    angles = _or_right((DEGREE, mistake) for mistake in in_degrees(names, np.ones(len(names))).mistakes if names)
    headings = _or_right([(DEGREE, headings_in_degrees())])
    positions = _or_right((1 / size, positions_in(unit)) for size, unit in POSITION_UNITS)
    explanations = []
    for (factor, rate), (share, steering) in product(rates, angles):
        read = recording.read(Reading(factors=share, rate_factors=factor))
        for (metre, position), (radian, heading) in product(positions, headings):
            mistakes = (*rate, *steering, *heading, *position)
            if not steering or len(mistakes) > 1:  # odd_gears tells steering angles in degrees from a gear
                misfit = float(read.misfits(recording.design[None], metre, radian)[0])
                explanations.append(Explanation(mistakes, misfit, unit=True))
    return explanations


def _or_right(units: Iterable[tuple[float, Misreading]]) -> list[_Unit]:
    return [(1.0, ()), *((size, (mistake,)) for size, mistake in units)]


def odd_wheels(recording: Recording) -> list[Explanation]:
    """Wheels that are swapped or counted the wrong way round: the simplest explanation of those that fit best."""
    if recording.robot.drive.direct:
        transforms = list(arrangements(recording.robot))
        orders = np.array([each.columns for each in transforms])
        misfits = recording.misfits(recording.design @ np.swapaxes(orders, 1, 2)).tolist()
        found = [(each.cost, misfit, each.mistakes) for each, misfit in zip(transforms, misfits, strict=True)]
    else:
        readings = list(simple_readings(recording.robot))
        found = [(each.cost, recording.read(each).misfit, each.mistakes) for each in readings]
    least = min(misfit for _, misfit, _ in found)
    _, misfit, mistakes = min((each for each in found if each[1] <= _AS_GOOD * least), key=lambda each: each[:2])
    return [Explanation(mistakes, misfit)]


def ticks(recording: Recording) -> list[Explanation]:
    """Rates that are too high by a factor, as ticks in the place of radians are, or turns of a motor."""
    moved, driven = recording.moved, recording.driven
    if not 0 < moved < _LEAST_FACTOR * driven:
        return []
    rough = moved / driven
    misfits = recording.read(Reading(rate_factors=rough)).misfits(_FINER[:, None, None] * recording.design)
    names = recording.robot.wheel_names
    mistake = scaled(names, np.ones(len(names)), 1 / (rough * float(_FINER[misfits.argmin()])))
    return [Explanation((mistake,), float(misfits.min()), unit=True)]
