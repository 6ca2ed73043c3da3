"""The verdict on a calibration by runs that it was not fitted to, in the words with which the commands end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.fit.uncertainty.ratio_intervals import FEWEST, Bootstrap, RatioIntervals, units_of
from omnibench.robot.calibration import HeldOutVerdict
from omnibench.robot.kinematics import Array
from omnibench.words import noun_for, plural

_SHOWN = 6  # runs that are named; the rest are counted (chosen: two lines of a terminal)
_HOLD_OUT = (
    "keep runs for validation (omnibench import ... --set validation=PATTERN), or evaluate the calibration on a "
    "recording that it was not fitted to (omnibench evaluate CALIBRATION DATASET)"
)


def nothing_held_out(reason: str = "no run was held out") -> HeldOutVerdict:
    """The verdict where no run was held out."""
    sentence = f"{reason}: whether the calibration is better than the design on other runs cannot be said"
    return HeldOutVerdict(verdict="unknown", sentence=sentence, detail=f"to have it said, {_HOLD_OUT}")


def judge(
    design: Array, calibrated: Array, runs: Sequence[Trajectory], bootstrap: Bootstrap | None = None
) -> HeldOutVerdict:
    """The verdict by the final pose errors (Z, 3), m, m, rad, of the design values and of the calibration."""
    if not runs:
        return nothing_held_out()
    bootstrap = bootstrap or Bootstrap()
    units = units_of(runs, bootstrap.unit)
    costs, before = np.linalg.norm(calibrated, axis=1), np.linalg.norm(design, axis=1)  # Eq. (6), run by run
    gain = RatioIntervals(bootstrap).improvement(costs, before, units)
    ends = None if gain is None else gain.known
    verdict: Literal["better", "worse", "undecided"] = "undecided"
    if ends is not None and not (ends[0] <= 0 <= ends[1]):
        verdict = "better" if ends[0] > 0 else "worse"
    positions = [float(np.hypot(errors[:, 0], errors[:, 1]).mean()) for errors in (design, calibrated)]
    headings = [float(np.abs(errors[:, 2]).mean()) for errors in (design, calibrated)]
    position, heading = _lengths(*positions), _angles(*headings)
    meaning = {
        "better": "better than the design",
        "worse": "worse than the design: do not use",
        "undecided": "undecided: chance alone can explain the difference",
    }[verdict]
    if verdict == "undecided" and ends is None:
        meaning = "undecided: the commands or runs differ too much for an interval"
        if gain is None:
            meaning = "undecided: the design values have no error there to be improved"
        elif units.count < FEWEST:
            meaning = f"undecided: {plural(units.count, units.name)} cannot show it, hold out {FEWEST} or more"
    change = (
        "" if gain is None else f"Eq. (6) {'falls' if gain.value >= 0 else 'rises'} by {100 * abs(gain.value):.1f} %"
    )
    basis = units.words
    if ends is not None and gain is not None:
        low, high = ends if gain.value >= 0 else (-ends[1], -ends[0])
        basis = f"95 % interval {100 * low:.1f} to {100 * high:.1f} %, {units.words}"
    named = ", ".join(run.id for run in runs[:_SHOWN])
    rest = f" and {len(runs) - _SHOWN} more" if len(runs) > _SHOWN else ""
    return HeldOutVerdict(
        verdict=verdict,
        runs=tuple(run.id for run in runs),
        design_position_m=positions[0],
        position_m=positions[1],
        design_heading_rad=headings[0],
        heading_rad=headings[1],
        improvement=None if gain is None else gain.value,
        low=None if ends is None else ends[0],
        high=None if ends is None else ends[1],
        unit=units.name,
        units=units.count,
        method=units.method,
        sentence=f"held out ({plural(len(runs), 'run')}): {position}, {heading}, {meaning}",
        detail=f"{change and f'{change} ({basis}); '}{noun_for(len(runs), 'run')}: {named}{rest}",
    )


def _lengths(before: float, after: float) -> str:
    """Two lengths in the unit and with the decimals that show the larger and the smaller: ``22 mm -> 33 mm``."""
    factor, unit = (1.0, "m") if max(before, after) >= 1 else (1e3, "mm")
    return _change(factor * before, factor * after, unit)


def _angles(before: float, after: float) -> str:
    return _change(math.degrees(before), math.degrees(after), "deg")


def _change(before: float, after: float, unit: str) -> str:
    smaller = min(value for value in (before, after, 1e3) if value > 0)
    decimals = min(3, max(0, 1 - math.floor(math.log10(smaller))))
    return f"{before:.{decimals}f} {unit} -> {after:.{decimals}f} {unit}"
