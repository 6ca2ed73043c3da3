"""Step 1, fit: the plain matrix with the noise that it leaves; and the fits of matrix and effects of later steps.

Long drives are cut into windows that serve as runs, each from its own reference pose. Outliers are reference poses that
contradict the other poses of their run, where nothing like it recurs. Let r be the residuals of a run along one axis,
normal with the inverse covariance P. Given all others, residual i is normal with the mean r_i - (P r)_i / P_ii and the
variance 1 / P_ii (Rasmussen and Williams, Gaussian processes for machine learning, 2006, Eq. 5.12), so that it lies so
many standard deviations from what the others predict:

    |(P r)_i| / sqrt(P_ii).                                                                                         (1)

The score of a pose is the largest of those in x, y and heading. What a model lacks raises scores, too, but wherever the
robot does the same again: at one stamp of a command's repetitions, or of most runs. An outlier stands out of these.

The covariance of matrix elements and parameters is that of the noise, or of the scatter where the model does not fit.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.discover.paths import Paths, blocks_of, make_paths, slopes_by, slopes_by_matrix
from omnibench.discover.significance import Group
from omnibench.errors import DataError
from omnibench.fit import noise as reference_noise
from omnibench.fit import trajectory_fit as fits
from omnibench.fit.calibrators.map import runs_of_estimate
from omnibench.fit.estimate import (
    LOST_RATE,
    USUAL_NUISANCES,
    EstimateProblem,
    Linearisation,
    Nuisances,
    Unknown,
    chosen_poses,
    estimate,
)
from omnibench.fit.intervals import Clusters, jackknife
from omnibench.fit.motion_windows import windows_of
from omnibench.fit.prior import physical_prior_root, physical_tolerance
from omnibench.robot.calibration import Calibration, Noise
from omnibench.robot.effects.effect import MotionEffect, ReferenceEffect, Term
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog, split_by
from omnibench.robot.physical import EstimatedCovariance

_ENOUGH = 30  # runs that are not cut: signs of fewer are flipped in too few ways for chances of 0.002 to be known well
_MOST = 60  # windows of all drives, at most; chosen
_SHORTEST = (
    4.0  # s, of a window: slip after a start has settled, and chance in the pose it begins with averages out; chosen
)


def in_windows(runs: Sequence[Trajectory]) -> tuple[Trajectory, ...]:
    """The runs; where they are few, and no command is repeated, their parts of equal length."""
    repeated = any(len(members) > 1 for members in reference_noise.grouped([run.command or run.id for run in runs]))
    if repeated or len(runs) >= _ENOUGH:
        return tuple(runs)
    length = max(_SHORTEST, sum(run.end for run in runs) / _MOST)
    return tuple(window for run in runs for window in windows_of(run, max(1, int(run.end / length))))


@dataclass(frozen=True, eq=False)
class PlainFit:
    """The plain matrix, fitted to the training runs of a data set.

    fit: the matrix at the runs, or at their windows, with the noise that it leaves. whole: the runs with the poses that
    ``calibrate`` estimates by, where the fit's are windows of them or have others.
    """

    dataset: Dataset
    fit: Fit
    whole: tuple[Trajectory, ...] | None = None


def start_matrix(dataset: Dataset, calibration: Calibration | None) -> Array:
    """The matrix (3, M) to begin at: the design's, or that of a calibration without effects.

    DataError: the calibration is of another robot, or holds effects and its matrix without them is not known.
    """
    if calibration is None:
        return dataset.robot.inverse_kinematic_matrix
    if calibration.effects and calibration.plain is None:
        names = ", ".join(term.name for term in calibration.effects)
        raise DataError(
            f"the calibration {calibration.name!r} holds effects already ({names}), and discover begins at a plain "
            "matrix; give one without effects, such as the plain.yaml beside it, or none"
        )
    calibration.check_wheels(dataset.robot, f"the data set {dataset.name}")
    return calibration.matrix_without_effects


def fit_plain(dataset: Dataset, start: Array) -> PlainFit:
    """Fit the plain matrix to the training runs, from a start (3, M). DataError: there are no reference poses.

    Where no training run repeats a command, runs of the validation split that do tell the noise.
    """
    recorded = [run for run in dataset.split("train") if run.has_poses]
    runs = fits.usable_runs(in_windows(recorded) or dataset.split("train"))
    repeating: tuple[Trajectory, ...] = ()
    with suppress(DataError):  # none is usable
        others = reference_noise.repeating_runs(runs, dataset.split("validation"))
        repeating = fits.usable_runs(others, "validation")
    fit = fit_matrix(runs, dataset.robot, dataset.sample_period, start, repeating)
    estimated = sorted(runs_of_estimate(recorded), key=lambda run: (str(run.session), run.started_at or 0.0))
    if [len(run.pose_times) for run in estimated] == [len(run.pose_times) for run in runs]:
        return PlainFit(dataset, fit)
    whole = tuple(fits.with_poses(run, np.append(0, chosen_poses(run))) for run in estimated)
    return PlainFit(dataset, fit, whole)


_UNKNOWN_NOISE = reference_noise.NoiseEstimate(reference_noise.FIRST_NOISE, "within runs", 1, "")
_TOGETHER = 30_000  # samples whose paths are computed at once (chosen)
# Level of the tests for nuisances. It is strict, since other noise resembles them and what they explain is lost for
# effects: where encoders tick, start headings raise twice the log-likelihood by 10, and with them an effect was named
# that the simulated robot does not have (tests/discover/test_robot_recordings.py). Clocks of omni3 and of a hidden set
# raise it by 31 to 230; the level asks for 16. Half or twice of it: the same answers in 12 of 12 sets
# (tests/studies/constants.py).
_CHANCE = 1e-4


@dataclass(frozen=True, eq=False)
class Fit(fits.TrajectoryFit):
    """A fitted model at whole runs, its noise, and which of their poses are outliers, that no weighting counts.

    noise_runs: runs that the noise alone sees, as repetitions of these. inliers: True (K,) for the poses of the runs,
    then of these, that are no outliers; empty if there are none.
    """

    span: ClassVar[float] = 0.1  # less encoder noise than over two samples; slower than the ramps of a motor
    noise: reference_noise.NoiseEstimate
    inliers: tuple[NDArray[np.bool_], ...] = ()
    noise_runs: tuple[Trajectory, ...] = ()

    @property
    def masks(self) -> list[NDArray[np.bool_]]:
        """True (K,) for the inliers of each run."""
        masks = self.inliers or [np.ones(len(run.pose_times) - 1, dtype=bool) for run in self.runs]
        return list(masks[: len(self.runs)])

    @property
    def jumps(self) -> int:
        """The number of the runs' poses that are outliers."""
        return sum(int((~mask).sum()) for mask in self.masks)

    @cached_property
    def with_noise_runs(self) -> Fit:
        """The fit's model at its runs and at those that the noise alone sees."""
        if not self.noise_runs:
            return self
        values = np.vstack([self.nuisances.values, np.zeros((len(self.noise_runs), 3))])
        runs, nuisances = (*self.runs, *self.noise_runs), replace(self.nuisances, values=values)
        return self.changed(runs=runs, noise_runs=(), nuisances=nuisances).with_likeliest_nuisances()

    @cached_property
    def at_inliers(self) -> Fit:
        """The fit's model at its runs without their outliers."""
        if not self.jumps:
            return self
        pairs = zip(self.runs, self.masks, strict=True)
        runs = [run if mask.all() else fits.with_poses(run, np.append(True, mask)) for run, mask in pairs]
        return self.changed(runs=tuple(runs), inliers=(), noise_runs=())

    @cached_property
    def weightings(self) -> list[InlierWhitener]:
        """The whitening of each run's inliers under the noise; runs with the same stamps share theirs."""
        made: dict[tuple[bytes, bytes], InlierWhitener] = {}
        keys = [(stamps.tobytes(), mask.tobytes()) for stamps, mask in zip(self.stamps, self.masks, strict=True)]
        for key, stamps, mask in zip(keys, self.stamps, self.masks, strict=True):
            if key not in made:
                made[key] = InlierWhitener(self.noise.noise, stamps, mask)
        return [made[key] for key in keys]

    def whitened(self, columns: Sequence[Array], residuals: Sequence[Array] | None = None) -> fits.Whitened:
        """Columns (K, 3, p) and residuals (K, 3) of every run, whitened under the noise, nuisances eliminated.

        residuals: the fit's nuisance-free ones where none are given.
        """
        return self.linearised(columns, self.weightings, residuals)

    def whitened_steps(self, steps: Sequence[Array], residuals: Sequence[Array], runs: slice) -> fits.Whitened:
        """Columns and residuals (K, 3) of some runs as ``whitened`` has them.

        steps (K, 3, p): differences of the columns from one stamp to the next, the first from 0.
        """
        weightings = self.weightings[runs]
        of_steps = {id(weigh): weigh.of_differences for weigh in weightings}
        return fits.whitened(
            residuals[runs],
            steps,
            weightings,
            self.estimated_slopes[runs],
            self.nuisances.deviations[self.nuisances.estimated],
            [of_steps[id(weigh)] for weigh in weightings],
        )

    @property
    def weighted_residuals(self) -> list[Array]:
        """Inverse covariance of noise and nuisances times the nuisance-free residuals (K, 3); 0 for outliers."""
        deviations, weighted = self.nuisances.deviations[self.nuisances.estimated], []
        runs = zip(self.nuisance_free_residuals, self.estimated_slopes, self.weightings, strict=True)
        for residuals, slopes, weigh in runs:
            white = weigh(residuals)
            if len(deviations):
                nuisances = (weigh(slopes) * deviations).reshape(white.size, -1)
                white = fits.without(fits.without(white.reshape(-1, 1), nuisances), nuisances).reshape(white.shape)
            weighted.append(weigh.weighted(white))
        return weighted

    def with_likeliest_nuisances(self) -> Fit:
        """The fit with the most likely nuisances for the residuals that its model leaves."""
        if not self.nuisances.estimated.any():
            return self
        return self.changed(nuisances=replace(self.nuisances, values=self.likeliest_nuisances(self.weightings)))


