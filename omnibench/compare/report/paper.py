"""Beside published figures: each method next to the entry that is the same, circumstances, and Fig. 4 to 7."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import plotly.graph_objects as go

from omnibench.compare.config import THEORETICAL_NAME, PublishedResult
from omnibench.compare.report import view as views
from omnibench.data.dataset import SPLITS, Split, Trajectory
from omnibench.fit.calibrators.genetic import GeneticOptions
from omnibench.fit.intervals import Interval
from omnibench.fit.noise import grouped
from omnibench.registry import calibrators
from omnibench.report import blocks as page
from omnibench.report import numbers
from omnibench.report.blocks import Block, Callout, Cell, Fact, Facts, FigureGrid, Row
from omnibench.report.figures import line, marks
from omnibench.report.numbers import NOTHING, count, fixed, listing, percent, seconds, span
from omnibench.report.path_pictures import path_picture
from omnibench.report.recording.recording_figures import REFERENCE_ITEM, describe
from omnibench.report.style import AXIS, INK, plan, plot
from omnibench.robot.kinematics import Array
from omnibench.words import plural

_MET = 1e-4  # share of the lowest cost: searches that end nearer to it are in one minimum (chosen)
_PUBLISHED_COST = "final_pose"  # published costs are those of Eq. (6)
_DIRECTIONS = (30, 210, 120, 300)  # deg, of Fig. 6 (a) to (d)
_TURN_RATE = 0.35  # rad/s


def published_blocks(view: views.DatasetView) -> Iterator[Block]:
    """Our figures beside the published ones, and the circumstances of both; nothing where none are published."""
    published = view.config.published_results
    if published and view.config.cost_name != _PUBLISHED_COST:
        remark = f"They are of the cost {_PUBLISHED_COST}, Eq. (6); this comparison's is {view.config.cost_name}."
        yield Callout("The published costs cannot be set beside these", (remark,), "warning")
    elif published:
        yield _figure_table(view)
        yield _circumstances(view)
        remarks = tuple(dict.fromkeys(remark for result in published for remark in result.remarks))
        yield Callout("What the paper claims, and what is seen here", tuple(_claims(view)))
        yield Callout("About the published figures", remarks)
        yield from _fig_4(view)


def _claims(view: views.DatasetView) -> Iterator[str]:
    """Two claims of the paper: curves show systematic errors best, and a genetic algorithm avoids local minima."""
    split, turns = view.scored, [run.omega for run in view.dataset.split(view.scored)]
    turning = np.array([bool(turn) for turn in turns])
    if None not in turns and 0 < turning.sum() < len(turning):
        costs = view.runs[0].design[split].costs
        curved, straight = float(costs[turning].mean()), float(costs[~turning].mean())
        yield (
            f"Curves show systematic errors best (section 4.1): {'so' if curved > straight else 'not'} here, Eq. (6) "
            f"of the design values is {fixed(curved, 3)} on the {views.SPLIT_NAMES[split]} runs in curves and "
            f"{fixed(straight, 3)} on straight ones."
        )
    genetic = next((run for _, entry, run in view.published_entries if entry.parameterisation == "matrix"), None)
    if genetic is None:
        return
    # Training costs of the other searches from random starts in the same box
    costs_of: dict[str, list[float]] = {}
    for run in view.runs:
        record = run.record
        rival = record.label != genetic.record.label and run.fit.search_space == genetic.fit.search_space
        if rival and calibrators.entry(record.calibrator).cls.stochastic and record.train_cost is not None:
            costs_of.setdefault(record.label, []).append(record.train_cost)
    if costs_of:
        box, lowest = genetic.record.box, min(min(costs) for costs in costs_of.values())
        met = [
            f"{sum(cost <= (1 + _MET) * lowest for cost in costs)} of {plural(len(costs), 'run')} of {label}"
            for label, costs in costs_of.items()
        ]
        proven = [
            f"; by proof no matrix of the box is more than {percent(certificate.gap, 2)} below it"
            for certificate in view.result.certificates
            if (certificate.dataset, certificate.box) == (view.name, box)
        ]
        yield (
            f"Local minima (section 5): from random starts in the box {box}, {listing(met)} ended within "
            f"{percent(_MET, 2)} of one cost, {fixed(lowest, view.cost_decimals)}{''.join(proven)}."
        )


@dataclass(frozen=True)
class ComparedFigure:
    """One of our figures with its 95 % interval, and the published ones: costs, or shares where ``is_share``.

    decimals: of the published figures, as printed (shares in per cent). methods: labels of the published results.
    """

    name: str
    ours: Interval
    published: tuple[float, ...]
    is_share: bool
    decimals: int
    methods: tuple[str, ...] = ()

    @property
    def alike(self) -> bool:
        """True if our interval contains a published figure."""
        return self.ours.known is not None and any(map(self.ours.holds, self.published))

    @property
    def difference(self) -> str:
        """Our figure relative to the nearest published one, or for shares the percentage points between them."""
        nearest = min(self.published, key=lambda value: abs(value - self.ours.value))
        if self.is_share:
            return f"{fixed(100 * (self.ours.value - nearest), 1, signed=True)} points"
        return percent(self.ours.value / nearest - 1, signed=True)


def compared_figures(view: views.DatasetView) -> list[ComparedFigure]:
    """The design values beside all published results, then each published method beside the entry that is the same.

    Costs and improvements on each split, and the change of the cost from training to validation. A result that names no
    entry with an answer stands beside the best one.
    """
    published, best = view.config.published_results, view.best
    own = {result.label: entry for result, entry, _ in view.published_entries}
    if best is not None and best.calibrator != THEORETICAL_NAME:
        own = {result.label: best for result in published} | own
    figures = list(_compared(published, None, view.design_costs, {}))
    for entry in {entry.label: entry for entry in own.values()}.values():
        same = [result for result in published if own.get(result.label) is entry]
        figures += _compared(same, entry.label, entry.costs, entry.improvements)
    return figures


def _compared(
    published: Sequence[PublishedResult],
    label: str | None,
    costs: Mapping[Split, Interval],
    improvements: Mapping[Split, Interval | None],
) -> Iterator[ComparedFigure]:
    """Figures of the entry called ``label``, or of the design values, beside those of published results."""
    name, kind, entry = ("theoretical", 0, "") if label is None else ("calibrated", 1, f" ({label})")
    methods = tuple(dict.fromkeys(result.label for result in published)) if kind else ()
    for split in SPLITS:
        pairs = [pair for result in published if (pair := result.costs(split))]
        if pairs and split in costs:
            words = f"{name.capitalize()} cost, {views.SPLIT_NAMES[split]}{entry}"
            yield ComparedFigure(words, costs[split], tuple(pair[kind] for pair in pairs), False, 4, methods)
        shares = tuple(share for result in published if (share := result.improvement(split)) is not None)
        if shares and (improvement := improvements.get(split)) is not None:
            words = f"Improvement, {views.SPLIT_NAMES[split]}{entry}"
            yield ComparedFigure(words, improvement, shares, True, 2, methods)
    before, after = (costs.get(split) for split in SPLITS)
    changes = [
        held_out[kind] / train[kind] - 1
        for result in published
        if (train := result.costs("train")) and (held_out := result.costs("validation"))
    ]
    ends = [(each.value, *each.known) for each in (before, after) if each is not None and each.known]
    if len(ends) == len(SPLITS) and changes:
        change = ends[1][0] / ends[0][0] - 1
        # Both splits are samples, so that the interval of the change is about that of the two together.
        spread = math.hypot(*((high - low) / 2 / value for value, low, high in ends))
        ours = Interval(change, change - spread, change + spread)
        yield ComparedFigure(f"Change of the {name} cost to validation{entry}", ours, tuple(changes), True, 1, methods)


def _figure_table(view: views.DatasetView) -> page.Table:
    rows = []
    for figure in compared_figures(view):
        ours, decimals = figure.ours, 1 if figure.is_share else view.cost_decimals
        factor, unit = (100.0, " %") if figure.is_share else (1.0, "")
        interval = views.NO_INTERVAL
        if ours.known is not None:
            interval = f"{span(factor * ours.known[0], factor * ours.known[1], decimals)}{unit}"
        theirs = dict.fromkeys(f"{fixed(factor * value, figure.decimals)}{unit}" for value in figure.published)
        verdict = "as published" if figure.alike else "not as published"
        rows.append(
            Row.of(
                figure.name,
                Cell(f"{fixed(factor * ours.value, decimals)}{unit}", interval),
                Cell(listing(list(theirs)), listing(list(figure.methods))),
                figure.difference,
                # Whoever simulates chooses wheels, floor and noise, so that agreement would prove nothing
                "simulated" if view.dataset.simulated else verdict,
            )
        )
    one_machine = view.config.timing and len({run.record.machine for run in view.runs if run.record.machine}) < 2
    for result, entry, _ in view.published_entries:
        if result.seconds is not None and one_machine:  # else times do not compare
            here = Cell(seconds(entry.seconds_median), f"{count(entry.evaluations_median)} evaluations")
            theirs_took = Cell(seconds(result.seconds), result.label)
            rows.append(Row.of(f"Time, median ({entry.label})", here, theirs_took, NOTHING, "other hardware, program"))
    sources = listing(list(dict.fromkeys(result.source for result in view.config.published_results)))
    note = "As published: the 95 % interval (small print) contains a published figure."
    if view.dataset.simulated:
        note = "No verdict: what was simulated so that it gives the published figures agrees with them by construction."
    verdict_column = page.Column("Verdict", numeric=False)
    columns = page.columns("Figure", "Here", "Published", "From the nearest", verdict_column)
    return page.Table(f"Beside the published figures ({sources})", columns, tuple(rows), note)


def _circumstances(view: views.DatasetView) -> Facts:
    """What differs between the recordings here and the published ones, as far as it is known."""
    runs, split = view.dataset.split(view.scored), view.scored
    systematic, _ = scatter_parts(view.design_errors[split], runs)
    lengths = [run.distance or float(np.hypot(*np.diff(run.poses[:, :2], axis=0).T).sum()) for run in runs]
    origin = "simulated" if view.dataset.simulated else "recorded by another robot, or at another time"
    odometry = "exact arcs" if view.config.integration == "arc" else "Euler steps"
    facts = [
        Fact("Data", origin, view.runs_in_words(split)),
        Fact("Distance of a run, mean", f"{fixed(float(np.mean(lengths)), 2)} m"),
        Fact("Miss of a command's mean end by the design values", fixed(systematic, 4)),
        Fact("Odometry", odometry, "published: Euler steps, Eq. (1)"),
    ]
    errors = view.errors(view.best, split)
    if view.best is not None and errors is not None:
        _, scatter = scatter_parts(errors, runs)
        share = "" if scatter is None else f"{percent(scatter / view.best.costs[split].value, 0)} of the cost"
        here = "no command was repeated" if scatter is None else fixed(scatter, 4)
        facts.append(Fact("Scatter of a command's repetitions, which no matrix removes", here, share))
    return Facts(tuple(facts))


def scatter_parts(errors: Array, runs: Sequence[Trajectory]) -> tuple[float | None, float | None]:
    """Systematic part and scatter of final errors (Z, 3), m, m, rad; None where no command was repeated.

    The systematic part is the norm of a command's mean error, the scatter the norm of a run's deviation from it,
    each on average. sqrt(n / (n - 1)) corrects for a mean that is itself estimated from the n runs.
    """
    repeated = [rows for rows in grouped([run.command for run in runs]) if len(rows) > 1]
    groups = [errors[list(rows)] for rows in repeated if runs[rows[0]].command is not None]
    if not groups:
        return None, None
    means = [float(np.linalg.norm(group.mean(axis=0))) for group in groups]
    deviations = [
        np.linalg.norm(group - group.mean(axis=0), axis=1) * np.sqrt(len(group) / (len(group) - 1)) for group in groups
    ]
    return float(np.mean(means)), float(np.mean(np.concatenate(deviations)))


def paper_paths(view: views.DatasetView) -> Iterator[FigureGrid]:
    """Fig. 6 and 7: paths of the paper's four commands by the design values and its methods here."""
    chosen: dict[int, Trajectory] = {}
    for run in view.dataset.split(view.scored):
        turning = math.isclose(run.omega or 0.0, _TURN_RATE, abs_tol=1e-3)
        if run.alpha is not None and turning and numbers.moves(run):
            chosen.setdefault(round(numbers.direction_of(run)), run)
    if not set(_DIRECTIONS) <= chosen.keys() or not view.published_entries:
        return
    models = [(views.THEORETICAL_STYLE, view.model())]
    for result, entry, typical in view.published_entries:
        style = view.styles[entry.label]
        item = replace(style, label=f"{style.label}, as the paper's {result.label}")
        models.append((item, view.model(typical.matrix, typical.result.extension)))
    figures = tuple(path_picture(describe(chosen[direction]), chosen[direction], models) for direction in _DIRECTIONS)
    items = (REFERENCE_ITEM, *(item for item, _ in models))
    yield FigureGrid(figures, items, 2, "As Fig. 6 and 7 of the paper.", "paths-of-the-paper")


