"""Extrapolation: motions of held-out runs outside the training domain, and bounds on the predictions there.

The models c that the data cannot tell apart have weights w_c, which add up to 1, and predict that a run ends at e_c;
the model in use, which is their average and fades outside the training domain, predicts e. With S_c the mean square
error of the final positions of commands that were held out of the fit of c, and J_c, C_c the derivatives of e_c by the
numbers of c and their covariance, the mean square error of the prediction is

    V = sum of w_c |e_c - e|^2 + sum of w_c (S_c + tr(J_c C_c J_c')).                                  (1)

The circle that holds 95 % of normal errors of variance V / 2 in each coordinate has the radius

    sqrt(-2 ln 0.05) sqrt(V / 2).                                                                                  (2)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting import Extended, columns_at
from omnibench.discover.held_out import folds_of_commands, held_out_residuals
from omnibench.discover.result import Extrapolation
from omnibench.fit.noise import grouped
from omnibench.robot.corrections import Fade, extrapolated_share, motions_of, representatives
from omnibench.robot.kinematics import Array

_QUANTILE = 2.45  # sqrt(-2 ln 0.05), Eq. (2)


def training_domain(extended: Extended) -> Array:
    """Representative motions (k, 3) of the runs of a fit, m/s, m/s, rad/s."""
    model = extended.fit.model
    motions = [motions_of(model.matrix, run.times, run.signals) for run in extended.fit.runs]
    return representatives(model.robot, np.concatenate(motions))


def faded(extended: Extended, baseline: Extended) -> Extended:
    """The fit with a model whose corrections fade outside the training domain. baseline: the plain matrix, fitted."""
    model = extended.fit.model
    if not model.terms:
        return extended
    change, domain = model.matrix - baseline.fit.model.matrix, training_domain(extended)
    fade = Fade(model.robot, change, domain, model.terms, extended.covariance_of_terms)
    return replace(extended, fit=replace(extended.fit, model=replace(model, fade=fade)))


def extrapolations_of(
    runs: Sequence[Trajectory], plain: Extended, extended: Extended, members: Sequence[tuple[float, Extended]]
) -> tuple[Extrapolation, ...]:
    """One entry for every command of ``runs`` that leaves the training domain.

    members: the models of which the extended one is the average, with their weights; where these disagree the bound is
    wide.
    """
    model, domain = plain.fit.model, training_domain(plain)
    extrapolations = []
    for repetitions in grouped([run.command or run.id for run in runs]):
        of_command = [runs[index] for index in repetitions]
        motions = np.concatenate([motions_of(model.matrix, run.times, run.signals) for run in of_command])
        share, words = extrapolated_share(model.robot, domain, motions)
        if share:
            extrapolations.append(
                Extrapolation(
                    of_command[0].command or of_command[0].id,
                    f"{100 * share:.0f} % of its time it drives what no training run drove, such as {words}",
                    _bound(of_command, plain, [(1.0, plain)]),
                    _bound(of_command, extended, members),
                )
            )
    return tuple(extrapolations)


def _bound(runs: Sequence[Trajectory], used: Extended, members: Sequence[tuple[float, Extended]]) -> float:
    """95 % bound on the error of the final positions of some runs by a model, m, Eq. (2) with their mean V."""
    end, squares = _ends(used, runs), np.zeros(len(runs))
    for weight, model in members:
        residuals = held_out_residuals(model, folds_of_commands(model.fit.runs))
        scatter = float(np.mean([np.square(of_run[-1, :2]).sum() for of_run in residuals]))
        squares += weight * (np.square(_ends(model, runs) - end).sum(axis=1) + scatter)
        for row, columns in enumerate(columns_at(model, runs)):
            last = columns[-1, :2]
            squares[row] += weight * float(np.trace(last @ model.covariance.matrix @ last.T))  # Eq. (1)
    return float(_QUANTILE * np.sqrt(np.mean(squares) / 2))  # Eq. (2)


def _ends(model: Extended, runs: Sequence[Trajectory]) -> Array:
    """Final positions (R, 2) of runs by a model, m."""
    return np.array([poses[-1, :2] for poses in model.fit.model.reported([run.reference_log for run in runs])])
