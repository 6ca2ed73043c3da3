"""Smooth functions of a covariate for unknown effects: changes of the motion along, across and in turning.

They describe an error without its cause, and are never proposed as names. A change in turning is proportional to the
distance that the wheels move, so that a standing robot is never changed. No function extrapolates beyond the data: each
is constant there or fades to zero. Eccentric wheels and their rollers, whose cause is known, are waves of the same
kind.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from omnibench.registry import effects
from omnibench.robot.effects.effect import Need, Parameter, ReferenceEffect, Values
from omnibench.robot.effects.textbook import BodyEffect, EachWheelEffect, WheelEffect, has_rollers, of_wheels
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import STILL, Signals, needed

MODES = {
    "along": "along the way",
    "across": "across the way, to the left",
    "turn": "in turning, per way of the wheels",
    "rotation": "of the rate of turn",
}
ALL_MODES = tuple(MODES)
_WITHOUT_ROTATION = ("along", "across", "turn")
SURFACES = ("x", "y", "xx", "xy", "yy", "xxx", "xxy", "xyy", "yyy")
HARMONICS = (0.5, *(float(number) for number in range(1, 17)), 1.5, 2.5, 3.5)  # waves in a turn of a wheel; chosen
KNOTS = 8  # knots of the function of each wheel's rate; chosen
_COMMON_KNOTS = 33  # knots of the function that all wheels share; chosen
_WAVE = ("cos", "sin")
_TURNS = ("cos1", "sin1", "cos2", "sin2", "cos3", "sin3")
_AXES = {"x": "m", "y": "m", "theta": "rad"}
_LARGEST = 0.1  # plausible size of a coefficient, a share of the motion; chosen
_SLOW = 1e-3  # m/s, below which the direction of travel is ill-defined; chosen
_ROUNDS = 200  # steps of the fixed-point iteration that inverts a map, at most; chosen
_SAME = 1e-13  # m, rad: a smaller change ends the iteration


def scale(name: str, unit: str, low: float, high: float, usual: float, description: str) -> Parameter:
    """A parameter that sets the range of a function; usual: the value to try."""
    return Parameter(name, unit, low, high, description, choices=(usual,))


AREA = (
    scale("centre_x", "m", -1e6, 1e6, 0.0, "middle of the places that were seen"),
    scale("centre_y", "m", -1e6, 1e6, 0.0, "middle of the places that were seen"),
    scale("reach", "m", 1e-6, 1e6, 2.0, "how far from there places were seen"),
)
PATCH = (
    *AREA[:2],
    scale("radius", "m", 1e-6, 1e6, 2.0, "from the centre, where 1/e of the change is left"),
)
LINE = (
    scale("normal", "rad", -7.0, 7.0, 0.0, "direction across the line, in the reference's frame"),
    scale("distance", "m", -1e6, 1e6, 0.0, "of the line from the reference's origin along that direction"),
)
_SESSION = scale("duration", "s", 1e-3, 1e9, 3600.0, "of the longest session that was seen")
_TOP = scale("top", "rad/s", 1e-6, 1e6, 6.0, "the fastest rate that was seen; knots are spread from -top to top")


def shared(modes: Sequence[str], labels: Sequence[str], of_what: str) -> tuple[Parameter, ...]:
    """Coefficients ``<mode>_<label>``, each a share of the motion."""
    return tuple(
        Parameter(f"{mode}_{label}", "1", -_LARGEST, _LARGEST, f"change {MODES[mode]}, with {label} of {of_what}")
        for mode in modes
        for label in labels
    )


def direction(mode: str, signals: Signals) -> Array:
    """The change of the twist (F, 3) by a mode at a share of 1."""
    twists = signals.twists
    changes = np.zeros(twists.shape)
    if mode == "along":
        changes[:, :2] = twists[:, :2]
    elif mode == "across":
        changes[:, 0], changes[:, 1] = -twists[:, 1], twists[:, 0]
    elif mode == "rotation":
        changes[:, 2] = twists[:, 2]
    else:
        changes[:, 2] = np.abs(twists[:, 2]) + signals.speed / signals.robot.reach
    return changes


def waves(angle: Array, harmonics: Sequence[float]) -> Array:
    """Cosines and sines (F, 2 m) of m multiples of an angle (F,)."""
    return np.concatenate([[np.cos(multiple * angle), np.sin(multiple * angle)] for multiple in harmonics]).T


def _inside_of(places: Array, values: Values) -> Array:
    """Positions (F, 2) relative to the centre, in units of the reach; those beyond 1 are moved to the unit circle."""
    away = (places - [values["centre_x"], values["centre_y"]]) / values["reach"]
    return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1.0)


def surfaces(places: Array, values: Values) -> Array:
    """The nine monomials (F, 9) of degree 1 to 3 in x and y of positions (F, 2), held beyond the reach."""
    x, y = _inside_of(places, values).T
    return np.column_stack([x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])


def bump(places: Array, values: Values) -> Array:
    """A Gaussian function (F, 1) of positions (F, 2), with value 1 at the centre."""
    away = (places - [values["centre_x"], values["centre_y"]]) / values["radius"]
    return np.exp(-np.square(away).sum(axis=1, keepdims=True))


def across(places: Array, values: Values) -> Array:
    """Distances (F,) of positions (F, 2) from a line, on the side of its normal positive, m."""
    return places @ [np.cos(values["normal"]), np.sin(values["normal"])] - values["distance"]


def beyond(places: Array, values: Values) -> Array:
    """A soft step (F, 1) of positions (F, 2), from 0 to 1 across a line."""
    return (0.5 + 0.5 * np.tanh(across(places, values) / values["width"]))[:, None]


class WithoutCause:
    """Attributes of effects that describe an error and not its cause, and so are not in the catalogue."""

    physics = "None: a function that was fitted to what the model left, without a cause."
    source = "fitted to data"
    in_catalogue = False


class Covariate(NamedTuple):
    """A quantity on which an error may depend: its name among residuals, words for parameters, and what it needs."""

    shows_in: str
    words: str
    needs: frozenset[Need] = frozenset()


TIME = Covariate("elapsed time", "the time since the start")
SESSION_TIME = Covariate("order of runs", "the session's time", frozenset({"session_time"}))
HEADING = Covariate("heading", "the heading", frozenset({"poses"}))
PLACE = Covariate("place", "the place", frozenset({"poses"}))
ACROSS_A_LINE = PLACE._replace(words="the line")
MOTION = Covariate("command", "the motion")


class SmoothEffect(WithoutCause, BodyEffect):
    """Changes of the motion that depend on a covariate: for each of ``modes`` a sum of the ``labels`` functions."""

    modes: ClassVar[tuple[str, ...]]
    labels: ClassVar[tuple[str, ...]]

    @abstractmethod
    def shares(self, signals: Signals, values: Values) -> Array:
        """Values (F, J) of the J functions."""

    def correction(self, signals: Signals, values: Values) -> Array:
        shares, added = self.shares(signals, values), np.zeros(signals.twists.shape)
        for mode in self.modes:
            factors = np.array([values[f"{mode}_{label}"] for label in self.labels])
            if factors.any():
                added += (shares @ factors)[:, None] * direction(mode, signals)
        return added


def smooth_effect(
    covariate: Covariate, labels: Sequence[str], *scales: Parameter, modes: Sequence[str] = ALL_MODES
) -> Callable[[Callable[[Signals, Values], Array]], type[SmoothEffect]]:
    """Decorator: a function that computes ``shares`` of signals becomes the smooth effect of its name.

    scales: parameters that set the ranges of the functions; the coefficients ``<mode>_<label>`` stand before them.
    """

    def register(function: Callable[[Signals, Values], Array]) -> type[SmoothEffect]:
        members = {
            "__module__": function.__module__,
            "__doc__": function.__doc__,
            "shows_in": covariate.shows_in,
            "needs": covariate.needs,
            "modes": tuple(modes),
            "labels": tuple(labels),
            "fixed_parameters": (*shared(modes, labels, covariate.words), *scales),
            "shares": lambda _, signals, values: function(signals, values),
        }
        effect: type[SmoothEffect] = type(function.__name__, (SmoothEffect,), members)
        return effects.register(function.__name__)(effect)

    return register


@smooth_effect(
    TIME,
    [str(order) for order in range(16)],
    scale("duration", "s", 1e-3, 1e6, 5.0, "of the longest run that was seen"),
    modes=_WITHOUT_ROTATION,
)
def smooth_elapsed_time(signals: Signals, values: Values) -> Array:
    """Unknown effect: cosines of the time since the start of a run; after the longest run seen the value is held."""
    part = np.clip(signals.elapsed / values["duration"], 0.0, 1.0)
    return np.cos(np.pi * np.arange(16) * part[:, None])


@smooth_effect(
    TIME,
    _WAVE,
    scale("frequency", "Hz", 1e-6, 1e6, 1.0, "waves in a second"),
    scale("duration", "s", 1e-3, 1e6, 5.0, "of the longest run that was seen"),
)
def smooth_time_wave(signals: Signals, values: Values) -> Array:
    """Unknown effect: a wave of the time since the start of a run; after the longest run seen the value is held."""
    return waves(values["frequency"] * (2 * np.pi * np.minimum(signals.elapsed, values["duration"])), (1.0,))


@smooth_effect(HEADING, _TURNS, modes=_WITHOUT_ROTATION)
def smooth_heading(signals: Signals, values: Values) -> Array:  # noqa: ARG001
    """Unknown effect: the first three harmonics of the robot's heading."""
    return waves(needed(signals.poses)[:, 2], (1, 2, 3))


