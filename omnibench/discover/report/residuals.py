"""Residuals of plain and extended model, by command and over a covariate of the motion, for the figures.

Over a covariate, residuals are not averaged, because the error of a pose accumulates all errors before it. Drawn is the
change of the motion (along the path, across it, in turning, or of a wheel's rate) that is constant in each bin of the
covariate and explains the residuals best, by generalised least squares under the noise model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.discover.paths import Paths, make_paths
from omnibench.discover.result import Discovery
from omnibench.fit.noise import Whitener, grouped
from omnibench.robot.kinematics import Array, rotation

NORMAL_95 = 1.96  # standard deviations within which 95 % of a normal number lie
_STAMPS = 15_000  # reference poses drawn of all runs, at most, so that a report takes seconds
# Share of the largest eigenvalue of the information, below which a direction is left open: its standard error is 100
# times that of the best known one, wider than any figure.
_DETERMINED = 1e-4
_COMMANDS = 8  # with fewer, the signs of whole commands flip in less than 2^7 ways, too few for the band of 95 %


@dataclass(frozen=True, eq=False)
class Fitted:
    """Fitted values (n, 2), before and after, with their standard errors (n, 2) by chance; NaN: not determined."""

    values: Array
    errors: Array


@dataclass(frozen=True, eq=False)
class CommandResidual:
    """Final residuals of one command: means over its runs, in the frame of the start pose (x forward).

    run: the first of them. means (2, 3): before and after, m, m, rad; error (3,): their standard error by the noise.
    """

    name: str
    run: Trajectory
    runs: int
    means: Array
    error: Array


class Residuals:
    """The training runs with their residuals, in the order in which they were driven.

    runs: sorted by session and time. each: for both models the residuals (K, 3) of each run, reference minus
    odometry, m, m, rad. spread: ratio of the remaining residuals to the noise model, at least 1; it multiplies all
    standard errors.
    """

    def __init__(self, discovery: Discovery) -> None:
        trajectories = {run.id: run for run in discovery.dataset.trajectories}
        runs = [trajectories[name] for name in discovery.trajectories]
        order = sorted(range(len(runs)), key=lambda i: (str(runs[i].session), runs[i].started_at or 0.0))
        self.runs = tuple(runs[index] for index in order)
        self.each = tuple(tuple(own[index] for index in order) for own in (discovery.before, discovery.after))
        self.noise = discovery.noise.noise
        white = np.concatenate([each.ravel() for each in discovery.whitened_after])
        self.spread = max(1.0, math.sqrt(float(np.square(white).mean())))
        self._calibration = discovery.plain

    def deviations(self, times: Array) -> Array:
        """Standard deviations (n, 3) of single poses' errors at times (n,), m, m, rad."""
        noise = self.noise
        position = np.sqrt(noise.pose_position**2 + noise.walk_position**2 * times + noise.bias_position**2)
        heading = np.sqrt(noise.pose_heading**2 + noise.walk_heading**2 * times + noise.bias_heading**2)
        return self.spread * np.column_stack([position, position, heading])

    @cached_property
    def commands(self) -> tuple[CommandResidual, ...]:
        """Final residuals by command; a run without a command counts as a command of its own."""
        residuals = []
        for members in grouped([(run.command, run.id if run.command is None else None) for run in self.runs]):
            first = self.runs[members[0]]
            finals, variances = [], []
            for index in members:
                run = self.runs[index]
                finals.append([rotation(-run.start[2]) @ own[index][-1] for own in self.each])
                variances.append(self.deviations(run.pose_times[-1:])[0] ** 2)
            error: Array = np.sqrt(np.sum(variances, axis=0)) / len(members)
            means: Array = np.mean(finals, axis=0)
            residuals.append(CommandResidual(first.command or first.id, first, len(members), means, error))
        return tuple(residuals)

    @cached_property
    def paths(self) -> Paths:
        """The paths of the runs by the plain matrix, at the thinned stamps."""
        logs = [replace(run.reference_log, stamps=run.pose_times[1:][chosen]) for run, chosen in self._thinned]
        return make_paths(
            self._calibration.robot, self._calibration.matrix_array, logs, self._calibration.sample_period
        )

    @cached_property
    def _thinned(self) -> list[tuple[Trajectory, NDArray[np.intp]]]:
        """The runs with the numbers of their stamps that are fitted: at most 15,000 in all."""
        stride = max(1, math.ceil(sum(map(len, self.each[0])) / _STAMPS))
        return [(run, np.arange(len(own))[(len(own) - 1) % stride :: stride])
                for run, own in zip(self.runs, self.each[0], strict=True)]  # fmt: skip

    @cached_property
    def _white(self) -> list[tuple[Whitener, Array]]:
        """Whitener of each run, and its whitened residuals (3 K, 2), before and after."""
        whiteners: dict[bytes, Whitener] = {}
        found = []
        for (run, chosen), before, after in zip(self._thinned, *self.each, strict=True):
            stamps = run.pose_times[1:][chosen]
            whitener = whiteners.setdefault(stamps.tobytes(), Whitener(self.noise, stamps))
            both = whitener(np.stack([before[chosen], after[chosen]], axis=-1))
            found.append((whitener, both.reshape(-1, 2)))
        return found

    def fit(self, columns: Array) -> Fitted:
        """Fit the changes of the motion that explain the residuals best; columns (S, 3, n): their slopes at the stamps.

        Standard errors are the larger of two: by the noise model, and by random signs of the residuals of whole
        commands (of runs, where commands are few).
        """
        size = columns.shape[2]
        information, scores = np.zeros((size, size)), np.empty((len(self.runs), size, 2))
        for row, (part, (whitener, residuals)) in enumerate(zip(self.paths.parts, self._white, strict=True)):
            white = whitener(columns[part]).reshape(-1, size)
            information += white.T @ white
            scores[row] = white.T @ residuals
        scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        scale[np.diag(information) < 1e-12 * np.diag(information).max(initial=0.0)] = 0.0
        correlation = information * np.outer(scale, scale)
        inverse = np.linalg.pinv(correlation, rcond=_DETERMINED, hermitian=True) * np.outer(scale, scale)
        # Parameters that take no part in a direction that the data leave open.
        sizes, vectors = np.linalg.eigh(correlation)
        open_ones = vectors[:, sizes < _DETERMINED * max(float(sizes.max(initial=0.0)), 1e-300)]
        determined = (scale > 0) & (np.square(open_ones).sum(axis=1) < 0.01)
        noise = self.spread * np.sqrt(np.maximum(np.diag(inverse), 0.0))
        cluster_scores = np.stack([scores[list(members)].sum(axis=0) for members in self._clusters])
        flipped = np.sqrt(np.square(np.einsum("ij,cjm->cim", inverse, cluster_scores)).sum(axis=0))
        values = inverse @ scores.sum(axis=0)
        errors = np.maximum(noise[:, None], flipped)
        return Fitted(np.where(determined[:, None], values, np.nan), np.where(determined[:, None], errors, np.nan))

    @cached_property
    def _clusters(self) -> list[tuple[int, ...]]:
        """The runs of each command, or each run by itself where commands are few."""
        commands = grouped([(run.command, run.id if run.command is None else None) for run in self.runs])
        return commands if len(commands) >= _COMMANDS else [(index,) for index in range(len(self.runs))]


def shares(values: Array, edges: Sequence[float] | Array) -> Array:
    """Membership (F, B) of values (F,) in bins: 1 in its bin and 0 elsewhere; all 0 outside the edges."""
    bins = np.searchsorted(np.asarray(edges), values, side="right") - 1
    bins = np.where(values == edges[-1], len(edges) - 2, bins)
    found: Array = (bins[:, None] == np.arange(len(edges) - 1)).astype(float)
    return found
