"""Mechanics of a simulated robot behind effects of steering, casters and grip, on code of its own.

The effects that find these in recordings (robot/effects/textbook.py) are to first order and
see samples only. Here a flank of the gear pushes the wheel, a lag is a differential equation, and a caster is drawn
along by its pivot:

    d(beta)/dt = -(abs(V) / L) sin(beta - gamma) - w,                                                   (1)

beta being the direction from where the caster's wheel touches the floor to its pivot, relative to the robot, gamma that
of the pivot's velocity V, w the robot's rate of turn, and L the trail.

The twist that the wheels give a robot by how they touch the floor is derived from the velocities of the points of
contact and shares nothing with the matrices that are fitted (robot/kinematics.py). A robot with the twist (vx, vy, w)
moves over the contact of a wheel at (x, y) with the velocity

    V = (vx - y w, vy + x w).                                                                         (2)

A fixed wheel of radius r that turns at omega slides by V.e - r omega along its direction of rolling e, and by V.n along
its axle n; a driven steered wheel by V - r omega e, with e its true direction; omni and mecanum wheels slide along the
axis q of the rollers that touch the floor only, so that (V - r omega e).q is 0 where they do not. Wheels that
contradict each other slide, and friction makes the sum of squares of all sliding least; sliding along the axles of a
skid-steered robot counts by its lateral friction. A car is driven through a differential: the axles of all its wheels
meet in its instantaneous centre of rotation as nearly as they can, its speed is such that the mean rate of its rear
wheels is as driven, and each rear wheel then turns as it rolls.

A constant twist turns the robot about its centre of rotation: with the twist (vx, vy, w) in the frame of a pose (p,
theta), positions as complex numbers, a robot is after a time s at

    p + exp(i theta) (vx + i vy) (exp(i w s) - 1) / (i w).                                            (3)
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.effects.effect import Values
from omnibench.robot.kinematics import Array, CarDrive, Mount, Robot, Wheel
from omnibench.robot.odometry import Complex, Integration

_NO_FRICTION = 1e-9  # share of the friction along the wheels that stands for none across: less is lost to rounding
_STEP = 1e-6  # tangent of the steering angle by which a car's matrix is differentiated


class WheelContacts:
    """The true wheels of a robot and where they touch the floor.

    robot: the design, whose rates (N,) and steering angles (S,) are measured. wheels: the true ones, as many.
    steering_offsets (S,): true steering angle less the measured one, rad. mount: the true tracked point.
    lateral_friction: of a skid-steered robot across its wheels, as a share of that along them.
    """

    def __init__(
        self,
        robot: Robot,
        wheels: Sequence[Wheel],
        steering_offsets: Sequence[float] = (),
        mount: Mount | None = None,
        lateral_friction: float = 0.0,
    ) -> None:
        self._robot, self._wheels, self._mount = robot, tuple(wheels), mount
        self._offsets = np.array(steering_offsets or [0.0] * len(robot.drive.steered))
        self._across = np.sqrt(max(lateral_friction, _NO_FRICTION)) if robot.skid else 1.0
        self.has_differential = isinstance(robot.drive, CarDrive)

    def twists(self, rates: Array, steering: Array | None) -> Array:
        """Twists (F, 3) of the robot's centre, m/s, m/s, rad/s.

        rates (F, N): true mean wheel rates, rad/s. steering (F, S): angles in the samples' middles, rad.
        """
        if self.has_differential:
            assert steering is not None  # a car steers
            # Twists (F, 3) of a car, of which the mean of the rates (F, N) counts
            samples = len(rates)
            rows = [np.tile(_along(wheel, np.pi / 2), (samples, 1)) for wheel in self._wheels if wheel.kind == "fixed"]
            guiding = [wheel for wheel in self._wheels if wheel.has_steering]
            for wheel, angles, offset in zip(guiding, steering.T, self._offsets, strict=True):
                across = angles + offset + np.pi / 2
                rows.append(np.column_stack([np.cos(across), np.sin(across)]) @ _contact(wheel))
            # At unit speed ahead no wheel is to slide along its axle: a . (1, vy, w) = 0, in least squares.
            axles = np.stack(rows, axis=1)
            free = axles[:, :, 1:]
            normal, asked = np.swapaxes(free, 1, 2) @ free, -np.swapaxes(free, 1, 2) @ axles[:, :, :1]
            directions = np.column_stack([np.ones(samples), np.linalg.solve(normal, asked)[..., 0]])
            speeds = rates.mean(axis=1) / self.rolling_rates(directions).mean(axis=1)
            return speeds[:, None] * directions
        return self._driven(rates, steering) @ self._least_sliding.T

    def tracked(self, twists: Array) -> Array:
        """Twists (F, 3) of the tracked point, along its own axes, from those of the robot's centre."""
        if self._mount is None:
            return twists
        x, y, yaw = self._mount.x, self._mount.y, self._mount.yaw
        along, aside = twists[:, 0] - y * twists[:, 2], twists[:, 1] + x * twists[:, 2]
        turned = (along + 1j * aside) * np.exp(-1j * yaw)
        return np.column_stack([turned.real, turned.imag, twists[:, 2]])

    def rolling_rates(self, twists: Array) -> Array:
        """Rates (F, N), rad/s, at which fixed wheels roll without sliding under twists (F, 3) of the centre."""
        return np.column_stack([twists @ _along(wheel) / wheel.radius for wheel in self._measured])

    @cached_property
    def matrix(self) -> Array:
        """K (3, M) from the design's drive signals to the twist of the tracked point; of a car for small angles."""
        drive = self._robot.drive
        if not self.has_differential:
            rates, steering = drive.commands(np.eye(len(drive.names)))
            matrix: Array = self.tracked(self.twists(rates, steering)).T
            return matrix
        turned = np.array([[1.0, 0.0, 0.0], [1.0, _STEP, 0.0], [1.0, -_STEP, 0.0]])[:, : len(drive.names)]
        ahead, left, right = self.tracked(self.twists(*drive.commands(turned)))
        columns = [ahead, (left - right) / (2 * _STEP), np.zeros(3)]  # the difference of the rates follows the motion
        return np.column_stack(columns[: len(drive.names)])

    @property
    def _measured(self) -> list[Wheel]:
        return [wheel for wheel in self._wheels if wheel.has_rate]

    @cached_property
    def _least_sliding(self) -> Array:
        """The matrix (3, R) from the driven velocities of R contacts to the twist of least sliding."""
        rows: list[Array] = []
        for wheel in self._wheels:
            if wheel.kind == "steered":
                rows += list(_contact(wheel)) if wheel.has_rate else []
            else:
                rows += [_along(wheel)] if wheel.has_rate else []
                rows += [self._across * _along(wheel, np.pi / 2)] if wheel.kind == "fixed" else []
        return np.linalg.pinv(np.array(rows))

    def _driven(self, rates: Array, steering: Array | None) -> Array:
        """Velocities (F, R) that the wheels' rates ask of their contacts, along the rows of ``_least_sliding``."""
        columns, number, steered = [], 0, 0
        for wheel in self._wheels:
            driven = None
            if wheel.has_rate:
                driven = wheel.radius * rates[:, number]
                number += 1
            if wheel.kind == "steered":
                if driven is not None:
                    assert steering is not None  # this wheel steers
                    angle = steering[:, steered] + self._offsets[steered]
                    columns += [driven * np.cos(angle), driven * np.sin(angle)]
                    steered += 1
                continue
            columns += [] if driven is None else [driven * np.cos(wheel.roller_angle)]
            columns += [np.zeros(len(rates))] if wheel.kind == "fixed" else []
        return np.column_stack(columns)


