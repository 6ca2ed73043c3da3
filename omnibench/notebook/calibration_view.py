"""A calibration, a run of ``calibrate`` and an evaluation in a notebook."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import plotly.graph_objects as go
import polars as pl

from omnibench.data.dataset import Dataset
from omnibench.errors import DataError, require_type
from omnibench.fit.calibrate import CalibrationRun
from omnibench.fit.evaluate import Evaluation, SplitErrors
from omnibench.report.blocks import LegendItem
from omnibench.report.figures import drawn
from omnibench.report.path_pictures import CALIBRATED, DESIGN_ITEM, paths_before_after
from omnibench.report.style import PALETTE, plot, text
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.views import View

_ROWS = (("x", "m/rad"), ("y", "m/rad"), ("heading", "rad/rad"))
_CALIBRATED = LegendItem("calibrated", "calibration", CALIBRATED)
_SIGNALS = 4  # columns of a matrix that a text shows
_WARNINGS = 4  # shown of a run
_FINAL = ("trajectories", "cost", "position_mean_m", "position_max_m", "heading_mean_rad", "heading_max_rad")


class CalibrationView(View):
    """A calibration: its matrix, the deviation from the design, paths before and after."""

    shown: Calibration

    @property
    def calibration(self) -> Calibration:
        """The calibration that is shown."""
        return self.shown

    def lines(self) -> Iterator[str]:
        calibration = self.calibration
        drive, origin = calibration.robot.drive, calibration.provenance
        fitted = "" if origin is None else f", fitted to {origin.dataset} by {origin.calibrator}"
        yield f"{type(self.shown).__name__} {calibration.name!r} of robot {calibration.robot.name}{fitted}"
        more = " ..." if len(drive.names) > _SIGNALS else ""
        yield f"  {'':17}{''.join(f'{name:>13}' for name in drive.names[:_SIGNALS])}{more}"
        for (name, unit), row in zip(_ROWS, calibration.matrix, strict=True):
            yield f"  {f'{name} ({unit})':17}{''.join(f'{value:+13.7f}' for value in row[:_SIGNALS])}{more}"
        if calibration.effects:
            yield f"  effects: {calibration.effects_in_words}"
        if origin is not None and origin.held_out is not None:
            yield f"  {origin.held_out.sentence}"

    def intervals(self) -> tuple[Array, Array] | None:
        """Ends (3, M) of the elements' 95 % intervals; a file does not say by how many runs its covariance is known."""
        return None

    def deviations(self) -> Array | None:
        """Standard deviations (3, M) of the elements by the covariance; NaN where it tells nothing."""
        if self.calibration.covariance is None:
            return None
        matrix = self.calibration.matrix_array
        variances = np.diag(np.array(self.calibration.covariance))[: matrix.size].reshape(matrix.shape)
        return np.sqrt(np.where(variances > 0, variances, np.nan))

    def tables(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        return {"matrix": self._matrix, "parameters": self._parameters}

    def _parameters(self) -> pl.DataFrame:
        """The physical parameters, a row for each."""
        schema = {"name": pl.String, "design": pl.Float64, "value": pl.Float64, "unit": pl.String}
        rows = [each.model_dump() for each in self.calibration.physical_parameters.values()]
        return pl.DataFrame(rows, {**schema, "low": pl.Float64, "high": pl.Float64})

    def _matrix(self) -> pl.DataFrame:
        calibration = self.calibration
        columns: dict[str, Array | None] = {
            "value": calibration.matrix_array,
            "design": calibration.robot.inverse_kinematic_matrix,
            "standard_deviation": self.deviations(),
        }
        if (ends := self.intervals()) is not None:
            columns |= dict(zip(("low", "high"), ends, strict=True))
        signals = calibration.robot.drive.names
        named = {
            "row": [name for name, _ in _ROWS for _ in signals],
            "signal": [*signals] * len(_ROWS),
            "unit": [unit for _, unit in _ROWS for _ in signals],
        }
        untold = np.full(len(named["row"]), np.nan)
        numbers = {name: untold if each is None else each.ravel() for name, each in columns.items()}
        return pl.DataFrame({**named, **numbers}).fill_nan(None)

    def figure(self, dataset: Dataset | None = None) -> go.Figure:
        return self._deviations() if dataset is None else self._paths(dataset)

    def _deviations(self) -> go.Figure:
        """Each element's difference from the design, in % of its row's scale, with its interval or its deviation."""
        frame = self._matrix()
        scales = np.repeat(self.calibration.robot.row_scales, len(self.calibration.robot.drive.names)) / 100
        told = "low" in frame.columns
        value, deviation = frame["value"], frame["standard_deviation"]
        ends = (frame["low"], frame["high"]) if told else (value - deviation, value + deviation)
        scaled = {
            name: (column - frame["design"]) / scales
            for name, column in zip(("value", "low", "high"), (frame["value"], *ends), strict=True)
        }
        names = [text(f"{row}: {signal}") for row, signal in zip(frame["row"], frame["signal"], strict=True)]
        error = {
            "type": "data",
            "array": (scaled["high"] - scaled["value"]).to_list(),
            "arrayminus": (scaled["value"] - scaled["low"]).to_list(),
        }
        marker = {"color": PALETTE[0], "size": 9}
        dots = go.Scatter(x=scaled["value"].to_list(), y=names, mode="markers", marker=marker, error_x=error)
        figure = plot(dots, x_title="difference from the design, % of the row's scale")
        figure.add_vline(x=0.0, line={"width": 1, "dash": "dot"})
        figure.update_yaxes(autorange="reversed")
        bars = "95 % intervals" if told else "standard deviations"
        title = f"{text(self.calibration.name)}: elements of the matrix with {bars}"
        figure.update_layout(title_text=title, title_x=0.02, height=160 + 28 * len(names), margin={"l": 110, "t": 60})
        return figure

    def _paths(self, dataset: Dataset) -> go.Figure:
        """Paths of a few runs, held out where some are, by the design and by the calibration."""
        require_type(dataset, Dataset, "load_dataset")
        self.calibration.check_wheels(dataset.robot, f"the data set {dataset.name}")
        held_out = dataset.split("validation")
        runs = [run for run in held_out or dataset.trajectories if len(run.poses) > 1]
        design = OdometryModel.of_design(dataset.robot, self.calibration.integration)
        models = [(DESIGN_ITEM, design), (_CALIBRATED, self.calibration.model)]
        grid = paths_before_after(runs, models, "held-out" if held_out else "")
        if grid is None:
            raise DataError(f"data set {dataset.name}: no run has a path of poses to draw")
        return drawn(grid)


class CalibrationRunView(CalibrationView):
    """A run of ``calibrate``: the calibration, how the search ended and what the data leave open."""

    shown: CalibrationRun  # type: ignore[assignment]

    @property
    def calibration(self) -> Calibration:
        return self.shown.calibration

    def lines(self) -> Iterator[str]:
        yield from super().lines()
        yield f"  {self.shown.result.outcome}: {self.shown.result.reason}"
        yield from (f"  warning: {warning}" for warning in self.shown.warnings[:_WARNINGS])

    def intervals(self) -> tuple[Array, Array] | None:
        if self.shown.uncertainty is None:
            return None
        return self.shown.uncertainty.intervals.low, self.shown.uncertainty.intervals.high


class EvaluationView(View):
    """An evaluation: errors on every split, beside those of the design."""

    shown: Evaluation

    def lines(self) -> Iterator[str]:
        evaluation = self.shown
        yield f"Evaluation on {evaluation.dataset!r}, {evaluation.trajectories} runs"
        for split, errors in evaluation.splits.items():
            design = evaluation.design[split]
            yield f"  {split}: {_before_after(design, errors)}"
        yield f"  {evaluation.held_out.sentence}"

    def tables(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        told = any(errors.references for errors in self.shown.splits.values())
        return {"splits": self._splits, **({"references": self._references} if told else {})}

    def _splits(self) -> pl.DataFrame:
        rows = [labels | {name: vars(errors)[name] for name in _FINAL} for labels, errors in self._of_models()]
        return pl.DataFrame(rows, infer_schema_length=None)

    def _references(self) -> pl.DataFrame:
        """Errors at the references, by split, model and kind."""
        return pl.DataFrame([labels | dict(at) for labels, errors in self._of_models() for at in errors.references])

    def _of_models(self) -> Iterator[tuple[dict[str, Any], SplitErrors]]:
        """The errors on every split with its name and the model's."""
        for model, splits in (("calibration", self.shown.splits), ("design", self.shown.design)):
            for split, errors in splits.items():
                yield {"split": split, "model": model}, errors

    def figure(self) -> go.Figure:
        """Mean position errors on every split, before and after."""
        frame = self._splits()
        bars = []
        for model, colour in (("design", DESIGN_ITEM.colour), ("calibration", CALIBRATED)):
            rows = frame.filter(pl.col("model") == model)
            values = (1000 * rows["position_mean_m"].cast(pl.Float64)).to_list()
            bars.append(go.Bar(x=rows["split"].to_list(), y=values, name=model, marker_color=colour))
        figure = go.Figure(bars, layout=plot(y_title="mean position error at the end (mm)").layout)
        figure.update_layout(title_text=text(f"{self.shown.dataset}: before and after"), showlegend=True)
        return figure


def _before_after(design: SplitErrors, errors: SplitErrors) -> str:
    """Mean errors by the design and by a calibration; of runs that have no poses by their references."""
    told = [
        f"{what} {before:.4f} -> {after:.4f} {unit}"
        for what, before, after, unit in (
            ("position error", design.position_mean_m, errors.position_mean_m, "m"),
            ("heading error", design.heading_mean_rad, errors.heading_mean_rad, "rad"),
        )
        if before is not None and after is not None
    ]
    return f"mean {', '.join(told)}" if told else f"cost {design.cost:.4f} -> {errors.cost:.4f}"
