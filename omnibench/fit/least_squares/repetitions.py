"""Repetitions of a command, and differences between them, which contain the noise but no error of the model."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.robot.kinematics import Array
from omnibench.words import noun_for


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
        (
            of_sessions,
            "each within one session, across both splits, so that the noise has seen validation runs",
        ),
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
            own = values[chosen[-1]]
            if len(grid):
                contrast = (before[..., 0] / count - own[..., 0]) * np.sqrt(count / (count + 1))
                yield Difference(grid, contrast, (before + own)[..., 1:] / (count + 1))
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
    chosen = [_nearest(times, grid) for times in stamps]
    # A pose is used for one stamp only: using it twice would correlate the white noise.
    fresh = (np.diff(chosen, axis=1, prepend=-1) > 0).all(axis=0)
    return grid[fresh], [index[fresh] for index in chosen]


def _nearest(stamps: Array, grid: Array) -> NDArray[np.intp]:
    """Index of the stamp that is nearest to each of a grid (K,)."""
    middles = (stamps[1:] + stamps[:-1]) / 2
    return np.searchsorted(middles, grid)
