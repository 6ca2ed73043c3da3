"""The verdict on a calibration by runs that it was not fitted to, in the words with which the commands end."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Literal

import numpy as np

from omnibench.data.dataset import WHEEL_DIGITS, Dataset, Trajectory
from omnibench.fit.cost import NO_ERROR
from omnibench.fit.observations.reference_errors import measured_parts
from omnibench.fit.uncertainty.ratio_intervals import FEWEST, Bootstrap, Interval, RatioIntervals, Units, units_of
from omnibench.robot.calibration import HeldOutVerdict
from omnibench.robot.kinematics import Array
from omnibench.words import noun_for, plural

_SHOWN = 6  # runs that are named; the rest are counted (chosen: two lines of a terminal)
_MEANINGS = {"better": "better than the design", "worse": "worse than the design: do not use"}
_BASES = {"held_out": "held out", "cross_validation": "cross-validated"}
_HOLD_OUT = (
    "keep runs for validation (omnibench import ... --set validation=PATTERN), or evaluate the calibration on a "
    "recording that it was not fitted to (omnibench evaluate CALIBRATION DATASET)"
)


def nothing_held_out(reason: str = "no run was held out") -> HeldOutVerdict:
    """The verdict where no run was held out."""
    sentence = f"{reason}: whether the calibration is better than the design on other runs cannot be said"
    return HeldOutVerdict(verdict="unknown", sentence=sentence, detail=f"to have it said, {_HOLD_OUT}")


def unfitted_runs(dataset: Dataset, fitted: Collection[str]) -> tuple[Trajectory, ...]:
    """The runs of a data set that are not among those fitted to another, which are given by their fingerprints.

    A run with the wheel samples of a fitted run is that run with a reference made anew, unless fitted runs share theirs
    (commanded rates, or simulated ones without noise).
    """
    runs, wheels = set(fitted), {fingerprint[:WHEEL_DIGITS] for fingerprint in fitted}
    if len(wheels) < len(runs):
        return tuple(run for run in dataset.trajectories if run.fingerprint not in runs)
    return tuple(run for run in dataset.trajectories if run.fingerprint[:WHEEL_DIGITS] not in wheels)


def judge(
    design: Array,
    calibrated: Array,
    runs: Sequence[Trajectory],
    bootstrap: Bootstrap | None = None,
    basis: Literal["held_out", "cross_validation"] = "held_out",
) -> HeldOutVerdict:
    """The verdict by the final pose errors (Z, 3), m, m, rad, of the design values and of the calibration.

    Of runs without poses they are what ``final_errors`` of evaluate.py says. basis: as in HeldOutVerdict.
    """
    if not runs:
        return nothing_held_out()
    bootstrap = bootstrap or Bootstrap()
    units = units_of(runs, bootstrap.unit)
    costs, before = np.linalg.norm(calibrated, axis=1), np.linalg.norm(design, axis=1)  # Eq. (6), run by run
    gain = RatioIntervals(bootstrap).improvement(costs, before, units, NO_ERROR)
    low, high = (None, None) if gain is None else (gain.low, gain.high)
    verdict: Literal["better", "worse", "undecided"] = "undecided"
    if low is not None and high is not None and not (low <= 0 <= high):
        verdict = "better" if low > 0 else "worse"
    placed, turned = measured_parts(runs)
    positions = [
        float(np.hypot(errors[:, 0], errors[:, 1])[placed].mean()) for errors in (design, calibrated) if placed.any()
    ]
    headings = [float(np.abs(errors[:, 2])[turned].mean()) for errors in (design, calibrated) if turned.any()]
    changes = [*([_lengths(*positions)] if positions else []), *([_angles(*headings)] if headings else [])]
    meaning = (
        _MEANINGS[verdict] if verdict != "undecided" else _undecided(gain, units, same=bool((costs == before).all()))
    )
    return HeldOutVerdict(
        basis=basis,
        verdict=verdict,
        runs=tuple(run.id for run in runs),
        design_position_m=positions[0] if positions else None,
        position_m=positions[1] if positions else None,
        design_heading_rad=headings[0] if headings else None,
        heading_rad=headings[1] if headings else None,
        improvement=None if gain is None else gain.value,
        low=low,
        high=high,
        unit=units.name,
        units=units.count,
        method=units.method,
        sentence=f"{_BASES[basis]} ({plural(len(runs), 'run')}): {', '.join([*changes, meaning])}",
        detail=f"{_gain_in_words(gain, units)}{noun_for(len(runs), 'run')}: {_named(runs)}",
    )


def _undecided(gain: Interval | None, units: Units, same: bool) -> str:
    """Why held-out runs leave it undecided whether the calibration is better or worse."""
    if same:
        return "the same as the design"
    if gain is None:
        return "undecided: the design values have no error there to be improved"
    if units.count < FEWEST:
        return f"undecided: {plural(units.count, units.name)} cannot show it, hold out {FEWEST} or more"
    if gain.known is None:
        return f"undecided: the {noun_for(units.count, units.name)} differ too much for an interval"
    return "undecided: chance alone can explain the difference"


def _gain_in_words(gain: Interval | None, units: Units) -> str:
    """The improvement of Eq. (6) with its interval and what that rests on; empty where there is none."""
    if gain is None:
        return ""
    basis = units.words
    if gain.known is not None:
        low, high = sorted(end if gain.value >= 0 else -end for end in gain.known)
        basis = f"95 % interval {100 * low:.1f} to {100 * high:.1f} %, {units.words}"
    return f"Eq. (6) {'falls' if gain.value >= 0 else 'rises'} by {100 * abs(gain.value):.1f} % ({basis}); "


def _named(runs: Sequence[Trajectory]) -> str:
    rest = f" and {len(runs) - _SHOWN} more" if len(runs) > _SHOWN else ""
    return ", ".join(run.id for run in runs[:_SHOWN]) + rest


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
