"""A model at recorded runs, each with nuisances of its own: residuals, their derivatives, and the runs' chi-square.

With r the residuals of a run (reference minus model), W their weighting, J the derivatives of the poses by what is
fitted, N those by the run's nuisances eta, and S the standard deviations that eta is expected to have, a Gauss-Newton
step (d, e) minimises over all runs

    |W (r - J d - N e)|^2 + |(eta + e) / S|^2.                                                            (1)

Whatever d is, the nuisances eta + e of a run are those of nuisances.py, Eq. (1), for the residuals r + N eta - J d.
Eliminated, they leave plain least squares in d, whose columns whitened.py makes.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.data.stored.periods import median_period
from omnibench.fit.least_squares.nuisances import (
    Nuisances,
    Weighting,
    likeliest_nuisances,
    log_of,
    nuisance_columns,
    weighed_together,
)
from omnibench.fit.least_squares.whitened import Whitened, whitened
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import OdometryBatch, WheelLog, split_by

_TOGETHER = 20  # runs of about the same length whose derivatives are computed at once (chosen)


@dataclass(frozen=True, eq=False)
class TrajectoryFit:
    """A model at some runs, at their reference poses after the start. Quantities are lists with one entry a run."""

    model: OdometryModel
    runs: tuple[Trajectory, ...]
    nuisances: Nuisances

    def changed(self, **changes: Any) -> Self:
        """The fit with other values of some fields, and what was computed already and does not depend on these."""
        other = replace(self, **changes)
        same_runs = len(other.runs) == len(self.runs) and all(map(operator.is_, other.runs, self.runs))
        if same_runs and np.array_equal(other.nuisances.values, self.nuisances.values):
            known = ("logs", "poses", "residuals", "slopes") if other.model is self.model else ("logs",)
            vars(other).update({name: vars(self)[name] for name in known if name in vars(self)})
        return other

    @cached_property
    def logs(self) -> list[WheelLog]:
        """The wheel logs at the times when the poses were taken, starts turned."""
        return [log_of(run, values) for run, values in zip(self.runs, self.nuisances.values, strict=True)]

    @cached_property
    def poses(self) -> list[Array]:
        """The model's poses (K, 3), m, m, rad."""
        return self.model.reported(self.logs)

    @cached_property
    def residuals(self) -> list[Array]:
        """Reference minus model (K, 3), m, m, rad."""
        return [run.poses[1:] - modelled for run, modelled in zip(self.runs, self.poses, strict=True)]

    @property
    def stamps(self) -> list[Array]:
        """Times (K,) of the residuals, s."""
        return [run.pose_times[1:] for run in self.runs]

    @cached_property
    def slopes(self) -> list[Array]:
        """Derivatives (K, 3, 3) of the model's poses by the nuisances."""
        paths = [poses - log.start for poses, log in zip(self.poses, self.logs, strict=True)]
        return [nuisance_columns(*of_run) for of_run in zip(paths, self.velocities, self.stamps, strict=True)]

    @property
    def velocities(self) -> list[Array]:
        """Velocities (K, 3) at the poses, m/s, m/s, rad/s.

        They are differences over two samples: the rate of a single one has its full encoder noise.
        """
        period = median_period(self.runs)
        shifted = []
        for run, log in zip(self.runs, self.logs, strict=True):
            stamps = np.concatenate([log.stamps + period, log.stamps - period])
            shifted.append(replace(run.log(stamps).continued(float(stamps.max())), start=log.start))
        both = (np.split(poses, 2) for poses in self.model.reported(shifted))
        return [(late - early) / (2 * period) for late, early in both]

    @property
    def estimated_slopes(self) -> list[Array]:
        """Derivatives (K, 3, m) by the m nuisances that are estimated."""
        known = self.nuisances.estimated
        if not known.any():
            return [np.empty((*residuals.shape, 0)) for residuals in self.residuals]
        return [slopes[..., known] for slopes in self.slopes]

    @cached_property
    def nuisance_free_residuals(self) -> list[Array]:
        """Residuals (K, 3) if all nuisances that are estimated were 0, to first order."""
        if not self.nuisances.estimated.any():
            return self.residuals
        values = np.where(self.nuisances.estimated, self.nuisances.values, 0.0)
        return [
            residuals + slopes @ of_run
            for residuals, slopes, of_run in zip(self.residuals, self.slopes, values, strict=True)
        ]

    def matrix_jacobian(self) -> list[Array]:
        """Derivatives (K, 3, 3N) of the poses by the elements of the matrix, row by row."""
        columns: list[Array] = [np.empty(0)] * len(self.runs)
        by_length = sorted(range(len(self.runs)), key=lambda index: len(self.logs[index].times))
        for first in range(0, len(by_length), _TOGETHER):
            part = [self.logs[index] for index in by_length[first : first + _TOGETHER]]
            slopes = OdometryBatch(part, self.model.integration).jacobian(self.model.matrix)
            of_runs = split_by(slopes.reshape(len(slopes), 3, -1), [log.stamps for log in part])
            for index, of_run in zip(by_length[first:], of_runs, strict=False):
                columns[index] = of_run
        return columns

    def chi_square(self, weightings: Sequence[Weighting]) -> Array:
        """Every run's share (Z,) in the objective, Eq. (1) with d = e = 0."""
        squares = np.empty(len(self.runs))
        for members, white in weighed_together(weightings, [residuals[..., None] for residuals in self.residuals]):
            squares[list(members)] = np.square(white).sum(axis=(1, 2))
        return self.nuisances.chi_square + squares

    def linearised(
        self, columns: Sequence[Array], weightings: Sequence[Weighting], residuals: Sequence[Array] | None = None
    ) -> Whitened:
        """Columns (K, 3, p) and residuals of every run, weighted, the nuisances eliminated.

        residuals: the nuisance-free ones where none are given.
        """
        values = self.nuisance_free_residuals if residuals is None else residuals
        deviations = self.nuisances.deviations[self.nuisances.estimated]
        return whitened(values, columns, weightings, self.estimated_slopes, deviations)

    def likeliest_nuisances(self, weightings: Sequence[Weighting], residuals: Sequence[Array] | None = None) -> Array:
        """Nuisances (Z, 3) of largest likelihood for nuisance-free residuals, by default the model's own."""
        values = self.nuisance_free_residuals if residuals is None else residuals
        return likeliest_nuisances(values, self.estimated_slopes, weightings, self.nuisances)


def split_runs(columns: Array, runs: Sequence[Trajectory]) -> list[Array]:
    """Values of all poses (S, ...), cut into those of each run (K, ...)."""
    ends = np.cumsum([len(run.pose_times) - 1 for run in runs])[:-1]
    return np.split(columns, ends)
