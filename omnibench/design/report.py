"""The report of a design: what to drive, how precise it is, the baseline's equals; as words, figures and tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import cycle
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from omnibench.design.candidates import Per, Use
from omnibench.design.design import Candidate, Design, Effort, Precision, SetDesign, Step
from omnibench.report import blocks as page
from omnibench.report.figures import ORIGIN, line, marks
from omnibench.report.numbers import (
    NOTHING,
    count,
    fixed,
    listing,
    motion_in_words,
    noise_in_words,
    percent,
    significant,
)
from omnibench.report.result import NextStep, Remark, Result
from omnibench.report.style import INK, PALETTE, QUIET, logarithmic, plan, plot, text
from omnibench.robot.kinematics import Array
from omnibench.words import plural


class DesignResult(Result):
    """A design. folder: where its files are, None if nowhere."""

    def __init__(self, design: Design, folder: Path | None = None) -> None:
        self.design, self.folder = design, folder

    def opening(self) -> Sequence[Remark]:
        design, use = self.design, USE_IN_WORDS[self.design.use]
        simulated = " (simulated data)" if design.simulated else ""
        kind = simulated if design.recorded else " (assumed)"
        first = f"{design.name}{kind}: robot {design.robot}, D-optimal per {design.per}, {use}"
        return [Remark(first), Remark(origin_in_words(design))]

    def tables(self) -> Sequence[page.Table]:
        design = self.design
        of_sets = [(chosen_table(design, each), effort_table(design, each)) for each in design.sets]
        return [*(table for tables in of_sets for table in tables), equal_table(design)]

    def remarks(self) -> Sequence[Remark]:
        lines = []
        for of_set in self.design.sets:
            lines += [choice_in_words(self.design, of_set), motions_in_words(of_set)]
            if not self.design.recorded:
                lines += ["What to drive:", *(f"  {each}" for each in plan_in_words(self.design, of_set))]
        lines += [f"- {note}" for note in self.design.notes]
        lines += [] if self.folder is None else [f"report: {self.folder / 'report.html'}"]
        return list(map(Remark, lines))

    def next_step(self) -> NextStep:
        what = plural(self.design.sets[0].step.effort.runs, "run")
        drive = "drive them and make a data set of the recordings (omnibench guide data)"
        return NextStep(f"{what} tell the most of {self.design.robot}", drive)

    def document(self) -> page.Document:
        return design_document(self.design)

    def json(self) -> Design:
        return self.design


USE_IN_WORDS: Mapping[Use, str] = {"final": "final poses", "trajectory": "whole trajectories"}
UNIT_OF_COST: Mapping[Per, str] = {"run": "runs", "second": "s", "metre": "m of wheel"}


def command_in_words(candidate: Candidate) -> str:
    return motion_in_words(candidate.name, candidate.speed, candidate.direction, candidate.turn_rate)


def drive_in_words(candidate: Candidate) -> str:
    """A command as a person drives it: ``forward 2 m at 0.5 m/s, turning left with radius 1.2 m``."""
    speed, direction, rate = candidate.speed, candidate.direction, candidate.turn_rate
    if speed is None or direction is None or rate is None:
        return candidate.name
    turned = math.degrees(abs(rate) * candidate.duration_s)
    turns = plural(round(turned / 360), "full turn") if turned > 359 else f"{fixed(turned, 0)}°"
    side = "left" if rate > 0 else "right"
    if not speed:
        return f"on the spot {turns} to the {side} at {significant(abs(rate), 2)} rad/s"
    driven = f"{_way_in_words(direction)} {significant(candidate.distance_m, 2)} m at {significant(speed, 2)} m/s"
    if not rate:
        return driven
    return f"{driven}, turning {side} by {turns} with radius {significant(speed / abs(rate), 2)} m"


def _way_in_words(direction: float) -> str:
    """A direction, rad, as ``forward``, ``backward``, ``sideways to the left`` or with its angle."""
    degrees = round(math.degrees(direction), 3) % 360
    words = {0.0: "forward", 90.0: "sideways to the left", 180.0: "backward", 270.0: "sideways to the right"}
    side = "left" if degrees < 180 else "right"
    return words.get(degrees, f"at {fixed(min(degrees, 360 - degrees), 0)}° to the {side} of forward,")


def plan_in_words(design: Design, of_set: SetDesign) -> tuple[str, ...]:
    """What to drive of a set, a line for each chosen command, with how often."""
    drives = ((drive_in_words(design.candidate(chosen.command)), chosen.runs) for chosen in of_set.chosen)
    return tuple(f"{drive}, {plural(runs, 'time')}" for drive, runs in drives)


def motions_in_words(of_set: SetDesign) -> str:
    """Precision of odometry that the chosen runs promise, in words."""
    left = [
        f"{significant(each.position_mm, 2)} mm and {significant(each.heading_deg, 2)}° after {each.motion}"
        for each in of_set.step.motions
    ]
    return f"Calibrated from these runs, the matrix leaves an error of {listing(left)} (standard deviations)."


def duration_in_words(seconds: float) -> str:
    """A duration of driving, in s, or in min from 120 s on."""
    return f"{significant(seconds, 3)} s" if seconds < 120 else f"{fixed(seconds / 60, 1)} min"


def effort_in_words(effort: Effort) -> str:
    """An effort as ``6 runs, 33.5 s, 6.7 m``."""
    runs = plural(effort.runs, "run")
    return f"{runs}, {duration_in_words(effort.seconds)}, {significant(effort.metres, 3)} m"


def origin_in_words(design: Design) -> str:
    """Origin of candidates and noise, so that nobody takes an assumption for a measurement."""
    recorded = "of simulated recordings" if design.simulated else "of recordings"
    kind = recorded if design.recorded else "as designed, nothing recorded"
    return f"candidates: commands {kind}; noise {design.noise_source}"


def choice_in_words(design: Design, of_set: SetDesign) -> str:
    """Efficiency of a set's chosen runs against the bound that no design exceeds, in words."""
    runs = plural(of_set.step.effort.runs, "run")
    share = percent(of_set.step.efficiency, 2)
    lost = percent(1 - of_set.step.efficiency, 2)
    bound = f"{share} of the bound that no design from these {plural(len(of_set.commands), 'command')} exceeds"
    if design.runs_asked is not None:
        return f"{runs}, as asked for, reach {bound}."
    if of_set.reached:
        return f"{runs} are within 1 % of the D-optimum: they reach {bound} (at most {lost} is lost)."
    return f"No design found is within 1 % of the bound; the best, of {runs}, reaches {bound}."


