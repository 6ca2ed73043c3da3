"""What may be wrong with the steering angles of a recording, and the misfit that remains if it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from omnibench.data.checks.misfit import EXPLAINED, Explanation, Reading, Recording, listed, rounded, times
from omnibench.robot.kinematics import Array

DEGREE, _TURN = math.pi / 180, 2 * math.pi
IN_DEGREES = "steering angles look like degrees; steer_* must be rad (import with --set steering_unit=deg)"
# Factors of steering angles that are tried, 1.5 apart, then 1.1; nearer to 1 than 1.8 is what a calibration is for. The
# smallest makes the farthest angle _LEAST_STEERED, less than which no robot steers (chosen).
_NEAREST, _LARGEST, _APART, _LEAST_STEERED = 1.8, 20.0, 1.5, 0.1
_FINER = 1.1 ** np.arange(-2, 3)
_FEWEST_TICKS = 100  # of a turn of the wheel, from which on they are named first (chosen)
_ALIKE = 1.25  # a factor nearer to that of degrees is taken for it; chosen: designs are not off by more
# Share of the misfit that may remain as degrees where the angles are beyond a whole turn, which few wheels can steer
# (chosen): OptiOdom's tricycle is far off its design, and half the misfit of its angles in degrees remains as rad.
_REMAINS = 0.7
# Zeros of steering angles that are tried, degrees, halving the last steps; and the least that is warned of. Smaller
# ones are what a calibration is for: OptiOdom's tricycle is 1 degree off.
_ZEROS, _STEPS, LEAST_ZERO = range(-80, 81, 20), (10.0, 5.0, 2.5, 1.25), 5.0
# Rows 3 of the design, as shares, than which a wrong zero must fit better, and how much (chosen): on curves to one side
# alone it cannot be told from another wheelbase.
_TURNS, _BETTER = np.linspace(0.6, 1.6, 11), 1.5


def odd_gears(recording: Recording) -> list[Explanation]:
    """Steering angles that are too large or too small by a factor, as degrees are and angles in front of a gear."""
    names = recording.robot.drive.steered
    if not names:
        return []

    def misfit(share: float) -> float:
        return recording.reread(steering=times(share)).misfit

    coarse = min(_shares(recording.farthest_steered), key=misfit)
    least, share = min((misfit(share), share) for share in (coarse * _FINER).tolist())
    explanations = [Explanation((in_degrees(names, wheel),), left) for wheel, left in _single_degrees(recording)]
    if DEGREE / _ALIKE < share < DEGREE * _ALIKE:
        remains = _REMAINS if recording.farthest_steered > _TURN else EXPLAINED
        return [Explanation((IN_DEGREES,), misfit(DEGREE), unit=True, may_remain=remains), *explanations]
    return [Explanation((_gear_in_words(share),), least), *explanations]


def _shares(farthest: float) -> list[float]:
    """Factors of steering angles of up to ``farthest``, rad, that are tried."""
    least = min(_LEAST_STEERED / farthest, 1 / _LARGEST) if farthest > 0 else 1 / _LARGEST
    steps = math.ceil(math.log(1 / _NEAREST / least, _APART)), math.ceil(math.log(_LARGEST / _NEAREST, _APART))
    return [*np.geomspace(least, 1 / _NEAREST, 1 + steps[0]), *np.geomspace(_NEAREST, _LARGEST, 1 + steps[1])]


def _gear_in_words(share: float) -> str:
    """The warning of steering angles that are to be taken times ``share``."""
    factor, size = (1 / share, "large") if share < 1 else (share, "small")
    words, count = f"steering angles look about {rounded(factor)} times too {size}", _TURN / share
    scale = f"--set steering_scale={share:.2g}, times the present one"
    if count > _FEWEST_TICKS:
        words += f", as ticks would be at about {rounded(count)} a turn of the wheel"
        options = f"--set steering_unit=ticks --set steering_ticks_per_turn=N; or {scale}"
    else:
        words += "; is there a gear between the encoder and the wheel?"
        options = f"{scale}; or steering_unit; or calibrate with --steering fit"
    return f"{words} (import with {options})"


def _single_degrees(recording: Recording) -> list[tuple[int, float]]:
    """Each of several steered wheels whose angles are beyond a turn, and the misfit if these are degrees."""
    farthest = np.max([np.abs(log.steering).max(axis=0) for log in recording.logs if log.steering is not None], axis=0)
    beyond = np.flatnonzero(farthest > _TURN).tolist() if len(farthest) > 1 else []
    return [(wheel, recording.reread(steering=scaled(wheel, len(farthest), DEGREE)).misfit) for wheel in beyond]


def in_degrees(names: Sequence[str], wheel: int) -> str:
    """The warning of one of the steered wheels whose angle is in degrees."""
    scales = ",".join(f"{DEGREE:.7f}" if index == wheel else "1" for index in range(len(names)))
    return (
        f"the steering angle of wheel {names[wheel]} looks like degrees; steer_{names[wheel]} must be rad (import "
        f"with --set steering_scale=[{scales}], times the present ones)"
    )


def clockwise(which: str, signs: Sequence[int]) -> str:
    """The warning of steering angles of which wheels (of all: ``signs``) count the wrong way round."""
    return (
        f"the steering angle of {which} looks counted clockwise; it must count counter-clockwise (import "
        f"with --set steering_signs={listed(signs)}, times the present ones)"
    )


def scaled(wheel: int, count: int, factor: float) -> Reading:
    """The reading with one of ``count`` columns times a factor."""
    return lambda values: values * np.where(np.arange(count) == wheel, factor, 1.0)


def odd_zeros(recording: Recording) -> list[Explanation]:
    """Steering angles whose zero is not straight ahead: of all wheels together and of each."""
    names = recording.robot.drive.steered
    if not names:
        return []
    groups = [np.ones(len(names))] + [row for row in np.eye(len(names)) if len(names) > 1]
    explanations = []
    for group in groups:
        offset, misfit = best_zero(group, lambda reading: recording.reread(steering=reading).misfit)
        if abs(offset) >= LEAST_ZERO:
            explanations.append(Explanation((zero_in_words(recording, group, round(offset)),), misfit))
    best = min((explanation.misfit for explanation in explanations), default=math.inf)
    design = recording.design
    turning = recording.misfits(design * np.array([[[1.0], [1.0], [share]] for share in _TURNS]))
    return [] if turning.min() <= _BETTER * best else explanations


def frozen(recording: Recording) -> list[str]:
    """A warning of steering angles that never change, as those do that a driver fills in; empty if there are none."""
    steering = np.concatenate(
        [log.steering for log in recording.logs if log.steering is not None] or [np.empty((0, 0))]
    )
    steered = recording.robot.drive.steered
    names = [name for name, angles in zip(steered, steering.T, strict=True) if not np.ptp(angles)]
    if not names:
        return []
    columns = ", ".join(f"steer_{name}" for name in names)
    return [
        f"{columns} never changes, which the reference contradicts; is that steering angle measured? (--set "
        "steering_columns=NAME on import; rosbag: steering_joints, steering_topic)"
    ]


def best_zero(group: Array, misfit: Callable[[Reading], float]) -> tuple[float, float]:
    """Degrees to add to the steering angles of a group (S,) of 0 and 1 with least misfit, and that misfit."""

    def shifted(degrees: float) -> float:
        return misfit(lambda values: values + degrees * DEGREE * group)

    best, least = min(((float(zero), shifted(zero)) for zero in _ZEROS), key=lambda pair: pair[1])
    for step in _STEPS:
        for degrees in (best - step, best + step):
            if (found := shifted(degrees)) < least:
                best, least = degrees, found
    return best, least


def zero_in_words(recording: Recording, group: Array, degrees: int) -> str:
    """The warning of a group (S,) of 0 and 1 of steered wheels whose angles lack so many degrees."""
    names = [name for name, chosen in zip(recording.robot.drive.steered, group, strict=True) if chosen]
    which = f"wheel {names[0]}" if len(names) == 1 else f"every wheel ({', '.join(names)})"
    values = listed([degrees if chosen else 0 for chosen in group])
    free = not any(wheel.kind == "fixed" for wheel in recording.robot.wheels) and group.all()
    turned = f"; or the reference is turned: mount: {{yaw_deg: {-degrees}}} of the robot" if free else ""
    return (
        f"the steering angle of {which} looks {abs(degrees)} degrees too {'large' if degrees < 0 else 'small'}, its "
        f"zero not straight ahead (import with --set steering_offsets_deg={values}, added to the present ones{turned})"
    )
