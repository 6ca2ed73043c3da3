"""Figures of the evidence: candidates of each step, errors after each step, gaps, effects that may still hide."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import plotly.graph_objects as go

from omnibench.discover.report.before_after import AFTER, ALONE, EXTENDED, FLOOR, PLAIN
from omnibench.discover.report.wording import (
    METRICS,
    added,
    closed_in_words,
    decisive,
    floor_in_words,
    gap_decimals,
    held_out_in_words,
    reading,
    weight_in_words,
    worst_of_each,
)
from omnibench.discover.result import Candidate, Discovery, Gap, Hidden, Step
from omnibench.report.blocks import Figure, FigureGrid, LegendItem
from omnibench.report.numbers import decimals_for, fixed
from omnibench.report.style import INK, QUIET, logarithmic, plot, text, wrapped
from omnibench.report.traces import coordinates, marks

EvidenceFigure = Callable[[Discovery], FigureGrid | None]
_NAME = 20  # characters of a line of an effect's name
_CANDIDATES = 8  # shown of each step, at most; only the drawing hangs on it
_CHOSEN, _UNCHOSEN = LegendItem("chosen", "added", AFTER), LegendItem("other", "not added", "#b9c0c8")
_FLOOR = LegendItem("floor", "floor", FLOOR)
_FLOOR_LINE = LegendItem("floor", "floor", FLOOR, "dash")
_GAINED = LegendItem("down", "gained by an effect", "#7fb8d8")
_LOST = LegendItem("up", "lost by an effect", "#e3a3a3")
_RESULT = LegendItem("after", "extended model", AFTER)
_LIMIT = LegendItem("limit", "dot: could be this large (95 %)", AFTER)
_DETECTABLE = LegendItem("detectable", "diamond: found nearly always from here on", INK, symbol="diamond-open")


def candidate_grid(discovery: Discovery) -> FigureGrid | None:
    """The chi-square difference of every effect that was tried, for each step."""
    found = {effect.name for effect in discovery.effects}
    figures = []
    for number, tried in enumerate(discovery.candidates, 1):
        shown = sorted((each for each in tried if each.chi_square > 0), key=lambda each: -each.chi_square)[:_CANDIDATES]
        if not shown:
            continue
        chosen = next((each.name for each in shown if each.name in found and _is_step(discovery, number, each)), None)
        title = f"Step {number}: {f'{chosen} is added' if chosen else 'nothing is added'}"
        figures.append(
            Figure(
                title,
                _candidate_bars(shown, chosen),
                "Fall of the whitened chi2 with each candidate: "
                + ", ".join(
                    f"{each.name} {each.chi_square:.3g}, weight {weight_in_words(each.weight)}" for each in shown
                ),
                80 + 34 * len(shown),
            )
        )
    if not figures:
        return None
    return FigureGrid(
        tuple(figures),
        (_CHOSEN, _UNCHOSEN),
        2 if len(figures) > 1 else 1,
        "By how much each candidate would lower the whitened χ² of the training runs, the "
        f"{_CANDIDATES} largest; at the bars, the weight of the name and the degrees of freedom.",
    )


def _is_step(discovery: Discovery, number: int, candidate: Candidate) -> bool:
    """True if a candidate is the effect that the step added."""
    if number < len(discovery.steps):
        return added(discovery.steps[number]) == candidate.name
    return False


def _candidate_bars(shown: Sequence[Candidate], chosen: str | None) -> go.Figure:
    bars = [
        _Bar(
            wrapped(each.name, _NAME),
            0.0,
            each.chi_square,
            f"{weight_in_words(each.weight)}, {each.degrees_of_freedom} df",
            _CHOSEN if each.name == chosen else _UNCHOSEN,
        )
        for each in shown
    ]
    return _bars(bars, "gain in whitened χ²", 1.55)


@dataclass(frozen=True)
class _Bar:
    """A horizontal bar from low to high with its label, and its item of the legend."""

    name: str
    low: float
    high: float
    label: str
    item: LegendItem


def _bars(bars: Sequence[_Bar], x_title: str, room: float) -> go.Figure:
    """A plot of bars from the top down. room: width of the plot as a multiple of the longest bar, for the labels."""
    traces = []
    for item in dict.fromkeys(bar.item for bar in bars):
        own = [bar for bar in bars if bar.item == item]
        traces.append(
            go.Bar(
                y=[text(bar.name) for bar in own],
                x=coordinates([bar.high - bar.low for bar in own]),
                base=coordinates([bar.low for bar in own]),
                orientation="h",
                marker={"color": item.colour},
                text=[bar.label for bar in own],
                textposition="outside",
                cliponaxis=False,
                textfont={"size": 12, "color": INK},
                legendgroup=item.key,
                hovertemplate="%{y}: %{text}<extra></extra>",
            )
        )
    figure = plot(*traces, barmode="overlay", x_title=x_title)
    figure.update_xaxes(range=[0, room * max(bar.high for bar in bars)])
    figure.update_yaxes(
        ticks="", tickfont_color=INK, categoryorder="array", categoryarray=[text(bar.name) for bar in reversed(bars)]
    )
    return figure


def waterfall_grid(discovery: Discovery) -> FigureGrid | None:
    """The error after each step, down to the noise floor."""
    steps = discovery.steps
    if len(steps) < 2:
        return None
    held = decisive(discovery)
    unseen = held is not None and all(step.eq6_held_out is not None and step.held_out is not None for step in steps)
    if unseen and held is not None:
        where = held_out_in_words(discovery, held)
        values = [[step.eq6_held_out for step in steps], [step.held_out for step in steps]]
        floors: list[float | None] = [held.eq6.floor, held.chi2.floor]
    else:
        where, gap = "training runs", discovery.gap
        values = [[step.eq6_train for step in steps], [step.train for step in steps]]
        floors = [gap.floor if gap.metric == metric and not discovery.held_out else None for metric in METRICS]
    figures = tuple(
        Figure(
            f"{title}, {where}",
            _waterfall(steps, [value for value in own if value is not None], floor, title),
            f"{title} of the plain matrix and after each effect that was added, {where}",
            110 + 44 * (len(steps) + 1),
        )
        for title, own, floor in zip(METRICS.values(), values, floors, strict=True)
    )
    lost = (_LOST,) if any(_rises(own) for own in values) else ()
    line = (_FLOOR_LINE,) if any(floor is not None for floor in floors) else ()
    return FigureGrid(figures, (ALONE, _GAINED, *lost, _RESULT, *line), 2)


def _rises(values: Sequence[float | None]) -> bool:
    known = [value for value in values if value is not None]
    return any(after > before for before, after in pairwise(known))


def _waterfall(steps: Sequence[Step], values: Sequence[float], floor: float | None, title: str) -> go.Figure:
    decimals = max(2, min(6, decimals_for(min(value for value in values if value > 0))))
    bars = [_Bar("plain matrix", 0.0, values[0], fixed(values[0], decimals), ALONE)]
    for step, (before, after) in zip(steps[1:], pairwise(values), strict=True):
        item = _GAINED if after <= before else _LOST
        label = fixed(after - before, decimals, signed=True)
        bars.append(_Bar(wrapped(f"+ {added(step)}", _NAME), min(before, after), max(before, after), label, item))
    bars.append(_Bar("extended model", 0.0, values[-1], fixed(values[-1], decimals), _RESULT))
    figure = _bars(bars, title, 1.25)
    if floor is not None:
        figure.add_vline(x=floor, line={"color": FLOOR, "width": 2, "dash": "dash"})
    return figure


def gap_grid(discovery: Discovery) -> FigureGrid:
    """Errors before and after and the noise floor, on the training runs and on the held-out runs."""
    gaps: list[tuple[str, Gap]] = []
    for held in discovery.held_out:
        where = held_out_in_words(discovery, held)
        gaps += [(where, held.eq6), (where, held.chi2)]
    if not gaps:
        gaps.append(("training runs", discovery.gap))
    figures = tuple(
        Figure(
            _gap_title(discovery, gap, name),
            _gap_bars(gap, discovery.extends),
            f"{METRICS[gap.metric]} on {name}: "
            + ", ".join(f"{bar} {value:.4g}" for bar, value, _ in _gap_values(gap, discovery.extends)),
            190 if discovery.extends else 150,
        )
        for name, gap in gaps
    )
    line = (_FLOOR,) if any(gap.floor is not None for _, gap in gaps) else ()
    return FigureGrid(
        figures,
        (*((PLAIN, EXTENDED) if discovery.extends else (ALONE,)), *line),
        2 if len(figures) > 1 else 1,
        floor_in_words(discovery),
    )


def _gap_title(discovery: Discovery, gap: Gap, name: str) -> str:
    title = f"{METRICS[gap.metric]}, {name}"
    if not discovery.extends:
        return title
    return f"{title}: {closed_in_words(gap)}{'' if gap.closed is None else ' closed'}"


def _gap_values(gap: Gap, extends: bool) -> tuple[tuple[str, float, LegendItem], ...]:
    """Names, values and legend of the bars: the plain matrix alone and the floor where nothing was added."""
    floor = () if gap.floor is None else (("floor", gap.floor, _FLOOR),)
    if not extends:
        return ("plain matrix", gap.before, ALONE), *floor
    return ("before", gap.before, PLAIN), ("after", gap.after, EXTENDED), *floor


def _gap_bars(gap: Gap, extends: bool) -> go.Figure:
    decimals = gap_decimals(gap)
    bars = [_Bar(name, 0.0, value, fixed(value, decimals), item) for name, value, item in _gap_values(gap, extends)]
    return _bars(bars, METRICS[gap.metric], 1.25)


def hidden_grid(hidden: Sequence[Hidden]) -> FigureGrid | None:
    """The largest size at which each effect could stay unseen, as a share of its plausible size."""
    shown = [each for each in reversed(worst_of_each(hidden)) if each.plausible > 0 and each.limit > 0]
    if not shown:
        return None
    names = [wrapped(f"{each.name}: {each.parameter}") for each in shown]
    traces = []
    for item, values, words in (
        (_LIMIT, [each.limit for each in shown], "at most"),
        (_DETECTABLE, [each.detectable for each in shown], "found nearly always from"),
    ):
        shares = [100 * value / each.plausible for value, each in zip(values, shown, strict=True)]
        sizes = [f"{words} ±{reading(each.unit).words(value, 2)}" for value, each in zip(values, shown, strict=True)]
        traces.append(marks(item, 9, shares, names, hover="%{y}<br>%{text}", words=sizes, marker_line_width=1.5))
    figure = plot(*traces, x_title="% of the plausible range")
    shares = [100 * value / each.plausible for each in shown for value in (each.limit, each.detectable)]
    logarithmic(figure, "x", min([*shares, 50.0]), max([*shares, 200.0]))
    figure.add_vline(x=100, line={"color": QUIET, "width": 1.2, "dash": "dot"})
    figure.update_yaxes(ticks="", tickfont_color=INK, showgrid=True)
    return FigureGrid(
        (
            Figure(
                "What could still hide, as a share of what is plausible",
                figure,
                "For each effect that was not found, how large it could be unseen in per cent of its plausible range",
                90 + 34 * len(shown),
            ),
        ),
        (_LIMIT, _DETECTABLE),
        1,
        "Each effect is shown by the parameter that could be largest. The dotted line is the end of the plausible "
        "range, 100 %. Of an effect whose dot is left of it, the data tell more than what is plausible anyway; an "
        "effect whose dot is right of it could hide at a plausible size.",
    )


# Figures of the report, by the part that shows them: a figure that is added here is shown.
CANDIDATES: tuple[EvidenceFigure, ...] = (candidate_grid,)
GAPS: tuple[EvidenceFigure, ...] = (gap_grid, waterfall_grid)


def drawn(figures: Sequence[EvidenceFigure], discovery: Discovery) -> tuple[FigureGrid, ...]:
    """The figures for which the discovery has data."""
    return tuple(grid for figure in figures if (grid := figure(discovery)) is not None)
