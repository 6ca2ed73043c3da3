"""Kinds of motion by their twists: those that a check finds missing, and those that a report shows as driven."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array, Robot

# Least share of the time in motion that counts as driven on purpose; chosen: about a second in a minute.
SHARE = 0.02
TURNING, _STRAIGHT = 0.06, 0.04  # rad/s from which on a robot turns, and up to which it goes straight; chosen
MOVING = 0.02  # m/s from which on it moves; chosen
_ON_THE_SPOT = 0.1  # way ahead, as a share of the wheels' way by turning, below which it turns on the spot; chosen
_SECTOR = 30.0  # deg about an axis that count as along it; chosen
_SIDES = ("left", "right")

Kinds = Mapping[str, NDArray[np.bool_]]
"""Twists (n,) of each kind, True, by its name."""


def motion_kinds(twists: Array, robot: Robot) -> Kinds:
    """The kinds that a robot can drive, with those of twists (n, 3), m/s, m/s and rad/s, that are of each.

    A twist is straight or turns, and goes forward, backward or sideways. A steered robot turns in curves alone.
    """
    speed, turn = np.hypot(twists[:, 0], twists[:, 1]), twists[:, 2]
    moving, turns = speed > MOVING, np.abs(turn) > TURNING
    spot = turns & (speed < _ON_THE_SPOT * robot.reach * np.abs(turn) + MOVING) & robot.drive.direct
    angle = np.degrees(np.arctan2(twists[:, 1], twists[:, 0]))
    sides = dict(zip(_SIDES, (turn > 0, turn < 0), strict=True))
    kinds = {"straight": moving & (np.abs(turn) < _STRAIGHT)}
    kinds |= {f"curves to the {side}": turns & ~spot & to_side for side, to_side in sides.items()}
    if robot.drive.direct:
        kinds |= {f"on the spot to the {side}": spot & to_side for side, to_side in sides.items()}
    ahead = moving & ~spot
    kinds |= {"forward": ahead & (np.abs(angle) <= _SECTOR), "backward": ahead & (np.abs(angle) >= 180 - _SECTOR)}
    if len(robot.motions) == 3:
        kinds |= {
            "sideways to the left": ahead & (np.abs(angle - 90) <= _SECTOR),
            "sideways to the right": ahead & (np.abs(angle + 90) <= _SECTOR),
        }
    return kinds


def turning(kinds: Kinds, side: str) -> NDArray[np.bool_]:
    """True (n,) for twists that turn to a side, left or right, in curves or on the spot."""
    curves = kinds[f"curves to the {side}"]
    return curves | kinds.get(f"on the spot to the {side}", np.zeros_like(curves))
