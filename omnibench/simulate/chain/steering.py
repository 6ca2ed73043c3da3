"""Steering of wheels: motors that turn them to their angles at a limited rate, and encoders that measure these."""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from omnibench.config import Model, Positive
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.robot_class import class_of
from omnibench.simulate.chain.motors import TRUE_STEP


class Steering(Model):
    """The drives of steering angles. Each turns its wheel to the commanded angle at a constant rate, and holds it."""

    rate_deg: Positive = Field(180.0, description="of a steering motor, degrees/s")
    ticks: int = Field(8192, gt=0, le=10**9, description="of the absolute encoder, per turn of the steering angle")
    noise_deg: float = Field(0.05, ge=0, le=45, description="white noise of the measured angle, degrees")
    waits: bool | None = Field(
        None,
        description="the wheels drive once they are steered; default: true for several driven steered wheels, which "
        "would push against each other, else false",
    )

    def rest(self, robot: Robot, before: Array, targets: Array, sample_period: float) -> int:
        """Samples for which a robot stands until its steering has gone from angles to targets (S,), rad."""
        waits = class_of(robot) == "swerve" if self.waits is None else self.waits
        if not waits:
            return 0
        seconds = np.abs(targets - before).max(initial=0.0) / math.radians(self.rate_deg)
        return math.ceil(seconds / sample_period - 1e-9)

    def angles(self, before: Array, targets: Array, steps: int) -> Array:
        """True angles (steps + 1, S), rad, every millisecond, from those before a run to its targets (S,)."""
        reach = math.radians(self.rate_deg) * TRUE_STEP * np.arange(steps + 1)[:, None]
        turned: Array = before + np.clip(targets - before, -reach, reach)
        return turned

    def measured(self, angles: Array, rng: np.random.Generator) -> Array:
        """Measured angles (F, S) of true ones (F, S), rad: with noise, and in whole ticks."""
        tick = 2 * math.pi / self.ticks
        noisy = angles + math.radians(self.noise_deg) * rng.standard_normal(angles.shape)
        return tick * np.round(noisy / tick)
