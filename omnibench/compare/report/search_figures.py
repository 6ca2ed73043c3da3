"""The section on searches: best cost, gap above the best known cost, and share of targets reached."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import plotly.graph_objects as go

from omnibench.compare.plan import SearchSpace
from omnibench.compare.report.view import THEORETICAL_STYLE, DatasetView, EntryStyle
from omnibench.compare.result import ScoredRun
from omnibench.fit.problem import Improvement
from omnibench.report.blocks import Figure, FigureGrid, Paragraph, Section
from omnibench.report.numbers import listing, significant
from omnibench.report.style import logarithmic, plot, text
from omnibench.robot.kinematics import Array

TARGETS: Array = np.logspace(0, -8, 81)  # relative gaps above the best known cost (chosen)
Axis = Literal["evaluations", "time"]
AXES: tuple[Axis, ...] = ("evaluations", "time")
_TITLES: Mapping[Axis, str] = {"evaluations": "evaluations", "time": "time (s)"}
_FLOOR = 1e-10  # relative gap; smaller ones are drawn at this value
_POINTS = 12_000  # points of one plot, shared by its runs: keeps the file small


@dataclass(frozen=True, eq=False)
class Course:
    """The course of a search: best cost (K,) against evaluations and seconds (K,), the final answer as last point.

    best_known: the exact optimum that the record's gap is measured from; where that is not known, the lowest training
    cost that any run reached in the same search space.
    """

    run: ScoredRun
    style: EntryStyle
    evaluations: Array
    seconds: Array
    costs: Array
    best_known: float

    @property
    def gaps(self) -> Array:
        """Relative gaps (K,) above the best known cost, at least ``_FLOOR``."""
        gaps: Array = np.maximum(self.costs / self.best_known - 1.0, _FLOOR)
        return gaps


def search_section(view: DatasetView) -> Section:
    """Cost, gap and targets reached, against evaluations and against time."""
    drawn = courses(view)
    if not drawn:
        words = "There is no course to draw: no entry searched, or none reached a cost above zero."
        return Section("searches", "Searches", (Paragraph(words, "note"),))
    searches = _Searches(
        drawn,
        points=max(24, _POINTS // len(drawn)),
        runs=Counter(run.record.label for run in view.runs),
        theoretical=view.theoretical_cost("train"),
    )
    figures = [figure(searches, axis) for figure in (_cost_figure, _gap_figure, _target_figure) for axis in AXES]
    styles = {course.style.key: course.style for course in drawn}.values()
    legend = (*(style.legend for style in styles), THEORETICAL_STYLE.legend)
    return Section("searches", "Searches", (FigureGrid(tuple(figures), legend, 2, _caption(drawn)),))


@dataclass(frozen=True, eq=False)
class _Searches:
    """The data of the figures.

    points: roughly how many a course is drawn with. runs: number of runs by label, with those that have no course.
    theoretical: the training cost of the design values.
    """

    courses: Sequence[Course]
    points: int
    runs: Mapping[str, int]
    theoretical: float | None


def _cost_figure(searches: _Searches, axis: Axis) -> Figure:
    return Figure(
        f"Best training cost against {axis}",
        _cost_plot(searches.courses, axis, searches.points, searches.theoretical),
        f"Best training cost found so far by each run against {axis}, both axes logarithmic",
        360,
    )


def _gap_figure(searches: _Searches, axis: Axis) -> Figure:
    return Figure(
        f"Gap above the best known cost against {axis}",
        _gap_plot(searches.courses, axis, searches.points),
        f"Relative gap above the best known cost in the same box against {axis}, both axes logarithmic",
        360,
    )


def _target_figure(searches: _Searches, axis: Axis) -> Figure:
    return Figure(
        f"Targets reached against {axis}",
        _target_plot(searches.courses, axis, searches.runs),
        f"Share of targets that each entry reached, over its seeds, against {axis}",
        360,
    )


def courses(view: DatasetView) -> list[Course]:
    """The courses of the runs that searched, in the order of the results.

    Runs that evaluated one candidate at most, and those whose answer keeps to no box, did not search.
    """
    lowest = _lowest_costs(view)
    drawn = []
    for run in view.runs:
        if run.record.evaluations <= 1 or not run.search_space.bounded:
            continue
        history, best_known = _with_answer(run), _best_known(run, lowest[run.search_space])
        if history and 0 < best_known < math.inf:
            drawn.append(
                Course(
                    run,
                    view.styles[run.record.label],
                    np.array([step.evaluations for step in history], dtype=float),
                    np.array([step.seconds for step in history]),
                    np.array([step.cost for step in history]),
                    best_known,
                )
            )
    return drawn


def _best_known(run: ScoredRun, lowest: float) -> float:
    """The cost that a run's gap is measured from."""
    record = run.record
    if record.gap is None or record.train_cost is None:
        return lowest
    return record.train_cost / (1 + record.gap)


