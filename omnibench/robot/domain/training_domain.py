"""Training domain: the motions that a model was fitted to. Outside it the model's effects extrapolate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array, Robot

# Lengths of motions (m/s, turning as speed at the wheels) are shares of the largest in the domain. All are chosen.
_NEAR = 0.15  # a motion nearer than this to one in the domain is inside
_SPACING = 0.05  # least distance between the representatives that are kept
_SMOOTHING = 0.25  # s, over which the twists of a run are averaged
_STANDING = 0.02  # a smaller motion is standing still, which is inside every domain
_OFTEN = 0.05  # share of a run's time: motions outside that take less are transitions, and do not count


def motions_of(matrix: Array, times: Array, signals: Array) -> Array:
    """Twists (k, 3) of a run, m/s, m/s, rad/s, smoothed over a quarter of a second; times (F,), signals (F, M)."""
    width = max(1, round(_SMOOTHING * len(times) / float(times[-1])))
    totals = np.cumsum(np.vstack([np.zeros(3), signals @ matrix.T]), axis=0)
    if len(times) <= width:
        return totals[-1:] / len(times)
    smooth: Array = (totals[width:] - totals[:-width])[:: max(1, width // 2)] / width
    return smooth


def representatives(robot: Robot, motions: Array) -> Array:
    """A subset of motions (k, 3) such that every motion is near one of the subset."""
    at_wheels = motions * _scale(robot)
    size = _size(at_wheels)
    _, first = np.unique(np.round(at_wheels / (_SPACING * size)), axis=0, return_index=True)
    chosen: list[int] = []
    for index in first:
        if not chosen or np.linalg.norm(at_wheels[chosen] - at_wheels[index], axis=1).min() > _SPACING * size:
            chosen.append(int(index))
    return motions[chosen]


def kinds_of_motion(robot: Robot, means: Array, spreads: Array) -> NDArray[np.intp]:
    """The number (k,) of the kind of each of several paths: all of a kind are near to its first one.

    means, spreads (k, 3): of their twists, and standard deviations about these.
    """
    paths = np.hstack([means, spreads]) * np.tile(_scale(robot), 2)
    size = _size(paths)
    kinds, firsts = np.zeros(len(paths), dtype=np.intp), list[int]()
    for number, path in enumerate(paths):
        near = np.flatnonzero(np.linalg.norm(paths[firsts] - path, axis=1) < _NEAR * size)
        kinds[number] = near[0] if len(near) else len(firsts)
        if not len(near):
            firsts.append(number)
    return kinds


def extrapolated_share(robot: Robot, fitted: Array, motions: Array) -> tuple[float, str]:
    """The share of motions (k, 3) outside the training domain of ``fitted`` (n, 3), and what they are, in words."""
    domain = TrainingDomain(robot, fitted)
    outside = domain.outside_in_run(motions)
    return (float(outside.mean()), domain.in_words(motions[outside])) if outside.any() else (0.0, "")


class TrainingDomain:
    """The motions (n, 3) that a model was fitted to, m/s, m/s, rad/s; a motion far from all of them is outside."""

    def __init__(self, robot: Robot, motions: Array | Sequence[Sequence[float]]) -> None:
        self._scale = _scale(robot)
        self._known = np.asarray(motions, dtype=float) * self._scale
        self._size = _size(self._known)

    def excess(self, motions: Array) -> Array:
        """How far (k,) motions (k, 3) are outside, in widths of what counts as near to a known motion; 0 inside."""
        at_wheels = motions * self._scale
        excess: Array = np.maximum(self._distances(at_wheels) / (_NEAR * self._size) - 1, 0.0)
        return np.where(np.linalg.norm(at_wheels, axis=1) < _STANDING * self._size, 0.0, excess)

    def is_outside(self, motion: Array) -> bool:
        """True if one motion (3,) is outside."""
        return bool(self.outside(motion[None])[0])

    def outside(self, motions: Array) -> NDArray[np.bool_]:
        """True (k,) for each of many motions (k, 3) that is outside."""
        outside: NDArray[np.bool_] = self.excess(motions) > 0
        return outside

    def _distances(self, at_wheels: Array) -> Array:
        """Distances (k,) of motions (k, 3), m/s, from the nearest known one; one without SciPy, slow to import live."""
        if len(at_wheels) == 1:
            return np.sqrt(np.square(self._known - at_wheels).sum(axis=1).min(keepdims=True))
        from scipy.spatial import KDTree

        distances: Array = KDTree(self._known).query(at_wheels)[0]
        return distances

    def outside_in_run(self, motions: Array) -> NDArray[np.bool_]:
        """True (k,) for the motions (k, 3) of one run that are outside; all False where they are mere transitions."""
        outside = self.outside(motions)
        return outside if outside.mean() >= _OFTEN else np.zeros_like(outside)

    def in_words(self, motions: Array) -> str:
        """The kind of motion that these (k, 3) are, by their medians, in words."""
        return _in_words(motions * self._scale, motions)


def extrapolation_consequence(effects: Sequence[str], *, fading: bool = False) -> str:
    """The consequence of extrapolation for effects of these names, in words. fading: they do so where unsure."""
    names = list(dict.fromkeys(effects))
    one = len(names) == 1
    fades = f"{'fades' if one else 'fade'} to the plain matrix where unsure, " if fading else ""
    return (
        f"{', '.join(names)} {'is' if one else 'are'} not known to hold there, {fades}and errors may be larger than "
        "stated"
    )


def _scale(robot: Robot) -> Array:
    """Factors (3,) that make m/s of a twist: turning counts as the speed that it gives the wheels."""
    return np.array([1.0, 1.0, robot.reach])


def _size(at_wheels: Array) -> float:
    """Length of the largest of some motions (k, 3), m/s."""
    return max(float(np.linalg.norm(at_wheels, axis=1).max()), 1e-9)


def _in_words(at_wheels: Array, motions: Array) -> str:
    speed = float(np.median(np.hypot(motions[:, 0], motions[:, 1])))
    turning = float(np.median(np.abs(at_wheels[:, 2])))
    if speed < 0.3 * turning:
        return "turning on the spot"
    if turning < 0.2 * speed:
        return f"driving straight at {speed:.2f} m/s"
    return f"turning while driving at {speed:.2f} m/s"
