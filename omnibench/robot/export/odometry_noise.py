"""Variances of odometry from a calibration: the random walk of its noise model, and the covariance of its matrix.

A random walk of s per root second makes the mean velocity over T err by s^2 / T, independently from one interval to the
next, and the pose by s^2 t after a time t. The tracked point walks alike in x and y; a base frame whose twist is F
times the tracked point's walks with the covariance F diag(p^2, p^2, h^2) F^T. The matrix errs in the same way all the
time: a motion by the signals u errs by F C(u) F^T, of which C(u)_ij = u^T cov(row i, row j) u.
"""

from __future__ import annotations

import numpy as np

from omnibench.robot.calibration import Calibration
from omnibench.robot.export.remaining import driven_motions
from omnibench.robot.kinematics import Array, Mount


def walk_covariance(calibration: Calibration, base: Mount) -> Array | None:
    """Covariance (3, 3) that a second adds to the pose of a frame of the robot, m2, rad2; None without noise model."""
    noise = calibration.noise
    if noise is None:
        return None
    frame = _from_tracked(calibration, base)
    return (frame * np.square([noise.walk_position, noise.walk_position, noise.walk_heading])) @ frame.T


def pose_variances(calibration: Calibration, base: Mount) -> Array | None:
    """Variances (3,) that a second adds to x, y (m2) and heading (rad2); None without a noise model."""
    covariance = walk_covariance(calibration, base)
    return None if covariance is None else np.diag(covariance)


def twist_variances(calibration: Calibration, base: Mount) -> Array | None:
    """Variances (3,) of a sample's mean twist, m2/s2, m2/s2, rad2/s2; None without a noise model."""
    growth = pose_variances(calibration, base)
    return None if growth is None else growth / calibration.sample_period


def matrix_deviations(calibration: Calibration, base: Mount) -> Array | None:
    """Standard deviations (D, 3) of x, y and heading by the matrix's covariance; None where that is not known.

    One row for each of ``driven_motions``: a metre, or a radian.
    """
    if calibration.covariance is None:
        return None
    frame, count = _from_tracked(calibration, base), len(calibration.robot.drive.names)
    blocks = np.array(calibration.covariance)[: 3 * count, : 3 * count].reshape(3, count, 3, count)
    _, signals = driven_motions(calibration.robot, base)
    variances = np.einsum("ai,aj,imjn,md,nd->da", frame, frame, blocks, signals, signals, optimize=True)
    deviations: Array = np.sqrt(np.maximum(variances, 0.0))
    return deviations


def interval_in_words(calibration: Calibration) -> str:
    """The sample period, in ms."""
    return f"{1e3 * calibration.sample_period:g} ms"


def _from_tracked(calibration: Calibration, base: Mount) -> Array:
    """F (3, 3): the twist of a frame of the robot from that of the tracked point."""
    mount = calibration.robot.mount
    frame: Array = base.twist if mount is None else base.twist @ np.linalg.inv(mount.twist)
    return frame
