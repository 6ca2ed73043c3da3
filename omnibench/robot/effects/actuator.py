"""Motors and their controllers: from target to true wheel rates. For simulation; odometry measures the true ones."""

from __future__ import annotations

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import ActuatorEffect, Parameter, Values
from omnibench.robot.kinematics import Array

_SOURCE = "first principles"


@effects.register("motor_lag")
class MotorLag(ActuatorEffect):
    """Wheels follow their targets with a first-order lag."""

    physics = "Inertia and a controller of finite bandwidth delay what was told."
    source = _SOURCE
    shows_in = "acceleration"
    needs = frozenset({"targets"})
    fixed_parameters = (Parameter("tau", "s", 0.0, 0.3, "time constant"),)

    def driven(self, durations: Array, targets: Array, values: Values) -> Array:
        """Means over each sample of the exact solution for targets that are constant within samples."""
        tau = values["tau"]
        if tau <= 0:
            return targets.copy()
        mean_left = (-np.expm1(-durations / tau) * tau / durations)[:, None]
        return targets + (_reached(np.exp(-durations / tau), targets) - targets) * mean_left


def _reached(left: Array, targets: Array) -> Array:
    """Rates (F, N) at the beginning of each sample; left (F,): share of the distance to the target after a sample."""
    from scipy.linalg.lapack import dtbtrs  # slow to import, and not needed by a live node

    before = np.zeros(targets.shape)
    if len(targets) > 1:
        bands = np.ones((2, len(targets) - 1))
        bands[1, :-1] = -left[1:-1]
        before[1:] = dtbtrs(bands, (1 - left[:-1, None]) * targets[:-1], uplo="L")[0]
    return before


@effects.register("motor_dead_band")
class MotorDeadBand(ActuatorEffect):
    """Targets below a threshold do not move a wheel, and larger ones are reduced by it."""

    physics = "Static friction takes a part of what drives the motor."
    source = "H. Olsson et al., Friction models and friction compensation, 1998"
    shows_in = "wheel rate"
    needs = frozenset({"targets"})
    fixed_parameters = (Parameter("band", "rad/s", 0.0, 0.1, "half the width of the dead band"),)

    def driven(self, durations: Array, targets: Array, values: Values) -> Array:  # noqa: ARG002
        return np.sign(targets) * np.maximum(np.abs(targets) - values["band"], 0.0)


@effects.register("motor_gain")
class MotorGain(ActuatorEffect):
    """Wheels turn faster or slower than they were told, by a factor."""

    physics = "The controller's scale of counts per turn, or its supply, is off."
    source = _SOURCE
    shows_in = "wheel rate"
    needs = frozenset({"targets"})
    fixed_parameters = (Parameter("g", "1", -0.05, 0.05, "by how much wheels turn faster than they were told"),)

    def driven(self, durations: Array, targets: Array, values: Values) -> Array:  # noqa: ARG002
        return (1 + values["g"]) * targets