def first_fit(runs: Sequence[Trajectory], robot: Robot, sample_period: float, start: Array) -> Fit:
    """The plain matrix (3, N) to start from, whose noise is not known yet.

    The model drives exact arcs: Euler steps would leave what looks like centripetal slip.
    """
    model = OdometryModel(robot, start, "arc", (), sample_period)
    return Fit(model, tuple(runs), fits.Nuisances(np.zeros((len(runs), 3)), np.zeros(3)), _UNKNOWN_NOISE)


def with_noise(fit: Fit) -> Fit:
    """The fit with noise, nuisances and outliers estimated anew from its residuals; outliers may come back."""
    near = fit.noise.noise if fit.noise is not _UNKNOWN_NOISE else None
    seen = fit.with_noise_runs
    usual = seen.at_inliers
    noise = reference_noise.estimate_noise(
        reference_noise.differences_between_repetitions(usual.runs, fits.in_start_frames(usual.runs, usual.residuals)),
        near,
    )
    fit = fit.changed(inliers=inliers_of(seen.runs, fits.in_start_frames(seen.runs, seen.residuals), noise.noise))
    found = fits.noise_of_fit(fit.with_noise_runs.at_inliers, range(3), noise.noise, _CHANCE)
    values = np.where(found.deviations > 0, fit.nuisances.values, 0.0)
    fit = fit.changed(nuisances=fits.Nuisances(values, found.deviations), noise=found.estimate)
    return fit.with_likeliest_nuisances()


