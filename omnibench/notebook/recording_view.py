"""A data set, one of its runs, and its robot in a notebook."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import plotly.graph_objects as go
import polars as pl

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.storage import reference_frame, tables_of
from omnibench.errors import DataError
from omnibench.report.blocks import Figure, FigureGrid
from omnibench.report.figures import START, drawn, is_drawn, marks, motion_system, path
from omnibench.report.recording.recording_figures import REFERENCE_ITEM, all_runs
from omnibench.report.style import plan
from omnibench.robot.kinematics import Robot
from omnibench.views import View
from omnibench.words import plural

_SHOWN = 12  # wheels


class RobotView(View):
    """A robot: a line for each wheel."""

    shown: Robot

    def lines(self) -> Iterator[str]:
        robot = self.shown
        mount = "" if robot.mount is None else f", tracked point at {robot.mount.x:g}, {robot.mount.y:g} m"
        yield f"Robot {robot.name!r}: {len(robot.wheels)} wheels{', skid steering' if robot.skid else ''}{mount}"
        for wheel in robot.wheels[:_SHOWN]:
            said = wheel.model_dump(exclude_none=True, exclude_defaults=True, exclude={"name", "type", "radius"})
            place = ", ".join(f"{name} {value:g}" for name, value in said.items())
            yield f"  {wheel.name}: {wheel.kind}, radius {wheel.radius:g} m, {place}"

    def tables(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        return {"wheels": self._wheels}

    def _wheels(self) -> pl.DataFrame:
        rows = [{"kind": wheel.kind, **wheel.model_dump(exclude={"type"})} for wheel in self.shown.wheels]
        frame = pl.DataFrame(rows, infer_schema_length=None)
        return frame.select(column for column in frame.iter_columns() if column.null_count() < len(frame))

    def figure(self) -> go.Figure:
        if not is_drawn(self.shown):
            raise DataError(f"robot {self.shown.name}: where its wheels stand is not said, so that it cannot be drawn")
        figure, items = motion_system(self.shown)
        return drawn(FigureGrid((figure,), tuple(items), 1))


_WARNINGS = 5  # shown of a data set


class DatasetView(View):
    """A data set: its runs, its tables, the paths of all runs from one start."""

    shown: Dataset

    def lines(self) -> Iterator[str]:
        dataset = self.shown
        runs = dataset.trajectories
        splits = ", ".join(f"{sum(run.split == split for run in runs)} {split}" for split in ("train", "validation"))
        robot = f"robot {dataset.robot.name} (wheels {', '.join(dataset.robot.wheel_names)})"
        yield f"Dataset {dataset.name!r}: {plural(len(runs), 'run')} ({splits}) of {robot}"
        samples, poses = sum(run.samples.count for run in runs), sum(len(run.pose_times) for run in runs)
        yield (
            f"  {'simulated' if dataset.simulated else 'recorded'}, {plural(samples, 'wheel sample')} every "
            f"{1000 * dataset.sample_period:g} ms, {plural(poses, 'reference pose')}"
        )
        yield from (f"  warning: {warning}" for warning in dataset.warnings[:_WARNINGS])

    def tables(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        runs = self.shown.trajectories
        names = ["trajectories", "wheels"]
        names += ["poses"] if any(run.start_known for run in runs) else []
        names += ["references"] if any(run.references is not None for run in runs) else []
        return {name: partial(_table, self.shown, name) for name in names}

    def figure(self) -> go.Figure:
        grid = all_runs(self.shown, self.shown.trajectories[0], ())
        return drawn(replace(grid, figures=grid.figures[:1], legend=grid.legend[:1]))


def _table(dataset: Dataset, name: str) -> pl.DataFrame:
    """A table without columns that are empty for all runs."""
    frame = tables_of(dataset)[name]
    return frame.select(column for column in frame.iter_columns() if column.null_count() < len(frame))


class TrajectoryView(View):
    """A run: how long, how far, and its reference path."""

    shown: Trajectory

    def lines(self) -> Iterator[str]:
        run = self.shown
        command = "" if run.command is None else f", command {run.command}"
        yield f"Trajectory {run.id!r} ({run.split}{command}): {run.times[-1]:.2f} s"
        samples = f"{plural(len(run.times), 'wheel sample')} of {plural(run.rates.shape[1], 'wheel')}"
        yield f"  {samples}, {self._reference()}"

    def _reference(self) -> str:
        """The reference in words: poses with the way from start to end, or what there is in their place."""
        run = self.shown
        told = [] if run.references is None else [plural(len(run.references), "reference")]
        if run.has_poses:
            end = ", ".join(f"{value:.3f}" for value in run.final_pose - run.start)
            told.insert(0, f"{plural(len(run.pose_times), 'reference pose')}; end - start: {end} (m, m, rad)")
        return "; ".join(told) or "no reference"

    def tables(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        references = self.shown.references
        tables: dict[str, Callable[[], pl.DataFrame]] = {"wheels": self._wheels, "poses": self._poses}
        if references is not None:
            tables["references"] = lambda: reference_frame([("", references)]).drop("trajectory")
        return tables

    def _wheels(self) -> pl.DataFrame:
        run = self.shown
        columns = {"t": np.asarray(run.times)} | {
            f"omega_{index + 1}": rates for index, rates in enumerate(run.rates.T)
        }
        steering = () if run.steering is None else run.steering.T
        return pl.DataFrame(columns | {f"steer_{index + 1}": angles for index, angles in enumerate(steering)})

    def _poses(self) -> pl.DataFrame:
        x, y, theta = self.shown.poses.T
        return pl.DataFrame({"t": self.shown.pose_times, "x": x, "y": y, "theta": theta})

    def figure(self) -> go.Figure:
        run = self.shown
        start = marks(START, 9, *run.start[None, :2].T, hover="start")
        figure = plan(path(REFERENCE_ITEM, run.poses, 2.5), start)
        title = f"Reference path of {run.id}"
        return drawn(FigureGrid((Figure(title, figure, title),), (REFERENCE_ITEM,), 1))
