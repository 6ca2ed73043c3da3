"""The section on searches: share of targets reached, and the gap above the best known cost.

A diagram after Fig. 4 of the paper shows how a search runs.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import plotly.graph_objects as go

from omnibench.compare.plan import SearchSpace
from omnibench.compare.report.view import DatasetView, cost_in_words
from omnibench.compare.result import ScoredFit
from omnibench.fit.calibrators.genetic import GeneticOptions
from omnibench.fit.problem import Improvement
from omnibench.report.blocks import Figure, FigureGrid, LegendItem, Paragraph, Section
from omnibench.report.figures import joined, line, marks
from omnibench.report.numbers import count, listing, percent, significant
from omnibench.report.style import AXIS, INK, logarithmic, plot, text
from omnibench.robot.kinematics import Array
from omnibench.words import plural

# Middles of the boxes in units of the picture: two columns, which a phone and half a sheet of paper can hold.
_START, _CANDIDATES, _ODOMETRY, _COST = (1.0, 3.0), (1.0, 2.0), (1.0, 1.0), (1.0, 0.0)
_STOP, _SELECTION, _NEXT = (0.0, 0.0), (0.0, 1.0), (0.0, 2.0)
_WIDTH = 156  # px of a box
_TO_SIDE, _TO_TOP = 87, 38  # px from a box's middle to its edges


def search_diagram(view: DatasetView) -> FigureGrid:
    """From the design values over candidates and their costs to the answer: Fig. 4 of the paper, or any search."""
    config, runs = view.config, len(view.dataset.split("train"))
    euler = "Euler steps, Eq. (1)" if config.integration == "euler" else "exact arcs"
    is_paper = config.cost_name == "final_pose"
    stop = f"{count(config.budget.evaluations)} evaluations"
    genetic = next((run.record for _, entry, run in view.published_entries if entry.calibrator == "genetic"), None)
    if genetic is None:
        own = {
            _START: "<b>Start</b><br>the design values",
            _CANDIDATES: "<b>Candidates</b><br>elements or geometry,<br>within their bounds",
            _STOP: f"<b>Stop?</b><br>by its own rule, or<br>after {stop}",
            _NEXT: "<b>Next candidates</b><br>by the search's own rule",
        }
    else:
        options = GeneticOptions.model_validate(genetic.options)
        population = options.size(3 * len(view.dataset.robot.drive.names) - len(genetic.held))
        bounds = "±10 % of V" if genetic.box == "paper" else f"box {genetic.box}"
        own = {
            _START: f"<b>Initial population</b><br>V, the design values,<br>and {population - 1} random ones",
            _CANDIDATES: f"<b>Population of {population}</b><br>V<sub>LB</sub>, V<sub>UB</sub>: {bounds}",
            _STOP: f"<b>Stop?</b> best changes<br>≤ {options.tolerance:g} on average of<br>"
            f"{options.stall_generations} generations, or<br>{stop}",
            _SELECTION: f"<b>Selection</b><br>elite {percent(options.elite, 0)} unchanged,<br>parents by rank",
            _NEXT: f"<b>Crossover</b> of {percent(options.crossover, 0)}<br><b>Mutation</b> of the others<br>"
            f"({options.mutation.replace('_', ' ')})",
        }
    boxes = own | {
        _ODOMETRY: f"<b>Odometry</b><br>{plural(runs, 'training run')},<br>{euler}",
        _COST: f"<b>Cost</b><br>{config.objective}" + (",<br>Eq. (6)" if is_paper else ""),
    }
    loop = (_CANDIDATES, _ODOMETRY, _COST, _STOP, _SELECTION, _NEXT, _CANDIDATES)
    arrows = [_arrow(tail, tip) for tail, tip in pairwise([_START, *(place for place in loop if place in boxes)])]
    figure = plot(go.Scatter(x=[-0.5, 1.5], y=[-0.5, 3.5], mode="markers", marker_opacity=0, hoverinfo="skip"))
    notes = [*(_box(place, words) for place, words in boxes.items()), *arrows]
    hidden = {"visible": False}
    figure.update_layout(annotations=notes, xaxis=hidden, yaxis=hidden, margin_l=10, margin_b=10)
    words = "Start, candidates, odometry, cost; then stop, or the next candidates"
    title, paper = "How a search runs", ""
    if genetic is not None:
        title, paper = "How the genetic search runs", f"Fig. 4 of the paper, with the settings of {genetic.label}. "
    return FigureGrid((Figure(title, figure, words, 500),), (), 1, f"{paper}The cost is {cost_in_words(view)}")


def _box(middle: tuple[float, float], words: str) -> dict[str, Any]:
    looks = {"bordercolor": AXIS, "borderwidth": 1, "borderpad": 6, "bgcolor": "white", "font": {"size": 12}}
    return {"x": middle[0], "y": middle[1], "text": words, "showarrow": False, "width": _WIDTH, **looks}


def _arrow(tail: tuple[float, float], tip: tuple[float, float]) -> dict[str, Any]:
    """An arrow from the edge of one box to the edge of another."""
    gap = _TO_SIDE if tail[1] == tip[1] else _TO_TOP
    gaps = {"standoff": gap, "startstandoff": gap}
    ends = {"x": tip[0], "y": tip[1], "ax": tail[0], "ay": tail[1]}
    frames = {"xref": "x", "yref": "y", "axref": "x", "ayref": "y"}
    return {
        **ends,
        **gaps,
        **frames,
        "text": "",
        "showarrow": True,
        "arrowhead": 2,
        "arrowwidth": 1.4,
        "arrowcolor": INK,
    }


TARGETS: Array = np.logspace(0, -8, 81)  # relative gaps above the best known cost (chosen)
Axis = Literal["evaluations", "time"]
AXES: tuple[Axis, ...] = ("evaluations", "time")
_TITLES: Mapping[Axis, str] = {"evaluations": "evaluations", "time": "time (s)"}
_FLOOR = 1e-10  # relative gap; smaller ones are drawn at this value
_ABOUT = "How fast each search came how near the best known cost."
_POINTS = 12_000  # points of one plot, shared by its runs: keeps the file small


@dataclass(frozen=True, eq=False)
class Course:
    """The course of a search: best cost (K,) against evaluations and seconds (K,), the final answer as last point.

    best_known: closed_form's cost that the record's gap is measured from; where that is not known, the lowest training
    cost that any run reached in the same search space.
    """

    run: ScoredFit
    style: LegendItem
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
        words = "There is no course to draw: no entry searched, or the lowest cost is rounding."
        return Section("searches", "Searches", (Paragraph(words, "note"),), about=_ABOUT, folded=True)
    searches = _Searches(drawn, max(24, _POINTS // len(drawn)), Counter(run.record.label for run in view.runs))
    targets = FigureGrid(
        tuple(_targets(searches, axis) for axis in (AXES if view.times_compare else AXES[:1])),
        tuple({course.style.key: course.style for course in drawn}.values()),
        2,
        "Targets are relative gaps above the best known cost in the same box, from 1 down to 1e-8 in equal steps of "
        "the exponent; a share counts all targets of all seeds.",
        "targets-reached",
    )
    return Section("searches", "Searches", (targets, _gaps(searches), search_diagram(view)), about=_ABOUT, folded=True)


@dataclass(frozen=True, eq=False)
class _Searches:
    """The data of the figures.

    points: roughly how many a course is drawn with. runs: number of runs by label, with those that have no course.
    """

    courses: Sequence[Course]
    points: int
    runs: Mapping[str, int]


def courses(view: DatasetView) -> list[Course]:
    """The courses of the runs that searched, in the order of the results.

    Runs that evaluated one candidate at most, and those whose answer keeps to no box, did not search.
    """
    # The lowest training cost or loss that was reached in each search space; infinite where nothing was
    lowest: dict[SearchSpace, float] = {}
    for run in view.runs:
        space, cost = run.search_space, _reached(view, run)
        lowest[space] = min(lowest.get(space, math.inf), math.inf if cost is None else cost)
    drawn = []
    for run in view.runs:
        if run.record.evaluations <= 1 or not run.search_space.bounded:
            continue
        history, best_known = _with_answer(view, run), _best_known(run, lowest[run.search_space])
        if history and run.scores["train"].rounding < best_known < math.inf:
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


def _best_known(run: ScoredFit, lowest: float) -> float:
    """The cost that a run's gap is measured from."""
    record = run.record
    if record.gap is None or record.train_cost is None:
        return lowest
    return record.train_cost / (1 + record.gap)


