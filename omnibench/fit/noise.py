"""The noise of reference poses: whitening of residuals, and variance components from repetitions.

The errors of one run at its stamps t_i > 0 have the covariance

    white^2 I + walk^2 min(t_i, t_j) + bias^2 1 1^T,

with the same components for x and y, and others for the heading. The covariance of the differences
(r_1, r_2 - r_1, r_3 - r_2, ...) is tridiagonal, so that whitening takes a time proportional to K. A shift of the start
pose is a bias, exactly.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dtbtrs

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.words import noun_for

# Share of the largest eigenvalue or variance below which another one is rounding: far above the rounding of products
# between columns (1e-15), and far below a direction of wheel rates that are a hundredth of the strongest (1e-4).
ROUNDING = 1e-12
# White noise, m or rad, that keeps the covariance regular where there is neither white noise nor walk: a millionth of
# the millimetre that poses are known to. Half of it and twice change nothing (tests/studies/constants_fit.py).
LEAST_WHITE = 1e-9
# Range of the search: logarithms of the components as shares of the residuals' RMS. Half as wide, it moves estimates by
# 1e-4 of their standard deviations at most, twice as wide by 2e-3; either moves these deviations by 0.1 %
# (tests/studies/constants_fit.py).
_LOGARITHMS = (np.log(1e-4), np.log(1e2))
# Change of twice the log-likelihood below which a component is set to zero: nothing beside 2.7, a test at 5 % (Self
# and Liang 1987). Half of it and twice change nothing (tests/studies/constants_fit.py).
_NO_LOSS = 1e-3
_WIDE = 200  # columns from which on a row at a time is faster than LAPACK, which takes every column by itself
_COORDINATES = (("position", slice(0, 2)), ("heading", slice(2, 3)))
# First guess of the noise, replaced after one fit: 1 cm or 0.01 rad, and as much again in a second. Half of it and
# twice move estimates by 0.002 of their standard deviations at most (tests/studies/constants_fit.py).
FIRST_NOISE = Noise(pose_position=0.01, pose_heading=0.01, walk_position=0.01, walk_heading=0.01)


def roots_of(information: Array) -> Array:
    """Roots R (n, d) with R'AR = 1 of a positive semi-definite matrix A (n, n).

    Directions whose eigenvalue is rounding are left out: R R' is the pseudo-inverse of A.
    """
    values, vectors = np.linalg.eigh(information)
    significant = values > ROUNDING * values.max(initial=0.0)
    return np.asarray(vectors[:, significant] / np.sqrt(values[significant]))


@dataclass(frozen=True, eq=False)
class Difference:
    """A linear combination of runs that is distributed as the noise of one run.

    stamps (K,): s. values (K, 3): m, m, rad. slopes (K, 3, m): mean over these runs of the poses' derivatives by m
    nuisances.
    """

    stamps: Array
    values: Array
    slopes: Array


@dataclass(frozen=True, eq=False)
class Differences:
    """Independent differences, their source, and in words from how many runs and commands they come."""

    each: tuple[Difference, ...]
    source: Literal["repetitions", "within runs"]
    description: str

    @cached_property
    def by_stamps(self) -> list[tuple[Array, Array, Array]]:
        """Differences at the same stamps together: stamps (K,), values (K, 3, n) and slopes (K, 3, n, m) of n."""
        groups = grouped([difference.stamps.tobytes() for difference in self.each])
        return [
            (
                self.each[members[0]].stamps,
                np.stack([self.each[index].values for index in members], axis=-1),
                np.stack([self.each[index].slopes for index in members], axis=2),
            )
            for members in groups
        ]


def differences_between_repetitions(
    trajectories: Sequence[Trajectory], residuals: Sequence[Array], slopes: Sequence[Array] | None = None
) -> Differences:
    """Independent differences of residuals (K, 3), odometry minus reference or the reverse, at all pose_times[1:].

    Repetitions are those of ``repetitions_of_commands``. Runs with different stamps are compared at the nearest ones;
    interpolation would reduce white noise. Without repeated commands the residuals themselves stand in for the
    differences. slopes (K, 3, m): derivatives of every trajectory's poses by its nuisances, averaged alongside; default
    none.
    """
    slopes = [np.zeros((*residual.shape, 0)) for residual in residuals] if slopes is None else slopes
    runs = [
        (run.pose_times[1:], np.concatenate([residual[..., None], columns], axis=-1))
        for run, residual, columns in zip(trajectories, residuals, slopes, strict=True)
    ]
    repeated = repetitions_of_commands(trajectories)
    measured = [[runs[index] for index in members if len(runs[index][0])] for members in repeated.groups]
    if contrasts := tuple(contrast for members in measured for contrast in _contrasts(members)):
        words = (
            f"{len(contrasts)} independent {noun_for(len(contrasts), 'difference')} between repetitions "
            f"({repeated.description}, {repeated.words})"
        )
        return Differences(contrasts, "repetitions", words)
    whole = tuple(Difference(stamps, values[..., 0], values[..., 1:]) for stamps, values in runs if len(stamps))
    words = (
        f"the residuals within {len(whole)} {noun_for(len(whole), 'run')}: {repeated.words}, so what the model "
        "cannot express counts as noise"
    )
    return Differences(whole, "within runs", words)


@dataclass(frozen=True)
class Repetitions:
    """Groups of run indices, one for every command driven more than once within one session.

    commands: number of different commands. words: from where the repetitions are, or why there are none.
    """

    groups: tuple[tuple[int, ...], ...]
    commands: int
    words: str

    @property
    def description(self) -> str:
        return f"{sum(map(len, self.groups))} runs of {self.commands} {noun_for(self.commands, 'command')}"


def repetitions_of_commands(trajectories: Sequence[Trajectory]) -> Repetitions:
    """The repetitions within sessions, of one split or, if none repeats a command, of both. Runs need a command.

    Runs of different sessions are no repetitions: what differs between the sessions would count as noise. Where
    sessions are not known, those of a split are taken for one.
    """
    of_splits = [(run.split, run.session, run.command) for run in trajectories]
    of_sessions = [(run.split if run.session is None else "", run.session, run.command) for run in trajectories]
    known = any(run.session is not None for run in trajectories)
    for keys, words in (
        (of_splits, f"each within one {'session' if known else 'split'}"),
        (of_sessions, "each within one session, across both splits, so that the noise has seen validation runs"),
    ):
        repeated = [group for group in grouped(keys) if len(group) > 1 and trajectories[group[0]].command is not None]
        if repeated:
            return Repetitions(tuple(repeated), len({trajectories[group[0]].command for group in repeated}), words)
    driven = [run.command for run in trajectories if run.command is not None]
    alone = len(set(driven)) == len(driven) or not known
    return Repetitions((), 0, "no command is repeated" if alone else "no session repeats a command")


def repeating_runs(runs: Sequence[Trajectory], others: Sequence[Trajectory]) -> list[Trajectory]:
    """The other runs that repeat a command of the runs in the same session, where the runs themselves repeat none.

    An other run counts if it has all that was recorded of the runs.
    """
    if repetitions_of_commands(runs).groups:
        return []
    driven = {(run.session, run.command) for run in runs if None not in (run.session, run.command)}
    needed = [name for name in ("angles", "started_at") if any(getattr(run, name) is not None for run in runs)]
    return [
        run
        for run in others
        if (run.session, run.command) in driven and all(getattr(run, name) is not None for name in needed)
    ]


def grouped(keys: Sequence[Hashable]) -> list[tuple[int, ...]]:
    """Indices of equal keys, in the order in which the keys first come."""
    groups: dict[Hashable, list[int]] = {}
    for index, key in enumerate(keys):
        groups.setdefault(key, []).append(index)
    return [tuple(members) for members in groups.values()]


def _contrasts(runs: list[tuple[Array, Array]]) -> Iterator[Difference]:
    """Helmert contrasts of n runs (stamps, values): n - 1 independent ones, each with the noise of one run.

    Each compares a run with the mean of those that last longer, so that no run is cut to the shortest of all.
    """
    runs = sorted(runs, key=lambda run: -run[0][-1])
    # Stamps that runs share, and the sum of these runs' values: many runs have few different stamps.
    sums: dict[bytes, tuple[Array, Array]] = {}
    for count, (stamps, values) in enumerate(runs):
        key = stamps.tobytes()
        if count:
            grid, chosen = _common([*(times for times, _ in sums.values()), stamps])
            before = np.sum([total[index] for (_, total), index in zip(sums.values(), chosen, strict=False)], axis=0)
            now = values[chosen[-1]]
            if len(grid):
                contrast = (before[..., 0] / count - now[..., 0]) * np.sqrt(count / (count + 1))
                yield Difference(grid, contrast, (before + now)[..., 1:] / (count + 1))
        sums[key] = (stamps, sums[key][1] + values if key in sums else values)


def common_poses(runs: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Stamps (K,) of the run with the fewest, and values (n, K, ...) of all runs at their nearest stamps.

    Interpolating would average two poses, which have less white noise than one.
    """
    grid, chosen = _common([stamps for stamps, _ in runs])
    return grid, np.array([values[index] for (_, values), index in zip(runs, chosen, strict=True)])


