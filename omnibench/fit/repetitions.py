"""Differences between repetitions of a command: combinations of runs that hold noise and nothing of the model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.robot.kinematics import Array


@dataclass(frozen=True, eq=False)
class Difference:
    """A combination of runs that is distributed as the noise of one run.

    stamps (K,): s. values (K, 3): m, m, rad. companion (K, 3): the mean over these runs of what came with them.
    """

    stamps: Array
    values: Array
    companion: Array


@dataclass(frozen=True, eq=False)
class Differences:
    """Independent differences, where they come from, and of how many runs of how many commands."""

    each: tuple[Difference, ...]
    source: Literal["repetitions", "within runs"]
    description: str


def differences_between_repetitions(
    trajectories: Sequence[Trajectory], residuals: Sequence[Array], companions: Sequence[Array] | None = None
) -> Differences:
    """Independent differences of residuals (K, 3), given at every trajectory's pose_times[1:].

    Repetitions are runs of one command within a session; within a split, if no session repeats a command. Where none
    is repeated, the residuals themselves stand for the differences.
    """
    companions = residuals if companions is None else companions
    runs = [
        (run.pose_times[1:], np.stack([own, other], axis=-1))
        for run, own, other in zip(trajectories, residuals, companions, strict=True)
    ]
    for within in ("session", "split"):
        groups = _repetitions(trajectories, within)
        found = tuple(each for members in groups for each in _contrasts([runs[index] for index in members]))
        if found:
            words = (
                f"{len(found)} independent differences between repetitions ({sum(map(len, groups))} runs of "
                f"{len(groups)} commands, each within one {within})"
            )
            return Differences(found, "repetitions", words)
    found = tuple(Difference(stamps, values[..., 0], values[..., 1]) for stamps, values in runs if len(stamps))
    words = (
        f"the residuals within {len(found)} runs: no command is repeated, so what the model cannot express counts as "
        "noise"
    )
    return Differences(found, "within runs", words)


def _repetitions(trajectories: Sequence[Trajectory], within: str) -> list[list[int]]:
    """Indices of the runs of each command that is driven more than once within a split, and session if so asked."""
    groups: dict[tuple[str | None, ...], list[int]] = {}
    for index, run in enumerate(trajectories):
        if run.command is not None and len(run.pose_times) > 1:
            session = run.session if within == "session" else None
            groups.setdefault((run.split, session, run.command), []).append(index)
    return [members for members in groups.values() if len(members) > 1]


def _contrasts(runs: list[tuple[Array, Array]]) -> Iterator[Difference]:
    """Helmert contrasts of n runs (stamps, values): n - 1 independent ones, each with the noise of one run.

    Each compares a run with the mean of those that last longer, so that no run is cut to the shortest of all.
    """
    runs = sorted(runs, key=lambda run: -run[0][-1])
    for count in range(1, len(runs)):
        stamps, values = _common(runs[: count + 1])
        if len(stamps):
            residuals, companions = values[..., 0], values[..., 1]
            contrast = (residuals[:-1].mean(axis=0) - residuals[-1]) * np.sqrt(count / (count + 1))
            yield Difference(stamps, contrast, companions.mean(axis=0))


def _common(runs: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Stamps (K,) of the run that has the fewest, and the values (n, K, ...) of all runs at the nearest of their own.

    Nothing is interpolated: the mean of two poses has less white noise than a pose.
    """
    end = min(stamps[-1] for stamps, _ in runs)
    coarsest = min((stamps for stamps, _ in runs), key=lambda stamps: int((stamps <= end).sum()))
    grid = coarsest[coarsest <= end]
    chosen = np.array([_nearest(stamps, grid) for stamps, _ in runs], dtype=np.intp)
    # A pose stands for one stamp only: the same white noise twice would look like less of it.
    fresh = (np.diff(chosen, axis=1, prepend=-1) > 0).all(axis=0)
    return grid[fresh], np.array([values[index[fresh]] for (_, values), index in zip(runs, chosen, strict=True)])


def _nearest(stamps: Array, grid: Array) -> NDArray[np.intp]:
    """Index of the stamp that is nearest to each of a grid (K,)."""
    middles = (stamps[1:] + stamps[:-1]) / 2
    return np.searchsorted(middles, grid)