@smooth_effect(HEADING, _WAVE, scale("harmonic", "1", 1.0, 64.0, 4.0, "waves in a turn of the robot"))
def smooth_heading_wave(signals: Signals, values: Values) -> Array:
    """Unknown effect: a wave of the robot's heading, so many times a turn."""
    return waves(values["harmonic"] * needed(signals.poses)[:, 2], (1.0,))


@effects.register("smooth_course")
class SmoothCourse(SmoothEffect):
    """Unknown effect: a steady push along the way in the world, and two harmonics of the direction of travel there.

    The harmonics fade to zero below 1 mm/s, where there is no direction of travel.
    """

    shows_in = "heading"
    needs = frozenset({"poses"})
    modes = _WITHOUT_ROTATION
    labels = _TURNS[:4]
    fixed_parameters = (
        Parameter("east", "1", -_LARGEST, _LARGEST, "push along x of the reference, of the speed"),
        Parameter("north", "1", -_LARGEST, _LARGEST, "push along y of the reference, of the speed"),
        *shared(modes, labels, "the direction of travel"),
    )

    def shares(self, signals: Signals, values: Values) -> Array:  # noqa: ARG002
        forward, left, _ = signals.twists.T
        driving = np.minimum(1.0, signals.speed / _SLOW)
        return driving[:, None] * waves(needed(signals.poses)[:, 2] + np.arctan2(left, forward), (1, 2))

    def correction(self, signals: Signals, values: Values) -> Array:
        added = super().correction(signals, values)
        push = complex(values["east"], values["north"]) * np.exp(-1j * needed(signals.poses)[:, 2])
        push *= signals.speed
        added[:, 0] += push.real
        added[:, 1] += push.imag
        return added


