"""The interface of effects: named corrections of the odometry model, with their physics and plausible ranges."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from omnibench.registry import Options, effects
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import Signals

Stage = Literal["actuator", "wheel", "steering", "clock", "body", "world", "reference"]
Need = Literal["wheel_angles", "session_time", "session", "targets", "poses", "steering_side", "caster_rates"]
Values = Mapping[str, float]


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect.

    low, high: plausible range, in ``unit``; a fitted value may lie outside. choices: values to try, for a parameter in
    which the correction is not linear (a number of rollers, a length). The correction is linear in all other parameters
    and vanishes where they are 0.
    """

    name: str
    unit: str
    low: float
    high: float
    description: str
    choices: tuple[float, ...] = ()

    @property
    def largest(self) -> float:
        """The largest plausible size."""
        return max(abs(self.low), abs(self.high))


class Effect(ABC):
    """A term that can be added to the odometry model. Derive from one of the three kinds below.

    stage: where it acts. physics: a sentence on its cause. source: literature. shows_in: the covariate on which the
    residual depends. needs: data that must have been recorded, and signals that are computed only on demand.
    run_nuisance: True if it has one value for each run, which is estimated and reported but is no answer of
    ``discover``. measurement: how to measure it, for an effect that a change of the matrix can absorb. only_for: the
    robots to which it applies, in words, where these are not all; then override ``applies``. form_covariates: with what
    its size may vary (forms.py), by default what follows from shows_in. fixed_parameters: parameters that are the same
    for every robot; otherwise override ``parameters``. in_catalogue: False for a smooth
    function without physics, which ``discover`` never names. weighted: True if it has weights beside its parameters,
    many numbers that only training finds; then override ``with_weights`` and ``trial_weights``.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    physics: ClassVar[str]
    source: ClassVar[str]
    shows_in: ClassVar[str]
    needs: ClassVar[frozenset[Need]] = frozenset()
    run_nuisance: ClassVar[bool] = False
    in_catalogue: ClassVar[bool] = True
    measurement: ClassVar[str] = ""
    only_for: ClassVar[str] = ""
    form_covariates: ClassVar[tuple[str, ...] | None] = None
    fixed_parameters: ClassVar[tuple[Parameter, ...]] = ()
    weighted: ClassVar[bool] = False

    def __init__(self, options: Options | None = None) -> None:
        self.options = options or Options()

    def applies(self, robot: Robot) -> bool:  # noqa: ARG002
        """True for a robot that has what the effect acts on."""
        return True

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        """The parameters for a robot; sessions: names, in order, of the sessions that are fitted."""
        return self.fixed_parameters

    def accepts(self, parameter: str) -> bool:  # noqa: ARG002
        """True for a parameter that ``parameters`` does not list but that is valid: one of an unknown session."""
        return False

    def with_weights(self, weights: Array, robot: Robot, prefix: str) -> Effect:  # noqa: ARG002
        """The effect with weights (n,) for a robot. DataError, which begins with ``prefix``: they do not fit it."""
        return self

    def trial_weights(self, robot: Robot) -> Array:  # noqa: ARG002
        """Some weights (n,) for a robot with which the effect changes something, for tests."""
        return np.empty(0)


class MotionEffect(Effect):
    """An effect of stage wheel, steering, clock, body or world."""

    @abstractmethod
    def correction(self, signals: Signals, values: Values) -> Array:
        """The correction that is added, for every sample by itself (no memory beyond the signals).

        Stage wheel or clock: to the wheel rates, (F, N) rad/s. Steering: to the steering angles, (F, S) rad. Body: to
        the twist of the robot's centre, (F, 3) m/s, m/s, rad/s. World: to the velocity in the reference's frame, (F, 2)
        m/s. Corrections of several effects add up.
        """


class ReferenceEffect(Effect):
    """An effect of stage reference: it changes the poses that the reference reports, not the odometry."""

    stage: ClassVar[Stage] = "reference"

    def delays(self, stamps: Array, values: Values) -> tuple[Array, Array]:  # noqa: ARG002
        """Delays (K,) of position and of heading, s: how much earlier than their stamps (K,) they were measured."""
        return 0 * stamps, 0 * stamps

    def reported(self, poses: Array, start: Array, values: Values) -> Array:  # noqa: ARG002
        """Poses (K, 3) that the reference reports for true poses (K, 3); start (3,): the run's true start pose."""
        return poses

    def corrected(self, poses: Array, start: Array, values: Values) -> Array:  # noqa: ARG002
        """True poses (K, 3) for reported ones: the inverse of ``reported``."""
        return poses


class ActuatorEffect(Effect):
    """An effect of stage actuator: from target to true wheel rates. For simulation; odometry does not need it."""

    stage: ClassVar[Stage] = "actuator"

    @abstractmethod
    def driven(self, durations: Array, targets: Array, values: Values) -> Array:
        """Mean wheel rates (F, N) under targets (F, N), rad/s, from rest; durations (F,): the samples', s."""


effects.contract = Effect
