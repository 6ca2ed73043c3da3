"""The motions that a model was fitted to, and whether others are among them: effects need not hold beyond."""

from __future__ import annotations

import numpy as np

from omnibench.robot.kinematics import Array, Robot

_NEAR = 0.15  # of the largest motion: what is nearer to one that was driven is not new
_SPACING = 0.05  # of the largest motion, between those that are kept
_SMOOTHING = 0.25  # s
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
    from scipy.spatial import KDTree  # a live node does not need it

    known, own = driven * _scale(robot), motions * _scale(robot)
    size = _size(known)
    away = KDTree(known).query(own)[0] > _NEAR * size
    if away.mean() < _OFTEN:
        return 0.0, ""
    return float(away.mean()), _in_words(own[away], motions[away])


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
