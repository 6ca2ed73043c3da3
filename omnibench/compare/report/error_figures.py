"""The section on final errors: a table, and errors before and after by command: polar plots or box plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from omnibench.compare.report.view import (
    SPLIT_NAMES,
    THEORETICAL_STYLE,
    DatasetView,
    entry_cell,
    mean_and_worst,
    position_unit,
)
from omnibench.compare.result import EntryStatistics, ScoredRun
from omnibench.data.dataset import Split, Trajectory
from omnibench.fit.evaluate import positions_and_headings
from omnibench.report.blocks import (
    Block,
    Column,
    Details,
    Figure,
    FigureGrid,
    LegendItem,
    Paragraph,
    Row,
    Section,
    Table,
)
from omnibench.report.numbers import MOST_MOTIONS, Motion, direction_of, fixed, motion_items, motion_of, moves
from omnibench.report.style import INK, plot, text, wrapped
from omnibench.report.traces import coordinates
from omnibench.robot.kinematics import Array

_MANY_GROUPS = 12  # commands or sessions: with more, all trajectories of a split share one box plot (chosen)


def error_section(view: DatasetView) -> Section:
    """Final errors on the scored split as table and figures; the table of the other split is folded away."""
    others = (
        Details(f"Final errors on the {SPLIT_NAMES[split]} runs", (final_error_table(view, split),))
        for split in view.splits
        if split != view.scored
    )
    blocks = (final_error_table(view, view.scored), *_figures(view), *others)
    about = "How far from the reference the odometry ends: every entry, and by direction of motion."
    return Section("errors", "Final errors", blocks, about=about, folded=True)


def final_error_table(view: DatasetView, split: Split) -> Table:
    """A table of mean and worst final errors in position and heading, design values first."""
    errors: list[tuple[EntryStatistics | None, Array]] = [(None, view.design_errors[split])]
    for entry, run in view.calibrated:
        after = view.errors(run, split)
        if after is not None:
            errors.append((entry, after))
    factor, unit, decimals = position_unit(*(mean_and_worst(positions_and_headings(rows)[0])[0] for _, rows in errors))
    rows = []
    for entry_or_none, of_entry in errors:
        positions, headings = positions_and_headings(of_entry)
        cells = [fixed(factor * value, decimals) for value in mean_and_worst(positions)]
        cells += [fixed(np.degrees(value), 2) for value in mean_and_worst(headings)]
        is_best = entry_or_none is not None and entry_or_none.is_best
        rows.append(Row.of(entry_cell(view, entry_or_none), *cells, role="best" if is_best else "plain"))
    return Table(
        caption=f"Error of the final pose, {SPLIT_NAMES[split]} runs",
        columns=(
            Column("Entry", numeric=False),
            Column("position, mean", unit),
            Column("position, worst", unit),
            Column("heading, mean", "°"),
            Column("heading, worst", "°"),
        ),
        rows=tuple(rows),
    )


def _figures(view: DatasetView) -> tuple[Block, ...]:
    """Final errors before and after calibration: by direction where those were commanded, else in groups."""
    best = view.best
    if best is None or best.typical is None:
        return ()
    after = view.errors(best.typical, view.scored)
    if after is None:
        return ()
    trajectories = view.dataset.split(view.scored)
    if _is_flower(trajectories) and np.isfinite(after).all():
        return _flower_blocks(view, trajectories, after, best.label)
    return (_box_plots(view, best, best.typical),)


@dataclass(frozen=True)
class _Quantity:
    """One kind of error (Z,), before and after calibration, in the unit in which it is drawn."""

    name: str
    unit: str
    before: Array
    after: Array
    decimals: int


def _quantities(before: Array, after: Array) -> list[_Quantity]:
    """The kinds of errors that are known of some runs."""
    (p0, h0), (p1, h1) = positions_and_headings(before), positions_and_headings(after)
    factor, unit, decimals = position_unit(mean_and_worst(p0)[0], mean_and_worst(p1)[0])
    both = (
        _Quantity("position error", unit, factor * p0, factor * p1, decimals),
        _Quantity("heading error", "°", np.degrees(h0), np.degrees(h1), 2),
    )
    return [quantity for quantity in both if np.isfinite(quantity.before).any()]


def _is_flower(trajectories: Sequence[Trajectory]) -> bool:
    """True if at least three directions were driven at each of a few speeds and rates of turn."""
    if any(t.alpha is None or t.omega is None for t in trajectories):
        return False
    directions: dict[Motion, set[int]] = {}
    for trajectory in trajectories:
        if moves(trajectory):
            directions.setdefault(motion_of(trajectory), set()).add(round(direction_of(trajectory)) % 360)
    return 0 < len(directions) <= MOST_MOTIONS and all(len(driven) >= 3 for driven in directions.values())


def _flower_blocks(
    view: DatasetView, trajectories: Sequence[Trajectory], after: Array, label: str
) -> tuple[Block, ...]:
    motions = sorted({motion_of(t) for t in trajectories if moves(t)})
    legend = motion_items(motions)
    figures = []
    for quantity in _quantities(view.design_errors[view.scored], after):
        means = [_petals(trajectories, motion, quantity) for motion in motions]
        largest = max(float(max(before.max(), values.max())) for _, before, values in means)
        reached = max(float(values.max()) for _, _, values in means)
        for title, column, limit in (
            ("design values", 1, largest),
            (f"{label}, same scale", 2, largest),
            (f"{label}, enlarged", 2, reached),
        ):
            curves = [(petals[0], petals[column]) for petals in means]
            figures.append(
                Figure(
                    f"Mean final {quantity.name} ({quantity.unit}), {title}",
                    _polar(curves, legend, quantity, 1.08 * limit),
                    f"Mean final {quantity.name} in {quantity.unit} by direction of motion and rate of turn, {title}",
                    300,
                )
            )
    caption = (
        f"Mean over the repetitions of each command, {SPLIT_NAMES[view.scored]} runs. The angle is the commanded "
        "direction α in the robot's frame, forward up and left to the left; the radius is the error."
    )
    grid = FigureGrid(tuple(figures), tuple(legend), 3, caption)
    return (grid, *_turns_on_the_spot(view, trajectories, after))


def _petals(trajectories: Sequence[Trajectory], motion: Motion, quantity: _Quantity) -> tuple[Array, Array, Array]:
    """Directions (deg) and mean errors before and after of one speed and rate of turn, the first direction repeated."""
    like = [i for i, t in enumerate(trajectories) if moves(t) and motion_of(t) == motion]
    direction = np.array([direction_of(trajectories[i]) for i in like])
    angles = np.unique(direction)
    chosen = [np.array(like)[direction == angle] for angle in angles]
    before = np.array([quantity.before[rows].mean() for rows in chosen])
    after = np.array([quantity.after[rows].mean() for rows in chosen])
    closed = np.append(angles, angles[0])
    return closed, np.append(before, before[0]), np.append(after, after[0])


def _polar(
    curves: Sequence[tuple[Array, Array]], legend: Sequence[LegendItem], quantity: _Quantity, limit: float
) -> go.Figure:
    hover = f"%{{r:.{quantity.decimals}f}} {quantity.unit}"
    traces = [
        go.Scatterpolar(
            theta=coordinates(angles),
            r=coordinates(values),
            mode="lines+markers",
            line={"color": item.colour, "width": 2},
            marker={"size": 5},
            legendgroup=item.key,
            hovertemplate=f"{text(item.label)}, α %{{theta:.0f}}°<br>{hover}<extra></extra>",
        )
        for (angles, values), item in zip(curves, legend, strict=True)
    ]
    figure = plot(
        *traces,
        polar={
            "angularaxis": {"rotation": 90, "direction": "counterclockwise", "dtick": 30, "ticksuffix": "°"},
            "radialaxis": {"range": [0, limit], "nticks": 5, "angle": 75, "tickangle": 75, "showline": False},
        },
    )
    figure.update_layout(margin={"l": 38, "r": 38, "t": 26, "b": 26})
    return figure


def _turns_on_the_spot(view: DatasetView, trajectories: Sequence[Trajectory], after: Array) -> tuple[Block, ...]:
    still = np.array([not moves(t) for t in trajectories])
    if not still.any():
        return ()
    parts = [
        f"mean {quantity.name} {fixed(quantity.before[still].mean(), quantity.decimals)} → "
        f"{fixed(quantity.after[still].mean(), quantity.decimals)} {quantity.unit}"
        for quantity in _quantities(view.design_errors[view.scored], after)
    ]
    return (Paragraph(f"Turns on the spot have no direction and are not drawn: {', '.join(parts)}.", "note"),)


def _box_plots(view: DatasetView, best: EntryStatistics, typical: ScoredRun) -> FigureGrid:
    """Box plots over the trajectories of each command or session, on both splits."""
    groups: list[str] = []
    before, after = [], []
    for split in view.design_errors:
        errors = view.errors(typical, split)
        if errors is not None:
            groups += _groups(view, split)
            before.append(view.design_errors[split])
            after.append(errors)
    quantities = _quantities(np.concatenate(before), np.concatenate(after))
    style = view.styles[best.label]
    styles = [THEORETICAL_STYLE] if style is THEORETICAL_STYLE else [THEORETICAL_STYLE, style]
    figures = tuple(
        Figure(
            f"Final {quantity.name} ({quantity.unit})",
            _box_figure(groups, quantity, styles),
            f"Final {quantity.name} in {quantity.unit} of each group of trajectories, theoretical and {best.label}",
            80 + 44 * len(set(groups)),
        )
        for quantity in quantities
    )
    return FigureGrid(
        figures,
        tuple(styles),
        1,
        "Every point is a trajectory; the rectangle holds the middle half, its line is the median.",
    )


def _groups(view: DatasetView, split: Split) -> list[str]:
    trajectories = view.dataset.split(split)
    for names in ([t.command for t in trajectories], [t.session for t in trajectories]):
        if None not in names and len(set(names)) <= _MANY_GROUPS:
            return [f"{SPLIT_NAMES[split]}: {name}" for name in names]
    return [SPLIT_NAMES[split]] * len(trajectories)


def _box_figure(groups: Sequence[str], quantity: _Quantity, styles: Sequence[LegendItem]) -> go.Figure:
    traces = [
        go.Box(
            y=[text(wrapped(group)) for group in groups],
            x=coordinates(values),
            orientation="h",
            boxpoints="all",
            jitter=0.5,
            pointpos=0,
            line={"color": drawn.colour, "width": 1.5},
            marker={"color": drawn.colour, "size": 4, "opacity": 0.6},
            fillcolor="rgba(255,255,255,0)",
            legendgroup=drawn.key,
            hovertemplate=f"{text(drawn.label)}: %{{x:.{quantity.decimals}f}} {quantity.unit}<extra></extra>",
        )
        for drawn, values in zip(styles, (quantity.before, quantity.after), strict=False)
    ]
    figure = plot(*traces, boxmode="group", x_title=f"final {quantity.name} ({quantity.unit})")
    figure.update_xaxes(rangemode="tozero")
    figure.update_yaxes(tickfont_color=INK, autorange="reversed", ticks="")  # first group on top
    return figure