def targets_reached(group: Sequence[Course], runs: int, axis: Axis) -> tuple[Array, Array]:
    """Times at which targets were reached, sorted, and the share of all (targets x runs) reached by then.

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
    """Time at which each target was first reached; infinite where it was not."""
    along: Array = _along(course, axis)
    gaps = course.costs / course.best_known - 1.0
    # 1e-12 allows for rounding: the best known cost itself has a gap of zero.
    first = np.searchsorted(-gaps, -TARGETS - 1e-12)
    times: Array = np.where(first < len(gaps), along[np.minimum(first, len(gaps) - 1)], np.inf)
    return times


def _reached(view: DatasetView, run: ScoredFit) -> float | None:
    """The answer's training cost; under a robust loss, by which answers are not scored, the best one of the search."""
    if view.config.loss == "squares":
        return run.record.train_cost
    return min((step.cost for step in run.result.history), default=None)


def _with_answer(view: DatasetView, run: ScoredFit) -> tuple[Improvement, ...]:
    """The history, followed by the answer at the run's total evaluations and time."""
    record, reached = run.record, _reached(view, run)
    if reached is None:
        return run.result.history
    lowest = min((step.cost for step in run.result.history), default=math.inf)
    last = Improvement(max(record.evaluations, 1), record.seconds, min(reached, lowest))
    return (*run.result.history, last)