def _common(stamps: Sequence[Array]) -> tuple[Array, list[NDArray[np.intp]]]:
    """The stamps that the runs with such stamps have in common, and the index of the nearest one in each."""
    end = min(times[-1] for times in stamps)
    coarsest = min(stamps, key=lambda times: int((times <= end).sum()))
    grid = coarsest[coarsest <= end]
    chosen = [np.searchsorted((times[1:] + times[:-1]) / 2, grid) for times in stamps]  # between the middles
    # A pose is used for one stamp only: using it twice would correlate the white noise.
    fresh = (np.diff(chosen, axis=1, prepend=-1) > 0).all(axis=0)
    return grid[fresh], [index[fresh] for index in chosen]


class Whitener:
    """Turns the pose residuals of one run into independent ones of unit variance, exactly, in O(K).

    stamps (K,): s, > 0, increasing; the start pose at t = 0 is not among them. log_determinant: of the covariance of
    all 3K residuals. Without white noise and walk the covariance is singular: white noise of 1e-9 (m, rad) stands in.
    """

    log_determinant: float

    def __init__(self, noise: Noise, stamps: Array) -> None:
        stamps = np.asarray(stamps, dtype=float)
        steps = np.diff(stamps, prepend=0.0)
        if stamps.ndim != 1 or len(stamps) == 0 or not (steps > 0).all():
            raise ValueError("stamps must be increasing and > 0")
        self._position = _Factor(noise.pose_position, noise.walk_position, noise.bias_position, steps)
        self._heading = _Factor(noise.pose_heading, noise.walk_heading, noise.bias_heading, steps)
        self.log_determinant = 2 * self._position.log_determinant + self._heading.log_determinant

    def __call__(self, residuals: Array) -> Array:
        """Whitened residuals, or derivatives of residuals: (K, 3) or (K, 3, n) to the same shape."""
        return self.of_differences(_differences(residuals).reshape(residuals.shape))

    def of_differences(self, differences: Array) -> Array:
        """Whitened residuals (K, 3) or (K, 3, n) by their differences from one stamp to the next, the first from 0.

        These are overwritten.
        """
        flat = differences.reshape(len(differences), -1)
        split = 2 * flat.shape[1] // 3
        for factor, part in ((self._position, flat[:, :split]), (self._heading, flat[:, split:])):
            factor.whiten_in_place(part)
        return differences

    def transposed(self, white: Array) -> Array:
        """The transposed whitening of whitened values (K, 3, n): the inverse covariance of differences times these."""
        parts = [self._position.transposed(white[:, :2]), self._heading.transposed(white[:, 2:])]
        return np.concatenate(parts, axis=1)

    @property
    def traces(self) -> Array:
        """Derivatives (6,) of ``log_determinant`` by the variances white, walk, bias of positions and of headings."""
        return np.concatenate([2 * self._position.traces(), self._heading.traces()])

    def forms(self, values: Array) -> Array:
        """Quadratic forms (6,) of values (K, 3, n), summed over n, of the derivatives of the covariance by these."""
        return np.concatenate([self._position.forms(values[:, :2]), self._heading.forms(values[:, 2:])])

    def left_out(self, residuals: Array) -> tuple[Array, Array]:
        """Every error (K, 3) less what the run's others say of it, and the variances (K, 3) of that difference.

        With the inverse C^-1 of a coordinate's covariance, (C^-1 r)_s / (C^-1)_ss and 1 / (C^-1)_ss.
        """
        errors = np.empty_like(residuals)
        variances = np.empty_like(residuals)
        for factor, columns in ((self._position, slice(0, 2)), (self._heading, slice(2, 3))):
            errors[:, columns], of_each = factor.left_out(residuals[:, columns])
            variances[:, columns] = of_each[:, None]
        return errors, variances


