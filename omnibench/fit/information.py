"""Noise of the reference poses about a matrix, and the Fisher information of its elements under a noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from omnibench.data.dataset import Trajectory
from omnibench.fit.loss import LossName, make_loss
from omnibench.fit.noise import NoiseEstimate, Whitener, differences_between_repetitions, estimate_noise
from omnibench.fit.trajectory_fit import with_poses
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, OdometryBatch, WheelLog, split_by
from omnibench.robot.stored_odometry import of_runs, poses_of_runs

INTERVAL = 0.95  # probability of the intervals, by convention; every table of the program says 95 %
# Degrees of freedom that stand for infinity: the quantile of Student's t differs from the normal one by 2e-9 there.
MANY = 1e9
Stamps = Literal["reference", "final"]
_ROUNDING = 1e-12  # share of the largest derivative: a smaller one is rounding


@dataclass(frozen=True, eq=False)
class EstimatedCovariance:
    """Covariance (n, n) of n numbers, and degrees of freedom (n,) of their variances, or one for all."""

    matrix: Array
    degrees_of_freedom: Array | float = np.inf

    def of(self, slopes: Array) -> EstimatedCovariance:
        """Covariance of q functions of the numbers, with derivatives (q, n), and degrees of freedom of their variances.

        The reciprocal of a function's degrees of freedom is the mean of those of the numbers, weighted by their shares
        in its variance: what depends on one number has that number's, and numbers that agree give theirs.
        """
        weights = np.abs(slopes * (slopes @ self.matrix))
        freedom = np.broadcast_to(np.minimum(self.degrees_of_freedom, MANY), len(self.matrix))
        reciprocals = (weights / freedom).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-300)
        return EstimatedCovariance(slopes @ self.matrix @ slopes.T, 1 / np.maximum(reciprocals, 1 / MANY))

    @property
    def standard_deviations(self) -> Array:
        """Standard deviations (n,)."""
        return np.sqrt(np.maximum(np.diag(self.matrix), 0.0))

    @property
    def reach(self) -> Array:
        """Half-widths (n,) of the 95 % intervals."""
        quantile = stdtrit(np.minimum(self.degrees_of_freedom, MANY), (1 + INTERVAL) / 2)
        return np.asarray(quantile * self.standard_deviations)


def depending(slopes: Array, inputs: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which functions (q,) with derivatives (q, n) depend on one of the n inputs that are marked."""
    return np.asarray((np.abs(slopes[:, inputs]) > _ROUNDING * np.abs(slopes).max()).any(axis=1))


def noise_of_matrix(
    runs: Sequence[Trajectory], matrix: Array, integration: Integration, loss: LossName = "squares"
) -> NoiseEstimate:
    """Noise of the reference poses, estimated from the residuals that ``matrix`` (3, N) leaves in some runs.

    With a robust loss poses that are far off are left out. Runs without poses tell nothing of it; DataError where none
    has any.
    """
    runs = [run for run in runs if run.has_poses]
    odometry = poses_of_runs([run.reference_log for run in runs], matrix, integration)
    residuals: list[Array] = [poses - run.poses[1:] for poses, run in zip(odometry, runs, strict=True)]
    near, residuals = without_jumps(runs, residuals, loss)
    return estimate_noise(differences_between_repetitions(near, residuals))


def information_of_run(
    run: Trajectory | WheelLog, matrix: Array, integration: Integration, noise: Noise, *, stamps: Stamps = "reference"
) -> Array:
    """Fisher information (3N, 3N) of the elements of ``matrix`` (3, N), row by row, from one run; 1/element squared.

    J^T C^-1 J with the derivatives J of the poses and their covariance C under ``noise``, at all reference poses after
    the start or at the last alone. A WheelLog has its own stamps, > 0. Wheel rates and start pose count as exact; a
    noisy start position is part of the noise's bias.
    """
    (information,) = information_of_runs([run], matrix, integration, noise, stamps=stamps)
    return information


def information_of_runs(
    runs: Sequence[Trajectory | WheelLog],
    matrix: Array,
    integration: Integration,
    noise: Noise,
    *,
    stamps: Stamps = "reference",
) -> Array:
    """Fisher information (Z, 3N, 3N) of each run; their sum is that of all runs together."""
    name = "final_log" if stamps == "final" else "reference_log"
    logs: list[WheelLog] = [run if isinstance(run, WheelLog) else getattr(run, name) for run in runs]
    by_parts = of_runs(_informations, logs, integration, matrix, noise)
    return np.concatenate([np.zeros((0, matrix.size, matrix.size)), *by_parts])


def _informations(odometry: OdometryBatch, logs: Sequence[WheelLog], matrix: Array, noise: Noise) -> Array:
    """Fisher information (Z, 3N, 3N) of logs."""
    information = np.empty((len(logs), matrix.size, matrix.size))
    jacobians = split_by(odometry.jacobian(matrix), [log.stamps for log in logs])
    for of_run, log, jacobian in zip(information, logs, jacobians, strict=True):
        whitened = Whitener(noise, log.stamps)(jacobian.reshape(len(jacobian), 3, -1))
        columns = whitened.reshape(-1, whitened.shape[-1])
        of_run[:] = columns.T @ columns
    return information


def without_jumps(
    runs: Sequence[Trajectory], residuals: Sequence[Array], loss: LossName
) -> tuple[list[Trajectory], list[Array]]:
    """Runs and their residuals (K, 3) at the poses that have not jumped, m and rad alike.

    Where most of a run's poses are off, its start is, which shifts or turns them all: the run is left out.
    """
    chosen = make_loss(loss, 3)
    if chosen is None:
        return list(runs), list(residuals)
    counts = np.array([len(of_run) for of_run in residuals])
    shares = np.repeat(1 / (np.maximum(counts, 1) * max(np.count_nonzero(counts), 1)), counts)
    all_near = chosen.is_near(np.linalg.norm(np.concatenate(residuals), axis=1), shares)
    near = [of_run & (of_run.mean() > 1 / 2) for of_run in np.split(all_near, np.cumsum(counts)[:-1])]
    shortened = [
        (with_poses(run, np.append(0, 1 + np.flatnonzero(used))), of_run[used])
        for run, of_run, used in zip(runs, residuals, near, strict=True)
        if used.any()
    ]
    return [run for run, _ in shortened], [of_run for _, of_run in shortened]
