"""Sessions that differ, and by what: the radii of the wheels, one of them, or more than radii.

The tests are those of session_contrast.py. Looked for are a common change of all radii (d = 1), one of each (d = N) and
any change of the matrix (d = 3N); the least chance counts, times three and times the number of sessions that are tested
(Bonferroni). The session that differs most is taken out, and the others are tested again.

Derivatives are at a matrix that is fitted to all runs, to a share p of which a session's change belongs. Relative to
that matrix a radius changes by u, and relative to that of the other sessions by

    k = u / (1 - p u).                                                                                    (1)
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import stdtrit

from omnibench.data.dataset import Trajectory
from omnibench.data.stored.drawn_runs import drawn_runs
from omnibench.errors import DataError
from omnibench.fit.least_squares.noise import whiteners
from omnibench.fit.least_squares.nuisance_noise import FitNoise, noise_of_fit
from omnibench.fit.least_squares.nuisances import Nuisances
from omnibench.fit.least_squares.repetitions import grouped
from omnibench.fit.least_squares.trajectory_fit import TrajectoryFit
from omnibench.fit.least_squares.usable_runs import usable_runs
from omnibench.fit.least_squares.whitened import given
from omnibench.fit.sessions.session_contrast import Contrast, SessionScores, sessions_of
from omnibench.fit.uncertainty.intervals import INTERVAL
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

# Chance at which sessions are said to differ that do not, over all that is tested: strict, as one such answer in a
# hundred is too many, and enough to see 0.5 % of one radius in 60 + 60 runs (tests/studies/session_study.py).
CHANCE = 0.001
# Level of the tests for nuisances, that of discover (discover/fitting/model_fit.py).
_NUISANCES = 1e-4
# Chance of what is left from which on a change of radii counts as all that differs: chosen; words alone hang on it.
_ALL = 0.01
# Chance below which no figure is printed but "< 10⁻⁹": tails that thin are not those of real noise (chosen).
_LEAST = 1e-9
# Names of sessions, or of wheels, that a sentence lists (chosen).
_LISTED = 3
_ALONE = "all runs are of one session"
Kind = Literal["all wheels", "one wheel", "wheels", "matrix"]


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
        return (*(_in_words(each) for each in self.differences), *self.of_other_commands)

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
        runs = usable_runs(drawn_runs(trajectories), "all")
    except DataError as error:
        return SessionComparison(untested=str(error))
    if untested := _untested(runs):
        few = "the runs of all sessions but one have no reference poses after their start"
        return SessionComparison(untested=few if untested == _ALONE else untested)
    fit = TrajectoryFit(model, runs, Nuisances(np.zeros((len(runs), 3)), np.zeros(3)))
    noise = noise_of_fit(fit, range(3), None, _NUISANCES)
    fit = _centred(replace(fit, nuisances=Nuisances(fit.nuisances.values, noise.deviations)), noise)
    try:
        data = SessionScores.of(fit, noise.estimate.noise)
    except DataError as error:
        return SessionComparison(untested=str(error))
    chance = _with_other_commands(data)
    untested = "" if chance is not None else _uncomparable(sessions_of(fit.runs), data.comparable)
    deviates = chance is not None and chance < CHANCE
    return SessionComparison(tuple(_differences(data)), chance if deviates else None, untested)


def _centred(fit: TrajectoryFit, noise: FitNoise) -> TrajectoryFit:
    """The fit with its matrix fitted to all runs, by one step, so that the sessions' changes about it are small."""
    data = fit.linearised(fit.matrix_jacobian(), whiteners(noise.estimate.noise, fit.stamps))
    step, _ = given(data, []).estimate(range(fit.model.matrix.size))
    return replace(fit, model=replace(fit.model, matrix=fit.model.matrix + step.reshape(fit.model.matrix.shape)))


def _untested(runs: Sequence[Trajectory]) -> str:
    """Why sessions cannot be compared; empty if they can."""
    names = sessions_of(runs)
    if len(set(names)) < 2:
        return _ALONE
    driven = [(name, run.command) for name, run in zip(names, runs, strict=True) if run.command is not None]
    if not any(len(members) > 1 for members in grouped(driven)):
        return "no session repeats a command, so that nothing says how much its runs scatter"
    return ""


def _uncomparable(names: Sequence[str], comparable: Sequence[str]) -> str:
    """The sessions that share with another one no command that either repeats, in words; empty if there are none."""
    left = [name for name in dict.fromkeys(names) if name not in comparable]
    if not comparable:
        return "the sessions share no command that any of them repeats"
    if not left:
        return ""
    return f"no run of {_listed(left)} drives a command of another session that either repeats"


