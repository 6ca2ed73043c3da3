"""Effects of tyres in curves: understeer, scrub of their contact patches, and skid steering.

A tyre takes a side force by a slip angle, in proportion to it until it slides. With front and rear axle at different
slip angles, a car of wheelbase L at the speed v and the steering angle delta turns at the rate (Gillespie 1992, ch. 6)

    w = v tan(delta) / (L + K v^2),    its rear axle sliding outward by the slip angle b v w,               (T1)

with K its understeer gradient: k = K / L, and u = sqrt(L / K) its characteristic speed, at which it turns half as fast
as its wheels point. What the matrix has is v tan(delta) / L.
"""

from __future__ import annotations

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import Parameter, Values, body_change
from omnibench.robot.effects.textbook import PACEJKA, BodyEffect
from omnibench.robot.kinematics import Array, CarDrive, Robot, class_of
from omnibench.robot.signals import Signals

_STANDS = 1e-9  # m/s, rad/s: added where a robot that stands would divide by 0
_MANDOW = (
    "A. Mandow et al., Experimental kinematics for wheeled skid-steer mobile robots, 2007; J. Pentzer, S. Brennan "
    "and K. Reichard, Model-based prediction of skid-steer robot kinematics using online estimation of track "
    "instantaneous centers of rotation, 2014"
)


class _CarEffect(BodyEffect):
    """An effect on a car, whose front wheels steer and whose rear wheels are measured."""

    shows_in = "command"
    only_for = "cars"

    def applies(self, robot: Robot) -> bool:
        return isinstance(robot.drive, CarDrive)