def equal_in_words(design: Design, of_set: SetDesign, use: Use) -> str:
    """Number of runs of a set that give as much information as the baseline, in words."""
    equal = of_set.equivalent(use)
    if equal.least is None:
        return "none: they leave part of the matrix undetermined"
    effort = "none within the repetitions allowed" if equal.effort is None else effort_in_words(equal.effort)
    return f"{effort} (no design does it below {least_in_words(equal.least)} {UNIT_OF_COST[design.per]})"


def headline(design: Design) -> str:
    """The answer, a sentence for each set."""
    sentences = []
    for of_set in design.sets:
        drive = f"{of_set.name}: drive" if len(design.sets) > 1 else "Drive"
        runs, chosen = plural(of_set.step.effort.runs, "run"), plural(len(of_set.chosen), "command")
        words = f"{drive} {runs} of {chosen}; together they give "
        if of_set.reached:
            commands = plural(len(of_set.commands), "command")
            words += f"as much information per {design.per} as the best design from {commands}, within 1 %"
        else:
            words += f"{percent(of_set.step.efficiency)} of the best design's information per {design.per}"
        if (effort := of_set.equivalent(design.use).effort) is not None:
            give = "gives" if effort.runs == 1 else "give"
            words += f"; {count(effort.runs)} of the best runs {give} as much as the baseline's {baseline_runs(design)}"
        sentences.append(f"{words}.")
    return " ".join(sentences)


def least_in_words(least: float) -> str:
    """A lower bound to a tenth, rounded down so that it stays one."""
    return fixed(math.floor(10 * least) / 10, 1)


def baseline_runs(design: Design) -> str:
    """Number of the baseline's runs."""
    return count(design.baseline.precision.effort.runs)