def flower_figures(view: views.DatasetView) -> Iterator[FigureGrid]:
    """Mean final position error by commanded direction and rate of turn, before and after.

    Nothing where fewer than three directions were driven at each of a few speeds and rates of turn.
    """
    groups: dict[numbers.Motion, dict[int, list[int]]] = {}
    for index, run in enumerate(view.dataset.split(view.scored)):
        if run.alpha is not None and run.omega is not None and numbers.moves(run):
            way = round(numbers.direction_of(run)) % 360
            groups.setdefault(numbers.motion_of(run), {}).setdefault(way, []).append(index)
    few = not groups or len(groups) > numbers.MOST_MOTIONS or min(map(len, groups.values())) < 3
    best, after = view.best, view.errors(view.best, view.scored)
    if best is None or after is None or few or not np.isfinite(after).all():
        return
    before = view.design_errors[view.scored]
    items, largest = numbers.motion_items(sorted(groups)), float(np.hypot(*before[:, :2].T).max())
    factor, unit, _ = views.position_unit(largest)
    figures = []
    for title, of_model in (("design values", before), (best.label, after)):
        traces, errors = [], factor * np.hypot(*of_model[:, :2].T)
        for item, motion in zip(items, sorted(groups), strict=True):
            means = {angle: float(errors[groups[motion][angle]].mean()) for angle in sorted(groups[motion])}
            ways = np.radians([*means, min(means)])  # the outline is closed
            x, y = np.array([*means.values(), means[min(means)]]) * np.array([-np.sin(ways), np.cos(ways)])
            words = [f"{item.label}, α {angle}°: {mean:.3g} {unit}" for angle, mean in means.items()]
            traces += [line(item, 2.0, x, y), marks(item, 5, x[:-1], y[:-1], hover="%{text}", words=words)]
        window = 1.08 * factor * largest * np.array([[-1.0, 1.0]] * 2)
        figure = plan(*traces, window=window, x_title=f"to the right ({unit})", y_title=f"ahead ({unit})")
        name = f"Mean final position error ({unit}), {title}"
        figures.append(page.Figure(name, figure, f"{name}, by direction of motion and rate of turn", 300))
    caption = "Distance from the middle: mean error over repetitions, along the commanded direction, forward up."
    yield FigureGrid(tuple(figures), tuple(items), 2, caption, "errors-by-direction")


