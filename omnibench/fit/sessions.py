"""Sessions that differ, and by what: the radii of the wheels, one of them, or more than radii.

A deviation that the runs of a session share is tested by the scatter of its repetitions. Runs z of a command c are
compared at stamps that they have in common, in the frames of their starts. With r_z the residuals of a run by any
decent model (reference minus odometry), C their covariance by the noise and the nuisances, and X_c the mean derivatives
of the command's poses by the elements of the matrix, a run has the score and information

    s_z = X_c' C^-1 r_z,    H_z = X_c' C^-1 X_c.                                                          (1)

What the model lacks is alike in all runs of a command, and so is its part in their scores. It cancels between a session
B and the others, A, where these drive the command, too, n_A and n_B times: with weights

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

Where the validation split drives no command of the training, J and S come from the estimates of both, with I_A = sum of
H_z in A, in which whatever the model lacks counts, too:

    J = (I_A^-1 + I_B^-1)^-1,    u_z = R'J I_B^-1 s_z in B,    u_z = -R'J I_A^-1 s_z in A.                (7)

A deviation then says that sessions or commands differ, and not which. A run of a command that no session repeats has
the term E_k, by the s of its session's repetitions, or of all where it has none.

Looked for are a common change of all radii (d = 1), one of each (d = N) and any change of the matrix (d = 3N); the
least chance counts, times three and times the number of sessions that are tested (Bonferroni). The session that differs
most is taken out, and the others are tested again.

Derivatives are at a matrix that is fitted to all runs, to a share p of which a session's change belongs. Relative to
that matrix a radius changes by u, and relative to that of the other sessions by

    k = u / (1 - p u).                                                                                    (8)
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, stdtrit

from omnibench.data.dataset import Trajectory
from omnibench.data.stored import drawn_runs
from omnibench.errors import DataError
from omnibench.fit import trajectory_fit
from omnibench.fit.noise import common_poses, grouped, roots_of, whiteners
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.physical import INTERVAL
from omnibench.words import plural

# Share of a command's median duration that a run must last: a shorter one would cut all others (chosen).
_WHOLE = 0.5
# Share of the largest singular value below which a direction is rounding, and of the noise model's variance below which
# the scatter is: repetitions that agree exactly.
_ROUNDING = 1e-6
# Chance at which sessions are said to differ that do not, over all that is tested: strict, as one such answer in a
# hundred is too many, and enough to see 0.5 % of one radius in 60 + 60 runs (tests/studies/session_study.py).
CHANCE = 0.001
# Level of the tests for nuisances, that of discover (discover/fit.py).
_NUISANCES = 1e-4
# Chance of what is left from which on a change of radii counts as all that differs: chosen; words alone hang on it.
_ALL = 0.01
# Chance below which no figure is printed but "< 10⁻⁹": tails that thin are not those of real noise (chosen).
_LEAST = 1e-9
# Names of sessions, or of wheels, that a sentence lists (chosen).
_LISTED = 3
_SPLITS = "train", "validation"
_ALONE = "all runs are of one session"
Kind = Literal["all wheels", "one wheel", "wheels", "matrix"]


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
    def of(cls, fit: trajectory_fit.TrajectoryFit, noise: Noise) -> SessionScores:
        """The scores of the runs that have poses in common with the others of their command. DataError: none has."""
        elements = fit.model.matrix.size
        values = [
            np.concatenate([residuals[..., None], *slopes], axis=-1)
            for residuals, *slopes in zip(
                fit.nuisance_free_residuals, fit.matrix_jacobian(), fit.estimated_slopes, strict=True
            )
        ]
        values = trajectory_fit.in_start_frames(fit.runs, values)
        used: list[int] = []
        parts: list[tuple[Array, Array, Array]] = []  # residuals, columns, slopes by nuisances
        stamps_of: list[Array] = []
        for of_command in grouped([run.command for run in fit.runs]):
            if fit.runs[of_command[0]].command is None:
                continue
            ends = np.array([fit.runs[index].pose_times[-1] for index in of_command])
            members = [index for index, end in zip(of_command, ends, strict=True) if end >= _WHOLE * np.median(ends)]
            stamps, poses = common_poses([(fit.runs[index].pose_times[1:], values[index]) for index in members])
            if len(stamps):
                columns = poses.mean(axis=0)[..., 1:]
                used += members
                stamps_of += [stamps] * len(members)
                parts += [(of_run[..., 0], columns[..., :elements], columns[..., elements:]) for of_run in poses]
        deviations = fit.nuisances.deviations[fit.nuisances.estimated]
        if not parts:
            raise DataError("the runs of a command have no reference poses at common times")
        residuals, fitted, slopes = zip(*parts, strict=True)
        data = trajectory_fit.whitened(residuals, fitted, whiteners(noise, stamps_of), slopes, deviations)
        names = sessions_of(fit.runs)
        return cls(
            tuple(fit.runs[index] for index in used),
            tuple(names[index] for index in used),
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
        others = [index for index, name in enumerate(self.sessions) if name != session]
        return replace(
            self,
            runs=tuple(self.runs[index] for index in others),
            sessions=tuple(self.sessions[index] for index in others),
            scores=self.scores[others],
            information=self.information[others],
        )

    def _contrast(self, used: NDArray[np.intp], factors: Array) -> Contrast:
        pulls = np.einsum("zij,zj->zi", factors, self.scores[used])
        spreads = factors @ self.information[used] @ factors.swapaxes(1, 2)
        runs = [self.runs[index] for index in used]
        return Contrast(pulls, spreads, runs, [self.sessions[index] for index in used])


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
        return np.asarray(self.spreads.sum(axis=0))

    def roots(self, directions: Array) -> Array:
        """R (n, d) of directions T (n, q), Eq. (4)."""
        return directions @ roots_of(directions.T @ self.information @ directions)

    def beyond(self, directions: Array) -> Array:
        """R (n, d) of all directions that are independent of T (n, q)."""
        roots = roots_of(self.information)
        basis, sizes, _ = np.linalg.svd(roots.T @ self.information @ directions)
        rank = int((sizes > _ROUNDING * sizes.max(initial=0.0)).sum())
        return np.asarray(roots @ basis[:, rank:])

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
        seen = np.array([n / max(n - 1, 1) * errors.T @ errors for n, errors in zip(counts, apart, strict=True)])
        of_session, of_command = (
            np.array([names[members[0]] for members in groups], dtype=object)
            for names in (self.sessions, [run.command for run in self.runs])
        )
        repeated = counts > 1
        if not repeated.any():
            return pulls.sum(axis=0), seen.sum(axis=0), 0.0
        traces = [np.trace(terms, axis1=1, axis2=2) * (counts - 1) for terms in (seen, expected)]
        plain = np.trace(expected, axis1=1, axis2=2)
        for name in dict.fromkeys(self.sessions):  # s^2 of each session, or of all where one repeats nothing
            inside = of_session == name
            repeating = inside if repeated[inside].any() else repeated
            expected[inside] *= max(traces[0][repeating].sum() / max(traces[1][repeating].sum(), 1e-300), _ROUNDING)
        # A run without repetition scatters as the groups of its command, else as those of its session, else as all.
        shares = np.zeros((len(counts), len(counts)))
        seen_units, expected_units = (terms / np.maximum(plain, 1e-300)[:, None, None] for terms in (seen, expected))
        for index in np.flatnonzero(~repeated):
            alike = (names == names[index] for names in (of_command, of_session, np.ones(len(counts))))
            groups_like = next(
                groups for groups in (np.flatnonzero(repeated & those) for those in alike) if len(groups)
            )
            shares[index, groups_like] = (counts[groups_like] - 1) / (counts[groups_like] - 1).sum()
            if of_command[groups_like[0]] == of_command[index]:  # with their s: its session's may rest on two runs
                seen[index] = plain[index] * np.tensordot(shares[index], seen_units, 1)
                expected[index] = plain[index] * np.tensordot(shares[index], expected_units, 1)
            else:
                seen[index] = expected[index]
        whole = expected + np.tensordot(shares.T, expected, 1)
        terms = [
            _total_variance(of_group) / (n - 1) for of_group, n in zip(whole[repeated], counts[repeated], strict=True)
        ]
        freedom = _total_variance(expected.sum(axis=0)) / np.sum(terms)
        return pulls.sum(axis=0), seen.sum(axis=0) + _ROUNDING * np.eye(len(roots.T)), float(freedom)


def _total_variance(covariance: Array) -> float:
    """tr A^2 + (tr A)^2, Eq. (5)."""
    return float(np.square(covariance).sum() + np.trace(covariance) ** 2)


@dataclass(frozen=True)
class RadiusChange:
    """Relative change of a wheel's radius with its 95 % interval; the name is empty where it is that of all wheels."""

    wheel: str
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class SessionDifference:
    """A session, or the validation split, whose runs deviate from those of the others.

    runs, commands: those that were compared. chance: of as much where nothing differs, corrected for all that was
    tested. radii: the changes that explain it, none for the kind "matrix". matrix: the change of the matrix (3, N).
    """

    session: str
    others: tuple[str, ...]
    runs: int
    commands: int
    chance: float
    kind: Kind
    radii: tuple[RadiusChange, ...]
    matrix: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class SessionComparison:
    """Comparison of the sessions of a data set, or of its splits where sessions are not known.

    differences: of those that differ, surest first. other_commands: chance of the deviation of a validation split that
    drives none of the training's commands, if it is below CHANCE. untested: why some or all sessions could not be
    compared, or empty.
    """

    differences: tuple[SessionDifference, ...] = ()
    other_commands: float | None = None
    untested: str = ""

    @property
    def sentences(self) -> tuple[str, ...]:
        """A sentence for each session that differs, or for a validation split that drives other commands."""
        return (*map(_in_words, self.differences), *self.of_other_commands)

    @property
    def doubts(self) -> tuple[str, ...]:
        """The sentence on sessions that could not be compared; none where there is one session only."""
        if self.untested in ("", _ALONE):
            return ()
        return (f"Whether the sessions differ cannot be said: {self.untested}.",)

    @property
    def of_other_commands(self) -> tuple[str, ...]:
        """The sentence on a validation split that drives other commands and deviates, if it does."""
        if self.other_commands is None:
            return ()
        return (
            "The validation runs deviate from what the training runs fit by more than their repetitions explain "
            f"(chance {_chance(self.other_commands)}), and they drive other commands: whether the sessions differ, or "
            "the model lacks what these commands show, cannot be told. Drive some of the training's commands in that "
            "session, too.",
        )


