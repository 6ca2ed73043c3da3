"""Span of the drive signals that recordings drive: outside it the matrix is not determined."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array, Robot

Unidentified = Literal["keep", "fit", "shrink"]  # what is asked for; shrink is what map does
# What an answer does along motions that the data hardly tell; weigh: it weighs the data against the design.
Treatment = Literal["keep", "fit", "weigh"]
State = Literal["driven", "weak", "undriven"]

# Share of the strongest direction below which a direction holds noise and no motion. Half of it changes nothing; with
# twice, slip of 2 % counts as no motion in the place of a weak one, and both keep the design
# (tests/studies/constants_fit.py).
_NULL_SHARE = 1e-2

# Share of the strongest direction below which slip alone may explain what was driven. Slip of 1 % of the strongest
# motion changes the matrix along a direction driven with a tenth of it by 10 %, more than a calibration corrects. Festo
# Robotino runs without commanded turns have 0.051 and 0.053 along the direction that turns the robot (slip, uneven
# motors); recordings with commanded turns have 0.53 (omni3) and 0.56 (flower of the APR-02).
# On the simulated recordings of tests/studies/constants_fit.py half of it and twice change nothing; with half of it
# Robotino's would count as driven.
WEAK_SHARE = 0.1

# The following decide on names of directions alone; half of each and twice give the same names
# (tests/studies/constants_fit.py).
_SAME_DIRECTION = 0.99  # cosine from which on a direction is called by one of the robot's motions: 8 degrees
_ALMOST = math.tan(math.radians(5))  # ratio of speeds below which the smaller one is not mentioned
_NO_MOTION = 0.05  # m per metre that the wheels roll: a direction that moves the robot less only slips
_ROUND = 0.02  # share of the largest element: a smaller one is not named, and one so close to 1 is called 1


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
        """Driven directions (q, N) that slip alone may explain: less than a tenth of the strongest."""
        return self.driven[self.shares[: len(self.driven)] < WEAK_SHARE]

    @property
    def strong(self) -> Array:
        """Driven directions (rank - q, N) that are not weak."""
        return self.driven[: len(self.driven) - len(self.weak)]

    def state(self, direction: Array) -> State:
        """Driven, weak or undriven: the state of a direction (N,) of length one."""
        share = self.share(direction)
        return "driven" if share >= WEAK_SHARE else "weak" if share > _NULL_SHARE else "undriven"

    def share(self, direction: Array) -> float:
        """RMS wheel angle along a direction (N,) of length one, as a share of the strongest."""
        along = np.concatenate([self.driven, self.null]) @ direction
        return float(np.linalg.norm(self.shares * along))


def driven_span(trajectories: Sequence[Trajectory]) -> DrivenSpan:
    """Span of the wheel angles driven between reference poses. DataError when there are no trajectories.

    Angles between poses are used rather than rates, since encoder noise averages out of them.
    """
    if not trajectories:
        raise DataError("no trajectories; nothing can be calibrated")
    increments = [np.diff(trajectory.angles_at_poses, axis=0) for trajectory in trajectories]
    wheels = increments[0].shape[1]
    # Rows of zeros give N directions even if there are fewer increments than wheels.
    _, strengths, directions = np.linalg.svd(
        np.concatenate([*increments, np.zeros((wheels, wheels))]), full_matrices=False
    )
    shares: Array = strengths / strengths[0] if strengths[0] > 0 else np.zeros(wheels)
    rank = int((shares > _NULL_SHARE).sum())
    return DrivenSpan(directions[:rank], _signed(directions[rank:]), shares)


def directions_kept(robot: Robot, span: DrivenSpan, treatment: Treatment) -> Array:
    """Directions (q, N), orthonormal, along which a calibration keeps the design values.

    treatment: ``keep`` does so along weak and undriven directions, ``fit`` along undriven ones, ``weigh`` along none.
    """
    if treatment == "weigh":
        return np.zeros((0, span.null.shape[1]))
    if treatment == "fit" or len(span.weak) == 0:
        return span.null
    return unidentified_directions(robot, span)


def unidentified_directions(robot: Robot, span: DrivenSpan) -> Array:
    """Weak and undriven directions (q, N), orthonormal."""
    return aligned(np.concatenate([span.weak, span.null]), robot)


def aligned(space: Array, robot: Robot) -> Array:
    """Orthonormal directions of ``space`` (q, N), rotated towards the robot's motions, which have names.

    They span the same space, except that a motion (along x, along y, on the spot) within a few degrees of the space
    counts as part of it.
    """
    chosen, motions, left = np.zeros((0, space.shape[1])), _motions(robot), space
    while len(left):
        inside = motions @ left.T
        reach = np.linalg.norm(inside, axis=1)
        best = int((reach + np.array([*[0.0] * (len(motions) - 1), 1e-9])).argmax())  # ties go to turning on the spot
        direction = motions[best] if reach[best] > _SAME_DIRECTION else inside[best] @ left
        if reach[best] < 1e-6:  # no motion without slip is left
            direction = left[0]
        direction = direction - chosen.T @ (chosen @ direction)
        direction = direction / np.linalg.norm(direction)
        chosen = np.vstack([chosen, direction])
        _, _, turned = np.linalg.svd((left @ direction)[None])
        left = turned[1:] @ left
    return _signed(chosen)


@dataclass(frozen=True, eq=False)
class WheelDirection:
    """One of the directions of wheel rates in words, and how much the recordings drive it.

    rates (N,): of length one. words: like ``a - b``. motion: the design robot's motion under these rates, like
    ``turning on the spot``; empty if the wheels only slip. share and state: see DrivenSpan. identified: False where
    the recordings do not identify the matrix, so that a calibration keeps the design values.
    """

    rates: Array
    words: str
    motion: str
    share: float
    state: State
    identified: bool

    @property
    def share_in_words(self) -> str:
        """The share, like ``5.3 % of the strongest motion``."""
        return f"{100 * self.share:.1f} % of the strongest motion"


def wheel_directions(robot: Robot, span: DrivenSpan) -> tuple[WheelDirection, ...]:
    """All N directions, those that are identified first."""
    spaces = (True, aligned(span.strong, robot)), (False, unidentified_directions(robot, span))
    return tuple(
        WheelDirection(
            rates,
            direction_in_words(rates, robot.drive.names),
            motion_in_words(rates, robot),
            span.share(rates),
            span.state(rates),
            identified,
        )
        for identified, space in spaces
        for rates in space
    )


def direction_in_words(direction: Array, wheels: Sequence[str]) -> str:
    """A direction of wheel rates (N,) as text like ``a - b + 0.5 c``, its largest element 1 and its sign arbitrary."""
    large = np.abs(direction) > 0.5 * np.abs(direction).max()
    scaled = direction * np.sign(direction[large][0]) / np.abs(direction).max()
    terms = [(value, name) for value, name in zip(scaled, wheels, strict=True) if abs(value) > _ROUND]
    text = " ".join(
        f"{'-' if value < 0 else '+'} {'' if abs(abs(value) - 1) < _ROUND else f'{abs(value):.2g} '}{name}"
        for value, name in terms
    )
    return text.removeprefix("+ ")


def motion_in_words(direction: Array, robot: Robot) -> str:
    """Motion of the design robot under wheel rates along a direction (N,), like ``turning on the spot``.

    Empty if the robot would not move because the wheels only slip, or contradict each other.
    """
    motions = np.linalg.qr(_motions(robot).T)[0]
    if np.linalg.norm(direction @ motions) < _NO_MOTION * np.linalg.norm(direction):
        return ""
    x, y, turn = robot.inverse_kinematic_matrix @ direction
    speed, spin = math.hypot(x, y), abs(turn) * robot.reach
    if max(speed, spin) < _NO_MOTION * float(robot.radii.mean() * np.linalg.norm(direction)):  # of the way they roll
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
    """Signals (D, M) of length one that move the designed robot along x, along y where it can, and on the spot."""
    signals = robot.motions @ robot.signal_equations.T
    return signals / np.linalg.norm(signals, axis=1, keepdims=True)


def _signed(directions: Array) -> Array:
    """Directions (q, N) with their first large element positive, so that their names do not depend on the data."""
    leading = (np.abs(directions) > 0.5 * np.abs(directions).max(axis=1, keepdims=True)).argmax(axis=1)
    return directions * np.sign(directions[np.arange(len(directions)), leading])[:, None]
