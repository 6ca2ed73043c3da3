"""Mechanics of a simulated robot behind effects of steering, casters and grip, on code of its own.

The effects that find these in recordings (robot/effects/steering_angle.py, slip.py, drift.py) are to first order and
see samples only. Here a flank of the gear pushes the wheel, a lag is a differential equation, and a caster is drawn
along by its pivot:

    d(beta)/dt = -(abs(V) / L) sin(beta - gamma) - w,                                                   (1)

beta being the direction from where the caster's wheel touches the floor to its pivot, relative to the robot, gamma that
of the pivot's velocity V, w the robot's rate of turn, and L the trail.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from omnibench.robot.effects.effect import Values
from omnibench.robot.kinematics import Array, Robot, Wheel

_TRAIL = 0.05  # m, L
_LEAST = 1e-9  # m/s: a slower pivot stands
_SIDE = 1e-6  # rad off the exactly reversed direction, in which a caster would stay for ever: it swings to the left


def steering_truth(name: str, values: Values, ends: Array, durations: Array) -> Array:
    """True steering angles (F, S) at the samples' ends from the measured ones, rad; durations (F,): s."""
    return _OF_STEERING[name](values, ends, durations)


def _with_gain(values: Values, ends: Array, durations: Array) -> Array:  # noqa: ARG001
    return ends + values["g"] * ends


def _with_offset(values: Values, ends: Array, durations: Array) -> Array:  # noqa: ARG001
    return ends + values["c"]


def _with_play(values: Values, ends: Array, durations: Array) -> Array:  # noqa: ARG001
    """The wheel is pushed by one flank of the gear or by the other; at first it stands in the middle between them."""
    half, wheel, path = abs(values["b"]), ends[0].copy(), np.empty_like(ends)
    for sample, motor in enumerate(ends):
        pushed_left, pushed_right = motor - half > wheel, motor + half < wheel
        wheel = np.where(pushed_left, motor - half, np.where(pushed_right, motor + half, wheel))
        path[sample] = wheel
    return path


def _with_lag(values: Values, ends: Array, durations: Array) -> Array:
    """A first-order lag, exact for angles that change linearly within samples; below 0 they are reported late."""
    tau = values["tau"]
    if tau == 0:
        return ends.copy()
    times = np.cumsum(durations)
    if tau < 0:
        return np.column_stack([np.interp(times - tau, times, angle) for angle in ends.T])
    wheel, before, path = ends[0].copy(), ends[0], np.empty_like(ends)
    for sample, (motor, duration) in enumerate(zip(ends, durations, strict=True)):
        slope = (motor - before) / duration
        left = wheel - before + tau * slope  # how far the wheel is from where it would be after a long ramp
        wheel = motor - tau * slope + left * math.exp(-duration / tau)
        path[sample], before = wheel, motor
    return path


def turned_by_steering(values: Values, wheels: Sequence[Wheel], ends: Array, durations: Array) -> Array:
    """Rates (F, N), rad/s, that modules give their wheels when they turn from end to end of a sample (F, S), rad."""
    changes = np.vstack([np.zeros((1, ends.shape[1])), ends[1:] - ends[:-1]]) / durations[:, None]
    steered = iter(changes.T)
    turned = []
    for wheel in wheels:
        change = next(steered) if wheel.has_steering else np.zeros(len(ends))
        if wheel.has_rate:
            turned.append(values["k"] * change)
    return np.column_stack(turned)


def lost_by_light_wheels(
    values: Values, wheels: Sequence[Wheel], steering: Array | None, twists: Array, durations: Array
) -> Array:
    """Rates (F, N), rad/s, by which wheels slip for the force of the robot's acceleration, as seen from the floor.

    twists (F, 3): of the robot's centre. steering (F, S): true angles, rad.
    """
    headings = np.cumsum(twists[:, 2] * durations) - twists[:, 2] * durations / 2
    over_floor = (twists[:, 0] + 1j * twists[:, 1]) * np.exp(1j * headings)
    changes = np.diff(over_floor, prepend=0.0) / durations
    force = changes * np.exp(-1j * headings)  # per mass, along the robot's axes
    steered = iter(np.zeros((0, 0)) if steering is None else steering.T)
    lost = []
    for wheel in wheels:
        angle = next(steered) if wheel.has_steering else np.zeros(len(twists))
        if wheel.has_rate:
            grip = np.exp(1j * (wheel.rolling + angle - wheel.roller_angle))
            rim = wheel.radius * math.cos(wheel.roller_angle)
            lost.append(values[f"k_{wheel.name}"] * (force * grip.conjugate()).real / rim)
    return np.column_stack(lost)


def body_truth(name: str, values: Values, robot: Robot, twists: Array, durations: Array) -> Array:
    """Twists (F, 3) that are added to those of the robot's centre."""
    return _OF_BODY[name](values, robot, twists, durations)


def _about_a_point_ahead(values: Values, robot: Robot, twists: Array, durations: Array) -> Array:  # noqa: ARG001
    """A robot that turns at w about a point x abs(w) ahead of its centre carries the centre round that point."""
    ahead = values["x"] * np.abs(twists[:, 2])
    carried = 1j * twists[:, 2] * (0.0 - ahead)
    return np.column_stack([carried.real, carried.imag, np.zeros(len(twists))])


def _by_a_caster(values: Values, robot: Robot, twists: Array, durations: Array) -> Array:
    """Friction in the swivel hands a share of the caster's swing on to the robot, Eq. (1)."""
    added, beta = np.zeros(twists.shape), None
    for sample, ((vx, vy, turn), duration) in enumerate(zip(twists.tolist(), durations.tolist(), strict=True)):
        along, aside = vx, vy - robot.reach * turn
        speed = math.hypot(along, aside)
        if speed < _LEAST:
            continue
        gamma = math.atan2(aside, along)
        beta = gamma if beta is None else beta - turn * duration
        off = math.remainder(beta - gamma, 2 * math.pi)
        if abs(off) > math.pi - _SIDE:
            off = -(math.pi - _SIDE)
        after = 2 * math.atan(math.tan(off / 2) * math.exp(-speed * duration / _TRAIL))
        added[sample, 2] = values["k"] * (after - off) / duration
        beta = gamma + after
    return added


_Steered = Callable[[Values, Array, Array], Array]
_OF_STEERING: Mapping[str, _Steered] = {
    "steering_gain": _with_gain,
    "steering_offset": _with_offset,
    "steering_play": _with_play,
    "steering_lag": _with_lag,
}
_OF_BODY: Mapping[str, Callable[[Values, Robot, Array, Array], Array]] = {
    "icr_shift": _about_a_point_ahead,
    "caster_pull": _by_a_caster,
}
STEERING, BODY = frozenset(_OF_STEERING), frozenset(_OF_BODY)
COUPLING, LIGHT_WHEEL = "steering_coupling", "light_wheel"
MECHANICS = STEERING | BODY | {COUPLING, LIGHT_WHEEL}
