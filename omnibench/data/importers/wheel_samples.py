"""Wheel samples of a recording: mean rates between readings of the encoders, in stretches without missing samples."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from omnibench.data.checks.finding import FindingWarning
from omnibench.data.importers.encoder_counts import repeated_readings
from omnibench.data.importers.encoder_options import EncoderOptions
from omnibench.robot.kinematics import Array
from omnibench.words import plural

_MOST_TOO_FAST = 0.05  # share of samples faster than any wheel turns; more mean a wrong unit


@dataclass(frozen=True, eq=False)
class WheelReadings:
    """What a robot's encoders showed.

    times (F,): s, increasing. values (F, N): angles that count on, rad, if ``counted``; else mean rates since the
    reading before, rad/s. absolute: the angles are the wheels' own, not counted from an unknown one. steering (F, S):
    steering angles, rad, where there are any.
    """

    times: Array
    values: Array
    counted: bool
    absolute: bool
    steering: Array | None = None

    def only(self, kept: NDArray[np.bool_]) -> WheelReadings:
        """Some of the readings."""
        steering = None if self.steering is None else self.steering[kept]
        return WheelReadings(self.times[kept], self.values[kept], self.counted, self.absolute, steering)


@dataclass(frozen=True, eq=False)
class WheelSamples:
    """Wheel samples from begins (F,) to ends (F,), s; none spans a gap.

    rates (F, N): rad/s. angles (F, N) and steering (F, S): at the ends, rad, or None. stretch (F,): number of the
    unbroken stretch that a sample belongs to; angles are continuous within a stretch only.
    """

    begins: Array
    ends: Array
    rates: Array
    angles: Array | None
    steering: Array | None
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
    """Samples that were dropped: gaps in the stream, restarts of the counters, and readings that were logged again."""

    gaps: int
    longest: float  # gap, s
    restarts: int
    repeats: int

    def in_words(self, place: str, reading: str) -> list[str]:
        """Warnings of restarts and repeats. place: their recording. reading: a message, or a row."""
        words: list[str] = []
        if self.restarts:
            anew = f"the positions begin anew {plural(self.restarts, 'time')}, faster than any wheel turns"
            way = "if that is a counter that wraps, --set wraps_at=N"
            words.append(FindingWarning.of_restart(f"{place}: {anew} ({way}); runs end there"))
        if self.repeats:
            repeated = "that repeats the one before" if self.repeats == 1 else "that repeat the ones before"
            words.append(f"{place}: {plural(self.repeats, reading)} {repeated} while the wheels turn left out")
        return words


def wheel_samples(
    readings: WheelReadings,
    options: EncoderOptions,
    place: str,
    period: float,
    *,
    longest_gap: float = np.inf,
    still: float = 0.0,
) -> tuple[WheelSamples, Losses]:
    """Samples from the readings of encoders at least two times.

    place: for messages. period: of a first sample of rates, s. longest_gap: s; a longer one while the robot drives ends
    a stretch, since a constant twist does not describe it. still: rad; wheels that turned by less in a gap stood.
    A position that changes faster than ``fastest`` has started again. DataError: so many samples are faster that the
    unit must be another.
    """
    repeats = 0
    if readings.counted:
        repeated = repeated_readings(readings.times, readings.values, readings.steering)
        repeats, readings = int(repeated.sum()), readings.only(~repeated)
    times, values = readings.times, readings.values
    angles: Array | None = None
    if readings.counted:
        driven = np.diff(values, axis=0)
        begins, ends = times[:-1], times[1:]
        rates: Array = driven / (ends - begins)[:, None]
        angles = values[1:] if readings.absolute else None
        moved = (np.abs(driven) >= still).any(axis=1)
    else:
        begins, ends = np.append(times[0] - period, times[:-1]), times
        rates, moved = values, np.ones(len(times), dtype=bool)
    steering = None if readings.steering is None else readings.steering[-len(ends) :]
    lengths = ends - begins
    gap = (lengths > longest_gap) & moved
    too_fast = (np.abs(rates) > options.fastest_rates).any(axis=1) & ~gap
    if too_fast.mean() > _MOST_TOO_FAST:
        raise options.misread(place, rates, lengths)
    restart = too_fast & readings.counted
    lost: NDArray[np.bool_] = gap | restart
    kept = ~lost
    samples = WheelSamples(
        begins[kept],
        ends[kept],
        rates[kept],
        None if angles is None else angles[kept],
        None if steering is None else steering[kept],
        np.cumsum(lost, dtype=np.intp)[kept],
    )
    return samples, Losses(int(gap.sum()), float(lengths[gap].max(initial=0.0)), int(restart.sum()), repeats)
