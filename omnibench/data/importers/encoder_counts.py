"""Counts of encoders that begin again, and absolute encoders, as numbers that go on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array

POWERS_OF_TWO = tuple(2.0**bits for bits in range(8, 65))  # where counters of 8 to 64 bits begin again
# A counter is taken to begin again where its steps are short beside its range, and where the step across its end is
# not longer than the others are (chosen): that of a counter that was set to 0 is, but for one case in some thousands.
_LONGEST_STEP = 0.25  # of the range
_LONGER, _ROUNDING = 2.0, 1e-4  # times the longest other step, and of the range
_FEWEST_TICKS = 10  # of a step that is not slow; chosen
_USUAL = 2.0  # periods; a longer one without a step is a rest
# A step that lost one turn of a shorter register is one whole turn off what the wheel does before and after; all others
# keep well away from half a turn. Of a wheel that turns on, no other cause makes one step go backwards so far (chosen).
_AROUND = 1.0  # s before and after
_KEPT = 0.4  # of the register's range, that other steps may be off
_LOST = 0.6  # of the range
_RARE, _NEARLY_ALL = 0.01, 0.95  # shares of the steps
_ROUNDS = 3  # a lost turn beside another hides it at first


def recognised_wrap(counts: Array, ranges: tuple[float, ...]) -> float | None:
    """The one of ``ranges`` after which a counter with counts (F,) begins again; None if it does so after none."""
    steps, spread = np.abs(np.diff(counts)), np.ptp(counts)
    for wrap in sorted(ranges):
        across = steps > wrap / 2
        if not across.any() or spread > wrap * (1 + _ROUNDING):
            continue
        usual = float(steps[~across].max(initial=0.0))
        over = float(np.abs(steps[across] - wrap).max())
        if usual <= _LONGEST_STEP * wrap and over <= max(_LONGER * usual, _ROUNDING * wrap):
            return wrap
    return None


def counted_on(counts: Array, wrap: float) -> Array:
    """Counts (F,) of a counter that begins again after ``wrap``, signed or not, as counts that go on from the first."""
    turns = np.cumsum(np.round(np.diff(counts, prepend=counts[0]) / wrap))
    on: Array = counts - wrap * turns
    return on


def recognised_register(counts: Array, times: Array, ranges: tuple[float, ...]) -> float | None:
    """The one of ``ranges`` of which single steps of counts (F,), read at times (F,), s, lost a turn; None without.

    So does a driver that takes the difference of two readings in a register of 16 bits, and now and then reads too
    late. The steps go backwards while the wheel turns on, and not to 0, where a counter stands that was set anew.
    """
    possible = [wrap for wrap in sorted(ranges) if wrap <= np.ptp(counts)]
    if not possible:
        return None
    off, certain = _surprises(counts, times)
    steps = np.abs(np.diff(counts))
    farthest, usual = np.abs(off[certain]).max(initial=0.0), np.median(steps)
    anew = np.abs(counts[1:]) <= _LONGER * np.quantile(steps, _NEARLY_ALL)
    for wrap in possible:
        if farthest <= _LOST * wrap:  # no step lost a turn of this register, or of a longer one
            return None
        if usual > _LONGEST_STEP * wrap:
            continue
        found = counts
        for _ in range(_ROUNDS):
            found = turns_restored(found, times, wrap)
        turns = np.abs(np.round((np.diff(found) - np.diff(counts)) / wrap))
        if turns.max() > 1:  # a shorter register loses several
            continue
        lost = turns > 0
        left, certain = _surprises(found, times)
        backwards = np.diff(counts) * np.diff(found) < 0
        others = float(np.abs(left[certain & ~lost]).max(initial=0.0))
        if (lost & anew).any() or not backwards[lost].all():
            continue
        if lost.any() and lost.mean() < _RARE and others < _KEPT * wrap:
            return wrap
    return None


def turns_restored(counts: Array, times: Array, wrap: float) -> Array:
    """Counts (F,) with the whole turns of ``wrap`` that single steps lost, by what the wheel does before and after."""
    off, certain = _surprises(counts, times)
    turns = np.where(certain & (np.abs(off) > _LOST * wrap), np.round(off / wrap), 0.0)
    restored: Array = counts + wrap * np.concatenate([[0.0], np.cumsum(turns)])
    return restored


def _surprises(counts: Array, times: Array) -> tuple[Array, NDArray[np.bool_]]:
    """By how much (F - 1,) the wheel's rates before and after a step say that it is too short, and whether both do.

    A step begins where the counts last changed. Of the two rates the one that surprises less counts.
    """
    steps = np.diff(counts)
    count = len(steps)
    changed = np.maximum.accumulate(np.where(steps != 0, np.arange(count), -1))
    begin = np.concatenate([[-1], changed[:-1]]) + 1  # reading after the last step that was not 0
    end = np.arange(1, count + 1)
    first = np.searchsorted(times, times[begin] - _AROUND)
    last = np.minimum(np.searchsorted(times, times[end] + _AROUND), count)
    duration = times[end] - times[begin]
    off = []
    for low, high in ((first, begin), (end, last)):
        span = times[high] - times[low]
        rate = np.divide(counts[high] - counts[low], span, out=np.zeros(count), where=span > 0)
        off.append(rate * duration - steps)
    certain = (steps != 0) & (first < begin) & (end < last) & (off[0] * off[1] > 0) & (duration < _AROUND)
    return np.where(np.abs(off[0]) < np.abs(off[1]), off[0], off[1]), certain


def about_zero(shown: Array, turn: float) -> Array:
    """Angles (F,) of an absolute encoder, continuous; one that counts from 0 to a turn is read as about 0.

    An axle that steers stands nearer to straight ahead than half a turn of its encoder most of the time.
    """
    if np.ptp(shown) > turn * (1 + _ROUNDING):  # it counts several turns, or another unit
        return shown
    on = counted_on(shown, turn)
    if shown.min() < 0 or shown.max() > turn:  # it counts both ways
        return on
    middle: Array = on - turn * np.round(np.median(on) / turn)
    return middle


def repeated_readings(times: Array, angles: Array, steering: Array | None) -> NDArray[np.bool_]:
    """True (F,) for single readings of angles (F, N) and steering (F, S) that were logged again while the robot drives.

    They are as in the reading before, at the usual time (F,), s, after it, and the wheels turn by at least half their
    usual step before and after.
    """
    steps = np.abs(np.diff(angles, axis=0)).max(axis=1)
    durations = np.diff(times)
    still = (steps == 0) & (durations < _USUAL * np.median(durations))
    if steering is not None:
        still &= (np.diff(steering, axis=0) == 0).all(axis=1)
    moved = steps[steps > 0]
    if not len(moved) or len(steps) < 3:
        return np.zeros(len(angles), dtype=bool)
    # Slow wheels that step from tick to tick repeat themselves rightly.
    tick = np.diff(np.unique(steps)).min(initial=np.inf)
    fast = steps >= max(np.median(moved) / 2, _FEWEST_TICKS * tick)
    repeated = np.zeros(len(angles), dtype=bool)
    repeated[2:-1] = still[1:-1] & fast[:-2] & fast[2:]
    return repeated
