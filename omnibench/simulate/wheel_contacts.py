"""True kinematics of a simulated robot: the twist that its wheels give it by how they touch the floor.

This is derived from the velocities of the points of contact and shares nothing with the matrices that are fitted
(robot/kinematics.py). A robot with the twist (vx, vy, w) moves over the contact of a wheel at (x, y) with the velocity

    V = (vx - y w, vy + x w).                                                                         (1)

A fixed wheel of radius r that turns at omega slides by V.e - r omega along its direction of rolling e, and by V.n along
its axle n; a driven steered wheel by V - r omega e, with e its true direction; omni and mecanum wheels slide along the
axis q of the rollers that touch the floor only, so that (V - r omega e).q is 0 where they do not. Wheels that
contradict each other slide, and friction makes the sum of squares of all sliding least; sliding along the axles of a
skid-steered robot counts by its lateral friction. A car is driven through a differential: the axles of all its wheels
meet in its instantaneous centre of rotation as nearly as they can, its speed is such that the mean rate of its rear
wheels is as driven, and each rear wheel then turns as it rolls.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from omnibench.robot.kinematics import Array, CarDrive, Mount, Robot, Wheel

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
            return self._twists_of_car(rates, steering)
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

    def _twists_of_car(self, rates: Array, steering: Array) -> Array:
        """Twists (F, 3) of a car, of which the mean of the rates (F, N) counts."""
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


def _contact(wheel: Wheel) -> Array:
    """The matrix (2, 3) from a twist to the velocity of the robot over a wheel's contact, Eq. (1)."""
    x, y = wheel.position
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])


def _along(wheel: Wheel, turned: float = 0.0) -> Array:
    """The row (3,) from a twist to the contact's velocity along the wheel's rolling, less the angle of its rollers.

    turned: an angle, rad, by which the direction is turned counter-clockwise.
    """
    angle = wheel.rolling - wheel.roller_angle + turned
    row: Array = np.array([np.cos(angle), np.sin(angle)]) @ _contact(wheel)
    return row
