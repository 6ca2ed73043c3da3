"""What a calibration would gain on runs that it was not fitted to, by cross-validation over commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.fit.check.missing_motions import command_names
from omnibench.fit.held_out import judge
from omnibench.fit.linear_fit import linear_fit
from omnibench.fit.span import directions_kept, driven_span
from omnibench.robot.arrays import Array
from omnibench.robot.kinematics import Robot
from omnibench.robot.odometry import OdometryBatch
from omnibench.robot.planar import wrapped
from omnibench.words import plural

_PARTS = 5  # of the commands, each held out once
_FEWEST = 4  # runs, below which nothing can be held out
_SMALL = 0.1  # share of the cost: a larger gain that is not significant is left open; chosen
_ENOUGH = 10  # commands, from which on a gain would have shown if there were one; chosen
_MOST = 120  # runs that are looked at; chosen: some seconds


@dataclass(frozen=True)
class Gain:
    """needed: as in CheckReport. sentence: the errors before and after."""

    needed: bool | None
    sentence: str


def expected_gain(robot: Robot, runs: Sequence[Trajectory]) -> Gain:
    """Errors at the end of runs that were held out, by the design and by a linear fit to the others."""
    chosen = [run for run in runs if run.has_poses]
    chosen = chosen[:: -(-len(chosen) // _MOST)] if len(chosen) > _MOST else list(chosen)
    unknown = "whether a calibration is needed cannot be told from"
    if len(chosen) < _FEWEST:
        return Gain(None, f"{unknown} {plural(len(chosen), 'run')}; {_FEWEST} are needed")
    names = command_names(chosen)
    known = sorted(set(names))
    if len(known) < 2:
        return Gain(None, f"{unknown} runs of one command; 2 are needed, of which one is held out")
    count = min(_PARTS, len(known))
    parts = [known.index(name) % count for name in names]
    before, after, held = [], [], []
    for part in range(count):
        out = [run for run, of in zip(chosen, parts, strict=True) if of == part]
        rest = [run for run, of in zip(chosen, parts, strict=True) if of != part]
        before.append(_errors(out, robot.inverse_kinematic_matrix))
        after.append(_errors(out, _fitted(robot, rest)))
        held += out
    named = [replace(run, command=names[chosen.index(run)]) for run in held]
    verdict = judge(np.concatenate(before), np.concatenate(after), named)
    needed = {"better": True, "worse": False}.get(verdict.verdict)
    small = verdict.improvement is not None and abs(verdict.improvement) < _SMALL
    if verdict.verdict == "undecided" and small and verdict.units is not None and verdict.units >= _ENOUGH:
        needed = False
    return Gain(needed, verdict.sentence.replace("held out", "cross-validated", 1))


def _fitted(robot: Robot, runs: Sequence[Trajectory]) -> Array:
    odometry = OdometryBatch([run.reference_log for run in runs], "arc")
    reference = np.concatenate([run.poses[1:] for run in runs])
    span = driven_span(runs)
    kept = directions_kept(robot, span, "shrink")
    _, _, directions = np.linalg.svd(np.vstack([kept, np.zeros((1, len(robot.drive.names)))]))
    return linear_fit(odometry, runs, reference, robot.inverse_kinematic_matrix, directions[len(kept) :])


def _errors(runs: Sequence[Trajectory], matrix: Array) -> Array:
    """Errors (Z, 3) of the final poses."""
    poses = OdometryBatch([run.final_log for run in runs], "arc").poses(matrix[None])[0]
    errors = poses - np.array([run.final_pose for run in runs])
    errors[:, 2] = wrapped(errors[:, 2])
    return errors
