"""The report of a check: the verdict, matched clocks in a picture, every finding with what to type."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.data.checks.finding import Finding
from omnibench.data.clock_matching import ClockMatch
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.fit.check.checking import CheckReport
from omnibench.report.blocks import (
    Block,
    Code,
    Document,
    Fact,
    Figure,
    FigureGrid,
    LegendItem,
    Paragraph,
    Section,
    answer_section,
    simulated_badge,
)
from omnibench.report.figures import line
from omnibench.report.numbers import fixed, typeset
from omnibench.report.recording.section import path_overview
from omnibench.report.style import PALETTE, REFERENCE, plot
from omnibench.robot.kinematics import Array, Robot

_WHEELS = LegendItem("wheels", "by the wheels, at the design", PALETTE[0])
_REFERENCE = LegendItem("reference", "by the reference", REFERENCE)
_SMOOTH = 0.3  # s over which rates of turn are taken, so that the reference's noise does not hide them; chosen
_SHOWN = 12.0  # s that are drawn, where matching shows best; chosen
_LOOKED_AT = 8  # runs whose clocks are farthest off, of which the one is drawn that shows it best; chosen
_WORDS = {"error": "Errors", "warning": "Warnings", "note": "Notes"}


def check_document(dataset: Dataset, checked: CheckReport) -> Document:
    """The report on a data set as blocks."""
    runs = [run for run in dataset.trajectories if run.has_poses]
    picture = _clock_picture(dataset.robot, runs, checked.clocks) or path_overview(dataset)
    counts = {severity: sum(each.severity == severity for each in checked.findings) for severity in _WORDS}
    tiles = [Fact(_WORDS[severity], str(count)) for severity, count in counts.items()]
    tiles.append(Fact("Runs", str(len(dataset.trajectories))))
    gain = f"What a calibration would gain on runs that it was not fitted to, each in turn; {typeset(checked.gain)}."
    sections = [
        answer_section(
            f"{checked.sentence}.",
            tiles,
            picture,
            *([Paragraph(gain, "note")] if checked.gain else []),
            title="Verdict",
        ),
        Section("findings", "Findings, each with what to type", tuple(_blocks(checked.findings))),
    ]
    return Document(
        title=f"Check: {dataset.name}",
        subtitle=dataset.description,
        sections=tuple(sections),
        badges=simulated_badge(dataset.simulated),
    )


def _blocks(findings: Sequence[Finding]) -> list[Block]:
    if not findings:
        return [Paragraph("Nothing was found that spoils a calibration.")]
    blocks: list[Block] = []
    for finding in findings:
        blocks.append(Paragraph(f"{finding.severity.capitalize()}, {finding.where}: {finding.what}."))
        if finding.fix.startswith("omnibench "):
            blocks.append(Code(finding.fix))
        elif finding.fix:
            blocks.append(Paragraph(finding.fix, "note"))
    return blocks


def _clock_picture(robot: Robot, runs: Sequence[Trajectory], clocks: Sequence[ClockMatch | None]) -> FigureGrid | None:
    """Rates of turn by wheels and reference in the run whose clock is farthest off, before and after matching."""
    known = [(run, clock) for run, clock in zip(runs, clocks, strict=True) if clock is not None]
    if not known:
        return None
    farthest = sorted(known, key=lambda pair: -_worst(pair[1]))[:_LOOKED_AT]
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
    return FigureGrid(figures, (_WHEELS, _REFERENCE), caption=caption, name="clocks")


def _worst(clock: ClockMatch) -> float:
    return max(abs(clock.offset), abs(clock.offset + clock.drift * clock.length))


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


def _rates(robot: Robot, run: Trajectory, stamps: Array, span: tuple[float, float], title: str) -> Figure:
    edges, turns = _turned(robot, run)
    moments = np.arange(span[0], span[1], _SMOOTH / 3)
    traces = [
        line(item, 1.8, moments, _slopes(moments, *turned), hover=f"{item.label}<br>%{{y:.2f}} rad/s at %{{x:.2f}} s")
        for item, turned in ((_WHEELS, (edges, turns)), (_REFERENCE, (stamps, run.poses[:, 2])))
    ]
    figure = plot(*traces, x_title="time by the wheels' clock (s)", y_title="rate of turn (rad/s)")
    return Figure(title, figure, "Rate of turn over time, by the wheels and by the reference", 300)


def _slopes(moments: Array, times: Array, headings: Array) -> Array:
    half = _SMOOTH / 2
    slopes: Array = (np.interp(moments + half, times, headings) - np.interp(moments - half, times, headings)) / _SMOOTH
    return slopes
