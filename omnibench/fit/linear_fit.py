"""Matrix by two linear least squares, with the headings of the reference: where searches begin.

With C_s the wheel angles driven up to stamp s and a_k those of sample k, a run that starts at (x, y, theta)_0 obeys

    theta_s - theta_0 = m3.C_s                                                                   (L1)
    (x + iy)_s - (x + iy)_0 = (m1 + i m2).sum_k a_k exp(i theta(k))                              (L2)

for the matrix with rows m1, m2, m3. With theta(k) interpolated between reference poses, both are linear in them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch


def linear_fit(
    odometry: OdometryBatch, runs: Sequence[Trajectory], reference: Array, design: Array, directions: Array
) -> Array:
    """The matrix (3, N) that fits reference poses (S, 3) at the stamps of ``odometry``, made from ``runs``.

    directions (r, N): orthonormal directions of wheel rates that are fitted; along the others it keeps ``design``.
    """
    basis = directions.T
    moved, columns = linear_system(odometry, runs, reference)
    turned = moved[:, 2] - odometry.driven @ design[2]
    row_3 = basis @ np.linalg.lstsq(odometry.driven @ basis, turned, rcond=None)[0]  # Eq. (L1)
    missing = moved[:, 0] + 1j * moved[:, 1] - columns @ (design[0] + 1j * design[1])
    rows_12 = basis @ np.linalg.lstsq(columns @ basis, missing, rcond=None)[0]  # Eq. (L2)
    return np.asarray(design + np.stack([rows_12.real, rows_12.imag, row_3]))


def linear_system(
    odometry: OdometryBatch,
    runs: Sequence[Trajectory],
    reference: Array,
    used: Sequence[NDArray[np.bool_]] | None = None,
) -> tuple[Array, NDArray[np.complex128]]:
    """The left side of Eq. (L1) and (L2): motions (S, 3) since the start; and the factor of m1 + i m2, (S, N).

    used: for each run, True (K,) for the reference poses between which headings are interpolated; default all.
    """
    moved = reference - np.array([run.start for run in runs])[odometry.trajectory]
    chosen = [np.ones(len(run.poses), dtype=bool) for run in runs] if used is None else used
    headings = (
        np.interp(np.append(0.0, run.times[:-1]), run.pose_times[near], run.poses[near, 2])
        for run, near in zip(runs, chosen, strict=True)
    )
    return moved, odometry.position_design(headings)
