"""Counters of encoders: where they begin again, single readings that jump, and turns that a short register lost.

A counter's range is decided for the whole recording: a slow run shows it, and the fast ones are read by it, too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array

POWERS_OF_TWO = tuple(2.0**bits for bits in range(8, 65))  # where counters of 8 to 64 bits begin again
# A counter is taken to begin again where its steps are short beside its range, and where the step across its end is
# not longer than the others are (chosen): that of a counter that was set to 0 is, but for one case in some thousands.
_LONGEST_STEP = 0.25  # share of a counter's range that its steps are at most where it is taken to begin again
_LONGER, _ROUNDING = 2.0, 1e-4  # times the longest other step, and of the range
_FEWEST_CROSSINGS = 3  # at one place, of a range that is no power of two and no turn; chosen
# A step that lost one turn of a shorter register is one whole turn off what the wheel does before and after; all others
# keep well away from half a turn. Of a wheel that turns on, no other cause makes one step go backwards so far (chosen).
_AROUND = 1.0  # s before and after
_KEPT, _LOST = 0.4, 0.6  # of the register's range: that other steps may be off, and that a lost turn is at least
_RARE, _NEARLY_ALL = 0.01, 0.95  # shares of the steps
_ROUNDS = 20  # at most: a lost turn beside another hides it at first
# A reading that jumps and returns is beyond its neighbours by more than the longest usual step, and by so many standard
# deviations of usual readings from the line between theirs, and ticks, at least; it returns as near as that (chosen).
_DEVIATIONS, _NEAR, _TICKS = 8.0, 4.0, 3.0
_FEWEST = 5  # readings, of fewer it is not told what is usual
_MOST_HELD = 100  # rows in which a sensor that is read less often holds a value; chosen: more are an even motion
_FEWEST_TICKS, _USUAL = 10, 2.0  # ticks of a step that is not slow; periods, a longer one without a step is a rest


def counter_range(runs: Sequence[Array], turn: float, whole: bool) -> float | None:
    """The number of counts after which the counter of a wheel begins again; None if it does so after none.

    runs: its counts (F,) in every run of the recording. turn: counts of a turn. whole: they are ticks, of which other
    ranges than a turn are possible: powers of two, and any that three crossings or more agree on.
    """
    spread = max(counts.max() for counts in runs) - min(counts.min() for counts in runs)
    for wrap in sorted((turn, *(POWERS_OF_TWO if whole else ()))):
        within = wrap / 2 < spread <= wrap * (1 + _ROUNDING)
        if within and any(begins_again(counts, wrap) for counts in runs):
            return wrap
    return _agreed_range(runs, spread, turn) if whole and spread > 0 else None


def begins_again(counts: Array, wrap: float) -> bool:
    """True if counts (F,) cross the end of a range, by steps that are short beside it."""
    steps = np.abs(np.diff(counts))
    across = steps > wrap / 2
    if not across.any():
        return False
    usual = float(steps[~across].max(initial=0.0))
    over = float(np.abs(steps[across] - wrap).max())
    return usual <= _LONGEST_STEP * wrap and over <= max(_LONGER * usual, _ROUNDING * wrap)


def _agreed_range(runs: Sequence[Array], spread: float, turn: float) -> float | None:
    """The range that crossings of its end agree on: the multiple of a turn next to it, if one is near enough."""
    across, local = np.empty(0), np.empty(0)
    for counts in runs:
        steps = np.pad(np.diff(counts), 1, constant_values=np.nan)
        crossing = np.flatnonzero(np.abs(steps) > spread / 2)
        around = steps[crossing[:, None] + np.array([-1, 1])]  # the steps before and after
        jumps = np.isnan(around).all(axis=1) | (np.abs(around) > spread / 2).any(axis=1)  # and returns
        if np.nan_to_num(np.abs(np.delete(steps, crossing))).max() > _LONGEST_STEP * spread or jumps.any():
            return None
        across = np.append(across, np.abs(steps[crossing]))
        local = np.append(local, np.abs(np.nanmean(around, axis=1)))
    if len(across) < _FEWEST_CROSSINGS:
        return None
    wrap, step = float(np.median(across + local)), max(float(local.max()), 1.0)
    if np.abs(across + local - wrap).max() > _LONGER * step or wrap < spread:
        return None
    likely = [each for each in (turn * round(wrap / turn), spread + 1) if spread < each and abs(each - wrap) <= step]
    return float([*likely, round(wrap)][0])


def counted_on(counts: Array, wrap: float) -> Array:
    """Counts (F,) of a counter that begins again after ``wrap``, signed or not, as counts that go on from the first.

    A step is the one nearest to the step before where some are long beside the range, and else the shortest.
    """
    steps = np.diff(counts, prepend=counts[0])
    short = steps - wrap * np.round(steps / wrap)
    if np.abs(short).max() > _LONGEST_STEP * wrap:
        before = 0.0
        for index, step in enumerate(short.tolist()):
            before = short[index] = step + wrap * round((before - step) / wrap)
    return np.asarray(counts - wrap * np.cumsum(np.round((steps - short) / wrap)))


def jumping_readings(counts: Array, times: Array) -> NDArray[np.bool_]:
    """True (F, N) for lone readings of counts (F, N), one or two in a row, that jump beyond those about them.

    Readings with a late stamp are off the line between their neighbours, too, but between these. The line is as steep
    as the steps beside it, so that a counter which was set anew, and stays there, does not count. A wheel that stands
    has the ticks of the others.
    """
    jumping, steps = np.zeros(counts.shape, dtype=bool), np.diff(counts, axis=0)
    if len(counts) < _FEWEST or not steps.any():
        return jumping
    sizes = np.abs(steps)
    tick = min(float(np.median(moved[moved <= 2 * moved.min()])) for wheel in sizes.T if len(moved := wheel[wheel > 0]))
    longest = np.quantile(sizes, _NEARLY_ALL, axis=0)  # (N,)
    share = (times[1:-1] - times[:-2]) / (times[2:] - times[:-2])
    off = counts[1:-1] - counts[:-2] - share[:, None] * (counts[2:] - counts[:-2])
    deviation = 1.4826 * np.median(np.abs(off), axis=0)
    near, usual = (np.maximum(size * deviation, _TICKS * tick) for size in (_NEAR, _DEVIATIONS))
    least = np.maximum(usual, longest)
    around = np.pad(steps, ((1, 1), (0, 0)), mode="edge")  # steps before and after each reading
    for lone in (1, 2):
        before, after = counts[: -lone - 1], counts[lone + 1 :]  # (F - lone - 1, N)
        lowest, highest = np.minimum(before, after) - least, np.maximum(before, after) + least
        rows = [slice(row, row + len(before)) for row in range(1, lone + 1)]
        jumps = np.logical_and.reduce([(counts[row] < lowest) | (counts[row] > highest) for row in rows])
        if not jumps.any():
            continue
        steps_beside, way = np.array([around[: -lone - 2], around[lone + 2 :]]) * (lone + 1), after - before
        jumps &= (way >= steps_beside.min(axis=0) - near) & (way <= steps_beside.max(axis=0) + near)
        for row in rows:
            jumping[row] |= jumps
    return jumping


def lost_register(counts: Array, times: Array, ranges: Sequence[float]) -> float | None:
    """The one of ``ranges`` of which single steps of counts (F,), read at times (F,), s, lost a turn; None without.

    So does a driver that takes the difference of two readings in a register of 16 bits, and now and then reads too
    late. The steps go backwards while the wheel turns on, and not to 0, where a counter stands that was set anew.
    """
    spread = np.ptp(counts)
    possible = [wrap for wrap in sorted(ranges) if wrap <= spread]
    if not possible:
        return None
    steps, (off, certain) = np.diff(counts), _surprises(counts, times)
    farthest = np.abs(off[certain]).max(initial=0.0)
    anew = np.abs(counts[1:]) <= _LONGER * np.quantile(np.abs(steps), _NEARLY_ALL)
    for wrap in possible:
        if farthest <= _LOST * wrap:  # no step lost a turn of this register, or of a longer one
            return None
        if np.median(np.abs(steps)) > _LONGEST_STEP * wrap:
            continue
        restored = turns_restored(counts, times, wrap)
        turned = np.diff(restored)
        turns = np.abs(np.round((turned - steps) / wrap))
        lost = turns > 0
        surprises, certain = _surprises(restored, times)
        others = np.abs(surprises[certain & ~lost]).max(initial=0.0)
        single = turns.max() == 1 and lost.mean() < _RARE  # a shorter register loses several turns
        if single and others < _KEPT * wrap and not (lost & (anew | (steps * turned >= 0))).any():
            return wrap
    return None


def turns_restored(counts: Array, times: Array, wrap: float) -> Array:
    """Counts (F,) with the whole turns of ``wrap`` that single steps lost, by what the wheel does before and after."""
    for _ in range(_ROUNDS):
        off, certain = _surprises(counts, times)
        turns = np.where(certain & (np.abs(off) > _LOST * wrap), np.round(off / wrap), 0.0)
        if not turns.any():
            break
        counts = counts + wrap * np.concatenate([[0.0], np.cumsum(turns)])
    return counts


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
    return np.asarray(on - turn * np.round(np.median(on) / turn))


def repeated_readings(times: Array, counts: Array, steering: Array | None) -> NDArray[np.bool_]:
    """True (F,) for single readings of counts (F, N) and steering (F, S) that were logged again while the robot drives.

    They are as in the reading before, at the usual time (F,), s, after it, and the wheels turn by at least half their
    usual step before and after. Slow wheels that step from tick to tick repeat themselves rightly.
    """
    steps = np.abs(np.diff(counts, axis=0)).max(axis=1)
    durations = np.diff(times)
    still = (steps == 0) & (durations < _USUAL * np.median(durations))
    if steering is not None:
        still &= (np.diff(steering, axis=0) == 0).all(axis=1)
    moved, repeated = steps[steps > 0], np.zeros(len(counts), dtype=bool)
    if not len(moved) or len(steps) < 3:
        return repeated
    sizes = np.unique(moved)
    apart = np.diff(sizes, prepend=0.0)
    tick = float(apart[apart > 1e-9 * sizes[-1]].min())
    fast = steps >= max(np.median(moved) / 2, _FEWEST_TICKS * tick)
    repeated[2:-1] = still[1:-1] & fast[:-2] & fast[2:]
    return repeated


def held_readings(values: Array) -> NDArray[np.bool_]:
    """True (F,) for rows of values (F, n) that hold the last value of a sensor which is read less often than the rows.

    The sensor's period is the usual number of equal rows between two changes; while it stands every such row counts.
    """
    held = np.zeros(len(values), dtype=bool)
    changes = np.flatnonzero(np.concatenate([[True], (np.diff(values, axis=0) != 0).any(axis=1)]))
    lengths = np.diff(np.append(changes, len(values)))
    if len(lengths) < _FEWEST:
        return held
    period = int(np.median(lengths[1:-1]))
    if not 2 <= period <= _MOST_HELD or np.mean(np.abs(lengths[1:-1] - period) <= 1) < 1 - 5 * _RARE:
        return held
    since = np.arange(len(values)) - np.repeat(changes, lengths)
    return since % period != 0
