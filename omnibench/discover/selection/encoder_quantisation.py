"""Encoder quantisation: what a wheel turns between the last tick and standstill is not measured.

No effect explains it, and it may look like one where a controller stops the wheels at the same place each time. A
wheel's true angle is then off the measured one by the same part of a tick in all repetitions of a command, uniform
within half a tick: a quarter in the mean. With q the changes of the poses by such a quarter, of each wheel at its start
and at its rest, whitened, and R the roots of the information of columns X beyond others (R'X'XR = I), columns lower the
chi-square that the changes make by at most

    (sum over commands, wheels, start and rest of |R' X' q|)^2,                                                     (1)

which they reach if all of these happen to push into one direction.

An angle of n ticks is known to n e ticks, e being the relative error of rates as written. Any angle is that near to a
whole number of ticks with a probability of 2 n e, at most 1, so that angles n_i are multiples of a tick by chance with

    P = product of min(1, 2 n_i e).                                                                                 (2)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting.model_fit import Fit
from omnibench.fit.noise import grouped
from omnibench.fit.trajectory_fit import Whitened, given
from omnibench.robot.kinematics import Array, in_the_middle, rotated

_FEWEST = 50  # samples in which a wheel turns (chosen): with fewer, the smallest gap need not be one tick
_DECADES = 20.0  # -log10 of the chance, Eq. (2), that angles are multiples: no set of recordings has so many (chosen)
_FINEST = 10_000  # ticks in the largest sample: a finer one is 0.01 % of the motion, less than a wheel slips
_MEAN = 0.25  # ticks: mean size of an error that is uniform within half a tick
_WHOLE = 1e-3  # e, share by which angles may differ from whole ticks: rates written with four digits differ by 1e-4


def quantisation_steps(runs: Sequence[Trajectory]) -> Array:
    """The angle (N,) of a tick of each wheel's encoder, rad; 0 where measured angles are no multiples of one."""
    turned = np.concatenate([run.rates * np.diff(run.times, prepend=0.0)[:, None] for run in runs])
    return np.array([_tick(np.abs(of_wheel)) for of_wheel in turned.T])


def _tick(steps: Array) -> float:
    turning = steps[steps > 0]
    if len(turning) < _FEWEST:
        return 0.0
    floor = turning.max() / _FINEST
    ordered = np.sort(np.append(turning, 0.0))
    gaps = np.diff(ordered)
    gaps = gaps[gaps > floor]
    if not len(gaps):
        return 0.0
    tick = float(gaps.min())
    near = np.round(turning / tick)
    if not near.any():
        return 0.0
    tick = float(turning @ near / (near @ near))  # least squares over all samples: more exact than the smallest gap
    near = np.maximum(np.round(turning / tick), 1)
    if -np.log10(np.minimum(2 * _WHOLE * near, 1)).sum() < _DECADES:  # Eq. (2)
        return 0.0
    return tick if (np.abs(turning / tick - near) < _WHOLE * near).all() else 0.0


class EncoderQuantisation:
    """Upper bounds on the chi-square that encoder quantisation lets columns explain, if every command conspired."""

    def __init__(self, fit: Fit, data: Whitened) -> None:
        """data: the columns of every run of the fit."""
        self.steps = quantisation_steps(fit.runs)
        self._data = data
        if not self.steps.any():
            return
        errors = [
            _quarter_ticks(run, run.poses[1:] - residuals, fit.model.matrix, self.steps)
            for run, residuals in zip(fit.runs, fit.residuals, strict=True)
        ]
        of_runs = zip(data.columns, fit.whitened(errors).columns, strict=True)
        products = [columns.T @ of_errors for columns, of_errors in of_runs]
        members = grouped([run.command or run.id for run in fit.runs])
        self._products = np.concatenate([sum(products[run] for run in runs) for runs in members], axis=1)

    def chi_square(self, index: Sequence[int], beyond: Sequence[int]) -> float:
        """The largest chi-square difference (0 without ticks) by the columns ``index`` beyond others."""
        if not self.steps.any():
            return 0.0
        left = given(self._data, beyond)
        taken = given(self._data, []).roots(beyond)
        products = self._products[list(index)]
        products = products - (self._data.information[np.ix_(index, beyond)] @ taken) @ (
            taken.T @ self._products[list(beyond)]
        )
        return float(np.linalg.norm(left.roots(index).T @ products, axis=0).sum() ** 2)  # Eq. (1)


def _quarter_ticks(run: Trajectory, poses: Array, matrix: Array, ticks: Array) -> Array:
    """Changes (K, 3, 2N) of a run's poses (K, 3) by a quarter of a tick of each wheel: at its start, and its rest."""
    turning = run.rates != 0
    columns = np.zeros((len(poses), 3, 2 * len(ticks)))
    stamps, known = run.pose_times[1:], np.vstack([run.start, poses])
    for wheel in np.flatnonzero(turning.any(axis=0) & (ticks > 0)):
        moving = np.flatnonzero(turning[:, wheel])
        first, last = moving[0], moving[-1]
        moments = ((first, run.times[first - 1] if first else 0.0), (last, run.times[last]))
        for column, (sample, moment) in zip((wheel, wheel + len(ticks)), moments, strict=True):
            later = stamps > moment - 1e-9
            place = [float(np.interp(moment, run.pose_times, values)) for values in known.T]
            moved = _column(run, matrix, int(wheel), int(sample))
            columns[later, :, column] = _MEAN * ticks[wheel] * _turned(moved, place, poses[later])
    return columns


def _column(run: Trajectory, matrix: Array, wheel: int, sample: int) -> Array:
    """The motion (3,) in the robot's frame by a radian more of a wheel in a sample, m, m, rad."""
    column: Array
    if run.drive is None:
        column = matrix[:, wheel]
    else:
        assert run.steering is not None  # the drive steers
        part = slice(sample, sample + 1)
        by_rate, _ = run.drive.slopes(run.rates[part], in_the_middle(run.steering)[part])
        column = matrix @ by_rate[0, :, wheel]
    return column


def _turned(wheel: Array, place: Sequence[float], poses: Array) -> Array:
    """Changes (K, 3) of later poses by a radian more of a wheel that moves the robot by (3,), at a place."""
    x, y, heading = place
    step = rotated(wheel, heading)
    turn = wheel[2] * np.column_stack([y - poses[:, 1], poses[:, 0] - x])
    return np.column_stack([step + turn, np.full(len(poses), wheel[2])])