def _lowest_costs(view: DatasetView) -> Mapping[SearchSpace, float]:
    """The lowest training cost that was reached in each search space; infinite where nothing was."""
    lowest: dict[SearchSpace, float] = {}
    for run in view.runs:
        space, cost = run.search_space, run.record.train_cost
        lowest[space] = min(lowest.get(space, math.inf), math.inf if cost is None else cost)
    return lowest


def targets_reached(group: Sequence[Course], runs: int, axis: Axis) -> tuple[Array, Array]:
    """When targets were reached (sorted) and the share of all (targets x runs) reached by then.

    ``runs`` counts those without a course too: they reached nothing.
    """
    times = np.concatenate([_first_times(course, axis) for course in group])
    reached = np.sort(times[np.isfinite(times)])
    return reached, np.arange(1, len(reached) + 1) / (len(TARGETS) * runs)


def thinned(along: Array, gaps: Array, limit: int) -> list[int]:
    """Indices of at most about ``limit`` points that draw nearly the same steps on logarithmic axes, with both ends."""
    if len(along) <= limit:
        return list(range(len(along)))
    across = np.log(np.maximum(along, 1e-9))
    down = np.log(gaps)
    cell = 2.0 * max(float(np.ptp(across) + np.ptp(down)), 1e-12) / limit
    steps = np.stack([across // cell, down // cell], axis=1)
    changes = np.flatnonzero(np.any(np.diff(steps, axis=0) != 0, axis=1))
    return sorted({0, *changes.tolist(), len(along) - 1})


def _first_times(course: Course, axis: Axis) -> Array:
    """When each target was first reached; infinite where it was not."""
    along: Array = _along(course, axis)
    gaps = course.costs / course.best_known - 1.0
    # 1e-12 allows for rounding: the best known cost itself has a gap of zero.
    first = np.searchsorted(-gaps, -TARGETS - 1e-12)
    times: Array = np.where(first < len(gaps), along[np.minimum(first, len(gaps) - 1)], np.inf)
    return times


def _with_answer(run: ScoredRun) -> tuple[Improvement, ...]:
    """The history, followed by the answer at the run's total evaluations and time."""
    record = run.record
    if record.train_cost is None:
        return run.history
    lowest = min((step.cost for step in run.history), default=math.inf)
    last = Improvement(max(record.evaluations, 1), record.seconds, min(record.train_cost, lowest))
    return (*run.history, last)


def _groups(drawn: Sequence[Course]) -> Mapping[EntryStyle, list[Course]]:
    groups: dict[EntryStyle, list[Course]] = {}
    for course in drawn:
        groups.setdefault(course.style, []).append(course)
    return groups


def _steps(style: EntryStyle, group: Sequence[Course], axis: Axis, limit: int, gaps: bool) -> list[go.Scatter]:
    """One trace for all seeds of an entry, with a break between them, and a mark at each end."""
    x: list[float | None] = []
    y: list[float | None] = []
    seeds: list[int | None] = []
    for course in group:
        picks = thinned(_along(course, axis), course.gaps, limit)
        values = course.gaps if gaps else course.costs
        x += [*(float(f"{value:.5g}") for value in _along(course, axis)[picks]), None]
        y += [*(float(f"{value:.6g}") for value in values[picks]), None]
        seeds += [*([course.run.record.seed] * len(picks)), None]
    ends = [index - 1 for index, value in enumerate(x) if value is None]
    words = f"{text(style.label)}, seed %{{customdata}}<br>%{{x:.4g}}{' s' if axis == 'time' else ' evaluations'}"
    shared = {
        "legendgroup": style.key,
        "hovertemplate": f"{words}, {'gap' if gaps else 'cost'} %{{y:.5g}}<extra></extra>",
    }
    line = {"color": style.colour, "width": 1.8, "dash": style.dash, "shape": "hv"}
    marker = {"color": style.colour, "symbol": style.symbol, "size": 8, "line": {"width": 1.8}}
    return [
        go.Scatter(x=x, y=y, customdata=seeds, mode="lines", line=line, opacity=0.8, **shared),
        go.Scatter(
            x=[x[i] for i in ends], y=[y[i] for i in ends], customdata=[seeds[i] for i in ends],
            mode="markers", marker=marker, **shared,
        ),
    ]  # fmt: skip


def _cost_plot(drawn: Sequence[Course], axis: Axis, limit: int, theoretical: float | None) -> go.Figure:
    traces = [trace for style, group in _groups(drawn).items() for trace in _steps(style, group, axis, limit, False)]
    low = min(course.costs.min() for course in drawn)
    high = max(course.costs.max() for course in drawn)
    if theoretical is not None:
        high = max(high, theoretical)
        traces.append(
            go.Scatter(
                x=list(_extent(drawn, axis)),
                y=[theoretical, theoretical],
                mode="lines",
                line={"color": THEORETICAL_STYLE.colour, "width": 1.8, "dash": THEORETICAL_STYLE.dash},
                legendgroup=THEORETICAL_STYLE.key,
                hovertemplate=f"theoretical, cost {theoretical:.5g}<extra></extra>",
            )
        )
    figure = plot(*traces, xaxis_title_text=_TITLES[axis], yaxis_title_text="best training cost so far")
    logarithmic(figure, "x", *_extent(drawn, axis))
    logarithmic(figure, "y", float(low), float(high))
    return figure


def _gap_plot(drawn: Sequence[Course], axis: Axis, limit: int) -> go.Figure:
    traces = [trace for style, group in _groups(drawn).items() for trace in _steps(style, group, axis, limit, True)]
    figure = plot(*traces, xaxis_title_text=_TITLES[axis], yaxis_title_text="relative gap above best known cost")
    logarithmic(figure, "x", *_extent(drawn, axis))
    logarithmic(figure, "y", _FLOOR, float(max(course.gaps.max() for course in drawn)))
    return figure


def _target_plot(drawn: Sequence[Course], axis: Axis, runs: Mapping[str, int]) -> go.Figure:
    traces = []
    low, high = _extent(drawn, axis)
    for style, group in _groups(drawn).items():
        reached, share = targets_reached(group, runs[style.label], axis)
        x = np.concatenate([[low], reached, [high]])
        y = np.concatenate([[0.0], share, [share[-1] if len(share) else 0.0]])
        keep = np.append(np.flatnonzero(np.diff(x) > 0), len(x) - 1)
        traces.append(
            go.Scatter(
                x=[float(f"{value:.5g}") for value in x[keep]],
                y=np.round(100 * y[keep], 2).tolist(),
                mode="lines",
                line={"color": style.colour, "width": 2.2, "dash": style.dash, "shape": "hv"},
                legendgroup=style.key,
                hovertemplate=f"{text(style.label)}<br>%{{y:.1f}} % by %{{x:.4g}}<extra></extra>",
            )
        )
    figure = plot(*traces, xaxis_title_text=_TITLES[axis], yaxis_title_text="targets reached (%)")
    logarithmic(figure, "x", low, high)
    figure.update_yaxes(range=[-1, 104])
    return figure


def _extent(drawn: Sequence[Course], axis: Axis) -> tuple[float, float]:
    """From the first improvement of any run to the end of the longest."""
    ends = [(float(_along(course, axis)[0]), float(_along(course, axis)[-1])) for course in drawn]
    return max(min(first for first, _ in ends), 1e-4), max(last for _, last in ends)


def _along(course: Course, axis: Axis) -> Array:
    return course.evaluations if axis == "evaluations" else course.seconds


def _caption(drawn: Sequence[Course]) -> str:
    known: dict[tuple[str, str], list[str]] = {}
    for course in drawn:
        record = course.run.record
        labels = known.setdefault((record.gap_box or record.box, significant(course.best_known, 8)), [])
        labels += [] if record.label in labels else [record.label]
    shared = Counter(box for box, _ in known)
    costs = "; ".join(
        f"box {box}{f' of {listing(labels)}' if shared[box] > 1 else ''}: {value}"
        for (box, value), labels in known.items()
    )
    return (
        f"One line a seed, marked where the run ended. Best known training cost: {costs}. Gaps below {_FLOOR:.0e} are "
        "drawn at that value. Targets are relative gaps above the best known cost in the same box, from 1 down to 1e-8 "
        "in equal steps of the exponent; a share counts all targets of all seeds."
    )
