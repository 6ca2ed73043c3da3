"""References other than poses in a maximum likelihood fit: residuals and columns in units of their uncertainty.

The errors of a run's references, of the standard deviations s, are those of what measured them and of the odometry,
which wanders by random walks w_p of position and w_h of heading (m and rad per sqrt s). They have the covariance

    C = diag(s^2) + w_p^2 G_p + w_h^2 G_h,                                                                (1)

with the G of Eq. (5) for steps of 1 m and 1 rad per sqrt s. With the columns J of what is fitted, N of the run's start
where it is not known, and P = C^-1 - C^-1 N (N'C^-1 N)^-1 N'C^-1, the walks maximise the restricted likelihood

    -2 ln L = sum_z (ln |C| + ln |N'C^-1 N| + r'P r) + ln |A| - b'A^-1 b,   A = sum J'P J,   b = sum J'P r   (2)

(Patterson and Thompson, Biometrika 58:545, 1971). A gyro's offset is one for the runs of a session: in units of its
standard deviation it is fitted beside J, and its information in A is 1 more. Whitened are L^-1 r and L^-1 J, LL' = C,
less what N explains. With the columns w of the offset, stacked over the runs of a session, these still have the
covariance I + w w', whose symmetric inverse root is

    I - w w' (1 - 1/sqrt(1 + w'w)) / w'w.                                                                 (3)

A variance V_i of the fit, V = A^-1, changes with w^2 by (V K V)_ii, K = sum J'P G P J, and w^2 has the variance 1 / I,
I = 1/2 sum tr (P G)^2 times the share of numbers that the fit leaves, so that V_i has

    2 V_i^2 / sum_w ((V K V)_ii^2 / I)                                                                    (4)

degrees of freedom (Satterthwaite 1946), and any number where no walk is found.

While a robot drives, its odometry errs by small independent steps: of the position, by as much in any direction, and of
the heading. A step dW of the heading at the time s turns all of the path that follows about the place p(s),

    dp(t) = dW J (p(t) - p(s)),   J = (0, -1; 1, 0),                                                      (5)

so that the end of a long straight run is known far worse to the side than ahead. With the derivatives S of the numbers
that a run's references measure by all steps, walks of 1 m and 1 rad per sqrt s give them the covariances S S' dt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from omnibench.data.dataset import Trajectory
from omnibench.fit.noise import GIVEN, ROUNDING, NoiseEstimate, grouped, roots_of
from omnibench.fit.reference_rows import ReferenceBatch, ReferenceRows, reference_rows
from omnibench.fit.trajectory_fit import Whitened
from omnibench.robot.kinematics import Array, interpolated, rotation
from omnibench.robot.odometry import Integration, OdometryBatch

_STEPS = 60  # steps of a run: variances at its end come out to a thousandth
# Shares of the references' own variance at which the search for the odometry's begins: nothing, and as much again.
_STARTS = (0.0, 1.0)
# Times the sigma of positions that do not tell the heading from which they count; chosen: a millionth of their weight
# is none, and the covariance still has a root.
_UNTOLD = 1e3
_MANY = 1e9  # degrees of freedom that stand for any number
_MOST = 1e6  # times the references' own variance: the most that is searched; chosen, odometry a thousand times as bad


def wander_of(batch: ReferenceBatch, matrix: Array, integration: Integration) -> list[tuple[Array, Array]]:
    """Covariances (k, k) of the numbers of each run's references, row by row, for unit walks of position and heading.

    matrix (3, M): whose paths count.
    """
    rows = batch.rows
    reach = [max(float(rows.t1[rows.trajectory == run].max()), 1e-9) for run in range(len(rows.runs))]
    ends = [np.linspace(0.0, until, _STEPS + 1) for until in reach]
    logs = [run.log(stamps) for run, stamps in zip(rows.runs, ends, strict=True)]
    poses = OdometryBatch(logs, integration).poses(matrix[None])[0].reshape(len(logs), _STEPS + 1, 3)
    turns = batch.start_turns(matrix)
    return [_wander_of_run(rows, run, ends[run], poses[run], float(turns[run])) for run in range(len(rows.runs))]


def _wander_of_run(rows: ReferenceRows, run: int, ends: Array, poses: Array, turn: float) -> tuple[Array, Array]:
    """The covariances (k, k) of one run, whose path has poses (_STEPS + 1, 3) at ``ends``, s, turned by ``turn``."""
    times, width = (ends[1:] + ends[:-1]) / 2, float(ends[1])
    path = interpolated(times, ends, poses)
    moved = np.diff(poses[:, :2], axis=0)
    along = moved / np.maximum(np.linalg.norm(moved, axis=1), 1e-12)[:, None]
    by_position, by_heading = [], []
    for row in np.flatnonzero(rows.trajectory == run):
        begin = 0.0 if rows.begins_at_start[row].any() else float(rows.t0[row])
        inside = (times > begin) & (times < rows.t1[row])
        first, last = interpolated(np.array([begin, rows.t1[row]]), ends, poses)
        frame = rotation(-first[2] if rows.lengths[row] == "displacement" else turn)[:2, :2]
        lever = (last[:2] - path[:, :2]) @ rotation(np.pi / 2)[:2, :2].T @ frame.T * inside[:, None]  # Eq. (5)
        nothing = np.zeros((len(times), 2))
        if rows.lengths[row] == "distance":
            by_position.append((along * inside[:, None]).ravel())
            by_heading.append(np.zeros(len(times)))
        elif rows.lengths[row]:
            by_position += [(nothing + frame[axis] * inside[:, None]).ravel() for axis in range(2)]
            by_heading += list(lever.T)
        if rows.measured[row, 2]:
            by_position.append(nothing.ravel())
            by_heading.append(inside.astype(float))
    position, heading = np.array(by_position), np.array(by_heading)
    return width * position @ position.T, width * heading @ heading.T


@dataclass(frozen=True)
class Walk:
    """Random walk of the odometry beside its references: m and rad per sqrt s."""

    position: float = 0.0
    heading: float = 0.0


@dataclass(frozen=True, eq=False)
class ReferenceFit:
    """The references of some runs, and the walk of the odometry beside them.

    wander: G_p and G_h (k, k) of each run, Eq. (1), on the paths of a design.
    """

    runs: tuple[Trajectory, ...]
    batch: ReferenceBatch
    wander: Sequence[tuple[Array, Array]]
    walk: Walk = Walk()

    @classmethod
    def of(cls, runs: Sequence[Trajectory], design: Array, integration: Integration) -> ReferenceFit | None:
        """The references of those runs that have some; None where none has."""
        measured = tuple(run for run in runs if run.references is not None)
        if not measured:
            return None
        batch = ReferenceBatch(reference_rows(measured, "none"), integration)
        return cls(measured, batch, wander_of(batch, design, integration))

    def whitened(self, matrix: Array, slopes: Array | None = None) -> tuple[list[Array], list[Array]]:
        """Whitened residuals (k,) and columns (k, n) of each run, by a matrix (3, M). slopes (3M, n): of the matrix.

        Without slopes there are no columns, n = 0.
        """
        residuals, columns, starts = self._unweighted(matrix, slopes)
        white = []
        for root, *parts, of_start in zip(self._roots, residuals, columns, self._offsets, starts, strict=True):
            values = solve_triangular(root, np.column_stack([*parts, of_start]), lower=True)
            white.append(_without(values, of_start.shape[1]))
        if self._sessions:  # whitened for the offsets of the last columns, without these
            offsets = [of_run[:, -self._sessions :] for of_run in white]
            white = [of_run[:, : -self._sessions] for of_run in white]
            squares = sum(np.square(of_run).sum(axis=0) for of_run in offsets)
            shared = sum(by.T @ of_run for by, of_run in zip(offsets, white, strict=True))
            share = ((1 - 1 / np.sqrt(1 + squares)) / np.maximum(squares, np.finfo(float).tiny))[:, None]  # Eq. (3)
            white = [of_run - by @ (share * shared) for of_run, by in zip(white, offsets, strict=True)]
        return [of_run[:, 0] for of_run in white], [of_run[:, 1:] for of_run in white]

    def chi_square(self, matrix: Array) -> float:
        """Sum of the squared residuals."""
        return float(sum(np.square(of_run).sum() for of_run in self.whitened(matrix)[0]))

    def with_walk(self, matrix: Array, slopes: Array) -> ReferenceFit:
        """The fit with the walk of largest restricted likelihood, Eq. (2), linearised at a matrix (3, M)."""
        residuals, columns, starts = self._unweighted(matrix, slopes)
        # Units of the variances of both walks: those of the references over the diagonal of G_p and G_h, where not 0.
        size = []
        for part in range(2):
            means = []
            for sigmas, of_run in zip(self._sigmas, self.wander, strict=True):
                diagonal = np.diag(of_run[part])
                moved = diagonal > 1e-9
                if moved.any():
                    means.append(float((np.square(sigmas) / np.maximum(diagonal, 1e-9))[moved].mean()))
            size.append(float(np.mean(means)) if means else 0.0)
        driven = [unit > 0 for unit in size]

        def walk_of(shares: Array) -> Walk:
            position, heading = (np.sqrt(max(share, 0.0) * unit) for share, unit in zip(shares, size, strict=True))
            return Walk(float(position), float(heading))

        groups = _Group.of(self._sigmas, self.wander, residuals, self._with_offsets(columns), starts)

        def value(shares: Array) -> float:
            return _minus_log_likelihood(groups, walk_of(shares), self._sessions)

        bounds = [(0.0, _MOST if unit > 0 else 0.0) for unit in size]
        tries = [
            scipy.optimize.minimize(
                value, np.where(driven, start, 0.0), method="L-BFGS-B", bounds=bounds, options={"eps": 1e-4}
            )
            for start in _STARTS
        ]
        return replace(self, walk=walk_of(min(tries, key=lambda answer: float(answer.fun)).x))

    @property
    def noise(self) -> NoiseEstimate:
        """The noise where no run has poses: given, and a walk that was estimated."""
        words = [f"{1e3 * self.walk.position:.2g} mm"] * (self.walk.position > 0)
        words += [f"{np.degrees(self.walk.heading):.2g} deg"] * (self.walk.heading > 0)
        walk = f", and odometry that wanders by {' and '.join(words)} in a second" if words else ""
        return replace(GIVEN, description=f"{GIVEN.description}{walk}")

    def freedom(self, matrix: Array, slopes: Array, covariance: Array) -> Array:
        """Degrees of freedom (n,) of the variances on the diagonal of a covariance (n, n), Eq. (4)."""
        residuals, columns, starts = self._unweighted(matrix, slopes)
        groups = _Group.of(self._sigmas, self.wander, residuals, self._with_offsets(columns), starts)
        # Changes (n + G, n) of the coefficients by the first n columns, with the offsets fitted along.
        size = groups[0].size - self._sessions
        whole = np.sum([group.information(self.walk) for group in groups], axis=0)
        along = np.linalg.solve(whole[size:, size:] + np.eye(self._sessions), whole[size:, :size])
        fixed = np.vstack([np.eye(size), -along])
        rows, fitted = self.batch.rows, len(roots_of(covariance).T)
        numbers = int(rows.measured.sum()) - rows.numbers_of_starts
        free = max(numbers - fitted, 1) / max(numbers, 1)
        reciprocals = np.zeros(len(covariance))
        for part, walk in enumerate((self.walk.position, self.walk.heading)):
            if walk == 0:
                continue
            information, change = 0.0, np.zeros_like(covariance)
            for group in groups:
                of_run, by_columns = group.by_walk(self.walk, part)
                information += free * of_run / 2
                change += fixed.T @ by_columns @ fixed
            moved = np.diag(covariance @ change @ covariance)
            reciprocals += np.square(moved) / max(information, 1e-300)
        doubled = 2 * np.square(np.diag(covariance))
        bounded = reciprocals * _MANY > doubled
        return np.where(bounded, doubled / np.where(bounded, reciprocals, 1.0), _MANY)

    def _unweighted(self, matrix: Array, slopes: Array | None) -> tuple[list[Array], list[Array], list[Array]]:
        """Residuals (k,), columns (k, n) and derivatives (k, 0 or 3) by the start of each run, in m and rad."""
        rows = self.batch.rows
        predicted = self.batch.poses(matrix[None])[0]
        errors = rows.observed - predicted
        jacobian = np.zeros((*errors.shape, 0))
        if slopes is not None:
            jacobian = self.batch.jacobian(matrix).reshape(*errors.shape, -1) @ slopes
        residuals, columns, starts = [], [], []
        for index, of_run in enumerate(self._rows_of_runs):
            measured = rows.measured[of_run]
            residuals.append(errors[of_run][measured])
            columns.append(jacobian[of_run][measured])
            starts.append(rows.start_columns(index, predicted)[measured])
        return residuals, columns, starts

    @cached_property
    def _rows_of_runs(self) -> list[NDArray[np.intp]]:
        """Indices of the rows of each run."""
        return [np.flatnonzero(self.batch.trajectory == index) for index in range(len(self.runs))]

    @cached_property
    def _sigmas(self) -> list[Array]:
        """Standard deviations (k,) that the references of each run have."""
        rows = self.batch.rows
        sigmas = rows.sigmas.copy()
        sigmas[rows.tells_no_heading, :2] *= _UNTOLD  # a heading of the same time keeps its weight
        return [sigmas[of_run][rows.measured[of_run]] for of_run in self._rows_of_runs]

    def _with_offsets(self, columns: Sequence[Array]) -> list[Array]:
        return [np.column_stack(pair) for pair in zip(columns, self._offsets, strict=True)]

    @cached_property
    def _offsets(self) -> list[Array]:
        """Columns (k, G) of the offsets of G gyros, in standard deviations, at the references of each run."""
        rows = self.batch.rows
        # Parts of a recording, cut where samples are missing, are sessions with a number: ``name#2``.
        names = [(run.session or "").partition("#")[0] for run in self.runs]
        number: dict[str, int] = {}
        for name, run in zip(names, self.runs, strict=True):
            if run.references and run.references.rate_sigma:
                number.setdefault(name, len(number))
        offsets: list[Array] = []
        for name, of_run in zip(names, self._rows_of_runs, strict=True):
            sigmas = rows.offset_sigmas[of_run][rows.measured[of_run]]
            columns = np.zeros((len(sigmas), len(number)))
            if name in number:
                columns[:, number[name]] = sigmas
            offsets.append(columns)
        return offsets

    @property
    def _sessions(self) -> int:
        """Number of gyros' offsets, G."""
        return self._offsets[0].shape[1]

    @cached_property
    def _roots(self) -> list[Array]:
        """Lower triangular roots (k, k) of the covariance of each run, Eq. (1)."""
        position, heading = self.walk.position**2, self.walk.heading**2
        return [
            covariance_root(np.diag(np.square(sigmas)) + position * lengths + heading * angles)
            for sigmas, (lengths, angles) in zip(self._sigmas, self.wander, strict=True)
        ]


