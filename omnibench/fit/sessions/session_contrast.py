"""Contrasts between sessions: a deviation that the runs of one share, tested by the scatter of its repetitions.

Runs z of a command c are compared at stamps that they have in common, in the frames of their starts. With r_z the
residuals of a run by any decent model (reference minus odometry), C their covariance by the noise and the nuisances,
and X_c the mean derivatives of the command's poses by the elements of the matrix, a run has the score and information

    s_z = X_c' C^-1 r_z,    H_z = X_c' C^-1 X_c.                                                          (1)

What the model lacks is alike in all runs of a command, and so is its part in their scores. It cancels between a
session B and the others, A, where these drive the command, too, n_A and n_B times: with weights

    g_z = n_A / (n_A + n_B) in B,    g_z = -n_B / (n_A + n_B) in A,                                       (2)

a matrix that differs by delta in B gives the sum over the runs of all such commands

    S = sum_z g_z s_z,    E S = J delta,    J = sum_z g_z^2 H_z.                                          (3)

S has the covariance J by the noise model, the uncertainty of A being in it. The test rests on the scatter of the
repetitions instead, which holds whatever the noise is, its part that a run shares included. With R (n, d) from the
directions T in which delta is looked for, R'JR = 1, and groups k of n_k repetitions of a command in a session,

    t = R'S,    V = sum_k n_k / (n_k - 1) sum_(z in k) (u_z - mean_k)(u_z - mean_k)',    u_z = g_z R's_z. (4)

With the expectations E_k = s^2 sum_(z in k) g_z^2 R'H_zR of the terms of V, s^2 the scatter of the session's
repetitions in units of the noise model's, and E their sum, V has the degrees of freedom (Nel and Van der Merwe 1986)

    v = (tr E^2 + (tr E)^2) / sum_k (tr E_k^2 + (tr E_k)^2) / (n_k - 1),                                  (5)

and Hotelling's statistic where the sessions do not differ the distribution

    t' V^-1 t (v - d + 1) / (v d) ~ F(d, v - d + 1).                                                      (6)

A run that its session does not repeat has the terms of the groups of its command in V, by shares n_k - 1 and in
proportion to the noise model's E_k, and adds its E_k to theirs in (5). A command that no session repeats is left out:
nothing says how much its runs scatter.

Where the validation split drives no command of the training, J and S come from the estimates of both, with
I_A = sum of H_z in A, in which whatever the model lacks counts, too:

    J = (I_A^-1 + I_B^-1)^-1,    u_z = R'J I_B^-1 s_z in B,    u_z = -R'J I_A^-1 s_z in A.                (7)

A deviation then says that sessions or commands differ, and not which. A run of a command that no session repeats has
the term E_k, by the s of its session's repetitions, or of all where it has none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.least_squares.noise import whiteners
from omnibench.fit.least_squares.repetitions import common_poses, grouped
from omnibench.fit.least_squares.roots import roots_of
from omnibench.fit.least_squares.trajectory_fit import TrajectoryFit
from omnibench.fit.least_squares.usable_runs import in_start_frames
from omnibench.fit.least_squares.whitened import whitened
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

# Share of a command's median duration that a run must last: a shorter one would cut all others (chosen).
_WHOLE = 0.5
# Share of the largest singular value below which a direction is rounding, and of the noise model's variance below which
# the scatter is: repetitions that agree exactly (trajectory_covariance.py).
_ROUNDING = 1e-6


def sessions_of(runs: Sequence[Trajectory]) -> tuple[str, ...]:
    """The session of each run, or its split where the session of any run is not known."""
    if all(run.session is not None for run in runs):
        return tuple(str(run.session) for run in runs)
    return tuple(run.split for run in runs)


@dataclass(frozen=True, eq=False)
class SessionScores:
    """Scores (Z, n) and information (Z, n, n) of runs, Eq. (1).

    sessions: the runs' sessions. matrix (3, N): of the model. wheels: names of its N wheels.
    """

    runs: tuple[Trajectory, ...]
    sessions: tuple[str, ...]
    scores: Array
    information: Array
    matrix: Array
    wheels: tuple[str, ...]

    @classmethod
    def of(cls, fit: TrajectoryFit, noise: Noise) -> SessionScores:
        """The scores of the runs that have poses in common with the others of their command. DataError: none has."""
        elements = fit.model.matrix.size
        values = [
            np.concatenate([residuals[..., None], *slopes], axis=-1)
            for residuals, *slopes in zip(
                fit.nuisance_free_residuals, fit.matrix_jacobian(), fit.estimated_slopes, strict=True
            )
        ]
        values = in_start_frames(fit.runs, values)
        kept: list[int] = []
        parts: list[tuple[Array, Array, Array]] = []  # residuals, columns, slopes by nuisances
        stamps_of: list[Array] = []
        for members in _whole_runs(fit.runs):
            stamps, poses = common_poses([(fit.runs[index].pose_times[1:], values[index]) for index in members])
            if len(stamps):
                columns = poses.mean(axis=0)[..., 1:]
                kept += members
                stamps_of += [stamps] * len(members)
                parts += [(of_run[..., 0], columns[..., :elements], columns[..., elements:]) for of_run in poses]
        deviations = fit.nuisances.deviations[fit.nuisances.estimated]
        if not parts:
            raise DataError("the runs of a command have no reference poses at common times")
        residuals, fitted, slopes = zip(*parts, strict=True)
        data = whitened(residuals, fitted, whiteners(noise, stamps_of), slopes, deviations)
        names = sessions_of(fit.runs)
        return cls(
            tuple(fit.runs[index] for index in kept),
            tuple(names[index] for index in kept),
            data.scores,
            data.information_of_runs,
            fit.model.matrix,
            fit.model.robot.drive.names,
        )

    @property
    def comparable(self) -> list[str]:
        """The sessions that share a command with another one, those with runs of the validation split first."""
        held_out = {name for name, run in zip(self.sessions, self.runs, strict=True) if run.split == "validation"}
        names = [name for name in dict.fromkeys(self.sessions) if self.between(name).runs]
        return sorted(names, key=lambda name: name not in held_out)

    def between(self, session: str) -> Contrast:
        """The contrast between a session and the others, Eq. (2)."""
        weights = np.zeros(len(self.runs))
        for members in grouped([run.command for run in self.runs]):
            driven = [self.sessions[index] for index in members]
            inside = np.array(driven) == session
            if inside.any() and not inside.all() and len(set(driven)) < len(driven):
                share = np.where(inside, (~inside).sum(), -inside.sum()) / len(inside)
                weights[list(members)] = share
        used = np.flatnonzero(weights)
        factors = weights[used, None, None] * np.eye(self.scores.shape[1])
        return self._contrast(used, factors)

    def between_splits(self) -> Contrast:
        """The contrast between the estimates from both splits, Eq. (7)."""
        late = np.array([run.split == "validation" for run in self.runs])
        inverse = [np.linalg.pinv(self.information[part].sum(axis=0), hermitian=True) for part in (~late, late)]
        whole = np.linalg.pinv(inverse[0] + inverse[1], hermitian=True)
        factors = np.where(late[:, None, None], whole @ inverse[1], -whole @ inverse[0])
        return self._contrast(np.arange(len(late)), factors)

    def without(self, session: str) -> SessionScores:
        """The scores of all other sessions."""
        kept = [index for index, name in enumerate(self.sessions) if name != session]
        return replace(
            self,
            runs=tuple(self.runs[index] for index in kept),
            sessions=tuple(self.sessions[index] for index in kept),
            scores=self.scores[kept],
            information=self.information[kept],
        )

    def _contrast(self, used: NDArray[np.intp], factors: Array) -> Contrast:
        pulls = np.einsum("zij,zj->zi", factors, self.scores[used])
        spreads = factors @ self.information[used] @ factors.swapaxes(1, 2)
        runs = [self.runs[index] for index in used]
        return Contrast(pulls, spreads, runs, [self.sessions[index] for index in used])


def _whole_runs(runs: Sequence[Trajectory]) -> Iterator[list[int]]:
    """The runs of each command, but those that were cut short."""
    for members in grouped([run.command for run in runs]):
        if runs[members[0]].command is not None:
            ends = np.array([runs[index].pose_times[-1] for index in members])
            yield [index for index, end in zip(members, ends, strict=True) if end >= _WHOLE * np.median(ends)]


@dataclass(frozen=True, eq=False)
class Contrast:
    """Weighted scores (Z, n) of runs, whose sum is S, their covariances (Z, n, n) by the noise, the runs' sessions."""

    pulls: Array
    spreads: Array
    runs: list[Trajectory]
    sessions: list[str]

    @property
    def information(self) -> Array:
        """J (n, n), Eq. (3)."""
        total: Array = self.spreads.sum(axis=0)
        return total

    def roots(self, directions: Array) -> Array:
        """R (n, d) of directions T (n, q), Eq. (4)."""
        return directions @ roots_of(directions.T @ self.information @ directions)

    def beyond(self, directions: Array) -> Array:
        """R (n, d) of all directions that are independent of T (n, q)."""
        roots = roots_of(self.information)
        taken = roots.T @ self.information @ directions
        basis, sizes, _ = np.linalg.svd(taken)
        rank = int((sizes > _ROUNDING * sizes.max(initial=0.0)).sum())
        rest: Array = roots @ basis[:, rank:]
        return rest

    def chance(self, roots: Array) -> tuple[float, float]:
        """The chance of t, Eq. (6), and t' V^-1 t; 1 where the repetitions are too few for so many directions."""
        total, scatter, freedom = self.scatter(roots)
        size = len(total)
        if not size or freedom - size + 1 < 1:
            return 1.0, 0.0
        statistic = float(total @ np.linalg.solve(scatter, total))
        ratio = statistic * (freedom - size + 1) / (freedom * size)
        return float(fdtrc(size, freedom - size + 1, ratio)), statistic

    def scatter(self, roots: Array) -> tuple[Array, Array, float]:
        """t (d,), its covariance V (d, d) by the scatter of repetitions, and its degrees of freedom, Eq. (4), (5)."""
        pulls = self.pulls @ roots
        groups = grouped([(name, run.command) for name, run in zip(self.sessions, self.runs, strict=True)])
        counts = np.array([len(members) for members in groups], dtype=float)
        expected = np.array([roots.T @ self.spreads[list(members)].sum(axis=0) @ roots for members in groups])
        apart = [pulls[list(members)] - pulls[list(members)].mean(axis=0) for members in groups]
        seen = np.array([count / max(count - 1, 1) * each.T @ each for count, each in zip(counts, apart, strict=True)])
        of_session, of_command = (
            np.array([names[members[0]] for members in groups], dtype=object)
            for names in (self.sessions, [run.command for run in self.runs])
        )
        repeated = counts > 1
        if not repeated.any():
            return pulls.sum(axis=0), seen.sum(axis=0), 0.0
        traces = [np.trace(each, axis1=1, axis2=2) * (counts - 1) for each in (seen, expected)]
        plain = np.trace(expected, axis1=1, axis2=2)
        for name in dict.fromkeys(self.sessions):  # s^2 of each session, or of all where one repeats nothing
            inside = of_session == name
            known = inside if repeated[inside].any() else repeated
            expected[inside] *= max(traces[0][known].sum() / max(traces[1][known].sum(), 1e-300), _ROUNDING)
        shares = _shares(counts, of_command, of_session)
        seen_units, expected_units = (each / np.maximum(plain, 1e-300)[:, None, None] for each in (seen, expected))
        for index in np.flatnonzero(~repeated):
            told = np.flatnonzero(shares[index])
            if of_command[told[0]] == of_command[index]:  # with their s: that of its session may rest on two runs
                seen[index] = plain[index] * np.tensordot(shares[index], seen_units, 1)
                expected[index] = plain[index] * np.tensordot(shares[index], expected_units, 1)
            else:
                seen[index] = expected[index]
        known_by = expected + np.tensordot(shares.T, expected, 1)
        freedom = _size(expected.sum(axis=0)) / np.sum(
            [_size(each) / (count - 1) for each, count in zip(known_by[repeated], counts[repeated], strict=True)]
        )
        return pulls.sum(axis=0), seen.sum(axis=0) + _ROUNDING * np.eye(len(roots.T)), float(freedom)


def _shares(counts: Array, of_command: NDArray[np.object_], of_session: NDArray[np.object_]) -> Array:
    """Shares (K, K) of the groups that say how much the run of a group without repetitions, a row, scatters.

    Those of its command do, else those of its session, else all.
    """
    shares = np.zeros((len(counts), len(counts)))
    for index in np.flatnonzero(counts == 1):
        alike = (names == names[index] for names in (of_command, of_session, np.ones(len(counts))))
        told = next(each for each in ((counts > 1) & those for those in alike) if each.any())
        shares[index, told] = (counts[told] - 1) / (counts[told] - 1).sum()
    return shares


def _size(covariance: Array) -> float:
    """tr A^2 + (tr A)^2, Eq. (5)."""
    return float(np.square(covariance).sum() + np.trace(covariance) ** 2)
