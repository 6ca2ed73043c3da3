"""Rests of a robot in its wheels' angles."""

from __future__ import annotations

import numpy as np

from omnibench.robot.kinematics import Array

_KEPT = 0.5  # s of rest that are kept before and after a run (chosen)


def find_rests(times: Array, angles: Array, least: float, turned: float) -> list[tuple[float, float]]:
    """Rests as (begin, end), s: no wheel's angle leaves a range of ``turned`` rad for at least ``least`` s.

    times (F + 1,): s. angles (F + 1, N): rad, at these times. The range is used and not the rate from sample to sample,
    because one encoder tick within a short sample is a high rate.
    """
    # (first, last) indices of the shortest spans of that length from each time on, and up to each time.
    every, enough = np.arange(len(times)), least * (1 - 1e-9)
    on = np.column_stack([every, np.searchsorted(times, times + enough)])
    back = np.column_stack([np.searchsorted(times, times - enough, side="right") - 1, every])
    spans = np.vstack([on[on[:, 1] < len(times)], back[back[:, 0] >= 0]])
    if not len(spans):
        return []
    # reduceat takes pairs (first, behind the last); every second result is that between two pairs.
    pairs = (spans + np.array([0, 1])).ravel()
    padded = np.vstack([angles, angles[-1:]])
    ranges = np.maximum.reduceat(padded, pairs)[::2] - np.minimum.reduceat(padded, pairs)[::2]
    quiet = spans[(ranges <= turned).all(axis=1)]
    balance = np.zeros(len(times) + 1, dtype=int)
    np.add.at(balance, quiet[:, 0], 1)
    np.add.at(balance, quiet[:, 1], -1)
    resting = np.cumsum(balance)[:-1] > 0  # (T,): the sample that begins at each time is at rest
    steps = np.flatnonzero(np.diff(resting.astype(int), prepend=0, append=0))
    return [(float(times[begin]), float(times[end])) for begin, end in zip(steps[::2], steps[1::2], strict=True)]


def departure(rest: tuple[float, float], shared: bool, stamps: Array) -> float:
    """Begin of the run after a rest, s: at a reference pose of the rest, if it has one."""
    begin, end = rest
    target = max(end - _KEPT, (begin + end) / 2 if shared else begin)
    inside = stamps[(stamps >= begin) & (stamps <= end)]
    if not len(inside):
        return target
    late = inside[inside >= target]
    return float(late[0] if len(late) else inside[-1])
