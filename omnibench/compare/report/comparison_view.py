"""A comparison as it shows itself: on a terminal, in its report, in a notebook and as JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import plotly.graph_objects as go
import polars as pl

from omnibench.compare.output import calibration_file, result_tables, summary
from omnibench.compare.report import tables
from omnibench.compare.report.answer import answer_sentence, entry_chart, ratio_chart, robots_sentence
from omnibench.compare.report.document import comparison_document
from omnibench.compare.report.view import views
from omnibench.compare.result import ComparisonResult
from omnibench.errors import DataError, require_choice
from omnibench.report.blocks import Document, Table, Tone
from omnibench.report.calibration_report import how_to_use
from omnibench.report.figures import drawn
from omnibench.report.result import NextStep, Remark, Result
from omnibench.robot.calibration import read_calibration
from omnibench.words import plural

_SHOWN = 3  # failures that are listed; the others are counted (chosen)
_TONES: Mapping[str, Tone] = {"better": "good", "worse": "bad"}  # by verdict; the others are warnings


class ComparisonView(Result):
    """The answer in a table; with ``everything`` all tables of the report and all failures."""

    def __init__(self, result: ComparisonResult, *, everything: bool = False) -> None:
        self.result, self.everything = result, everything
        runs, sets = plural(len(result.runs), "run"), ", ".join(result.datasets)
        self.title = f"Comparison {result.config.name!r}: {runs} on {sets}, in {result.output}"
        self.warnings = result.warnings

    def sentence(self) -> str:
        if self.result.config.robots:
            return robots_sentence(self.result)
        return "; ".join(answer_sentence(view) for view in views(self.result))

    def next_step(self) -> NextStep:
        result = self.result
        if result.nothing_answered:
            first = result.failures[0] if result.failures else "no method is for these robots"
            what = "no method gave an answer" if result.config.robots else "every search failed"
            return NextStep(f"{what}, the first: {first}", "mend what its reason names, and run again")
        if result.broken:
            ending = f"{plural(len(result.broken), 'robot')} left out, whose recordings cannot be read"
            return NextStep(ending, "say where they are with --data, or take them out of the config, and run again")
        if result.config.robots:
            return NextStep(robots_sentence(result).rstrip("."), self._reading)
        compared = f"{plural(len({run.fit.label for run in result.runs}), 'entry')} compared"
        name, best = next(iter(result.held_out.items()), ("", None))
        file = None if best is None else calibration_file(result, name, best.label)
        if best is None or file is None:
            return NextStep(f"{compared} in {result.output}", self._reading)
        if best.verdict.verdict == "better":
            outcome = f"{compared}; the best on {name}, {best.label}, beats the design on runs held out"
            return NextStep(outcome, *how_to_use(read_calibration(file), file))
        unsure = f"{compared}; that the best on {name}, {best.label}, beats the design was not shown by runs held out"
        return NextStep(unsure, "record more runs for validation, and compare again")

    @property
    def _reading(self) -> str:
        return f"read {self.result.output / 'report.html'}"

    def tables(self) -> Sequence[Table]:
        result, shown = self.result, list[Table]()
        if result.config.robots:
            shown.append(tables.methods_table(result))
            more = [tables.cell_table(result, cell) for cell in result.judged_cells]
            return [*shown, *more, tables.outcome_table(result, result.runs)] if self.everything else shown
        for view in views(result):
            shown.append(tables.cost_table(view, view.scored, brief=not self.everything))
            if self.everything:
                shown += [tables.cost_table(view, split) for split in view.splits[1:]]
                ways = (False, True) if len(view.runs) > len(view.statistics) else (False,)
                shown += [tables.outcome_table(result, view.runs, every=every) for every in ways]
        return shown

    def remarks(self) -> Sequence[Remark]:
        result = self.result
        found = [Remark(f"cannot be read: {name}: {reason}", "warning") for name, reason in result.broken.items()]
        shown = len(result.failures) if self.everything else _SHOWN
        found += [Remark(f"no answer: {failure}", "warning") for failure in result.failures[:shown]]
        if len(result.failures) > shown:
            found.append(Remark(f"no answer: {len(result.failures) - shown} more; --all lists them", "warning"))
        for name, entry in result.held_out.items():
            tone = _TONES.get(entry.verdict.verdict, "warning")
            found.append(Remark(f"{name}, {entry.label}: {entry.verdict.sentence}", tone))
            found += [Remark(sentence, "warning") for sentence in result.sessions.get(name, ())]
        return [*found, Remark(f"report: {result.output / 'report.html'}")]

    def document(self) -> Document:
        return comparison_document(self.result)

    def page(self) -> Document:
        return self.document() if self.next_step().then == self._reading else super().page()

    def json(self) -> Mapping[str, Any]:
        return summary(self.result)

    def frames(self) -> Mapping[str, Callable[[], pl.DataFrame]]:
        return result_tables(self.result)

    def figure(self, dataset: str | None = None) -> go.Figure:
        """The cost of every entry with its 95 % interval. dataset: the name of one, if there are several.

        Of several robots: the reference method beside the best published one, cell by cell.
        """
        of_sets = {view.name: view for view in views(self.result)}
        if not of_sets:
            grid = ratio_chart(self.result)
            missing = "no method is compared with published ones"
        else:
            name = next(iter(of_sets)) if dataset is None else dataset
            require_choice("data set", name, of_sets)
            grid, missing = entry_chart(of_sets[name]), f"{name}: no entry was calibrated"
        if grid is None:
            raise DataError(f"{missing}: there is nothing to draw")
        return drawn(grid)
