"""Smooth functions of a covariate for unknown effects: changes of the motion along, across and in turning.

They describe an error without its cause, and are never proposed as names. A change in turning is proportional to the
distance that the wheels move, so that a standing robot is never changed. No function extrapolates beyond the data: each
is constant there or fades to zero.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.polynomial import chebyshev

from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, Values
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import Signals

SURFACES = ("x", "y", "xx", "xy", "yy", "xxx", "xxy", "xyy", "yyy")
_LARGEST = 0.1  # plausible size of a coefficient, a share of the motion; chosen
_SLOW = 1e-3  # m/s, below which the direction of travel is ill-defined; chosen
MODES = {
    "along": "along the way",
    "across": "across the way, to the left",
    "turn": "in turning, per way of the wheels",
    "rotation": "of the rate of turn",
}
ALL_MODES = tuple(MODES)


def scale(name: str, unit: str, low: float, high: float, usual: float, description: str) -> Parameter:
    """A parameter that sets the range of a function; usual: the value to try."""
    return Parameter(name, unit, low, high, description, choices=(usual,))


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
        changes[:, 2] = np.abs(twists[:, 2]) + np.hypot(twists[:, 0], twists[:, 1]) / lever(signals.robot)
    return changes


def lever(robot: Robot) -> float:
    """Mean lever arm of the wheels, m, which converts turning to speed at the wheels."""
    return robot.reach


def waves(angle: Array, harmonics: Sequence[float]) -> Array:
    """Cosines and sines (F, 2 m) of m multiples of an angle (F,)."""
    return np.concatenate([[np.cos(multiple * angle), np.sin(multiple * angle)] for multiple in harmonics]).T


def surfaces(inside: Array) -> Array:
    """The nine monomials (F, 9) of degree 1 to 3 in x and y of points (F, 2)."""
    x, y = inside.T
    return np.column_stack([x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])


def inside_of(places: Array, values: Values) -> Array:
    """Positions (F, 2) relative to the centre, in units of the reach; those beyond 1 are moved to the unit circle."""
    away = (places - [values["centre_x"], values["centre_y"]]) / values["reach"]
    return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1.0)


def bump(places: Array, values: Values) -> Array:
    """A Gaussian function (F, 1) of positions (F, 2), with value 1 at the centre."""
    away = (places - [values["centre_x"], values["centre_y"]]) / values["radius"]
    return np.exp(-np.square(away).sum(axis=1, keepdims=True))


def across(places: Array, values: Values) -> Array:
    """Distances (F,) of positions (F, 2) from a line, on the side of its normal positive, m."""
    distances: Array = places @ [np.cos(values["normal"]), np.sin(values["normal"])] - values["distance"]
    return distances


def beyond(places: Array, values: Values) -> Array:
    """A soft step (F, 1) of positions (F, 2), from 0 to 1 across a line."""
    return (0.5 + 0.5 * np.tanh(across(places, values) / values["width"]))[:, None]


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


class WithoutCause:
    """Attributes of effects that describe an error and not its cause, and so are not in the catalogue."""

    physics = "None: a function that was fitted to what the model left, without a cause."
    source = "fitted to data"
    in_catalogue = False


class SmoothEffect(WithoutCause, MotionEffect):
    """Changes of the motion that depend on a covariate: for each of ``modes`` a sum of the ``labels`` functions."""

    stage = "body"
    modes: ClassVar[tuple[str, ...]] = ("along", "across", "turn")
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


_TIMES = tuple(str(order) for order in range(16))


@effects.register("smooth_elapsed_time")
class SmoothElapsedTime(SmoothEffect):
    """Unknown effect: cosines of the time since the start of a run; after the longest run seen the value is held."""

    shows_in = "elapsed time"
    labels = _TIMES
    fixed_parameters = (
        *shared(SmoothEffect.modes, _TIMES, "the time since the start"),
        scale("duration", "s", 1e-3, 1e6, 5.0, "of the longest run that was seen"),
    )

    def shares(self, signals: Signals, values: Values) -> Array:
        part = np.clip(signals.elapsed / values["duration"], 0.0, 1.0)
        return np.cos(np.pi * np.arange(len(_TIMES)) * part[:, None])


_TURNS = ("cos1", "sin1", "cos2", "sin2", "cos3", "sin3")


@effects.register("smooth_time_wave")
class SmoothTimeWave(SmoothEffect):
    """Unknown effect: a wave of the time since the start of a run; after the longest run seen the value is held."""

    shows_in = "elapsed time"
    modes = ALL_MODES
    labels = ("cos", "sin")
    fixed_parameters = (
        *shared(ALL_MODES, labels, "the time since the start"),
        scale("frequency", "Hz", 1e-6, 1e6, 1.0, "waves in a second"),
        scale("duration", "s", 1e-3, 1e6, 5.0, "of the longest run that was seen"),
    )

    def shares(self, signals: Signals, values: Values) -> Array:
        return waves(2 * np.pi * np.minimum(signals.elapsed, values["duration"]), (values["frequency"],))


@effects.register("smooth_heading")
class SmoothHeading(SmoothEffect):
    """Unknown effect: the first three harmonics of the robot's heading."""

    shows_in = "heading"
    needs = frozenset({"poses"})
    labels = _TURNS
    fixed_parameters = shared(SmoothEffect.modes, _TURNS, "the heading")

    def shares(self, signals: Signals, values: Values) -> Array:  # noqa: ARG002
        assert signals.poses is not None  # they are needed
        return waves(signals.poses[:, 2], (1, 2, 3))


