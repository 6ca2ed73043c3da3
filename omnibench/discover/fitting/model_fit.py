"""A model with effects fitted to runs: least squares of whole trajectories, weighted by the noise of repetitions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting.nuisances import Nuisances, deviations_of, log_of, nuisance_slopes
from omnibench.discover.fitting.outliers import without_jumps
from omnibench.discover.fitting.start_frames import in_start_frames
from omnibench.discover.regressors.paths import Paths, make_paths
from omnibench.fit.least_squares.noise import NoiseEstimate, Whitener, estimate_noise
from omnibench.fit.least_squares.whitened import Whitened, given, whitened
from omnibench.robot.calibration import Noise
from omnibench.robot.effects.term import Term
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import OdometryBatch, WheelLog

# Noise that the first fit assumes: 1 cm or 0.01 rad, and as much again in a second; chosen.
_UNKNOWN_NOISE = NoiseEstimate(
    Noise(pose_position=0.01, pose_heading=0.01, walk_position=0.01, walk_heading=0.01), "within runs", 1, ""
)
_ROUNDS = 4  # rounds that fit noise and matrix by turns, at most; fewer where the noise stays within 2 %
_NEAR = 0.02


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model and its residuals.

    runs: without poses that jump; jumps: the number of these. residuals: (K, 3) of each run, reference minus model, m,
    m, rad, at pose_times[1:]. slopes: derivatives (K, 3, 3) of the model's poses by each run's nuisances.
    """

    model: OdometryModel
    runs: tuple[Trajectory, ...]
    nuisances: Nuisances
    noise: NoiseEstimate
    residuals: tuple[Array, ...]
    slopes: tuple[Array, ...]
    jumps: int

    @property
    def nuisance_free_residuals(self) -> list[Array]:
        """Residuals (K, 3) of each run if all nuisances were 0, to first order."""
        return [
            residuals + slopes @ values
            for residuals, slopes, values in zip(self.residuals, self.slopes, self.nuisances.values, strict=True)
        ]

    @property
    def stamps(self) -> list[Array]:
        """Times (K,) of each run's residuals, s."""
        return [run.pose_times[1:] for run in self.runs]

    def whitened(self, columns: Sequence[Array], residuals: Sequence[Array] | None = None) -> Whitened:
        """Columns (K, 3, p) and residuals (K, 3) of every run, whitened under the noise, nuisances eliminated.

        residuals: the fit's nuisance-free ones where none are given.
        """
        values = self.nuisance_free_residuals if residuals is None else residuals
        return whitened(values, columns, self.stamps, self.noise.noise, self.slopes, self.nuisances.deviations)


def fit_matrix(runs: Sequence[Trajectory], robot: Robot, sample_period: float, start: Array) -> Fit:
    """Fit the plain matrix from a start (3, N), and with it noise, nuisances and the poses that jump.

    The model drives exact arcs: Euler steps would leave what looks like centripetal slip.
    """
    model = OdometryModel(robot, start, "arc", (), sample_period)
    nuisances = Nuisances(np.zeros((len(runs), 3)), np.zeros(3))
    fit = _at(model, tuple(runs), nuisances, _UNKNOWN_NOISE, 0)
    for _ in range(3):
        fit = _matrix_step(fit)
    for _ in range(_ROUNDS):
        before = fit.noise.noise
        fit = with_noise(fit)
        for _ in range(2 if fit.nuisances.deviations.any() else 1):
            fit = _matrix_step(fit)
        if _is_near(before, fit.noise.noise):
            break
    return fit


def with_noise(fit: Fit) -> Fit:
    """The fit with noise, nuisances and jumping poses estimated anew from its residuals."""
    near = fit.noise.noise if fit.noise is not _UNKNOWN_NOISE else None
    turned = in_start_frames(fit.runs, fit.residuals)
    noise = estimate_noise(fit.runs, turned, near)
    runs, jumps = without_jumps(fit.runs, turned, noise.noise)
    if jumps:
        fit = _at(fit.model, runs, fit.nuisances, noise, fit.jumps + jumps)
        noise = estimate_noise(fit.runs, in_start_frames(fit.runs, fit.residuals), noise.noise)
    residuals, slopes = (in_start_frames(fit.runs, values) for values in (fit.nuisance_free_residuals, fit.slopes))
    deviations = deviations_of(fit.runs, residuals, slopes, noise.noise)
    values = np.where(deviations > 0, fit.nuisances.values, 0.0)
    return _at(fit.model, fit.runs, Nuisances(values, deviations), noise, fit.jumps)


def matrix_jacobian(fit: Fit) -> Array:
    """Derivatives (S, 3, 3N) of all poses by the elements of the matrix."""
    batch = OdometryBatch(_logs(fit.runs, fit.nuisances.values), "arc")
    columns = batch.jacobian(fit.model.matrix)
    return columns.reshape(len(columns), 3, -1)