def _differences(data: SessionScores) -> Iterator[SessionDifference]:
    """The sessions that differ, the surest first: each is taken out before the others are tested again."""
    names = data.comparable
    tests = 3 * (1 if len(names) == 2 else len(names))  # two sessions differ from each other: one test
    while len(names) > 1:
        chances = {name: _least_chance(data, data.between(name)) for name in names}
        session = min(chances, key=lambda name: chances[name])
        if tests * chances[session] >= CHANCE:
            break
        yield _difference(data, session, tests * chances[session])
        data = data.without(session)
        names = data.comparable


def _directions(data: SessionScores) -> tuple[Array, Array, Array]:
    """Directions (3N, d) of a change of all radii, of each radius, and of the matrix."""
    wheels = np.eye(data.matrix.shape[1])
    each = np.stack([(data.matrix * wheel).ravel() for wheel in wheels], axis=1)
    return data.matrix.reshape(-1, 1), each, np.eye(data.matrix.size)


def _least_chance(data: SessionScores, contrast: Contrast) -> float:
    return min(contrast.chance(contrast.roots(directions))[0] for directions in _directions(data))


def _difference(data: SessionScores, session: str, chance: float) -> SessionDifference:
    """The least change that explains a session's deviation: of one number, of each radius, or of the matrix."""
    contrast = data.between(session)
    kind, directions, wheels = _least_change(data, contrast)
    roots = contrast.roots(directions)
    total, scatter, freedom = contrast.scatter(roots)
    change, inverse = roots @ total, np.linalg.pinv(directions)
    values, deviations = inverse @ change, np.sqrt(np.diag(inverse @ roots @ scatter @ roots.T @ inverse.T))
    reach = float(stdtrit(freedom, (1 + INTERVAL) / 2)) * deviations
    share = contrast.sessions.count(session) / len(contrast.sessions)
    return SessionDifference(
        session=session,
        others=tuple(sorted(set(contrast.sessions) - {session})),
        runs=contrast.sessions.count(session),
        commands=len({run.command for run in contrast.runs}),
        chance=chance,
        kind=kind,
        radii=tuple(
            RadiusChange(wheel, *(float(each / (1 - share * each)) for each in (value, value - width, value + width)))
            for wheel, value, width in zip(wheels, values, reach, strict=False)  # none of the matrix; Eq. (1)
        ),
        matrix=tuple(tuple(float(value) for value in row) for row in change.reshape(data.matrix.shape)),
    )


def _least_change(data: SessionScores, contrast: Contrast) -> tuple[Kind, Array, tuple[str, ...]]:
    """The least change beside which nothing is left: its kind, its directions (3N, d) and its wheels."""
    common, each, every = _directions(data)
    single = {"": common} | {wheel: each[:, [column]] for column, wheel in enumerate(data.wheels)}
    able = {name: directions for name, directions in single.items() if _explains(contrast, directions)}
    if able:
        name = max(able, key=lambda name: contrast.chance(contrast.roots(able[name]))[1])
        return ("one wheel" if name else "all wheels"), able[name], (name,)
    if _explains(contrast, each):
        return "wheels", each, data.wheels
    return "matrix", every, ()


def _explains(contrast: Contrast, directions: Array) -> bool:
    return contrast.chance(contrast.beyond(directions))[0] >= _ALL


def _with_other_commands(data: SessionScores) -> float | None:
    """The chance of the validation split's deviation, where it drives no command of the training."""
    driven = [{run.command for run in data.runs if run.split == split} for split in ("train", "validation")]
    if not all(driven) or driven[0] & driven[1]:
        return None
    return 3 * _least_chance(data, data.between_splits())


def _in_words(difference: SessionDifference) -> str:
    others = _listed(difference.others)
    changes = " and ".join(
        f"{f'the radius of wheel {each.wheel} looks' if each.wheel else 'the radii of all wheels look'} {_size(each)}"
        for each in difference.radii
    )
    what = changes or "more than the wheels' radii is another (floor, load, or the mount of wheels or reference)"
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
    value, low, high = (100 * each for each in (change.value, change.low, change.high))
    decimals = max(0, math.ceil(0.7 - math.log10(max((high - low) / 2, 1e-9))))  # 2 for a half width of 0.05 to 0.5
    low, high = sorted((low, high) if value >= 0 else (-low, -high))
    than = "larger" if value >= 0 else "smaller"
    return f"{abs(value):.{decimals}f} % {than} (95 %: {low:.{decimals}f} to {high:.{decimals}f} %)"