@effects.register("understeer")
class Understeer(_CarEffect):
    """A car turns less than its wheels point, the faster the less: w - k v^2 w / (1 + (v / u)^2), Eq. (T1).

    u is the shape of the loss at high speeds: it levels off at k u^2. With k u^2 = 1 it is the car of Eq. (T1); a u
    that no car reaches gives its first order. Its rear axle slides outward: vy - b abs(v) v w / (1 + (v / u)^2).
    """

    physics = "The front tyres need a larger slip angle than the rear ones for the side force of the curve."
    source = f"T. D. Gillespie, Fundamentals of Vehicle Dynamics, 1992 (steady-state cornering); {PACEJKA}"
    form_covariates = ("centripetal acceleration",)
    fixed_parameters = (
        Parameter("k", "s2/m2", -0.1, 0.5, "understeer gradient by the wheelbase, K / L"),
        Parameter("b", "rad s2/m", -0.02, 0.05, "slip angle of the rear axle per lateral acceleration"),
        Parameter("u", "m/s", 0.1, 1e3, "characteristic speed", (1.5, 3.0, 6.0, 1e3)),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        speed, _, turn = signals.twists.T
        turned = turn / (1 + (speed / values["u"]) ** 2)
        change = body_change(signals, turning=-values["k"] * speed**2 * turned)
        change[:, 1] = -values["b"] * np.abs(speed) * speed * turned
        return change


@effects.register("understeer_limit")
class UndersteerLimit(_CarEffect):
    """The tyres of a car slide at a lateral acceleration a: w (1 - s (1 - tanh(x) / x)), x = abs(v w) / a.

    With s = 1 the lateral acceleration saturates at a, the friction's share of gravity.
    """

    physics = "Tyres give no more side force than friction allows, however far the wheels are turned."
    source = f"E. Fiala, Seitenkraefte am rollenden Luftreifen, 1954; {PACEJKA} (side force that saturates)"
    form_covariates = ()
    fixed_parameters = (
        Parameter("s", "1", 0.0, 1.5, "share of the loss at that limit"),
        Parameter("a", "m/s2", 0.1, 100.0, "lateral acceleration at which the tyres slide", (1.0, 2.0, 4.0, 8.0)),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        speed, _, turn = signals.twists.T
        beyond = np.abs(speed * turn) / values["a"] + _STANDS
        return body_change(signals, turning=-values["s"] * (1 - np.tanh(beyond) / beyond) * turn)


@effects.register("turn_slip")
class TurnSlip(BodyEffect):
    """A robot on tyres turns more, or less, the tighter the curve: w (1 + k c / (c + c0)).

    c = abs(w) / V is the curvature of its wheels' paths, V the mean speed of the rims: finite on the spot. In
    proportion to the curvature, the torque by which a tyre resists being turned takes the same share of every turn,
    which the matrix holds; above c0 the tread slides and the torque grows no more, so that tight turns lose less (k
    above 0).
    """

    physics = "The contact patch of a tyre has a length, and its tread is twisted and scrubs where the wheel turns."
    source = f"{PACEJKA} (turn slip of the brush model)"
    shows_in = "command"
    form_covariates = ()
    only_for = "differential drives and tricycles"
    fixed_parameters = (
        Parameter("k", "1", -0.1, 0.1, "share of the turn that tight curves gain on wide ones"),
        Parameter("c0", "1/m", 0.05, 1e3, "curvature above which the tread slides", (1.0, 3.0, 10.0, 30.0)),
    )

    def applies(self, robot: Robot) -> bool:
        return class_of(robot) in ("differential", "tricycle")

    def correction(self, signals: Signals, values: Values) -> Array:
        turn = signals.twists[:, 2]
        rims = (np.abs(signals.rates) * signals.robot.radii).mean(axis=1)
        share = np.abs(turn) / (np.abs(turn) + values["c0"] * rims + _STANDS)
        return body_change(signals, turning=values["k"] * share * turn)


@effects.register("icr_shift")
class IcrShift(BodyEffect):
    """The faster a skid-steered robot turns, the farther ahead it has its centre of rotation: vy - x w abs(w).

    What the rate of turn itself loses by wider tracks is quadratic_rotation_slip.
    """

    physics = "The floor's friction across the wheels turns with their load, which turning shifts between the axles."
    source = _MANDOW
    shows_in = "command"
    form_covariates = ("turning",)
    only_for = "skid-steered robots"
    fixed_parameters = (Parameter("x", "m s/rad", -0.1, 0.1, "way ahead of the centre of rotation per rate of turn"),)

    def applies(self, robot: Robot) -> bool:
        return robot.skid

    def correction(self, signals: Signals, values: Values) -> Array:
        rate_of_turn = signals.twists[:, 2]
        added = np.zeros(signals.twists.shape)
        added[:, 1] = -values["x"] * rate_of_turn * np.abs(rate_of_turn)
        return added


@effects.register("icr_curvature")
class IcrCurvature(BodyEffect):
    """A skid-steered robot has other centres of rotation on the spot than on arcs: w (1 - k q), vy - x q w.

    q = 1 / (1 + (R / R0)^2), R = abs(v) / abs(w) being the radius of the path; what the matrix has is as on wide arcs.
    """

    physics = "On the spot all wheels slide across; on wide arcs some still grip, which brings the tracks nearer."
    source = (
        "T. Wang et al., Analysis and experimental kinematics of a skid-steering wheeled robot based on a laser "
        "scanner sensor, 2015 (ICR span as a function of the curvature)"
    )
    shows_in = "command"
    form_covariates = ("curvature",)
    only_for = "skid-steered robots"
    fixed_parameters = (
        Parameter("k", "1", -0.5, 0.5, "share of the turn that is lost on the spot, more than on wide arcs"),
        Parameter("x", "m", -0.2, 0.2, "way ahead of the centre of rotation on the spot, more than on wide arcs"),
        Parameter("R0", "m", 0.01, 1e3, "radius of the path at which half of that is left", (0.1, 0.2, 0.4, 0.8)),
    )

    def applies(self, robot: Robot) -> bool:
        return robot.skid

    def correction(self, signals: Signals, values: Values) -> Array:
        turn = signals.twists[:, 2]
        spot, away = np.square(values["R0"] * turn) + _STANDS**2, np.square(signals.speed)
        lost = turn * spot / (spot + away)
        return np.column_stack([0 * turn, -values["x"] * lost, -values["k"] * lost])
