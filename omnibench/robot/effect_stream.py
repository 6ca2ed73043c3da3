"""Odometry with effects, one wheel sample at a time: the same corrections as in batch, of samples that come singly."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from omnibench.robot.corrected import corrected_twists
from omnibench.robot.effects.term import Term
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, OdometryStream, advance
from omnibench.robot.signals import SignalStream

_NO_STRETCH = 1e-6  # of an arc that comes back to where it began: no motion in the robot's frame moves it


class EffectStream(OdometryStream):
    """A stream whose samples are corrected by effects of stage wheel, clock, body and world.

    Effects that need poses get those by the uncorrected path, as in a batch, from the start or from the pose that was
    last set from outside.
    """

    def __init__(
        self, terms: Sequence[Term], signals: SignalStream, integration: Integration, start: Array | None = None
    ) -> None:
        super().__init__(signals.matrix, integration, start)
        self._terms, self._signals = tuple(terms), signals
        self._needs_poses = any("poses" in term.effect.needs for term in self._terms)
        self._left_at: Array | None = None

    def step(self, rates: Array, duration: float, wheel_angles: Array | None = None) -> Array:
        if duration <= 0:
            return self.drive(np.asarray(rates) * duration, duration, wheel_angles)
        self._follow()
        signals = self._signals.next(np.asarray(rates, dtype=float), duration, wheel_angles, self.frame_heading)
        twists, drift = corrected_twists(self._terms, signals, self.matrix)
        before, moved = self.pose, twists[0] * duration
        self.pose = advance(before, moved, self.integration)
        if drift is not None:
            added = self._in_frame(drift[0] * duration)
            self.pose = self.pose + np.array([added.real, added.imag, 0.0])
            moved = moved + self._in_body(added, before[2], moved[2])
        self.moved, self._left_at = moved, self.pose
        return self.pose

    def drive(self, angles: Array, duration: float | None = None, wheel_angles: Array | None = None) -> Array:
        if duration is None:
            raise ValueError("a model with effects needs the duration of every sample")
        if duration > 0:
            return self.step(np.asarray(angles) / duration, duration, wheel_angles)
        self._follow()
        self._signals.turn(angles, wheel_angles)  # no time, no rate: the matrix alone
        self._signals.move(self.matrix @ angles)
        self._left_at = super().drive(angles)
        return self.pose

    def _follow(self) -> None:
        """Begin the uncorrected path where the stream was put."""
        if self._needs_poses and self.pose is not self._left_at:
            self._signals.pose = self.pose

    def _in_frame(self, drift: Array) -> complex:
        """A way (2,) in the reference's frame as x + iy in the stream's, m."""
        turn = complex(math.cos(self.frame_heading), -math.sin(self.frame_heading))
        return complex(drift[0], drift[1]) * turn

    def _in_body(self, way: complex, heading: float, turned: float) -> Array:
        """The motion (3,) in the robot's frame that adds a way to a sample which begins at a heading and turns."""
        half = turned / 2 if self.integration == "arc" else 0.0
        stretch = math.sin(half) / half if half else 1.0
        if abs(stretch) < _NO_STRETCH:
            return np.zeros(3)
        own = way * complex(math.cos(heading + half), -math.sin(heading + half)) / stretch
        return np.array([own.real, own.imag, 0.0])
