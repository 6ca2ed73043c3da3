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
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from omnibench.compare.output import file_names
from omnibench.compare.plan import UNBOUNDED
from omnibench.compare.report.charts import share_chart
from omnibench.compare.report.view import DatasetView
from omnibench.compare.result import ScoredFit
from omnibench.files import write_text
from omnibench.fit.problem import Improvement
from omnibench.report.blocks import Block, Column, LegendItem, Paragraph, Row, Table
from omnibench.report.numbers import NOTHING, count, power_of_ten
from omnibench.robot.kinematics import Array

TARGETS: Array = np.logspace(0, -8, 81)  # relative gaps above the best known cost (chosen)
_TOLD = (-1, -2, -4, -8)  # exponents of the targets in the table of expected running times


@dataclass(frozen=True, eq=False)
class Course:
    """The course of a search: best cost (K,) against evaluations (K,), the final answer as last point.

    best_known: closed_form's cost that the record's gap is measured from; where that is not known, the lowest training
    cost that any run reached in the same search space.
    """

    run: ScoredFit
    evaluations: Array
    costs: Array
    best_known: float

    @property
    def first_times(self) -> Array:
        """Evaluations (T,) at which each of TARGETS was first reached; infinite where it was not."""
        gaps = self.costs / self.best_known - 1.0
        # 1e-12 allows for rounding: the best known cost itself has a gap of zero.
        first = np.searchsorted(-gaps, -TARGETS - 1e-12)
        return np.where(first < len(gaps), self.evaluations[np.minimum(first, len(gaps) - 1)], np.inf)


def courses(view: DatasetView) -> list[Course]:
    """The courses of the runs that searched, in the order of the results.

    Runs that evaluated one candidate at most, and those whose answer keeps to no box, did not search.
    """
    lowest: dict[Hashable, float] = {}  # by the set that was searched
    found = []
    for run in view.runs:
        record, history = run.record, list(run.result.history)
        reached = record.train_cost
        if view.config.loss != "squares":  # by which answers are not scored: the best one of the search
            reached = min((step.cost for step in history), default=None)
        if reached is not None:  # the answer stands at the run's total evaluations
            lowest[run.fit.search_space] = min(lowest.get(run.fit.search_space, math.inf), reached)
            last = min([reached, *(step.cost for step in history)])
            history.append(Improvement(max(record.evaluations, 1), record.seconds, last))
        found.append((run, history))
    drawn = []
    for run, history in found:
        record, best_known = run.record, lowest.get(run.fit.search_space, math.inf)
        if record.gap is not None and record.train_cost is not None:
            best_known = record.train_cost / (1 + record.gap)
        searched = record.evaluations > 1 and run.fit.box_name != UNBOUNDED and history
        if searched and run.scores["train"].rounding < best_known < math.inf:
            evaluations = np.array([step.evaluations for step in history], dtype=float)
            drawn.append(Course(run, evaluations, np.array([step.cost for step in history]), best_known))
    return drawn


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
    """Targets reached against evaluations, and expected running times."""
    groups: dict[LegendItem, list[Course]] = {}
    for course in courses(view):
        groups.setdefault(view.styles[course.run.record.label], []).append(course)
    if not groups:
        yield Paragraph("There is no course to draw: no entry searched, or the lowest cost is rounding.", "note")
        return
    runs = Counter(run.record.label for run in view.runs)
    ends = np.concatenate([course.evaluations[[0, -1]] for group in groups.values() for course in group])
    curves = {}
    for style, group in groups.items():
        reached, share = targets_reached(group, runs[style.label])
        x = np.concatenate([[max(ends.min(), 1.0)], reached, [ends.max()]])
        y = np.concatenate([[0.0], share, share[-1:] if len(share) else [0.0]])
        last_of_step = np.append(np.flatnonzero(np.diff(x) > 0), len(x) - 1)
        curves[style] = x[last_of_step], y[last_of_step]
    caption = (
        "Targets are relative gaps above the best known cost in the same box, from 1 down to 1e-8 in equal steps of "
        "the exponent; a share counts all targets of all seeds."
    )
    axes = ("evaluations", "targets reached (%)")
    yield share_chart(curves, "Targets reached against evaluations", axes, caption, "targets-reached")
    rows = []
    for style, group in groups.items():
        indices = (int(np.argmin(np.abs(np.log10(TARGETS) - exponent))) for exponent in _TOLD)
        times = (expected_running_time(group, index) for index in indices)
        shown = (count(time) if math.isfinite(time) else NOTHING for time in times)
        rows.append(Row.of(style.label, str(len(group)), *shown))
    columns = (Column("Entry", numeric=False), Column("Runs"), *(Column(power_of_ten(each)) for each in _TOLD))
    note = "Evaluations to a relative gap, with restarts until it is reached; a dash where no run reached it."
    yield Table("Expected running time", columns, tuple(rows), note)


def write_traces(views: Sequence[DatasetView], folder: Path) -> list[Path]:
    """Write the courses of all searches as files that IOHinspector and IOHanalyzer read: the heads of the entries.

    A folder for each data set, in it one for each entry: a JSON document with its runs, and the improvements of each
    run (IOHprofiler's format of 2023: de Nobel et al., IOHexperimenter, Evol. Comput. 32:205, 2024). DataError when the
    disk refuses.
    """
    heads = []
    for view, of_set in zip(views, file_names(view.name for view in views), strict=True):
        groups: dict[str, list[Course]] = {}
        for course in courses(view):
            groups.setdefault(course.run.record.label, []).append(course)
        for (label, group), of_entry in zip(groups.items(), file_names(groups), strict=True):
            dimension = 3 * len(view.dataset.robot.drive.names)
            data, runs, rows = f"data_f1/IOHprofiler_f1_DIM{dimension}.dat", [], []
            for course in group:
                record, best = course.run.record, int(np.argmin(course.costs))
                lowest = {"evals": int(course.evaluations[best]), "y": float(course.costs[best]), "x": []}
                runs.append({"instance": record.seed, "evals": record.evaluations, "best": lowest})
                steps = zip(course.evaluations, np.minimum.accumulate(course.costs), strict=True)
                rows += ["evaluations raw_y", *(f"{int(evaluations)} {cost:.17g}" for evaluations, cost in steps)]
            head = {
                "version": "0.3.16",
                "suite": "omnibench",
                "function_id": 1,
                "function_name": f"{view.name} {view.config.objective}",
                "maximization": False,
                "algorithm": {"name": label, "info": json.dumps(group[0].run.record.options)},
                "attributes": ["evaluations", "raw_y"],
                "scenarios": [{"dimension": dimension, "path": data, "runs": runs}],
            }
            place = folder / of_set / of_entry
            heads.append(place / "IOHprofiler_f1_omnibench.json")
            write_text(place / data, "\n".join(rows) + "\n")
            write_text(heads[-1], json.dumps(head, indent=1))
    return heads
