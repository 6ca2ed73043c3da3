"""Beside published figures: each method next to the entry that is the same, circumstances, and Fig. 4 to 7."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import plotly.graph_objects as go

from omnibench.compare.config import THEORETICAL_NAME, PublishedResult
from omnibench.compare.report import view as views
from omnibench.data.dataset import SPLITS, Split, Trajectory
from omnibench.fit.intervals import Interval
from omnibench.fit.noise import grouped
from omnibench.registry import calibrators
from omnibench.report.blocks import Block, Callout, Cell, Column, Figure, FigureGrid, Row, Table
from omnibench.report.figures import START, line, marks, path
from omnibench.report.numbers import (
    MOST_MOTIONS,
    NOTHING,
    Motion,
    count,
    direction_of,
    fixed,
    listing,
    motion_items,
    motion_of,
    moves,
    percent,
    seconds,
    span,
)
from omnibench.report.recording.recording_figures import REFERENCE_ITEM, describe, evenly
from omnibench.report.style import plan
from omnibench.robot.kinematics import Array
from omnibench.words import plural

_MET = 1e-4  # share of the lowest cost: searches that end nearer to it are in one minimum (chosen)
_PUBLISHED_COST = "final_pose"  # published costs are those of Eq. (6)
_DIRECTIONS = (30, 210, 120, 300)  # deg, of Fig. 6 (a) to (d)
_TURN_RATE = 0.35  # rad/s
_POINTS = 160  # points that a path is drawn with (chosen)


def published_blocks(view: views.DatasetView) -> Iterator[Block]:
    """Our figures beside the published ones, and the circumstances of both; nothing where none are published."""
    published = view.config.published_results
    if published and view.config.cost_name != _PUBLISHED_COST:
        remark = f"They are of the cost {_PUBLISHED_COST}, Eq. (6); this comparison's is {view.config.cost_name}."
        yield Callout("The published costs cannot be set beside these", (remark,), "warning")
    elif published:
        yield _figure_table(view)
        yield _circumstance_table(view)
        yield from _effort_table(view)
        if lines := _claims(view):
            yield Callout("What the paper claims, and what is seen here", lines)
        remarks = tuple(dict.fromkeys(remark for result in published for remark in result.remarks))
        if remarks:
            yield Callout("About the published figures", remarks)


def _claims(view: views.DatasetView) -> tuple[str, ...]:
    """Two claims of the paper: curves show systematic errors best, and a genetic algorithm avoids local minima."""
    lines, split, turns = [], view.scored, [run.omega for run in view.dataset.split(view.scored)]
    turning = np.array([bool(turn) for turn in turns])
    if view.runs and None not in turns and 0 < turning.sum() < len(turning):
        costs = view.runs[0].design[split].costs
        curved, straight = float(costs[turning].mean()), float(costs[~turning].mean())
        seen = "so here" if curved > straight else "not here"
        lines.append(
            f"Curves show systematic errors best (section 4.1): {seen}, Eq. (6) of the design values is "
            f"{fixed(curved, 3)} on the {views.SPLIT_NAMES[split]} runs in curves and {fixed(straight, 3)} on straight "
            "ones."
        )
    genetic = next((run for _, entry, run in view.published_entries if entry.parameterisation == "matrix"), None)
    costs_of: dict[str, list[float]] = {}
    for run in view.runs:
        record = run.record
        rival = (
            genetic is not None and record.label != genetic.record.label and run.search_space == genetic.search_space
        )
        if rival and calibrators.entry(record.calibrator).cls.stochastic and record.train_cost is not None:
            costs_of.setdefault(record.label, []).append(record.train_cost)
    if genetic is not None and costs_of:
        box, lowest = genetic.record.box, min(min(costs) for costs in costs_of.values())
        met = [
            f"{sum(cost <= (1 + _MET) * lowest for cost in costs)} of {plural(len(costs), 'run')} of {label}"
            for label, costs in costs_of.items()
        ]
        proven = [
            f"; by proof no matrix of the box is more than {percent(certificate.gap, 2)} below it"
            for certificate in view.certificates
            if certificate.box == box
        ]
        lines.append(
            f"Local minima (section 5): from random starts in the box {box}, {listing(met)} ended within "
            f"{percent(_MET, 2)} of one cost, {fixed(lowest, view.cost_decimals)}{''.join(proven)}."
        )
    return tuple(lines)


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
    for label, entry in {entry.label: entry for entry in own.values()}.items():
        same = [result for result in published if result.label in own and own[result.label].label == label]
        reached = {split: cost for split in view.splits if (cost := entry.cost(split)) is not None}
        fell = {split: share for split in view.splits if (share := entry.improvement(split)) is not None}
        figures += _compared(same, label, reached, fell)
    return figures


def _compared(
    published: Sequence[PublishedResult],
    label: str | None,
    costs: Mapping[Split, Interval],
    improvements: Mapping[Split, Interval],
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
        if shares and split in improvements:
            words = f"Improvement, {views.SPLIT_NAMES[split]}{entry}"
            yield ComparedFigure(words, improvements[split], shares, True, 2, methods)
    known = [(costs[split].value, ends) for split in SPLITS if split in costs and (ends := costs[split].known)]
    splits = [(result.costs("train"), result.costs("validation")) for result in published]
    both = [(before, after) for before, after in splits if before and after]
    if len(known) == len(SPLITS) and both:
        change = known[1][0] / known[0][0] - 1
        # Both splits are samples, so that the interval of the change is about that of the two together.
        spread = math.hypot(*((high - low) / 2 / value for value, (low, high) in known))
        changes = tuple(later[kind] / earlier[kind] - 1 for earlier, later in both)
        ours = Interval(change, change - spread, change + spread)
        yield ComparedFigure(f"Change of the {name} cost to validation{entry}", ours, changes, True, 1, methods)


def _figure_table(view: views.DatasetView) -> Table:
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
    sources = listing(list(dict.fromkeys(result.source for result in view.config.published_results)))
    note = "As published: the 95 % interval (small print) contains a published figure."
    if view.dataset.simulated:
        note = "No verdict: what was simulated so that it gives the published figures agrees with them by construction."
    return Table(
        f"Beside the published figures ({sources})",
        (
            Column("Figure", numeric=False),
            Column("Here"),
            Column("Published"),
            Column("From the nearest"),
            Column("Verdict", numeric=False),
        ),
        tuple(rows),
        note,
    )


def _effort_table(view: views.DatasetView) -> Iterator[Table]:
    """Published computing times beside the evaluations and times of the entries that are the same methods."""
    pairs = [(result, entry) for result, entry, _ in view.published_entries if result.seconds is not None]
    if pairs and view.times_compare:
        rows = [
            Row.of(
                Cell(result.label, f"here {entry.label}", view.styles[entry.label].colour),
                seconds(result.seconds),
                count(entry.evaluations_median),
                seconds(entry.seconds_median),
                fixed(entry.train_median, view.cost_decimals),
            )
            for result, entry in pairs
        ]
        titles = ("Time, published", "Evaluations here", "Time here", "CF training here")
        columns = (Column("Method", numeric=False), *map(Column, titles))
        note = "Medians. Hardware and program differ, so times compare within a column only."
        yield Table("Effort of the searches", columns, tuple(rows), note)


def _circumstance_table(view: views.DatasetView) -> Table:
    runs, split = view.dataset.split(view.scored), view.scored
    origin = "simulated" if view.dataset.simulated else "recorded by another robot, or at another time"
    systematic, _ = scatter_parts(view.design_errors[split], runs)
    lengths = [run.distance or float(np.hypot(*np.diff(run.poses[:, :2], axis=0).T).sum()) for run in runs]
    rows = [
        Row.of("Data", Cell(origin, plural(len(runs), f"{views.SPLIT_NAMES[split]} run")), NOTHING),
        Row.of("Distance of a run, mean", f"{fixed(float(np.mean(lengths)), 2)} m", "not known"),
        Row.of("Miss of a command's mean end by the design values", fixed(systematic, 4), "not known"),
        Row.of("Odometry", "exact arcs" if view.config.integration == "arc" else "Euler steps", "Euler steps, Eq. (1)"),
    ]
    best = view.best
    errors = None if best is None or best.typical is None else view.errors(best.typical, split)
    if best is not None and errors is not None and (reached := best.cost(split)) is not None:
        _, scatter = scatter_parts(errors, runs)
        share = "" if scatter is None else f"{percent(scatter / reached.value, 0)} of the cost"
        here = Cell(fixed(scatter, 4), share) if scatter is not None else "no command was repeated"
        rows.append(Row.of("Scatter of a command's repetitions, which no matrix removes", here, "not known"))
    columns = (Column("Circumstance", numeric=False), Column("Here", numeric=False), Column("Published", numeric=False))
    return Table("In which circumstances", columns, tuple(rows))


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
    runs = [run for degrees in _DIRECTIONS if (run := _commanded(view.dataset.split(view.scored), degrees)) is not None]
    if len(runs) < len(_DIRECTIONS) or not view.published_entries:
        return
    models = [(views.THEORETICAL_STYLE, view.model(view.design_matrix))]
    for result, entry, typical in view.published_entries:
        style = view.styles[entry.label]
        item = replace(style, label=f"{style.label}, as the paper's {result.label}")
        assert typical.matrix is not None  # published entries have answers
        models.append((item, view.model(typical.matrix, typical.result.extension)))
    figures = []
    for run in runs:
        reference = run.poses[evenly(len(run.poses), 2 * _POINTS)]
        traces = [path(REFERENCE_ITEM, reference, 3.5), marks(REFERENCE_ITEM, 9, *reference[-1:, :2].T)]
        for item, model in models:
            (poses,) = model.poses([run.log(np.linspace(0.0, run.end, _POINTS))])
            traces += [path(item, poses, 1.8), marks(item, 7, *poses[-1:, :2].T)]
        traces.append(marks(START, 9, run.start[:1], run.start[1:2], hover="start"))
        figures.append(Figure(describe(run), plan(*traces), f"Paths of {describe(run)}, x and y in m", 400))
    items = (REFERENCE_ITEM, *(item for item, _ in models))
    yield FigureGrid(tuple(figures), items, 2, "As Fig. 6 and 7 of the paper.", "paths-of-the-paper")


def _commanded(runs: Sequence[Trajectory], degrees: float) -> Trajectory | None:
    for run in runs:
        off = abs(math.degrees(run.alpha or 0.0) % 360 - degrees)
        if off < 0.5 and math.isclose(run.omega or 0.0, _TURN_RATE, abs_tol=1e-3) and moves(run):
            return run
    return None


def flower_figures(view: views.DatasetView) -> Iterator[FigureGrid]:
    """Mean final position error by commanded direction and rate of turn, before and after.

    Nothing where fewer than three directions were driven at each of a few speeds and rates of turn.
    """
    runs, best = view.dataset.split(view.scored), view.best
    after = None if best is None or best.typical is None else view.errors(best.typical, view.scored)
    moving = [index for index, run in enumerate(runs) if run.alpha is not None and run.omega is not None and moves(run)]
    motions = sorted({motion_of(runs[index]) for index in moving})
    directions = [{round(direction_of(runs[i])) % 360 for i in moving if motion_of(runs[i]) == m} for m in motions]
    few = not moving or len(motions) > MOST_MOTIONS or min(map(len, directions)) < 3
    if best is None or after is None or few or not np.isfinite(after).all():
        return
    legend = motion_items(motions)
    errors = [np.hypot(*each[:, :2].T) for each in (view.design_errors[view.scored], after)]
    factor, unit, _ = views.position_unit(float(errors[0].max()))
    titles = ("design values", best.label)
    figures = [
        Figure(
            f"Mean final position error ({unit}), {title}",
            _by_direction(runs, moving, motions, factor * of_model, 1.08 * factor * float(errors[0].max()), unit),
            f"Mean final position error in {unit} by direction of motion and rate of turn, {title}",
            300,
        )
        for title, of_model in zip(titles, errors, strict=True)
    ]
    caption = "Distance from the middle: mean error over repetitions, along the commanded direction, forward up."
    yield FigureGrid(tuple(figures), tuple(legend), 2, caption, "errors-by-direction")


def _by_direction(
    runs: Sequence[Trajectory], moving: Sequence[int], motions: Sequence[Motion], errors: Array, limit: float, unit: str
) -> go.Figure:
    """Mean error of each motion as the distance from the middle along its commanded direction, forward up."""
    traces = []
    for motion, item in zip(motions, motion_items(motions), strict=True):
        rows = np.array([index for index in moving if motion_of(runs[index]) == motion])
        angles = np.array([direction_of(runs[index]) for index in rows])
        unique = np.unique(angles)
        means = np.array([errors[rows[angles == angle]].mean() for angle in unique])
        along = np.radians(np.append(unique, unique[0]))
        x, y = np.append(means, means[0]) * np.array([-np.sin(along), np.cos(along)])
        words = [f"{item.label}, α {angle:.0f}°: {mean:.3g} {unit}" for angle, mean in zip(unique, means, strict=True)]
        traces += [line(item, 2.0, x, y), marks(item, 5, x[:-1], y[:-1], hover="%{text}", words=words)]
    window = limit * np.array([[-1.0, 1.0]] * 2)
    return plan(*traces, window=window, x_title=f"to the right ({unit})", y_title=f"ahead ({unit})")