def _contact(wheel: Wheel) -> Array:
    """The matrix (2, 3) from a twist to the velocity of the robot over a wheel's contact, Eq. (2)."""
    x, y = wheel.position
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])


def _along(wheel: Wheel, turned: float = 0.0) -> Array:
    """The row (3,) from a twist to the contact's velocity along the wheel's rolling, less the angle of its rollers.

    turned: an angle, rad, by which the direction is turned counter-clockwise.
    """
    angle = wheel.rolling - wheel.roller_angle + turned
    row: Array = np.array([np.cos(angle), np.sin(angle)]) @ _contact(wheel)
    return row


_TRAIL = 0.05  # m, L
_LEAST = 1e-9  # m/s: a slower pivot stands
_SIDE = 1e-6  # rad off the exactly reversed direction, in which a caster would stay for ever: it swings to the left


def steering_truth(name: str, values: Values, ends: Array, durations: Array) -> Array:
    """True steering angles (F, S) at the samples' ends from the measured ones, rad; durations (F,): s."""
    if name == "steering_gain":
        return ends + values["g"] * ends
    if name == "steering_offset":
        return ends + values["c"]
    return _with_play(values["b"], ends) if name == "steering_play" else _with_lag(values["tau"], ends, durations)


def _with_play(width: float, ends: Array) -> Array:
    """The wheel is pushed by one flank of the gear or by the other; at first it stands in the middle between them."""
    half, wheel, path = abs(width), ends[0].copy(), np.empty_like(ends)
    for sample, motor in enumerate(ends):
        pushed_left, pushed_right = motor - half > wheel, motor + half < wheel
        wheel = np.where(pushed_left, motor - half, np.where(pushed_right, motor + half, wheel))
        path[sample] = wheel
    return path


