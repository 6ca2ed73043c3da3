"""How fast each search came how near the best known cost: targets reached (ECDF) and expected running time.

A target is a relative gap above the best known cost in the same box. The share of all targets of all seeds that are
reached by a number of evaluations is the anytime curve by which optimisers are compared (Hansen et al., COCO: a
platform for comparing continuous optimizers in a black-box setting, Optim. Methods Softw. 36:114, 2021). With restarts,
the expected running time to a target is

    ERT = (evaluations of all runs, until the target or to their end) / (number of runs that reach it).      (A1)
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from omnibench.compare.plan import SearchSpace
from omnibench.compare.report.view import DatasetView
from omnibench.compare.result import ScoredFit
from omnibench.fit.calibrators.genetic import GeneticOptions
from omnibench.fit.problem import Improvement
from omnibench.report.blocks import Block, Column, Figure, FigureGrid, LegendItem, Paragraph, Row, Table
from omnibench.report.figures import line
from omnibench.report.numbers import NOTHING, count, percent, power_of_ten
from omnibench.report.style import AXIS, INK, logarithmic, plot, text
from omnibench.robot.kinematics import Array
from omnibench.words import plural

TARGETS: Array = np.logspace(0, -8, 81)  # relative gaps above the best known cost (chosen)
_TOLD = (-1, -2, -4, -8)  # exponents of the targets in the table of expected running times


@dataclass(frozen=True, eq=False)
class Course:
    """The course of a search: best cost (K,) against evaluations (K,), the final answer as last point.

    best_known: closed_form's cost that the record's gap is measured from; where that is not known, the lowest training
    cost that any run reached in the same search space.
    """

    run: ScoredFit
    style: LegendItem
    evaluations: Array
    costs: Array
    best_known: float

    @property
    def first_times(self) -> Array:
        """Evaluations (T,) at which each of TARGETS was first reached; infinite where it was not."""
        gaps = self.costs / self.best_known - 1.0
        # 1e-12 allows for rounding: the best known cost itself has a gap of zero.
        first = np.searchsorted(-gaps, -TARGETS - 1e-12)
        times: Array = np.where(first < len(gaps), self.evaluations[np.minimum(first, len(gaps) - 1)], np.inf)
        return times


def courses(view: DatasetView) -> list[Course]:
    """The courses of the runs that searched, in the order of the results.

    Runs that evaluated one candidate at most, and those whose answer keeps to no box, did not search.
    """
    # The lowest training cost or loss that was reached in each search space
    lowest: dict[SearchSpace, float] = {}
    for run in view.runs:
        cost = _reached(view, run)
        lowest[run.search_space] = min(lowest.get(run.search_space, math.inf), math.inf if cost is None else cost)
    drawn = []
    for run in view.runs:
        record, reached, best_known = run.record, _reached(view, run), lowest[run.search_space]
        if record.gap is not None and record.train_cost is not None:
            best_known = record.train_cost / (1 + record.gap)
        history = list(run.result.history)
        if reached is not None:  # the answer stands at the run's total evaluations
            lowest_before = min((step.cost for step in history), default=math.inf)
            history.append(Improvement(max(record.evaluations, 1), record.seconds, min(reached, lowest_before)))
        searched = record.evaluations > 1 and run.search_space.bounded and history
        if searched and run.scores["train"].rounding < best_known < math.inf:
            evaluations = np.array([step.evaluations for step in history], dtype=float)
            costs = np.array([step.cost for step in history])
            drawn.append(Course(run, view.styles[record.label], evaluations, costs, best_known))
    return drawn


def _reached(view: DatasetView, run: ScoredFit) -> float | None:
    """The answer's training cost; under a robust loss, by which answers are not scored, the best one of the search."""
    if view.config.loss == "squares":
        return run.record.train_cost
    return min((step.cost for step in run.result.history), default=None)


def targets_reached(group: Sequence[Course], runs: int) -> tuple[Array, Array]:
    """Evaluations at which targets were reached, sorted, and the share of all (targets x runs) reached by then.

    runs: counts those without a course too, which reached nothing.
    """
    times = np.concatenate([course.first_times for course in group])
    reached = np.sort(times[np.isfinite(times)])
    return reached, np.arange(1, len(reached) + 1) / (len(TARGETS) * runs)


