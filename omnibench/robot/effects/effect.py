"""What an effect is: a named correction of the odometry model, with its physics and the range that is plausible."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

from omnibench.registry import Options, effects
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import Signals

Stage = Literal["actuator", "wheel", "clock", "body", "world", "reference"]
Need = Literal["wheel_angles", "session_time", "session", "targets", "poses"]
Values = Mapping[str, float]


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect.

    low, high: its plausible range, in ``unit``; a fitted value may lie outside. choices: values to try, for a parameter
    that shapes the correction (a number of rollers, a length); the correction is linear in all others and vanishes
    where they are 0.
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

    stage: where it acts. physics: a sentence on why it happens. source: where it is described. shows_in: the covariate
    over which the residual shows it. needs: what must have been recorded. run_nuisance: one value for each run, which
    is estimated and reported and is never an answer. measurement: what would tell it, where a matrix absorbs it.
    fixed_parameters: for an effect that has the same for every robot; else override ``parameters``. in_catalogue: it is
    a name for what is missing; else it is a shape without physics, never tried as a name.
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
    fixed_parameters: ClassVar[tuple[Parameter, ...]] = ()

    def __init__(self, options: Options | None = None) -> None:
        self.options = options or Options()

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        """The parameters for a robot; sessions: in their order, of the recordings that are fitted."""
        return self.fixed_parameters

    def accepts(self, parameter: str) -> bool:  # noqa: ARG002
        """Whether a parameter may be given that ``parameters`` does not list: one of a session that is not known."""
        return False


class MotionEffect(Effect):
    """An effect of stage wheel, clock, body or world."""

    @abstractmethod
    def correction(self, signals: Signals, values: Values) -> Array:
        """What is to be added, for every sample by itself (no memory beyond the signals).

        Stage wheel or clock: to the wheel rates, (F, N) rad/s. Body: to the twist, (F, 3) m/s, m/s, rad/s. World: to
        the velocity in the reference's frame, (F, 2) m/s. Corrections of several effects add up.
        """


class ReferenceEffect(Effect):
    """An effect of stage reference: what the reference reports of the robot's pose. It acts on no odometry."""

    stage: ClassVar[Stage] = "reference"

    def delays(self, stamps: Array, values: Values) -> tuple[Array, Array]:  # noqa: ARG002
        """By how much earlier than their stamps (K,) position and heading were taken: two of (K,), s."""
        return 0 * stamps, 0 * stamps

    def reported(self, poses: Array, start: Array, values: Values) -> Array:  # noqa: ARG002
        """What the reference reports of true poses (K, 3), start: the run's true start pose (3,)."""
        return poses

    def corrected(self, poses: Array, start: Array, values: Values) -> Array:  # noqa: ARG002
        """The inverse of ``reported``."""
        return poses


class ActuatorEffect(Effect):
    """An effect of stage actuator: from target to true wheel rates. For simulation; odometry does not need it."""

    stage: ClassVar[Stage] = "actuator"

    @abstractmethod
    def driven(self, durations: Array, targets: Array, values: Values) -> Array:
        """Mean wheel rates (F, N) that the motors reach for targets (F, N), rad/s, from rest; durations (F,) s."""


effects.contract = Effect
