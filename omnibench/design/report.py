"""The report of a design: what to drive, how precise it is, the baseline's equals; as words, figures and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any, Literal

import numpy as np
import plotly.graph_objects as go

from omnibench.design.candidates import Per, Use
from omnibench.design.design import Candidate, Design, Effort, Precision, SetDesign
from omnibench.report import blocks as page
from omnibench.report.figures import ORIGIN, line, marks
from omnibench.report.numbers import NOTHING, count, fixed, listing, noise_in_words, percent, significant
from omnibench.report.result import NextStep, Remark, Result
from omnibench.report.style import INK, PALETTE, QUIET, logarithmic, plan, plot, text
from omnibench.words import plural

_USES: Mapping[Use, str] = {"final": "final poses", "trajectory": "whole trajectories"}
_UNITS: Mapping[Per, str] = {"run": "runs", "second": "s", "metre": "m of wheel"}


class DesignResult(Result):
    """A design. folder: where its files are, None if nowhere."""

    def __init__(self, design: Design, folder: Path | None = None) -> None:
        self.design, self.folder = design, folder

    def sentence(self) -> str:
        """What to drive, and how near that is to the best that can be driven, a sentence for each set."""
        per = self.design.per
        return " ".join(
            f"{of_set.name}: {plural(of_set.step.effort.runs, 'run')} of {plural(len(of_set.chosen), 'command')} reach "
            f"{percent(of_set.step.efficiency, 2)} of the information per {per} that no design from these "
            f"{plural(len(of_set.commands), 'command')} exceeds."
            for of_set in self.design.sets
        )

    def opening(self) -> Sequence[Remark]:
        design, simulated = self.design, " (simulated data)" if self.design.simulated else ""
        kind = simulated if design.recorded else " (assumed)"
        first = f"{design.name}{kind}: robot {design.robot}, D-optimal per {design.per}, {_USES[design.use]}"
        return [Remark(first), Remark(f"candidates: {origin_of(design)}"), Remark(self.sentence())]

    def tables(self) -> Sequence[page.Table]:
        design = self.design
        of_sets = [(chosen_table(design, each), effort_table(design, each)) for each in design.sets]
        return [*(table for tables in of_sets for table in tables), equal_table(design)]

    def remarks(self) -> Sequence[Remark]:
        lines = list[str]()
        for of_set in self.design.sets:
            lines.append(left_open(of_set))
            if not self.design.recorded:
                lines += ["What to drive:", *(f"  {each}" for each in what_to_drive(self.design, of_set))]
        lines += [f"- {note}" for note in self.design.notes]
        lines += [] if self.folder is None else [f"report: {self.folder / 'report.html'}"]
        return list(map(Remark, lines))

    def next_step(self) -> NextStep:
        what = plural(self.design.sets[0].step.effort.runs, "run")
        drive = "drive them and make a data set of the recordings (omnibench guide data)"
        return NextStep(f"{what} tell the most of {self.design.robot}", drive)

    def document(self) -> page.Document:
        design = self.design
        tiles, plans, chosen = list[page.Fact](), list[page.Block](), list[page.Block]()
        baseline = count(design.baseline.precision.effort.runs)
        for of_set in design.sets:
            effort = of_set.step.effort
            share = f"{percent(of_set.step.efficiency, 2)} of the bound; {_duration(effort.seconds)}"
            tiles.append(page.Fact(f"{of_set.name}: chosen", plural(effort.runs, "run"), share))
            equal = next(each.effort for each in of_set.equivalents if each.use == design.use)
            runs, driven = ("none", "") if equal is None else (plural(equal.runs, "run"), _duration(equal.seconds))
            tiles.append(page.Fact(f"{of_set.name}: equal to the baseline's {baseline}", runs, driven))
            if not design.recorded:
                plans.append(page.Callout(f"What to drive of {of_set.name}", what_to_drive(design, of_set)))
            chosen += [chosen_table(design, of_set), page.Paragraph(left_open(of_set))]
        paths, curve, precision = path_figures(design), precision_figure(design), list[page.Block]()
        if len(paths.figures) == 1:  # beside the paths there is room for what they give
            paths = replace(paths, figures=(*paths.figures, *curve.figures), columns=2)
        else:
            precision.append(curve)
        answer = page.answer_section(
            self.sentence(), tiles, paths, *plans, page.Callout("Before you rely on it", design.notes)
        )
        precision += [*(effort_table(design, of_set) for of_set in design.sets), equal_table(design)]
        position, heading = noise_in_words(design.noise)
        gaps = [f"{each.name}: within {100 * each.optimum.gap:.1g} % of its bound" for each in design.sets]
        facts = {
            "Source": design.source,
            "Candidates and noise": origin_of(design),
            "Noise of positions": position,
            "Noise of headings": heading,
            "Elements determined": f"{design.parameters} of the inverse kinematic matrix",
            "Odometry": design.integration,
            "Calibrated from": _USES[design.use],
            "Continuous optima": listing(gaps),
        }
        rows = tuple(page.Row.of(*_command_cells(candidate)) for candidate in design.candidates)
        everything = page.Table(f"All {len(rows)} candidates", _COMMAND_COLUMNS, rows)
        basis = (page.Facts(tuple(page.Fact(*fact) for fact in facts.items())), everything)
        return page.Document(
            title=f"Which commands are worth driving: {design.name}",
            subtitle=design.description,
            sections=(
                answer,
                page.Section("commands", "Chosen commands", tuple(chosen)),
                page.Section("precision", "Precision", tuple(precision), folded=True),
                page.Section("basis", "What this rests on", basis, folded=True),
            ),
            badges=page.simulated_badge(design.simulated) if design.recorded else (_ASSUMED,),
        )

    def json(self) -> Design:
        return self.design


def what_to_drive(design: Design, of_set: SetDesign) -> tuple[str, ...]:
    """What to drive of a set, a line for each chosen command, with how often."""
    return tuple(f"{design.candidate(each.command).words}, {plural(each.runs, 'time')}" for each in of_set.chosen)


def left_open(of_set: SetDesign) -> str:
    """Precision of odometry that the chosen runs promise."""
    left = [
        f"{significant(each.position_mm, 2)} mm and {significant(each.heading_deg, 2)}° after {each.motion}"
        for each in of_set.step.motions
    ]
    return f"Calibrated from these runs, the matrix leaves an error of {listing(left)} (standard deviations)."


def origin_of(design: Design) -> str:
    """Origin of candidates and noise, so that nobody takes an assumption for a measurement."""
    recorded = "of simulated recordings" if design.simulated else "of recordings"
    kind = recorded if design.recorded else "as designed, nothing recorded"
    return f"commands {kind}; noise {design.noise_source}"


def _duration(seconds: float) -> str:
    """A duration of driving, in s, or in min from 120 s on."""
    return f"{significant(seconds, 3)} s" if seconds < 120 else f"{fixed(seconds / 60, 1)} min"


def _effort(effort: Effort) -> str:
    return f"{plural(effort.runs, 'run')}, {_duration(effort.seconds)}, {significant(effort.metres, 3)} m"


_CHOSEN = page.LegendItem("chosen", "chosen", PALETTE[0])
_UNUSED = page.LegendItem("unused", "candidates not chosen", "#d4d9df")
_ASSUMED = page.Badge("ASSUMED NOISE, NO RECORDINGS", "warning")
_BASELINE = page.LegendItem("", "baseline", QUIET, symbol="diamond")
_MOST_TURN = math.radians(330)  # of an arc that stands for turning on the spot: more would close it
_HEIGHT = 380  # px: the paths end within the first 900 of the page


def path_figures(design: Design) -> page.FigureGrid:
    """Paths of each set's commands; a chosen one is in colour, and the wider the more often it is driven."""
    figures = tuple(
        page.Figure(
            f"{of_set.name}: {plural(of_set.step.effort.runs, 'run')} of {plural(len(of_set.chosen), 'command')}",
            _flower(design, of_set),
            f"Paths of the {plural(len(of_set.commands), 'command')} of {of_set.name}, and which are chosen",
            _HEIGHT,
        )
        for of_set in design.sets
    )
    caption = (
        "All paths start at the origin, heading along x, and end at the dot. The more often a command is driven, the "
    )
    caption += "wider its line (and its number stands at its end). Turns on the spot are arcs about the origin."
    return page.FigureGrid(figures, (_CHOSEN, _UNUSED), 2 if len(figures) > 1 else 1, caption, "what-to-drive")


