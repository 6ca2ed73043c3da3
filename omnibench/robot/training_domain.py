"""The motions that a model was fitted to, and whether others are among them: effects need not hold beyond."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array, Robot

_NEAR = 0.15  # of the largest motion: what is nearer to one that was driven is not new
_SPACING = 0.05  # of the largest motion, between those that are kept
_SMOOTHING = 0.25  # s
_STANDING = 0.02  # of the largest motion: who stands drives nothing new
_OFTEN = 0.05  # of a run's time: what is driven for less is a transition


def motions_of(matrix: Array, times: Array, rates: Array) -> Array:
    """Twists (k, 3) of a run, m/s, m/s, rad/s, smoothed over a quarter of a second; times (F,), rates (F, N)."""
    width = max(1, round(_SMOOTHING * len(times) / float(times[-1])))
    totals = np.cumsum(np.vstack([np.zeros(3), rates @ matrix.T]), axis=0)
    if len(times) <= width:
        return totals[-1:] / len(times)
    smooth: Array = (totals[width:] - totals[:-width])[:: max(1, width // 2)] / width
    return smooth


def representatives(robot: Robot, motions: Array) -> Array:
    """A few of many motions (k, 3), such that every one is near one of them."""
    at_wheels = motions * _scale(robot)
    size = _size(at_wheels)
    _, first = np.unique(np.round(at_wheels / (_SPACING * size)), axis=0, return_index=True)
    chosen: list[int] = []
    for index in first:
        if not chosen or np.linalg.norm(at_wheels[chosen] - at_wheels[index], axis=1).min() > _SPACING * size:
            chosen.append(int(index))
    return motions[chosen]


def new_share(robot: Robot, driven: Array, motions: Array) -> tuple[float, str]:
    """The share of motions (k, 3) that are far from all that were driven (n, 3), and what they are, in words."""
    known = DrivenMotions(robot, driven)
    away = known.new_in_run(motions)
    return (float(away.mean()), known.in_words(motions[away])) if away.any() else (0.0, "")


class DrivenMotions:
    """The motions (n, 3) that a model of a robot was fitted to, m/s, m/s, rad/s, and which others are far from all."""

    def __init__(self, robot: Robot, motions: Array | Sequence[Sequence[float]]) -> None:
        self._scale = _scale(robot)
        self._known = np.asarray(motions, dtype=float) * self._scale
        self._size = _size(self._known)

    def is_new(self, motion: Array) -> bool:
        """Whether one motion (3,) is far from all: for a live node, which has no time for SciPy."""
        own = motion * self._scale
        if np.linalg.norm(own) < _STANDING * self._size:
            return False
        return bool(np.linalg.norm(self._known - own, axis=1).min() > _NEAR * self._size)

    def new_among(self, motions: Array) -> NDArray[np.bool_]:
        """The same of many motions (k, 3): (k,)."""
        from scipy.spatial import KDTree

        own = motions * self._scale
        away = KDTree(self._known).query(own)[0] > _NEAR * self._size
        new: NDArray[np.bool_] = away & (np.linalg.norm(own, axis=1) >= _STANDING * self._size)
        return new

    def new_in_run(self, motions: Array) -> NDArray[np.bool_]:
        """As ``new_among`` of the motions of one run, but none where it drives new ones only in passing."""
        away = self.new_among(motions)
        return away if away.mean() >= _OFTEN else np.zeros_like(away)

    def in_words(self, motions: Array) -> str:
        """What kind of motion these (k, 3) are, by their medians."""
        return _in_words(motions * self._scale, motions)


def not_known_to_hold(effects: Sequence[str]) -> str:
    """What follows for effects of these names beyond the motions that they were fitted to."""
    verb = "is" if len(effects) == 1 else "are"
    return f"{', '.join(effects)} {verb} not known to hold there, and errors may be larger than stated"


def _scale(robot: Robot) -> Array:
    """The turning counts as what it moves at the wheels, m/s."""
    return np.array([1.0, 1.0, np.mean([wheel.distance for wheel in robot.wheels])])


def _size(at_wheels: Array) -> float:
    return max(float(np.linalg.norm(at_wheels, axis=1).max()), 1e-9)


def _in_words(at_wheels: Array, motions: Array) -> str:
    speed = float(np.median(np.hypot(motions[:, 0], motions[:, 1])))
    turning = float(np.median(np.abs(at_wheels[:, 2])))
    if speed < 0.3 * turning:
        return "turning on the spot"
    if turning < 0.2 * speed:
        return f"driving straight at {speed:.2f} m/s"
    return f"turning while driving at {speed:.2f} m/s"