def paths_of(fit: Fit, coarse: float = 0.0) -> Paths:
    """The paths of the fit's runs by its matrix alone; samples are merged into ones of up to ``coarse`` s."""
    assert fit.model.sample_period is not None
    together = max(1, int(coarse / fit.model.sample_period))
    logs = [_coarser(log, together) for log in fit.logs]
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
    steering = None if log.steering is None else log.steering[ends]
    return replace(log, times=times, rates=rates, wheel_angles=phases, steering=steering)


def at_model(fit: Fit, model: OdometryModel) -> Fit:
    """Another model at the fit's runs, with the most likely nuisances given the residuals that it leaves."""
    return fit.changed(model=model).with_likeliest_nuisances()


def at_runs(fit: Fit, runs: Sequence[Trajectory]) -> Fit:
    """The fit's model at other runs, their nuisances 0: only the sizes of these are known."""
    nothing_known = fits.Nuisances(np.zeros((len(runs), 3)), fit.nuisances.deviations)
    return replace(fit, runs=tuple(runs), nuisances=nothing_known, inliers=(), noise_runs=())


def model_with(model: OdometryModel, matrix: Array, terms: Sequence[Term]) -> OdometryModel:
    """The model with another matrix and other terms."""
    return replace(model, matrix=matrix, terms=tuple(terms))


