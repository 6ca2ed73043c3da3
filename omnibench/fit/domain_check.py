"""Runs that drive motions which a calibration was not fitted to: there its effects are a guess."""

from __future__ import annotations

from collections.abc import Sequence

from omnibench.data.dataset import Trajectory
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array
from omnibench.robot.training_domain import DrivenMotions, motions_of, not_known_to_hold

_NAMED = 3  # commands


def unfitted_motions(calibration: Calibration, runs: Sequence[Trajectory]) -> str | None:
    """What to warn of, in one line: runs that drive what the fit of the calibration's effects has not seen.

    None: there are none, the calibration has no effects, or it does not say which motions it was fitted to.
    """
    if not calibration.effects or not calibration.driven:
        return None
    driven = DrivenMotions(calibration.robot, calibration.driven)
    count, found = 0, dict[str, tuple[float, Array]]()  # by command: the share of a run that is new, and what
    for run in runs:
        motions = motions_of(calibration.matrix_array, run.times, run.rates)
        new = driven.new_in_run(motions)
        if new.any():
            count += 1
            command, share = run.command or run.id, float(new.mean())
            if command not in found or share > found[command][0]:
                found[command] = share, motions[new]
    if not count:
        return None
    commands = sorted(found, key=lambda command: -found[command][0])
    words = driven.in_words(found[commands[0]][1])
    consequence = not_known_to_hold([term.name for term in calibration.effects])
    return (
        f"{count} of {len(runs)} runs drive motions that calibration {calibration.name!r} was not fitted to "
        f"({_first(commands)}), such as {words}: {consequence}"
    )


def _first(commands: Sequence[str]) -> str:
    others = len(commands) - _NAMED
    return ", ".join(commands[:_NAMED]) + (f" and {others} more" if others > 0 else "")