def covariance_root(covariances: Array) -> Array:
    """Lower triangular roots L (..., k, k) of covariances C = LL' that may be singular to rounding.

    A long walk beside exact references leaves the smallest eigenvalues of C below the rounding of its elements. With
    2 k eps of its diagonal added, which is as much as that rounding, the root exists: scaled to a diagonal of ones, no
    eigenvalue is then below k eps (Higham, Accuracy and Stability of Numerical Algorithms, theorem 10.7).
    """
    size = covariances.shape[-1]
    diagonals = np.diagonal(covariances, axis1=-2, axis2=-1)
    rounding: Array = 2 * size * np.finfo(float).eps * diagonals[..., None] * np.eye(size)
    return np.asarray(np.linalg.cholesky(covariances + rounding))


def _without(values: Array, count: int) -> Array:
    """Values (..., k, n) less what their last ``count`` columns explain, and without these."""
    if not count:
        return values
    others, nuisances = values[..., :-count], values[..., -count:]
    basis, sizes, _ = np.linalg.svd(nuisances, full_matrices=False)
    basis = basis * (sizes > ROUNDING * sizes.max(axis=-1, initial=0.0)[..., None])[..., None, :]
    explained: Array = basis @ (basis.swapaxes(-1, -2) @ others)
    return np.asarray(others - explained)