_LEFT = page.LegendItem("left", "turning left", PALETTE[0])
_STRAIGHT = page.LegendItem("straight", "straight", "#5b6772")
# Left and right turns may run along the same circle: dashes over a line show both.
_RIGHT = page.LegendItem("right", "turning right", PALETTE[1], "dash")
_UNUSED = page.LegendItem("unused", "candidates not chosen", "#d4d9df")
_ASSUMED = page.Badge("ASSUMED NOISE, NO RECORDINGS", "warning")
_BASELINE = page.LegendItem("", "baseline", QUIET, symbol="diamond")
# rad: a run that turns by less is drawn as straight; nothing else hangs on it. Before calibration the simulated APR-02
# seems to turn by 0.1 to 2.7 degrees in six straight runs: five are drawn as straight, three with half of it and six
# with twice (tests/studies/constants_fit.py).
_STRAIGHT_BELOW = math.radians(2)
_Curve = tuple[Callable[[Precision], float], page.Dash]
_HEIGHT = 380  # px: the paths end within the first 900 of the page
# What curves show of a step, and how they are drawn.
_RUNS, _SECONDS = attrgetter("effort.runs"), attrgetter("effort.seconds")
_RELATIVE: _Curve = (attrgetter("relative"), "solid")
_ROWS_OF_MATRIX: tuple[_Curve, ...] = (
    (lambda step: step.row_percent[0], "solid"),
    (lambda step: step.row_percent[1], "dash"),
    (lambda step: step.row_percent[2], "dot"),
)
_OF_WHEELS: tuple[_Curve, ...] = (
    (attrgetter("physical.radius_percent"), "solid"),
    (attrgetter("physical.distance_percent"), "dash"),
)


def path_figures(design: Design) -> page.FigureGrid:
    """Paths of each set's commands; a chosen one is in colour, and the wider the more often it is driven."""
    figures = tuple(
        page.Figure(
            f"{of_set.name}: {plural(of_set.step.effort.runs, 'run')} of {plural(len(of_set.chosen), 'command')}",
            _flower(design, of_set),
            f"Paths of the {plural(len(of_set.commands), 'command')} of {of_set.name}; chosen: "
            + ", ".join(
                f"{command_in_words(design.candidate(chosen.command))} {chosen.runs}x" for chosen in of_set.chosen
            ),
            _HEIGHT,
        )
        for of_set in design.sets
    )
    drawn = {trace.legendgroup for figure in figures for trace in figure.plot.data}
    return page.FigureGrid(
        figures,
        tuple(item for item in (_LEFT, _STRAIGHT, _RIGHT, _UNUSED) if item.key in drawn),
        2 if len(figures) > 1 else 1,
        "All paths start at the origin, heading along x, and end at the dot. The more often a command is driven, the "
        "wider its line (and its number stands at its end). Turns on the spot are arcs about the origin.",
        "what-to-drive",
    )


def precision_figures(design: Design) -> page.FigureGrid:
    """Standard deviations of the best runs found against their number and against the time that they take."""
    baseline = plural(design.baseline.precision.effort.runs, "run")
    figures = [
        page.Figure(
            f"All elements together, as a multiple of the baseline's ({baseline})",
            _curves(design, _RUNS, "runs", [_RELATIVE], "standard deviation / baseline's"),
            "Geometric mean of the standard deviations against the number of runs, on logarithmic scales",
        ),
        page.Figure(
            "Rows of the matrix: x solid, y dashed, heading dotted",
            _curves(design, _RUNS, "runs", _ROWS_OF_MATRIX, "% of the row's largest element"),
            "Largest standard deviation of each row's elements against the number of runs, on logarithmic scales",
        ),
    ]
    if design.baseline.precision.physical is not None:
        figures.append(
            page.Figure(
                "Wheels: radius solid, distance dashed",
                _curves(design, _RUNS, "runs", _OF_WHEELS, "% of the design value"),
                "Largest standard deviation of the wheels' radii and distances against the number of runs",
            )
        )
    return page.FigureGrid(
        tuple(figures),
        _legend(design),
        2,
        "One standard deviation of the best unbiased estimate (the Cramér-Rao bound), under the noise model below. The "
        "ring is the chosen design, the grey diamond the baseline.",
    )


