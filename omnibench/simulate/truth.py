"""The truth behind a simulation: the true robot, its record in the truth folder, and the noise of its poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pydantic import Field

from omnibench.config import Model
from omnibench.data.dataset import Dataset
from omnibench.data.true_poses import TruePath
from omnibench.errors import require_choice
from omnibench.registry import effects
from omnibench.robot import kinematics
from omnibench.robot.calibration import EffectTerm, Noise, Row, matrix_rows
from omnibench.robot.corrections import Corrected, check_needs, corrected, needs_of
from omnibench.robot.effects.effect import ActuatorEffect, Term, check_applies
from omnibench.robot.model import OdometryModel, reported_poses
from omnibench.robot.odometry import Integration, WheelLog
from omnibench.robot.signals import of_centre, signals_of
from omnibench.simulate import mechanics as physics
from omnibench.simulate.commands import Variation
from omnibench.simulate.config import EncoderNoise, Experiment, FlowerConfig, Truth
from omnibench.simulate.floor_plan import FloorPlan
from omnibench.views import Brief


def reference_noise(noise: Noise, times: kinematics.Array, rng: np.random.Generator) -> kinematics.Array:
    """Noise (K, 3) of the reference poses in m, m, rad; none at t = 0, where the start pose is exact."""
    white = np.array([noise.pose_position, noise.pose_position, noise.pose_heading])
    walk = np.array([noise.walk_position, noise.walk_position, noise.walk_heading])
    bias = np.array([noise.bias_position, noise.bias_position, noise.bias_heading])
    steps = np.sqrt(np.diff(times))[:, None] * rng.standard_normal((len(times) - 1, 3))
    after_start = (
        bias * rng.standard_normal(3)
        + walk * np.cumsum(steps, axis=0)
        + white * rng.standard_normal((len(times) - 1, 3))
    )
    return np.vstack([np.zeros(3), after_start])


_SETTLES = 3  # corrections of a car's rates for the effects on them, each of which leaves some 1 % of the one before


@dataclass(frozen=True, eq=False)
class TrueRobot:
    """The true robot of a simulation: its matrix, and effects of any stage.

    contacts: its wheels on the floor, which move it where they were drawn about the design; without them, and for omni
    and mecanum wheels that are placed by distance and angle, the matrix does.
    """

    model: OdometryModel
    contacts: physics.WheelContacts | None = None

    @property
    def has_differential(self) -> bool:
        """True for a car, of whose rear wheels the mean rate is driven."""
        return self.contacts is not None and self.contacts.has_differential

    def driven(self, times: kinematics.Array, targets: kinematics.Array) -> kinematics.Array:
        """True mean wheel rates (F, N), rad/s, for targets (F, N) in samples that end at times (F,), s."""
        rates = targets
        for term in self.model.terms:
            if isinstance(term.effect, ActuatorEffect):
                rates = term.effect.driven(np.diff(times, prepend=0.0), rates, term.values)
        return rates

    def log(
        self,
        times: kinematics.Array,
        rates: kinematics.Array,
        start: kinematics.Array,
        stamps: kinematics.Array,
        angles: kinematics.Array,
        started_at: float | None,
        session: str | None,
        steering: kinematics.Array | None = None,
    ) -> WheelLog:
        """Log of what exact encoders would measure, from a start pose (3,) and angles of the wheels (N,), rad, on.

        rates (F, N): of the wheels, rad/s; of a car's, whose differential lets each turn as it rolls, the mean counts.
        steering (F, S): angles at the samples' ends, rad, where the robot steers.
        """
        durations = np.diff(times, prepend=0.0)[:, None]
        drive = None if steering is None else self.model.robot.drive
        turned = angles + np.cumsum(rates * durations, axis=0)
        log = WheelLog(times, rates, start, stamps, turned, started_at, session, steering, drive)
        if self.contacts is None or not self.has_differential:
            return log
        for _ in range(_SETTLES):
            twists, true = self._motion(log)
            rates = self.contacts.rolling_rates(twists) - (true.rates - log.rates)
            turned = angles + np.cumsum(rates * durations, axis=0)
            log = replace(log, rates=rates, wheel_angles=turned)
        return log

    def poses(self, log: WheelLog) -> kinematics.Array:
        """True poses (S, 3) of the tracked point at the log's stamps."""
        if self._by_model:
            return self.model.poses([log])[0]
        twists, true = self._motion(log)
        if true.body is not None:
            twists = twists + true.body
        mount = self.model.robot.mount
        if self.contacts is not None:
            twists = self.contacts.tracked(twists)
        elif mount is not None:
            twists = twists @ mount.twist.T
        motion = physics.TrueMotion(log.times, log.start, twists, self.model.integration, true.world)
        return motion.poses(log.stamps)

    def reported(self, log: WheelLog) -> kinematics.Array:
        """Poses (S, 3) that an exact reference reports at the log's stamps, with the effects on it."""
        if self._by_model:
            return self.model.reported([log])[0]
        return reported_poses(self.model.reference_terms, [log], lambda logs: [*map(self.poses, logs)])[0]

    @property
    def _by_model(self) -> bool:
        """True if the model has the whole motion: without contacts, and without mechanics beside them."""
        return self.contacts is None and physics.MECHANICS.isdisjoint(term.name for term in self.model.motion_terms)

    def _motion(self, log: WheelLog) -> tuple[kinematics.Array, Corrected]:
        """Twists (F, 3) of the centre that the true wheels give, and the effects of motion on a log."""
        model = self.model
        check_needs(model.motion_terms, log)
        mechanics = [term for term in model.motion_terms if term.name in physics.MECHANICS]
        terms = [term for term in model.motion_terms if term.name not in physics.MECHANICS]
        true = Corrected(log.rates, log.middle_steering)
        if terms:
            assert model.sample_period is not None  # there are terms
            true = corrected(terms, signals_of(log, model.robot, model.matrix, model.sample_period, needs_of(terms)))
        if mechanics:
            true = self._with_mechanics(log, true, mechanics)
        return self._twists(true), true

    def _twists(self, true: Corrected) -> kinematics.Array:
        """Twists (F, 3) of the centre that wheels give by their contacts, or by the matrix."""
        if self.contacts is not None:
            return self.contacts.twists(true.rates, true.steering)
        robot = self.model.robot
        return of_centre(robot, robot.drive.signals(true.rates, true.steering) @ self.model.matrix.T)

    def _with_mechanics(self, log: WheelLog, true: Corrected, terms: Sequence[Term]) -> Corrected:
        """Wheel samples as steering, casters and grip make them besides other effects: each in its own turn."""
        robot, durations = self.model.robot, np.diff(log.times, prepend=0.0)
        if log.steering is not None:
            assert true.steering is not None
            ends = log.steering
            for term in terms:
                if term.name in physics.STEERING:
                    ends = physics.steering_truth(term.name, term.values, ends, durations)
            turned_to = true.steering + kinematics.in_the_middle(ends) - kinematics.in_the_middle(log.steering)
            true = replace(true, steering=turned_to)
            for term in terms:
                if term.name == physics.COUPLING:
                    turned = physics.turned_by_steering(term.values, robot.wheels, log.steering, durations)
                    true = replace(true, rates=true.rates + turned)
        for term in terms:
            if term.name == physics.LIGHT_WHEEL:
                twists = self._twists(true)
                lost = physics.lost_by_light_wheels(term.values, robot.wheels, true.steering, twists, durations)
                true = replace(true, rates=true.rates - lost)
        twists = self._twists(true)
        for term in terms:
            if term.name in physics.BODY:
                added = physics.body_truth(term.name, term.values, robot, twists, durations)
                true = replace(true, body=added if true.body is None else true.body + added)
        return true