@smooth_effect(PLACE, SURFACES, *AREA, modes=_WITHOUT_ROTATION)
def smooth_place(signals: Signals, values: Values) -> Array:
    """Unknown effect: polynomials of degree 3 in the place on the floor; beyond the places seen the value is held."""
    return surfaces(needed(signals.poses)[:, :2], values)


@smooth_effect(PLACE, ("bump",), *PATCH)
def smooth_patch(signals: Signals, values: Values) -> Array:
    """Unknown effect: a round patch of the floor, outside of which the change fades to zero."""
    return bump(needed(signals.poses)[:, :2], values)


@smooth_effect(
    PLACE,
    _WAVE,
    scale("along_x", "rad/m", -1e3, 1e3, 10.0, "phase per way along x of the reference"),
    scale("along_y", "rad/m", -1e3, 1e3, 0.0, "phase per way along y of the reference"),
    *AREA,
)
def smooth_place_wave(signals: Signals, values: Values) -> Array:
    """Unknown effect: a plane wave over the floor, as of tiles; beyond the places seen the value is held."""
    held = values["reach"] * _inside_of(needed(signals.poses)[:, :2], values)
    return waves(held @ [values["along_x"], values["along_y"]], (1.0,))


@smooth_effect(ACROSS_A_LINE, ("beyond",), *LINE, scale("width", "m", 1e-6, 1e6, 0.05, "over which the change sets in"))
def smooth_edge(signals: Signals, values: Values) -> Array:
    """Unknown effect: the floor beyond a straight line, as a carpet's edge."""
    return beyond(needed(signals.poses)[:, :2], values)


