"""The examiner's own mathematics: motions over short windows by the wheels and by the reference, and their clocks.

Over a window of length h the reference moves by R(-mean heading) (x(t+h) - x(t)) and turns by theta(t+h) - theta(t); a
constant matrix takes the increments of the drive signals over the same window to the same three numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import minimize

from check_exam.recordings import TURN, Array, Recording, Run

_WINDOW = 0.5  # s; short beside a run's turns, long beside the noise of a pose
_GRID = np.arange(-2.0, 2.001, 0.25)  # s; offsets tried first
_FEWEST = 12  # windows of a run


@dataclass(frozen=True)
class Clock:
    """By how much poses are stamped too late at a run's begin and end, s. contrast: how sure that is, 0 to 1."""

    begin: float
    end: float
    contrast: float

    @property
    def farthest(self) -> float:
        return max(abs(self.begin), abs(self.end))


def drive_signals(recording: Recording, run: Run) -> Array:
    """Drive signals (F, M), rad, as they have counted up at each of the run's times."""
    angles = run.counts * (TURN / recording.ticks)
    if not recording.steered:
        return angles
    steps = np.diff(angles, axis=0)
    middle = (run.steering[1:] + run.steering[:-1]) / 2
    pairs = np.stack([steps * np.cos(middle), steps * np.sin(middle)], axis=2).reshape(len(steps), -1)
    return np.vstack([np.zeros(pairs.shape[1]), np.cumsum(pairs, axis=0)])


def windows(
    recording: Recording, run: Run, late: tuple[float, float] = (0.0, 0.0), length: float = _WINDOW
) -> tuple[Array, Array]:
    """Increments of the signals (W, M) and motions of the reference (W, 3).

    late: by how much, s, the poses are stamped too late at the run's begin and end, and linearly between.
    """
    span = (run.times[0], run.times[-1])

    def stamp(times: Array | float) -> Array:
        """The poses' stamps of the wheels' times."""
        return np.asarray(times + np.interp(times, span, late))

    times = np.arange(run.times[0], run.times[-1] - length, length / 2)
    times = times[(stamp(times) >= run.pose_times[0]) & (stamp(times + length) <= run.pose_times[-1])]
    signals = drive_signals(recording, run)
    track = np.column_stack([run.poses[:, :2], np.unwrap(run.poses[:, 2])])

    def at(values: Array, stamps: Array, wanted: Array) -> Array:
        return np.column_stack([np.interp(wanted, stamps, column) for column in values.T])

    counted = at(signals, run.times, times + length) - at(signals, run.times, times)
    first, last = (at(track, run.pose_times, stamp(instants)) for instants in (times, times + length))
    step, mean = last - first, (last[:, 2] + first[:, 2]) / 2
    cos, sin = np.cos(mean), np.sin(mean)
    body = np.column_stack([cos * step[:, 0] + sin * step[:, 1], -sin * step[:, 0] + cos * step[:, 1], step[:, 2]])
    return counted, body


def lever(recording: Recording) -> float:
    """A length, m, that weighs turning against driving: of the robot's wheels from its centre."""
    reach = [
        wheel.get("distance", np.hypot(wheel.get("x", 0.0), wheel.get("y", 0.0)))
        for wheel in recording.description["wheels"]
    ]
    return float(max(reach))


def fitted_matrix(recording: Recording) -> Array:
    """The matrix (3, M) that takes signals to motions over all runs, by least squares."""
    parts = [windows(recording, run) for run in recording.runs]
    counted, body = (np.concatenate([part[index] for part in parts]) for index in (0, 1))
    answer: Array = np.linalg.lstsq(counted, body, rcond=None)[0].T
    return answer


def misfit(recording: Recording, matrix: Array | None = None, length: float = 1.0) -> float:
    """Error of a matrix's motions (default: the design's) over windows, as a share of what the reference moves."""
    weights = np.array([1.0, 1.0, lever(recording)])
    chosen = recording.forward if matrix is None else matrix
    error = moved = 0.0
    for run in recording.runs:
        counted, body = windows(recording, run, length=length)
        error += float((((body - counted @ chosen.T) * weights) ** 2).sum())
        moved += float(((body * weights) ** 2).sum())
    return float(np.sqrt(error / moved)) if moved else float("inf")


def clock(recording: Recording, run: Run, matrix: Array) -> Clock | None:
    """The clock of a run's poses against its wheels': the offsets at begin and end with least misfit.

    None where the misfit hardly depends on them, as in a run at constant twist.
    """
    weights = np.array([1.0, 1.0, lever(recording)])

    def error(begin: float, end: float) -> float:
        counted, body = windows(recording, run, (begin, end))
        left = ((body - counted @ matrix.T) * weights) ** 2
        return float(left.sum(axis=1).mean()) if len(left) >= _FEWEST else math.inf

    errors = {pair: error(*pair) for pair in product(_GRID.tolist(), repeat=2)}
    start = min(errors, key=lambda pair: errors[pair])
    if not math.isfinite(errors[start]):
        return None
    best = minimize(
        lambda pair: error(*pair), start, method="Nelder-Mead",
        options={"initial_simplex": np.add(start, [[0, 0], [0.1, 0], [0, 0.1]]), "xatol": 2e-3, "fatol": 0},
    )  # fmt: skip
    begin, end = map(float, best.x)
    around = [error(begin + away, end + late) for away, late in ((0.5, 0.5), (-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5))]
    return Clock(begin, end, 1 - math.sqrt(best.fun / min(around)))
