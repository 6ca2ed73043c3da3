"""A comparison of calibrators in a notebook."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import plotly.graph_objects as go
import polars as pl

from omnibench.compare.output import result_table
from omnibench.compare.report.answer import entry_chart
from omnibench.compare.report.robots import robots_answer, robots_sentence
from omnibench.compare.report.view import views
from omnibench.compare.result import ComparisonResult
from omnibench.errors import DataError, require_choice
from omnibench.report.blocks import FigureGrid
from omnibench.report.figures import drawn
from omnibench.views import View
from omnibench.words import plural

_ENTRIES = 14  # shown in a text


class ComparisonView(View):
    """A comparison: the best entry of each data set, the costs of all; of several robots the answer."""

    shown: ComparisonResult

    def lines(self) -> Iterator[str]:
        result = self.shown
        runs, sets = plural(len(result.runs), "run"), ", ".join(result.datasets)
        yield f"Comparison {result.config.name!r}: {runs} on {sets}, in {result.output}"
        if result.config.robots:
            yield f"  {robots_sentence(result)}"
        for name, best in result.held_out.items():
            yield f"  {name}, {best.label}: {best.verdict.sentence}"
        for entry in result.statistics[:_ENTRIES]:
            cost = next((entry.cost(split) for split in ("validation", "train") if entry.cost(split)), None)
            shown = "no answer" if cost is None else f"{cost.value:.6f}"
            if cost is not None and entry.practically_equal is not False:
                shown += ", the best" if entry.is_best else ", not told apart from the best"
            yield f"  {entry.dataset} {entry.label}: cost {shown}"

    def tables(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        names = ("study",) if self.shown.config.robots else ("statistics", "runs", "errors", "history", "study")
        return {name: partial(result_table, self.shown, name) for name in names}

    def figure(self, dataset: str | None = None) -> go.Figure:
        """The cost of every entry with its 95 % interval. dataset: the name of one, if there are several."""
        if self.shown.config.robots:
            grids = [block for block in robots_answer(self.shown).blocks if isinstance(block, FigureGrid)]
            if not grids:
                raise DataError("no method is compared with published ones: there is nothing to draw")
            return drawn(grids[0])
        of_sets = {view.name: view for view in views(self.shown)}
        name = next(iter(of_sets)) if dataset is None else dataset
        require_choice("data set", name, of_sets)
        grid = entry_chart(of_sets[name])
        if grid is None:
            raise DataError(f"{name}: no entry was calibrated, so that there is nothing to draw")
        return drawn(grid)
