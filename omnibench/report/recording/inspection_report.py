"""An inspection and a check as they are shown: motions driven, what can be identified, findings with what to type."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from omnibench.check.check import CheckReport
from omnibench.check.motions import SHARE, motion_kinds
from omnibench.data.clock_matching import ClockMatch
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.finding import CLOCKS
from omnibench.fit.identifiability import ROWS, UNTOLD
from omnibench.fit.inspect import Inspection
from omnibench.report import blocks as page
from omnibench.report.figures import line, marks
from omnibench.report.numbers import NOTHING, fixed, percent, significant, typeset, with_unit
from omnibench.report.recording.recording_figures import evenly
from omnibench.report.recording.section import contents_table, field_table, path_overview, pictures, tiles
from omnibench.report.result import NextStep, Remark, Result
from omnibench.report.style import PALETTE, REFERENCE, plot
from omnibench.robot.kinematics import Array, Robot
from omnibench.words import plural


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
        share = "most" if self.inspection.identifiability.sentences else "all"
        command = ("omnibench", "calibrate", *self.sources, "-o", "calibration.yaml")
        return NextStep(f"{named} determines {share} of the matrix", "calibrate it", command)

    def tables(self) -> Sequence[page.Table]:
        tables = [self._splits, identifiability_table(self.inspection)]
        if self.dataset is not None:
            contents = contents_table(self.dataset)
            recorded = tuple(row for row in contents.rows if row.role != "muted")
            tables.insert(0, replace(contents, rows=recorded))
        return tables

    def remarks(self) -> Sequence[Remark]:
        found = self.inspection
        driven, shares = f"{found.driven_directions} of {len(found.driven_shares)}", found.driven_shares
        lines = [f"directions of {driven_by(found)} driven: {driven} ({', '.join(f'{share:.2g}' for share in shares)})"]
        lines += [f"noise: {found.identifiability.noise_source}"]
        lines += [] if found.scans is None else [f"scans: {found.scans.seen_share:.0%} of the rays measured"]
        return [Remark(text) for text in (*lines, *(f"- {each}" for each in found.findings))]

    def document(self) -> page.Document:
        """DataError in one line: scans that cannot be read."""
        dataset, inspection = self.dataset, self.inspection
        assert dataset is not None
        training = dataset.split("train") or dataset.trajectories
        identified, motions = inspection.identifiability, motion_table(training, dataset.robot)
        missing = ", ".join(row.cells[0].text for row in motions.rows if row.role == "failed")
        lacks = f"Not driven to train: {missing}." if missing else "Every kind of motion was driven to train."
        told = "Part of the matrix stays open." if identified.sentences else "The runs determine all of the matrix."
        picture, speeds = path_overview(dataset), speed_figure(training, dataset.robot)
        if alone := len(picture.figures) == 1:  # beside the paths there is room for the speeds
            picture = replace(picture, figures=(*picture.figures, speeds))
        driven = (motions,) if alone else (page.FigureGrid((speeds,)), motions)
        answer = page.answer_section(
            f"{plural(inspection.trajectories, 'run')} of {inspection.robot}. {lacks} {told}",
            tiles(dataset, sum(split.distance_m for split in inspection.splits.values())),
            picture,
            page.Callout("Findings", inspection.findings, "warning" if identified.sentences else "plain"),
            page.Callout("Warnings on reading the data", inspection.warnings, "warning"),
        )
        known: list[page.Block] = [parameter_table(inspection)] if identified.parameters else []
        known += [identifiability_table(inspection), page.Paragraph(f"Noise: {identified.noise_source}.", "note")]
        return page.Document(
            title=f"Inspection of {dataset.name}",
            subtitle=dataset.description,
            sections=(
                answer,
                page.Section("motions", "Motions driven", driven),
                page.Section("identified", "What can be identified", tuple(known)),
                *pictures(dataset),
                page.Section("recorded", "What was recorded", (self._splits, contents_table(dataset))),
            ),
            badges=page.simulated_badge(dataset.simulated),
        )

    @property
    def _splits(self) -> page.Table:
        """The content of each split: runs, commands, repetitions, sessions, time, distance, turns."""
        return field_table("", {name: dict(split) for name, split in self.inspection.splits.items()})

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
        dataset, checked = self.dataset, self.checked
        runs = [run for run in dataset.trajectories if run.has_poses]
        clocks_are_off = any(finding.kind in CLOCKS for finding in checked.findings)
        picture = _clock_picture(dataset.robot, runs, checked.clocks) if clocks_are_off else None
        facts = [
            page.Fact(f"{severity.capitalize()}s", str(sum(each.severity == severity for each in checked.findings)))
            for severity in ("error", "warning", "note")
        ]
        columns = tuple(page.Column(name, numeric=False) for name in ("", "finding", "where", "what to type or do"))
        rows = tuple(
            page.Row.of(
                each.severity, each.what, each.where, f"--set {each.fix}" if each.changes and each.fix else each.fix
            )
            for each in checked.findings
        )
        gain = (
            f"What a calibration would gain on runs that it was not fitted to, each in turn; {typeset(checked.gain)}."
        )
        answer = page.answer_section(
            f"{checked.sentence}.",
            [*facts, page.Fact("Runs", str(len(dataset.trajectories)))],
            picture or path_overview(dataset),
            *([page.Table("Findings, each with what to type", columns, rows)] if rows else []),
            *([page.Code(checked.command, "One import mends what options mend")] if checked.command else []),
            *([page.Paragraph(gain, "note")] if checked.gain else []),
            title="Verdict",
        )
        badges = page.simulated_badge(dataset.simulated)
        return page.Document(f"Check: {dataset.name}", dataset.description, (answer,), badges)

    def json(self) -> dict[str, Any]:
        return self.checked.model_dump(mode="json", include={"verdict", "needed", "findings", "command"})


_TONES: dict[str, page.Tone] = {
    "ready": "good", "fix": "bad", "record more": "warning", "error": "bad", "warning": "warning", "note": "plain",
}  # fmt: skip


def driven_by(inspection: Inspection) -> str:
    """What the columns of the matrix are: wheel rates, or drive signals."""
    return "wheel rates" if len(inspection.driven_shares) == len(inspection.wheels) else "drive signals"


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
    along = page.Column("motion", numeric=False)
    columns = page.columns(f"{what} along", along, "driven", *(f"row {row}" for row in ROWS))
    caption = "Precision of a calibration from these data, ± % of the row's largest element"
    return page.Table(caption, columns, tuple(rows))


def parameter_table(inspection: Inspection) -> page.Table:
    """How precisely the runs tell each physical parameter."""
    rows = []
    for parameter in inspection.identifiability.parameters:
        factor, unit, digits = (math.degrees(1.0), "°", 2) if parameter.unit == "rad" else (1e3, "mm", 1)
        known, deviation = NOTHING, parameter.deviation
        if deviation is not None:
            known = f"± {with_unit(significant(factor * deviation, 2), unit)}"
        design = with_unit(fixed(factor * parameter.design, digits), unit)
        rows.append(page.Row.of(parameter.name, design, known, "determined" if parameter.told else "not determined"))
    told = page.Column("By these runs", numeric=False)
    columns = page.columns("Parameter", "Design", "Could be known to", told)
    note = "One standard deviation of the best that any calibration from these runs could do (the Cramér-Rao bound)."
    return page.Table("Wheels, as these runs determine them", columns, tuple(rows), note)


_BLOCK = 0.5  # s: motions are means over so long, which smooths encoder ticks (chosen)
_DRAWN = 2500  # dots of a figure
_MOTION = page.LegendItem("motion", "half a second of motion", PALETTE[0])
_RESTS = 0.05  # share of the fastest motion below which the robot stands (chosen)


def driven_twists(runs: Sequence[Trajectory], robot: Robot) -> tuple[Array, Array]:
    """Mean twists (n, 3) of half seconds in motion, by the design values, and their durations (n,), s."""
    means, durations = [np.empty((0, 3))], [np.empty(0)]
    for run in runs:
        steps = np.diff(run.times, prepend=0.0)
        starts = np.flatnonzero(np.diff(run.times // _BLOCK, prepend=-1.0))
        moved = np.add.reduceat(run.signals @ robot.inverse_kinematic_matrix.T * steps[:, None], starts)
        durations.append(np.add.reduceat(steps, starts))
        means.append(moved / durations[-1][:, None])
    twists, seconds = np.concatenate(means), np.concatenate(durations)
    size = np.hypot(twists[:, 0], twists[:, 1]) + robot.reach * np.abs(twists[:, 2])
    moving = size > _RESTS * float(size.max(initial=0.0))
    return twists[moving], seconds[moving]


def speed_figure(runs: Sequence[Trajectory], robot: Robot) -> page.Figure:
    """Speeds against rates of turn, a dot for every half second."""
    twists, _ = driven_twists(runs, robot)
    vx, vy, rates = twists[evenly(len(twists), _DRAWN)].T if len(twists) else twists.T
    dots = marks(_MOTION, 5, np.degrees(rates), np.hypot(vx, vy), hover="%{x:.0f}°/s, %{y:.2f} m/s", marker_opacity=0.6)
    figure = plot(dots, x_title="rate of turn, to the left (°/s)", y_title="speed (m/s)")
    figure.update_xaxes(autorange="reversed").update_yaxes(rangemode="tozero")
    title = "Speeds and rates of turn, a dot for every half second"
    return page.Figure(title, figure, "Speed in m/s against the rate of turn in °/s", 340)


def motion_table(runs: Sequence[Trajectory], robot: Robot) -> page.Table:
    """How long each kind of motion was driven, at which speeds and rates of turn; what was not is marked as failed."""
    twists, seconds = driven_twists(runs, robot)
    total, rows = float(seconds.sum()) or 1.0, []
    for name, chosen in motion_kinds(twists, robot).items():
        share = float(seconds[chosen].sum()) / total
        if share < SHARE:
            rows.append(page.Row.of(name, "not driven", NOTHING, NOTHING, role="failed"))
            continue
        speeds, rates = np.hypot(*twists[chosen, :2].T), np.degrees(np.abs(twists[chosen, 2]))
        rows.append(page.Row.of(name, percent(share, 0), _range(speeds, 2), _range(rates, 0)))
    columns = page.columns("Motion", "Share of the time in motion", "Speed (m/s)", "Rate of turn (°/s)")
    note = "By the design values, as means over 0.5 s; ranges hold nine tenths. A motion counts as straight or curved "
    note += "and as forward, backward or sideways (within 30°), so that shares add up to more than 100 %."
    return page.Table("Motions driven", columns, tuple(rows), note)


def _range(values: Array, decimals: int) -> str:
    low, high = (fixed(float(value), decimals) for value in np.quantile(values, [0.05, 0.95]))
    return low if low == high else f"{low} to {high}"


_WHEELS = page.LegendItem("wheels", "by the wheels, at the design", PALETTE[0])
_REFERENCE = page.LegendItem("reference", "by the reference", REFERENCE)
_SMOOTH = 0.3  # s over which rates of turn are taken, so that the reference's noise does not hide them; chosen
_SHOWN = 12.0  # s that are drawn, where matching shows best; chosen
_LOOKED_AT = 8  # runs whose clocks are farthest off, of which the one is drawn that shows it best; chosen


def _clock_picture(
    robot: Robot, runs: Sequence[Trajectory], clocks: Sequence[ClockMatch | None]
) -> page.FigureGrid | None:
    """Rates of turn by wheels and reference where matching their clocks shows best, before and after it."""
    known = [(run, clock) for run, clock in zip(runs, clocks, strict=True) if clock is not None]
    if not known:
        return None
    off = [max(abs(clock.offset), abs(clock.offset + clock.drift * clock.length)) for _, clock in known]
    views = []
    for run, clock in (known[index] for index in np.argsort(-np.array(off), kind="stable")[:_LOOKED_AT]):
        moments, edges = np.arange(0.0, run.times[-1], _SMOOTH / 3), np.append(0.0, run.times)
        turns = np.append(0.0, np.cumsum((run.signals @ robot.inverse_kinematic_matrix[2]) * np.diff(edges)))
        of_reference = ((stamps, run.poses[:, 2]) for stamps in (run.pose_times, clock.corrected(run.pose_times)))
        wheels, before, after = (
            (np.interp(moments + _SMOOTH / 2, *turned) - np.interp(moments - _SMOOTH / 2, *turned)) / _SMOOTH
            for turned in ((edges, turns), *of_reference)
        )
        length = min(round(3 * _SHOWN / _SMOOTH), len(moments))
        gained = np.convolve((before - wheels) ** 2 - (after - wheels) ** 2, np.ones(length), "valid")
        begin = int(gained.argmax())
        rates = np.array([moments, wheels, before, after])[:, begin : begin + length]
        views.append((float(gained[begin]), run.id, abs(clock.offset + clock.drift * moments[begin]), rates))
    _, name, apart, (moments, wheels, before, after) = max(views, key=lambda view: view[0])
    low, high = (float(edge([wheels, before, after])) for edge in (np.min, np.max))
    figures = []
    for title, reference in ((f"As recorded: {fixed(apart, 2)} s apart", before), ("With matched stamps", after)):
        both = ((_WHEELS, wheels), (_REFERENCE, reference))
        traces = [line(item, 1.8, moments, rates, hover="%{y:.2f} rad/s") for item, rates in both]
        figure = plot(*traces, x_title="time by the wheels' clock (s)", y_title="rate of turn (rad/s)")
        figure.update_yaxes(range=[low - 0.05 * (high - low), high + 0.05 * (high - low)])
        figures.append(page.Figure(title, figure, "Rate of turn over time, by the wheels and by the reference", 300))
    caption = f"Rate of turn in run {name}, whose stamps are among those that differ most."
    return page.FigureGrid(tuple(figures), (_WHEELS, _REFERENCE), caption=caption, name="clocks")
