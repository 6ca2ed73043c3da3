"""Extrapolation monitor: how long a robot has driven outside the training domain of its calibration's effects."""

from __future__ import annotations

import logging

import numpy as np

from omnibench.live.wheels.wheel_input import WheelStep
from omnibench.robot.calibration import Calibration
from omnibench.robot.corrections import TrainingDomain, extrapolation_consequence
from omnibench.robot.kinematics import Array

LOG = logging.getLogger("omnibench.live")
_WINDOW = 0.5  # s, over which a twist is averaged before it is judged; chosen
_TRANSITION = 1.0  # s; a motion that lasts no longer is a transition and does not count; chosen


class ExtrapolationMonitor:
    """Counts the time that a robot drives outside its calibration's training domain; warns in the log the first time.

    seconds: the time so far; None where the calibration has no effects, or does not say what it was fitted to.
    """

    def __init__(self, robot: str, calibration: Calibration) -> None:
        self._robot, self._calibration = robot, calibration
        self._domain: TrainingDomain | None = None
        self.seconds: float | None = None
        if calibration.effects and calibration.driven:
            self._domain, self.seconds = TrainingDomain(calibration.robot, calibration.driven), 0.0
        self._matrix = calibration.matrix_array
        self._lasted = 0.0  # s that the robot has now been outside the domain without a break
        self._driven: Array = np.zeros(self._matrix.shape[1])  # rad, integrals of the signals in the present window
        self._elapsed = 0.0  # s since the present window began

    def take(self, step: WheelStep, driven: Array) -> None:
        """Take a wheel step with the integrals (M,) of its drive signals, rad."""
        if self._domain is None:
            return
        if step.blind:  # its motion is not known
            self._begin()
            return
        self._driven = self._driven + driven
        self._elapsed += step.duration
        if self._elapsed >= _WINDOW:
            self._judge(self._domain, self._matrix @ self._driven / self._elapsed)
            self._begin()

    def _begin(self) -> None:
        self._driven = np.zeros(self._matrix.shape[1])
        self._elapsed = 0.0

    def _judge(self, domain: TrainingDomain, motion: Array) -> None:
        if not domain.is_outside(motion):
            self._lasted = 0.0
            return
        before, self._lasted = self._lasted, self._lasted + self._elapsed
        if self._lasted <= _TRANSITION:
            return
        assert self.seconds is not None
        if not self.seconds:
            LOG.warning(
                "%s: drives motions that %r was not fitted to, such as %s: %s; told once, then counted in health",
                *(self._robot, self._calibration.name, domain.in_words(motion[None])),
                extrapolation_consequence(
                    [term.name for term in self._calibration.effects], fading=self._calibration.plain is not None
                ),
            )
        self.seconds += self._lasted if before <= _TRANSITION else self._elapsed
