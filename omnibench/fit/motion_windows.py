"""Motion in windows of runs: what training along the integrated path compares, by NumPy or JAX; and windows as runs.

Runs are cut into steps over which the drive signals are averaged, and poses of the reference at the steps' edges are
taken in pairs, the windows. The motion in a window is its last pose seen from its first one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.robot.kinematics import Array, interpolated, relative

_LONGEST = 1.5  # times the wanted length of a step: between poses that are farther apart, steps are no longer than this


@dataclass(frozen=True, eq=False)
class MotionWindows:
    """Z runs in steps, padded to J steps, and P windows of them.

    drive (Z, J, M): mean drive signals of the steps, rad/s. durations (Z, J): s, 0 beyond a run's end. windows (P, 3):
    run, first and last edge. motions (P, 3): by the reference, m, m, rad. lengths (P,): each window's number among the
    wanted lengths.
    """

    drive: Array
    durations: Array
    windows: NDArray[np.intp]
    motions: Array
    lengths: NDArray[np.intp]

    @classmethod
    def of(cls, runs: Sequence[Trajectory], lengths: Sequence[float], step: float, most: int) -> MotionWindows:
        """The windows of runs with two poses or more each.

        lengths: s, of the windows, which begin every half of it; infinity: from the first pose to the last. step: s,
        longer where there would be more steps than ``most`` in all.
        """
        step = max(step, sum(float(run.pose_times[-1]) for run in runs) / most)
        parts = [_edges(run.pose_times, step) for run in runs]
        longest, signals = max(len(times) for times, _ in parts) - 1, runs[0].signals.shape[1]
        drive, durations = np.zeros((len(runs), longest, signals)), np.zeros((len(runs), longest))
        windows, motions, numbers = [], [], []
        for index, (run, (times, posed)) in enumerate(zip(runs, parts, strict=True)):
            steps = len(times) - 1
            # Means of the drive signals between the edges, by interpolation of their integrals.
            bounds, durations[index, :steps] = np.append(0.0, run.times), np.diff(times)
            driven = np.vstack([np.zeros(signals), np.cumsum(run.signals * np.diff(bounds)[:, None], axis=0)])
            drive[index, :steps] = np.diff(interpolated(times, bounds, driven), axis=0) / np.diff(times)[:, None]
            poses = interpolated(times[posed], run.pose_times, run.poses)
            for number, length in enumerate(lengths):
                for first, last in _pairs(times[posed], length):
                    windows.append((index, posed[first], posed[last]))
                    motions.append(relative(poses[first], poses[last]))
                    numbers.append(number)
        return cls(drive, durations, np.array(windows), np.array(motions), np.array(numbers))


def motions_in_windows(twists: Any, durations: Any, windows: Any, math: Any = np) -> Any:
    """Motions (P, 3), m, m, rad, in windows of runs with twists (Z, J, 3), by exact arcs.

    durations, windows: as in ``MotionWindows``. math: numpy, or jax.numpy, whose arrays these are.
    """
    moved = twists * durations[..., None]
    turned = math.cumsum(moved[..., 2], axis=1)
    middle, chord = turned - moved[..., 2] / 2, math.sinc(moved[..., 2] / (2 * np.pi))
    cosine, sine = chord * math.cos(middle), chord * math.sin(middle)
    ahead = math.cumsum(moved[..., 0] * cosine - moved[..., 1] * sine, axis=1)
    aside = math.cumsum(moved[..., 0] * sine + moved[..., 1] * cosine, axis=1)
    x, y, heading = (math.pad(sums, ((0, 0), (1, 0))) for sums in (ahead, aside, turned))
    run, first, last = windows.T
    before = heading[run, first]
    along_x, along_y = x[run, last] - x[run, first], y[run, last] - y[run, first]
    cosine, sine = math.cos(before), math.sin(before)
    motion = [cosine * along_x + sine * along_y, cosine * along_y - sine * along_x, heading[run, last] - before]
    return math.stack(motion, axis=-1)


def _edges(stamps: Array, step: float) -> tuple[Array, NDArray[np.intp]]:
    """Edges (J + 1,) of steps, s, and which of them (K,) are stamps of poses; these are about a step apart or more."""
    cells = np.floor(stamps / step + 1e-6)
    edges = stamps[np.append(True, np.diff(cells) > 0)]
    edges = edges if edges[-1] == stamps[-1] else np.append(edges, stamps[-1])
    pieces = np.maximum(np.ceil(np.diff(edges) / (_LONGEST * step) - 1e-6), 1).astype(int)
    posed = np.append(0, np.cumsum(pieces))
    return np.interp(np.arange(posed[-1] + 1), posed, edges), posed


def _pairs(times: Array, length: float) -> list[tuple[int, int]]:
    """First and last pose of the windows of a length, s."""
    if length == np.inf:
        return [(0, len(times) - 1)]
    firsts = np.searchsorted(times, np.arange(0.0, times[-1] - length + 1e-6, length / 2) - 1e-6)
    lasts = np.searchsorted(times, times[firsts] + length - 1e-6)
    return [pair for pair in zip(firsts.tolist(), lasts.tolist(), strict=True) if pair[1] < len(times)]


def windows_of(run: Trajectory, count: int) -> Iterator[Trajectory]:
    """So many parts of a run, which begin and end at reference poses."""
    if count == 1:
        yield run
        return
    bounds = np.linspace(0.0, run.end, count + 1)
    edges = np.unique(np.clip(np.searchsorted(run.pose_times, bounds), 0, len(run.pose_times) - 1))
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        begin, end = float(run.pose_times[first]), float(run.pose_times[last])
        driven = slice(*np.searchsorted(run.times, [begin, end], side="right").tolist())
        driven = slice(driven.start, min(driven.stop + 1, len(run.times)))
        if last - first <= 1 or driven.stop <= driven.start:
            continue
        seen = slice(first, last + 1)
        fields = {
            name: value[driven]
            for name in ("rates", "angles", "targets", "steering", "odometry")
            if (value := getattr(run, name)) is not None
        }
        yield replace(
            run,
            id=f"{run.id} ({begin:.1f} to {end:.1f} s)",
            times=run.times[driven] - begin,
            pose_times=run.pose_times[seen] - begin,
            poses=run.poses[seen],
            pose_covariances=None if run.pose_covariances is None else run.pose_covariances[seen],
            started_at=None if run.started_at is None else run.started_at + begin,
            command=None,
            sent=None,
            **fields,
        )
