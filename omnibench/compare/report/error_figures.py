"""The sections on final errors and on paths: errors before and after by command, and paths with what was driven."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import plotly.graph_objects as go

from omnibench.compare.report.view import (
    REFERENCE_STYLE,
    SPLIT_NAMES,
    THEORETICAL_STYLE,
    DatasetView,
    entry_cell,
    mean_and_worst,
    position_unit,
)
from omnibench.compare.result import EntryStatistics, ScoredFit
from omnibench.data.dataset import Split, Trajectory
from omnibench.fit.evaluate import positions_and_headings
from omnibench.report import blocks as page
from omnibench.report.figures import START, coordinates, line, marks, path
from omnibench.report.numbers import MOST_MOTIONS, Motion, direction_of, fixed, listing, motion_items, motion_of, moves
from omnibench.report.recording.recording_figures import describe, evenly
from omnibench.report.style import INK, plan, plot, text, wrapped
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

_SHOWN = 4  # trajectories that are drawn, as many as in Fig. 6 of the paper
_POINTS = 160  # points that a path is drawn with (chosen)
_TAIL = 0.15  # last share of a run's duration, which the figure of its end shows (chosen)
_SEEN = 0.02  # share of a detail's window: ends that are nearer to each other are one mark on a screen
_PAPER_DIRECTIONS = (30, 210, 120, 300)  # deg, of Fig. 6 (a) to (d)
_PAPER_TURN_RATE = 0.35  # rad/s


@dataclass(frozen=True, eq=False)
class DrawnModel:
    """A model that stands for every entry whose paths cannot be told from its own. entries: their labels."""

    style: page.LegendItem
    model: OdometryModel
    entries: tuple[str, ...] = ()


def path_section(view: DatasetView) -> page.Section:
    """A few trajectories of the scored split: whole paths, each beside the detail of its end."""
    chosen = chosen_trajectories(view.dataset.split(view.scored))
    models = drawn_models(view, chosen)
    figures = [
        figure
        for trajectory in chosen
        for figure in (_path_figure(trajectory, models), _end_figure(view, trajectory, models))
    ]
    several = [each for each in models if len(each.entries) > 1]
    groups = "; ".join(f"{each.style.label}: {listing(list(each.entries[1:]), 20)}" for each in several)
    whence = "As Fig. 5 to 7 of the paper, of" if view.of_the_paper else "Of"
    caption = (
        f"{whence} the {SPLIT_NAMES[view.scored]} runs. Right: final poses about the reference's final position; short "
        "strokes show headings. The window holds the nearer ends; Autoscale, at the top right of a plot, shows all."
    )
    if groups:
        near = f"within {100 * _SEEN:.0f} % of the window of each other"
        caption += f" Entries that end {near} are drawn as one. {groups}."
    grid = page.FigureGrid(
        tuple(figures), (REFERENCE_STYLE, *(each.style for each in models)), 2, caption, "paths-and-ends"
    )
    about = "The paths of every entry that can be told from the others, and where they end."
    return page.Section("paths", "Paths of all entries", (grid,), about=about, folded=True)


def drawn_models(view: DatasetView, trajectories: Sequence[Trajectory]) -> list[DrawnModel]:
    """The design values, then one model for each group of entries with the same ends as far as can be seen.

    Entries that are the methods of published results come last, on top, each by itself, as in Fig. 6 and 7.
    """
    finals = [trajectory.final_log for trajectory in trajectories]
    last = np.array([trajectory.final_pose[:2] for trajectory in trajectories])
    calibrated = sorted(view.calibrated, key=lambda pair: not pair[0].is_best)  # the best one leads its group
    models = {
        entry.label: view.model(run.matrix, run.result.extension) for entry, run in calibrated if run.matrix is not None
    }
    ends = {label: np.array([poses[-1, :2] for poses in model.poses(finals)]) for label, model in models.items()}
    off = [1e3 * np.linalg.norm(end - last, axis=1) for end in ends.values()]
    seen = [2e-3 * _SEEN * _window(list(of_run)) for of_run in np.transpose(off)]  # m, of each run
    of_paper = {entry.label: result.label for result, entry, _ in view.published_entries}
    groups: dict[str, list[str]] = {}
    for label in sorted(ends, key=lambda label: label in of_paper):
        leaders = () if label in of_paper else groups
        near = (leader for leader in leaders if (np.linalg.norm(ends[label] - ends[leader], axis=1) < seen).all())
        groups.setdefault(next(near, label), []).append(label)
    others = [label for label in groups if label not in of_paper]
    order = [*reversed(others), *of_paper]  # the best on top, but for the paper's methods
    drawn = [_group(view.styles[leader], models[leader], groups[leader], of_paper.get(leader)) for leader in order]
    return [DrawnModel(THEORETICAL_STYLE, view.model(view.design_matrix)), *drawn]


def _group(style: page.LegendItem, model: OdometryModel, members: Sequence[str], published: str | None) -> DrawnModel:
    if published is not None:
        style = replace(style, label=f"{style.label}, as the paper's {published}")
    if len(members) > 1:
        style = replace(style, label=f"{style.label} and {plural(len(members) - 1, 'other')}")
    return DrawnModel(style, model, tuple(members))


def chosen_trajectories(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Up to four trajectories to draw: those of the paper's commands where they were driven, else a variety."""
    first_of = {t.command or t.session or t.id: t for t in reversed(trajectories)}
    distinct = [t for t in trajectories if first_of[t.command or t.session or t.id] is t]
    commanded = [t for t in distinct if t.alpha is not None and t.omega is not None and (t.v is None or t.v > 0)]
    by_direction = [_with_command(commanded, degrees) for degrees in _PAPER_DIRECTIONS]
    paper = [trajectory for trajectory in by_direction if trajectory is not None]
    if len(paper) == _SHOWN:
        return paper
    # Turns show an error of the model best.
    if commanded:
        strongest = max(abs(t.omega or 0.0) for t in commanded)
        distinct = [t for t in commanded if math.isclose(abs(t.omega or 0.0), strongest)]
        distinct.sort(key=lambda t: ((t.omega or 0.0) < 0, t.alpha or 0.0))
    pool = distinct if len(distinct) >= _SHOWN else list(trajectories)
    return [pool[index] for index in evenly(len(pool), _SHOWN)]