def expected_running_time(group: Sequence[Course], target: int) -> float:
    """Eq. (A1): evaluations to a target, by its index in TARGETS, with restarts; infinite where no run reached it."""
    times = np.array([course.first_times[target] for course in group])
    spent = np.where(np.isfinite(times), times, [course.evaluations[-1] for course in group])
    return float(spent.sum() / np.isfinite(times).sum()) if np.isfinite(times).any() else math.inf


def search_blocks(view: DatasetView) -> Iterator[Block]:
    """Targets reached against evaluations, expected running times, and Fig. 4 where the paper's method is here."""
    drawn = courses(view)
    if not drawn:
        yield Paragraph("There is no course to draw: no entry searched, or the lowest cost is rounding.", "note")
        return
    runs = Counter(run.record.label for run in view.runs)
    groups: dict[LegendItem, list[Course]] = {}
    for course in drawn:
        groups.setdefault(course.style, []).append(course)
    low = max(min(float(course.evaluations[0]) for course in drawn), 1.0)
    high = max(float(course.evaluations[-1]) for course in drawn)
    traces = []
    for style, group in groups.items():
        reached, share = targets_reached(group, runs[style.label])
        x = np.concatenate([[low], reached, [high]])
        y = np.concatenate([[0.0], share, [share[-1] if len(share) else 0.0]])
        keep = np.append(np.flatnonzero(np.diff(x) > 0), len(x) - 1)
        hover = f"{text(style.label)}<br>%{{y:.1f}} % by %{{x:.4g}}"
        traces.append(line(style, 2.2, x[keep], 100 * y[keep], hover=hover, line_shape="hv"))
    figure = plot(*traces, x_title="evaluations", y_title="targets reached (%)")
    logarithmic(figure, "x", low, high)
    figure.update_yaxes(range=[-1, 104])
    caption = (
        "Targets are relative gaps above the best known cost in the same box, from 1 down to 1e-8 in equal steps of "
        "the exponent; a share counts all targets of all seeds."
    )
    title = "Targets reached against evaluations"
    picture = Figure(title, figure, "Share of targets that each entry reached, over its seeds, by evaluations", 360)
    yield FigureGrid((picture,), tuple(groups), 1, caption, "targets-reached")
    indices = [int(np.argmin(np.abs(np.log10(TARGETS) - exponent))) for exponent in _TOLD]
    rows = [
        Row.of(style.label, str(len(group)), *(_time(expected_running_time(group, index)) for index in indices))
        for style, group in groups.items()
    ]
    columns = (Column("Entry", numeric=False), Column("Runs"), *(Column(power_of_ten(each)) for each in _TOLD))
    note = "Evaluations to a relative gap, with restarts until it is reached; a dash where no run reached it."
    yield Table("Expected running time", columns, tuple(rows), note)
    yield from _fig_4(view)


def _time(evaluations: float) -> str:
    return count(evaluations) if math.isfinite(evaluations) else NOTHING


def traces_of(view: DatasetView) -> Mapping[str, Mapping[str, Any]]:
    """Traces of all searches as files that IOHinspector and IOHanalyzer read, by the names of their files.

    One JSON document an entry with its runs, and beside it the improvements of each run (IOHprofiler's format of 2023:
    de Nobel et al., IOHexperimenter, Evol. Comput. 32:205, 2024).
    """
    documents: dict[str, dict[str, Any]] = {}
    for course in courses(view):
        record = course.run.record
        document = documents.setdefault(
            record.label,
            {
                "version": "0.3.16",
                "suite": "omnibench",
                "function_id": 1,
                "function_name": f"{view.name} {view.config.objective}",
                "maximization": False,
                "algorithm": {"name": record.label, "info": json.dumps(record.options)},
                "attributes": ["evaluations", "raw_y"],
                "scenarios": [{"dimension": 3 * len(view.dataset.robot.drive.names), "path": "", "runs": []}],
            },
        )
        best = int(np.argmin(course.costs))
        document["scenarios"][0]["runs"].append(
            {
                "instance": record.seed,
                "evals": record.evaluations,
                "best": {"evals": int(course.evaluations[best]), "y": float(course.costs[best]), "x": []},
            }
        )
    return documents


