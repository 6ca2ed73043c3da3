"""Angles of wheels between two readings of their counters, which may wrap, restart, or miss a silence."""

from __future__ import annotations

import math

import numpy as np

from omnibench.live.estimation.counts import Counts
from omnibench.robot.kinematics import Array

_TURN = 2 * math.pi
_WITHIN_A_TURN = _TURN + 1e-6  # rad, a turn and rounding
# Share of its last reading below which a counter has restarted; chosen: a robot seldom drives back so near its start.
_RESTARTED = 0.05
_JITTER = 0.01  # s, by which stamps may be too close together; chosen
_FASTER = 1.5  # times the fastest rate so far is the fastest that is believed of a silence; chosen


class WheelAngles:
    """The counters of one robot's wheels.

    wrap: the angle after which counters start again, rad; None: a counter that stays within one turn is taken to wrap
    there. max_rate: of any wheel, rad/s. known (N,): the last reading, rad; None before the first.
    """

    def __init__(self, wheels: int, wrap: float | None, max_rate: float, counts: Counts) -> None:
        self._wrap = wrap
        self._max_rate = max_rate
        self._counts = counts
        self._fastest = 0.0  # rad/s, of any wheel so far
        self._beyond_a_turn = np.zeros(wheels, dtype=bool)  # counters that have been there do not wrap at a turn
        self._wraps = wrap is not None
        self.known: Array | None = None

    def begin(self, positions: Array | None) -> None:
        """Count from these angles (N,) rad; None: from the next reading."""
        self.known = positions
        if positions is not None:
            self._beyond_a_turn |= np.abs(positions) > _WITHIN_A_TURN

    def drive(self, angles: Array) -> None:
        """Add a turn by ``angles`` (N,) rad that comes from rates and not from the counters."""
        if self.known is not None:
            self.known = self.known + angles

    def turned(self, positions: Array, rates: Array, elapsed: float) -> tuple[Array, bool]:
        """Angles (N,) rad since the last reading, and True if they hold the whole motion.

        rates (N,): expected, rad/s; they stand in for a counter that restarted. elapsed: s since the last reading.
        """
        assert self.known is not None
        expected = rates * elapsed
        angles = self._unwrapped(positions, expected)
        self.begin(positions)
        farthest, span = max(map(abs, angles.tolist())), max(elapsed, _JITTER)
        if farthest <= self._max_rate * span:
            self._fastest = max(self._fastest, farthest / span)
            return angles, True
        self._counts.counter_restarts += 1
        return np.where(np.abs(angles) > self._max_rate * span, expected, angles), False

    def turned_unseen(self, positions: Array, elapsed: float) -> tuple[Array, bool]:
        """Angles and flag of ``turned`` after a silence of ``elapsed`` s: turns may be lost, counters restarted."""
        assert self.known is not None
        before = self.known
        # counters that wrap do not tell how far the wheels went: the shortest way is taken
        angles = self._unwrapped(positions, np.zeros(len(positions))) if self._wraps else positions - before
        self.begin(positions)
        fastest = (_FASTER * self._fastest or self._max_rate) * elapsed + math.pi
        far = np.abs(before) > math.pi
        restarted = bool(far.any()) and bool((np.abs(positions) < _RESTARTED * np.abs(before))[far].all())
        if restarted or (np.abs(angles) > fastest).any():
            self._counts.counter_restarts += 1
            return np.zeros(len(angles)), False
        turns_may_be_lost = self._wrap is not None or not self._beyond_a_turn.all()
        length = self._wrap or _TURN
        return angles, not (turns_may_be_lost and fastest > length / 2 + math.pi)

    def _unwrapped(self, positions: Array, expected: Array) -> Array:
        """Differences (N,) rad from the last reading, with the wraps that bring them nearest to those expected."""
        assert self.known is not None
        angles: Array = positions - self.known
        length = self._wrap or _TURN
        if max(map(abs, (angles - expected).tolist())) <= length / 2:
            return angles
        wraps = np.round((angles - expected) / length)
        if self._wrap is None:  # a continuous joint of ROS 2 may wrap at a turn
            wraps[self._beyond_a_turn | (np.abs(positions) > _WITHIN_A_TURN)] = 0.0
        if wraps.any():
            self._counts.wraps += 1
            self._wraps = True
        return angles - length * wraps