def precision_figure(design: Design) -> page.FigureGrid:
    """Standard deviations of the best runs found against their number, with a ring around the chosen ones."""
    baseline, traces, legend = design.baseline.precision.effort.runs, [], []
    for of_set, colour in zip(design.sets, cycle(PALETTE)):
        legend.append(item := page.LegendItem(of_set.name, of_set.name, colour))
        words = [
            f"{of_set.name}, {_effort(step.effort)}, {percent(step.efficiency, 2)} of the bound"
            for step in of_set.steps
        ]
        runs, relative = zip(*((step.effort.runs, step.relative) for step in of_set.steps), strict=True)
        traces.append(line(item, 2.0, runs, relative, hover="%{text}<br>%{y:.4g}", words=words))
        ring: dict[str, Any] = {"marker_symbol": "circle-open", "marker_line_width": 2.5}
        traces.append(marks(item, 11, [of_set.step.effort.runs], [of_set.step.relative], **ring))
    traces.append(marks(_BASELINE, 10, [baseline], [1.0], hover="baseline"))
    figure = plot(*traces, x_title="runs", y_title="standard deviation / baseline's")
    figure.add_hline(y=1.0, line={"color": QUIET, "width": 1, "dash": "dot"})
    for axis in ("x", "y"):
        values = [value for trace in traces for value in trace[axis]]
        logarithmic(figure, axis, min(values), max(values))
    title = f"Standard deviation of all elements together, as a multiple of the baseline's ({plural(baseline, 'run')})"
    about = "Geometric mean of the standard deviations against the number of runs, on logarithmic scales"
    caption = "One standard deviation of the best unbiased estimate (the Cramér-Rao bound). Ring: the chosen design; "
    caption += "diamond: the baseline."
    return page.FigureGrid((page.Figure(title, figure, about),), tuple(legend), 1, caption)


