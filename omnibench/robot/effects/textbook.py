"""Effects of the textbook: on wheels and tread, slip, friction, mounting, drift, clocks, and motors.

Drift is motion that the wheel rates do not show: while driving, at the start of a run, or relative to the floor.
Effects of steering are in steering.py, those of tyres in curves in tyres.py, those of the place in floor.py.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from omnibench.registry import effects
from omnibench.robot.effects.effect import ActuatorEffect, MotionEffect, Parameter, ReferenceEffect, Values, body_change
from omnibench.robot.kinematics import Array, Robot, class_of
from omnibench.robot.signals import STILL, Signals, needed

PACEJKA = "H. B. Pacejka, Tire and Vehicle Dynamics"
_BORENSTEIN = (
    "J. Borenstein and L. Feng, Measurement and correction of systematic odometry errors in mobile robots, 1996"
)
_CENSI = (
    "A. Censi, A. Franchi, L. Marchionni and G. Oriolo, Simultaneous calibration of odometry and sensor parameters "
    "for mobile robots, 2013"
)

_FURGALE = (
    "P. Furgale, J. Rehder and R. Siegwart, Unified temporal and spatial calibration for multi-sensor systems, 2013"
)

_RATES = (2.5, 4.0, 6.3, 10.0, 16.0, 25.0)  # rad/s, preferred numbers (R5 of ISO 3) of geared wheels; chosen
_RADIUS_OF = "radius_"
_STANDS = 3  # wheels around a robot, each with two neighbours
_LEADS = 1e-3  # share of the rollers' angle by which wheels in one direction are put in their order
_WOBBLES = 4  # wheels: three stand on any floor, of four one may be lighter
KNEE = 0.05  # rad/s, half-width of the smoothed sign function; chosen


def has_rollers(robot: Robot) -> bool:
    """True if a wheel with a measured rate has rollers."""
    return any(wheel.kind in ("omni", "mecanum") for wheel in robot.measured)


class WheelEffect(MotionEffect):
    """An effect on the wheel rates."""

    stage = "wheel"


class BodyEffect(MotionEffect):
    """An effect on the twist of the robot's centre."""

    stage = "body"


class EachWheelEffect(WheelEffect):
    """An effect on the wheel rates, with parameters ``<name>_<wheel>`` of each wheel before the fixed ones."""

    for_each_wheel: ClassVar[tuple[Parameter, ...]]

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        of_wheels = (
            replace(item, name=f"{item.name}_{name}", description=f"{item.description}, wheel {name}")
            for item in self.for_each_wheel
            for name in robot.wheel_names
        )
        return (*of_wheels, *self.fixed_parameters)


def of_wheels(robot: Robot, prefix: str, values: Values) -> Array:
    """The values (N,) of the parameters ``prefix_<wheel>``."""
    return np.array([values[f"{prefix}_{name}"] for name in robot.wheel_names])


