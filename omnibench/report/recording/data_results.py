"""A data set, one of its runs, and its robot, as they are shown at a prompt and in a notebook."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import polars as pl

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.storage import reference_frame, tables_of
from omnibench.errors import DataError
from omnibench.report.blocks import Figure, FigureGrid, Table
from omnibench.report.figures import START, is_drawn, marks, motion_system, path
from omnibench.report.recording.recording_figures import REFERENCE_ITEM, all_runs
from omnibench.report.result import Remark, Result, frame_table
from omnibench.report.style import plan
from omnibench.robot.kinematics import Robot
from omnibench.words import plural

_WARNINGS = 5  # shown of a data set


class RobotResult(Result):
    """A robot: a row for each wheel."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        mount = "" if robot.mount is None else f", tracked point at {robot.mount.x:g}, {robot.mount.y:g} m"
        wheels = plural(len(robot.wheels), "wheel")
        self.title = f"Robot {robot.name!r}: {wheels}{', skid steering' if robot.skid else ''}{mount}"

    def tables(self) -> Sequence[Table]:
        return [frame_table(self._wheels())]

    def frames(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        return {"wheels": self._wheels}

    def _wheels(self) -> pl.DataFrame:
        rows = [{"kind": wheel.kind, **wheel.model_dump(exclude={"type"})} for wheel in self.robot.wheels]
        return _known(pl.DataFrame(rows, infer_schema_length=None))

    def figures(self) -> Sequence[FigureGrid]:
        if not is_drawn(self.robot):
            raise DataError(f"robot {self.robot.name}: where its wheels stand is not said, so that it cannot be drawn")
        return [motion_system(self.robot)]


class DatasetResult(Result):
    """A data set: its runs, its tables, the paths of all runs from one start."""

    def __init__(self, dataset: Dataset) -> None:
        self.dataset = dataset
        runs, names = dataset.trajectories, ", ".join(dataset.robot.wheel_names)
        splits = ", ".join(f"{sum(run.split == split for run in runs)} {split}" for split in ("train", "validation"))
        robot = f"robot {dataset.robot.name} (wheels {names})"
        self.title = f"Dataset {dataset.name!r}: {plural(len(runs), 'run')} ({splits}) of {robot}"

    def sentence(self) -> str:
        runs, period = self.dataset.trajectories, 1000 * self.dataset.sample_period
        samples, poses = sum(run.samples.count for run in runs), sum(len(run.pose_times) for run in runs)
        kind = "simulated" if self.dataset.simulated else "recorded"
        return f"{kind}, {samples:,} wheel samples every {period:g} ms, {plural(poses, 'reference pose')}"

    def remarks(self) -> Sequence[Remark]:
        return [Remark(f"warning: {warning}", "warning") for warning in self.dataset.warnings[:_WARNINGS]]

    def frames(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        runs = self.dataset.trajectories
        names = ["trajectories", "wheels"]
        names += ["poses"] if any(run.start_known for run in runs) else []
        names += ["references"] if any(run.references is not None for run in runs) else []
        return {name: partial(lambda each: _known(tables_of(self.dataset)[each]), name) for name in names}

    def figures(self) -> Sequence[FigureGrid]:
        grid = all_runs(self.dataset, self.dataset.trajectories[0], ())
        return [FigureGrid(grid.figures[:1], grid.legend[:1], 1)]


def _known(frame: pl.DataFrame) -> pl.DataFrame:
    """A table without columns that are empty in all rows."""
    return frame.select(column for column in frame.iter_columns() if column.null_count() < len(frame))


class TrajectoryResult(Result):
    """A run: how long, how far, and its reference path."""

    def __init__(self, run: Trajectory) -> None:
        self.run = run
        command = "" if run.command is None else f", command {run.command}"
        self.title = f"Trajectory {run.id!r} ({run.split}{command}): {run.times[-1]:.2f} s"

    def sentence(self) -> str:
        run = self.run
        parts = [f"{len(run.times):,} wheel samples of {plural(run.rates.shape[1], 'wheel')}"]
        if run.has_poses:
            end = ", ".join(f"{value:.3f}" for value in run.final_pose - run.start)
            parts.append(f"{len(run.pose_times):,} reference poses; end - start: {end} (m, m, rad)")
        parts += [] if run.references is None else [plural(len(run.references), "reference")]
        return ", ".join(parts)

    def frames(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        run, wheels = self.run, {"t": np.asarray(self.run.times)}
        for name, values in (("omega", run.rates), ("steer", run.steering)):
            wheels |= {f"{name}_{index + 1}": column for index, column in enumerate(() if values is None else values.T)}
        poses = {"t": run.pose_times} | dict(zip(("x", "y", "theta"), run.poses.T, strict=True))
        tables = {"wheels": lambda: pl.DataFrame(wheels), "poses": lambda: pl.DataFrame(poses)}
        if (references := run.references) is not None:
            tables["references"] = lambda: reference_frame([("", references)]).drop("trajectory")
        return tables

    def figures(self) -> Sequence[FigureGrid]:
        start = marks(START, 9, *self.run.start[None, :2].T, hover="start")
        title = f"Reference path of {self.run.id}"
        figure = Figure(title, plan(path(REFERENCE_ITEM, self.run.poses, 2.5), start), title)
        return [FigureGrid((figure,), (REFERENCE_ITEM,), 1)]