@smooth_effect(
    ACROSS_A_LINE,
    ("joint",),
    *LINE,
    scale("width", "m", 1e-6, 1e6, 0.03, "across the joint, where 1/e of the change is left on either side"),
)
def smooth_joint(signals: Signals, values: Values) -> Array:
    """Unknown effect: a joint of the floor along a straight line, as between two rows of tiles."""
    return np.exp(-np.square(across(needed(signals.poses)[:, :2], values) / values["width"]))[:, None]


@smooth_effect(
    MOTION,
    ("bump",),
    scale("vx", "m/s", -1e3, 1e3, 0.2, "the motion, forwards"),
    scale("vy", "m/s", -1e3, 1e3, 0.0, "the motion, to the left"),
    scale("omega", "rad/s", -1e3, 1e3, 0.0, "the motion, turning"),
    scale("width", "m/s", 1e-9, 1e3, 0.3, "how far other motions are, at the wheels, where 61 % of it is left"),
    modes=_WITHOUT_ROTATION,
)
def smooth_command(signals: Signals, values: Values) -> Array:
    """Unknown effect: motions near one, by direction of travel and turning; for all others the change fades to zero."""
    away = signals.twists - [values["vx"], values["vy"], values["omega"]]
    away = away * [1.0, 1.0, signals.robot.reach] / values["width"]
    return np.exp(-np.square(away).sum(axis=1, keepdims=True) / 2)


@smooth_effect(SESSION_TIME, _WAVE, scale("frequency", "Hz", 1e-9, 1e6, 1e-3, "waves in a second"), _SESSION)
def smooth_session_wave(signals: Signals, values: Values) -> Array:
    """Unknown effect: a wave of the time since the session's start; after the longest seen the value is held."""
    time = np.minimum(needed(signals.session_time), values["duration"])
    return waves(values["frequency"] * (2 * np.pi * time), (1.0,))


@smooth_effect(SESSION_TIME, [str(order) for order in range(1, 13)], _SESSION, modes=("along", "rotation", "turn"))
def smooth_order_of_runs(signals: Signals, values: Values) -> Array:
    """Unknown effect: polynomials of the time since the session's start; after the longest seen the value is held."""
    unit = np.clip(2 * needed(signals.session_time) / values["duration"] - 1, -1.0, 1.0)
    return chebyshev.chebvander(unit, 12)[:, 1:]


def mean_waves(signals: Signals, wheel: int, harmonic: float) -> Array:
    """Means (F, 2) of omega cos(n phi) and omega sin(n phi) of a wheel over each sample; harmonic: n.

    phi turns at the constant rate omega. With phi in the middle of a sample of duration d the means are cos(n phi) and
    sin(n phi) times 2 sin(n omega d / 2) / (n d).
    """
    half = harmonic / 2 * signals.durations
    amplitude = np.sin(half * signals.rates[:, wheel]) / half
    return amplitude[:, None] * waves(needed(signals.wheel_angles)[:, wheel], (harmonic,))