def write_traces(view: DatasetView, folder: Path) -> list[Path]:
    """Write the traces of all searches for IOHinspector: IOHprofiler_*.json, and tables of evaluations and costs."""
    files = []
    for label, document in traces_of(view).items():
        place = folder / "".join(letter if letter.isalnum() else "_" for letter in label)
        data = place / "data_f1" / f"IOHprofiler_f1_DIM{document['scenarios'][0]['dimension']}.dat"
        data.parent.mkdir(parents=True, exist_ok=True)
        document["scenarios"][0]["path"] = data.relative_to(place).as_posix()
        rows = []
        for course in courses(view):
            if course.run.record.label == label:
                rows.append("evaluations raw_y")
                steps = zip(course.evaluations, np.minimum.accumulate(course.costs), strict=True)
                rows += [f"{int(evaluations)} {cost:.17g}" for evaluations, cost in steps]
        data.write_text("\n".join(rows) + "\n", encoding="utf-8")
        head = place / "IOHprofiler_f1_omnibench.json"
        head.write_text(json.dumps(document, indent=1), encoding="utf-8")
        files.append(head)
    return files


# Middles of the boxes of Fig. 4 in units of the picture: two columns, which a phone and half a sheet of paper can hold.
_START, _CANDIDATES, _ODOMETRY, _COST = (1.0, 3.0), (1.0, 2.0), (1.0, 1.0), (1.0, 0.0)
_STOP, _SELECTION, _NEXT = (0.0, 0.0), (0.0, 1.0), (0.0, 2.0)
_WIDTH = 156  # px of a box
_TO_SIDE, _TO_TOP = 87, 38  # px from a box's middle to its edges


def _fig_4(view: DatasetView) -> Iterator[FigureGrid]:
    """Fig. 4 of the paper with the settings of its genetic algorithm here."""
    genetic = next((run.record for _, entry, run in view.published_entries if entry.calibrator == "genetic"), None)
    if genetic is None:
        return
    options = GeneticOptions.model_validate(genetic.options)
    population = options.size(3 * len(view.dataset.robot.drive.names) - len(genetic.held))
    bounds = "±10 % of V" if genetic.box == "paper" else f"box {genetic.box}"
    boxes = {
        _START: f"<b>Initial population</b><br>V, the design values,<br>and {population - 1} random ones",
        _CANDIDATES: f"<b>Population of {population}</b><br>V<sub>LB</sub>, V<sub>UB</sub>: {bounds}",
        _STOP: f"<b>Stop?</b> best changes<br>≤ {options.tolerance:g} on average of<br>"
        f"{options.stall_generations} generations, or<br>{count(view.config.budget.evaluations)} evaluations",
        _SELECTION: f"<b>Selection</b><br>elite {percent(options.elite, 0)} unchanged,<br>parents by rank",
        _NEXT: f"<b>Crossover</b> of {percent(options.crossover, 0)}<br><b>Mutation</b> of the others<br>"
        f"({options.mutation.replace('_', ' ')})",
        _ODOMETRY: f"<b>Odometry</b><br>{plural(len(view.dataset.split('train')), 'training run')}",
        _COST: f"<b>Cost</b><br>{view.config.objective},<br>Eq. (6)",
    }
    looks = {"bordercolor": AXIS, "borderwidth": 1, "borderpad": 6, "bgcolor": "white", "font": {"size": 12}}
    notes: list[dict[str, Any]] = [
        {"x": x, "y": y, "text": words, "showarrow": False, "width": _WIDTH, **looks} for (x, y), words in boxes.items()
    ]
    loop = (_START, _CANDIDATES, _ODOMETRY, _COST, _STOP, _SELECTION, _NEXT, _CANDIDATES)
    for tail, tip in pairwise(loop):
        gap = _TO_SIDE if tail[1] == tip[1] else _TO_TOP
        ends = {"x": tip[0], "y": tip[1], "ax": tail[0], "ay": tail[1], "standoff": gap, "startstandoff": gap}
        frames = {"xref": "x", "yref": "y", "axref": "x", "ayref": "y"}
        arrow = {"showarrow": True, "arrowhead": 2, "arrowwidth": 1.4, "arrowcolor": INK}
        notes.append({"text": "", **ends, **frames, **arrow})
    figure = plot(go.Scatter(x=[-0.5, 1.5], y=[-0.5, 3.5], mode="markers", marker_opacity=0, hoverinfo="skip"))
    hidden = {"visible": False}
    figure.update_layout(annotations=notes, xaxis=hidden, yaxis=hidden, margin_l=10, margin_b=10)
    words = "Initial population, odometry, cost; then stop, or selection, crossover and mutation"
    caption = f"Fig. 4 of the paper, with the settings of {genetic.label}."
    yield FigureGrid((Figure("How the genetic search runs", figure, words, 500),), (), 1, caption, "fig-4")