class TruthRecord(Model):
    """Record of the truth; it goes to its own folder, which fitting and comparing never read."""

    dataset: str
    robot: kinematics.Robot
    sample_period: float
    matrix: tuple[Row, Row, Row]
    integration: Integration = "arc"
    noise: EncoderNoise = EncoderNoise()
    effects: tuple[EffectTerm, ...] = ()
    wheels: tuple[kinematics.Wheel, ...] | None = Field(
        None, description="the true wheels, if they were drawn about the design"
    )
    steering_offsets: dict[str, float] = Field({}, description="drawn: true steering angle less the measured one, rad")
    mount: kinematics.Mount | None = Field(None, description="the true tracked point, if it is not the robot's centre")
    lateral_friction: float = 0.0
    variation: Variation = Field(Variation(), description="of the commands within a run")

    def true_robot(self, step: float | None = None) -> TrueRobot:
        """The true robot. step: of its motion, s; default: the sample period.

        OmnibenchError in one line: an effect or a parameter is unknown, or a parameter is missing.
        """
        robot = self.robot if self.mount is None else self.robot.model_copy(update={"mount": self.mount})
        terms = tuple(effect.term(robot, f"data set {self.dataset}: truth.effects") for effect in self.effects)
        model = OdometryModel(robot, np.array(self.matrix), self.integration, terms, step or self.sample_period)
        contacts = None
        if self.wheels is not None:
            drawn = _Drawn(self.wheels, self.steering_offsets, self.mount)
            contacts = drawn.contacts(self.robot, self.lateral_friction)
        return TrueRobot(model, contacts)


def true_record(config: Experiment[Any], dataset: str) -> TruthRecord:
    """The record of the truth behind a config's data set.

    UnknownNameError: no such effect, or no such parameter for this robot and these sessions.
    """
    truth, robot, where = config.truth, config.robot, f"data set {dataset}: truth.effects"
    drawn = _drawn(truth, robot) or _Drawn(None, {}, robot.mount)
    record = TruthRecord(
        dataset=dataset,
        robot=robot,
        sample_period=config.sample_period,
        matrix=matrix_rows(true_matrix(truth, robot)),
        effects=tuple(_complete(term, robot, tuple(config.sessions), where) for term in truth.effects),
        lateral_friction=truth.lateral_friction,
        **vars(drawn),
    )
    if not isinstance(config, FlowerConfig):
        return record
    of_flower = {"integration": config.integration, "noise": config.noise, "variation": config.commands.variation}
    return record.model_copy(update=of_flower)