def _groups(drawn: Sequence[Course]) -> Mapping[LegendItem, list[Course]]:
    groups: dict[LegendItem, list[Course]] = {}
    for course in drawn:
        groups.setdefault(course.style, []).append(course)
    return groups


def _gaps(searches: _Searches) -> FigureGrid:
    """A plot for each entry of the gap above the best known cost, all on the same axes, a line a seed."""
    highest = float(max(course.gaps.max() for course in searches.courses))
    figures = []
    for style, group in _groups(searches.courses).items():
        figure = plot(*_steps(searches, style, group), x_title=_TITLES["evaluations"], y_title="relative gap")
        logarithmic(figure, "x", *_extent(searches.courses, "evaluations"))
        logarithmic(figure, "y", _FLOOR, highest)
        seeds = plural(len(group), "seed")
        description = f"Relative gap of {style.label} above the best known cost in the same box against evaluations"
        figures.append(Figure(f"{style.label}, {seeds}", figure, description, 230))
    caption = "Gap above the best known cost, a line a seed, marked where the run ended. "
    # Best known costs by box, with the entries where a box has several
    known: dict[tuple[str, str], list[str]] = {}
    for course in searches.courses:
        record = course.run.record
        labels = known.setdefault((record.gap_box or record.box, significant(course.best_known, 8)), [])
        labels += [] if record.label in labels else [record.label]
    shared = Counter(box for box, _ in known)
    costs = "; ".join(
        f"box {box}{f' of {listing(labels)}' if shared[box] > 1 else ''}: {value}"
        for (box, value), labels in known.items()
    )
    caption += f"Best known training cost: {costs}. Gaps below {_FLOOR:.0e} are drawn at that value."
    return FigureGrid(tuple(figures), (), 3, caption, "gap-above-the-best-cost")


def _targets(searches: _Searches, axis: Axis) -> Figure:
    traces = []
    low, high = _extent(searches.courses, axis)
    for style, group in _groups(searches.courses).items():
        reached, share = targets_reached(group, searches.runs[style.label], axis)
        x = np.concatenate([[low], reached, [high]])
        y = np.concatenate([[0.0], share, [share[-1] if len(share) else 0.0]])
        keep = np.append(np.flatnonzero(np.diff(x) > 0), len(x) - 1)
        hover = f"{text(style.label)}<br>%{{y:.1f}} % by %{{x:.4g}}"
        traces.append(line(style, 2.2, x[keep], 100 * y[keep], hover=hover, line_shape="hv"))
    figure = plot(*traces, x_title=_TITLES[axis], y_title="targets reached (%)")
    logarithmic(figure, "x", low, high)
    figure.update_yaxes(range=[-1, 104])
    return Figure(
        f"Targets reached against {axis}",
        figure,
        f"Share of targets that each entry reached, over its seeds, against {axis}",
        360,
    )


def _steps(searches: _Searches, style: LegendItem, group: Sequence[Course]) -> list[go.Scatter]:
    """The courses of an entry's seeds as one trace with a break between them, and marks at their ends."""
    steps = []
    for course in group:
        seed = np.full(len(course.costs), course.run.record.seed)
        picks = thinned(course.evaluations, course.gaps, searches.points)
        steps.append(np.column_stack([course.evaluations, course.gaps, seed])[picks])
    ends = np.array([each[-1] for each in steps])
    hover = "seed %{customdata}<br>%{x:.4g} evaluations, gap %{y:.5g}"
    traces = []
    for points, trace, size, looks in (
        (joined(steps), line, 1.8, {"line_shape": "hv", "opacity": 0.8}),
        (ends, marks, 8, {"marker_line_width": 1.8}),
    ):
        seeds = [None if np.isnan(seed) else int(seed) for seed in points[:, 2]]
        traces.append(trace(style, size, *points[:, :2].T, hover=hover, customdata=seeds, **looks))
    return traces


def _extent(drawn: Sequence[Course], axis: Axis) -> tuple[float, float]:
    """Extent of the axis: from the first improvement of any run to the end of the longest."""
    ends = [(float(_along(course, axis)[0]), float(_along(course, axis)[-1])) for course in drawn]
    return max(min(first for first, _ in ends), 1e-4), max(last for _, last in ends)


def _along(course: Course, axis: Axis) -> Array:
    return course.evaluations if axis == "evaluations" else course.seconds