# tests/studies/constants.py varies each number by 0.5 and 2: on a small set with heading drift no verdict and no
# name changes.
_JUMP = 4.5  # score, Eq. (1), from which on a pose is an outlier: noise alone makes it of one normal pose in 49,000
_MOST_JUMPS = 0.1  # share of a run's poses that may be outliers
_RARE = 0.08  # share of all poses: where more seem to be outliers, the model is wrong in a way that varies fast
_MANY, _MANY_BY_CHANCE = 0.95, 2.39  # a quantile of all scores, and its value for the largest of three normal ones
_OFTEN, _OFTEN_BY_CHANCE = 0.8, 1.80  # likewise, of the scores at one stamp in other runs


def inliers_of(runs: Sequence[Trajectory], residuals: Sequence[Array], noise: Noise) -> tuple[NDArray[np.bool_], ...]:
    """True (K,) for the poses of each run that are no outliers. residuals (K, 3): in the frame of the run's start.

    A score of 4.5 makes an outlier, or 4.5 times what is usual for the scores at its stamp in other runs. Where more
    than 8 % of the poses seem to be outliers they are not, and the limit rises in proportion to the usual score.
    """
    whitening = reference_noise.whiteners(noise, [run.pose_times[1:] for run in runs])
    scores = [_scores(*each) for each in zip(whitening, residuals, strict=True)]
    every = np.concatenate(scores)
    if every.max() < _JUMP:
        return tuple(np.ones(len(of_run), dtype=bool) for of_run in scores)
    limits = _JUMP * np.maximum(_usual_at_stamps(runs, scores), 1.0)

    def below(limits: Array) -> tuple[NDArray[np.bool_], ...]:
        of_runs = np.split(limits, np.cumsum([len(of_run) for of_run in scores])[:-1])
        return tuple(_below(noise, *each) for each in zip(runs, residuals, scores, of_runs, strict=True))

    inliers = below(limits)
    if sum(int((~of_run).sum()) for of_run in inliers) <= _RARE * len(every):
        return inliers
    return below(np.maximum(limits, _JUMP * float(np.quantile(every, _MANY)) / _MANY_BY_CHANCE))


def _below(noise: Noise, run: Trajectory, residuals: Array, scores: Array, limits: Array) -> NDArray[np.bool_]:
    """True (K,) for the poses of a run whose scores are below their limits; the worst goes first."""
    inliers, stamps = np.ones(len(limits), dtype=bool), run.pose_times[1:]
    for _ in range(int(np.ceil(_MOST_JUMPS * len(limits)))):
        excess = scores / limits[inliers]
        if len(excess) < 3 or excess.max() < 1:
            break
        inliers[np.flatnonzero(inliers)[excess.argmax()]] = False
        scores = _scores(reference_noise.Whitener(noise, stamps[inliers]), residuals[inliers])
    return inliers


def _scores(whitener: reference_noise.Whitener, residuals: Array) -> Array:
    """Distances (K,) of poses from what the others of their run predict, in standard deviations, Eq. (1)."""
    errors, variances = whitener.left_out(residuals)
    scores: Array = np.abs(errors / np.sqrt(variances)).max(axis=1)
    return scores


