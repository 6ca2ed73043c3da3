"""Motions of held-out runs that no training run drove, and how far the candidates' predictions can be trusted there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting.extend import Extended, columns_at
from omnibench.discover.held_out.gaps import held_out_residuals
from omnibench.discover.result import Novelty
from omnibench.discover.selection.competing_models import folds_of_commands
from omnibench.fit.least_squares.repetitions import grouped
from omnibench.robot.kinematics import Array
from omnibench.robot.training_domain import extrapolated_share, motions_of, representatives

_QUANTILE = 2.45  # standard deviations of each coordinate: the radius that holds 95 % of positions in the plane


def driven_motions(extended: Extended) -> Array:
    """Representative motions (k, 3) of the runs of a fit, m/s, m/s, rad/s."""
    model = extended.fit.model
    every = [motions_of(model.matrix, run.times, run.rates) for run in extended.fit.runs]
    return representatives(model.robot, np.concatenate(every))


def novelties_of(
    runs: Sequence[Trajectory], plain: Extended, candidates: Sequence[tuple[float, Extended]]
) -> tuple[Novelty, ...]:
    """One entry for every command of ``runs`` that drives what the fit has not seen.

    candidates: fits that the data cannot tell apart, with their weights; where these disagree the bound is wide.
    """
    model, driven = plain.fit.model, driven_motions(plain)
    found = []
    for members in grouped([run.command or run.id for run in runs]):
        own = [runs[index] for index in members]
        motions = np.concatenate([motions_of(model.matrix, run.times, run.rates) for run in own])
        share, words = extrapolated_share(model.robot, driven, motions)
        if share:
            found.append(
                Novelty(
                    own[0].command or own[0].id,
                    f"{100 * share:.0f} % of its time it drives what no training run drove, such as {words}",
                    _bound(own, [(1.0, plain)]),
                    _bound(own, candidates),
                )
            )
    return tuple(found)


def _bound(runs: Sequence[Trajectory], candidates: Sequence[tuple[float, Extended]]) -> float:
    """Within how many metres the final positions are expected to be predicted, with 95 %.

    From what a fit leaves of commands that it has not seen, the uncertainty of its numbers, and what the candidates
    disagree on.
    """
    weights = np.array([weight for weight, _ in candidates])
    weights = weights / weights.sum()
    logs = [run.reference_log for run in runs]
    ends = np.array([[poses[-1, :2] for poses in each.fit.model.reported(logs)] for _, each in candidates])
    between = np.einsum("c,crk->r", weights, np.square(ends - np.einsum("c,crk->rk", weights, ends)))
    within = np.zeros(len(runs))
    for weight, (_, each) in zip(weights, candidates, strict=True):
        left = held_out_residuals(each, folds_of_commands(each.fit.runs))
        seen = float(np.mean([np.square(own[-1, :2]).sum() for own in left]))
        for row, columns in enumerate(columns_at(each, runs)):
            last = columns[-1, :2]
            within[row] += weight * (seen + float(np.trace(last @ each.covariance @ last.T)))
    return float(_QUANTILE * np.sqrt(np.mean(between + within) / 2))
