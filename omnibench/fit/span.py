"""Which directions of wheel rates a set of recordings drives: outside them the matrix is not determined."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array, Robot, wheel_equations

Unidentified = Literal["keep", "fit"]
State = Literal["driven", "weak", "undriven"]

# Below this share of the strongest direction a direction is noise, not motion.
_NULL_SHARE = 1e-2

# Below this share slip may be all there is. A wheel that slips by 1 % of the strongest motion changes what a direction
# driven with a tenth of it seems to do by 10 %, far more than calibrations are about. Runs of the Festo Robotino that
# were told not to turn drive the common turn of its wheels with a share of 0.051 and 0.053 (slip, uneven motors);
# recordings that turn on purpose have 0.53 (omni3) and 0.56 (the flower of the APR-02).
WEAK_SHARE = 0.1

# A direction this close (cosine) to one of the robot's own motions is taken for that motion.
_SAME_DIRECTION = 0.99
_ALMOST = math.tan(math.radians(5))


@dataclass(frozen=True)
class DrivenSpan:
    """Directions of wheel rates: ``driven`` (rank, N) and ``null`` (N - rank, N), orthonormal rows.

    shares (N,): RMS wheel angle along each direction as a share of the strongest.
    """

    driven: Array
    null: Array
    shares: Array

    @property
    def weak(self) -> Array:
        """The driven directions (q, N) that slip alone may have driven: with less than a tenth of the strongest."""
        return self.driven[self.shares[: len(self.driven)] < WEAK_SHARE]

    @property
    def strong(self) -> Array:
        """The driven directions that are left (rank - q, N)."""
        return self.driven[: len(self.driven) - len(self.weak)]

    def state(self, direction: Array) -> State:
        """How much a direction (N,) of length one is driven."""
        share = self.share(direction)
        return "driven" if share >= WEAK_SHARE else "weak" if share > _NULL_SHARE else "undriven"

    def share(self, direction: Array) -> float:
        """RMS wheel angle along a direction (N,) of length one, as a share of the strongest."""
        along = np.concatenate([self.driven, self.null]) @ direction
        return float(np.linalg.norm(self.shares * along))


def driven_span(trajectories: Sequence[Trajectory]) -> DrivenSpan:
    """The span of the wheel angles driven between reference poses. DataError when there are no trajectories.

    Angles between poses, not rates: encoder noise averages out of them, motion does not.
    """
    if not trajectories:
        raise DataError("no trajectories; nothing can be calibrated")
    increments = [np.diff(_angles_at_poses(trajectory), axis=0) for trajectory in trajectories]
    wheels = increments[0].shape[1]
    # Rows of zeros, so that there are directions for every wheel however few the increments.
    _, strengths, directions = np.linalg.svd(
        np.concatenate([*increments, np.zeros((wheels, wheels))]), full_matrices=False
    )
    shares: Array = strengths / strengths[0] if strengths[0] > 0 else np.zeros(wheels)
    rank = int((shares > _NULL_SHARE).sum())
    return DrivenSpan(directions[:rank], _signed(directions[rank:]), shares)


def directions_kept(robot: Robot, span: DrivenSpan, unidentified: Unidentified) -> Array:
    """Directions (q, N), orthonormal, along which a calibration keeps the design values.

    fit: those that the data do not drive. keep: also those driven so little that slip alone may have done it.
    """
    if unidentified == "fit" or len(span.weak) == 0:
        return span.null
    return unidentified_directions(robot, span)


def unidentified_directions(robot: Robot, span: DrivenSpan) -> Array:
    """Directions (q, N), orthonormal, that are not driven, or so little that slip alone may have done it."""
    return aligned(np.concatenate([span.weak, span.null]), robot)


def aligned(space: Array, robot: Robot) -> Array:
    """Orthonormal directions for those of ``space`` (q, N), turned to the robot's own motions: they read better.

    They span the same, but for this: a motion (along x, along y, on the spot) within a few degrees of the space is
    taken for part of it.
    """
    chosen = np.zeros((0, space.shape[1]))
    motions = _motions(robot)
    left = space
    while len(left):
        inside = motions @ left.T
        reach = np.linalg.norm(inside, axis=1)
        best = int((reach + np.array([0.0, 0.0, 1e-9])).argmax())  # of equals the turn
        direction = motions[best] if reach[best] > _SAME_DIRECTION else inside[best] @ left
        if reach[best] < 1e-6:  # nothing that the robot does without slip
            direction = left[0]
        direction = direction - chosen.T @ (chosen @ direction)
        direction = direction / np.linalg.norm(direction)
        chosen = np.vstack([chosen, direction])
        _, _, turned = np.linalg.svd((left @ direction)[None])
        left = turned[1:] @ left
    return _signed(chosen)


def direction_in_words(direction: Array, wheels: Sequence[str]) -> str:
    """A direction of wheel rates as ``a - b + 0.5 c``, scaled to its largest element; its sign has no meaning."""
    large = np.abs(direction) > 0.5 * np.abs(direction).max()
    scaled = direction * np.sign(direction[large][0]) / np.abs(direction).max()
    terms = [(value, name) for value, name in zip(scaled, wheels, strict=True) if abs(value) > 0.02]
    text = " ".join(
        f"{'-' if value < 0 else '+'} {'' if abs(abs(value) - 1) < 0.02 else f'{abs(value):.2g} '}{name}"
        for value, name in terms
    )
    return text.removeprefix("+ ")


def motion_in_words(direction: Array, robot: Robot) -> str:
    """What wheel rates along a direction (N,) make the designed robot do: ``turning on the spot``, ``moving along x``.

    The empty text where it does nothing: the wheels would only slip.
    """
    x, y, turn = robot.inverse_kinematic_matrix @ direction
    reach = float(np.mean([wheel.distance for wheel in robot.wheels]))
    speed, spin = math.hypot(x, y), abs(turn) * reach
    if max(speed, spin) < 0.05 * float(np.mean([wheel.radius for wheel in robot.wheels])) * np.linalg.norm(direction):
        return ""
    if speed < _ALMOST * spin:
        return "turning on the spot"
    if abs(y) < _ALMOST * abs(x):
        moving = "moving along x"
    elif abs(x) < _ALMOST * abs(y):
        moving = "moving along y"
    else:
        moving = f"moving at {math.degrees(math.atan2(y, x)) % 180:.0f} deg"
    return moving if spin < _ALMOST * speed else f"{moving} while turning"


def _motions(robot: Robot) -> Array:
    """Wheel rates (3, N) of length one that move the designed robot along x, along y, on the spot."""
    rates = wheel_equations(robot.wheels).T
    motions: Array = rates / np.linalg.norm(rates, axis=1, keepdims=True)
    return motions


def _signed(directions: Array) -> Array:
    """The sign is that of the first large element, so that a direction has the same name on any data."""
    leading = (np.abs(directions) > 0.5 * np.abs(directions).max(axis=1, keepdims=True)).argmax(axis=1)
    signed: Array = directions * np.sign(directions[np.arange(len(directions)), leading])[:, None]
    return signed


def _angles_at_poses(trajectory: Trajectory) -> Array:
    """Wheel angles (K, N) driven up to each reference pose, rad."""
    driven = np.cumsum(trajectory.rates * np.diff(trajectory.times, prepend=0.0)[:, None], axis=0)
    times = np.concatenate([[0.0], trajectory.times])
    angles = np.vstack([np.zeros(driven.shape[1]), driven])
    return np.stack([np.interp(trajectory.pose_times, times, column) for column in angles.T], axis=1)