def _usual_at_stamps(runs: Sequence[Trajectory], scores: Sequence[Array]) -> Array:
    """The usual score of other runs at each pose's stamp, as a share of that by chance; 0 where there are none.

    Of repetitions of a command and of all runs, at the time from the start and from the end: the largest.
    """
    interval = float(np.median(np.concatenate([np.diff(run.pose_times) for run in runs])))
    owner = np.repeat(np.arange(len(runs)), [len(of_run) for of_run in scores])
    every, usual = np.concatenate(scores), np.zeros(len(owner))
    names: dict[Hashable, int] = {}
    commands = np.array([names.setdefault((run.session, run.command or run.id), len(names)) for run in runs])
    for origin in (0, -1):
        moments = np.concatenate([(run.pose_times[1:] - run.pose_times[origin]) / interval for run in runs])
        stamps = np.round(moments).astype(int)
        for driven in (commands[owner], np.zeros(len(owner), dtype=int)):
            groups = np.unique(np.column_stack([driven, stamps]), axis=0, return_inverse=True)[1].ravel()
            np.maximum(usual, _quantile_of_others(groups, owner, every), out=usual)
    return usual / _OFTEN_BY_CHANCE


def _quantile_of_others(groups: NDArray[np.intp], owner: NDArray[np.intp], scores: Array) -> Array:
    """The quantile (S,) of the scores (S,) that the other runs of each one's group have, 0 where it has no other run.

    A run counts once in a group, by its largest score there.
    """
    members, member = np.unique(np.column_stack([groups, owner]), axis=0, return_inverse=True)
    largest = np.zeros(len(members))
    np.maximum.at(largest, member.ravel(), scores)
    order = np.lexsort([largest, members[:, 0]])
    _, firsts, counts = np.unique(members[order, 0], return_index=True, return_counts=True)
    first, count = np.repeat(firsts, counts), np.repeat(counts, counts)
    place = np.floor(_OFTEN * np.maximum(count - 2, 0)).astype(int)  # of the quantile among the others
    place += np.arange(len(order)) - first <= place  # among all, where the run itself stands before it
    place = np.minimum(place, count - 1)
    of_others = np.empty(len(members))
    of_others[order] = np.where(count > 1, largest[order][first + place], 0.0)
    quantiles: Array = of_others[member.ravel()]
    return quantiles


class InlierWhitener:
    """The whitening of a run's inliers: residuals (K, 3) or (K, 3, n) of all poses to (k, 3) or (k, 3, n)."""

    def __init__(self, noise: Noise, stamps: Array, inliers: NDArray[np.bool_]) -> None:
        self._whitener, self._inliers = reference_noise.Whitener(noise, stamps[inliers]), inliers
        self._whole = bool(inliers.all())

    def __call__(self, residuals: Array) -> Array:
        """Whitened residuals, or derivatives of residuals, of the inliers."""
        return self._whitener(residuals if self._whole else residuals[self._inliers])

    def of_differences(self, differences: Array) -> Array:
        """Whitened residuals of the inliers by the differences (K, 3, n) from one pose to the next, the first from 0.

        These may be overwritten.
        """
        if not self._whole:
            rows = np.flatnonzero(self._inliers)
            differences = np.add.reduceat(differences[: rows[-1] + 1], np.append(0, rows[:-1] + 1), axis=0)
        return self._whitener.of_differences(differences)

    def weighted(self, white: Array) -> Array:
        """Inverse covariance times the residuals (K, 3) that were whitened to (k, 3); 0 for outliers."""
        values = np.zeros((len(self._inliers), 3))
        values[self._inliers] = -np.diff(self._whitener.transposed(white), axis=0, append=0.0)
        return values


# tests/studies/constants.py varies each number by 0.5 and 2: on a small set with heading drift no verdict and no
# name changes.
_ROUNDS = 12  # rounds, at most, that fit model, noise and outliers by turns; recordings here settle in three
_NEAR = 0.02  # share of the largest component of the noise by which two noises may differ, see is_near
_STEPS = 4  # Gauss-Newton steps, at most
_HALVINGS = 10  # tries of a step that leads too far, each half of the one before: at last 1 / 512 of it
_ROUNDING = 1e-6  # share of chi-square by which a step of an ended fit may raise it, as numbers are rounded
# rad by which an estimate turns headings against its linearisation: below the first it is the model itself, to 1e-6 of
# a path's length; above the second slopes are taken anew (chosen).
_STRAIGHT, _BENT = 1e-3, 0.02
_STILL = 0.05  # standard errors: a smaller step, which no interval shows, ends the fit