def efficiency_figure(design: Design) -> page.FigureGrid:
    """Efficiency of exact designs against the number of runs; 100 % is the bound that no design exceeds."""
    traces = []
    lowest = min(step.efficiency for of_set in design.sets for step in of_set.steps)
    for of_set, item in zip(design.sets, _legend(design), strict=True):
        traces += _curve(item, of_set, _RUNS, lambda step: 100 * step.efficiency)
    most = max(of_set.steps[-1].effort.runs for of_set in design.sets)
    figure = plot(*traces, x_title="runs", y_title="efficiency (% of the bound)")
    few = min(of_set.steps[0].effort.runs for of_set in design.sets)
    logarithmic(figure, "x", few, most)
    figure.update_yaxes(range=[max(0.0, 100 * lowest - 3), 102])
    figure.add_hline(y=100, line={"color": INK, "width": 1.2})
    figure.add_hline(y=99, line={"color": QUIET, "width": 1, "dash": "dot"})
    baselines = ", ".join(f"{percent(of_set.baseline_efficiency)} of {of_set.name}'s" for of_set in design.sets)
    return page.FigureGrid(
        (
            page.Figure(
                "Information per run against the bound" if design.per == "run" else "Information for its cost",
                figure,
                "Efficiency of the exact designs against the number of runs, and the bound at 100 %",
                340,
            ),
        ),
        _legend(design),
        1,
        "Solid line: the bound of Kiefer and Wolfowitz, which no design from the set exceeds; dotted: 1 % below it. "
        f"Numbers of runs that do not share out evenly lose a little. The baseline reaches {baselines} bound.",
    )


def _curves(
    design: Design,
    across: Callable[[Precision], float],
    x_title: str,
    upwards: Sequence[_Curve],
    y_title: str,
) -> go.Figure:
    baseline = design.baseline.precision
    traces = []
    for of_set, item in zip(design.sets, _legend(design), strict=True):
        for value, dash in upwards:
            traces += _curve(item, of_set, across, value, dash)
    for value, _ in upwards:
        hover = f"baseline, {text(design.baseline.name)}: %{{y:.3g}}"
        traces.append(marks(_BASELINE, 10, [across(baseline)], [value(baseline)], hover=hover))
    figure = plot(*traces, x_title=x_title, y_title=y_title)
    if len(upwards) == 1:
        figure.add_hline(y=value(baseline), line={"color": QUIET, "width": 1, "dash": "dot"})
    shown = [step for of_set in design.sets for step in of_set.steps] + [baseline]
    logarithmic(figure, "x", min(map(across, shown)), max(map(across, shown)))
    heights = [value(step) for value, _ in upwards for step in shown]
    logarithmic(figure, "y", min(heights), max(heights))
    return figure


def _curve(
    item: page.LegendItem,
    of_set: SetDesign,
    across: Callable[[Step], float],
    upwards: Callable[[Step], float],
    dash: page.Dash = "solid",
) -> list[go.Scatter]:
    """A line through the steps of a set, with a ring around the chosen one."""
    x, y = ([value(step) for step in of_set.steps] for value in (across, upwards))
    words = [
        f"{of_set.name}, {plural(step.effort.runs, 'run')}, {step.effort.seconds:.0f} s, "
        f"{percent(step.efficiency, 2)} of the bound"
        for step in of_set.steps
    ]
    ring: dict[str, Any] = {"marker_symbol": "circle-open", "marker_line_width": 2.5}
    return [
        line(item, 2.0, x, y, hover="%{text}<br>%{y:.4g}", words=words, line_dash=dash),
        marks(item, 11, [across(of_set.step)], [upwards(of_set.step)], **ring),
    ]


def _legend(design: Design) -> tuple[page.LegendItem, ...]:
    colours = cycle(PALETTE)
    return tuple(page.LegendItem(of_set.name, of_set.name, next(colours)) for of_set in design.sets)


