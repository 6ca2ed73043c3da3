"""Noise of the reference poses about a matrix, and the Fisher information of its elements under a noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.fit.least_squares.noise import NoiseEstimate, Whitener, estimate_noise
from omnibench.fit.least_squares.repetitions import differences_between_repetitions
from omnibench.fit.loss.jumps import without_jumps
from omnibench.fit.loss.losses import LossName
from omnibench.jobs.gathering import gathered
from omnibench.progress import Reporter, no_progress
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, OdometryBatch, WheelLog, split_by
from omnibench.robot.stored.odometry_of_stored import StoredOdometry, are_many, together, workers

Stamps = Literal["reference", "final"]


def noise_of_matrix(
    runs: Sequence[Trajectory], matrix: Array, integration: Integration, loss: LossName = "squares"
) -> NoiseEstimate:
    """Noise of the reference poses, estimated from the residuals that ``matrix`` (3, N) leaves in some runs.

    With a robust loss poses that are far off are left out. Runs without poses tell nothing of it; DataError where none
    has any.
    """
    runs = [run for run in runs if run.has_poses]
    odometry = _poses(runs, matrix, integration)
    residuals: list[Array] = [poses - run.poses[1:] for poses, run in zip(odometry, runs, strict=True)]
    near, residuals = without_jumps(runs, residuals, loss)
    return estimate_noise(differences_between_repetitions(near, residuals))


def _poses(runs: Sequence[Trajectory], matrix: Array, integration: Integration) -> list[Array]:
    """The odometry (K, 3) of each run at its reference poses."""
    logs = [run.reference_log for run in runs]
    if are_many(logs):
        return split_by(StoredOdometry(logs, integration).poses(matrix[None])[0], [log.stamps for log in logs])
    return [OdometryBatch([log], integration).poses(matrix[None])[0] for log in logs]


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
    logs = [run if isinstance(run, WheelLog) else _log(run, stamps) for run in runs]
    if are_many(logs):
        tasks = [(StoredOdometry, part, matrix, integration, noise) for part in together(logs)]
        return np.concatenate(gathered(workers(), informations, tasks))
    one_by_one = [informations((OdometryBatch, [log], matrix, integration, noise), no_progress) for log in logs]
    return np.reshape(one_by_one, (len(logs), matrix.size, matrix.size))


def informations(task: tuple[type[OdometryBatch], Sequence[WheelLog], Array, Integration, Noise], _: Reporter) -> Array:
    """Fisher information (Z, 3N, 3N) of logs. The task: class of the odometry, logs, matrix, integration and noise."""
    odometry, logs, matrix, integration, noise = task
    information = np.empty((len(logs), matrix.size, matrix.size))
    jacobians = split_by(odometry(logs, integration).jacobian(matrix), [log.stamps for log in logs])
    for of_run, log, jacobian in zip(information, logs, jacobians, strict=True):
        whitened = Whitener(noise, log.stamps)(jacobian.reshape(len(jacobian), 3, -1))
        columns = whitened.reshape(-1, whitened.shape[-1])
        of_run[:] = columns.T @ columns
    return information


def _log(run: Trajectory, stamps: Stamps) -> WheelLog:
    return run.final_log if stamps == "final" else run.reference_log
