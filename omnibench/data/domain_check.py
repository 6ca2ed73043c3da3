"""Extrapolation: runs with motions outside a calibration's training domain, where its effects are a guess."""

from __future__ import annotations

from collections.abc import Sequence

from omnibench.data.dataset import Trajectory
from omnibench.robot.calibration import Calibration
from omnibench.robot.corrections import TrainingDomain, extrapolation_consequence, motions_of
from omnibench.robot.kinematics import Array
from omnibench.words import some

_NAMED = 3  # commands that the warning names; the others are counted


def extrapolation_warning(calibration: Calibration, runs: Sequence[Trajectory]) -> str | None:
    """A warning in one line, if runs drive motions that the calibration's effects were not fitted to.

    None if there are no such runs, or the calibration has no effects or does not state its training domain.
    """
    if not calibration.effects or not calibration.driven:
        return None
    domain, count = TrainingDomain(calibration.robot, calibration.driven), 0
    worst = dict[str, tuple[float, Array]]()  # by command: share of the worst run that is outside, and these motions
    for run in runs:
        motions = motions_of(calibration.matrix_array, run.times, run.signals)
        outside = domain.outside_in_run(motions)
        command, share = run.command or run.id, float(outside.mean())
        count += share > 0
        if share > (worst[command][0] if command in worst else 0.0):
            worst[command] = share, motions[outside]
    if not count:
        return None
    commands = sorted(worst, key=lambda command: -worst[command][0])
    words, effects = domain.in_words(worst[commands[0]][1]), [term.name for term in calibration.effects]
    consequence = extrapolation_consequence(effects, fading=calibration.plain is not None)
    what = f"{count} of {len(runs)} runs drive motions that calibration {calibration.name!r} was not fitted to"
    return f"{what} ({some(commands, _NAMED)}), such as {words}: {consequence}"


def share_outside(calibration: Calibration, runs: Sequence[Trajectory]) -> float | None:
    """Share of the runs' time in motions that a calibration was not fitted to; None where these are not known."""
    if not calibration.driven or not runs:
        return None
    domain, outside = TrainingDomain(calibration.robot, calibration.driven), 0.0
    for run in runs:
        motions = motions_of(calibration.matrix_array, run.times, run.signals)
        outside += float(domain.outside_in_run(motions).mean()) * run.samples.end
    return outside / sum(run.samples.end for run in runs)
