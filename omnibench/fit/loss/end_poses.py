"""Starts and ends of runs whose reference pose has jumped, taken from the poses beside them.

A start that is off shifts or turns every pose of its run, and no weight of single poses mends that. With the motions of
the design robot from pose to pose, each of the three poses beside the end of a run says where that end was; the median
of the three is what they agree on. An end that differs from it by far more than those of other runs do, by their weight
under a robust loss, has jumped. Over so short a way the design is good enough; what it leaves is left to the loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.fit.loss.losses import Loss
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration
from omnibench.robot.planar import compose, relative
from omnibench.words import plural

_BESIDE = 3  # poses beside an end that tell where it was: the fewest of which one may be off, too
_NAMED = 5  # runs that a sentence names
_FEWEST_RUNS = 5  # fewer ends do not tell how far an end usually is from what the poses beside it say


def with_ends_from_others(
    runs: Sequence[Trajectory], robot: Robot, integration: Integration, loss: Loss, *, last: bool
) -> tuple[tuple[Trajectory, ...], tuple[str, ...]]:
    """The runs, starts that have jumped replaced by what the next poses say, and the names of those runs.

    loss: of three coordinates, m and rad alike. last: the last poses are treated alike, for a cost that uses no others.
    """
    if len(runs) < _FEWEST_RUNS:
        return tuple(runs), ()
    design = OdometryModel.of_design(robot, integration)
    moved, names = list(runs), set()
    for end in (0, -1) if last else (0,):
        known = [index for index, run in enumerate(runs) if len(run.poses) > _BESIDE]
        if len(known) < _FEWEST_RUNS:
            continue
        told = np.array([_told(design, runs[index], end) for index in known])
        off = np.linalg.norm(told - [runs[index].poses[end] for index in known], axis=1)
        near = loss.is_near(off, np.full(len(off), 1 / len(off)))
        for index, pose in ((known[place], told[place]) for place in np.flatnonzero(~near)):
            poses = moved[index].poses.copy()
            poses[end] = pose
            moved[index] = replace(moved[index], poses=poses)
            names.add(runs[index].id)
    return tuple(moved), tuple(run.id for run in runs if run.id in names)


def moved_ends_in_words(names: Sequence[str], runs: int, *, last: bool) -> tuple[str, ...]:
    """A sentence on the runs (``names``) of all (their number) whose start or end has jumped; none where none has."""
    if not names:
        return ()
    which = "start or end" if last else "start"
    named = f"{', '.join(names[:_NAMED])}{' ...' if len(names) > _NAMED else ''}"
    return (
        f"{plural(len(names), 'run')} of {runs} ({named}): the reference pose at the {which} is far from what the "
        "poses beside it say, which are used in its place",
    )


def _told(design: OdometryModel, run: Trajectory, end: int) -> Array:
    """The pose (3,) of an end, 0 or -1, that the poses beside it say by the design's motions."""
    beside = np.arange(1, 1 + _BESIDE) if end == 0 else np.arange(-1 - _BESIDE, -1)
    (path,) = design.poses([run.reference_log])
    path = np.vstack([run.start, path])
    return np.asarray(np.median(compose(run.poses[beside], relative(path[beside], path[end])), axis=0))
