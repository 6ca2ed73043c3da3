"""Smooth functions of position and time for unknown errors of the reference. They do not act on odometry."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import Parameter, ReferenceEffect, Values
from omnibench.robot.effects.smooth.motion import (
    AREA,
    PATCH,
    SURFACES,
    WithoutCause,
    bump,
    inside_of,
    scale,
    surfaces,
    waves,
)
from omnibench.robot.kinematics import Array

_AXES = {"x": "m", "y": "m", "theta": "rad"}
_ROUNDS = 200  # steps of the fixed-point iteration that inverts a map, at most; chosen
_SAME = 1e-13  # m, rad: a smaller change ends the iteration


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
        shift: Array = there @ factors.T
        return shift


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
    fixed_parameters = (*_shifts(SURFACES), *AREA)

    def functions(self, places: Array, values: Values) -> Array:
        return surfaces(inside_of(places, values))


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
