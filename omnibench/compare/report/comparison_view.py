"""A comparison of calibrators at a prompt and in a notebook."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import plotly.graph_objects as go
import polars as pl

from omnibench.compare.output import result_table
from omnibench.compare.report.headline import entry_chart
from omnibench.compare.report.view import views
from omnibench.compare.result import ComparisonResult
from omnibench.errors import DataError, require_choice
from omnibench.report.blocks import Column, Row, Table
from omnibench.report.figures import drawn
from omnibench.report.result import Result
from omnibench.words import plural


class ComparisonView(Result):
    """A comparison: the best entry of each data set, the costs of all."""

    def __init__(self, result: ComparisonResult) -> None:
        self.result = result
        runs, sets = plural(len(result.runs), "run"), ", ".join(result.datasets)
        self.title = f"Comparison {result.config.name!r}: {runs} on {sets}, in {result.output}"

    def sentence(self) -> str:
        best = self.result.held_out.items()
        return "; ".join(f"{name}, {entry.label}: {entry.verdict.sentence}" for name, entry in best)

    def tables(self) -> Sequence[Table]:
        rows = []
        for entry in self.result.statistics:
            cost = next((entry.cost(split) for split in ("validation", "train") if entry.cost(split)), None)
            shown = "no answer" if cost is None else f"{cost.value:.6f}"
            beside = "the best" if entry.is_best else "not told apart from the best"
            beside = beside if cost is not None and entry.practically_equal is not False else ""
            rows.append(Row.of(entry.dataset, entry.label, shown, beside))
        names = ("data set", "entry", "cost", "")
        columns = tuple(Column(name, numeric=name == "cost") for name in names)
        return [Table("", columns, tuple(rows))]

    def frames(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        return {name: partial(result_table, self.result, name) for name in ("statistics", "runs", "errors", "history")}

    def figure(self, dataset: str | None = None) -> go.Figure:
        """The cost of every entry with its 95 % interval. dataset: the name of one, if there are several."""
        of_sets = {view.name: view for view in views(self.result)}
        name = next(iter(of_sets)) if dataset is None else dataset
        require_choice("data set", name, of_sets)
        grid = entry_chart(of_sets[name])
        if grid is None:
            raise DataError(f"{name}: no entry was calibrated, so that there is nothing to draw")
        return drawn(grid)
