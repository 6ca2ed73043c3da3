"""An inspection and a check as they are shown: motions driven, what can be identified, findings with what to type."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from omnibench.check.check import CheckReport
from omnibench.check.motions import SHARE, motion_kinds, turning
from omnibench.data.clock_matching import ClockMatch
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.finding import CLOCKS
from omnibench.fit.identifiability import ROWS, UNTOLD
from omnibench.fit.inspect import Inspection
from omnibench.report import blocks as page
from omnibench.report.figures import line, marks
from omnibench.report.numbers import NOTHING, count, fixed, listing, percent, significant, typeset, with_unit
from omnibench.report.recording.recording_figures import evenly
from omnibench.report.recording.section import about_table, contents_table, path_overview, pictures
from omnibench.report.result import NextStep, Remark, Result
from omnibench.report.style import PALETTE, REFERENCE, plot
from omnibench.robot.kinematics import Array, Robot
from omnibench.words import kind_of_data, plural


class InspectionResult(Result):
    """An inspection of a data set. sources: its folders, as they were typed."""

    def __init__(self, inspection: Inspection, dataset: Dataset | None = None, sources: Sequence[Path] = ()) -> None:
        self.inspection, self.dataset, self.sources = inspection, dataset, sources
        self.warnings = inspection.warnings

    def next_step(self) -> NextStep:
        directions = self.inspection.identifiability.directions
        named = self.sources[0] if len(self.sources) == 1 else self.inspection.dataset
        if missing := [each.motion for each in directions if each.state != "driven" and each.motion]:
            what = f"{named} hardly tells {' or '.join(missing)}"
            return NextStep(what, "read what to drive", ("omnibench", "guide", "driving"))
        told = f"{named} determines {'most' if self.inspection.identifiability.sentences else 'all'} of the matrix"
        command = ("omnibench", "calibrate", *self.sources, "-o", "calibration.yaml")
        return NextStep(told, "calibrate it", command)

    def tables(self) -> Sequence[page.Table]:
        return [recorded_table(self.inspection), split_table(self.inspection), identifiability_table(self.inspection)]

    def remarks(self) -> Sequence[Remark]:
        found = self.inspection
        driven, shares = f"{found.driven_directions} of {len(found.driven_shares)}", found.driven_shares
        lines = [f"directions of {driven_by(found)} driven: {driven} ({', '.join(f'{share:.2g}' for share in shares)})"]
        lines += [f"noise: {found.identifiability.noise_source}", *(f"- {each}" for each in found.findings)]
        return [Remark(text) for text in lines]

    def document(self) -> page.Document:
        assert self.dataset is not None
        return inspection_document(self.dataset, self.inspection)

    def json(self) -> Inspection:
        return self.inspection


class CheckResult(Result):
    """A check of a recording. next_command: the command line for a recording that is ready."""

    def __init__(self, checked: CheckReport, dataset: Dataset, next_command: str) -> None:
        self.checked, self.dataset, self.next_command = checked, dataset, next_command

    def next_step(self) -> NextStep:
        checked, typed = self.checked, shlex.split(self.checked.command or self.next_command)
        if checked.verdict == "ready":
            then = "mend what it warns of" if checked.command else f"{typed[1]} it"
            return NextStep("nothing stands in the way", then, tuple(typed))
        if checked.command:
            return NextStep("what can be mended is mended by one import", "type", tuple(typed))
        if checked.verdict == "record more":
            return NextStep("nothing of this can be typed", "record what is missing, and check again")
        return NextStep("no option mends this", "correct what is named above, and check again")

    def opening(self) -> Sequence[Remark]:
        return [Remark(f"{self.checked.verdict.upper()}: {self.checked.sentence}.", _TONES[self.checked.verdict])]

    def remarks(self) -> Sequence[Remark]:
        checked, lines = self.checked, list[Remark]()
        for finding in checked.findings:
            lines.append(Remark(f"{finding.severity}: {finding.what} [{finding.where}]", _TONES[finding.severity]))
            if finding.fix:
                lines.append(Remark(f"  --set {finding.fix}" if finding.changes else f"  {finding.fix}"))
        needed = {True: "a calibration is needed: ", False: "a calibration is hardly needed: ", None: ""}
        return [*lines, *([Remark(f"{needed[checked.needed]}{checked.gain}")] if checked.gain else [])]

    def document(self) -> page.Document:
        return check_document(self.dataset, self.checked)

    def json(self) -> dict[str, Any]:
        return self.checked.model_dump(mode="json", include={"verdict", "needed", "findings", "command"})


_TONES: dict[str, page.Tone] = {
    "ready": "good", "fix": "bad", "record more": "warning", "error": "bad", "warning": "warning", "note": "plain",
}  # fmt: skip


def driven_by(inspection: Inspection) -> str:
    """What the columns of the matrix are: wheel rates, or drive signals."""
    return "wheel rates" if len(inspection.driven_shares) == len(inspection.wheels) else "drive signals"


def recorded_table(inspection: Inspection) -> page.Table:
    """Robot, samples, references and scans of a data set, with their intervals."""

    def milliseconds(period: float | None) -> str:
        return NOTHING if period is None else f"{1000 * period:.3g} ms"

    shortest, longest = inspection.sample_period_range_s
    every = f"{milliseconds(inspection.sample_period_s)} ({milliseconds(shortest)} to {milliseconds(longest)})"
    rows = [page.Row.of("wheel samples", count(inspection.wheel_samples), every, ", ".join(inspection.wheels))]
    if inspection.pose_period_s is not None:
        poses = count(inspection.reference_poses)
        rows.append(page.Row.of("reference poses", poses, milliseconds(inspection.pose_period_s), ""))
    rows += [page.Row.of(f"references: {kind}", count(n), NOTHING, "") for kind, n in inspection.references.items()]
    if (scans := inspection.scans) is not None:
        view = (
            f"{count(scans.rays)} rays over {math.degrees(scans.field_of_view_rad):.0f}° up to {scans.range_max_m:g} m"
        )
        seen = f"{view}, {scans.seen_share:.0%} measured; in {plural(scans.trajectories, 'run')}"
        rows.append(page.Row.of("scans", count(scans.scans), milliseconds(scans.scan_period_s), seen))
    columns = (
        page.Column(f"robot {inspection.robot}", numeric=False),
        page.Column("number"),
        page.Column("every"),
        page.Column("", numeric=False),
    )
    named = {"": inspection.description, "source: ": inspection.source, "licence: ": inspection.licence}
    note = "; ".join(f"{name}{text}" for name, text in named.items() if text)
    return page.Table(f"{inspection.dataset}: {kind_of_data(inspection.simulated)}", columns, tuple(rows), note)


def split_table(inspection: Inspection) -> page.Table:
    """The content of each split: runs, commands, repetitions, sessions, time, distance, turns."""
    rows = []
    for name, split in inspection.splits.items():
        repetitions = f"{split.repetitions_min}"
        if split.repetitions_max != split.repetitions_min:
            repetitions += f" to {split.repetitions_max}"
        counts = (str(split.trajectories), str(split.commands), repetitions, str(split.sessions))
        amounts = (f"{split.duration_s:.0f}", f"{split.distance_m:.1f}", f"{math.degrees(split.turned_rad):.0f}")
        rows.append(page.Row.of(name, *counts, *amounts))
    columns = (
        page.Column("split", numeric=False),
        page.Column("runs"),
        page.Column("commands"),
        page.Column("repetitions", priority=1),
        page.Column("sessions"),
        *(page.Column(*quantity) for quantity in (("duration", "s"), ("distance", "m"), ("turned", "°"))),
    )
    return page.Table("", columns, tuple(rows))


def identifiability_table(inspection: Inspection) -> page.Table:
    """The precision of a calibration along each direction of wheel rates."""
    what, identifiability = driven_by(inspection), inspection.identifiability
    rows = []
    for direction in identifiability.directions:
        deviations = ["open"] * len(ROWS)
        if direction.state == "driven" and direction.deviations is not None:
            deviations = ["open" if value > UNTOLD else f"{100 * value:.2g} %" for value in direction.deviations]
        motion = direction.motion or "slip of the wheels"
        rows.append(page.Row.of(direction.direction, motion, f"{100 * direction.share:.3g} %", *deviations))
    columns = (
        page.Column(f"{what} along", numeric=False),
        page.Column("motion", numeric=False),
        page.Column("driven"),
        *(page.Column(f"row {row}") for row in ROWS),
    )
    caption = "Precision of a calibration from these data, ± % of the row's largest element"
    return page.Table(caption, columns, tuple(rows))


def parameter_table(inspection: Inspection) -> page.Table:
    """How precisely the runs tell each physical parameter."""
    rows = []
    for parameter in inspection.identifiability.parameters:
        factor, unit, digits = (math.degrees(1.0), "°", 2) if parameter.unit == "rad" else (1e3, "mm", 1)
        kind, _, wheel = parameter.name.partition("_")
        known = (
            NOTHING
            if parameter.deviation is None
            else f"± {with_unit(significant(factor * parameter.deviation, 2), unit)}"
        )
        design = with_unit(fixed(factor * parameter.design, digits), unit)
        known_now = "determined" if parameter.told else "not determined"
        rows.append(page.Row.of(f"{kind} of {wheel}" if wheel else kind, design, known, known_now))
    columns = (
        page.Column("Parameter", numeric=False),
        page.Column("Design"),
        page.Column("Could be known to"),
        page.Column("By these runs", numeric=False),
    )
    note = "One standard deviation of the best that any calibration from these runs could do (the Cramér-Rao bound)."
    return page.Table("Wheels, as these runs determine them", columns, tuple(rows), note)


_BLOCK = 0.5  # s: motions are means over so long, which smooths encoder ticks (chosen)
_RESTS = 0.05  # share of the fastest motion below which the robot stands (chosen)
_DRAWN = 2500  # dots of a figure
_LEFT = page.LegendItem("left", "turning left", PALETTE[0])
_STRAIGHT_ON = page.LegendItem("straight", "straight", "#5b6772")
_RIGHT = page.LegendItem("right", "turning right", PALETTE[1])


@dataclass(frozen=True, eq=False)
class DrivenMotion:
    """One kind of motion: its share of the time in motion, and its twists (n, 3) in m/s, m/s, rad/s."""

    name: str
    share: float
    twists: Array

    @property
    def driven(self) -> bool:
        """True if it was driven for longer than by chance."""
        return self.share >= SHARE


def driven_motions(runs: Sequence[Trajectory], robot: Robot) -> list[DrivenMotion]:
    """Every kind of motion that the robot can drive, by the design values, with what was driven of it."""
    twists, seconds = _twists(runs, robot)
    total = float(seconds.sum()) or 1.0
    return [
        DrivenMotion(name, float(seconds[chosen].sum()) / total, twists[chosen])
        for name, chosen in motion_kinds(twists, robot).items()
    ]


def missing_in_words(motions: Sequence[DrivenMotion]) -> str:
    """The motions that were not driven, in words; empty where none is missing."""
    names = [motion.name.replace("curves to", "in curves to") for motion in motions if not motion.driven]
    for both in ("on the spot", "sideways"):
        if {f"{both} to the left", f"{both} to the right"} <= set(names):
            names[names.index(f"{both} to the left")] = both
            names.remove(f"{both} to the right")
    return listing(names, last="or")


def _twists(runs: Sequence[Trajectory], robot: Robot) -> tuple[Array, Array]:
    """Mean twists (n, 3) of blocks in motion, by the design values, and the blocks' durations (n,), s."""
    means, durations = [np.empty((0, 3))], [np.empty(0)]
    for run in runs:
        steps = np.diff(run.times, prepend=0.0)
        starts = np.flatnonzero(np.diff(run.times // _BLOCK, prepend=-1.0))
        lengths = np.add.reduceat(steps, starts)
        moved = np.add.reduceat(run.signals @ robot.inverse_kinematic_matrix.T * steps[:, None], starts)
        means.append(moved / lengths[:, None])
        durations.append(lengths)
    twists, seconds = np.concatenate(means), np.concatenate(durations)
    size = np.hypot(twists[:, 0], twists[:, 1]) + robot.reach * np.abs(twists[:, 2])
    moving = size > _RESTS * float(size.max(initial=0.0))
    return twists[moving], seconds[moving]


def motion_table(motions: Sequence[DrivenMotion]) -> page.Table:
    """How long each motion was driven, at which speeds and rates of turn."""
    rows = []
    for motion in motions:
        if not motion.driven:
            rows.append(page.Row.of(motion.name, page.Cell("not driven"), NOTHING, NOTHING, role="failed"))
            continue
        speeds = np.hypot(motion.twists[:, 0], motion.twists[:, 1])
        rates = np.degrees(np.abs(motion.twists[:, 2]))
        rows.append(page.Row.of(motion.name, percent(motion.share, 0), _range(speeds, 2), _range(rates, 0)))
    return page.Table(
        "Motions driven",
        (
            page.Column("Motion", numeric=False),
            page.Column("Share of the time in motion"),
            page.Column("Speed", "m/s"),
            page.Column("Rate of turn", "°/s"),
        ),
        tuple(rows),
        "By the design values, as means over 0.5 s; ranges hold nine tenths. A motion counts as straight or curved and "
        "as forward, backward or sideways (within 30°), so that shares add up to more than 100 %.",
    )


def _range(values: Array, decimals: int) -> str:
    low, high = np.quantile(values, [0.05, 0.95])
    least = 10.0 ** -(decimals + 1)  # less is rounding, and is shown as 0
    low, high = (value if value >= least else 0.0 for value in (low, high))
    shown = [fixed(value, decimals) if value > 10.0**-decimals else significant(value, 1) for value in (low, high)]
    return shown[0] if shown[0] == shown[1] else f"{shown[0]} to {shown[1]}"


def motion_figures(runs: Sequence[Trajectory], robot: Robot) -> tuple[list[page.Figure], tuple[page.LegendItem, ...]]:
    """Speeds against rates of turn, a dot for every half second; with sideways motion also velocities from above."""
    twists, _ = _twists(runs, robot)
    twists = twists[evenly(len(twists), _DRAWN)] if len(twists) else twists
    kinds = motion_kinds(twists, robot)
    left, right = turning(kinds, "left"), turning(kinds, "right")
    groups = [each for each in ((_LEFT, left), (_STRAIGHT_ON, ~left & ~right), (_RIGHT, right)) if each[1].any()]
    beside, above = [], []
    for item, chosen in groups:
        ahead, aside, rate = twists[chosen].T
        velocity = f"{item.label}<br>%{{y:.2f}} m/s ahead, %{{x:.2f}} m/s to the left"
        above.append(marks(item, 5, aside, ahead, hover=velocity, marker_opacity=0.6))
        speeds = np.hypot(ahead, aside)
        beside.append(marks(item, 5, np.degrees(rate), speeds, hover="%{x:.0f}°/s, %{y:.2f} m/s", marker_opacity=0.6))
    rates = plot(*beside, x_title="rate of turn, to the left (°/s)", y_title="speed (m/s)")
    rates.update_xaxes(autorange="reversed").update_yaxes(rangemode="tozero")
    title = "Speeds and rates of turn, a dot for every half second"
    figures = [page.Figure(title, rates, "Speed in m/s against the rate of turn in °/s", 340)]
    if any(name.startswith("sideways") for name in kinds):
        seen = plot(*above, x_title="to the left (m/s)", y_title="ahead (m/s)")
        seen.update_layout(xaxis={"autorange": "reversed", "scaleanchor": "y"}, yaxis={"scaleratio": 1})
        title = "Velocities, seen from above"
        figures.append(page.Figure(title, seen, "Velocity ahead against velocity to the left, m/s", 340))
    return figures, tuple(item for item, _ in groups)


def inspection_document(dataset: Dataset, inspection: Inspection) -> page.Document:
    """The report as blocks. DataError in one line: scans that cannot be read."""
    training = dataset.split("train") or dataset.trajectories
    motions = driven_motions(training, dataset.robot)
    identified = inspection.identifiability
    figures, items = motion_figures(training, dataset.robot)
    picture = path_overview(dataset)
    if len(picture.figures) == 1:  # beside the paths there is room for the speeds
        both, words = (*picture.figures, figures.pop(0)), f"{picture.caption} Speeds by the design values."
        picture = page.FigureGrid(both, (*picture.legend, *items), 2, words, picture.name)
    return page.Document(
        title=f"What is in {dataset.name}",
        subtitle=dataset.description,
        sections=(
            _answer(inspection, motions, picture),
            page.Section(
                "motions",
                "Motions driven",
                (*((page.FigureGrid(tuple(figures), items),) if figures else ()), motion_table(motions)),
                about="By the training runs, from which a calibration is fitted.",
            ),
            page.Section(
                "identified",
                "What can be identified",
                (
                    *((parameter_table(inspection),) if identified.parameters else ()),
                    identifiability_table(inspection),
                    page.Paragraph(f"Noise: {identified.noise_source}.", "note"),
                ),
                about="What a calibration from these runs could know, and what it could not.",
            ),
            *pictures(dataset),
            page.Section(
                "recorded",
                "What was recorded",
                (split_table(inspection), contents_table(dataset), about_table(dataset)),
                about="Quantities, numbers, intervals, and where the recordings come from.",
            ),
        ),
        badges=page.simulated_badge(dataset.simulated),
    )


def _answer(inspection: Inspection, motions: list[DrivenMotion], picture: page.FigureGrid) -> page.Section:
    splits, open_ones = inspection.splits, inspection.identifiability.sentences
    missing = missing_in_words(motions)
    lacks = f"Not driven to train: {missing}." if missing else "Every kind of motion was driven to train."
    told = "Part of the matrix stays open." if open_ones else "The runs determine all of the matrix."
    metres, seconds = (sum(getattr(each, name) for each in splits.values()) for name in ("distance_m", "duration_s"))
    parts = ", ".join(f"{of_split.trajectories:,} {name}" for name, of_split in splits.items())
    kinds = ", ".join(f"{number} of {kind}" for kind, number in inspection.references.items())
    poses = page.Fact("References", count(sum(inspection.references.values())), kinds)
    if inspection.pose_period_s is not None:
        every, beside = f"every {significant(1e3 * inspection.pose_period_s)} ms", f"; {kinds}" if kinds else ""
        poses = page.Fact("Reference poses", every, f"{count(inspection.reference_poses)}{beside}")
    tiles = (
        page.Fact("Runs", count(inspection.trajectories), parts),
        page.Fact("Driven", f"{significant(metres, 3)} m", f"in {fixed(seconds / 60, 1)} min"),
        page.Fact(
            "Wheel samples",
            f"every {significant(1e3 * inspection.sample_period_s)} ms",
            count(inspection.wheel_samples),
        ),
        poses,
    )
    return page.answer_section(
        f"{plural(inspection.trajectories, 'run')} of {inspection.robot}. {lacks} {told}",
        tiles,
        picture,
        page.Callout("Findings", inspection.findings, "warning" if open_ones else "plain"),
        page.Callout("Warnings on reading the data", inspection.warnings, "warning"),
    )


_WHEELS = page.LegendItem("wheels", "by the wheels, at the design", PALETTE[0])
_REFERENCE = page.LegendItem("reference", "by the reference", REFERENCE)
_SMOOTH = 0.3  # s over which rates of turn are taken, so that the reference's noise does not hide them; chosen
_SHOWN = 12.0  # s that are drawn, where matching shows best; chosen
_LOOKED_AT = 8  # runs whose clocks are farthest off, of which the one is drawn that shows it best; chosen


def check_document(dataset: Dataset, checked: CheckReport) -> page.Document:
    """The report on a data set as blocks."""
    runs = [run for run in dataset.trajectories if run.has_poses]
    clocks_are_off = any(finding.kind in CLOCKS for finding in checked.findings)
    picture = _clock_picture(dataset.robot, runs, checked.clocks) if clocks_are_off else None
    tiles = [
        page.Fact(f"{severity.capitalize()}s", str(sum(each.severity == severity for each in checked.findings)))
        for severity in ("error", "warning", "note")
    ]
    tiles.append(page.Fact("Runs", str(len(dataset.trajectories))))
    columns = tuple(page.Column(name, numeric=False) for name in ("", "finding", "where", "what to type or do"))
    rows = tuple(
        page.Row.of(
            each.severity, each.what, each.where, f"--set {each.fix}" if each.changes and each.fix else each.fix
        )
        for each in checked.findings
    )
    gain = f"What a calibration would gain on runs that it was not fitted to, each in turn; {typeset(checked.gain)}."
    answer = page.answer_section(
        f"{checked.sentence}.",
        tiles,
        picture or path_overview(dataset),
        *([page.Table("Findings, each with what to type", columns, rows)] if rows else []),
        *([page.Code(checked.command, "One import mends what options mend")] if checked.command else []),
        *([page.Paragraph(gain, "note")] if checked.gain else []),
        title="Verdict",
    )
    badges = page.simulated_badge(dataset.simulated)
    return page.Document(f"Check: {dataset.name}", dataset.description, (answer,), badges)


def _clock_picture(
    robot: Robot, runs: Sequence[Trajectory], clocks: Sequence[ClockMatch | None]
) -> page.FigureGrid | None:
    """Rates of turn by wheels and reference in the run whose clock is farthest off, before and after matching."""
    known = [(run, clock) for run, clock in zip(runs, clocks, strict=True) if clock is not None]
    if not known:
        return None
    off_at_ends = [max(abs(clock.offset), abs(clock.offset + clock.drift * clock.length)) for _, clock in known]
    farthest = [known[index] for index in np.argsort(-np.array(off_at_ends), kind="stable")[:_LOOKED_AT]]
    views = [(*_view(robot, run, clock), run, clock) for run, clock in farthest]
    _, begin, run, clock = max(views, key=lambda view: view[0])
    span = begin, min(begin + _SHOWN, float(run.times[-1]))
    off = clock.offset + clock.drift * begin
    figures = (
        _rates(robot, run, run.pose_times, span, f"As recorded: {fixed(abs(off), 2)} s apart"),
        _rates(robot, run, clock.corrected(run.pose_times), span, "With matched stamps"),
    )
    values = [value for figure in figures for trace in figure.plot.data for value in trace.y]
    margin = 0.05 * (max(values) - min(values))
    for figure in figures:
        figure.plot.update_yaxes(range=[min(values) - margin, max(values) + margin])
    caption = f"Rate of turn in run {run.id}, whose stamps are among those that differ most."
    return page.FigureGrid(figures, (_WHEELS, _REFERENCE), caption=caption, name="clocks")


def _view(robot: Robot, run: Trajectory, clock: ClockMatch) -> tuple[float, float]:
    """How much matching brings the rates of turn together in the part that shows it best, and that part's begin, s."""
    moments = np.arange(0.0, run.times[-1], _SMOOTH)
    edges, turns = _turned(robot, run)
    wheels = _slopes(moments, edges, turns)
    before, after = (
        (_slopes(moments, stamps, run.poses[:, 2]) - wheels) ** 2
        for stamps in (run.pose_times, clock.corrected(run.pose_times))
    )
    gained = np.append(0.0, np.cumsum(before - after))
    length = max(1, min(round(_SHOWN / _SMOOTH), len(moments)))
    parts = gained[length:] - gained[:-length]
    best = int(parts.argmax())
    return float(parts[best]), float(moments[best])


def _turned(robot: Robot, run: Trajectory) -> tuple[Array, Array]:
    """Times (F + 1,), s, and the angles that the wheels turn the robot by until then, rad."""
    edges = np.append(0.0, run.times)
    return edges, np.append(0.0, np.cumsum((run.signals @ robot.inverse_kinematic_matrix[2]) * np.diff(edges)))


def _rates(robot: Robot, run: Trajectory, stamps: Array, span: tuple[float, float], title: str) -> page.Figure:
    edges, turns = _turned(robot, run)
    moments = np.arange(span[0], span[1], _SMOOTH / 3)
    traces = [
        line(item, 1.8, moments, _slopes(moments, *turned), hover=f"{item.label}<br>%{{y:.2f}} rad/s at %{{x:.2f}} s")
        for item, turned in ((_WHEELS, (edges, turns)), (_REFERENCE, (stamps, run.poses[:, 2])))
    ]
    figure = plot(*traces, x_title="time by the wheels' clock (s)", y_title="rate of turn (rad/s)")
    return page.Figure(title, figure, "Rate of turn over time, by the wheels and by the reference", 300)


def _slopes(moments: Array, times: Array, headings: Array) -> Array:
    half = _SMOOTH / 2
    slopes: Array = (np.interp(moments + half, times, headings) - np.interp(moments - half, times, headings)) / _SMOOTH
    return slopes
