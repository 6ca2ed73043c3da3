"""Drift: motion that the wheel rates do not show, while driving, at the start of a run, or relative to the floor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, ReferenceEffect, Values, body_change
from omnibench.robot.kinematics import Array, Robot, class_of
from omnibench.robot.signals import STILL, Signals, needed

_FURGALE = (
    "P. Furgale, J. Rehder and R. Siegwart, Unified temporal and spatial calibration for multi-sensor systems, 2013"
)


def _driving(rates: Array) -> NDArray[np.bool_]:
    """True for samples (F,) in which a wheel turns."""
    driving: NDArray[np.bool_] = np.abs(rates).max(axis=1) > STILL
    return driving


@effects.register("heading_drift")
class HeadingDrift(MotionEffect):
    """The robot turns a little all the time while it drives: w + b."""

    stage = "body"
    physics = "Something pulls to one side whatever the command: a dragged cable, a bent wheel, a drifting reference."
    source = "first principles"
    shows_in = "elapsed time"
    fixed_parameters = (Parameter("b", "rad/s", -0.005, 0.005, "rate of turn that is added while a wheel turns"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return body_change(signals, turning=values["b"] * _driving(signals.rates))


@effects.register("body_velocity_bias")
class BodyVelocityBias(MotionEffect):
    """The robot moves a little in its own frame all the time while it drives: v + b."""

    stage = "body"
    physics = "Something pulls the robot the same way whatever the command: a dragged cable, rollers that shake it on."
    source = "first principles"
    shows_in = "elapsed time"
    fixed_parameters = (
        Parameter("bx", "m/s", -0.005, 0.005, "velocity forward that is added while a wheel turns"),
        Parameter("by", "m/s", -0.005, 0.005, "velocity to the left that is added while a wheel turns"),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        return _driving(signals.rates)[:, None] * np.array([values["bx"], values["by"], 0.0])


@effects.register("start_transient")
class StartTransient(MotionEffect):
    """The robot falls behind at the start of a run: v (1 - k exp(-s / length)), s the way since it stood."""

    stage = "body"
    physics = "Play has to be taken up and rollers have to align themselves before the wheels drive the robot in full."
    source = "first principles"
    shows_in = "elapsed time"
    form_covariates = ("distance",)
    fixed_parameters = (
        Parameter("k", "1", -0.2, 0.2, "share of the velocity that is lost at first"),
        Parameter(
            "length", "m", 1e-3, 10, "way over which it comes back by a factor of e", (0.03, 0.05, 0.1, 0.2, 0.4)
        ),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        lost = values["k"] * np.exp(-signals.travelled / values["length"])
        return body_change(signals, velocity=-lost[:, None] * signals.twists[:, :2])


@effects.register("caster_pull")
class CasterPull(MotionEffect):
    """A caster that swings round takes the robot along: w + k times the rate of its swing.

    The caster stands as far behind the centre as the wheels beside it, and has a trail of 5 cm (signals.py). The side
    to which it swings is that of the turn; where the robot goes straight back, it is chance, and nothing is added.
    """

    stage = "body"
    physics = "Friction in a caster's swivel, and of its tread on the floor, turns the robot while the caster swings."
    source = (
        "J. Borenstein and L. Feng, Measurement and correction of systematic odometry errors in mobile robots, 1996 "
        "(internal forces by castor wheels)"
    )
    shows_in = "command"
    needs = frozenset({"caster_rates"})
    only_for = "differential drives, which casters hold up"
    fixed_parameters = (Parameter("k", "1", -0.05, 0.05, "turn of the robot per turn of the caster"),)

    def applies(self, robot: Robot) -> bool:
        return class_of(robot) == "differential"

    def correction(self, signals: Signals, values: Values) -> Array:
        return body_change(signals, turning=values["k"] * needed(signals.caster_rates))


@effects.register("floor_drift")
class FloorDrift(MotionEffect):
    """The floor carries the robot the same way wherever it heads: v_world + d abs(v)."""

    stage = "world"
    physics = "The floor is tilted, or its pile lies one way, and the wheels slip towards there."
    source = "first principles"
    shows_in = "heading"
    fixed_parameters = (
        Parameter("dx", "1", -0.02, 0.02, "drift along x of the reference, as a share of the speed"),
        Parameter("dy", "1", -0.02, 0.02, "drift along y of the reference, as a share of the speed"),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        return signals.speed[:, None] * np.array([values["dx"], values["dy"]])


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