@effects.register("speed_dependent_radius")
class SpeedDependentRadius(WheelEffect):
    """The radius of all wheels changes with their rate: r (1 + k abs(omega))."""

    physics = "A soft tread grows with the rate of its wheel, or is pressed flatter by what drives it."
    source = f"{PACEJKA} (effective rolling radius)"
    shows_in = "wheel rate"
    fixed_parameters = (Parameter("k", "s/rad", -0.02, 0.02, "relative change of the radius per rad/s"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["k"] * np.abs(signals.rates) * signals.rates


@effects.register("direction_dependent_radius")
class DirectionDependentRadius(EachWheelEffect):
    """A wheel drives farther one way than the other: omega + k_i abs(omega)."""

    physics = "Rollers, tread or backlash give way differently when a wheel turns backwards."
    source = "first principles"
    shows_in = "command"
    for_each_wheel = (Parameter("k", "1", -0.01, 0.01, "half the relative difference between both directions"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return of_wheels(signals.robot, "k", values) * np.abs(signals.rates)


@effects.register("thermal_radius_drift")
class ThermalRadiusDrift(WheelEffect):
    """The radius of all wheels drifts in the course of a session: r (1 + k session time)."""

    physics = "Treads warm up while they roll and expand, or soften and sink in."
    source = "first principles"
    shows_in = "order of runs"
    needs = frozenset({"session_time"})
    # 2 % within 1000 s; over hours the drift levels off, and its mean rate is smaller.
    fixed_parameters = (Parameter("k", "1/s", -2e-5, 2e-5, "relative change of the radius per second of the session"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return (values["k"] * needed(signals.session_time))[:, None] * signals.rates


@effects.register("tyre_wear")
class TyreWear(WheelEffect):
    """The radius of all wheels differs from session to session: r (1 + radius_session)."""

    physics = "Treads wear off, or are changed or pumped up, between two sessions."
    source = _BORENSTEIN
    shows_in = "order of runs"
    needs = frozenset({"session"})

    def parameters(self, robot: Robot, sessions: tuple[str, ...] = ()) -> tuple[Parameter, ...]:  # noqa: ARG002
        return tuple(
            Parameter(f"{_RADIUS_OF}{session}", "1", -0.01, 0.01, f"relative to the radius of session {sessions[0]}")
            for session in sessions[1:]
        )

    def accepts(self, parameter: str) -> bool:
        return parameter.startswith(_RADIUS_OF)

    def correction(self, signals: Signals, values: Values) -> Array:
        """The correction; zero in a session without a radius of its own."""
        return values.get(f"{_RADIUS_OF}{signals.session}", 0.0) * signals.rates


def _centripetal(twists: Array) -> Array:
    """w x v (F, 2) of twists (F, 3), m/s2."""
    across: Array = twists[:, 2:] * twists[:, 1::-1]  # w vy, w vx
    across[:, 0] *= -1
    return across


@effects.register("acceleration_slip")
class AccelerationSlip(BodyEffect):
    """The robot falls behind while it accelerates: v - k dv/dt, in the robot's frame."""

    physics = "Slip of the wheels grows with the force that accelerates the robot."
    source = f"{PACEJKA} (longitudinal slip in proportion to the force)"
    shows_in = "acceleration"
    fixed_parameters = (Parameter("k", "s", 0.0, 0.1, "velocity that is lost per acceleration"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return body_change(signals, velocity=-values["k"] * signals.accelerations[:, :2])


@effects.register("centripetal_slip")
class CentripetalSlip(BodyEffect):
    """The robot slides across while it turns: v + k w x v."""

    physics = "Slip of the wheels grows with the force that keeps the robot on its curve."
    source = f"{PACEJKA} (side slip in proportion to the force)"
    shows_in = "command"
    form_covariates = ("centripetal acceleration",)
    fixed_parameters = (
        Parameter("k", "s", 0.0, 0.1, "velocity towards the inside of the curve per centripetal acceleration"),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        return body_change(signals, velocity=values["k"] * _centripetal(signals.twists))


@effects.register("load_transfer")
class LoadTransfer(WheelEffect):
    """A wheel that is pressed down has a smaller radius: r (1 - k a.u_i), u_i the direction of the wheel's axle.

    a is the whole acceleration of the body, in its own frame: dv/dt + w x v.
    """

    physics = "Accelerating shifts the robot's weight from wheel to wheel, and a tread gives way under load."
    source = f"{PACEJKA} (effective rolling radius under load)"
    shows_in = "acceleration"
    fixed_parameters = (Parameter("k", "s2/m", 0.0, 0.3, "relative change of the radius per acceleration"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        angles = np.array([wheel.outward for wheel in signals.robot.measured])
        towards = np.stack([np.cos(angles), np.sin(angles)])
        acceleration = signals.accelerations[:, :2] + _centripetal(signals.twists)
        return -values["k"] * (acceleration @ towards) * signals.rates


@effects.register("rotation_translation_coupling")
class RotationTranslationCoupling(BodyEffect):
    """The robot turns faster or slower the faster it drives: w (1 + k.v)."""

    physics = "Rollers that already slide along their axles give way more easily when the robot turns."
    source = "first principles"
    shows_in = "command"
    fixed_parameters = (
        Parameter("kx", "s/m", -0.3, 0.3, "relative change of the rate of turn per velocity forward"),
        Parameter("ky", "s/m", -0.3, 0.3, "relative change of the rate of turn per velocity to the left"),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        vx, vy, w = signals.twists.T
        return body_change(signals, turning=w * (values["kx"] * vx + values["ky"] * vy))


@effects.register("quadratic_rotation_slip")
class QuadraticRotationSlip(BodyEffect):
    """The faster the robot turns, the more of it is lost or gained: w - k w abs(w)."""

    physics = "The rollers' drag grows with the rate of turn, and the wheels slip against it."
    source = "first principles"
    shows_in = "command"
    form_covariates = ("turning",)
    fixed_parameters = (Parameter("k", "s/rad", -0.1, 0.1, "share of the rate of turn that is lost per rad/s"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        rate_of_turn = signals.twists[:, 2]
        return body_change(signals, turning=-values["k"] * rate_of_turn * np.abs(rate_of_turn))


@effects.register("light_wheel")
class LightWheel(EachWheelEffect):
    """A wheel that stands lightly slips in proportion to the force that is asked of it: omega - k_i a.u_i / r.

    u_i is the direction in which the wheel drives the robot, a the whole acceleration of the body in its own frame,
    dv/dt + w x v.
    """

    physics = "Four wheels or more share the weight as floor and frame will have it; grip goes with a wheel's share."
    source = f"{PACEJKA} (slip stiffness in proportion to the load)"
    shows_in = "acceleration"
    only_for = "robots on four measured wheels or more"
    for_each_wheel = (Parameter("k", "s", 0.0, 0.1, "rim speed that is lost per acceleration"),)

    def applies(self, robot: Robot) -> bool:
        return len(robot.wheel_names) >= _WOBBLES

    def correction(self, signals: Signals, values: Values) -> Array:
        robot, acceleration = signals.robot, signals.accelerations[:, :2] + _centripetal(signals.twists)
        lost = np.empty(signals.rates.shape)
        for index, (wheel, pair) in enumerate(zip(robot.measured, robot.drive.pairs, strict=True)):
            rollers = wheel.roller_angle
            angles: Array = np.full(len(lost), wheel.rolling - rollers)
            if pair >= 0:
                angles = angles + needed(signals.steering)[:, pair]
            driving = np.cos(angles) * acceleration[:, 0] + np.sin(angles) * acceleration[:, 1]
            lost[:, index] = driving / (wheel.radius * np.cos(rollers))
        return -of_wheels(robot, "k", values) * lost


def _smooth_sign(rates: Array) -> Array:
    """Sign of wheel rates, smoothed near 0."""
    return np.tanh(rates / KNEE)


@effects.register("wheel_dead_zone")
class WheelDeadZone(WheelEffect):
    """Every wheel that turns loses or gains a constant rate: omega + c sign(omega)."""

    physics = "Play in the drive and dry friction of the rollers take a constant rate off every wheel that turns."
    source = "H. Olsson et al., Friction models and friction compensation, 1998"
    shows_in = "wheel rate"
    fixed_parameters = (Parameter("c", "rad/s", -0.02, 0.02, "rate that is gained in the direction of rotation"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["c"] * _smooth_sign(signals.rates)


@effects.register("coulomb_creep")
class CoulombCreep(WheelEffect):
    """Every wheel that turns loses a rate in proportion to the robot's speed: omega + c sign(omega) abs(v) / r."""

    physics = "Rollers drag with a friction that does not depend on their speed, and the wheels creep against it."
    source = "F. W. Carter, On the action of a locomotive driving wheel, 1926; H. Olsson et al., 1998 (friction)"
    shows_in = "wheel rate"
    form_covariates = ("wheel rate", "speed")
    fixed_parameters = (Parameter("c", "1", -0.02, 0.02, "creep as a share of the robot's speed"),)
    only_for = "robots with a wheel on rollers"

    def applies(self, robot: Robot) -> bool:
        return has_rollers(robot)

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["c"] * _smooth_sign(signals.rates) * (signals.speed[:, None] / signals.robot.radii)


@effects.register("missed_pulses")
class MissedPulses(WheelEffect):
    """A wheel turns faster than is counted beyond some rate: omega + k max(abs(omega) - rate, 0) sign(omega)."""

    physics = "Edges of an encoder that come faster than the controller serves them are not counted."
    source = "P. Stoffregen, Encoder Library for Teensy and Arduino (edges per second that interrupts can serve)"
    shows_in = "wheel rate"
    form_covariates = ()
    fixed_parameters = (
        Parameter("k", "1", 0.0, 0.5, "share of the rate beyond the limit that is missed"),
        Parameter("rate", "rad/s", 0.1, 1e3, "beyond which counts are missed", _RATES),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        rates = signals.rates
        return values["k"] * (rates - np.clip(rates, -values["rate"], values["rate"]))


@effects.register("cross_wheel_coupling")
class CrossWheelCoupling(WheelEffect):
    """A wheel on rollers slips the more, the faster its neighbours j and l turn, next and previous counter-clockwise:

    omega_i - omega_i (k_next abs(omega_j) + k_previous abs(omega_l)) - k_both sign(omega_i) abs(omega_j omega_l).
    """

    physics = "A slack chassis, and drag of the rollers, let a wheel's load and grip go with what its neighbours do."
    source = (
        "R. L. Williams II, B. E. Carter, P. Gallina and G. Rosati, Dynamic model with slip for wheeled "
        "omnidirectional robots, 2002"
    )
    shows_in = "command"
    form_covariates = ()
    only_for = "robots on three wheels or more with rollers"
    fixed_parameters = (
        Parameter("k_next", "s/rad", -0.02, 0.02, "slip per rate of the next wheel counter-clockwise"),
        Parameter("k_previous", "s/rad", -0.02, 0.02, "slip per rate of the next wheel clockwise"),
        Parameter("k_both", "s/rad", -0.02, 0.02, "rate that is lost per product of both neighbours' rates"),
    )

    def applies(self, robot: Robot) -> bool:
        return len(robot.wheel_names) >= _STANDS and all(wheel.kind in ("omni", "mecanum") for wheel in robot.measured)

    def correction(self, signals: Signals, values: Values) -> Array:
        # Mecanum wheels that are given by lever arms have one direction a side; rollers in an X tell which is ahead
        wheels = signals.robot.measured
        order = np.argsort([(wheel.outward - _LEADS * wheel.roller_angle) % (2 * np.pi) for wheel in wheels])
        rates = signals.rates[:, order]
        following, previous = (np.abs(np.roll(rates, step, axis=1)) for step in (-1, 1))
        lost = np.empty(rates.shape)
        lost[:, order] = (values["k_next"] * following + values["k_previous"] * previous) * rates
        lost[:, order] += values["k_both"] * _smooth_sign(rates) * following * previous
        return -lost


@effects.register("lidar_lever_arm")
class LidarLeverArm(ReferenceEffect):
    """The reference tracks another point than the robot's centre: p + (R(theta) - R(theta_0)) l."""

    physics = "The LIDAR stands somewhere else on the robot than its mounting says."
    source = _CENSI
    shows_in = "command"
    measurement = "a ruler: how far forward and to the left of the robot's centre the LIDAR stands"
    fixed_parameters = (
        Parameter("x", "m", -0.05, 0.05, "where the tracked point stands, forward of the centre"),
        Parameter("y", "m", -0.05, 0.05, "where the tracked point stands, to the left of the centre"),
    )

    def reported(self, poses: Array, start: Array, values: Values) -> Array:
        shift = (np.exp(1j * poses[:, 2]) - np.exp(1j * start[2])) * complex(values["x"], values["y"])
        return np.column_stack([poses[:, 0] + shift.real, poses[:, 1] + shift.imag, poses[:, 2]])

    def corrected(self, poses: Array, start: Array, values: Values) -> Array:
        return self.reported(poses, start, {name: -value for name, value in values.items()})


def _about_the_start(poses: Array, start: Array, factor: complex) -> Array:
    """Poses (K, 3) whose positions are turned and stretched about the start by a complex factor."""
    path = ((poses[:, 0] - start[0]) + 1j * (poses[:, 1] - start[1])) * factor
    return np.column_stack([start[0] + path.real, start[1] + path.imag, poses[:, 2]])


@effects.register("lidar_yaw")
class LidarYaw(ReferenceEffect):
    """The reference's forward is not the robot's: R(beta) v."""

    physics = "The LIDAR is mounted at another angle than its mounting says."
    source = _CENSI
    shows_in = "command"
    measurement = "a wall: drive along it and see by which angle the scan of it is turned"
    fixed_parameters = (Parameter("beta", "rad", -0.035, 0.035, "by how much the reported path is turned"),)

    def reported(self, poses: Array, start: Array, values: Values) -> Array:
        return _about_the_start(poses, start, complex(np.exp(1j * values["beta"])))

    def corrected(self, poses: Array, start: Array, values: Values) -> Array:
        return self.reported(poses, start, {"beta": -values["beta"]})


@effects.register("reference_scale")
class ReferenceScale(ReferenceEffect):
    """The reference's metre is not a metre: p (1 + s), from the start on."""

    physics = "The LIDAR's range is off by a factor, and the map with it."
    source = "first principles"
    shows_in = "command"
    measurement = "a tape: the length of a wall or of a driven way against the map's"
    fixed_parameters = (Parameter("s", "1", -0.01, 0.01, "by how much lengths are reported too long"),)

    def reported(self, poses: Array, start: Array, values: Values) -> Array:
        return _about_the_start(poses, start, 1 + values["s"])

    def corrected(self, poses: Array, start: Array, values: Values) -> Array:
        return _about_the_start(poses, start, 1 / (1 + values["s"]))


@effects.register("sample_period_scale")
class SamplePeriodScale(MotionEffect):
    """Wheel rates are wrong by a factor while their stamps are right: omega (1 + s)."""

    stage = "clock"
    physics = "The controller divides encoder counts by a sample period that it does not keep."
    source = "first principles"
    shows_in = "command"
    measurement = "a time stamp of every sample: their mean distance against the nominal period"
    fixed_parameters = (Parameter("s", "1", -0.01, 0.01, "by how much the true rates are higher"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["s"] * signals.rates


@effects.register("wheel_radius")
class WheelRadius(EachWheelEffect):
    """Wheels are larger or smaller than stated: omega (1 + k_i)."""

    physics = "Treads are worn, pumped up or pressed flat, and no two wheels are alike."
    source = f"{_BORENSTEIN} (unequal wheel diameters)"
    shows_in = "command"
    measurement = "a tape: the way that each wheel rolls in ten turns under load"
    only_for = "differential and skid-steered robots, tricycles and swerve drives"
    for_each_wheel = (Parameter("k", "1", -0.05, 0.05, "by how much the radius is larger"),)

    def applies(self, robot: Robot) -> bool:
        return class_of(robot) in ("differential", "skid", "tricycle", "swerve")

    def correction(self, signals: Signals, values: Values) -> Array:
        return of_wheels(signals.robot, "k", values) * signals.rates


@effects.register("wheel_position")
class WheelPosition(EachWheelEffect):
    """Fixed wheels stand farther out than stated: omega + y_i w / r to the left, in the direction of rolling ahead."""

    physics = "The track is not the one of the drawing: wheels touch the floor at another place of their width."
    source = f"{_BORENSTEIN} (uncertainty about the effective wheelbase)"
    shows_in = "command"
    measurement = "a ruler from wheel to wheel, or better: ten turns on the spot against a mark on the floor"
    only_for = "differential and skid-steered robots"
    for_each_wheel = (Parameter("y", "m", -0.02, 0.02, "by how much farther to the left it stands"),)

    def applies(self, robot: Robot) -> bool:
        return class_of(robot) in ("differential", "skid")

    def correction(self, signals: Signals, values: Values) -> Array:
        robot = signals.robot
        along = np.cos([wheel.rolling for wheel in robot.measured])
        return of_wheels(robot, "y", values) * along / robot.radii * signals.twists[:, 2:]


def _driving(rates: Array) -> NDArray[np.bool_]:
    """True for samples (F,) in which a wheel turns."""
    return np.abs(rates).max(axis=1) > STILL


@effects.register("heading_drift")
class HeadingDrift(BodyEffect):
    """The robot turns a little all the time while it drives: w + b."""

    physics = "Something pulls to one side whatever the command: a dragged cable, a bent wheel, a drifting reference."
    source = "first principles"
    shows_in = "elapsed time"
    fixed_parameters = (Parameter("b", "rad/s", -0.005, 0.005, "rate of turn that is added while a wheel turns"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return body_change(signals, turning=values["b"] * _driving(signals.rates))


@effects.register("body_velocity_bias")
class BodyVelocityBias(BodyEffect):
    """The robot moves a little in its own frame all the time while it drives: v + b."""

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
class StartTransient(BodyEffect):
    """The robot falls behind at the start of a run: v (1 - k exp(-s / length)), s the way since it stood."""

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
class CasterPull(BodyEffect):
    """A caster that swings round takes the robot along: w + k times the rate of its swing.

    The caster stands as far behind the centre as the wheels beside it, and has a trail of 5 cm (signals.py). The side
    to which it swings is that of the turn; where the robot goes straight back, it is chance, and nothing is added.
    """

    physics = "Friction in a caster's swivel, and of its tread on the floor, turns the robot while the caster swings."
    source = f"{_BORENSTEIN} (internal forces by castor wheels)"
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


@effects.register("motor_lag")
class MotorLag(ActuatorEffect):
    """Wheels follow their targets with a first-order lag."""

    physics = "Inertia and a controller of finite bandwidth delay what was told."
    source = "first principles"
    shows_in = "acceleration"
    needs = frozenset({"targets"})
    fixed_parameters = (Parameter("tau", "s", 0.0, 0.3, "time constant"),)

    def driven(self, durations: Array, targets: Array, values: Values) -> Array:
        """Means over each sample of the exact solution for targets that are constant within samples."""
        tau = values["tau"]
        if tau <= 0:
            return targets.copy()
        from scipy.linalg.lapack import dtbtrs  # slow to import, and not needed by a live node

        # Rates (F, N) at the beginning of each sample; remaining (F,): share of the distance to the target after one.
        remaining = np.exp(-durations / tau)
        begins = np.zeros(targets.shape)
        if len(targets) > 1:
            bands = np.ones((2, len(targets) - 1))
            bands[1, :-1] = -remaining[1:-1]
            begins[1:] = dtbtrs(bands, (1 - remaining[:-1, None]) * targets[:-1], uplo="L")[0]
        mean_remaining = (-np.expm1(-durations / tau) * tau / durations)[:, None]
        return targets + (begins - targets) * mean_remaining


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
    source = "first principles"
    shows_in = "wheel rate"
    needs = frozenset({"targets"})
    fixed_parameters = (Parameter("g", "1", -0.05, 0.05, "by how much wheels turn faster than they were told"),)

    def driven(self, durations: Array, targets: Array, values: Values) -> Array:  # noqa: ARG002
        return (1 + values["g"]) * targets