def _fig_4(view: views.DatasetView) -> Iterator[FigureGrid]:
    """Fig. 4 of the paper with the settings of its genetic algorithm here: the search as a loop of boxes."""
    genetic = next((run.record for _, entry, run in view.published_entries if entry.calibrator == "genetic"), None)
    if genetic is None:
        return
    options = GeneticOptions.model_validate(genetic.options)
    population = options.size(3 * len(view.dataset.robot.drive.names) - len(genetic.held))
    bounds = "±10 % of V" if genetic.box == "paper" else f"box {genetic.box}"
    # Middles of the boxes, in two columns that a phone and half a sheet of paper can hold, and what stands in them
    boxes = (
        (1, 3, f"<b>Initial population</b><br>V, the design values,<br>and {population - 1} random ones"),
        (1, 2, f"<b>Population of {population}</b><br>V<sub>LB</sub>, V<sub>UB</sub>: {bounds}"),
        (1, 1, f"<b>Odometry</b><br>{plural(len(view.dataset.split('train')), 'training run')}"),
        (1, 0, f"<b>Cost</b><br>{view.config.objective},<br>Eq. (6)"),
        (0, 0, f"<b>Stop?</b> best changes<br>≤ {options.tolerance:g} on average of<br>"
               f"{options.stall_generations} generations, or<br>{count(view.config.budget.evaluations)} evaluations"),
        (0, 1, f"<b>Selection</b><br>elite {percent(options.elite, 0)} unchanged,<br>parents by rank"),
        (0, 2, f"<b>Crossover</b> of {percent(options.crossover, 0)}<br><b>Mutation</b> of the others<br>"
               f"({options.mutation.replace('_', ' ')})"),
    )  # fmt: skip
    looks = {
        "bordercolor": AXIS,
        "borderwidth": 1,
        "borderpad": 6,
        "bgcolor": "white",
        "width": 156,
        "showarrow": False,
    }
    notes: list[dict[str, Any]] = [{"x": x, "y": y, "text": words, "width": 156, **looks} for x, y, words in boxes]
    for (x, y, _), (to_x, to_y, _) in pairwise((*boxes, boxes[1])):
        gap = 87 if y == to_y else 38  # px from the middle of a box to its side, or its top
        ends = {"x": to_x, "y": to_y, "ax": x, "ay": y, "standoff": gap, "startstandoff": gap, "text": ""}
        frames = {"xref": "x", "yref": "y", "axref": "x", "ayref": "y"}
        notes.append({**ends, **frames, "showarrow": True, "arrowhead": 2, "arrowwidth": 1.4, "arrowcolor": INK})
    figure = plot(go.Scatter(x=[-0.5, 1.5], y=[-0.5, 3.5], mode="markers", marker_opacity=0, hoverinfo="skip"))
    hidden = {"visible": False}
    figure.update_layout(annotations=notes, xaxis=hidden, yaxis=hidden, margin_l=10, margin_b=10, font_size=12)
    words = "Initial population, odometry, cost; then stop, or selection, crossover and mutation"
    picture = page.Figure("How the genetic search runs", figure, words, 500)
    yield FigureGrid((picture,), (), 1, f"Fig. 4 of the paper, with the settings of {genetic.label}.", "fig-4")