@dataclass(frozen=True, eq=False)
class _Group:
    """G runs with as many references each: own variances (G, k), wander G_p, G_h (G, k, k) and columns of Eq. (2).

    values (G, k, 1 + n + count): residuals, columns of what is fitted, and the ``count`` columns of unknown starts.
    """

    variances: Array
    lengths: Array
    angles: Array
    values: Array
    count: int

    @classmethod
    def of(
        cls,
        sigmas: Sequence[Array],
        wander: Sequence[tuple[Array, Array]],
        residuals: Sequence[Array],
        columns: Sequence[Array],
        starts: Sequence[Array],
    ) -> list[_Group]:
        """The groups of all runs."""
        groups = []
        for members in grouped([(len(run), start.shape[1]) for run, start in zip(sigmas, starts, strict=True)]):
            values = [np.column_stack([residuals[run], columns[run], starts[run]]) for run in members]
            groups.append(
                cls(
                    np.array([np.square(sigmas[run]) for run in members]),
                    np.array([wander[run][0] for run in members]),
                    np.array([wander[run][1] for run in members]),
                    np.array(values),
                    starts[members[0]].shape[1],
                )
            )
        return groups

    @property
    def size(self) -> int:
        """Number n of columns of what is fitted."""
        return self.values.shape[2] - 1 - self.count

    def information(self, walk: Walk) -> Array:
        """J'P J (n, n)."""
        columns = _without(self.whitened(walk)[0], self.count)[..., 1:]
        return np.asarray(np.einsum("gki,gkj->ij", columns, columns))

    def by_walk(self, walk: Walk, part: int) -> tuple[float, Array]:
        """Sum of tr (P G)^2, and J'P G P J (n, n), G being G_p (part 0) or G_h (1)."""
        white, _, roots = self.whitened(walk)
        shared = np.linalg.solve(roots, (self.lengths, self.angles)[part])
        shared = np.linalg.solve(roots, shared.swapaxes(1, 2))  # L^-1 G L'^-1
        starts = white[..., white.shape[2] - self.count :]
        basis, sizes, _ = np.linalg.svd(starts, full_matrices=False)
        basis = basis * (sizes > ROUNDING * sizes.max(axis=1, initial=0.0)[:, None])[:, None, :]
        free = np.eye(shared.shape[1]) - basis @ basis.swapaxes(1, 2)
        projected = free @ shared @ free
        columns = white[..., 1 : white.shape[2] - self.count]
        return float(np.square(projected).sum()), np.einsum("gki,gkl,glj->ij", columns, projected, columns)

    def whitened(self, walk: Walk) -> tuple[Array, Array, Array]:
        """Values (G, k, ...) whitened under a walk, starts among them, ln |C| (G,), and roots (G, k, k) of C."""
        shared = walk.position**2 * self.lengths + walk.heading**2 * self.angles
        roots = covariance_root(self.variances[..., None] * np.eye(self.variances.shape[1]) + shared)
        logarithms = 2 * np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
        return np.linalg.solve(roots, self.values), logarithms, roots