@effects.register("smooth_heading_wave")
class SmoothHeadingWave(SmoothEffect):
    """Unknown effect: a wave of the robot's heading, so many times a turn."""

    shows_in = "heading"
    needs = frozenset({"poses"})
    modes = ALL_MODES
    labels = ("cos", "sin")
    fixed_parameters = (
        *shared(ALL_MODES, labels, "the heading"),
        scale("harmonic", "1", 1.0, 64.0, 4.0, "waves in a turn of the robot"),
    )

    def shares(self, signals: Signals, values: Values) -> Array:
        assert signals.poses is not None  # they are needed
        return waves(signals.poses[:, 2], (values["harmonic"],))


@effects.register("smooth_course")
class SmoothCourse(SmoothEffect):
    """Unknown effect: a steady push along the way in the world, and two harmonics of the direction of travel there.

    The harmonics fade to zero below 1 mm/s, where there is no direction of travel.
    """

    shows_in = "heading"
    needs = frozenset({"poses"})
    labels = _TURNS[:4]
    fixed_parameters = (
        Parameter("east", "1", -_LARGEST, _LARGEST, "push along x of the reference, of the speed"),
        Parameter("north", "1", -_LARGEST, _LARGEST, "push along y of the reference, of the speed"),
        *shared(SmoothEffect.modes, labels, "the direction of travel"),
    )

    def shares(self, signals: Signals, values: Values) -> Array:  # noqa: ARG002
        assert signals.poses is not None  # they are needed
        forward, left, _ = signals.twists.T
        driving = np.minimum(1.0, np.hypot(forward, left) / _SLOW)
        return driving[:, None] * waves(signals.poses[:, 2] + np.arctan2(left, forward), (1, 2))

    def correction(self, signals: Signals, values: Values) -> Array:
        assert signals.poses is not None
        added = super().correction(signals, values)
        push = complex(values["east"], values["north"]) * np.exp(-1j * signals.poses[:, 2])
        push *= np.hypot(signals.twists[:, 0], signals.twists[:, 1])
        added[:, 0] += push.real
        added[:, 1] += push.imag
        return added


@effects.register("smooth_place")
class SmoothPlace(SmoothEffect):
    """Unknown effect: polynomials of degree 3 in the place on the floor; beyond the places seen the value is held."""

    shows_in = "place"
    needs = frozenset({"poses"})
    labels = SURFACES
    fixed_parameters = (*shared(SmoothEffect.modes, SURFACES, "the place"), *AREA)

    def shares(self, signals: Signals, values: Values) -> Array:
        assert signals.poses is not None  # they are needed
        return surfaces(inside_of(signals.poses[:, :2], values))


@effects.register("smooth_patch")
class SmoothPatch(SmoothEffect):
    """Unknown effect: a round patch of the floor, outside of which the change fades to zero."""

    shows_in = "place"
    needs = frozenset({"poses"})
    modes = ALL_MODES
    labels = ("bump",)
    fixed_parameters = (*shared(ALL_MODES, labels, "the place"), *PATCH)

    def shares(self, signals: Signals, values: Values) -> Array:
        assert signals.poses is not None  # they are needed
        return bump(signals.poses[:, :2], values)


