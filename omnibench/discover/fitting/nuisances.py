"""Nuisances of each run: its start heading, and the offset and slope of the reference's clock.

They belong to the recording of one run and say nothing of the robot. Their sizes are estimated from the differences
between repetitions of a command, their values together with each fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from omnibench.data.dataset import Trajectory
from omnibench.fit.least_squares.noise import Whitener
from omnibench.fit.least_squares.repetitions import differences_between_repetitions
from omnibench.fit.least_squares.start_noise import by_stamps
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import WheelLog

_LAST = 5  # wheel samples at the end of a run, with whose mean rate it goes on after them (chosen)
_LEAST_GAIN = 6.6  # twice the gain in log-likelihood that a variance of zero exceeds by chance once in 200 times

NUISANCES = ("start heading", "clock offset", "clock slope")
_LARGEST = np.array([0.3, 0.5, 0.02])  # rad, s, s/s: deviations that are searched, chosen


@dataclass(frozen=True, eq=False)
class Nuisances:
    """Nuisances of Z runs.

    values (Z, 3): rad, s, s per s. deviations (3,): their standard deviations from run to run, 0 for one that does not
    show and is left at 0.
    """

    values: Array
    deviations: Array


def log_of(run: Trajectory, nuisances: Array) -> WheelLog:
    """The run's log at the times when its poses were taken, its start turned. nuisances (3,): rad, s, s per s.

    After the last sample the robot goes on as in the last ones, so that the path has no kink there.
    """
    turn, offset, slope = nuisances
    log = run.log(run.pose_times[1:] * (1 - slope) - offset)
    start = log.start + np.array([0.0, 0.0, turn])
    if log.stamps[-1] <= log.times[-1]:
        return replace(log, start=start)
    rate = log.rates[-_LAST:].mean(axis=0)
    end = log.stamps[-1]
    angles = log.wheel_angles
    if angles is not None:
        angles = np.vstack([angles, angles[-1] + rate * (end - log.times[-1])])
    return replace(
        log, start=start, times=np.append(log.times, end), rates=np.vstack([log.rates, rate]), wheel_angles=angles
    )


def nuisance_slopes(log: WheelLog, poses: Array) -> Array:
    """Derivatives (K, 3, 3) of poses (K, 3) by start heading, clock offset and clock slope."""
    lever = poses - log.start
    turning = np.stack([-lever[:, 1], lever[:, 0], np.ones(len(poses))], axis=1)
    velocity = np.gradient(
        np.vstack([log.start, poses]), np.concatenate([[min(0.0, log.stamps[0] - 1e-3)], log.stamps]), axis=0
    )[1:]
    return np.stack([turning, -velocity, -velocity * log.stamps[:, None]], axis=2)


def deviations_of(
    runs: Sequence[Trajectory], residuals: Sequence[Array], slopes: Sequence[Array], noise: Noise
) -> Array:
    """Standard deviations (3,) of the nuisances between repetitions of a command, by maximum likelihood.

    0 for a nuisance that does not show. slopes (K, 3, 3): derivatives of each run's poses by its nuisances. The three
    resemble each other: the likeliest comes in first, a further one only for what those before it leave unexplained.
    """
    likelihood = _NegativeLogLikelihood(runs, residuals, slopes, noise)
    deviations: Array = np.zeros(3)
    chosen: list[int] = []
    while len(chosen) < len(NUISANCES):
        now = likelihood(deviations)
        trials = {kind: likelihood.along(deviations, kind) for kind in range(3) if kind not in chosen}
        best = min(trials, key=lambda kind: trials[kind][1])
        if now - trials[best][1] < _LEAST_GAIN:
            return deviations
        chosen.append(best)
        deviations[best] = trials[best][0]
        for kind in (*chosen, *chosen):  # earlier kinds may have stood in for later ones: fit all again
            deviations[kind] = likelihood.along(deviations, kind)[0]
    return deviations


class _NegativeLogLikelihood:
    """Twice the negative log-likelihood of differences between repetitions, by the nuisances' standard deviations.

    Up to a constant; nuisances are normal, and marginalised.
    """

    def __init__(
        self, runs: Sequence[Trajectory], residuals: Sequence[Array], slopes: Sequence[Array], noise: Noise
    ) -> None:
        kinds = [
            by_stamps(differences_between_repetitions(runs, residuals, [of_run[..., kind] for of_run in slopes]).each)
            for kind in range(3)
        ]
        self._products, self._scores = [], []
        for stamps, *of_kinds in zip([stamps for stamps, _ in kinds[0]], *kinds, strict=True):
            count = of_kinds[0][1].shape[2] // 2
            whiten = Whitener(noise, stamps)
            values = whiten(of_kinds[0][1][..., :count]).reshape(-1, count)
            columns = np.stack([whiten(both[..., count:]).reshape(-1, count) for _, both in of_kinds], axis=-1)
            self._products.append(np.einsum("rnk,rnl->nkl", columns, columns))
            self._scores.append(np.einsum("rnk,rn->nk", columns, values))

    def __call__(self, deviations: Array) -> float:
        total = 0.0
        for products, scores in zip(self._products, self._scores, strict=True):
            inner = np.eye(3) + products * np.outer(deviations, deviations)
            scaled = scores * deviations
            total += float(np.linalg.slogdet(inner)[1].sum())
            total -= float(np.einsum("nk,nk->", scaled, np.linalg.solve(inner, scaled[..., None])[..., 0]))
        return total

    def along(self, deviations: Array, kind: int) -> tuple[float, float]:
        """The best deviation of one kind, the others held, and the value that it reaches."""

        def with_deviation(value: float) -> float:
            return self(np.where(np.arange(3) == kind, value, deviations))

        answer = minimize_scalar(
            with_deviation,
            bounds=(0.0, float(_LARGEST[kind])),
            method="bounded",
            options={"xatol": 1e-5 * _LARGEST[kind]},
        )
        return float(answer.x), float(answer.fun)
