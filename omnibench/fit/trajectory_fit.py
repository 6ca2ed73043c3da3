"""A model at recorded runs, each with nuisances of its own: residuals, their derivatives, and the runs' chi-square.

With r the residuals of a run (reference minus model), W their weighting, J the derivatives of the poses by what is
fitted, N those by the run's nuisances eta, and S the standard deviations that eta is expected to have, a Gauss-Newton
step (d, e) minimises over all runs

    |W (r - J d - N e)|^2 + |(eta + e) / S|^2.                                                            (1)

Whatever d is, the nuisances eta + e of a run are those of Eq. (1) for the residuals r + N eta - J d. Eliminated, they
leave plain least squares in d.

The nuisances are the start heading of a run, and the offset and slope of its reference's clock. They belong to the
recording of one run and say nothing of the robot. A shift of the start position is none of them: it is a bias of the
run, which the noise model contains. Nuisances eta of a run are normal from run to run, with standard deviations S (a
diagonal matrix). With r the whitened residuals of a run and N the whitened derivatives of its poses by
eta, the likeliest values for the residuals that a model would leave without nuisances are

    eta = (N'N + S^-2)^-1 N'r.                                                                            (2)

The noise of the reference poses and of the nuisances is estimated by maximum likelihood from repetitions. Nuisances add
N S S N' to the covariance of a run's poses. With residuals r and N both whitened under the noise, whose covariance is
C, up to a constant

    -2 ln L = ln |1 + S N'N S| - (S N'r)' (1 + S N'N S)^-1 (S N'r) + r'r + ln |C|.                        (3)

Its derivative by a variance v of the noise or of a nuisance is, with a = (C + N S S N')^-1 r before whitening,

    d(-2 ln L) / dv = tr((C + N S S N')^-1 dC/dv) - a' dC/dv a,    dC/dv = N_j N_j' for nuisance j.        (4)

A deviation is zero unless a likelihood ratio test rejects that, all components of the noise and the nuisances found
before being fitted anew. Nuisances and noise resemble each other: an error of the start heading shifts the headings by
as much, like a bias, and only the path that turns about the start distinguishes it; so does an error of the clock by
what differs between fast and slow runs. An error of the start position is a bias, exactly.

Noise of the reference poses about a matrix, and the Fisher information of its elements under a noise.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Self

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.special import chdtri

from omnibench.data.dataset import Trajectory
from omnibench.data.stored import median_period
from omnibench.errors import DataError
from omnibench.fit import noise as noises
from omnibench.fit.loss import LossName, make_loss
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array, rotation
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryBatch, WheelLog, split_by
from omnibench.robot.stored_odometry import of_runs, poses_of_runs

Stamps = Literal["reference", "final"]


def noise_of_matrix(
    runs: Sequence[Trajectory], matrix: Array, integration: Integration, loss: LossName = "squares"
) -> noises.NoiseEstimate:
    """Noise of the reference poses, estimated from the residuals that ``matrix`` (3, N) leaves in some runs.

    With a robust loss poses that are far off are left out. Runs without poses tell nothing of it; DataError where none
    has any.
    """
    runs = [run for run in runs if run.has_poses]
    odometry = poses_of_runs([run.reference_log for run in runs], matrix, integration)
    residuals: list[Array] = [poses - run.poses[1:] for poses, run in zip(odometry, runs, strict=True)]
    near, residuals = without_jumps(runs, residuals, loss)
    return noises.estimate_noise(noises.differences_between_repetitions(near, residuals))


def information_of_runs(
    runs: Sequence[Trajectory | WheelLog],
    matrix: Array,
    integration: Integration,
    noise: Noise,
    *,
    stamps: Stamps = "reference",
) -> Array:
    """Fisher information (Z, 3N, 3N) of the elements of ``matrix`` (3, N), row by row, of each run; 1/element squared.

    J^T C^-1 J with the derivatives J of the poses and their covariance C under ``noise``, at all reference poses after
    the start or at the last alone. A WheelLog has its own stamps, > 0. Wheel rates and start pose count as exact; a
    noisy start position is part of the noise's bias. The sum is the information of all runs together.
    """
    name = "final_log" if stamps == "final" else "reference_log"
    logs: list[WheelLog] = [run if isinstance(run, WheelLog) else getattr(run, name) for run in runs]
    by_parts = of_runs(_informations, logs, integration, matrix, noise)
    return np.concatenate([np.zeros((0, matrix.size, matrix.size)), *by_parts])


def _informations(odometry: OdometryBatch, logs: Sequence[WheelLog], matrix: Array, noise: Noise) -> Array:
    """Fisher information (Z, 3N, 3N) of logs, as of columns that are whitened without any nuisances."""
    stamps = [log.stamps for log in logs]
    jacobian = odometry.jacobian(matrix)
    columns = split_by(jacobian.reshape(len(jacobian), 3, -1), stamps)
    residuals, slopes = [np.zeros((len(of), 3)) for of in stamps], [np.zeros((len(of), 3, 0)) for of in stamps]
    return whitened(residuals, columns, noises.whiteners(noise, stamps), slopes, np.zeros(0)).information_of_runs


def without_jumps(
    runs: Sequence[Trajectory], residuals: Sequence[Array], loss: LossName
) -> tuple[list[Trajectory], list[Array]]:
    """Runs and their residuals (K, 3) at the poses that have not jumped, m and rad alike.

    Where most of a run's poses are off, its start is, which shifts or turns them all: the run is left out.
    """
    if loss == "squares":
        return list(runs), list(residuals)
    counts = np.array([len(of_run) for of_run in residuals])
    shares = np.repeat(1 / (np.maximum(counts, 1) * max(np.count_nonzero(counts), 1)), counts)
    all_near = make_loss(loss, 3).is_near(np.linalg.norm(np.concatenate(residuals), axis=1), shares)
    near = [of_run & (of_run.mean() > 1 / 2) for of_run in np.split(all_near, np.cumsum(counts)[:-1])]
    shortened = [
        (with_poses(run, np.append(0, 1 + np.flatnonzero(used))), of_run[used])
        for run, of_run, used in zip(runs, residuals, near, strict=True)
        if used.any()
    ]
    return [run for run, _ in shortened], [of_run for _, of_run in shortened]


TURN, OFFSET, SLOPE = range(3)  # columns of the nuisances: start heading, clock offset, clock slope
# A function from a run's residuals (K, 3), or their derivatives (K, 3, n), to weighted ones (k, 3) or (k, 3, n).
Weighting = Callable[[Array], Array]

# tests/studies/constants.py varies each number by 0.5 and 2: on a small set with heading drift no verdict and no
# name changes.
_MOST_STAMPS = 80  # reference poses used of a run: neighbours in denser references share their errors
_STANDING = 1e-3  # rad/s: slower wheels count as standing; one of 0.1 m moves 0.1 mm in a second
_OVERHANG = 0.5  # s after the last wheel sample in which reference poses are still used, see ``log_of``
# Share of a direction's information that must be left beyond other columns for it to count: a thousandth of its length,
# far above rounding. Half of it and twice change no calibration (tests/studies/constants_fit.py) and no discovery
# (tests/studies/constants.py).
_DETERMINED = 1e-6
_NOTHING = 1e-22  # share of the largest information: with _DETERMINED, columns of 1e-14 of its size are rounding
_KEPT = 4  # Schur complements that are kept: beyond the matrix and beyond all effects, with forms or without (chosen)
_TOGETHER = 20  # runs of about the same length whose derivatives are computed at once (chosen)

_NAMES = ("pose_position", "walk_position", "bias_position", "pose_heading", "walk_heading", "bias_heading")
# Level of the tests, shared by the nuisances that are asked about (Bonferroni): noise alone shows any of them in one
# set of twenty.
CHANCE = 0.05
# Share of the critical value that a nuisance alone must gain before all components are fitted with it: the others do
# not add four times as much. Half of this and twice give the same estimates from right and wrong starts
# (tests/studies/constants_fit.py).
_PROMISING = 0.25
# rad, s, s per s: largest deviations that are searched, 17 degrees and several times those of clocks that are
# synchronised by hand (0.2 s, 0.003). Half and twice as wide, the search finds the same to 1e-5
# (tests/studies/constants_fit.py).
_LARGEST = np.array([0.3, 0.5, 0.02])


def in_start_frames(runs: Sequence[Trajectory], values: Sequence[Array]) -> list[Array]:
    """Residuals (K, 3), or derivatives of poses (K, 3, m), turned into the frame of each run's start.

    Repetitions of a command that start in different headings can be compared only so.
    """
    both = zip(runs, values, strict=True)
    return [np.einsum("ij,kj...->ki...", rotation(-run.start[2]), of_run) for run, of_run in both]


def usable_runs(trajectories: Sequence[Trajectory], split: str = "train") -> tuple[Trajectory, ...]:
    """Runs of a split with a reference pose after their start, by session and time, at most 80 stamps each.

    Raises DataError where there are none, or where the wheels stand in all of them.
    """
    runs = [run for run in trajectories if _covered_poses(run) > 1]
    if not runs and any(run.references is not None for run in trajectories):
        raise DataError(
            f"no trajectory of the split {split} has reference poses along its path, without which what a "
            "matrix lacks is not found; distances, turns and other references serve calibrate, evaluate and compare"
        )
    if not runs:
        raise DataError(
            f"no trajectory of the split {split} has a reference pose between its start and its last wheel sample"
        )
    if max(float(np.abs(run.rates).max()) for run in runs) < _STANDING:
        raise DataError(f"the wheels stand in all runs of the split {split}; drive some, or check the columns omega_*")
    runs.sort(key=lambda run: (str(run.session), run.started_at or 0.0))
    thinned = []
    for run in runs:
        last = _covered_poses(run) - 1
        if not last == len(run.pose_times) - 1 <= _MOST_STAMPS:
            chosen = np.round(np.linspace(last, 0, min(last, _MOST_STAMPS) + 1))
            run = with_poses(run, np.unique(chosen.astype(int)))
        thinned.append(run)
    return tuple(thinned)


def with_poses(run: Trajectory, index: Array) -> Trajectory:
    """The run with those of its reference poses that ``index`` chooses."""
    covariances = None if run.pose_covariances is None else run.pose_covariances[index]
    return replace(run, pose_times=run.pose_times[index], poses=run.poses[index], pose_covariances=covariances)


def _covered_poses(run: Trajectory) -> int:
    """The number of poses, the start among them, up to the end of the wheel samples and the overhang."""
    return int((run.pose_times <= run.times[-1] + _OVERHANG).sum())


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
        estimated = self.estimated
        return np.asarray(np.square(self.values[:, estimated] / self.deviations[estimated]).sum(axis=1))

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


def likeliest_nuisances(
    residuals: Sequence[Array], slopes: Sequence[Array], weightings: Sequence[Weighting], nuisances: Nuisances
) -> Array:
    """Values (Z, 3) of the nuisances of largest likelihood, Eq. (2); those that are not estimated keep theirs.

    residuals (K, 3): of each run if all nuisances that are estimated were 0. slopes (K, 3, m): derivatives of its poses
    by these.
    """
    values, estimated = nuisances.values.copy(), nuisances.estimated
    if not estimated.any():
        return values
    prior = np.diag(nuisances.deviations[estimated] ** -2.0)
    both = [np.concatenate([of_run[..., None], extra], axis=2) for of_run, extra in zip(residuals, slopes, strict=True)]
    for members, white in weighed_together(weightings, both):
        inner = white[..., 1:]
        products = inner.swapaxes(1, 2) @ white
        likeliest = np.linalg.solve(products[..., 1:] + prior, products[..., :1])
        values[np.ix_(np.array(members), estimated)] = likeliest[..., 0]
    return values


def weighed_together(
    weightings: Sequence[Weighting], values: Sequence[Array]
) -> Iterator[tuple[tuple[int, ...], Array]]:
    """The weighted values (R, 3 k, n) of each R runs that share a weighting, and which runs these are.

    values (K, 3, n): of every run.
    """
    for members in noises.grouped([id(weigh) for weigh in weightings]):
        columns = values[members[0]].shape[2]
        together = np.stack([values[index] for index in members], axis=2, dtype=float)
        white = weightings[members[0]](together.reshape(*together.shape[:2], -1))
        of_runs = white.reshape(*white.shape[:2], len(members), columns)
        yield members, of_runs.transpose(2, 0, 1, 3).reshape(len(members), white.shape[0] * white.shape[1], columns)


@dataclass(frozen=True, eq=False)
class Whitened:
    """Residuals and columns of Z runs, independent and of unit variance under the noise.

    residuals: (k,) for each run. columns: (k, p) for each run. information (p, p): products of the columns, summed over
    all runs. scores (Z, p): columns times residuals of each run.
    """

    residuals: Sequence[Array]
    columns: Sequence[Array]
    information: Array
    scores: Array
    _complements: dict[tuple[int, ...], Given] = field(init=False, default_factory=dict)

    @property
    def information_of_runs(self) -> Array:
        """Products (Z, p, p) of the columns of each run."""
        return np.array([columns.T @ columns for columns in self.columns])

    def only(self, index: Sequence[int]) -> Whitened:
        """Some of the columns, in this order."""
        rows = list(index)
        columns = [np.asarray(of_run[:, rows], dtype=float) for of_run in self.columns]
        return Whitened(self.residuals, columns, self.information[np.ix_(rows, rows)], self.scores[:, rows])

    def less(self, index: Sequence[int], values: Array) -> Whitened:
        """The columns with the residuals less some of the columns times values (n,)."""
        rows = list(index)
        both = zip(self.residuals, self.columns, strict=True)
        remaining = [residuals - columns[:, rows] @ values for residuals, columns in both]
        scores = np.empty_like(self.scores)
        for run, columns in enumerate(self.columns):
            scores[run] = remaining[run] @ columns
        return replace(self, residuals=remaining, scores=scores)

    def given(self, index: Sequence[int]) -> Given:
        """Schur complement of all columns once the columns ``index`` are fitted; the last few are kept."""
        key = tuple(index)
        if key not in self._complements:
            if len(self._complements) >= _KEPT:
                self._complements.pop(next(iter(self._complements)))
            self._complements[key] = _beyond(self.information, self.scores, np.diag(self.information).copy(), key)
        return self._complements[key]


def whitened(
    residuals: Sequence[Array],
    columns: Sequence[Array],
    weightings: Sequence[Weighting],
    slopes: Sequence[Array],
    deviations: Array,
    of_columns: Sequence[Weighting] | None = None,
) -> Whitened:
    """Whiten residuals (K, 3) and columns (K, 3, p) of every run.

    slopes (K, 3, m): derivatives of each run's poses by its nuisances. deviations (m,): their standard deviations, > 0;
    they count as noise that all poses of a run share. of_columns: weightings of the columns, if these are given in
    another way than the residuals.
    """
    count, width = len(residuals), columns[0].shape[2]
    beside = [np.concatenate([errors[..., None], by], axis=2) for errors, by in zip(residuals, slopes, strict=True)]
    free_residuals, free_columns = [np.empty(0)] * count, [np.empty((0, width))] * count
    information, scores = np.zeros((width, width)), np.empty((count, width))
    weighed = weighed_together(weightings, beside), weighed_together(of_columns or weightings, columns)
    for (members, white), (_, fitted) in zip(*weighed, strict=True):
        remaining = white[..., :1]
        if len(deviations):
            nuisances = white[..., 1:] * deviations
            remaining, fitted = without(remaining, nuisances), without(fitted, nuisances)
        flat = fitted.reshape(fitted.shape[0] * fitted.shape[1], width)
        information += flat.T @ flat
        scores[list(members)] = (remaining.swapaxes(1, 2) @ fitted)[:, 0]
        for index, of_residuals, of_run in zip(members, remaining, fitted, strict=True):
            free_residuals[index], free_columns[index] = of_residuals[:, 0], of_run
    return Whitened(tuple(free_residuals), tuple(free_columns), information, scores)


def without(values: Array, nuisances: Array) -> Array:
    """Values (..., k, n) less what nuisances (..., k, m) of unit variance explain: (1 + N N')^(-1/2) values."""
    basis, sizes, _ = np.linalg.svd(nuisances, full_matrices=False)
    shrink = 1 - 1 / np.sqrt(1 + sizes**2)
    return np.asarray(values - basis @ (shrink[..., None] * (basis.swapaxes(-1, -2) @ values)))


@dataclass(frozen=True, eq=False)
class Given:
    """Schur complement of the information matrix: what columns add once others are fitted.

    information (p, p), scores (Z, p): computed from the columns' parts beyond the others. total (p,): diagonal of the
    information before, against which a direction counts as determined.
    """

    information: Array
    scores: Array
    total: Array
    _roots: dict[tuple[int, ...], Array] = field(init=False, default_factory=dict)

    def chi_square(self, index: Sequence[int]) -> float:
        """Chi-square difference: by how much fitting some columns lowers it."""
        roots = self.roots(index)
        return float(np.square(roots.T @ self.scores[:, list(index)].sum(axis=0)).sum())

    def rank(self, index: Sequence[int]) -> int:
        """Degrees of freedom: independent directions that some columns have left."""
        return self.roots(index).shape[1]

    def roots(self, index: Sequence[int]) -> Array:
        """Matrix (n, d) that turns the scores of n columns into d independent ones of unit variance."""
        key = tuple(index)
        if key not in self._roots:
            scale = self.scale(key)
            inner = self.information[np.ix_(key, key)] * np.outer(scale, scale)
            values, vectors = np.linalg.eigh(inner)
            determined = values > _DETERMINED
            self._roots[key] = scale[:, None] * vectors[:, determined] / np.sqrt(values[determined])
        return self._roots[key]

    def scale(self, index: Sequence[int]) -> Array:
        """Units (n,) in which columns have length one; of signals that no motion drives they are not their own."""
        least = max(_NOTHING * float(self.total.max(initial=0.0)), 1e-300)
        return np.asarray(1 / np.sqrt(np.maximum(self.total[list(index)], least)))

    def share_left(self, index: Sequence[int]) -> float:
        """The largest share of itself that any direction of some columns keeps beyond those that are fitted, 0 to 1."""
        index, scale = list(index), self.scale(index)
        return float(np.linalg.eigvalsh(self.information[np.ix_(index, index)] * np.outer(scale, scale))[-1])

    def estimate(self, index: Sequence[int]) -> tuple[Array, Array]:
        """Least-squares values (n,) of some columns, and their covariance (n, n) by the noise model."""
        roots = self.roots(index)
        covariance = roots @ roots.T
        values: Array = covariance @ self.scores[:, list(index)].sum(axis=0)
        return values, covariance

    def only(self, index: Sequence[int]) -> Given:
        """Some of the columns, in this order."""
        rows = list(index)
        return Given(self.information[np.ix_(rows, rows)], self.scores[:, rows], self.total[rows])

    def given(self, index: Sequence[int]) -> Given:
        """The Schur complement beyond further columns."""
        return _beyond(self.information, self.scores, self.total, index)


def given(data: Whitened, index: Sequence[int]) -> Given:
    """Schur complement of all columns once the columns ``index`` are fitted."""
    return data.given(index)


def _beyond(information: Array, scores: Array, total: Array, index: Sequence[int]) -> Given:
    index = list(index)
    if not index:
        return Given(information, scores, total)
    roots = Given(information, scores, total).roots(index)
    explained = information[:, index] @ roots
    return Given(information - explained @ explained.T, scores - (scores[:, index] @ roots) @ explained.T, total)


@dataclass(frozen=True, eq=False)
class TrajectoryFit:
    """A model at some runs, at their reference poses after the start. Quantities are lists with one entry a run."""

    span: ClassVar[float] = 0.0  # s, to either side of a pose over which its velocity is taken
    model: OdometryModel
    runs: tuple[Trajectory, ...]
    nuisances: Nuisances

    def changed(self, **changes: Any) -> Self:
        """The fit with other values of some fields, and what was computed already and does not depend on these."""
        other = replace(self, **changes)
        same_runs = len(other.runs) == len(self.runs) and all(map(operator.is_, other.runs, self.runs))
        if same_runs and np.array_equal(other.nuisances.values, self.nuisances.values):
            valid = ("logs", "poses", "residuals", "slopes") if other.model is self.model else ("logs",)
            vars(other).update({name: vars(self)[name] for name in valid if name in vars(self)})
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
        """Derivatives (K, 3, 3) of the model's poses by the nuisances; the path turns about its start."""
        columns = []
        for poses, log, velocity, stamps in zip(self.poses, self.logs, self.velocities, self.stamps, strict=True):
            path = poses - log.start
            turning = np.stack([-path[:, 1], path[:, 0], np.ones(len(path))], axis=1)
            columns.append(np.stack([turning, -velocity, -velocity * stamps[:, None]], axis=2))
        return columns

    @property
    def velocities(self) -> list[Array]:
        """Velocities (K, 3) at the poses, m/s, m/s, rad/s.

        They are differences over twice the span, and two samples at least: the rate of a single one has its full
        encoder noise.
        """
        period = max(median_period(self.runs), self.span)
        shifted = []
        for run, log in zip(self.runs, self.logs, strict=True):
            stamps = np.concatenate([log.stamps + period, log.stamps - period])
            shifted.append(replace(run.log(stamps).continued(float(stamps.max())), start=log.start))
        both = (np.split(poses, 2) for poses in self.model.reported(shifted))
        return [(late - early) / (2 * period) for late, early in both]

    @property
    def estimated_slopes(self) -> list[Array]:
        """Derivatives (K, 3, m) by the m nuisances that are estimated."""
        estimated = self.nuisances.estimated
        if not estimated.any():
            return [np.empty((*residuals.shape, 0)) for residuals in self.residuals]
        return [slopes[..., estimated] for slopes in self.slopes]

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


@dataclass(frozen=True, eq=False)
class FitNoise:
    """The noise of the reference poses, and the standard deviations (3,) of the nuisances: rad, s, s per s."""

    estimate: noises.NoiseEstimate
    deviations: Array

    @property
    def sizes(self) -> dict[str, float]:
        """Standard deviations of poses and start headings, by their names."""
        return {**self.estimate.noise.model_dump(), "start_heading": float(self.deviations[TURN])}


def noise_of_fit(
    fit: TrajectoryFit, kinds: Sequence[int], near: Noise | None = None, chance: float = CHANCE
) -> FitNoise:
    """The noise that the residuals of a fit show beside nuisances of some kinds, and the deviations of these.

    Nuisances of other kinds keep their values; their deviations are 0. near: an earlier estimate of the noise. chance:
    level of the tests.
    """
    differences = differences_without_nuisances(fit, kinds)
    estimate = noises.estimate_noise(differences, near)
    separate = separate_nuisances(differences, estimate.noise, kinds, chance)
    return FitNoise(replace(estimate, noise=separate.noise), separate.deviations)


def differences_without_nuisances(fit: TrajectoryFit, kinds: Sequence[int]) -> noises.Differences:
    """Differences between repetitions of the residuals that a fit leaves if nuisances of some kinds are 0."""
    values = fit.nuisances.values.copy()
    values[:, kinds] = 0.0
    if not np.array_equal(values, fit.nuisances.values):
        fit = replace(fit, nuisances=replace(fit.nuisances, values=values))
    slopes = fit.slopes if kinds else [np.zeros((*residuals.shape, 3)) for residuals in fit.residuals]
    residuals, slopes = (in_start_frames(fit.runs, of_runs) for of_runs in (fit.residuals, slopes))
    return noises.differences_between_repetitions(fit.runs, residuals, slopes)


@dataclass(frozen=True, eq=False)
class SeparateNoise:
    """A noise without that of nuisances, their deviations (3,), and -2 ln L of both, Eq. (3).

    slopes (9,): derivatives of -2 ln L by the logarithms of the noise's components and of the deviations.
    """

    noise: Noise
    deviations: Array
    minus_log_likelihood: float
    slopes: Array

    @classmethod
    def of(cls, differences: noises.Differences, noise: Noise, deviations: Array) -> SeparateNoise:
        """This noise with these deviations, as likely as differences between repetitions make them."""
        estimated = np.flatnonzero(deviations)
        sizes = deviations[estimated]
        total, slopes = 0.0, np.zeros(len(_NAMES) + 3)
        for stamps, values, columns in differences.by_stamps:
            whitener = noises.Whitener(noise, stamps)
            white = _whitened(whitener, values, columns[..., estimated])
            products = _Products.of(whitener, white)
            total += products.minus_log_likelihood(sizes)
            # Eq. (4): a, and columns Z such that (C + N S S N')^-1 = C^-1 - Z Z'.
            beside, inner, lower = products.beside, products.inner, products.lower(sizes)
            reduced = np.linalg.solve(lower, sizes[:, None] * np.concatenate([beside[..., None], inner], axis=2))
            solved = whitener.transposed(white)
            roots = np.linalg.solve(lower, sizes[:, None] * np.eye(len(sizes)))
            removed = np.einsum("ksnj,nij->ksni", solved[..., 1:], roots)
            remaining = solved[..., 0] - np.einsum("ksni,ni->ksn", removed, reduced[..., 0])
            both = np.concatenate([remaining[..., None], removed], axis=3)
            forms = whitener.forms(both.reshape(*values.shape[:2], -1))
            slopes[: len(_NAMES)] += values.shape[2] * whitener.traces - forms
            projected = beside - np.einsum("nij,ni->nj", reduced[..., 1:], reduced[..., 0])  # N' a
            traces = np.diagonal(inner, axis1=1, axis2=2) - np.square(reduced[..., 1:]).sum(axis=1)
            slopes[len(_NAMES) + estimated] += (traces - np.square(projected)).sum(axis=0)
        components = np.concatenate([[getattr(noise, name) for name in _NAMES], deviations])
        return cls(noise, deviations, total, 2 * np.square(components) * slopes)


@dataclass(frozen=True, eq=False)
class _Products:
    """Products of differences at the same stamps, whitened, with the columns of some nuisances.

    log_determinant: ln |C|. squares (n,), beside (n, m), inner (n, m, m): r'r, N'r and N'N of n differences.
    """

    log_determinant: float
    squares: Array
    beside: Array
    inner: Array

    @classmethod
    def of(cls, whitener: noises.Whitener, white: Array) -> _Products:
        """Products of white (K, 3, n, 1 + m), differences and nuisances."""
        of_runs = white.reshape(-1, *white.shape[2:]).transpose(1, 0, 2)
        products = of_runs.transpose(0, 2, 1) @ of_runs
        return cls(whitener.log_determinant, products[:, 0, 0], products[:, 1:, 0], products[:, 1:, 1:])

    def lower(self, sizes: Array) -> Array:
        """Cholesky factors (n, m, m) of 1 + S N'N S, S being the sizes (m,)."""
        return np.asarray(np.linalg.cholesky(np.eye(len(sizes)) + self.inner * np.outer(sizes, sizes)))

    def minus_log_likelihood(self, sizes: Array) -> float:
        """-2 ln L, Eq. (3), of nuisances with standard deviations (m,)."""
        lower = self.lower(sizes)
        reduced = np.linalg.solve(lower, (sizes * self.beside)[..., None])
        determinants = 2 * np.log(np.diagonal(lower, axis1=1, axis2=2)).sum()
        total = len(self.squares) * self.log_determinant + self.squares.sum() - np.square(reduced).sum() + determinants
        return float(total)


def _whitened(whitener: noises.Whitener, values: Array, columns: Array) -> Array:
    """Differences (K, 3, n) and columns (K, 3, n, m), whitened: (K, 3, n, 1 + m)."""
    both = np.concatenate([values[..., None], columns], axis=3)
    return whitener(both.reshape(*values.shape[:2], -1)).reshape(both.shape)


def _products(differences: noises.Differences, noise: Noise, used: NDArray[np.intp]) -> list[_Products]:
    """The products of all differences with the columns of the nuisances ``used``, by stamps."""
    products = []
    for stamps, values, columns in differences.by_stamps:
        whitener = noises.Whitener(noise, stamps)
        products.append(_Products.of(whitener, _whitened(whitener, values, columns[..., used])))
    return products


def separate_nuisances(
    differences: noises.Differences, noise: Noise, kinds: Sequence[int], chance: float = CHANCE
) -> SeparateNoise:
    """Maximum likelihood estimate of the noise and of the deviations of nuisances of some kinds.

    noise: the estimate without nuisances, where the search begins. The likeliest nuisance comes in first, a further one
    for what those before it leave unexplained.
    """
    # Under the null half of the statistic of one variance that may be zero is chi-square with one degree of freedom,
    # half is 0 (Self and Liang 1987).
    critical = chdtri(1, 2 * chance / max(len(kinds), 1))
    now = SeparateNoise.of(differences, noise, np.zeros(3))

    def gain(then: SeparateNoise) -> float:
        return now.minus_log_likelihood - then.minus_log_likelihood

    while True:
        trials = [_along(differences, now, kind) for kind in kinds if now.deviations[kind] == 0]
        likeliest = max(trials, key=gain, default=now)
        if gain(likeliest) >= _PROMISING * critical:
            likeliest = _polished(differences, likeliest)
        if gain(likeliest) <= critical:
            return now
        now = likeliest


def _along(differences: noises.Differences, now: SeparateNoise, kind: int) -> SeparateNoise:
    """The best deviation of one more nuisance, other noise held.

    The bias of the headings has stood in for start headings and becomes smaller by as much.
    """
    reach, bias = float(_LARGEST[kind]), now.noise.bias_heading
    if kind == TURN:
        reach = min(max(2 * bias, 4 * now.noise.pose_heading, 1e-6), reach)
    used = np.flatnonzero((now.deviations > 0) | (np.arange(3) == kind))
    held = None if kind == TURN else _products(differences, now.noise, used)

    def deviations_with(deviation: float) -> Array:
        return np.where(np.arange(3) == kind, deviation, now.deviations)

    def noise_with(deviation: float) -> Noise:
        if kind != TURN:
            return now.noise
        return now.noise.model_copy(update={"bias_heading": float(np.sqrt(max(bias**2 - deviation**2, 0.0)))})

    def minus_log_likelihood(deviation: float) -> float:
        products = _products(differences, noise_with(deviation), used) if held is None else held
        return sum(of_group.minus_log_likelihood(deviations_with(deviation)[used]) for of_group in products)

    answer = scipy.optimize.minimize_scalar(
        minus_log_likelihood, bounds=(0.0, reach), method="bounded", options={"xatol": 1e-6}
    )
    deviation = float(answer.x)
    return SeparateNoise.of(differences, noise_with(deviation), deviations_with(deviation))


def _polished(differences: noises.Differences, near: SeparateNoise) -> SeparateNoise:
    """All components of the noise and the deviations that are not 0 estimated together, from a good start."""
    estimated = near.deviations > 0
    start = np.array([*(getattr(near.noise, name) for name in _NAMES), *near.deviations[estimated]])
    # The search is on a logarithmic scale, where zero cannot be left. Start headings are the first of the nuisances.
    for of_one_unit in (start[:3], start[3 : 6 + estimated[TURN]]):
        np.maximum(of_one_unit, 0.1 * max(of_one_unit.max(), noises.LEAST_WHITE), out=of_one_unit)

    moved = np.concatenate([np.ones(len(_NAMES), dtype=bool), estimated])

    def described(logarithms: Array) -> SeparateNoise:
        values, deviations = start * np.exp(logarithms), np.zeros(3)
        deviations[estimated] = values[len(_NAMES) :]
        noise = Noise(**dict(zip(_NAMES, map(float, values), strict=False)))
        return SeparateNoise.of(differences, noise, deviations)

    def cost(logarithms: Array) -> tuple[float, Array]:
        there = described(logarithms)
        return there.minus_log_likelihood / count, there.slopes[moved] / count

    count = sum(difference.values.size for difference in differences.each)
    bounds = [(-5.0, 5.0)] * len(start)
    answer = scipy.optimize.minimize(
        cost, np.zeros(len(start)), jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-10}
    )
    return described(answer.x)
