"""The truth behind simulated recordings: the true robot, and its record in the truth folder."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from omnibench.config import Model
from omnibench.errors import UnknownNameError
from omnibench.registry import effects
from omnibench.robot.calibration import EffectTerm, Row, matrix_rows
from omnibench.robot.effects.effect import ActuatorEffect
from omnibench.robot.effects.term import make_term
from omnibench.robot.kinematics import Array, Robot, Wheel, inverse_kinematic_matrix
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, WheelLog
from omnibench.robot.published_matrices import published_matrix
from omnibench.simulate.config import EncoderNoise, Truth


@dataclass(frozen=True, eq=False)
class TrueRobot:
    """The true robot of a simulation: its matrix, and effects of any stage."""

    model: OdometryModel

    def driven(self, times: Array, targets: Array) -> Array:
        """True mean wheel rates (F, N), rad/s, for targets (F, N) in samples that end at times (F,), s."""
        rates = targets
        for term in self.model.terms:
            if isinstance(term.effect, ActuatorEffect):
                rates = term.effect.driven(np.diff(times, prepend=0.0), rates, term.values)
        return rates

    def log(
        self,
        times: Array,
        rates: Array,
        start: Array,
        stamps: Array,
        angles: Array,
        started_at: float | None,
        session: str | None,
    ) -> WheelLog:
        """Log of the true wheel rates (F, N), from a start pose (3,) and start angles of the wheels (N,), rad, on."""
        turned = np.cumsum(rates * np.diff(times, prepend=0.0)[:, None], axis=0)
        return WheelLog(times, rates, start, stamps, angles + turned, started_at, session)


class TruthRecord(Model):
    """Record of the truth; it goes to its own folder, which fitting and comparing never read."""

    dataset: str
    robot: Robot
    sample_period: float
    matrix: tuple[Row, Row, Row]
    integration: Integration
    noise: EncoderNoise
    effects: tuple[EffectTerm, ...] = ()
    wheels: tuple[Wheel, ...] | None = Field(None, description="the true wheels, if they were drawn about the design")

    def true_robot(self, step: float | None = None) -> TrueRobot:
        """The true robot. step: of its motion, s; default: the sample period.

        OmnibenchError in one line: an effect or a parameter is unknown, or a parameter is missing.
        """
        where = _place(self.dataset)
        terms = tuple(make_term(effect.name, effect.parameters, self.robot, where) for effect in self.effects)
        return TrueRobot(
            OdometryModel(self.robot, np.array(self.matrix), self.integration, terms, step or self.sample_period)
        )


def true_record(
    truth: Truth,
    robot: Robot,
    sample_period: float,
    sessions: tuple[str, ...],
    dataset: str,
    *,
    integration: Integration = "arc",
    noise: EncoderNoise | None = None,
) -> TruthRecord:
    """The record of a data set's truth. UnknownNameError as for ``complete_effects``."""
    return TruthRecord(
        dataset=dataset,
        robot=robot,
        sample_period=sample_period,
        matrix=matrix_rows(true_matrix(truth, robot)),
        integration=integration,
        noise=noise or EncoderNoise(),
        effects=complete_effects(truth, robot, sessions, dataset),
        wheels=true_wheels(truth, robot),
    )


def complete_effects(truth: Truth, robot: Robot, sessions: tuple[str, ...], dataset: str) -> tuple[EffectTerm, ...]:
    """The effects with parameters that are left out set to 0, so that one wheel of several may be eccentric.

    An effect without any parameter is left as it is. sessions: names of those that are driven. UnknownNameError: no
    such effect, or no such parameter for this robot and these sessions.
    """
    return tuple(_complete(term, robot, sessions, _place(dataset)) for term in truth.effects)


def true_wheels(truth: Truth, robot: Robot) -> tuple[Wheel, ...] | None:
    """The wheels drawn about the design, if the truth says so."""
    if truth.tolerances is None:
        return None
    rng = np.random.default_rng(truth.tolerances.seed)
    draws = rng.standard_normal((3, len(robot.wheels)))
    drawn = []
    for wheel, (radius, distance, angle) in zip(robot.wheels, draws.T.tolist(), strict=True):
        changes = {
            "radius": wheel.radius * (1 + truth.tolerances.radius * radius),
            "distance": wheel.distance * (1 + truth.tolerances.distance * distance),
            "angle": wheel.angle + math.radians(truth.tolerances.angle_deg) * angle,
        }
        drawn.append(wheel.model_copy(update=changes))
    return tuple(drawn)


def true_matrix(truth: Truth, robot: Robot) -> Array:
    """The hidden inverse kinematic matrix (3, N)."""
    if truth.published is not None:
        return published_matrix(truth.published)
    if truth.matrix is not None:
        return np.array(truth.matrix)
    wheels = true_wheels(truth, robot)
    assert wheels is not None  # one of the three is given
    return inverse_kinematic_matrix(wheels)


def _complete(term: EffectTerm, robot: Robot, sessions: tuple[str, ...], where: str) -> EffectTerm:
    parameters = effects.create(term.name, where=where).parameters(robot, sessions)
    known = {parameter.name for parameter in parameters}
    for given in term.parameters:
        if given not in known:
            raise UnknownNameError("parameter", given, known, f"{where}: effect {term.name!r}")
    unchanged = {parameter.name: 0.0 for parameter in parameters if not parameter.choices}
    if unchanged.keys().isdisjoint(term.parameters):
        return term  # whoever uses it refuses it for its missing parameters
    return term.model_copy(update={"parameters": unchanged | term.parameters})


def _place(dataset: str) -> str:
    return f"data set {dataset}: truth.effects"