@dataclass(frozen=True, eq=False)
class Extended:
    """A fit with effects.

    data: whitened columns of the matrix elements, then of the effects' linear parameters. columns (K, 3, p): each run's
    columns, before whitening. values (n,): the effects' linear parameters. covariance (p, p): of matrix elements and
    parameters. without_folds: how they change without some runs, where they are not those of least squares.
    """

    fit: Fit
    groups: tuple[Group, ...]
    data: fits.Whitened
    columns: tuple[Array, ...]
    values: Array
    covariance: EstimatedCovariance
    without_folds: Callable[[NDArray[np.intp]], Array] | None = None

    def steps_without(self, folds: NDArray[np.intp]) -> Array:
        """Changes (Z, p) of matrix elements and parameters for each run, once all runs of its fold (Z,) are left out.

        They are to first order: least squares of the other runs, unless ``without_folds`` says otherwise.
        """
        if self.without_folds is not None:
            return self.without_folds(folds)
        return values_of_other_folds(self.data, range(len(self.data.information)), folds)

    @property
    def residuals_without_effects(self) -> list[Array]:
        """Nuisance-free residuals (K, 3) of each run with the effects' share put back, to first order.

        Of effects on steering angles, most of which the matrix can take up, only the rest is put back: to first order
        the whole would lead too far.
        """
        elements = self.fit.model.matrix.size
        put_back = np.concatenate([np.zeros(elements), self.values])
        if _bends(self.groups):
            information = self.data.information[:elements]
            put_back[:elements] = -np.linalg.pinv(information[:, :elements]) @ information[:, elements:] @ self.values
        first = 0 if _bends(self.groups) else elements
        return [
            residuals + columns[..., first:] @ put_back[first:]
            for residuals, columns in zip(self.fit.nuisance_free_residuals, self.columns, strict=True)
        ]

    @property
    def covariance_of_terms(self) -> Array:
        """Covariance (n, n) of the matrix and of all values of the terms; 0 for shapes, which are not fitted."""
        elements = self.fit.model.matrix.size
        fitted = list(range(elements))
        count = elements
        for group in self.groups:
            fitted += range(count, count + len(group.parameters))
            count += len(group.parameters) + len(group.shapes)
        covariance = np.zeros((count, count))
        covariance[np.ix_(fitted, fitted)] = (self.covariance.matrix + self.covariance.matrix.T) / 2
        return covariance


def fit_matrix(
    runs: Sequence[Trajectory],
    robot: Robot,
    sample_period: float,
    start: Array,
    noise_runs: Sequence[Trajectory] = (),
) -> Fit:
    """Fit the plain matrix from a start (3, N), and with it noise, nuisances and outliers.

    noise_runs: repetitions of the runs that the noise alone sees.
    """
    first = replace(first_fit(runs, robot, sample_period, start), noise_runs=tuple(noise_runs))
    return _in_turn(first, ())[0]


def extend(plain: Fit, groups: Sequence[Group]) -> Extended:
    """Fit matrix and effects together, from the plain matrix and effects of 0; noise stays where there are none."""
    fit, values, data, columns = _in_turn(plain, groups) if groups else _descend(plain, (), np.zeros(0))
    covariance = jackknife(data.information_of_runs, data.scores, Clusters.of(fit.runs))
    return Extended(fit, tuple(groups), data, columns, values, covariance)


def _in_turn(fit: Fit, groups: Sequence[Group]) -> tuple[Fit, Array, fits.Whitened, tuple[Array, ...]]:
    """Matrix and effects fitted, then noise, outliers and these by turns until the outliers and the noise stay.

    Outliers that come back in a circle end it, too.
    """
    fit, values, data, columns = _descend(fit, groups, np.zeros(sum(len(group.parameters) for group in groups)))
    seen: set[bytes] = set()
    for _ in range(_ROUNDS):
        before = fit.noise.noise
        seen.add(np.concatenate(fit.masks).tobytes())
        fit, values, data, columns = _descend(with_noise(fit), groups, values)
        same_noise = reference_noise.is_near(before.model_dump(), fit.noise.noise.model_dump(), _NEAR)
        if same_noise and np.concatenate(fit.masks).tobytes() in seen:
            break
    return fit, values, data, columns