def _flower(design: Design, of_set: SetDesign) -> go.Figure:
    counts: Mapping[str, int] = {chosen.command: chosen.runs for chosen in of_set.chosen}
    candidates = [design.candidate(name) for name in of_set.commands]
    reaches = {each.name: max(math.hypot(x, y) for x, y, _ in each.path) for each in candidates}
    spots, reach = [name for name, farthest in reaches.items() if farthest < 0.01], max(reaches.values()) or 1.0
    traces = []
    for candidate in sorted(candidates, key=lambda command: (counts.get(command.name, 0) > 0, -_turned(command))):
        points = np.array(candidate.path)[:, :2]
        if candidate.name in spots:  # a turn on the spot is drawn as an arc about the origin of at most 330 deg
            turned = math.copysign(min(abs(_turned(candidate)), math.radians(330)), _turned(candidate))
            angles = np.linspace(0.0, turned, 60)
            radius = reach * (0.1 + 0.3 * spots.index(candidate.name) / len(spots))
            points = radius * np.column_stack([np.cos(angles), np.sin(angles)])
        traces += _path(candidate, points, counts.get(candidate.name, 0))
    return plan(*traces, marks(ORIGIN, 7, [0], [0], hover="start"))


def _path(candidate: Candidate, points: Array, runs: int) -> list[go.Scatter]:
    turned = _turned(candidate)
    width = min(2.0 + 1.2 * runs, 14.0)
    item = _LEFT if turned > 0 else _RIGHT
    if abs(turned) < _STRAIGHT_BELOW:
        item = _STRAIGHT
    hover = f"{text(command_in_words(candidate))}, {candidate.duration_s:.3g} s: "
    if not runs:
        return [line(_UNUSED, 1, *points.T, hover=hover + "not chosen")]
    hover += plural(runs, "run")
    end: dict[str, Any] = {"mode": "markers+text", "text": [f"<b>{runs}×</b>"]} if runs > 1 else {}
    end |= {"textposition": "top center" if points[-1, 1] >= 0 else "bottom center", "cliponaxis": False}
    return [
        line(item, width, *points.T, hover=hover),
        marks(item, width + 5, *points[-1:].T, hover=hover, textfont={"size": 13, "color": INK}, **end),
    ]


def _turned(candidate: Candidate) -> float:
    """The angle that a run turns by, rad; positive to the left."""
    return candidate.path[-1][2] - candidate.path[0][2]


# Designs in the table against the number of runs, beside the chosen one and the baseline. Only the table's length hangs
# on it: 6 and 15 lines in the place of 9 with half of it and with twice (tests/studies/constants_fit.py).
_ROWS = 7
_COMMAND_COLUMNS = (
    page.Column("Command", numeric=False),
    page.Column("Duration", "s"),
    page.Column("Distance", "m"),
    page.Column("Wheels roll", "m", priority=2),
)


def equal_table(design: Design) -> page.Table:
    """The smallest designs that give as much information as the baseline, set by set."""
    rows = []
    for of_set in design.sets:
        for equal in of_set.equivalents:
            effort, least = equal.effort, NOTHING if equal.least is None else least_in_words(equal.least)
            left_open = "they leave part of the matrix undetermined"
            reason = left_open if equal.least is None else "not within the repetitions allowed"
            cells: tuple[page.Cell | str, ...] = (page.Cell(NOTHING, reason), NOTHING, NOTHING)
            if effort is not None:
                distance = f"{significant(effort.metres, 3)} m"
                cells = (count(effort.runs), duration_in_words(effort.seconds), distance)
            rows.append(page.Row.of(of_set.name, USE_IN_WORDS[equal.use], *cells, least))
    effort = design.baseline.precision.effort
    return page.Table(
        f"As good as the baseline: {design.baseline.name} ({effort_in_words(effort)})",
        (
            page.Column("Candidates", numeric=False),
            page.Column("Calibrated from", numeric=False),
            page.Column("Runs"),
            page.Column("Time"),
            page.Column("Distance"),
            page.Column("Bound", UNIT_OF_COST[design.per]),
        ),
        tuple(rows),
        "The smallest design found whose det(information)^(1/p) is at least the baseline's; no design at all can do "
        "it with less than the bound in the last column. Final poses are taken as Eq. (6) does, with equal noise in m "
        "and rad; whole trajectories by every reference pose under the noise model.",
    )


