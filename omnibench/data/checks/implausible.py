"""Warnings of a recording: the explanation of its misfit to the design model, by units and wheels, if one stands out.

The angle of one wheel may make the wheels contradict each other, whatever the reference is. Of a robot that has more
drive signals than ways to move, a twist gives signals in the range of E Z only (E: from twist to signals, Z: the twists
in which no fixed wheel slides). What lies outside is noise, slip and design; or one wheel that is misread, which the
others outvote in the odometry: 10 degrees of one of four leave a misfit of 0.03 there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import product

import numpy as np

from omnibench.data.checks.finding import Finding
from omnibench.data.checks.misread_search import beyond_twists
from omnibench.data.checks.misreading import (
    DEGREE,
    EXPLAINED,
    POSITION_UNITS,
    RATE_UNITS,
    Explanation,
    Misreading,
    Reading,
    Recording,
    another_zero,
    arrangements,
    clockwise,
    farthest_steered,
    frozen_steering,
    gear,
    groups,
    headings_in_degrees,
    in_degrees,
    positions_in,
    scaled,
    simple_readings,
    warning_of,
    wrong_unit,
)
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import WheelLog

_TURN = 2 * math.pi
# Factors of steering angles that are tried, 1.5 apart, then 1.1; nearer to 1 than 1.8 is what a calibration is for. The
# smallest makes the farthest angle _LEAST_STEERED, less than which no robot steers (chosen).
_NEAREST, _LARGEST, _APART, _LEAST_STEERED = 1.8, 20.0, 1.5, 0.1
_FINER = 1.1 ** np.arange(-2, 3)
_ALIKE = 1.25  # a factor nearer to that of degrees is taken for it; chosen: designs are not off by more
# Share of the misfit that may remain as degrees where the angles are beyond a whole turn, which few wheels can steer
# (chosen): OptiOdom's tricycle is far off its design, and half the misfit of its angles in degrees remains as rad.
_REMAINS = 0.7
# Zeros of steering angles that are tried, degrees, halving the last steps; and the least that is warned of. Smaller
# ones are what a calibration is for: OptiOdom's tricycle is 1 degree off.
_ZEROS, _STEPS, _LEAST_ZERO = range(-80, 81, 20), (10.0, 5.0, 2.5, 1.25), 5.0
# Rows 3 of the design, as shares, than which a wrong zero must fit better, and how much (chosen): on curves to one side
# alone it cannot be told from another wheelbase.
_TURNS, _BETTER = np.linspace(0.6, 1.6, 11), 1.5
# Share of the signals outside of the range (chosen): 10 degrees of one of four wheels leave 0.06; radii all 5 %
# off the design leave 0.04, of which no single wheel explains much.
_CONTRADICTING = 0.03


def odd_gears(recording: Recording) -> list[Explanation]:
    """Steering angles that are too large or too small by a factor, as degrees are and angles in front of a gear."""
    names = recording.robot.drive.steered
    if not names:
        return []

    def misfit(share: float) -> float:
        return recording.read(Reading(factors=share)).misfit

    farthest = farthest_steered(recording.logs)
    # Factors of steering angles of up to ``widest``, rad, that are tried.
    widest = float(farthest.max())
    smallest = min(_LEAST_STEERED / widest, 1 / _LARGEST) if widest > 0 else 1 / _LARGEST
    steps = math.ceil(math.log(1 / _NEAREST / smallest, _APART)), math.ceil(math.log(_LARGEST / _NEAREST, _APART))
    coarse = min(
        [*np.geomspace(smallest, 1 / _NEAREST, 1 + steps[0]), *np.geomspace(_NEAREST, _LARGEST, 1 + steps[1])],
        key=misfit,
    )
    least, share = min((misfit(share), share) for share in (coarse * _FINER).tolist())
    beyond = [in_degrees(names, group) for group in groups(len(names))[1:] if farthest @ group > _TURN]
    single = [Explanation(reading.mistakes, recording.read(reading).misfit) for reading in beyond]
    if DEGREE / _ALIKE < share < DEGREE * _ALIKE:
        remains = _REMAINS if farthest.max() > _TURN else EXPLAINED
        degrees = in_degrees(names, np.ones(len(names))).mistakes
        return [Explanation(degrees, misfit(DEGREE), unit=True, may_remain=remains), *single]
    return [Explanation(gear(share).mistakes, least), *single]


def odd_zeros(recording: Recording) -> list[Explanation]:
    """Steering angles whose zero is not straight ahead: of all wheels together and of each."""
    names = recording.robot.drive.steered
    if not names:
        return []
    explanations = []
    for group in groups(len(names)):
        offset, misfit = best_zero(group, lambda reading: recording.read(reading).misfit)
        if offset:
            explanations.append(Explanation(another_zero(recording.robot, group, offset).mistakes, misfit))
    best = min((explanation.misfit for explanation in explanations), default=math.inf)
    design = recording.design
    turning = recording.misfits(design * np.array([[[1.0], [1.0], [share]] for share in _TURNS]))
    return [] if turning.min() <= _BETTER * best else explanations


def frozen(recording: Recording) -> list[Finding]:
    """Steering angles that never change, as those do that a driver fills in; empty if there are none."""
    angles = [log.steering for log in recording.logs if log.steering is not None]
    if not angles:
        return []
    spans = np.ptp(np.concatenate(angles), axis=0).tolist()
    names = [name for name, span in zip(recording.robot.drive.steered, spans, strict=True) if not span]
    return [frozen_steering(names)] if names else []


def best_zero(group: Array, misfit: Callable[[Reading], float]) -> tuple[int, float]:
    """Degrees to add to the steering angles of a group (S,) of 0 and 1 with least misfit, 0 if few; and that misfit."""

    def shifted(degrees: float) -> float:
        return misfit(Reading(offsets=degrees * DEGREE * group))

    best, least = min(((float(zero), shifted(zero)) for zero in _ZEROS), key=lambda pair: pair[1])
    for step in _STEPS:
        for degrees in (best - step, best + step):
            if (found := shifted(degrees)) < least:
                best, least = degrees, found
    return (round(best) if abs(best) >= _LEAST_ZERO else 0), least


def contradictions(recording: Recording) -> list[Finding]:
    """The steered wheel whose angle, read otherwise, lets the wheels agree; empty if there is none."""
    drive = recording.robot.drive
    outside = beyond_twists(recording.robot)
    present = _share(recording, outside)
    if max(drive.pairs) < 1 or present < _CONTRADICTING:  # one steered wheel may be as wrong as all others together
        return []

    def share(reading: Reading) -> float:
        return _share(recording.read(reading), outside)

    readings: list[Reading] = []
    for group in np.eye(len(drive.steered)):
        zero, _ = best_zero(group, share)
        readings += [clockwise(drive.steered, group), in_degrees(drive.steered, group)]
        readings += [another_zero(recording.robot, group, zero)] if zero else []
    best = min(readings, key=share)
    if share(best) >= EXPLAINED * present:
        return frozen(recording)
    return [mistake.finding() for mistake in best.mistakes]


def _share(recording: Recording, outside: Array) -> float:
    """Share of the drive signals that no twist gives."""
    signals = np.concatenate(
        [log.signals * np.sqrt(np.diff(log.times, prepend=0.0))[:, None] for log in recording.logs]
    )
    whole = float(np.linalg.norm(signals))
    return float(np.linalg.norm(signals @ outside)) / whole if whole else 0.0


# Misfit of the design model (chosen): errors of calibration, slip and noise stay below, wrong units and wheels do not.
_SUSPICIOUS = 0.15
# A wrong zero of steering angles shows in less: all of a swerve base 10 degrees off leave 0.07; chosen so that a
# drive whose dimensions are 5 % off stays below.
_SUSPICIOUS_ZERO = 0.05
# A factor that is fitted is told in the place of a unit's that leaves more than this misfit, and this many times more
# (chosen): next to those of rpm and deg/s a gear is told by the rest that they leave.
_EXACT, _FAR_BETTER = 0.05, 0.5


def implausible(robot: Robot, logs: Sequence[WheelLog], poses: Sequence[Array]) -> list[str]:
    """Warnings about units, wheels and steering, from a comparison of the reference with the design model's odometry.

    ``poses`` (K, 3) of each log are as recorded, at the log's stamps; headings may be wrapped.
    """
    if not any(log.rates.any() for log in logs):
        return ["the wheels never turn; check the omega_* columns"]
    findings, unit = _found(Recording.of(robot, logs, poses))
    return [warning_of(robot, finding, unit=unit) for finding in findings]


def _found(recording: Recording) -> tuple[list[Finding], bool]:
    """Findings of a recording, and whether they are of units."""
    if recording.misfit < _SUSPICIOUS_ZERO:
        return contradictions(recording), False
    zeros = odd_zeros(recording)
    if recording.misfit < _SUSPICIOUS:
        best = None if (found := contradictions(recording)) else _best(recording, zeros)
    else:
        units, gears, high = odd_units(recording), odd_gears(recording), ticks(recording)
        single = [each for each in (*units, *gears) if each.unit and len(each.mistakes) == 1]  # the simplest first
        best = _best(recording, single, [*zeros, *high])
        best = best or _best(recording, [*units, *gears, *odd_wheels(recording), *zeros, *high])
        found = [] if best else contradictions(recording) or frozen(recording)
    return ([mistake.finding() for mistake in best.mistakes], best.unit) if best else (found, False)


def _best(
    recording: Recording, explanations: Sequence[Explanation], fitted: Sequence[Explanation] = ()
) -> Explanation | None:
    """The best explanation, if it explains the misfit; none if a fitted one is far better."""
    best = min(explanations, key=lambda explanation: explanation.misfit, default=None)
    if best is None or best.misfit >= best.may_remain * recording.misfit:
        return None
    better = any(each.misfit < _FAR_BETTER * best.misfit for each in fitted)
    return None if best.misfit > _EXACT and better else best


# An explanation that changes more must fit better by this share than a simpler one (chosen); wheels on one side of a
# skid-steered robot turn almost alike.
_AS_GOOD = 1.1
# Factors of rates about the one by which the reference moves less than the wheels (chosen: its way is cut short and
# noisy); and the largest: a robot whose wheels turn slower by less than 1.8 has another radius.
_RATE_FACTORS, _LEAST_FACTOR = np.geomspace(0.6, 1.6, 31), 0.55

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
    misfits = recording.read(Reading(rate_factors=rough)).misfits(_RATE_FACTORS[:, None, None] * recording.design)
    names = recording.robot.wheel_names
    mistake = scaled(names, np.ones(len(names)), 1 / (rough * float(_RATE_FACTORS[misfits.argmin()])))
    return [Explanation((mistake,), float(misfits.min()), unit=True)]
