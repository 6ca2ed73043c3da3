"""Extrapolation: runs with motions outside a calibration's training domain, where its effects are a guess."""

from __future__ import annotations

from collections.abc import Sequence

from omnibench.data.dataset import Trajectory
from omnibench.robot.calibration import Calibration
from omnibench.robot.corrections import TrainingDomain, extrapolation_consequence, motions_of
from omnibench.robot.kinematics import Array

_NAMED = 3  # commands that the warning names; the others are counted


def extrapolation_warning(calibration: Calibration, runs: Sequence[Trajectory]) -> str | None:
    """A warning in one line, if runs drive motions that the calibration's effects were not fitted to.

    None if there are no such runs, or the calibration has no effects or does not state its training domain.
    """
    if not calibration.effects or not calibration.driven:
        return None
    domain = TrainingDomain(calibration.robot, calibration.driven)
    count = 0
    worst = dict[str, tuple[float, Array]]()  # by command: share of the worst run that is outside, and these motions
    for run in runs:
        motions = motions_of(calibration.matrix_array, run.times, run.signals)
        outside = domain.outside_in_run(motions)
        if outside.any():
            count += 1
            command, share = run.command or run.id, float(outside.mean())
            if command not in worst or share > worst[command][0]:
                worst[command] = share, motions[outside]
    if not count:
        return None
    commands = sorted(worst, key=lambda command: -worst[command][0])
    words = domain.in_words(worst[commands[0]][1])
    consequence = extrapolation_consequence(
        [term.name for term in calibration.effects], fading=calibration.plain is not None
    )
    return (
        f"{count} of {len(runs)} runs drive motions that calibration {calibration.name!r} was not fitted to "
        f"({_first(commands)}), such as {words}: {consequence}"
    )


def share_outside(calibration: Calibration, runs: Sequence[Trajectory]) -> float | None:
    """Share of the runs' time in motions that a calibration was not fitted to; None where these are not known."""
    if not calibration.driven or not runs:
        return None
    domain = TrainingDomain(calibration.robot, calibration.driven)
    times = [float(run.times[-1]) for run in runs]
    motions = (motions_of(calibration.matrix_array, run.times, run.signals) for run in runs)
    outside = [domain.outside_in_run(of_run).mean() * time for of_run, time in zip(motions, times, strict=True)]
    return float(sum(outside) / sum(times))


def _first(commands: Sequence[str]) -> str:
    others = len(commands) - _NAMED
    return ", ".join(commands[:_NAMED]) + (f" and {others} more" if others > 0 else "")