def whiteners(noise: Noise, stamps: Sequence[Array]) -> list[Whitener]:
    """The whitening of runs with stamps (K,); those with the same stamps share theirs."""
    made = {times.tobytes(): times for times in stamps}
    whitener_of = {key: Whitener(noise, times) for key, times in made.items()}
    return [whitener_of[times.tobytes()] for times in stamps]


def is_near(first: Mapping[str, float], second: Mapping[str, float], share: float) -> bool:
    """True if no standard deviation differs by more than a share of the largest one."""
    ours, theirs = np.array(list(first.values())), np.array(list(second.values()))
    return bool((np.abs(ours - theirs) <= share * np.maximum(ours, theirs).max()).all())


class _Factor:
    """The Cholesky factor of one coordinate's covariance, as a lower bidiagonal matrix of the differences.

    steps (K,): s from each stamp to the next, the first from t = 0.
    """

    def __init__(self, white: float, walk: float, bias: float, steps: Array) -> None:
        walked = walk**2 * (steps[1:] if bias else steps)
        self._steps, self._singular = steps, white**2 + walked.min(initial=np.inf) < LEAST_WHITE**2
        if self._singular:
            white = LEAST_WHITE
        bands = np.empty((2, len(steps)), order="F")
        bands[0] = 2 * white**2 + walk**2 * steps
        bands[0, 0] += bias**2 - white**2
        bands[1] = -(white**2)
        self._factor, failed = dpbtrf(bands, lower=1, overwrite_ab=1)
        if failed:
            raise DataError("the noise or the stamps of a run are not finite; omnibench check DATASET says more")
        self.log_determinant = float(2 * np.log(self._factor[0]).sum())

    def whiten(self, differences: Array) -> Array:
        """Independent values (K, n) of differences (K, n) between successive residuals, the first from 0."""
        whitened, _ = dtbtrs(self._factor, differences, uplo="L")
        return whitened

    def whiten_in_place(self, differences: Array) -> None:
        """Replace differences (K, n) by what ``whiten`` makes of them."""
        if not differences.size:
            return  # LAPACK would write beyond the end of nothing
        if differences.shape[1] < _WIDE:
            differences[:] = self.whiten(differences)
            return
        diagonal, below = self._factor
        differences[0] /= diagonal[0]
        for row in range(1, len(differences)):
            differences[row] -= below[row - 1] * differences[row - 1]
            differences[row] /= diagonal[row]

    def transposed(self, white: Array) -> Array:
        """The inverse covariance of the differences times what was whitened to (K, ...)."""
        solved, _ = dtbtrs(self._factor, white.reshape(len(white), -1), uplo="L", trans="T")
        return np.asarray(solved).reshape(white.shape)

    def traces(self) -> Array:
        """Derivatives (3,) of the log determinant by the variances of white noise, walk and bias."""
        inner, beside = self._inverse_bands()
        white = 2 * inner.sum() - inner[0] - 2 * beside.sum()
        return np.array([0.0 if self._singular else white, self._steps @ inner, inner[0]])

    def forms(self, values: Array) -> Array:
        """Quadratic forms (3,) of values (K, ...), summed, of the covariance's derivatives by the same variances."""
        square = np.square(values).reshape(len(values), -1).sum(axis=1)
        white = np.square(values[:-1] - values[1:]).sum() + square[-1]
        return np.array([0.0 if self._singular else white, self._steps @ square, square[0]])

    def left_out(self, residuals: Array) -> tuple[Array, Array]:
        """Errors (K, n) less what the others say of them, and their variances (K,); see Whitener."""
        solved = self.transposed(self.whiten(_differences(residuals)))  # by the inverse covariance of the differences
        solved[:-1] -= solved[1:]
        inner, beside = self._inverse_bands()
        inner[:-1] += inner[1:] - 2 * beside
        return solved / inner[:, None], 1 / inner

    def _inverse_bands(self) -> tuple[Array, Array]:
        """Diagonal (K,) and upper diagonal (K - 1,) of the inverse of the covariance C of the differences.

        With the pivots p of its factor from the first row on and q from the last, (C^-1)_ii = 1 / (p_i + q_i - C_ii)
        (Meurant, SIAM J. Matrix Anal. Appl. 13:707, 1992).
        """
        diagonal, below = self._factor
        pivots = np.square(diagonal)
        on, off = pivots.copy(), diagonal[:-1] * below[:-1]
        on[1:] += np.square(below[:-1])
        backward, _ = dpbtrf(np.stack([on[::-1], np.append(off[::-1], 0.0)]), lower=1)
        inner = 1 / (pivots + np.square(backward[0])[::-1] - on)
        return inner, -below[:-1] / diagonal[:-1] * inner[1:]


