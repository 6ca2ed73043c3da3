"""A discovery as it is shown: on a terminal, in a notebook and at a prompt."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from omnibench.discover.report import tables
from omnibench.discover.report.figures import error_grid
from omnibench.discover.result import CALIBRATION_FILES, Discovery, discovery_document, experiment_file
from omnibench.report.blocks import Cell, FigureGrid, Table, Tone
from omnibench.report.result import NextStep, Remark, Result
from omnibench.robot.kinematics import Array
from omnibench.words import kind_of_data, plural

# So much is shown that the answer fits into a screen; the report has the rest.
_HIDDEN = 4  # lines of effects that could still hide
_MOST_DEPENDENCES = 4  # lines of covariates that the residuals depend on
_PARAMETERS = 9  # lines for an effect
_LINES = 3  # notes, and as many motions that were not driven in training
_COLUMNS = {
    **dict.fromkeys(("effect", "stage"), pl.String),
    "weight": pl.Float64,
    "parameter": pl.String,
    "value": pl.Float64,
    "unit": pl.String,
    **dict.fromkeys(("low", "high"), pl.Float64),
}


class DiscoveryResult(Result):
    """A discovery: its verdict, the effects, the errors before and after. folder: where its files are."""

    def __init__(self, discovery: Discovery, folder: Path | None = None) -> None:
        self.discovery, self.folder = discovery, folder
        dataset = discovery.dataset
        runs = f"{plural(len(discovery.trajectories), 'training run')}, {plural(discovery.poses, 'reference pose')}"
        self.data = f"{dataset.name} ({kind_of_data(dataset.simulated)}): {runs}"
        self.title = f"Discovery on {self.data}"
        self.warnings = discovery.dataset.warnings

    def sentence(self) -> str:
        verdict = tables.verdict_in_words(self.discovery)
        return f"verdict: {self.discovery.verdict} ({verdict}). {self.discovery.headline}"

    def opening(self) -> Sequence[Remark]:
        discovery = self.discovery
        verdict = f"verdict: {discovery.verdict} ({tables.verdict_in_words(discovery)})"
        tone: Tone = "good" if discovery.verdict in ("named", "none") else "warning"
        return [Remark(self.data), Remark(verdict, tone), Remark(discovery.headline)]

    def next_step(self) -> NextStep:
        discovery, folder = self.discovery, self.folder or Path()
        if any(experiment.runs for experiment in discovery.experiments):
            drive = "drive the runs above, import them with --set train=*, join both recordings and discover again"
            join = ("omnibench", "import", "dataset", "RECORDED", "--set", "join=NEW", "-o", "BOTH")
            return NextStep("more than one effect explains these data", drive, join)
        kind, to = ("extended", "c_header") if discovery.extends else ("plain", "ros2_controllers")
        command = ("omnibench", "export", folder / CALIBRATION_FILES[kind], "--to", to)
        if discovery.extends:
            what = "closes the gap without a name" if discovery.has_unnamed_term else "holds what the matrix lacked"
            then = "export it" if discovery.dataset.simulated else "use it on the robot"
            return NextStep(f"the extended calibration {what}", then, command)
        return NextStep("nothing was added to the matrix", "use the plain calibration", command)

    def tables(self) -> Sequence[Table]:
        return list(map(_in_brief, self._tables()))

    def _tables(self) -> Iterator[Table]:
        discovery = self.discovery
        if discovery.effects:
            effects = [replace(effect, parameters=effect.parameters[:_PARAMETERS]) for effect in discovery.effects]
            yield tables.parameter_table(effects, discovery.dataset)
        if discovery.where:
            strongest = {found.covariate: found for found in reversed(discovery.where)}  # the first of each covariate
            shown = [found for found in discovery.where if strongest[found.covariate] is found][:_MOST_DEPENDENCES]
            yield tables.dependence_table(shown, "Where the plain matrix fails")
        yield tables.gap_table(discovery)
        if discovery.extrapolations:
            yield tables.extrapolation_table(discovery.extrapolations[:_LINES])
        if discovery.hidden:
            yield tables.hidden_table(discovery.hidden, _HIDDEN)
        yield from (tables.experiment_table(each) for each in discovery.experiments if each.commands)

    def remarks(self) -> Sequence[Remark]:
        return list(map(Remark, self._remarks()))

    def _remarks(self) -> Iterator[str]:
        discovery = self.discovery
        for experiment in discovery.experiments:
            yield experiment.description
        for effect in discovery.effects:
            if effect.in_doubt:
                yield f"In doubt: {effect.name}: {effect.in_doubt}."
        if discovery.left:
            left = dict.fromkeys(f"{each.covariate} ({tables.chance(each.p_value)})" for each in discovery.left)
            yield f"Left over: the residuals still depend on {', '.join(left)}."
        if discovery.classes:
            yield f"These data cannot tell apart: {'; '.join(' or '.join(names) for names in discovery.classes)}."
        if discovery.absorbed:
            yield f"Absorbed by any matrix, and so never named: {', '.join(discovery.absorbed)}."
        yield from (f"- {note}" for note in discovery.notes[:_LINES])
        more = sum(max(0, len(lines) - _LINES) for lines in (discovery.notes, discovery.extrapolations))
        if more:
            yield f"{plural(more, 'more remark')} in the report"
        if self.folder is not None:
            kind = "extended" if discovery.extends else "plain"
            what = "extended calibration" if discovery.extends else "plain calibration, as nothing was added"
            yield f"{what}: {self.folder / CALIBRATION_FILES[kind]}"
            for number, experiment in enumerate(discovery.experiments, 1):
                if experiment.config:
                    yield f"the runs to drive, as a config: {self.folder / experiment_file(number)}"
            yield f"report: {self.folder / 'report.html'}"

    def figures(self) -> Sequence[FigureGrid]:
        return [error_grid(self.discovery)]

    def json(self) -> Mapping[str, Any]:
        return discovery_document(self.discovery, self.folder or Path())

    def frames(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        return {"effects": self._effects, "residuals": lambda: residual_table(self.discovery)}

    def _effects(self) -> pl.DataFrame:
        rows = [
            (effect.name, effect.stage, effect.weight, each.name, each.value, each.unit, each.low, each.high)
            for effect in self.discovery.effects
            for each in effect.parameters
        ]
        return pl.DataFrame(rows, _COLUMNS, orient="row")


def _in_brief(table: Table) -> Table:
    """A table without notes and lesser columns."""
    shown = [index for index, column in enumerate(table.columns) if column.priority == 0]
    rows = (
        row if row.role == "group" else replace(row, cells=tuple(Cell(row.cells[index].text) for index in shown))
        for row in table.rows
    )
    return Table(table.caption, tuple(table.columns[index] for index in shown), tuple(rows))


def residual_table(discovery: Discovery) -> pl.DataFrame:
    """Table of the reference poses of the training runs after their starts, with residuals before and after.

    Residuals are reference minus odometry, by the plain matrix (before) and by the extended model (after), in m and
    rad; whitened ones are independent and of unit variance under the noise.
    """
    trajectories = {trajectory.id: trajectory for trajectory in discovery.dataset.trajectories}
    runs = [trajectories[name] for name in discovery.trajectories]
    columns: dict[str, list[object] | Array] = {
        "trajectory": [run.id for run in runs for _ in run.pose_times[1:]],
        "command": [run.command for run in runs for _ in run.pose_times[1:]],
        "t": np.concatenate([run.pose_times[1:] for run in runs]),
    }
    poses = np.concatenate([run.poses[1:] for run in runs])
    columns |= dict(zip(("x", "y", "theta"), poses.T, strict=True))
    for label, values, names in (
        ("before", discovery.before, ("x_m", "y_m", "heading_rad")),
        ("after", discovery.after, ("x_m", "y_m", "heading_rad")),
        ("whitened_before", discovery.whitened_before, ("x", "y", "heading")),
        ("whitened_after", discovery.whitened_after, ("x", "y", "heading")),
    ):
        columns |= dict(zip((f"{label}_{name}" for name in names), np.concatenate(values).T, strict=True))
    return pl.DataFrame(columns, schema_overrides={"command": pl.String})