def compare_sessions(model: OdometryModel, trajectories: Sequence[Trajectory]) -> SessionComparison:
    """Compare the sessions of recordings by a model; noise and nuisances are estimated from their repetitions.

    Of very many runs some that chance has drawn are compared.
    """
    if len(set(sessions_of(trajectories))) < 2:
        return SessionComparison(untested=_ALONE)
    try:
        runs = trajectory_fit.usable_runs(drawn_runs(trajectories), "all")
    except DataError as error:
        return SessionComparison(untested=str(error))
    names = sessions_of(runs)
    if len(set(names)) < 2:
        return SessionComparison(untested="the runs of all sessions but one have no reference poses after their start")
    driven = [(name, run.command) for name, run in zip(names, runs, strict=True) if run.command is not None]
    if not any(len(members) > 1 for members in grouped(driven)):
        return SessionComparison(
            untested="no session repeats a command, so that nothing says how much its runs scatter"
        )
    fit = trajectory_fit.TrajectoryFit(model, runs, trajectory_fit.Nuisances(np.zeros((len(runs), 3)), np.zeros(3)))
    noise = trajectory_fit.noise_of_fit(fit, range(3), None, _NUISANCES)
    fit = replace(fit, nuisances=trajectory_fit.Nuisances(fit.nuisances.values, noise.deviations))
    # The matrix is fitted to all runs, by one step, so that the sessions' changes about it are small.
    whitened_fit = fit.linearised(fit.matrix_jacobian(), whiteners(noise.estimate.noise, fit.stamps))
    step, _ = whitened_fit.given([]).estimate(range(model.matrix.size))
    fit = replace(fit, model=replace(model, matrix=model.matrix + step.reshape(model.matrix.shape)))
    try:
        data = SessionScores.of(fit, noise.estimate.noise)
    except DataError as error:
        return SessionComparison(untested=str(error))
    chance, untested, comparable = None, "", data.comparable
    training, validation = ({run.command for run in data.runs if run.split == split} for split in _SPLITS)
    if training and validation and not training & validation:
        chance = 3 * _least_chance(data, data.between_splits())
    elif not comparable:
        untested = "the sessions share no command that any of them repeats"
    elif apart := [name for name in dict.fromkeys(names) if name not in comparable]:
        untested = f"no run of {_listed(apart)} drives a command of another session that either repeats"
    deviates = chance is not None and chance < CHANCE
    return SessionComparison(tuple(_differences(data)), chance if deviates else None, untested)