def _with_command(trajectories: Sequence[Trajectory], degrees: float) -> Trajectory | None:
    for trajectory in trajectories:
        direction = math.degrees(trajectory.alpha or 0.0) % 360
        if abs(direction - degrees) < 0.5 and math.isclose(trajectory.omega or 0.0, _PAPER_TURN_RATE, abs_tol=1e-3):
            return trajectory
    return None


def _path_figure(trajectory: Trajectory, models: Sequence[DrawnModel]) -> page.Figure:
    reference = trajectory.poses[evenly(len(trajectory.poses), 2 * _POINTS)]
    stamps = np.linspace(0.0, trajectory.end, _POINTS)
    traces = [path(REFERENCE_STYLE, reference, 3.5), _end_mark(REFERENCE_STYLE, reference, 9)]
    for each in models:
        (poses,) = each.model.poses([trajectory.log(stamps)])
        traces += [path(each.style, poses, 1.8), _end_mark(each.style, poses, 7)]
    traces.append(marks(START, 9, trajectory.start[:1], trajectory.start[1:2], hover="start"))
    title = describe(trajectory)
    description = f"Paths of {title}: reference, odometry by the design values and calibrated, x and y in metres"
    return page.Figure(title, plan(*traces), description, 400)


def _end_mark(style: page.LegendItem, poses: Array, size: int) -> go.Scatter:
    return marks(style, size, poses[-1:, 0], poses[-1:, 1], marker_line_width=2)


def _end_figure(view: DatasetView, trajectory: Trajectory, models: Sequence[DrawnModel]) -> page.Figure:
    final = trajectory.final_pose
    duration = trajectory.end
    stamps = np.linspace((1 - _TAIL) * duration, duration, 60)
    tails = [(each.style, each.model.poses([trajectory.log(stamps)])[0]) for each in models]
    calibrated = tails[1:] or tails  # the design values come first, and are far away
    half = _window([_distance_mm(poses[-1], final) for _, poses in calibrated])
    late = trajectory.poses[trajectory.pose_times >= min(stamps[0], trajectory.pose_times[-2:][0])]
    traces = _tail_traces(REFERENCE_STYLE, late, final, half, width=2.6)
    for style, poses in tails:
        traces += _tail_traces(style, poses, final, half, width=1.6)
    window = half * np.array([[-1.0, 1.0]] * 2)
    return page.Figure(
        f"Its end: {_ends_in_words(view, trajectory)}",
        plan(*traces, window=window, x_title="x − x of reference (mm)", y_title="y − y of reference (mm)"),
        f"Final poses of {describe(trajectory)} about the reference's final position, in millimetres",
        400,
    )


