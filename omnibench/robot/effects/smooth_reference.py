"""Smooth functions of where and when the reference is read, for what has no name. They act on no odometry."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import Parameter, ReferenceEffect, Values
from omnibench.robot.effects.smooth import (
    AREA,
    NO_PHYSICS,
    NO_SOURCE,
    PATCH,
    SURFACES,
    bump,
    inside_of,
    scale,
    surfaces,
    waves,
)
from omnibench.robot.kinematics import Array

_AXES = {"x": "m", "y": "m", "theta": "rad"}
_ROUNDS = 200
_SAME = 1e-13  # m, rad


class BentMap(ReferenceEffect):
    """Poses are reported beside, by functions of the place; at the run's start they agree.

    ``corrected`` supposes that the map is not folded.
    """

    physics = NO_PHYSICS
    source = NO_SOURCE
    shows_in = "place"
    in_catalogue = False
    labels: ClassVar[tuple[str, ...]]

    @abstractmethod
    def functions(self, places: Array, values: Values) -> Array:
        """Of places (K, 2), m: (K, J)."""

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
        """By how much poses (K, 3) are reported beside, more than the start is."""
        factors = np.array([[values[f"{axis}_{label}"] for label in self.labels] for axis in _AXES])
        there = self.functions(poses[:, :2], values) - self.functions(start[None, :2], values)
        shift: Array = there @ factors.T
        return shift


def _shifts(labels: Sequence[str]) -> tuple[Parameter, ...]:
    """Coefficients ``axis_label``."""
    return tuple(
        Parameter(f"{axis}_{label}", unit, -0.01, 0.01, f"shift of {axis}, with {label} of the place")
        for axis, unit in _AXES.items()
        for label in labels
    )


@effects.register("smooth_map")
class SmoothMap(BentMap):
    """Without a name: a bent map, by polynomials of degree 3 in the place; beyond the places seen the value is held."""

    labels = SURFACES
    fixed_parameters = (*_shifts(SURFACES), *AREA)

    def functions(self, places: Array, values: Values) -> Array:
        return surfaces(inside_of(places, values))


@effects.register("smooth_map_patch")
class SmoothMapPatch(BentMap):
    """Without a name: a round patch of the map that is shifted, outside of which the shift fades to zero."""

    labels = ("bump",)
    fixed_parameters = (*_shifts(labels), *PATCH)

    def functions(self, places: Array, values: Values) -> Array:
        return bump(places, values)


@effects.register("smooth_stamps")
class SmoothStamps(ReferenceEffect):
    """Without a name: delays that grow with the stamp, up to the last one seen, and that alternate."""

    physics = NO_PHYSICS
    source = NO_SOURCE
    shows_in = "stamps"
    in_catalogue = False
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
class SmoothStampWave(ReferenceEffect):
    """Without a name: a delay of the poses that swings with their stamps, at one frequency."""

    physics = NO_PHYSICS
    source = NO_SOURCE
    shows_in = "stamps"
    in_catalogue = False
    fixed_parameters = (
        Parameter("cos", "s", -0.1, 0.1, "by how much earlier the pose was taken, with the cosine"),
        Parameter("sin", "s", -0.1, 0.1, "by how much earlier the pose was taken, with the sine"),
        scale("frequency", "Hz", 1e-6, 1e6, 1.0, "swings in a second"),
    )

    def delays(self, stamps: Array, values: Values) -> tuple[Array, Array]:
        swing = waves(2 * np.pi * values["frequency"] * stamps, (1,)) @ np.array([values["cos"], values["sin"]])
        return swing, swing
