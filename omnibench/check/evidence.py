"""The evidence of a recording: its runs by one clock, free fits and looks, shared by the detectors of a check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from omnibench.check.clocks import clocks_of
from omnibench.check.misreadings import Explained, Recorded, search
from omnibench.check.motion_fit import FreeFit, Windows, continuous
from omnibench.check.source import RecordingSource, recorded
from omnibench.check.streams import Look, looks_of
from omnibench.data.clock_matching import ClockMatch
from omnibench.data.dataset import Dataset, Trajectory


@dataclass(frozen=True, eq=False)
class Evidence:
    """A recording, and what detectors need to know of it, computed when the first of them does."""

    read: RecordingSource

    @property
    def dataset(self) -> Dataset:
        """The data set of the recording."""
        return self.read.dataset

    @cached_property
    def runs(self) -> Sequence[Trajectory]:
        """The runs that have poses."""
        return [run for run in self.dataset.trajectories if run.has_poses]

    @cached_property
    def clocks(self) -> Sequence[ClockMatch | None]:
        """The clocks of their references."""
        smooth = [replace(run, poses=continuous(run.pose_times, run.poses)) for run in self.runs]
        return clocks_of(self.dataset.robot, smooth)

    @cached_property
    def aligned(self) -> Sequence[Trajectory]:
        """The runs that have poses, with these by the wheels' clock where the reference's clock shows."""
        aligned = []
        for run, clock in zip(self.runs, self.clocks, strict=True):
            times = run.pose_times if clock is None else clock.corrected(run.pose_times)
            first, last = int(np.searchsorted(times, 0.0)), int(np.searchsorted(times, run.times[-1], side="right"))
            if clock is not None and last - first >= max(3, len(times) // 2):
                poses = run.poses[first:last]
                run = replace(run, pose_times=times[first:last], poses=poses, pose_covariances=None)
            aligned.append(run)
        return aligned

    @cached_property
    def seen(self) -> Recorded:
        """The runs that have poses, by the wheels' clock; without any, those that have positions."""
        seen = recorded(replace(self.dataset, trajectories=tuple(self.aligned)) if self.aligned else self.dataset)
        return replace(seen, counted=bool(self.read.options.get("ticks_per_turn")))

    @cached_property
    def explained(self) -> Explained:
        """The mistakes that explain the motion."""
        return search(self.seen)

    @cached_property
    def looks(self) -> list[Look]:
        """A look at each of the runs that have poses."""
        return looks_of(self.dataset.robot, self.aligned) if self.aligned else []

    @cached_property
    def windows(self) -> Windows | None:
        """Windows of a second of the runs that have poses, of many some; None where poses are sparse."""
        poses = [continuous(run.pose_times, run.poses) for run in self.aligned]
        return Windows.of([run.log(run.pose_times) for run in self.aligned], poses)

    @cached_property
    def fit(self) -> FreeFit | None:
        """The matrix that fits these windows best."""
        return None if self.windows is None else self.windows.fit(self.dataset.robot.reach)