def chosen_table(design: Design, of_set: SetDesign) -> page.Table:
    """The chosen commands of a set."""
    rows = (
        page.Row.of(
            *_command_cells(design.candidate(chosen.command)),
            count(chosen.runs),
            percent(of_set.optimum.shares.get(chosen.command, 0.0)),
        )
        for chosen in of_set.chosen
    )
    unit = {"run": "runs", "second": "time", "metre": "wheels' distance"}[design.per]
    return page.Table(
        f"What to drive of {of_set.name}: {effort_in_words(of_set.step.effort)}",
        (*_COMMAND_COLUMNS, page.Column("Runs"), page.Column("Continuous optimum", f"share of the {unit}", priority=1)),
        tuple(rows),
        "Other choices may be as good: turning all directions of a design by the same angle often changes nothing.",
    )


def _command_cells(candidate: Candidate) -> tuple[page.Cell, ...]:
    words = command_in_words(candidate)
    return (
        page.Cell(words, "" if candidate.name == words else candidate.name),
        page.Cell(fixed(candidate.duration_s, 2)),
        page.Cell(fixed(candidate.distance_m, 2)),
        page.Cell(fixed(candidate.rolled_m, 2)),
    )


def promise_table(design: Design) -> page.Table:
    """The precision that the chosen runs of every set promise, beside the baseline's."""
    rows = [_precision_row(of_set.name, of_set.step) for of_set in design.sets]
    baseline = _precision_row(f"baseline: {design.baseline.name}", design.baseline.precision)
    return page.Table(
        "Standard deviations that the chosen runs promise",
        _precision_columns(design, page.Column("Design", numeric=False)),
        (*rows, baseline),
        "Of each row, and of each kind of physical parameter, the largest. They fall with the root of the number of "
        "runs when a design is repeated.",
    )


def effort_table(design: Design, of_set: SetDesign) -> page.Table:
    """The precision against the number of runs: some of a set's best designs, the chosen one, and the baseline."""
    chosen = of_set.step.effort.runs
    rows = [
        _precision_row(percent(step.efficiency, 2), step, "best" if step.effort.runs == chosen else "plain")
        for step in _worth_a_row(of_set)
    ]
    baseline = _precision_row(percent(of_set.baseline_efficiency, 2), design.baseline.precision, "muted")
    return page.Table(
        f"Standard deviations against the number of runs of {of_set.name}",
        _precision_columns(design, page.Column("Of the bound")),
        (*rows, baseline),
        f"Last line: the baseline, {design.baseline.name}.",
    )


def _worth_a_row(of_set: SetDesign) -> list[Step]:
    """The chosen step and some others, spaced evenly on a logarithmic scale."""
    first, last = of_set.steps[0].effort.runs, of_set.steps[-1].effort.runs
    wanted = [first * (last / first) ** (index / (_ROWS - 1)) for index in range(_ROWS)]
    shown = {min(of_set.steps, key=lambda step: abs(step.effort.runs - runs)).effort.runs for runs in wanted}
    return [step for step in of_set.steps if step.effort.runs in shown | {of_set.step.effort.runs}]


def _precision_columns(design: Design, first: page.Column) -> tuple[page.Column, ...]:
    physical = [page.Column(*kind, priority=1) for kind in (("Radius", "%"), ("Distance", "%"), ("Angle", "°"))]
    return (
        first,
        page.Column("Runs"),
        page.Column("Time"),
        page.Column("Against the baseline"),
        *(page.Column(f"Row {number}", "% of largest") for number in (1, 2, 3)),
        *(physical if design.baseline.precision.physical is not None else ()),
    )


def _precision_row(name: str, precision: Precision, role: page.RowRole = "plain") -> page.Row:
    values = list(precision.row_percent)
    if precision.physical is not None:
        spread = precision.physical
        values += [spread.radius_percent, spread.distance_percent, spread.angle_deg]
    return page.Row.of(
        name,
        count(precision.effort.runs),
        duration_in_words(precision.effort.seconds),
        f"× {significant(precision.relative, 3)}",
        *(significant(value, 3) for value in values),
        role=role,
    )