def without_effects(plain: Fit, extended: Extended) -> Extended:
    """The plain matrix fitted to the inliers, noise and nuisances of an extended model, to be compared with it."""
    return extend(at_model(extended.fit, plain.model), ()) if extended.groups else extended


def most_probable(
    fit: Fit, groups: Sequence[Group], values: Array, whole: Sequence[Trajectory] | None = None
) -> Extended:
    """Matrix and effects as ``calibrate`` estimates a matrix: weighed by what is known of the design, and robust.

    The estimate is that of fit/estimate.py, whose prior for a parameter is its largest plausible size, and for the lost
    rate that of the robot's class. Runs count as they are; outliers, by the loss. values (n,): of the effects'
    parameters, to begin with. whole: the runs to estimate by, where those of the fit are windows of them.
    """
    robot, elements = fit.model.robot, fit.model.matrix.size
    tolerance = physical_tolerance(robot)
    parameters = [(group.name, parameter) for group in groups for parameter in group.parameters]
    unknowns = tuple(
        Unknown(name, each.name, tolerance.lost_rate if (name, each.name) == LOST_RATE else each.largest)
        for name, each in parameters
    )
    root, period = physical_prior_root(robot, tolerance), fit.model.sample_period
    assert period is not None
    runs = tuple(whole or fit.runs)
    heading, clock = USUAL_NUISANCES
    if any(group.effect is not None and group.effect.stage == "reference" for group in groups):
        clock = 0.0  # beside an offset of each run's clock, a delay of all runs would be hardly known
    nuisances = Nuisances(heading, clock)
    problem = EstimateProblem(robot, runs, root, fit.model.integration, period, unknowns, nuisances)
    still = fits.TrajectoryFit(fit.model, runs, fits.Nuisances(np.zeros((len(runs), 3)), np.zeros(3)))
    now, found, columns = np.append(fit.model.matrix, values), None, None
    for _ in range(_ROUNDS):
        model = model_with(fit.model, now[:elements].reshape(3, -1), terms_of(groups, now[elements:]))
        still = still.changed(model=model)
        if columns is None:
            columns = columns_of(still, groups)
        errors = [-residuals for residuals in still.residuals]
        found = estimate(problem, near=found, about=Linearisation(now, errors, columns, still.slopes))
        step, now = found.values - now, found.values
        turned = max(float(np.abs(of_run[:, 2] @ step).max()) for of_run in columns)
        if turned < _STRAIGHT:
            break
        columns = None if turned > _BENT else columns
    assert found is not None
    estimated, hessian = found, found.information.sum(axis=0) + np.eye(found.root.shape[1])

    def without_folds(folds: NDArray[np.intp]) -> Array:
        """One Gauss-Newton step of the estimate without the runs of each fold."""
        steps = np.zeros((len(folds), len(now)))
        for fold in np.unique(folds):
            inside = folds == fold
            others = hessian - estimated.information[inside].sum(axis=0)
            steps[inside] = estimated.root @ np.linalg.solve(others, estimated.scores[inside].sum(axis=0))
        return steps

    clusters, unit = Clusters.of(runs), np.eye(found.root.shape[1])
    covariance = jackknife(found.information, found.scores, clusters, unit, found.root)
    there = at_model(fit, model_with(fit.model, now[:elements].reshape(3, -1), terms_of(groups, now[elements:])))
    columns = columns_of(there, groups) if columns is None or whole is not None else columns
    same = whole is None or [run.id for run in whole] == [run.id for run in fit.runs]
    data, of_folds = there.whitened(columns), without_folds if same else None
    return Extended(there, tuple(groups), data, columns, now[elements:], covariance, of_folds)


