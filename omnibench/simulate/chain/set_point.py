"""The set point's scale from 0 (rest) to 1 (full speed) over time, with limited slope and jerk.

A course of the scale is a sequence of phases of constant jerk in closed form; nothing is sampled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from omnibench.robot.kinematics import Array


@dataclass(frozen=True)
class SlewLimits:
    """The steepest slope of the scale, 1/s, and the greatest change of the slope, 1/s2 (inf: the slope may step)."""

    slope: float
    jerk: float = math.inf


@dataclass(frozen=True)
class Phase:
    """A phase of constant jerk from ``start``, s, on. way: integral of the scale until then, s at full speed."""

    start: float
    way: float
    scale: float
    slope: float = 0.0
    jerk: float = 0.0

    def at(self, time: float) -> Phase:
        """The rest of the phase, from ``time``, s, on."""
        s = time - self.start
        way = self.way + s * (self.scale + s * (self.slope / 2 + s * self.jerk / 6))
        scale = self.scale + s * (self.slope + s * self.jerk / 2)
        return Phase(time, way, scale, self.slope + s * self.jerk, self.jerk)


@dataclass(frozen=True)
class SetPoint:
    """A course of the scale: its phases in time; the last goes on for ever."""

    limits: SlewLimits
    phases: tuple[Phase, ...] = (Phase(0.0, 0.0, 0.0),)

    @property
    def target(self) -> float:
        """Final value of the scale."""
        return self.phases[-1].scale

    @property
    def end(self) -> float:
        """Time from which on the scale is constant, s."""
        return self.phases[-1].start

    @property
    def way(self) -> float:
        """Integral of the scale over a course that ends at rest, s at full speed."""
        return self.phases[-1].way

    def towards(self, target: float, time: float) -> SetPoint:
        """The course that leaves this one at ``time`` (s, from 0 on) for ``target``, as fast as the limits allow.

        A scale between 0 and 1 that is sent to 0 or to 1 stays between them.
        """
        if target == self.target:
            return self
        now = next(phase for phase in reversed(self.phases) if phase.start <= time).at(time)
        driven = (phase for phase in self.phases if phase.start < time)
        return SetPoint(self.limits, (*driven, *_course(now, target, self.limits)))

    def ways(self, times: Array) -> Array:
        """Integrals (F,) of the scale until ``times`` (F,), s at full speed."""
        columns = np.array([[phase.start, phase.way, phase.scale, phase.slope, phase.jerk] for phase in self.phases]).T
        chosen = np.searchsorted(columns[0], times, side="right") - 1
        start, way, scale, slope, jerk = columns[:, chosen]
        s = times - start
        covered: Array = way + s * (scale + s * (slope / 2 + s * jerk / 6))
        return covered


def _course(now: Phase, target: float, limits: SlewLimits) -> tuple[Phase, ...]:
    """The fastest course to the target: the slope goes to its peak, stays there, goes to 0."""
    if math.isinf(limits.jerk):
        sign = math.copysign(1.0, target - now.scale)
        parts = [(abs(target - now.scale) / limits.slope, sign * limits.slope, 0.0)]
    else:
        parts = _s_curve(now, target, limits)
    phases, start, way, scale = [], now.start, now.way, now.scale
    for duration, slope, jerk in parts:
        if duration > 0:
            phases.append(Phase(start, way, scale, slope, jerk))
            reached = phases[-1].at(start + duration)
            start, way, scale = reached.start, reached.way, reached.scale
    return (*phases, Phase(start, way, target))


def _s_curve(now: Phase, target: float, limits: SlewLimits) -> list[tuple[float, float, float]]:
    """Duration, slope at the begin and jerk of the three phases, from any slope to slope 0."""
    coasting = now.scale + now.slope * abs(now.slope) / (
        2 * limits.jerk
    )  # the scale that is reached if the slope goes to 0 at once
    sign = math.copysign(1.0, target - coasting)
    slope, missing, jerk = sign * now.slope, sign * (target - now.scale), limits.jerk
    peak = max(min(limits.slope, math.sqrt(max(jerk * missing + slope**2 / 2, 0.0))), slope, 0.0)
    held = (missing - (2 * peak**2 - slope**2) / (2 * jerk)) / peak if peak > 0 else 0.0
    return [
        ((peak - slope) / jerk, now.slope, sign * jerk),
        (max(held, 0.0), sign * peak, 0.0),
        (peak / jerk, sign * peak, -sign * jerk),
    ]
