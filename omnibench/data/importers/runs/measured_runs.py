"""Distances, turns, positions and the like of a recording, given to the runs that it is cut into."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omnibench.data.importers.runs.cut_run import CutRun
from omnibench.data.references.run_references import References
from omnibench.words import plural

_LATE = 0.5  # s after the last wheel sample, as long as a data set takes a reference for one of the run


def with_measured(
    runs: Sequence[CutRun], measured: References | None, notes: list[str], place: str, *, whole: bool
) -> list[CutRun]:
    """The runs of a recording with those of its references that lie within them; the others are added to ``notes``.

    whole: the recording is one run, of whose start and end a reference without times tells. Runs without poses and
    references are left out.
    """
    if measured is None:
        return list(runs)
    given, kept = [], 0
    for run in runs:
        references = _within(measured, run, whole=whole)
        kept += 0 if references is None else len(references)
        if references is not None or run.trajectory.has_poses:
            known = run.trajectory.has_poses or (references is not None and references.start_known)
            poses = run.trajectory.poses if known else np.zeros((1, 3))
            given.append(replace(run, trajectory=replace(run.trajectory, references=references, poses=poses)))
    if kept < len(measured):
        notes.append(
            f"{place}: {len(measured) - kept} of {plural(len(measured), 'reference')} left out, outside of the wheels' "
            "samples or across a cut; if the clocks differ, set pose_time_unit or pose_time_offset"
        )
    return given


def _within(measured: References, run: CutRun, *, whole: bool) -> References | None:
    """The references of a run, by its time; None if it has none."""
    trajectory = run.trajectory
    end, period = float(trajectory.times[-1]), float(trajectory.times[-1]) / len(trajectory.times)
    begun, ended = measured.t0 >= run.zero - period, measured.t1 <= run.zero + end + _LATE
    if whole:
        begun, ended = begun | np.isneginf(measured.t0), ended | np.isposinf(measured.t1)
    inside = begun & ended
    if not inside.any():
        return None
    of_run = measured.of_run(run.zero, end, inside)
    near = np.abs(of_run.t0) <= period  # a stamp or two beside the first sample's begin is the start
    t0 = np.where(near & (of_run.t0 != of_run.t1), 0.0, np.maximum(of_run.t0, 0.0))
    t1 = np.maximum(of_run.t1, t0)
    known = trajectory.has_poses or (measured.start_known and whole)
    return replace(of_run, t0=np.where(of_run.t0 == of_run.t1, t1, t0), t1=t1, start_known=known).by_time()
