"""Odometry with effects, one wheel sample at a time; the corrections are those of the batch."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from omnibench.robot.domain.fade import Fade, faded_twists
from omnibench.robot.effects.term import Term
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, OdometryStream, advance
from omnibench.robot.signals import SignalStream

# Chord by length of an arc. Below it the arc ends where it began, and no motion in the robot's frame displaces its end.
_NO_STRETCH = 1e-6


class EffectStream(OdometryStream):
    """A stream whose samples are corrected by effects of stage wheel, clock, body and world.

    Effects that need poses get those of the uncorrected path, as in a batch. The path begins at the start, and again
    wherever ``pose`` is set from outside.
    """

    def __init__(
        self,
        terms: Sequence[Term],
        signals: SignalStream,
        integration: Integration,
        start: Array | None = None,
        fade: Fade | None = None,
    ) -> None:
        super().__init__(signals.matrix, integration, start, signals.robot.drive)
        self._terms, self._signals, self._fade = tuple(terms), signals, fade
        self._needs_poses = any("poses" in term.effect.needs for term in self._terms)
        self._left_at: Array | None = None

    def drive(
        self,
        angles: Array,
        duration: float | None = None,
        wheel_angles: Array | None = None,
        steering: Array | None = None,
    ) -> Array:
        if duration is None:
            raise ValueError("a model with effects needs the duration of every sample")
        angles = np.asarray(angles, dtype=float)
        if duration <= 0:
            return self._take_at_once(angles, wheel_angles, steering)
        self._follow()
        middle = self.steer(steering)
        steered = None if middle is None or steering is None else (middle, np.asarray(steering, dtype=float))
        self.driven = self.driven_signals(angles, middle)
        signals = self._signals.next(angles / duration, duration, wheel_angles, self.frame_heading, steered)
        twists, drift, doubts = faded_twists(self._fade, self._terms, signals, self.matrix)
        before, moved = self.pose, twists[0] * duration
        self.pose = advance(before, moved, self.integration)
        if drift is not None:
            added = self._in_frame(drift[0] * duration)
            self.pose = self.pose + np.array([added.real, added.imag, 0.0])
            moved = moved + self._in_body(added, before[2], moved[2])
        self.moved, self._left_at = moved, self.pose
        self.doubts = None if doubts is None else self._all_in_body(duration * doubts[0], before[2])
        return self.pose

    def _all_in_body(self, doubts: Array, heading: float) -> Array:
        """Deviations (3, r) of a motion in the robot's frame from those (5, r) of its twist and of its drift."""
        turn = self.frame_heading + heading
        cosine, sine = math.cos(turn), math.sin(turn)
        of_drift = np.array([[cosine, sine], [-sine, cosine], [0.0, 0.0]]) @ doubts[3:]
        in_body: Array = doubts[:3] + of_drift
        return in_body

    def _take_at_once(self, angles: Array, wheel_angles: Array | None, steering: Array | None) -> Array:
        """Advance by wheel angles (N,) rad that take no time: without rates no effect acts, and the matrix stands."""
        self._follow()
        self.doubts = None
        self._signals.turn(angles, wheel_angles)
        self._left_at = super().drive(angles, steering=steering)
        self._signals.move(self.moved)
        return self.pose

    def _follow(self) -> None:
        """Begin the uncorrected path where the stream was put."""
        if self._needs_poses and self.pose is not self._left_at:
            self._signals.pose = self.pose

    def _in_frame(self, drift: Array) -> complex:
        """A displacement (2,) in the reference's frame, m, as x + iy in the stream's frame."""
        turn = complex(math.cos(self.frame_heading), -math.sin(self.frame_heading))
        return complex(drift[0], drift[1]) * turn

    def _in_body(self, displacement: complex, heading: float, turned: float) -> Array:
        """Motion (3,) in the robot's frame that displaces the end of a sample which begins at ``heading`` and turns."""
        half = turned / 2 if self.integration == "arc" else 0.0
        stretch = math.sin(half) / half if half else 1.0
        if abs(stretch) < _NO_STRETCH:
            return np.zeros(3)
        in_body = displacement * complex(math.cos(heading + half), -math.sin(heading + half)) / stretch
        return np.array([in_body.real, in_body.imag, 0.0])
