"""Where the runs of a recording begin and end: not across gaps and jumps of the reference, and from rest, if wanted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from omnibench.data.checks.reference_jumps import reference_jumps
from omnibench.data.importers.runs.reference_options import ReferenceOptions
from omnibench.data.importers.runs.reference_stream import ReferenceStream
from omnibench.data.importers.wheel_samples import WheelSamples
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

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


Span = tuple[float, float]
"""Begin and end, s."""

# A robot rests while no wheel leaves a range of this angle (chosen, as that of the importer of bags) for this time
# (chosen; shorter than there, as no run is cut in two by it).
LEAST_REST, STILL = 0.3, 0.025  # s, rad
_SAME_TIME = 1e-6  # s; unix time in a double has steps of 0.2 us


def breaks(samples: WheelSamples, reference: ReferenceStream, options: ReferenceOptions) -> list[Span]:
    """From the last pose before to the first pose after each gap and each jump of the reference, where these cut."""
    times = reference.times
    found: set[int] = set()
    if options.longest_gap is not None:
        found |= set(np.flatnonzero(np.diff(times) > options.longest_gap).tolist())
    if options.jumps == "cut":
        for part in samples.stretches():
            seen = np.flatnonzero((times >= samples.begins[part][0]) & (times <= samples.ends[part][-1]))
            if len(seen):
                model = OdometryModel.of_design(options.robot, "arc")
                (driven,) = model.poses([wheel_log(samples, part, options.robot, times[seen])])
                found |= set(seen[reference_jumps(options.robot, driven, reference.poses[seen])].tolist())
    return [(float(times[index]), float(times[index + 1])) for index in sorted(found)]


def wheel_log(samples: WheelSamples, part: slice, robot: Robot, stamps: Array) -> WheelLog:
    """The log of an unbroken part of the samples, from t = 0 at its begin, with stamps (S,) of the recording, s."""
    zero = float(samples.begins[part][0])
    steering = None if samples.steering is None else samples.steering[part]
    drive = None if robot.drive.direct else robot.drive
    log = WheelLog(samples.ends[part] - zero, samples.rates[part], np.zeros(3), stamps - zero)
    return replace(log, steering=steering, drive=drive)


def parted(span: Span, breaks: Sequence[Span]) -> Iterator[Span]:
    """The parts of a span between the breaks within it."""
    begin, end = span
    for before, after in breaks:
        if begin - _SAME_TIME < before and after < end + _SAME_TIME:
            yield begin, before
            begin = after
    yield begin, end


def from_rest(samples: WheelSamples, part: slice, span: Span, stamps: Array) -> Span | None:
    """The span from the rest before its first drive on, at one of the poses at stamps (K,), s; None without a rest."""
    times, angles = samples.edges(part)
    within = (times > span[0] - _SAME_TIME) & (times < span[1] + _SAME_TIME)
    rests = find_rests(times[within], angles[within], LEAST_REST, STILL)
    rests = [rest for rest in rests if rest[1] < times[within][-1]]
    return (departure(rests[0], False, stamps), span[1]) if rests else None