def design_document(design: Design) -> page.Document:
    """The report as blocks."""
    blocks: list[page.Block] = []
    for of_set in design.sets:
        blocks += [
            page.Paragraph(f"{of_set.name}: {choice_in_words(design, of_set)}"),
            chosen_table(design, of_set),
            page.Paragraph(motions_in_words(of_set)),
        ]
        equal = f"{of_set.name} equals the baseline with {equal_in_words(design, of_set, design.use)}"
        blocks.append(page.Paragraph(f"{equal}, calibrated from {USE_IN_WORDS[design.use]}.", "note"))
    curves = precision_figures(design)
    left = curves.figures[1:] if len(design.sets) == 1 else curves.figures[:2]  # the first may be in the answer
    return page.Document(
        title=f"Which commands are worth driving: {design.name}",
        subtitle=design.description,
        sections=(
            _answer(design),
            page.Section("commands", "Chosen commands", tuple(blocks)),
            page.Section(
                "precision",
                "Precision against runs",
                (replace(curves, figures=left), promise_table(design), equal_table(design)),
                about="How well the matrix is known after so many runs, beside the baseline.",
                folded=True,
            ),
            page.Section(
                "efficiency",
                "Efficiency against the bound",
                (efficiency_figure(design),),
                about="How near the chosen runs are to the best that any choice could reach.",
                folded=True,
            ),
            page.Section(
                "basis",
                "What this rests on",
                _basis(design),
                about="Candidates, noise and source.",
                folded=True,
            ),
        ),
        badges=page.simulated_badge(design.simulated) if design.recorded else (_ASSUMED,),
    )


def _answer(design: Design) -> page.Section:
    """The section with the answer: what to drive, in words and as a picture of the paths."""
    tiles = []
    for of_set in design.sets:
        effort, name = of_set.equivalent(design.use).effort, f"{of_set.name}: " * (len(design.sets) > 1)
        tiles += [
            page.Fact(
                f"{name}chosen" if name else "Chosen",
                plural(of_set.step.effort.runs, "run"),
                f"{percent(of_set.step.efficiency, 2)} of the bound; {duration_in_words(of_set.step.effort.seconds)}",
            ),
            page.Fact(
                f"{name}{'equal' if name else 'Equal'} to the baseline's {baseline_runs(design)}",
                "none allowed" if effort is None else plural(effort.runs, "run"),
                "" if effort is None else f"{duration_in_words(effort.seconds)} of driving",
            ),
        ]
    plans = []
    if not design.recorded:
        title = "What to drive" + " of {}" * (len(design.sets) > 1)
        plans = [page.Callout(title.format(of_set.name), plan_in_words(design, of_set)) for of_set in design.sets]
    notes = page.Callout("Before you rely on it", design.notes)
    picture = path_figures(design)
    if len(picture.figures) == 1:  # beside the paths there is room for what they give
        both = (*picture.figures, precision_figures(design).figures[0])
        picture = replace(picture, figures=both, columns=2)
    return page.answer_section(headline(design), tiles, picture, *plans, notes)


def _basis(design: Design) -> tuple[page.Block, ...]:
    position, heading = noise_in_words(design.noise)
    facts = (
        page.Fact("Source", design.source),
        page.Fact("Candidates and noise", origin_in_words(design)),
        page.Fact("Noise of positions", position),
        page.Fact("Noise of headings", heading),
        page.Fact("Robot", design.robot),
        page.Fact("Elements determined", f"{design.parameters} of the inverse kinematic matrix"),
        page.Fact("Odometry", "exact arcs" if design.integration == "arc" else "Euler steps, Eq. (1)"),
        page.Fact("Calibrated from", USE_IN_WORDS[design.use]),
        page.Fact("Measure", f"information per {design.per}"),
        page.Fact(
            "Continuous optima",
            listing([f"{of_set.name}: within {100 * of_set.optimum.gap:.1g} % of its bound" for of_set in design.sets]),
        ),
    )
    rows = tuple(page.Row.of(*_command_cells(candidate)) for candidate in design.candidates)
    return (
        page.Facts(facts),
        page.Details(
            f"All candidates ({len(design.candidates)})",
            (page.Table(f"All {len(rows)} candidates", _COMMAND_COLUMNS, rows),),
        ),
    )
