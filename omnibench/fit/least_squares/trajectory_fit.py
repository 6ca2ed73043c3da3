"""Weighted least squares of whole reference trajectories, with the nuisances of every run eliminated.

With r the residuals of a run (odometry minus reference), W their weighting, J their derivatives by the vector, N those
by the run's nuisances eta, and S the standard deviations that eta is expected to have, a Gauss-Newton step (d, e)
minimises over all runs

    |W (r + J d + N e)|^2 + |(eta + e) / S|^2.

For every run e is eliminated by a QR decomposition of (W N, 1/S), so that the step costs hardly more than without it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.least_squares.noise import Whitener
from omnibench.fit.parameterisation import Parameterisation
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, OdometryBatch, WheelLog

TURN, OFFSET, SLOPE = range(3)
_LAST = 5  # samples whose mean rate continues the path after the last sample; chosen
# A function from a run's residuals (K, 3), or their derivatives (K, 3, n), to weighted ones (k, 3) or (k, 3, n).
Weighting = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class Estimate:
    """A vector (n,) and the nuisances of every run (Z, 3).

    Nuisances: correction that is added to the start heading (rad); offset tau (s) and slope s of the reference's clock,
    by which a pose with stamp t was taken at t - tau - s t on the clock of the wheels. A shift of the start position is
    no nuisance: it is a bias of the run, which the noise model contains.
    """

    vector: Array
    nuisances: Array


@dataclass(frozen=True, eq=False)
class Linearisation:
    """A fit linearised about an estimate, the nuisances eliminated, run by run.

    chi2 (Z,): shares of the objective. information (Z, n, n): J'V^-1 J. scores (Z, n): J'V^-1 r.
    """

    chi2: Array
    information: Array
    scores: Array
    _solved: tuple[tuple[Array, Array], ...]
    _known: NDArray[np.bool_]

    def nuisance_steps(self, step: Array) -> Array:
        """The steps (Z, 3) of the nuisances that go with a step (n,) of the vector."""
        steps = np.zeros((len(self.scores), 3))
        steps[:, self._known] = [-(alone + with_vector @ step) for alone, with_vector in self._solved]
        return steps


class TrajectoryFit:
    """Residuals between the reference poses of some runs and the odometry of an estimate, and their derivatives.

    trajectories: the runs that have reference poses after their start; DataError when there are none.
    """

    def __init__(
        self, trajectories: Sequence[Trajectory], parameterisation: Parameterisation, integration: Integration
    ) -> None:
        self.trajectories = tuple(run for run in trajectories if len(run.pose_times) > 1)
        if not self.trajectories:
            raise DataError("no trajectory has a reference pose after its start; nothing can be fitted")
        self._parameterisation = parameterisation
        self._integration: Integration = integration
        self._reference = np.concatenate([run.poses[1:] for run in self.trajectories])
        ends = np.cumsum([0, *(len(run.pose_times) - 1 for run in self.trajectories)])
        self._parts = [slice(first, last) for first, last in pairwise(ends)]
        # Velocities are differences over two samples: the rate of a single one has its full encoder noise.
        self._period = float(np.median(np.concatenate([np.diff(run.times, prepend=0.0) for run in self.trajectories])))
        self._plain = self._batch(np.zeros((len(self.trajectories), 3)))

    def residuals(self, estimate: Estimate) -> list[Array]:
        """Odometry minus reference of every run, (K, 3) in m, m, rad."""
        errors = self._odometry(estimate).poses(self._matrix(estimate.vector)[None])[0] - self._reference
        return [errors[part] for part in self._parts]

    def turning(self, estimate: Estimate) -> list[Array]:
        """Derivatives (K, 3) of the poses of every run by its start heading."""
        columns = self._turning(estimate)
        return [columns[part] for part in self._parts]

    def whiteners(self, noise: Noise) -> list[Weighting]:
        """The whitening of every run; runs with the same stamps share theirs."""
        made: dict[bytes, Weighting] = {}
        for run in self.trajectories:
            key = run.pose_times.tobytes()
            if key not in made:
                made[key] = Whitener(noise, run.pose_times[1:])
        return [made[run.pose_times.tobytes()] for run in self.trajectories]

    def chi2(self, estimate: Estimate, weightings: Sequence[Weighting], deviations: Array) -> Array:
        """Every run's share (Z,) in the objective at an estimate, with deviations as for ``linearise``."""
        known = deviations > 0
        shares: Array = np.square(estimate.nuisances[:, known] / deviations[known]).sum(axis=1)
        for row, residuals in enumerate(self.residuals(estimate)):
            shares[row] += float(np.square(weightings[row](residuals)).sum())
        return shares

    def linearise(self, estimate: Estimate, weightings: Sequence[Weighting], deviations: Array) -> Linearisation:
        """The fit linearised about an estimate.

        deviations (3,): S, the standard deviations of the nuisances; 0 for one that keeps its value.
        """
        size, known = len(estimate.vector), deviations > 0
        jacobian, columns = self._jacobian(estimate), self._nuisance_columns(estimate, known)
        expected, scale = estimate.nuisances[:, known] / deviations[known], np.diag(1 / deviations[known])
        chi2, information, scores, solved = [], [], [], []
        for row, errors in enumerate(self.residuals(estimate)):
            part = self._parts[row]
            everything = weightings[row](np.concatenate([errors[..., None], jacobian[part], columns[part]], axis=-1))
            white = everything.reshape(-1, everything.shape[-1])
            residuals, slopes = white[:, 0], white[:, 1 : 1 + size]
            if known.any():
                residuals = np.concatenate([residuals, expected[row]])
                slopes = np.vstack([slopes, np.zeros((len(scale), size))])
                basis, upper = np.linalg.qr(np.vstack([white[:, 1 + size :], scale]))
                solved.append((np.linalg.solve(upper, basis.T @ residuals), np.linalg.solve(upper, basis.T @ slopes)))
                chi2.append(float(residuals @ residuals))
                residuals = residuals - basis @ (basis.T @ residuals)
                slopes = slopes - basis @ (basis.T @ slopes)
            else:
                solved.append((np.zeros(0), np.zeros((0, size))))
                chi2.append(float(residuals @ residuals))
            information.append(slopes.T @ slopes)
            scores.append(slopes.T @ residuals)
        return Linearisation(np.array(chi2), np.array(information), np.array(scores), tuple(solved), known)

    def _matrix(self, vector: Array) -> Array:
        return self._parameterisation.matrices(vector[None])[0]

    def _odometry(self, estimate: Estimate) -> OdometryBatch:
        return self._batch(estimate.nuisances) if estimate.nuisances.any() else self._plain

    def _batch(self, nuisances: Array, later: float = 0.0) -> OdometryBatch:
        """The odometry at the times when the poses were taken, plus ``later`` s."""
        logs = []
        for run, (turn, offset, slope) in zip(self.trajectories, nuisances, strict=True):
            stamps = run.pose_times[1:] * (1 - slope) - offset + later
            times, rates = run.times, run.rates
            if stamps[-1] > times[-1]:  # the robot drove on; the path must not stop at the last sample
                times, rates = np.append(times, stamps[-1]), np.vstack([rates, rates[-_LAST:].mean(axis=0)])
            logs.append(WheelLog(times, rates, run.start + np.array([0.0, 0.0, turn]), stamps))
        return OdometryBatch(logs, self._integration)

    def _jacobian(self, estimate: Estimate) -> Array:
        """Derivatives (S, 3, n) of the poses by the vector; the matrix is differentiated by central differences."""
        vector, size = estimate.vector, len(estimate.vector)
        steps = 1e-5 * np.maximum(np.abs(self._parameterisation.start), 1e-3)
        matrices = self._parameterisation.matrices(np.concatenate([vector + np.diag(steps), vector - np.diag(steps)]))
        slopes = (matrices[:size] - matrices[size:]) / (2 * steps[:, None, None])
        by_elements = self._odometry(estimate).jacobian(self._matrix(vector))
        return by_elements.reshape(len(by_elements), 3, -1) @ slopes.reshape(size, -1).T

    def _nuisance_columns(self, estimate: Estimate, known: NDArray[np.bool_]) -> Array:
        """Derivatives (S, 3, m) of the poses by the m nuisances that are estimated, True in ``known`` (3,)."""
        columns: list[Array] = []
        if known[TURN]:
            columns.append(self._turning(estimate))
        if known[OFFSET] or known[SLOPE]:
            matrix = self._matrix(estimate.vector)[None]
            after, before = (self._batch(estimate.nuisances, sign * self._period).poses(matrix)[0] for sign in (1, -1))
            velocity = (after - before) / (2 * self._period)
            if known[OFFSET]:
                columns.append(-velocity)
            if known[SLOPE]:
                stamps = np.concatenate([run.pose_times[1:] for run in self.trajectories])
                columns.append(-velocity * stamps[:, None])
        return np.stack(columns, axis=-1) if columns else np.empty((len(self._reference), 3, 0))

    def _turning(self, estimate: Estimate) -> Array:
        """Derivatives (S, 3) of the poses by the start heading: the path turns about its start."""
        odometry = self._odometry(estimate)
        starts = np.array([run.start for run in self.trajectories])[odometry.trajectory]
        path = odometry.poses(self._matrix(estimate.vector)[None])[0] - starts
        return np.stack([-path[:, 1], path[:, 0], np.ones(len(path))], axis=1)
