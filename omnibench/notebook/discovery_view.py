"""A discovery in a notebook."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import plotly.graph_objects as go
import polars as pl

from omnibench.discover.output import residual_table
from omnibench.discover.report.evidence_figures import gap_grid
from omnibench.discover.report.tables import effect_in_words, verdict_in_words
from omnibench.discover.result import Discovery
from omnibench.report.figures import drawn
from omnibench.views import View

_COLUMNS = {
    **dict.fromkeys(("effect", "stage"), pl.String),
    "weight": pl.Float64,
    "parameter": pl.String,
    "value": pl.Float64,
    "unit": pl.String,
    **dict.fromkeys(("low", "high"), pl.Float64),
}


class DiscoveryView(View):
    """A discovery: its verdict, the effects, the errors before and after."""

    shown: Discovery

    def lines(self) -> Iterator[str]:
        discovery = self.shown
        yield f"Discovery on {discovery.dataset.name!r}: {discovery.verdict} ({verdict_in_words(discovery)})"
        yield f"  {discovery.headline}"
        yield from (f"  {effect_in_words(effect)}" for effect in discovery.effects)

    def tables(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        return {"effects": self._effects, "residuals": lambda: residual_table(self.shown)}

    def _effects(self) -> pl.DataFrame:
        rows = [
            (effect.name, effect.stage, effect.weight, each.name, each.value, each.unit, each.low, each.high)
            for effect in self.shown.effects
            for each in effect.parameters
        ]
        return pl.DataFrame(rows, _COLUMNS, orient="row")

    def figure(self) -> go.Figure:
        return drawn(gap_grid(self.shown))