def true_matrix(truth: Truth, robot: kinematics.Robot) -> kinematics.Array:
    """The hidden inverse kinematic matrix (3, M); of a car with steering offsets the one for small angles."""
    if truth.published is not None:
        return kinematics.published_matrix(truth.published)
    if truth.matrix is not None:
        return np.array(truth.matrix)
    drawn = _drawn(truth, robot)
    assert drawn is not None  # one of the three is given
    assert drawn.wheels is not None
    contacts = drawn.contacts(robot, truth.lateral_friction)
    return kinematics.inverse_kinematic_matrix(drawn.wheels) if contacts is None else contacts.matrix


@dataclass(frozen=True)
class _Drawn:
    """A robot drawn about its design, named as in the record; wheels: None where none is drawn."""

    wheels: tuple[kinematics.Wheel, ...] | None
    steering_offsets: dict[str, float]
    mount: kinematics.Mount | None

    def contacts(self, robot: kinematics.Robot, lateral_friction: float) -> physics.WheelContacts | None:
        """The contacts of the wheels with the floor, of the ``robot`` as designed.

        None for omni and mecanum wheels placed by distance and angle, which the matrix of Eq. (3) or its general form
        moves.
        """
        if self.mount is None and all(wheel.distance is not None and wheel.measured for wheel in robot.wheels):
            return None
        assert self.wheels is not None
        offsets = [self.steering_offsets[name] for name in robot.drive.steered]
        return physics.WheelContacts(robot, self.wheels, offsets, self.mount, lateral_friction)


def _drawn(truth: Truth, robot: kinematics.Robot) -> _Drawn | None:
    """The robot drawn about the design, if the truth says so."""
    given = truth.tolerances
    if given is None:
        return None
    rng = np.random.default_rng(given.seed)
    radii, distances, angles = rng.standard_normal((3, len(robot.wheels))).tolist()
    places = rng.standard_normal((len(robot.wheels), 2)).tolist()
    wheels = []
    for wheel, radius, distance, angle, place in zip(robot.wheels, radii, distances, angles, places, strict=True):
        changes = {"radius": wheel.radius * (1 + given.radius * radius)}
        if wheel.distance is not None:
            changes["distance"] = wheel.distance * (1 + given.distance * distance)
        else:
            x, y = wheel.position
            changes |= {"x": x + given.position * place[0], "y": y + given.position * place[1]}
        if wheel.kind != "steered":
            axle_or_rolling = wheel.rolling if wheel.kind == "fixed" else wheel.axle
            changes["angle"] = axle_or_rolling + math.radians(given.angle_deg) * angle
        wheels.append(wheel.model_copy(update=changes))
    steered = robot.drive.steered
    offsets = np.radians(given.steering_deg * rng.standard_normal(len(steered))).tolist()
    mount = robot.mount
    if given.mount or given.mount_deg:
        x, y, yaw = rng.standard_normal(3).tolist()
        design = robot.mount or kinematics.Mount()
        mount = kinematics.Mount(
            x=design.x + given.mount * x,
            y=design.y + given.mount * y,
            yaw=design.yaw + math.radians(given.mount_deg) * yaw,
        )
    return _Drawn(tuple(wheels), dict(zip(steered, offsets, strict=True)), mount)


def _complete(term: EffectTerm, robot: kinematics.Robot, sessions: tuple[str, ...], where: str) -> EffectTerm:
    """An effect with parameters that are left out set to 0, so that one wheel of several may be eccentric.

    One without any parameter is left as it is.
    """
    effect = effects.create(term.name, where=where)
    check_applies(effect, robot, f"{where}: effect {term.name!r}")
    parameters = effect.parameters(robot, sessions)
    for given in term.parameters:
        names = {parameter.name for parameter in parameters}
        require_choice("parameter", given, names, f"{where}: effect {term.name!r}")
    unchanged = {parameter.name: 0.0 for parameter in parameters if not parameter.choices}
    if unchanged.keys().isdisjoint(term.parameters):
        return term  # whoever uses it refuses it for its missing parameters
    return term.model_copy(update={"parameters": unchanged | term.parameters})


@dataclass(frozen=True, repr=False)
class Simulation(Brief):
    """A simulated data set and, apart from it, the truth behind it.

    The robot simulator also gives paths: the true path of each run. plan: the room. starts: the true start pose (3,) in
    the room of each run, m, m, rad.
    """

    dataset: Dataset
    truth: TruthRecord
    paths: Mapping[str, TruePath] = field(default_factory=dict)
    plan: FloorPlan | None = None
    starts: Mapping[str, kinematics.Array] = field(default_factory=dict)