def _flower(design: Design, of_set: SetDesign) -> go.Figure:
    counts: Mapping[str, int] = {chosen.command: chosen.runs for chosen in of_set.chosen}
    candidates = sorted(map(design.candidate, of_set.commands), key=lambda each: (each.name in counts, -each.turned))
    reaches = {each.name: max(math.hypot(x, y) for x, y, _ in each.path) for each in candidates}
    spots, reach = [name for name, farthest in reaches.items() if farthest < 0.01], max(reaches.values()) or 1.0
    traces = []
    for candidate in candidates:
        points, runs = np.array(candidate.path)[:, :2], counts.get(candidate.name, 0)
        if candidate.name in spots:  # a turn on the spot is drawn as an arc about the origin
            angles = np.linspace(
                0.0, math.copysign(min(abs(candidate.turned), math.radians(330)), candidate.turned), 60
            )
            radius = reach * (0.1 + 0.3 * spots.index(candidate.name) / len(spots))
            points = radius * np.column_stack([np.cos(angles), np.sin(angles)])
        hover = f"{text(candidate.motion)}, {candidate.duration_s:.3g} s: {plural(runs, 'run')}"
        width = min(2.0 + 1.2 * runs, 14.0) if runs else 1.0
        traces.append(line(_CHOSEN if runs else _UNUSED, width, *points.T, hover=hover))
        if runs:
            number: dict[str, Any] = {"mode": "markers+text", "text": [f"<b>{runs}×</b>"]} if runs > 1 else {}
            number |= {"textposition": "top center" if points[-1, 1] >= 0 else "bottom center", "cliponaxis": False}
            number |= {"textfont": {"size": 13, "color": INK}}
            traces.append(marks(_CHOSEN, width + 5, *points[-1:].T, hover=hover, **number))
    return plan(*traces, marks(ORIGIN, 7, [0], [0], hover="start"))


# Designs in the table against the number of runs, beside the chosen one and the baseline. Only the table's length hangs
# on it: 6 and 15 lines in the place of 9 with half of it and with twice (tests/studies/constants_fit.py).
_ROWS = 7
_COMMAND_COLUMNS = page.columns("Command", "Duration (s)", "Distance (m)", page.Column("Wheels roll", "m", priority=2))


