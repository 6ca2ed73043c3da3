"""Timing of the reference: offset, latency and drift of its clock."""

from __future__ import annotations

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import Parameter, ReferenceEffect, Values
from omnibench.robot.kinematics import Array

_FURGALE = (
    "P. Furgale, J. Rehder and R. Siegwart, Unified temporal and spatial calibration for multi-sensor systems, 2013"
)


@effects.register("reference_time_offset")
class ReferenceTimeOffset(ReferenceEffect):
    """Every pose was taken earlier than its stamp says: at t - tau."""

    physics = "The reference's clock is off, or its poses are stamped when SLAM has finished: only the sum shows."
    source = _FURGALE
    shows_in = "acceleration"
    fixed_parameters = (Parameter("tau", "s", -0.2, 0.2, "by how much earlier the pose was taken"),)

    def delays(self, stamps: Array, values: Values) -> tuple[Array, Array]:
        delay = np.full(stamps.shape, values["tau"])
        return delay, delay


@effects.register("heading_latency")
class HeadingLatency(ReferenceEffect):
    """The heading alone was taken earlier than its stamp says: at t - tau."""

    physics = "The reference smooths its headings, or takes them from another sensor than its positions."
    source = _FURGALE
    shows_in = "acceleration"
    fixed_parameters = (Parameter("tau", "s", -0.1, 0.1, "by how much earlier the heading was taken"),)

    def delays(self, stamps: Array, values: Values) -> tuple[Array, Array]:
        return np.zeros(stamps.shape), np.full(stamps.shape, values["tau"])


@effects.register("reference_clock_drift")
class ReferenceClockDrift(ReferenceEffect):
    """The reference's clock has an offset and goes wrong, by its own amounts in every run: t - offset - slope t."""

    physics = "The clocks of robot and reference were set independently and do not go at the same speed."
    source = "E. Olson, A passive solution to the sensor synchronization problem, 2010"
    shows_in = "stamps"
    run_nuisance = True
    fixed_parameters = (
        Parameter("offset", "s", -0.2, 0.2, "by how much earlier the first pose was taken"),
        Parameter("slope", "1", -0.01, 0.01, "by how much more for every second of the run"),
    )

    def delays(self, stamps: Array, values: Values) -> tuple[Array, Array]:
        delay = values["offset"] + values["slope"] * stamps
        return delay, delay
