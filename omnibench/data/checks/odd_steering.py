"""What may be wrong with the steering angles of a recording, and the misfit that remains if it is."""

from __future__ import annotations

import math

import numpy as np

from omnibench.data.checks.misfit import EXPLAINED, Explanation, Recording, listed, times
from omnibench.robot.kinematics import Array

DEGREE = math.pi / 180
IN_DEGREES = "steering angles look like degrees; steer_* must be rad (importers csv and rosbag: steering_unit=deg)"
# Factors of steering angles that are tried, 1.5 apart, then 1.1; nearer to 1 than 1.8 is what a calibration is for.
_SHARES = np.concatenate([np.geomspace(0.01, 0.55, 11), np.geomspace(1.8, 20.0, 7)])
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


def odd_gears(recording: Recording) -> list[Explanation]:
    """Steering angles that are too large or too small by a factor, as degrees are and angles in front of a gear."""
    if not recording.robot.drive.steered:
        return []

    def misfit(share: float) -> float:
        return recording.reread(steering=times(share)).misfit

    coarse = min(_SHARES.tolist(), key=misfit)
    least, share = min((misfit(share), share) for share in (coarse * _FINER).tolist())
    if DEGREE / _ALIKE < share < DEGREE * _ALIKE:
        remains = _REMAINS if recording.farthest_steered > 2 * math.pi else EXPLAINED
        return [Explanation((IN_DEGREES,), misfit(DEGREE), unit=True, may_remain=remains)]
    factor, size = (1 / share, "large") if share < 1 else (share, "small")
    words = (
        f"steering angles look about {factor:.2g} times too {size}; is there a gear between the encoder and the wheel? "
        f"(importers csv and rosbag: steering_scale={share:.2g}; or steering_unit)"
    )
    return [Explanation((words,), least)]


def odd_zeros(recording: Recording) -> list[Explanation]:
    """Steering angles whose zero is not straight ahead: of all wheels together and of each."""
    names = recording.robot.drive.steered
    if not names:
        return []
    groups = [np.ones(len(names))] + [row for row in np.eye(len(names)) if len(names) > 1]
    explanations = []
    for group in groups:
        offset, misfit = _best_zero(recording, group)
        if abs(offset) >= _LEAST_ZERO:
            explanations.append(Explanation((_zero_in_words(recording, group, round(offset)),), misfit))
    best = min((explanation.misfit for explanation in explanations), default=math.inf)
    design = recording.design
    turning = recording.misfits(design * np.array([[[1.0], [1.0], [share]] for share in _TURNS]))
    return [] if turning.min() <= _BETTER * best else explanations


def _best_zero(recording: Recording, group: Array) -> tuple[float, float]:
    """Degrees to add to the steering angles of a group (S,) of 0 and 1, and the misfit that remains then."""

    def misfit(degrees: float) -> float:
        return recording.reread(steering=lambda angles: angles + degrees * DEGREE * group).misfit

    best, least = min(((float(zero), misfit(zero)) for zero in _ZEROS), key=lambda pair: pair[1])
    for step in _STEPS:
        for degrees in (best - step, best + step):
            if (found := misfit(degrees)) < least:
                best, least = degrees, found
    return best, least


def _zero_in_words(recording: Recording, group: Array, degrees: int) -> str:
    names = [name for name, chosen in zip(recording.robot.drive.steered, group, strict=True) if chosen]
    which = f"wheel {names[0]}" if len(names) == 1 else f"every wheel ({', '.join(names)})"
    values = listed([degrees if chosen else 0 for chosen in group])
    free = not any(wheel.kind == "fixed" for wheel in recording.robot.wheels) and group.all()
    turned = f"; or the reference is turned: mount: {{yaw_deg: {-degrees}}} of the robot" if free else ""
    return (
        f"the steering angle of {which} looks {abs(degrees)} degrees too {'large' if degrees < 0 else 'small'}, its "
        f"zero not straight ahead (importers csv and rosbag: add {values} to steering_offsets_deg{turned})"
    )
