"""What wheels turned between two readings of their counters, which may wrap, start again, or have been out of sight."""

from __future__ import annotations

import math

import numpy as np

from omnibench.live.estimation.counts import Counts
from omnibench.robot.kinematics import Array

_TURN = 2 * math.pi
_WITHIN_A_TURN = _TURN + 1e-6
_RESTARTED = 0.05  # of what a counter was; a robot hardly drives back so near to where its counters began
_JITTER = 0.01  # s
_FASTER = 1.5  # than the wheels were ever seen; out of sight they are not believed to be


class WheelAngles:
    """The counters of one robot's wheels.

    wrap: angles start again after so much, rad; None: angles that stay within one turn are found out. max_rate: rad/s.
    """

    def __init__(self, wheels: int, wrap: float | None, max_rate: float, counts: Counts) -> None:
        self._wrap = wrap
        self._max_rate = max_rate
        self._counts = counts
        self._fastest = 0.0  # seen so far, rad/s
        self._beyond_a_turn = np.zeros(wheels, dtype=bool)  # such a counter does not wrap at a turn
        self._wraps = wrap is not None
        self.known: Array | None = None

    def begin(self, positions: Array | None) -> None:
        """Count from here; None: from what comes next."""
        self.known = positions
        if positions is not None:
            self._beyond_a_turn |= np.abs(positions) > _WITHIN_A_TURN

    def drive(self, angles: Array) -> None:
        """The wheels turned by ``angles`` (N,) which the counters did not tell."""
        if self.known is not None:
            self.known = self.known + angles

    def turned(self, positions: Array, rates: Array, elapsed: float) -> tuple[Array, bool]:
        """Angles (N,) since the last reading, and whether they hold the whole motion.

        rates (N,): with which they are believed to have turned, rad/s; they bridge a counter that started again.
        elapsed: s, in which samples came; stamps may jitter by more than they are apart.
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
        """The same after a silence: whole turns may be lost, and a counter may have started again with its robot."""
        assert self.known is not None
        before = self.known
        # how far it went is anybody's guess: the shortest way, if these counters wrap at all
        angles = self._unwrapped(positions, np.zeros(len(positions))) if self._wraps else positions - before
        self.begin(positions)
        fastest = (_FASTER * self._fastest or self._max_rate) * elapsed + math.pi
        far = np.abs(before) > math.pi
        again = bool(far.any()) and bool((np.abs(positions) < _RESTARTED * np.abs(before))[far].all())
        if again or (np.abs(angles) > fastest).any():
            self._counts.counter_restarts += 1
            return np.zeros(len(angles)), False
        turns_may_be_lost = self._wrap is not None or not self._beyond_a_turn.all()
        length = self._wrap or _TURN
        return angles, not (turns_may_be_lost and fastest > length / 2 + math.pi)

    def _unwrapped(self, positions: Array, expected: Array) -> Array:
        """Differences, by as many wraps more or less as bring them next to what is expected."""
        assert self.known is not None
        angles: Array = positions - self.known
        length = self._wrap or _TURN
        if max(map(abs, (angles - expected).tolist())) <= length / 2:
            return angles
        wraps = np.round((angles - expected) / length)
        if self._wrap is None:  # as ROS 2's continuous joints have it, if they have
            wraps[self._beyond_a_turn | (np.abs(positions) > _WITHIN_A_TURN)] = 0.0
        if wraps.any():
            self._counts.wraps += 1
            self._wraps = True
        return angles - length * wraps