@effects.register("smooth_place_wave")
class SmoothPlaceWave(SmoothEffect):
    """Unknown effect: a plane wave over the floor, as of tiles; beyond the places seen the value is held."""

    shows_in = "place"
    needs = frozenset({"poses"})
    modes = ALL_MODES
    labels = ("cos", "sin")
    fixed_parameters = (
        *shared(ALL_MODES, labels, "the place"),
        scale("along_x", "rad/m", -1e3, 1e3, 10.0, "phase per way along x of the reference"),
        scale("along_y", "rad/m", -1e3, 1e3, 0.0, "phase per way along y of the reference"),
        *AREA,
    )

    def shares(self, signals: Signals, values: Values) -> Array:
        assert signals.poses is not None  # they are needed
        held = values["reach"] * inside_of(signals.poses[:, :2], values)
        return waves(held @ [values["along_x"], values["along_y"]], (1.0,))


@effects.register("smooth_edge")
class SmoothEdge(SmoothEffect):
    """Unknown effect: the floor beyond a straight line, as a carpet's edge."""

    shows_in = "place"
    needs = frozenset({"poses"})
    modes = ALL_MODES
    labels = ("beyond",)
    fixed_parameters = (
        *shared(ALL_MODES, labels, "the line"),
        *LINE,
        scale("width", "m", 1e-6, 1e6, 0.05, "over which the change sets in"),
    )

    def shares(self, signals: Signals, values: Values) -> Array:
        assert signals.poses is not None  # they are needed
        return beyond(signals.poses[:, :2], values)


@effects.register("smooth_joint")
class SmoothJoint(SmoothEffect):
    """Unknown effect: a joint of the floor along a straight line, as between two rows of tiles."""

    shows_in = "place"
    needs = frozenset({"poses"})
    modes = ALL_MODES
    labels = ("joint",)
    fixed_parameters = (
        *shared(ALL_MODES, labels, "the line"),
        *LINE,
        scale("width", "m", 1e-6, 1e6, 0.03, "across the joint, where 1/e of the change is left on either side"),
    )

    def shares(self, signals: Signals, values: Values) -> Array:
        assert signals.poses is not None  # they are needed
        return np.exp(-np.square(across(signals.poses[:, :2], values) / values["width"]))[:, None]


@effects.register("smooth_command")
class SmoothCommand(SmoothEffect):
    """Unknown effect: motions near one, by direction of travel and turning; for all others the change fades to zero."""

    shows_in = "command"
    labels = ("bump",)
    fixed_parameters = (
        *shared(SmoothEffect.modes, labels, "the motion"),
        scale("vx", "m/s", -1e3, 1e3, 0.2, "the motion, forwards"),
        scale("vy", "m/s", -1e3, 1e3, 0.0, "the motion, to the left"),
        scale("omega", "rad/s", -1e3, 1e3, 0.0, "the motion, turning"),
        scale("width", "m/s", 1e-9, 1e3, 0.3, "how far other motions are, at the wheels, where 61 % of it is left"),
    )

    def shares(self, signals: Signals, values: Values) -> Array:
        away = signals.twists - [values["vx"], values["vy"], values["omega"]]
        away = away * [1.0, 1.0, lever(signals.robot)] / values["width"]
        return np.exp(-np.square(away).sum(axis=1, keepdims=True) / 2)


@effects.register("smooth_session_wave")
class SmoothSessionWave(SmoothEffect):
    """Unknown effect: a wave of the time since the session's start; after the longest seen the value is held."""

    shows_in = "order of runs"
    needs = frozenset({"session_time"})
    modes = ALL_MODES
    labels = ("cos", "sin")
    fixed_parameters = (
        *shared(ALL_MODES, labels, "the session's time"),
        scale("frequency", "Hz", 1e-9, 1e6, 1e-3, "waves in a second"),
        scale("duration", "s", 1e-3, 1e9, 3600.0, "of the longest session that was seen"),
    )

    def shares(self, signals: Signals, values: Values) -> Array:
        assert signals.session_time is not None  # it is needed
        return waves(2 * np.pi * np.minimum(signals.session_time, values["duration"]), (values["frequency"],))


@effects.register("smooth_order_of_runs")
class SmoothOrderOfRuns(SmoothEffect):
    """Unknown effect: polynomials of the time since the session's start; after the longest seen the value is held."""

    shows_in = "order of runs"
    needs = frozenset({"session_time"})
    modes = ("along", "rotation", "turn")
    labels = tuple(str(order) for order in range(1, 13))
    fixed_parameters = (
        *shared(modes, labels, "the session's time"),
        scale("duration", "s", 1e-3, 1e9, 3600.0, "of the longest session that was seen"),
    )

    def shares(self, signals: Signals, values: Values) -> Array:
        assert signals.session_time is not None  # it is needed
        unit = np.clip(2 * signals.session_time / values["duration"] - 1, -1.0, 1.0)
        functions: Array = chebyshev.chebvander(unit, len(self.labels))[:, 1:]
        return functions
