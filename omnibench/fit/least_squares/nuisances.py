"""Nuisances of each run: its start heading, and the offset and slope of the reference's clock.

They belong to the recording of one run and say nothing of the robot. A shift of the start position is none of them: it
is a bias of the run, which the noise model contains. Nuisances eta of a run are normal from run to run, with standard
deviations S (a diagonal matrix). With r the whitened residuals of a run and N the whitened derivatives of its poses by
eta, the likeliest values for the residuals that a model would leave without nuisances are

    eta = (N'N + S^-2)^-1 N'r.                                                                            (1)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.fit.least_squares.repetitions import grouped
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import WheelLog

NUISANCES = ("start heading", "clock offset", "clock slope")
TURN, OFFSET, SLOPE = range(3)  # their columns
# A function from a run's residuals (K, 3), or their derivatives (K, 3, n), to weighted ones (k, 3) or (k, 3, n).
Weighting = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class Nuisances:
    """Nuisances of Z runs.

    values (Z, 3): correction that is added to the start heading (rad); offset tau (s) and slope s of the reference's
    clock, by which a pose with stamp t was taken at t - tau - s t on the clock of the wheels. deviations (3,): their
    standard deviations from run to run, 0 for one that keeps its value.
    """

    values: Array
    deviations: Array

    @property
    def estimated(self) -> NDArray[np.bool_]:
        """True (3,) for the nuisances that are estimated."""
        return np.asarray(self.deviations > 0)

    @property
    def chi_square(self) -> Array:
        """Squares (Z,) of the estimated values in units of their deviations, summed for each run."""
        known = self.estimated
        total: Array = np.square(self.values[:, known] / self.deviations[known]).sum(axis=1)
        return total

    def held(self) -> Nuisances:
        """These values, none of which is estimated any more."""
        return replace(self, deviations=np.zeros(3))


def log_of(run: Trajectory, nuisances: Array) -> WheelLog:
    """The run's log at the times when its poses were taken, its start turned. nuisances (3,): rad, s, s per s."""
    turn, offset, slope = nuisances.tolist()
    stamps = run.pose_times[1:]
    log = run.log(stamps * (1 - slope) - offset if slope or offset else stamps)
    log = log.continued(float(log.stamps[-1]))
    return replace(log, start=log.start + np.array([0.0, 0.0, turn])) if turn else log


def nuisance_columns(path: Array, velocity: Array, stamps: Array) -> Array:
    """Derivatives (K, 3, 3) of a run's poses by its nuisances.

    path (K, 3): the poses less that of the start, about which the path turns. velocity (K, 3): m/s, m/s, rad/s.
    """
    turning = np.stack([-path[:, 1], path[:, 0], np.ones(len(path))], axis=1)
    return np.stack([turning, -velocity, -velocity * stamps[:, None]], axis=2)


def likeliest_nuisances(
    residuals: Sequence[Array], slopes: Sequence[Array], weightings: Sequence[Weighting], nuisances: Nuisances
) -> Array:
    """Values (Z, 3) of the nuisances of largest likelihood, Eq. (1); those that are not estimated keep theirs.

    residuals (K, 3): of each run if all nuisances that are estimated were 0. slopes (K, 3, m): derivatives of its poses
    by these.
    """
    values, known = nuisances.values.copy(), nuisances.estimated
    if not known.any():
        return values
    prior = np.diag(nuisances.deviations[known] ** -2.0)
    both = [np.concatenate([of_run[..., None], extra], axis=2) for of_run, extra in zip(residuals, slopes, strict=True)]
    for members, white in weighed_together(weightings, both):
        inner = white[..., 1:]
        products = inner.swapaxes(1, 2) @ white
        found = np.linalg.solve(products[..., 1:] + prior, products[..., :1])
        values[np.ix_(np.array(members), known)] = found[..., 0]
    return values


def weighed_together(
    weightings: Sequence[Weighting], values: Sequence[Array]
) -> Iterator[tuple[tuple[int, ...], Array]]:
    """The weighted values (R, 3 k, n) of each R runs that share a weighting, and which runs these are.

    values (K, 3, n): of every run.
    """
    for members in grouped([id(weigh) for weigh in weightings]):
        together, columns = np.stack([values[index] for index in members], axis=2), values[members[0]].shape[2]
        white = weightings[members[0]](together.reshape(*together.shape[:2], -1))
        of_runs = white.reshape(*white.shape[:2], len(members), columns)
        yield members, of_runs.transpose(2, 0, 1, 3).reshape(len(members), white.shape[0] * white.shape[1], columns)