def paths_of(fit: Fit, coarse: float = 0.0) -> Paths:
    """The paths of the fit's runs by its matrix alone; samples are merged into ones of up to ``coarse`` s."""
    assert fit.model.sample_period is not None
    together = max(1, int(coarse / fit.model.sample_period))
    logs = [_coarser(log, together) for log in _logs(fit.runs, fit.nuisances.values)]
    return make_paths(fit.model.robot, fit.model.matrix, logs, together * fit.model.sample_period)


def _coarser(log: WheelLog, together: int) -> WheelLog:
    """The log with so many samples merged into one, of their mean rates."""
    if together == 1:
        return log
    ends = np.unique(np.append(np.arange(together - 1, len(log.times), together), len(log.times) - 1))
    angles = np.cumsum(log.rates * np.diff(log.times, prepend=0.0)[:, None], axis=0)[ends]
    times = log.times[ends]
    rates = np.diff(angles, axis=0, prepend=np.zeros((1, angles.shape[1]))) / np.diff(times, prepend=0.0)[:, None]
    phases = None if log.wheel_angles is None else log.wheel_angles[ends]
    return replace(log, times=times, rates=rates, wheel_angles=phases)


def at_model(fit: Fit, model: OdometryModel) -> Fit:
    """Another model at the fit's runs, with the most likely nuisances given the residuals that it leaves."""
    return _with_nuisances(_at(model, fit.runs, fit.nuisances, fit.noise, fit.jumps))


def at_runs(fit: Fit, runs: Sequence[Trajectory]) -> Fit:
    """The fit's model at other runs, their nuisances 0: only the sizes of these are known."""
    nothing_known = Nuisances(np.zeros((len(runs), 3)), fit.nuisances.deviations)
    return _at(fit.model, tuple(runs), nothing_known, fit.noise, 0)


def _with_nuisances(fit: Fit) -> Fit:
    """The most likely nuisances for the residuals that the model leaves."""
    deviations = fit.nuisances.deviations
    known = deviations > 0
    if not known.any():
        return fit
    values = np.zeros_like(fit.nuisances.values)
    for row, (run, residuals, slopes) in enumerate(zip(fit.runs, fit.nuisance_free_residuals, fit.slopes, strict=True)):
        both = np.concatenate([residuals[..., None], slopes[..., known]], -1)
        flat = Whitener(fit.noise.noise, run.pose_times[1:])(both).reshape(3 * len(residuals), -1)
        columns = flat[:, 1:]
        prior = np.diag(deviations[known] ** -2.0)
        values[row, known] = np.linalg.solve(columns.T @ columns + prior, columns.T @ flat[:, 0])
    return _at(fit.model, fit.runs, Nuisances(values, deviations), fit.noise, fit.jumps)


def _matrix_step(fit: Fit) -> Fit:
    """One Gauss-Newton step of the matrix, nuisances refitted after it."""
    jacobian = matrix_jacobian(fit)
    data = fit.whitened(split_runs(jacobian, fit.runs))
    everything = list(range(jacobian.shape[2]))
    step, _ = given(data, []).estimate(everything)
    matrix = fit.model.matrix + step.reshape(3, -1)
    return _with_nuisances(_at(replace(fit.model, matrix=matrix), fit.runs, fit.nuisances, fit.noise, fit.jumps))


def _at(
    model: OdometryModel, runs: tuple[Trajectory, ...], nuisances: Nuisances, noise: NoiseEstimate, jumps: int
) -> Fit:
    logs = _logs(runs, nuisances.values)
    poses = model.reported(logs)
    residuals = tuple(run.poses[1:] - modelled for run, modelled in zip(runs, poses, strict=True))
    slopes = tuple(nuisance_slopes(log, modelled) for log, modelled in zip(logs, poses, strict=True))
    return Fit(model, runs, nuisances, noise, residuals, slopes, jumps)


def _logs(runs: Sequence[Trajectory], nuisances: Array) -> list[WheelLog]:
    return [log_of(run, values) for run, values in zip(runs, nuisances, strict=True)]


def split_runs(columns: Array, runs: Sequence[Trajectory]) -> list[Array]:
    """Values of all poses (S, ...), cut into those of each run (K, ...)."""
    ends = np.cumsum([len(run.pose_times) - 1 for run in runs])[:-1]
    return np.split(columns, ends)


def _is_near(first: Noise, second: Noise) -> bool:
    ours, theirs = (np.array(list(each.model_dump().values())) for each in (first, second))
    return bool((np.abs(ours - theirs) <= _NEAR * np.maximum(ours, theirs).max()).all())


def model_with(model: OdometryModel, matrix: Array, terms: Sequence[Term]) -> OdometryModel:
    """The model with another matrix and other terms."""
    return replace(model, matrix=matrix, terms=tuple(terms))
