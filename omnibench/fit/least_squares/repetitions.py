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

    Repetitions are runs of one command within a session (within a split if no session repeats a command). Runs with
    different stamps are compared at the nearest ones; interpolation would reduce white noise. Without repeated commands
    the residuals themselves stand in for the differences. slopes (K, 3, m): derivatives of every trajectory's poses by
    its nuisances, averaged alongside; default none.
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
            f"({repeated.description}, each within one {repeated.within})"
        )
        return Differences(contrasts, "repetitions", words)
    whole = tuple(Difference(stamps, values[..., 0], values[..., 1:]) for stamps, values in runs if len(stamps))
    words = (
        f"the residuals within {len(whole)} {noun_for(len(whole), 'run')}: no command is repeated, so what the model "
        "cannot express counts as noise"
    )
    return Differences(whole, "within runs", words)


@dataclass(frozen=True)
class Repetitions:
    """Groups of run indices, one for every command driven more than once within one session or one split."""

    groups: tuple[tuple[int, ...], ...]
    within: Literal["session", "split"]

    @property
    def description(self) -> str:
        return f"{sum(map(len, self.groups))} runs of {len(self.groups)} {noun_for(len(self.groups), 'command')}"


def repetitions_of_commands(trajectories: Sequence[Trajectory]) -> Repetitions:
    """The repetitions within sessions; if no session repeats a command, those within splits. Runs need a command."""
    for within in ("session", "split"):
        keys = [(run.split, run.session if within == "session" else None, run.command) for run in trajectories]
        repeated = [group for group in grouped(keys) if len(group) > 1 and trajectories[group[0]].command is not None]
        if repeated:
            return Repetitions(tuple(repeated), within)
    return Repetitions((), "split")


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
    for count in range(1, len(runs)):
        stamps, values = common_poses(runs[: count + 1])
        if len(stamps):
            residuals, slopes = values[..., 0], values[..., 1:]
            contrast = (residuals[:-1].mean(axis=0) - residuals[-1]) * np.sqrt(count / (count + 1))
            yield Difference(stamps, contrast, slopes.mean(axis=0))


def common_poses(runs: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Stamps (K,) of the run with the fewest, and values (n, K, ...) of all runs at their nearest stamps.

    Interpolating would average two poses, which have less white noise than one.
    """
    end = min(stamps[-1] for stamps, _ in runs)
    coarsest = min((stamps for stamps, _ in runs), key=lambda stamps: int((stamps <= end).sum()))
    grid = coarsest[coarsest <= end]
    chosen = np.array([_nearest(stamps, grid) for stamps, _ in runs], dtype=np.intp)
    # A pose is used for one stamp only: using it twice would correlate the white noise.
    fresh = (np.diff(chosen, axis=1, prepend=-1) > 0).all(axis=0)
    return grid[fresh], np.array([values[index[fresh]] for (_, values), index in zip(runs, chosen, strict=True)])


def _nearest(stamps: Array, grid: Array) -> NDArray[np.intp]:
    """Index of the stamp that is nearest to each of a grid (K,)."""
    middles = (stamps[1:] + stamps[:-1]) / 2
    return np.searchsorted(middles, grid)
