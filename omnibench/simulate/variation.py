"""Variation of a command within a run: a rate of turn that weaves, and a speed that is reversed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from omnibench.config import Model, NonNegative, Positive
from omnibench.robot.kinematics import Array, Robot
from omnibench.simulate.command import Command


class Variation(Model):
    """Variation of every command within a run, by default none: what changes only then shows steering and casters."""

    weave: NonNegative = Field(0.0, description="by which the rate of turn swings about the command's, rad/s")
    period: Positive = Field(4.0, description="of the weave, s")
    reversals: int = Field(0, ge=0, le=1000, description="of the speed within a run; the rate of turn goes on")

    @property
    def is_none(self) -> bool:
        """True if a run holds its command throughout."""
        return not self.weave and not self.reversals

    def extremes(self, command: Command) -> tuple[Command, ...]:
        """The command with the slowest and with the fastest rate of turn that it takes."""
        if not self.weave:
            return (command,)
        return tuple(replace(command, turn_rate=command.turn_rate + side * self.weave) for side in (-1, 1))

    def wheels(self, robot: Robot, command: Command, times: Array, *, ends: bool) -> tuple[Array, Array]:
        """Wheel rates (F, N), rad/s, and steering angles (F, S), rad, by the design in samples that end at times (F,).

        ends: at the samples' ends, else in their middles. Between two reversals steering angles are continuous; after
        each a wheel that would steer by more than a quarter turn drives backward.
        """
        middles = times - np.diff(times, prepend=0.0) / 2
        legs = np.floor(middles / times[-1] * (self.reversals + 1)).astype(int)
        swing = self.weave * np.sin(2 * math.pi / self.period * (times if ends else middles))
        straight = replace(command, turn_rate=0.0).twist
        turning = replace(command, speed=0.0, turn_rate=1.0).twist
        twists = (1 - 2 * (legs % 2))[:, None] * straight + (command.turn_rate + swing)[:, None] * turning
        rates, steering = robot.drive.commands(twists @ robot.signal_equations.T)
        for wheel, pair in enumerate(robot.drive.pairs):
            if pair >= 0:
                angles = _within_legs(steering[:, pair], legs)
                rates[:, wheel] *= np.sign(np.cos(angles - steering[:, pair]))
                steering[:, pair] = angles
        return rates, steering


STEADY = Variation()  # a run holds its command throughout


def _within_legs(angles: Array, legs: NDArray[np.intp]) -> Array:
    """Directions (F,) of rolling, rad, either way: continuous in each leg, which begins within a quarter turn."""
    chosen = np.empty_like(angles)
    for leg in np.unique(legs):
        part = np.unwrap(angles[legs == leg], period=math.pi)
        chosen[legs == leg] = part - math.pi * round(part[0] / math.pi)
    return chosen