def terms_of(groups: Sequence[Group], values: Array) -> list[Term]:
    """The effects as terms of a model. values: all their linear parameters in turn."""
    terms, first = [], 0
    for group in groups:
        linear = {each.name: float(value) for each, value in zip(group.parameters, values[first:], strict=False)}
        first += len(group.parameters)
        assert group.effect is not None
        terms.append(Term(group.effect, linear | dict(group.shapes)))
    return terms


def columns_of(fit: fits.TrajectoryFit, groups: Sequence[Group]) -> tuple[Array, ...]:
    """Slopes (K, 3, n) of each run's poses by matrix elements and by the effects' parameters, about a fit."""
    needs = frozenset().union(*(group.effect.needs for group in groups if group.effect is not None))
    model, period, columns = fit.model, fit.model.sample_period, list[Array]()
    assert period is not None
    # The paths of some runs at a time
    for first, last in blocks_of([len(log.times) for log in fit.logs], _TOGETHER):
        logs = fit.logs[first:last]
        paths = make_paths(model.robot, model.matrix, logs, period, needs, first, model.motion_terms)
        slopes = [slopes_by_matrix(paths)]
        for group in groups:
            assert isinstance(group.effect, MotionEffect | ReferenceEffect)
            base = {each.name: 0.0 for each in group.parameters} | dict(group.shapes)
            slopes.append(slopes_by(paths, group.effect, [each.name for each in group.parameters], base))
        columns += split_by(np.concatenate(slopes, axis=2), [log.stamps for log in logs])
    return tuple(columns)


def columns_at(extended: Extended, runs: Sequence[Trajectory]) -> list[Array]:
    """Slopes (K, 3, n) of other runs' poses by matrix elements and by the effects' parameters."""
    ordered = sorted(range(len(runs)), key=lambda index: str(runs[index].session))
    parts = columns_of(at_runs(extended.fit, [runs[index] for index in ordered]), extended.groups)
    return [part for _, part in sorted(zip(ordered, parts, strict=True), key=lambda pair: pair[0])]


def _descend(fit: Fit, groups: Sequence[Group], values: Array) -> tuple[Fit, Array, fits.Whitened, tuple[Array, ...]]:
    columns = columns_of(fit, groups)
    elements = fit.model.matrix.size
    data = fit.whitened(columns)
    for _ in range(_STEPS):
        step, covariance = fits.given(data, []).estimate(range(elements + len(values)))
        before, least = (fit, values, data), _chi_square(data) * (1 + _ROUNDING)
        for share in 0.5 ** np.arange(_HALVINGS):
            values = before[1] + share * step[elements:]
            matrix = before[0].model.matrix + (share * step[:elements]).reshape(fit.model.matrix.shape)
            fit = at_model(before[0], model_with(before[0].model, matrix, terms_of(groups, values)))
            data = fit.whitened(columns)
            if _chi_square(data) <= least:
                break
        else:
            fit, values, data = before
            break
        deviations = np.maximum(np.sqrt(np.diag(covariance)), 1e-300)
        if float((np.abs(step) / deviations).max()) < _STILL:
            break
    return fit, values, data, columns


def _bends(groups: Sequence[Group]) -> bool:
    """True if a motion is not linear in an effect beyond small sizes: steering angles act by their tangents."""
    return any(group.effect is not None and group.effect.stage == "steering" for group in groups)


def _chi_square(data: fits.Whitened) -> float:
    return sum(float(np.square(of_run).sum()) for of_run in data.residuals)


def without_runs(data: fits.Whitened, held_out: NDArray[np.bool_]) -> fits.Given:
    """The columns over all runs but those (Z,) that are held out."""
    columns = np.concatenate([data.columns[run] for run in np.flatnonzero(held_out).tolist()])
    return fits.Given(data.information - columns.T @ columns, data.scores[~held_out], np.diag(data.information))


def values_of_other_folds(data: fits.Whitened, index: Sequence[int], folds: NDArray[np.intp]) -> Array:
    """Values (Z, n) of the columns ``index``: for each run, those fitted to the runs of all folds but its own."""
    index = list(index)
    few = data.only(index)
    values = np.zeros((len(folds), len(index)))
    for fold in np.unique(folds):
        values[folds == fold] = without_runs(few, folds == fold).estimate(range(len(index)))[0]  # Eq. (1)
    return values