def ripple(signals: Signals, harmonic: float, values: Values) -> Array:
    """Mean of omega (a cos(n phi) + b sin(n phi)) over each sample (F, N).

    harmonic: n. values: a_<wheel> and b_<wheel>.
    """
    added = np.zeros(signals.rates.shape)
    if len(signals.rates) > 1:
        for index, name in enumerate(signals.robot.wheel_names):
            amplitudes = np.array([values[f"a_{name}"], values[f"b_{name}"]])
            if amplitudes.any():
                added[:, index] = mean_waves(signals, index, harmonic) @ amplitudes
        return added
    # Python floats are faster than NumPy for a few wheels in a stream.
    half = harmonic / 2 * float(signals.durations[0])
    rates, angles = signals.rates[0].tolist(), needed(signals.wheel_angles)[0].tolist()
    for index, (wheel, rate, angle) in enumerate(zip(signals.robot.measured, rates, angles, strict=True)):
        a, b, phase = values[f"a_{wheel.name}"], values[f"b_{wheel.name}"], harmonic * angle
        added[0, index] = (a * math.cos(phase) + b * math.sin(phase)) * math.sin(half * rate) / half
    return added


def _of_radius(largest: float, angle: str = "") -> tuple[Parameter, ...]:
    """The parameters a and b of a wheel whose radius changes with an angle."""
    return tuple(
        Parameter(name, "1", -largest, largest, f"share of the radius, with the {function}{angle}")
        for name, function in (("a", "cosine"), ("b", "sine"))
    )


class _WheelWave(EachWheelEffect):
    """A wave of each wheel's angle, with ``harmonic`` waves in a turn."""

    shows_in = "wheel angle"
    needs = frozenset({"wheel_angles"})
    harmonic: ClassVar[str] = ""

    def correction(self, signals: Signals, values: Values) -> Array:
        return ripple(signals, values[self.harmonic] if self.harmonic else 1.0, values)


@effects.register("wheel_eccentricity")
class WheelEccentricity(_WheelWave):
    """A wheel's radius changes over one turn: r (1 + a cos phi + b sin phi)."""

    physics = "The axle does not stand in the middle of the wheel."
    source = "first principles"
    for_each_wheel = _of_radius(0.02, " of the angle")


@effects.register("roller_ripple")
class RollerRipple(_WheelWave):
    """A wheel's radius changes from roller to roller: r (1 + a cos(n phi) + b sin(n phi)), n rollers."""

    physics = "The rollers do not make a perfect circle: the wheel sinks in between two of them."
    source = "first principles"
    harmonic = "rollers"
    only_for = "robots with a wheel on rollers"
    for_each_wheel = _of_radius(0.03, " of n angles")
    fixed_parameters = (
        Parameter("rollers", "1", 2, 64, "rollers along a wheel's circumference, n", tuple(map(float, range(3, 17)))),
    )

    def applies(self, robot: Robot) -> bool:
        return has_rollers(robot)


@effects.register("smooth_wheel_angle")
class SmoothWheelAngle(WithoutCause, _WheelWave):
    """Unknown effect: a wave of each wheel's angle, so many times a turn."""

    harmonic = "harmonic"
    for_each_wheel = _of_radius(0.03)
    fixed_parameters = (Parameter("harmonic", "1", 0.1, 256.0, "waves in a turn of the wheel", choices=HARMONICS),)


def hat_functions(rates: Array, top: float) -> Array:
    """Piecewise linear hat functions (..., 8) of rates between -top and top, rad/s, constant beyond.

    Zero for standing wheels.
    """
    return np.stack([_between_knots(rates, top, heights) for heights in np.eye(KNOTS)], axis=-1)


def _between_knots(rates: Array, top: float, heights: Array) -> Array:
    """The piecewise linear function (...) of rates with given heights at the knots; zero for standing wheels."""
    interpolated: Array = np.interp(rates, np.linspace(-top, top, len(heights)), heights)
    return np.where(np.abs(rates) > STILL, interpolated, 0.0)


