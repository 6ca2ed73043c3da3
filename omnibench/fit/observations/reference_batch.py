"""What many candidate matrices predict of the rows that were observed, and the derivatives of one."""

from __future__ import annotations

import numpy as np

from omnibench.fit.observations.reference_rows import ReferenceRows
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, WheelLog, kept_with_samples, locate
from omnibench.robot.stored.odometry_of_stored import odometry_of

_BLOCK = 200_000  # speeds at a time (candidates x samples), 2 MB, as in odometry.py
_STANDING = 1e-12  # m: a sample that is shorter has no direction, and its length no derivative


class ReferenceBatch:
    """Predictions of some rows for any number of candidate matrices, in the place of an OdometryBatch's poses.

    trajectory (S,): index of the run of each row.
    """

    def __init__(self, rows: ReferenceRows, integration: Integration) -> None:
        self.rows = rows
        self.trajectory = rows.trajectory
        self._odometry = odometry_of(rows.logs, integration)
        self._ways = [_Ways(log) for log in rows.logs] if rows.needs_lengths else []

    def poses(self, matrices: Array) -> Array:
        """Predictions (P, S, 3) in m, m, rad of candidate matrices (P, 3, M)."""
        poses = self._odometry.poses(matrices)
        return self.rows.predicted(poses, self._lengths(matrices))

    def start_turns(self, matrix: Array) -> Array:
        """Likeliest headings (Z,) of the runs' unknown starts by a matrix (3, M), 0 of those that are known, rad."""
        return self.rows.start_turns(self._odometry.poses(matrix[None])[0])

    def jacobian(self, matrix: Array) -> Array:
        """Derivatives (S, 3, 3, M) of the predictions with respect to the elements of one matrix (3, M)."""
        moving = self._odometry.jacobian(matrix)
        moving = moving.reshape(*moving.shape[:2], -1)
        driving = np.zeros((len(moving), moving.shape[2]))
        if self._ways:
            of_rows_12 = np.concatenate([way.slopes(matrix) for way in self._ways])  # (T, 2M)
            driving[:, : of_rows_12.shape[1]] = of_rows_12
        slopes = self.rows.slopes(self._odometry.poses(matrix[None])[0], moving, driving)
        return slopes.reshape(len(slopes), 3, *matrix.shape)

    def _lengths(self, matrices: Array) -> Array:
        """Distances driven (P, T) at the logs' stamps."""
        if not self._ways:
            return np.zeros((len(matrices), len(self._odometry.trajectory)))
        return np.concatenate([way.lengths(matrices) for way in self._ways], axis=1)


class _Ways:
    """The way along the path of one run, up to its stamps, which depends on rows 1 and 2 alone."""

    def __init__(self, log: WheelLog) -> None:
        self._log, self.rates = log, log.rates
        self._sample, self._share = locate(log.times, log.stamps)

    @kept_with_samples
    def _angles(self) -> Array:
        """Integrals (F, M) of the signals over each sample, rad."""
        angles: Array = self._log.signals * np.diff(self._log.times, prepend=0.0)[:, None]
        return angles

    def lengths(self, matrices: Array) -> Array:
        """Distances (P, T) of matrices (P, 3, M), m."""
        result, angles = np.empty((len(matrices), len(self._sample))), self._angles
        step = max(1, _BLOCK // len(angles))
        for first in range(0, len(matrices), step):
            part = slice(first, first + step)
            moved = np.einsum("fm,pam->paf", angles, matrices[part, :2])
            result[part] = self._at_stamps(np.hypot(moved[:, 0], moved[:, 1]).T).T
        return result

    def slopes(self, matrix: Array) -> Array:
        """Derivatives (T, 2M) of the distances by rows 1 and 2 of one matrix."""
        angles = self._angles
        moved = angles @ matrix[:2].T
        length = np.linalg.norm(moved, axis=1)
        units = moved / np.where(length > _STANDING, length, np.inf)[:, None]
        by_elements = units[:, :, None] * angles[:, None]
        return self._at_stamps(by_elements.reshape(len(moved), -1))

    def _at_stamps(self, of_samples: Array) -> Array:
        """Sums (T, n) up to the stamps of values of samples (F, n)."""
        before = np.vstack([np.zeros(of_samples.shape[1]), np.cumsum(of_samples, axis=0)])
        sums: Array = before[self._sample] + self._share[:, None] * of_samples[self._sample]
        return sums


def predicted_by(model: OdometryModel, rows: ReferenceRows) -> Array:
    """What a model, with its effects, predicts (S, 3) of some rows. DataError: a run lacks what an effect needs."""
    poses = np.concatenate(model.reported(rows.logs))
    lengths = np.concatenate(model.lengths(rows.logs)) if rows.needs_lengths else np.zeros(len(poses))
    return rows.predicted(poses[None], lengths[None])[0]