def _differences(data: SessionScores) -> Iterator[SessionDifference]:
    """The sessions that differ, the surest first: each is taken out before the others are tested again."""
    names = data.comparable
    tests = 3 * (1 if len(names) == 2 else len(names))  # two sessions differ from each other: one test
    while len(names) > 1:
        contrasts = {name: data.between(name) for name in names}
        chances = {name: _least_chance(data, contrast) for name, contrast in contrasts.items()}
        session = min(chances, key=lambda name: chances[name])
        if tests * chances[session] >= CHANCE:
            break
        # The least change that explains the deviation: of one number, of each radius, or of the matrix.
        contrast = contrasts[session]
        kind, directions, wheels = _least_change(data, contrast)
        roots = contrast.roots(directions)
        total, scatter, freedom = contrast.scatter(roots)
        change, inverse = roots @ total, np.linalg.pinv(directions)
        values, deviations = inverse @ change, np.sqrt(np.diag(inverse @ roots @ scatter @ roots.T @ inverse.T))
        reach = float(stdtrit(freedom, (1 + INTERVAL) / 2)) * deviations
        count = contrast.sessions.count(session)
        share = count / len(contrast.sessions)
        radii = []
        for wheel, value, width in zip(wheels, values, reach, strict=False):  # none of the matrix
            limits = (float(u / (1 - share * u)) for u in (value, value - width, value + width))  # Eq. (8)
            radii.append(RadiusChange(wheel, *limits))
        yield SessionDifference(
            session=session,
            others=tuple(sorted(set(contrast.sessions) - {session})),
            runs=count,
            commands=len({run.command for run in contrast.runs}),
            chance=tests * chances[session],
            kind=kind,
            radii=tuple(radii),
            matrix=tuple(tuple(float(value) for value in row) for row in change.reshape(data.matrix.shape)),
        )
        data = data.without(session)
        names = data.comparable


