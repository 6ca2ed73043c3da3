"""The report of an inspection: paths, motions driven, what can be identified, wheel rates, and runs step by step.

Its tables are the terminal's, too. And the report of a check: the verdict, matched clocks in a picture, every finding
with what to type.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

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
from omnibench.report.style import INK, PALETTE, REFERENCE, plot
from omnibench.robot.kinematics import Array, Robot
from omnibench.words import plural


def driven_by(inspection: Inspection) -> str:
    """What the columns of the matrix are: wheel rates, or drive signals."""
    return "wheel rates" if len(inspection.driven_shares) == len(inspection.wheels) else "drive signals"


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


def motion_figures(runs: Sequence[Trajectory], robot: Robot) -> page.FigureGrid:
    """Velocities seen from above, and speeds against rates of turn, a dot for every half second."""
    twists, _ = _twists(runs, robot)
    twists = twists[evenly(len(twists), _DRAWN)] if len(twists) else twists
    kinds = motion_kinds(twists, robot)
    left, right = turning(kinds, "left"), turning(kinds, "right")
    of_kinds = ((_LEFT, left), (_STRAIGHT_ON, ~left & ~right), (_RIGHT, right))
    groups = [(item, chosen) for item, chosen in of_kinds if chosen.any()]
    above, beside = [], []
    for item, chosen in groups:
        ahead, aside, rate = twists[chosen].T
        words = f"{item.label}<br>%{{y:.2f}} m/s ahead, %{{x:.2f}} m/s to the left"
        above.append(marks(item, 5, aside, ahead, hover=words, marker_opacity=0.6))
        speeds, degrees = np.hypot(ahead, aside), np.degrees(rate)
        beside.append(marks(item, 5, degrees, speeds, hover="%{x:.0f}°/s, %{y:.2f} m/s", marker_opacity=0.6))
    middle = marks(page.LegendItem("", "", INK, symbol="cross-thin-open"), 10, [0.0], [0.0])
    velocity = plot(*above, middle, x_title="to the left (m/s)", y_title="ahead (m/s)")
    reach = 1.1 * max(float(np.abs(twists[:, :2]).max(initial=0.0)), 0.01)
    velocity.update_layout(
        xaxis={"range": [reach, -reach], "scaleanchor": "y"}, yaxis={"range": [-reach, reach], "scaleratio": 1}
    )
    rates = plot(*beside, x_title="rate of turn, to the left (°/s)", y_title="speed (m/s)")
    rates.update_xaxes(autorange="reversed")
    rates.update_yaxes(rangemode="tozero")
    return page.FigureGrid(
        (
            page.Figure(
                "Velocities, seen from above", velocity, "Velocity ahead against velocity to the left, m/s", 360
            ),
            page.Figure(
                "Speeds and rates of turn", rates, "Speed in m/s against the rate of turn in degrees a second", 360
            ),
        ),
        tuple(item for item, _ in groups),
        2,
        "A dot is half a second, by the design values.",
        "motions-driven",
    )


def inspection_document(dataset: Dataset, inspection: Inspection) -> page.Document:
    """The report as blocks. DataError in one line: scans that cannot be read."""
    training = dataset.split("train") or dataset.trajectories
    motions = driven_motions(training, dataset.robot)
    identified = inspection.identifiability
    return page.Document(
        title=f"What is in {dataset.name}",
        subtitle=dataset.description,
        sections=(
            _answer(dataset, inspection, motions),
            page.Section(
                "motions",
                "Motions driven",
                (motion_figures(training, dataset.robot), motion_table(motions)),
                about="By the training runs, from which a calibration is fitted.",
            ),
            page.Section(
                "identified",
                "What can be identified",
                (
                    *map(page.Paragraph, _identified_in_words(inspection)),
                    identifiability_table(inspection),
                    *((parameter_table(inspection),) if identified.parameters else ()),
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
                folded=True,
            ),
        ),
        badges=page.simulated_badge(dataset.simulated),
    )


def _answer(dataset: Dataset, inspection: Inspection, motions: list[DrivenMotion]) -> page.Section:
    splits = inspection.splits
    names = {"train": "to train", "validation": "held out"}
    parts = " and ".join(f"{of_split.trajectories:,} {names[name]}" for name, of_split in splits.items())
    missing = missing_in_words(motions)
    lacks = f"To train, it was never driven {missing}." if missing else "Every kind of motion was driven to train."
    open_ones = inspection.identifiability.sentences
    told = "Part of the matrix stays open: see below." if open_ones else "The runs determine all of the matrix."
    sentence = f"{plural(inspection.trajectories, 'run')} of {inspection.robot} ({parts}). {lacks} {told}"
    seconds = sum(of_split.duration_s for of_split in splits.values())
    metres = sum(of_split.distance_m for of_split in splits.values())
    tiles = (
        page.Fact("Runs", count(inspection.trajectories), parts),
        page.Fact("Driven", f"{significant(metres, 3)} m", f"in {fixed(seconds / 60, 1)} min"),
        page.Fact(
            "Wheel samples",
            f"every {significant(1e3 * inspection.sample_period_s)} ms",
            count(inspection.wheel_samples),
        ),
        _reference_tile(inspection),
    )
    return page.answer_section(
        sentence,
        tiles,
        path_overview(dataset),
        page.Callout("Findings", inspection.findings, "warning" if open_ones else "plain"),
        page.Callout("Warnings on reading the data", inspection.warnings, "warning"),
    )


def _reference_tile(inspection: Inspection) -> page.Fact:
    """The reference poses or, where there are none, how many references of which kinds there are."""
    kinds = ", ".join(f"{number} of {kind}" for kind, number in inspection.references.items())
    if inspection.pose_period_s is None:
        return page.Fact("References", count(sum(inspection.references.values())), kinds)
    every = f"every {significant(1e3 * inspection.pose_period_s)} ms"
    beside = f"; beside them {kinds}" if kinds else ""
    return page.Fact("Reference poses", every, f"{count(inspection.reference_poses)}{beside}")


def _identified_in_words(inspection: Inspection) -> list[str]:
    """What the runs determine and what they do not, a sentence each."""
    driven = [each for each in inspection.identifiability.directions if each.state == "driven" and each.motion]
    words = []
    for title, wanted in (("Determined", False), ("Determined in part", True)):
        some = [each for each in driven if wanted == any(value > UNTOLD for value in each.deviations or ())]
        motions = list(dict.fromkeys(each.motion.removesuffix(" on the spot") for each in some))
        words += [f"{title}: the columns of the matrix that belong to {listing(motions)}."] if some else []
    return [*words, *(f"{sentence[:1].upper()}{sentence[1:]}." for sentence in inspection.identifiability.sentences)]


_WHEELS = page.LegendItem("wheels", "by the wheels, at the design", PALETTE[0])
_REFERENCE = page.LegendItem("reference", "by the reference", REFERENCE)
_SMOOTH = 0.3  # s over which rates of turn are taken, so that the reference's noise does not hide them; chosen
_SHOWN = 12.0  # s that are drawn, where matching shows best; chosen
_LOOKED_AT = 8  # runs whose clocks are farthest off, of which the one is drawn that shows it best; chosen
_WORDS = {"error": "Errors", "warning": "Warnings", "note": "Notes"}


def check_document(dataset: Dataset, checked: CheckReport) -> page.Document:
    """The report on a data set as blocks."""
    runs = [run for run in dataset.trajectories if run.has_poses]
    clocks_are_off = any(finding.kind in CLOCKS for finding in checked.findings)
    picture = _clock_picture(dataset.robot, runs, checked.clocks) if clocks_are_off else None
    counts = {severity: sum(each.severity == severity for each in checked.findings) for severity in _WORDS}
    tiles = [page.Fact(_WORDS[severity], str(count)) for severity, count in counts.items()]
    tiles.append(page.Fact("Runs", str(len(dataset.trajectories))))
    gain = f"What a calibration would gain on runs that it was not fitted to, each in turn; {typeset(checked.gain)}."
    sections = [
        page.answer_section(
            f"{checked.sentence}.",
            tiles,
            picture or path_overview(dataset),
            *([page.Paragraph(gain, "note")] if checked.gain else []),
            title="Verdict",
        ),
        page.Section("findings", "Findings, each with what to type", tuple(_blocks(checked))),
    ]
    return page.Document(
        title=f"Check: {dataset.name}",
        subtitle=dataset.description,
        sections=tuple(sections),
        badges=page.simulated_badge(dataset.simulated),
    )


def _blocks(checked: CheckReport) -> list[page.Block]:
    if not checked.findings:
        return [page.Paragraph("Nothing was found that spoils a calibration.")]
    blocks: list[page.Block] = []
    for finding in checked.findings:
        end = "" if finding.what.endswith("?") else "."
        blocks.append(page.Paragraph(f"{finding.severity.capitalize()}, {finding.where}: {finding.what}{end}"))
        if finding.changes and finding.fix:
            blocks.append(page.Code(f"--set {finding.fix}"))
        elif finding.fix.startswith("omnibench "):
            blocks.append(page.Code(finding.fix))
        elif finding.fix:
            blocks.append(page.Paragraph(finding.fix, "note"))
    if checked.command:
        blocks += [page.Paragraph("One import mends what options mend:"), page.Code(checked.command)]
    return blocks


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