def _differences(residuals: Array) -> Array:
    """Differences (K, n) of residuals (K, ...) from one stamp to the next, the first from 0."""
    flat = residuals.reshape(len(residuals), -1)
    differences = flat.copy()
    differences[1:] -= flat[:-1]
    return differences


@dataclass(frozen=True)
class NoiseEstimate:
    """A noise model and its source.

    degrees_of_freedom: number of independent differences between runs, or of runs if no command is repeated. source
    ``given``: there are no poses, and references of other kinds say how exact they are.
    """

    noise: Noise
    source: Literal["repetitions", "within runs", "given"]
    degrees_of_freedom: int
    description: str


GIVEN = NoiseEstimate(Noise(), "given", 1_000_000, "the standard deviations that the references have")


def estimate_noise(differences: Differences, near: Noise | None = None) -> NoiseEstimate:
    """Variance components by restricted maximum likelihood from the differences between repetitions of a command.

    The residuals are those of any decent fit, since errors of the model are the same in all repetitions and cancel.
    Without repetitions the residuals themselves count as noise, and the estimate says so. near: an earlier estimate,
    where the search starts; without one it starts from several points. DataError without differences.
    """
    if not differences.each:
        raise DataError("no trajectory has a reference pose after its start; the noise cannot be estimated")
    # Position and heading are independent.
    components: dict[str, float] = {}
    for name, columns in _COORDINATES:
        samples = [(stamps, values[:, columns].reshape(len(stamps), -1)) for stamps, values, _ in differences.by_stamps]
        names = [f"{kind}_{name}" for kind in ("pose", "walk", "bias")]
        start = None if near is None else np.array([getattr(near, component) for component in names])
        components |= dict(zip(names, _most_likely(samples, start), strict=True))
    return NoiseEstimate(Noise(**components), differences.source, len(differences.each), differences.description)


