"""Wheel samples of a bag: mean rates between stamps, in stretches without missing samples."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from omnibench.data.importers.rosbag.message_streams import Stamps, WheelStream
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array

# A longer gap while the robot drives ends a stretch, since a constant twist does not describe it (chosen):
_LONGEST_GAP = 0.5  # s, and
_LONGEST_GAP_PERIODS = 10  # sample periods
_MOST_RESTARTS = 0.05  # share of restarts among all samples; more mean a wrong unit
FASTEST = 100.0  # rad/s; a position that changes faster has started again (chosen)


@dataclass(frozen=True, eq=False)
class WheelSamples:
    """Wheel samples from begins (F,) to ends (F,), s since ``origin`` (ns); none spans a gap.

    rates (F, N): rad/s. angles (F, N): at the ends, rad, or None. stretch (F,): number of the unbroken stretch that a
    sample belongs to; angles are continuous within a stretch only.
    """

    origin: int
    begins: Array
    ends: Array
    rates: Array
    angles: Array | None
    stretch: NDArray[np.intp]

    def stretches(self) -> Iterator[slice]:
        """The samples of each unbroken stretch."""
        edges = np.flatnonzero(np.diff(self.stretch, prepend=-1, append=-1))
        for first, last in pairwise(edges.tolist()):
            yield slice(first, last)

    def edges(self, part: slice) -> tuple[Array, Array]:
        """Times (F + 1,) and the angles driven until then (F + 1, N), from 0, of an unbroken part."""
        driven = self.rates[part] * (self.ends[part] - self.begins[part])[:, None]
        times = np.append(self.begins[part.start], self.ends[part])
        return times, np.vstack([np.zeros(driven.shape[1]), np.cumsum(driven, axis=0)])


@dataclass(frozen=True)
class Losses:
    """Samples that were dropped: gaps in the stream, and restarts of the counters."""

    gaps: int
    longest: float  # gap, s
    restarts: int


def seconds(stamps: Stamps, origin: int) -> Array:
    """Stamps (ns) in s since ``origin``, exact to the nanosecond, which a double of unix time is not."""
    since: Array = (stamps - origin) / 1e9
    return since


def wheel_samples(
    wheels: WheelStream, signs: Array, wrap: float | None, still: float, place: str
) -> tuple[WheelSamples, Losses]:
    """Samples from recorded positions or velocities.

    signs (N,): 1 or -1. wrap: value, rad, after which positions start again. still: rad; wheels that turned by less in
    a gap stood. DataError: positions start again without ``wrap``, or are not in rad.
    """
    origin = int(wheels.stamps[0])
    times, values = seconds(wheels.stamps, origin), wheels.values
    period = float(np.median(np.diff(times)))
    if wheels.absolute:
        angles, driven = _counted(values, wrap, place)
        begins, ends, angles = times[:-1], times[1:], signs * angles[1:]
        rates = signs * driven / (ends - begins)[:, None]
        moved = (np.abs(driven) >= still).any(axis=1)
    else:
        begins, ends, angles = np.append(times[0] - period, times[:-1]), times, None
        rates, moved = signs * values, np.ones(len(times), dtype=bool)
    lengths = ends - begins
    gap = (lengths > max(_LONGEST_GAP, _LONGEST_GAP_PERIODS * period)) & moved
    restart = (np.abs(rates) > FASTEST).any(axis=1) & ~gap if wheels.absolute else np.zeros_like(gap)
    lost: NDArray[np.bool_] = gap | restart
    kept = ~lost
    if restart.mean() > _MOST_RESTARTS:
        raise DataError(
            f"{place}: the positions change by up to {np.abs(rates).max():.3g} rad/s; they must be in rad (not degrees "
            "or ticks); if they begin again after so many rad, set wheel_wrap"
        )
    samples = WheelSamples(
        origin,
        begins[kept],
        ends[kept],
        rates[kept],
        None if angles is None else angles[kept],
        np.cumsum(lost, dtype=np.intp)[kept],
    )
    losses = Losses(int(gap.sum()), float(lengths[gap].max(initial=0.0)), int(restart.sum()))
    return samples, losses


def _counted(values: Array, wrap: float | None, place: str) -> tuple[Array, Array]:
    """Angles (F, N) and the steps between them (F - 1, N), unwrapped by multiples of ``wrap``."""
    steps = np.diff(values, axis=0)
    if wrap is not None:
        steps = steps - wrap * np.round(steps / wrap)
        return np.vstack([values[:1], values[0] + np.cumsum(steps, axis=0)]), steps
    turn = 2 * np.pi
    if (np.ptp(values, axis=0) <= turn + 1e-6).all() and (np.abs(steps) > np.pi).any():
        raise DataError(f"{place}: the positions begin again after a turn; set wheel_wrap={turn!r} (rad)")
    return values, steps
