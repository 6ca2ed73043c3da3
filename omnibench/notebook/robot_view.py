"""A robot in a notebook: its wheels, and a drawing from above."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import plotly.graph_objects as go
import polars as pl

from omnibench.errors import DataError
from omnibench.notebook.single_figure import drawn
from omnibench.report.blocks import FigureGrid
from omnibench.report.figures import is_drawn, motion_system
from omnibench.robot.kinematics import Robot
from omnibench.views import View

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
