"""What may be wrong with the units and the wheels of a recording, and the misfit that remains if it is."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations, product

import numpy as np

from omnibench.data.checks.misfit import Explanation, Reading, Recording, listed, rounded, times
from omnibench.data.checks.odd_steering import DEGREE, IN_DEGREES, clockwise
from omnibench.robot.kinematics import Array

# Units that a column may have been recorded in: factor to the SI unit, and warning.
_RATES = (
    (1.0, ""),
    (2 * math.pi / 60, "wheel rates look like rpm; omega_* must be rad/s (import with --set wheel_unit=rpm)"),
    (
        DEGREE,
        "wheel rates look like deg/s; omega_* must be rad/s (import with --set wheel_unit=deg/s, or deg of positions)",
    ),
    (
        2 * math.pi,
        "wheel rates look like turns a second; omega_* must be rad/s (import with --set wheel_unit=rev/s, or "
        "rev of positions)",
    ),
)
HEADINGS_IN_DEGREES = "theta looks like degrees; it must be rad (import with --set heading_unit=deg)"
_HEADINGS = ((1.0, ""), (DEGREE, HEADINGS_IN_DEGREES))
_POSITIONS = (
    (1.0, ""),
    (1e-3, "positions look like mm; x and y must be m (import with --set position_unit=mm)"),
    (1e-2, "positions look like cm; x and y must be m (import with --set position_unit=cm)"),
)
_ARRANGED = 4  # wheels of which every order and sign is tried, at most; of more only one mistake (chosen)
# An explanation that changes more must fit better by this share than a simpler one (chosen); wheels on one side of a
# skid-steered robot turn almost alike.
_AS_GOOD = 1.1
# Factors of rates about the one by which the reference moves less than the wheels (chosen: its way is cut short and
# noisy); and the largest: a robot whose wheels turn slower by less than 1.8 has another radius.
_FINER, _LEAST_FACTOR = np.geomspace(0.6, 1.6, 31), 0.55
_FEWEST_TICKS = 100  # of a turn of the wheel, from which on they are named first (chosen)


def odd_units(recording: Recording) -> list[Explanation]:
    """Every choice of units of rates, positions, headings and steering angles; not of steering angles alone."""
    angles = ((1.0, ""), (DEGREE, IN_DEGREES)) if recording.robot.drive.steered else ((1.0, ""),)
    design = recording.design[None]
    explanations = []
    for (factor, rate), (share, steering) in product(_RATES, angles):
        reading = recording.reread(times(factor), times(share))
        for (metre, position), (radian, heading) in product(_POSITIONS, _HEADINGS):
            texts = tuple(text for text in (rate, steering, heading, position) if text)
            if texts != (IN_DEGREES,):  # which odd_gears tells from a gear
                misfit = float(reading.misfits(design, metre, radian)[0])
                explanations.append(Explanation(texts, misfit, unit=True))
    return explanations


def odd_wheels(recording: Recording) -> list[Explanation]:
    """Wheels that are swapped or counted the wrong way round: the simplest explanation of those that fit best."""
    drive = recording.robot.drive
    if drive.direct and len(drive.wheels) <= _ARRANGED:
        return _arrangement(recording)
    single = [
        Explanation((mistake.words,), recording.reread(mistake.rates, mistake.steering).misfit)
        for mistake in (*_wrong_signs(drive.wheels, drive.steered), *_exchanges(drive.wheels, drive.steered))
    ]
    least = min(explanation.misfit for explanation in single)
    return [next(explanation for explanation in single if explanation.misfit <= _AS_GOOD * least)]


def _arrangement(recording: Recording) -> list[Explanation]:
    """The order and signs of the wheels that explain the reference best."""
    names, design = recording.robot.wheel_names, recording.design
    arrangements = list(product(permutations(range(len(names))), product((1, -1), repeat=len(names))))
    misfits = recording.misfits(np.array([_rearranged(design, order, signs) for order, signs in arrangements]))
    changes = [sum(pair != (wheel, 1) for wheel, pair in enumerate(zip(*each, strict=True))) for each in arrangements]
    good = np.flatnonzero(misfits <= _AS_GOOD * misfits.min())
    best = min(good.tolist(), key=lambda index: (changes[index], misfits[index]))
    order, signs = arrangements[best]
    shown = ", ".join(
        f"{name} <- {'-' if sign < 0 else ''}{names[column]}"
        for name, column, sign in zip(names, order, signs, strict=True)
    )
    columns = ",".join(f"omega_{names[column]}" for column in order)
    options = f"import with --set wheel_columns=[{columns}] --set wheel_signs={listed(signs)}; rosbag: joints"
    if order == tuple(range(len(names))):
        options = _signs(signs)
    warning = f"wheels look swapped or sign-flipped; the reference fits with omega of {shown} ({options})"
    return [Explanation((warning,), float(misfits[best]))]


def _rearranged(matrix: Array, order: Sequence[int], signs: Sequence[int]) -> Array:
    """The columns of ``matrix`` for recordings whose wheel i is signs[i] times column order[i]."""
    result = np.empty_like(matrix)
    for wheel, (column, sign) in enumerate(zip(order, signs, strict=True)):
        result[:, column] = sign * matrix[:, wheel]
    return result


@dataclass(frozen=True)
class _Mistake:
    """A mistake in words, and how rates and steering angles are to be read then."""

    words: str
    rates: Reading | None = None
    steering: Reading | None = None


def _wrong_signs(wheels: Sequence[str], steered: Sequence[str]) -> Iterator[_Mistake]:
    """One wheel or steering angle, or all, counted the wrong way round."""
    for which, signs in _flips(wheels):
        yield _Mistake(f"{which} looks counted the wrong way round ({_signs(signs)})", rates=_columns(signs=signs))
    for which, signs in _flips(steered):
        yield _Mistake(clockwise(which, signs), steering=_columns(signs=signs))


def _signs(signs: Sequence[int]) -> str:
    """The options that turn wheels round, whatever they were on import."""
    return f"import with --set wheel_signs={listed(signs)}, times the present ones; rosbag: joint_signs"


def _exchanges(wheels: Sequence[str], steered: Sequence[str]) -> Iterator[_Mistake]:
    """Two wheels exchanged: their rates, their steering angles, or both."""
    for pair, swap in _swaps(wheels):
        options = "exchange them in --set wheel_columns=[...]; rosbag: joints"
        yield _Mistake(f"the rates of wheels {pair} look swapped ({options})", rates=swap)
    for pair, swap in _swaps(steered):
        options = "exchange them in --set steering_columns=[...]; rosbag: steering_joints"
        yield _Mistake(f"the steering angles of wheels {pair} look swapped ({options})", steering=swap)
    for pair, swap in _swaps(wheels) if tuple(wheels) == tuple(steered) else ():
        options = "exchange them in --set wheel_columns=[...] and steering_columns; rosbag: joints and steering_joints"
        yield _Mistake(f"wheels {pair} look swapped, rates and steering angles ({options})", rates=swap, steering=swap)


def _flips(names: Sequence[str]) -> Iterator[tuple[str, list[int]]]:
    """Each name with the signs (n,) that turn it round, and all of several."""
    for turned, name in enumerate(names):
        yield f"wheel {name}", [-1 if index == turned else 1 for index in range(len(names))]
    if len(names) > 1:
        yield f"every wheel ({', '.join(names)})", [-1] * len(names)


def _swaps(names: Sequence[str]) -> Iterator[tuple[str, Reading]]:
    """Each two names, and their exchange."""
    for first, second in combinations(range(len(names)), 2):
        order = list(range(len(names)))
        order[first], order[second] = second, first
        yield f"{names[first]} and {names[second]}", _columns(order)


def _columns(order: Sequence[int] | None = None, signs: Sequence[int] | None = None) -> Reading:
    """Columns (F, n) in another order, or times signs."""
    chosen = slice(None) if order is None else list(order)
    return lambda values: values[:, chosen] * np.array(signs or 1)


def ticks(recording: Recording) -> list[Explanation]:
    """Rates that are too high by a factor, as ticks in the place of radians are, or turns of a motor."""
    design = recording.design
    moved, driven = recording.moved, recording.driven
    if not 0 < moved < _LEAST_FACTOR * driven:
        return []
    rough = moved / driven
    factors = _FINER[:, None, None]
    misfits = recording.reread(times(rough)).misfits(factors * design)
    factor = rough * float(_FINER[misfits.argmin()])
    words, count = f"wheel rates look about {rounded(1 / factor)} times too high", 2 * math.pi / factor
    options = (
        f"--set gear_ratio={rounded(1 / factor)}, where the encoder is at the motor, or so many times the "
        "ticks_per_turn, which counts edges (4 a pulse)"
    )
    if count > _FEWEST_TICKS:
        words += f", as ticks would be at about {rounded(count)} a turn of the wheel"
        options = f"--set wheel_unit=ticks --set ticks_per_turn=N, with /s or /sample behind ticks; or {options}"
    else:
        words += "; omega_* must be rad/s of the wheel"
    options = f"import with {options}; or correct the radius of the wheels, in m, in robot.yaml"
    return [Explanation((f"{words} ({options})",), float(misfits.min()), unit=True)]