def _tail_traces(style: page.LegendItem, poses: Array, final: Array, half: float, width: float) -> list[go.Scatter]:
    millimetres = 1e3 * (poses[:, :2] - final[:2])
    end = millimetres[-1]
    stroke = end + 0.28 * half * np.array([[0.0, 0.0], [math.cos(poses[-1, 2]), math.sin(poses[-1, 2])]])
    hover = f"{text(style.label)}: {math.hypot(*end):.1f} mm, {math.degrees(poses[-1, 2] - final[2]):.2f}°"
    return [
        line(style, width, *millimetres.T, hover=hover, opacity=0.55),
        line(style, 2.2, *stroke.T, hover=hover, line_dash="solid"),
        marks(style, 11, end[:1], end[1:], hover=hover, marker_line_width=2),
    ]


def _ends_in_words(view: DatasetView, trajectory: Trajectory) -> str:
    """Distances of the theoretical end and the best entry's end from the reference's, in words."""
    (design,) = view.model(view.design_matrix).poses([trajectory.final_log])
    parts = [f"design values {_distance_mm(design[-1], trajectory.final_pose):.0f} mm off"]
    best = view.best
    if best is not None and best.typical is not None and best.typical.matrix is not None:
        (pose,) = view.model(best.typical.matrix, best.typical.result.extension).poses([trajectory.final_log])
        parts.append(f"{best.label} {_distance_mm(pose[-1], trajectory.final_pose):.0f} mm")
    return ", ".join(parts)


def _window(distances: Sequence[float]) -> float:
    """Half the width (mm) of a detail that holds the reference's end and the nearer half of the others at least."""
    near = [distance for distance in distances if distance <= 2.5 * float(np.median(distances))]
    return max(5.0, 1.45 * max(near))


def _distance_mm(pose: Array, reference: Array) -> float:
    return 1e3 * float(math.hypot(pose[0] - reference[0], pose[1] - reference[1]))


_MANY_GROUPS = 12  # commands or sessions: with more, all trajectories of a split share one box plot (chosen)


def error_section(view: DatasetView) -> page.Section:
    """Final errors on the scored split as table and figures; the table of the other split is folded away."""
    others = (
        page.Details(f"Final errors on the {SPLIT_NAMES[split]} runs", (final_error_table(view, split),))
        for split in view.splits
        if split != view.scored
    )
    blocks = (final_error_table(view, view.scored), *_figures(view), *others)
    about = "How far from the reference the odometry ends: every entry, and by direction of motion."
    return page.Section("errors", "Final errors", blocks, about=about, folded=True)


def final_error_table(view: DatasetView, split: Split) -> page.Table:
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
        rows.append(page.Row.of(entry_cell(view, entry_or_none), *cells, role="best" if is_best else "plain"))
    return page.Table(
        caption=f"Error of the final pose, {SPLIT_NAMES[split]} runs",
        columns=(
            page.Column("Entry", numeric=False),
            page.Column("position, mean", unit),
            page.Column("position, worst", unit),
            page.Column("heading, mean", "°"),
            page.Column("heading, worst", "°"),
        ),
        rows=tuple(rows),
    )


def _figures(view: DatasetView) -> tuple[page.Block, ...]:
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
) -> tuple[page.Block, ...]:
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
                page.Figure(
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
    grid = page.FigureGrid(tuple(figures), tuple(legend), 3, caption)
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
    curves: Sequence[tuple[Array, Array]], legend: Sequence[page.LegendItem], quantity: _Quantity, limit: float
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


def _turns_on_the_spot(view: DatasetView, trajectories: Sequence[Trajectory], after: Array) -> tuple[page.Block, ...]:
    still = np.array([not moves(t) for t in trajectories])
    if not still.any():
        return ()
    parts = [
        f"mean {quantity.name} {fixed(quantity.before[still].mean(), quantity.decimals)} → "
        f"{fixed(quantity.after[still].mean(), quantity.decimals)} {quantity.unit}"
        for quantity in _quantities(view.design_errors[view.scored], after)
    ]
    return (page.Paragraph(f"Turns on the spot have no direction and are not drawn: {', '.join(parts)}.", "note"),)


def _box_plots(view: DatasetView, best: EntryStatistics, typical: ScoredFit) -> page.FigureGrid:
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
        page.Figure(
            f"Final {quantity.name} ({quantity.unit})",
            _box_figure(groups, quantity, styles),
            f"Final {quantity.name} in {quantity.unit} of each group of trajectories, theoretical and {best.label}",
            80 + 44 * len(set(groups)),
        )
        for quantity in quantities
    )
    return page.FigureGrid(
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


def _box_figure(groups: Sequence[str], quantity: _Quantity, styles: Sequence[page.LegendItem]) -> go.Figure:
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