def _most_likely(groups: list[tuple[Array, Array]], near: Array | None) -> tuple[float, float, float]:
    """White noise, walk and bias of largest likelihood for samples (K, n) at stamps (K,); near (3,): first guess."""
    count = sum(values.size for _, values in groups)
    size = float(np.sqrt(sum(np.square(values).sum() for _, values in groups) / count))
    if size < LEAST_WHITE:
        return 0.0, 0.0, 0.0
    longest = max(float(stamps[-1]) for stamps, _ in groups)
    units = size * np.array([1.0, longest**-0.5, 1.0])

    prepared = []
    for stamps, values in groups:
        differences = _differences(values)  # D (K, n): all that the likelihood needs is D D', of at most K columns
        wide = differences.shape[1] > len(differences)
        condensed = np.linalg.qr(differences.T).R.T if wide else np.asfortranarray(differences)
        prepared.append((np.diff(stamps, prepend=0.0), values.shape[1], condensed))

    def negative_log_likelihood(components: Array) -> float:
        """Twice the negative log-likelihood for each value, up to a constant."""
        white, walk, bias = components
        total = 0.0
        for steps, number, differences in prepared:
            factor = _Factor(white, walk, bias, steps)
            total += number * factor.log_determinant + float(np.square(factor.whiten(differences)).sum())
        return total / count

    if near is not None and near.any():
        starts = np.log(np.clip(near / units, 0.05, 50.0))[None]
    else:  # the likelihood may have a local maximum for each component that could dominate
        starts = np.log(0.1 + 0.6 * np.eye(3))
    tries = [
        scipy.optimize.minimize(
            lambda logarithms: negative_log_likelihood(units * np.exp(logarithms)),
            start,
            method="L-BFGS-B",
            bounds=[_LOGARITHMS] * 3,
            options={"eps": 1e-5, "ftol": 1e-8},
        )
        for start in starts
    ]
    best = units * np.exp(min(tries, key=lambda attempt: float(attempt.fun)).x)
    for index in np.argsort(best / units):  # try zero, which a logarithmic scale never reaches
        without = np.where(np.arange(3) == index, 0.0, best)
        if count * (negative_log_likelihood(without) - negative_log_likelihood(best)) < _NO_LOSS:
            best = without
    white, walk, bias = best
    return float(white), float(walk), float(bias)