def _directions(data: SessionScores) -> tuple[Array, Array, Array]:
    """Directions (3N, d) of a change of all radii, of each radius, and of the matrix."""
    wheels = np.eye(data.matrix.shape[1])
    radii = np.stack([(data.matrix * wheel).ravel() for wheel in wheels], axis=1)
    return data.matrix.reshape(-1, 1), radii, np.eye(data.matrix.size)


def _least_chance(data: SessionScores, contrast: Contrast) -> float:
    return min(contrast.chance(contrast.roots(directions))[0] for directions in _directions(data))


def _least_change(data: SessionScores, contrast: Contrast) -> tuple[Kind, Array, tuple[str, ...]]:
    """The least change beside which nothing is left: its kind, its directions (3N, d) and its wheels."""
    common, radii, matrix = _directions(data)
    single = {"": common} | {wheel: radii[:, [column]] for column, wheel in enumerate(data.wheels)}
    explaining = {name: directions for name, directions in single.items() if _explains(contrast, directions)}
    if explaining:
        name = max(explaining, key=lambda name: contrast.chance(contrast.roots(explaining[name]))[1])
        return ("one wheel" if name else "all wheels"), explaining[name], (name,)
    if _explains(contrast, radii):
        return "wheels", radii, data.wheels
    return "matrix", matrix, ()


def _explains(contrast: Contrast, directions: Array) -> bool:
    return contrast.chance(contrast.beyond(directions))[0] >= _ALL


def _in_words(difference: SessionDifference) -> str:
    others = _listed(difference.others)
    changes = " and ".join(
        f"{f'the radius of wheel {one.wheel} looks' if one.wheel else 'the radii of all wheels look'} {_size(one)}"
        for one in difference.radii
    )
    what = changes or "more differs than the wheels' radii (floor, load, or the mount of wheels or reference)"
    return (
        f"The sessions differ: in {difference.session} against {others}, {plural(difference.commands, 'command')} that "
        f"they share, {what}; repetitions do not explain it (chance {_chance(difference.chance)})."
    )


def _chance(value: float) -> str:
    """A chance in words."""
    return f"{value:.1g}" if value >= _LEAST else "< 10⁻⁹"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:_LISTED]) + (f" and {len(names) - _LISTED} more" if len(names) > _LISTED else "")


def _size(change: RadiusChange) -> str:
    """``2.04 % larger (95 %: 1.95 to 2.13 %)``."""
    value, low, high = (100 * share for share in (change.value, change.low, change.high))
    decimals = max(0, math.ceil(0.7 - math.log10(max((high - low) / 2, 1e-9))))  # 2 for a half width of 0.05 to 0.5
    low, high = sorted((low, high) if value >= 0 else (-low, -high))
    than = "larger" if value >= 0 else "smaller"
    return f"{abs(value):.{decimals}f} % {than} (95 %: {low:.{decimals}f} to {high:.{decimals}f} %)"
