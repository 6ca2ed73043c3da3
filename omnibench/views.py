"""Short texts, data frames and figures of public objects, for a Python prompt and for notebooks.

What an object shows is said by its result in the rooms above (``omnibench.report.result``): here the object's class
names that, which is imported when it is first asked for.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields
from importlib import import_module
from inspect import signature
from typing import TYPE_CHECKING, Any, Literal, overload

from omnibench.errors import ConfigError, require_choice

if TYPE_CHECKING:
    import plotly.graph_objects as go
    import polars as pl

# Module and class of the result, by the class that is shown: a plug-in's may be called the same.
_RESULTS = {
    "omnibench.robot.calibration.Calibration": ("report.calibration_report", "CalibrationResult"),
    "omnibench.fit.calibrate.CalibrationRun": ("report.calibration_report", "CalibrationResult"),
    "omnibench.compare.result.ComparisonResult": ("compare.report.comparison_view", "ComparisonView"),
    "omnibench.data.dataset.Dataset": ("report.recording.data_results", "DatasetResult"),
    "omnibench.discover.result.Discovery": ("discover.report.discovery_result", "DiscoveryResult"),
    "omnibench.fit.evaluate.Evaluation": ("report.calibration_report", "EvaluationResult"),
    "omnibench.robot.kinematics.Robot": ("report.recording.data_results", "RobotResult"),
    "omnibench.data.dataset.Trajectory": ("report.recording.data_results", "TrajectoryResult"),
}
_LINES = 20  # of a text, at most: a screenful with what was typed
_WIDTH = 120  # characters of a line of such a text
_VALUE = 60  # characters of a field's value in it


class Brief:
    """A mixin for dataclasses: their repr names the fields and shortens their values, arrays to their shapes."""

    def __repr__(self) -> str:
        named = ((field.name, getattr(self, field.name)) for field in fields(self) if field.repr)  # type: ignore[arg-type]
        return brief(type(self).__name__, named)


class Shown:
    """A mixin for results: a short text, tables as Polars data frames and a Plotly figure."""

    def __repr__(self) -> str:
        return str(_of_reports("as_text")(_result(self)))

    def __str__(self) -> str:
        return repr(self)

    def _repr_html_(self) -> str:
        """Title, sentence and tables, for notebooks."""
        return str(_of_reports("as_html")(_result(self)))

    @overload
    def to_frame(self, table: str | None = None, *, pandas: Literal[False] = False) -> pl.DataFrame: ...
    @overload
    def to_frame(self, table: str | None = None, *, pandas: bool) -> Any: ...
    def to_frame(self, table: str | None = None, *, pandas: bool = False) -> Any:
        """One of the object's tables as a data frame of Polars, or of pandas, in SI units; default: the first.

        Of a data set: trajectories, wheels, poses, references. A trajectory: wheels, poses, references. A robot:
        wheels. A calibration and a run of ``calibrate``: matrix, parameters. An evaluation: splits, references. A
        comparison: statistics, runs, errors, history. A discovery: effects, residuals. UnknownNameError lists those
        that there are.
        """
        tables = _result(self).frames()
        name = next(iter(tables)) if table is None else table
        require_choice("table", name, tables)
        return as_pandas(tables[name]()) if pandas else tables[name]()

    def plot(self, **options: Any) -> go.Figure:
        """The object as a Plotly figure.

        A data set: the reference paths of its runs from one start. A trajectory: its path. A robot: its wheels from
        above. A calibration: each element's difference from the design with its standard deviation, of a run of
        ``calibrate`` with its 95 % interval; or with ``dataset=`` the paths of a few runs before and after. A
        comparison: the cost of every entry (``dataset=`` names one of several). A discovery: the errors before and
        after.
        """
        result = _result(self)
        parameters = signature(result.figure).parameters
        for option in sorted(options):
            require_choice("option of plot", option, parameters)
        return result.figure(**options)


def as_pandas(frame: pl.DataFrame) -> Any:
    """A Polars frame as a pandas one. ConfigError: pandas is not installed."""
    try:
        from pandas import DataFrame
    except ImportError:
        raise ConfigError('pandas is not installed; pip install "omnibench[pandas]"') from None
    return DataFrame({column.name: column.to_list() for column in frame.iter_columns()})


def brief(name: str, values: Iterable[tuple[str | None, Any]]) -> str:
    """An object in at most twenty lines: its class and its fields, with what is long shortened."""
    fields_shown = [f"{field}={_shortened(value)}" if field else _shortened(value) for field, value in values]
    line = f"{name}({', '.join(fields_shown)})"
    if len(line) <= _WIDTH:
        return line
    return "\n".join(screenful([f"{name}(", *(f"  {shown}," for shown in fields_shown)], ")"))


def screenful(lines: Iterable[str], end: str = "") -> list[str]:
    """At most twenty lines of at most 120 characters, the last of which is ``end`` if it is given."""
    cut = [line if len(line) <= _WIDTH else f"{line[: _WIDTH - 4]} ..." for line in lines]
    last = [end] if end else []
    room = _LINES - len(last)
    if len(cut) > room:
        cut = [*cut[: room - 1], f"  ... {len(cut) - room + 1} more lines"]
    return [*cut, *last]


def _shortened(value: Any) -> str:
    """A value in a few words: an array by its shape, a collection by its length where it is long."""
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple) and shape:
        return f"<array {shape}>"
    if isinstance(value, str | bytes) and len(value) > _VALUE:
        return f"{value[: _VALUE - 4]!r}..."
    if isinstance(value, Mapping | tuple | list) and len(value) > 3:
        return f"<{len(value)} items>"
    words = " ".join(repr(value).split())
    return words if len(words) <= _VALUE else f"<{type(value).__name__}>"


def _result(shown: Shown) -> Any:
    """The result of an object, by its class."""
    kinds = (f"{kind.__module__}.{kind.__qualname__}" for kind in type(shown).__mro__)
    module, name = next(_RESULTS[kind] for kind in kinds if kind in _RESULTS)
    return getattr(import_module(f"omnibench.{module}"), name)(shown)


def _of_reports(name: str) -> Any:
    """A renderer of the room above."""
    return getattr(import_module("omnibench.report.terminal"), name)