def equal_table(design: Design) -> page.Table:
    """The smallest designs that give as much information as the baseline, set by set."""
    rows = []
    for of_set, equal in ((each, equal) for each in design.sets for equal in each.equivalents):
        # A lower bound to a tenth, rounded down so that it stays one
        least = NOTHING if equal.least is None else fixed(math.floor(10 * equal.least) / 10, 1)
        left = "they leave part of the matrix undetermined"
        reason = left if equal.least is None else "not within the repetitions allowed"
        cells: tuple[page.Cell | str, ...] = (page.Cell(NOTHING, reason), NOTHING, NOTHING)
        if (effort := equal.effort) is not None:
            cells = (count(effort.runs), _duration(effort.seconds), f"{significant(effort.metres, 3)} m")
        rows.append(page.Row.of(of_set.name, _USES[equal.use], *cells, least))
    use, bound = page.Column("Calibrated from", numeric=False), page.Column("Bound", _UNITS[design.per])
    return page.Table(
        f"As good as the baseline: {design.baseline.name} ({_effort(design.baseline.precision.effort)})",
        page.columns("Candidates", use, "Runs", "Time", "Distance", bound),
        tuple(rows),
        "The smallest design found whose det(information)^(1/p) is at least the baseline's; no design at all can do "
        "it with less than the bound. Final poses are taken as Eq. (6) does, with equal noise in m and rad; whole "
        "trajectories by every reference pose under the noise model.",
    )


def chosen_table(design: Design, of_set: SetDesign) -> page.Table:
    """The chosen commands of a set."""
    rows = []
    for chosen in of_set.chosen:
        share = percent(of_set.optimum.shares.get(chosen.command, 0.0))
        rows.append(page.Row.of(*_command_cells(design.candidate(chosen.command)), count(chosen.runs), share))
    return page.Table(
        f"What to drive of {of_set.name}: {_effort(of_set.step.effort)}",
        (*_COMMAND_COLUMNS, page.Column("Runs"), page.Column("Continuous optimum", "share", priority=1)),
        tuple(rows),
        "Other choices may be as good: turning all directions of a design by the same angle often changes nothing.",
    )


def _command_cells(candidate: Candidate) -> tuple[page.Cell, ...]:
    lengths = (candidate.duration_s, candidate.distance_m, candidate.rolled_m)
    note = "" if candidate.name == candidate.motion else candidate.name
    return page.Cell(candidate.motion, note), *(page.Cell(fixed(each, 2)) for each in lengths)


def effort_table(design: Design, of_set: SetDesign) -> page.Table:
    """The precision against the number of runs: some of a set's best designs, the chosen one, and the baseline."""
    first, last, chosen = of_set.steps[0].effort.runs, of_set.steps[-1].effort.runs, of_set.step.effort.runs
    wanted = [first * (last / first) ** (index / (_ROWS - 1)) for index in range(_ROWS)]
    shown = {min(of_set.steps, key=lambda step: abs(step.effort.runs - runs)).effort.runs for runs in wanted}
    steps = [step for step in of_set.steps if step.effort.runs in shown | {chosen}]
    rows = [_precision_row(step.efficiency, step, step.effort.runs == chosen and "best") for step in steps]
    rows.append(_precision_row(of_set.baseline_efficiency, design.baseline.precision, "muted"))
    physical = [page.Column(*kind, priority=1) for kind in (("Radius", "%"), ("Distance", "%"), ("Angle", "°"))]
    of_rows = (f"Row {number} (% of largest)" for number in (1, 2, 3))
    columns = page.columns(page.Column("Of the bound"), "Runs", "Time", "Against the baseline", *of_rows)
    return page.Table(
        f"Standard deviations against the number of runs of {of_set.name}",
        (*columns, *(physical if design.baseline.precision.physical is not None else ())),
        tuple(rows),
        f"Last line: the baseline, {design.baseline.name}. Of each row, and of each kind of parameter, the largest.",
    )


def _precision_row(efficiency: float, precision: Precision, role: page.RowRole | Literal[False]) -> page.Row:
    spread, runs = precision.physical, precision.effort.runs
    values = [*precision.row_percent, *(() if spread is None else spread.model_dump().values())]
    numbers = (f"× {significant(precision.relative, 3)}", *(significant(value, 3) for value in values))
    cells = (percent(efficiency, 2), count(runs), _duration(precision.effort.seconds), *numbers)
    return page.Row.of(*cells, role=role or "plain")