def _with_lag(tau: float, ends: Array, durations: Array) -> Array:
    """A first-order lag, exact for angles that change linearly within samples; below 0 they are reported late."""
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


def _with_rates(wheels: Sequence[Wheel], columns: Array) -> Iterator[tuple[Wheel, Array]]:
    """The wheels with a rate, each with its column (F,) of those (F, S) of the steered wheels; zeros if it is none."""
    steered = iter(columns.T)
    for wheel in wheels:
        column = next(steered) if wheel.has_steering else np.zeros(len(columns))
        if wheel.has_rate:
            yield wheel, column


def turned_by_steering(values: Values, wheels: Sequence[Wheel], ends: Array, durations: Array) -> Array:
    """Rates (F, N), rad/s, that modules give their wheels when they turn from end to end of a sample (F, S), rad."""
    changes = np.vstack([np.zeros((1, ends.shape[1])), ends[1:] - ends[:-1]]) / durations[:, None]
    return np.column_stack([values["k"] * change for _, change in _with_rates(wheels, changes)])


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
    lost = []
    for wheel, angle in _with_rates(wheels, np.zeros((len(twists), 0)) if steering is None else steering):
        grip = np.exp(1j * (wheel.rolling + angle - wheel.roller_angle))
        rim = wheel.radius * math.cos(wheel.roller_angle)
        lost.append(values[f"k_{wheel.name}"] * (force * grip.conjugate()).real / rim)
    return np.column_stack(lost)


def body_truth(name: str, values: Values, robot: Robot, twists: Array, durations: Array) -> Array:
    """Twists (F, 3) that are added to those of the robot's centre."""
    if name == "icr_shift":
        # A robot that turns at w about a point x abs(w) ahead of its centre carries the centre round that point.
        carried = 1j * twists[:, 2] * (0.0 - values["x"] * np.abs(twists[:, 2]))
        return np.column_stack([carried.real, carried.imag, np.zeros(len(twists))])
    # Friction in the swivel hands a share of the caster's swing on to the robot, Eq. (1).
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


STEERING = frozenset({"steering_gain", "steering_offset", "steering_play", "steering_lag"})
BODY = frozenset({"icr_shift", "caster_pull"})
COUPLING, LIGHT_WHEEL = "steering_coupling", "light_wheel"
MECHANICS = STEERING | BODY | {COUPLING, LIGHT_WHEEL}


_SMALL = 1e-4  # rad: below it the series of Eq. (3) is exact to rounding


class TrueMotion:
    """Motion with a constant twist within every sample.

    times (F,): the samples' ends, s. start (3,): pose at t = 0. twists (F, 3): in the robot's frame, m/s, m/s, rad/s.
    drift (F, 2): velocity that is added in the reference's frame, m/s. integration: ``euler`` moves straight ahead
    within a sample and turns at its end.
    """

    def __init__(
        self, times: Array, start: Array, twists: Array, integration: Integration, drift: Array | None = None
    ) -> None:
        self._begins, self._ends = np.append(0.0, times[:-1]), times
        self._twists, self._exact = twists, integration == "arc"
        self._drift: Complex = np.zeros(len(times), complex) if drift is None else drift[:, 0] + 1j * drift[:, 1]
        lengths = times - self._begins
        self._headings = start[2] + np.append(0.0, np.cumsum(twists[:, 2] * lengths))
        steps = self._travel(np.arange(len(times)), lengths)
        self._positions: Complex = complex(start[0], start[1]) + np.append(0.0, np.cumsum(steps))

    def poses(self, stamps: Array) -> Array:
        """Poses (K, 3) at stamps (K,), s; before t = 0 and after the last sample the robot stands."""
        held = np.clip(stamps, 0.0, self._ends[-1])
        sample = np.minimum(np.searchsorted(self._ends, held), len(self._ends) - 1)
        passed = held - self._begins[sample]
        position = self._positions[sample] + self._travel(sample, passed)
        heading = self._headings[sample] + self._twists[sample, 2] * passed
        return np.column_stack([position.real, position.imag, heading])

    def _travel(self, sample: NDArray[np.intp], seconds: Array) -> Complex:
        """Displacements (K,) within samples (K,) after some seconds (K,) of each, Eq. (3)."""
        vx, vy, turn = self._twists[sample].T
        velocity: Complex = (vx + 1j * vy) * np.exp(1j * self._headings[sample])
        angle = 1j * turn * seconds
        series = 1 + angle / 2 * (1 + angle / 3 * (1 + angle / 4))
        exact = np.divide(np.expm1(angle), angle, out=series.copy(), where=np.abs(angle) > _SMALL)
        return (velocity * (exact if self._exact else 1.0) + self._drift[sample]) * seconds
