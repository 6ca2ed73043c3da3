"""Fits of a few runs that are put together by hand: what they leave, and what they know, is given."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from discovery_samples import APR02

from omnibench.data.dataset import Split, Trajectory
from omnibench.discover.fit import Extended, Fit
from omnibench.fit.noise import NoiseEstimate
from omnibench.fit.trajectory_fit import Nuisances
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.physical import EstimatedCovariance

ROBOT = Robot.model_validate(APR02)
MATRIX = ROBOT.inverse_kinematic_matrix
FORWARD, SIDEWAYS, TURN = np.linalg.pinv(MATRIX).T * np.array([[0.2], [0.2], [0.35]])  # wheel rates, rad/s
UNIT_NOISE = NoiseEstimate(Noise(pose_position=1.0, pose_heading=1.0), "repetitions", 10, "")
SECONDS = 4


def run_of(rates: np.ndarray, command: str | None = None, name: str = "run", split: Split = "train") -> Trajectory:
    """A run of 4 s at constant wheel rates, with reference poses at 0, 2 and 4 s where the design values lead."""
    times = np.arange(1, 10 * SECONDS + 1) / 10
    stamps = np.array([0.0, SECONDS / 2, SECONDS])
    wheels = np.tile(rates, (len(times), 1))
    run = Trajectory(name, split, times, wheels, stamps, np.zeros((3, 3)), command=command, session="s1")
    return _with_residuals(run, np.zeros((2, 3)), MATRIX)


def extended_of(
    runs: Sequence[Trajectory],
    residuals: Sequence[np.ndarray],
    columns: Sequence[np.ndarray] | None = None,
    covariance: np.ndarray | None = None,
    matrix: np.ndarray = MATRIX,
) -> Extended:
    """A fit without effects that leaves residuals (2, 3) of each run. columns (2, 3, p): none by default."""
    recorded = tuple(_with_residuals(run, left, matrix) for run, left in zip(runs, residuals, strict=True))
    nuisances = Nuisances(np.zeros((len(runs), 3)), np.zeros(3))
    fit = Fit(OdometryModel(ROBOT, matrix, "arc", (), 0.1), recorded, nuisances, UNIT_NOISE)
    slopes = tuple(columns) if columns is not None else tuple(np.zeros((2, 3, 0)) for _ in runs)
    of_elements = EstimatedCovariance(np.zeros((9, 9)) if covariance is None else covariance)
    return Extended(fit, (), fit.whitened(slopes), slopes, np.zeros(0), of_elements)


def _with_residuals(run: Trajectory, residuals: np.ndarray, matrix: np.ndarray) -> Trajectory:
    """The run with reference poses that lie these residuals (2, 3) beside where the matrix leads."""
    (poses,) = OdometryModel(ROBOT, matrix, "arc").reported([run.reference_log])
    return replace(run, poses=np.vstack([run.start, poses + residuals]))