@effects.register("smooth_wheel_rate")
class SmoothWheelRate(WithoutCause, EachWheelEffect):
    """Unknown effect: a piecewise linear function of each wheel's rate, which holds its value beyond the rates seen."""

    shows_in = "wheel rate"
    for_each_wheel = tuple(
        Parameter(f"change_{knot}", "rad/s", -0.02, 0.02, f"change at knot {knot} of 0 to 7") for knot in range(KNOTS)
    )
    fixed_parameters = (_TOP,)

    def correction(self, signals: Signals, values: Values) -> Array:
        heights = np.array([of_wheels(signals.robot, f"change_{knot}", values) for knot in range(KNOTS)])
        wheels = zip(signals.rates.T, heights.T, strict=True)
        return np.column_stack([_between_knots(rates, values["top"], at_knots) for rates, at_knots in wheels])


@effects.register("smooth_common_rate")
class SmoothCommonRate(WithoutCause, WheelEffect):
    """Unknown effect: a finer function of the wheel rate, the same for all wheels, held beyond the rates seen."""

    shows_in = "wheel rate"
    fixed_parameters = (
        *(
            Parameter(f"change_{knot}", "rad/s", -0.02, 0.02, f"change at knot {knot} of 0 to {_COMMON_KNOTS - 1}")
            for knot in range(_COMMON_KNOTS)
        ),
        _TOP,
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        heights = np.array([values[f"change_{knot}"] for knot in range(_COMMON_KNOTS)])
        return _between_knots(signals.rates, values["top"], heights)


@effects.register("smooth_acceleration")
class SmoothAcceleration(WithoutCause, BodyEffect):
    """Unknown effect: changes that grow with the acceleration, up to the largest that was seen, and then no more."""

    shows_in = "acceleration"
    fixed_parameters = (
        Parameter("straight", "s", -0.1, 0.1, "change of the velocity, of the acceleration"),
        Parameter("aside", "s", -0.1, 0.1, "change of the velocity to the left of the acceleration, of its size"),
        Parameter("about_x", "rad s/m", -0.1, 0.1, "change of the rate of turn, of the acceleration forwards"),
        Parameter("about_y", "rad s/m", -0.1, 0.1, "change of the rate of turn, of the acceleration to the left"),
        Parameter("about_omega", "s", -0.1, 0.1, "change of the rate of turn, of its own rate of change"),
        Parameter("about_size", "rad s/m", -0.1, 0.1, "change of the rate of turn, of the acceleration's size"),
        Parameter("about_turning", "s", -0.1, 0.1, "change of the rate of turn, of the size of its rate of change"),
        Parameter("along", "s2/m", -0.1, 0.1, "change along the way, of the speed times the acceleration's size"),
        Parameter("across", "s2/m", -0.1, 0.1, "change across the way, of the speed times the acceleration's size"),
        Parameter("rotation", "s2/m", -0.1, 0.1, "change of the rate of turn, of itself times the acceleration's size"),
        scale("top", "m/s2", 1e-9, 1e9, 10.0, "the largest acceleration that was seen"),
        scale("top_turning", "rad/s2", 1e-9, 1e9, 50.0, "the largest change of the rate of turn that was seen"),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        forward, left, angular = signals.accelerations.T
        size = np.hypot(forward, left)
        limit = np.minimum(1.0, values["top"] / np.maximum(size, 1e-300))
        forward, left, size = limit * forward, limit * left, limit * size
        angular = np.clip(angular, -values["top_turning"], values["top_turning"])
        zeros = np.zeros(len(size))
        turning = values["about_x"] * forward + values["about_y"] * left + values["about_omega"] * angular
        turning = turning + values["about_size"] * size + values["about_turning"] * np.abs(angular)
        added = values["straight"] * np.column_stack([forward, left, zeros])
        added += values["aside"] * np.column_stack([-left, forward, zeros])
        added[:, 2] += turning
        for mode in ("along", "across", "rotation"):
            added += values[mode] * size[:, None] * direction(mode, signals)
        return added


class BentMap(WithoutCause, ReferenceEffect):
    """A distorted map: reported poses are shifted by functions of the position, relative to the run's start.

    ``corrected`` assumes that the map is invertible.
    """

    shows_in = "place"
    axes = tuple(_AXES)
    labels: ClassVar[tuple[str, ...]]

    @abstractmethod
    def functions(self, places: Array, values: Values) -> Array:
        """Values (K, J) of the J functions at positions (K, 2), m."""

    def reported(self, poses: Array, start: Array, values: Values) -> Array:
        return poses + self._shift(poses, start, values)

    def corrected(self, poses: Array, start: Array, values: Values) -> Array:
        true = poses
        for _ in range(_ROUNDS):
            before, true = true, poses - self._shift(true, start, values)
            if np.abs(true - before).max(initial=0.0) < _SAME:
                break
        return true

    def _shift(self, poses: Array, start: Array, values: Values) -> Array:
        """Shift (K, 3) of reported poses relative to the shift of the start, m, m, rad."""
        factors = np.array([[values[f"{axis}_{label}"] for label in self.labels] for axis in _AXES])
        there = self.functions(poses[:, :2], values) - self.functions(start[None, :2], values)
        return there @ factors.T


def _shifts(labels: Sequence[str]) -> tuple[Parameter, ...]:
    """Coefficients ``<axis>_<label>``."""
    return tuple(
        Parameter(f"{axis}_{label}", unit, -0.01, 0.01, f"shift of {axis}, with {label} of the place")
        for axis, unit in _AXES.items()
        for label in labels
    )


@effects.register("smooth_map")
class SmoothMap(BentMap):
    """Unknown effect: a bent map, by polynomials of degree 3 in the place; beyond the places seen the value is held."""

    labels = SURFACES
    fixed_parameters = (*_shifts(labels), *AREA)

    def functions(self, places: Array, values: Values) -> Array:
        return surfaces(places, values)


@effects.register("smooth_map_patch")
class SmoothMapPatch(BentMap):
    """Unknown effect: a round patch of the map that is shifted, outside of which the shift fades to zero."""

    labels = ("bump",)
    fixed_parameters = (*_shifts(labels), *PATCH)

    def functions(self, places: Array, values: Values) -> Array:
        return bump(places, values)


@effects.register("smooth_stamps")
class SmoothStamps(WithoutCause, ReferenceEffect):
    """Unknown effect: delays that grow with the stamp, up to the last one seen, and that alternate."""

    shows_in = "stamps"
    fixed_parameters = (
        *(
            Parameter(f"{what}_{kind}", "s", -0.1, 0.1, f"by how much earlier the {what} was taken, {words}")
            for what in ("position", "heading")
            for kind, words in (
                ("always", "always"),
                ("late", "at the last stamp, more than at 0"),
                ("alternating", "every other pose, and later those between"),
            )
        ),
        scale("duration", "s", 1e-3, 1e6, 30.0, "the last stamp that was seen"),
        scale("period", "s", 1e-6, 1e6, 0.25, "from one pose to the next"),
    )

    def delays(self, stamps: Array, values: Values) -> tuple[Array, Array]:
        late, turns = np.clip(stamps / values["duration"], 0.0, 1.0), (-1.0) ** np.rint(stamps / values["period"])
        position, heading = (
            values[f"{what}_always"] + values[f"{what}_late"] * late + values[f"{what}_alternating"] * turns
            for what in ("position", "heading")
        )
        return position, heading


@effects.register("smooth_stamp_wave")
class SmoothStampWave(WithoutCause, ReferenceEffect):
    """Unknown effect: a delay of the poses that swings with their stamps, at one frequency."""

    shows_in = "stamps"
    fixed_parameters = (
        Parameter("cos", "s", -0.1, 0.1, "by how much earlier the pose was taken, with the cosine"),
        Parameter("sin", "s", -0.1, 0.1, "by how much earlier the pose was taken, with the sine"),
        scale("frequency", "Hz", 1e-6, 1e6, 1.0, "swings in a second"),
    )

    def delays(self, stamps: Array, values: Values) -> tuple[Array, Array]:
        swing = waves(2 * np.pi * values["frequency"] * stamps, (1,)) @ np.array([values["cos"], values["sin"]])
        return swing, swing