def _minus_log_likelihood(groups: Sequence[_Group], walk: Walk, offsets: int) -> float:
    """Eq. (2), up to a constant. offsets: number of the last columns that are gyros' offsets."""
    size = groups[0].size
    total, scores = 0.0, np.zeros(size)
    information = np.diag(np.repeat([0.0, 1.0], [size - offsets, offsets]))
    for group in groups:
        white, logarithms, _ = group.whitened(walk)
        total += float(logarithms.sum())
        if group.count:
            sizes = np.linalg.svd(white[..., -group.count :], compute_uv=False)
            significant = sizes > ROUNDING * sizes.max(axis=1, initial=0.0)[:, None]
            total += 2 * float(np.log(sizes[significant]).sum())
        free = _without(white, group.count)
        total += float(np.square(free[..., 0]).sum())
        information += np.einsum("gki,gkj->ij", free[..., 1:], free[..., 1:])
        scores += np.einsum("gki,gk->i", free[..., 1:], free[..., 0])
    eigenvalues, vectors = np.linalg.eigh(information)
    determined = eigenvalues > ROUNDING * eigenvalues.max(initial=0.0)
    along = vectors[:, determined].T @ scores
    return total + float(np.log(eigenvalues[determined]).sum() - np.square(along) @ (1 / eigenvalues[determined]))


def with_references(
    runs: Sequence[Trajectory],
    posed: Sequence[Trajectory],
    by_poses: Whitened | None,
    measured: Sequence[Trajectory],
    by_references: tuple[Sequence[Array], Sequence[Array]],
) -> Whitened:
    """Whitened data of runs, from the poses of some and the references of others; a run may be among both.

    by_poses: of the runs ``posed``. by_references: residuals (k,) and columns (k, n) of the runs ``measured``.
    """
    parts: dict[str, list[tuple[Array, Array]]] = {run.id: [] for run in runs}
    if by_poses is not None:
        for run, values, slopes in zip(posed, by_poses.residuals, by_poses.columns, strict=True):
            parts[run.id].append((values, slopes))
    for run, values, slopes in zip(measured, *by_references, strict=True):
        parts[run.id].append((values, slopes))
    whole = [
        (np.concatenate([values for values, _ in of_run]), np.concatenate([slopes for _, slopes in of_run]))
        for of_run in parts.values()
    ]
    information = np.sum([slopes.T @ slopes for _, slopes in whole], axis=0)
    scores = np.array([slopes.T @ values for values, slopes in whole])
    return Whitened(tuple(values for values, _ in whole), tuple(slopes for _, slopes in whole), information, scores)
