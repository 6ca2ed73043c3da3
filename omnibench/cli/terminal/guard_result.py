"""The answer of ``omnibench guard``: alarms, proposals, and the evidence for each change over the way."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from omnibench.live.guard import THRESHOLD, Guard
from omnibench.live.guarding import GuardReport
from omnibench.live.health import number_with_unit
from omnibench.report.blocks import (
    Column,
    Document,
    Fact,
    Figure,
    FigureGrid,
    LegendItem,
    Row,
    Table,
    answer_section,
    columns,
    simulated_badge,
)
from omnibench.report.figures import line
from omnibench.report.result import NextStep, Remark, Result
from omnibench.report.style import PALETTE, plot
from omnibench.robot.physical import unit_of
from omnibench.words import kind_of_data

_CURVES = 6  # hypotheses that the picture shows; chosen


class GuardResult(Result):
    """A guard's answer on a recording.

    file: of the calibration. sources: data sets, as they were typed. asked: where the proposed calibration was to be
    written; proposed: where it was.
    """

    title = "guard"

    def __init__(
        self,
        report: GuardReport,
        guard: Guard,
        dataset: str,
        simulated: bool,
        file: Path,
        sources: Sequence[Path] = (),
        proposed: Path | None = None,
        asked: Path | None = None,
    ) -> None:
        self.report, self.guard, self.dataset, self.simulated = report, guard, dataset, simulated
        self.file, self.sources, self.proposed, self.asked = file, sources, proposed, asked

    def sentence(self) -> str:
        report = self.report
        driven = f"{report.metres:.0f} m of {self.dataset} ({kind_of_data(self.simulated)})"
        changes = [alarm for alarm in report.alarms if alarm.kind in ("change", "fault")]
        if changes:
            return f"In {driven}: {'; '.join(alarm.sentence for alarm in changes)}."
        others = f"; besides, {', '.join(alarm.sentence for alarm in report.alarms)}" if report.alarms else ""
        return f"Nothing changed in {driven}, as far as {self.file.name} states its noise{others}."

    def opening(self) -> Sequence[Remark]:
        return [Remark(self.sentence())]

    def tables(self) -> Sequence[Table]:
        tables = []
        if self.report.alarms:
            rows: list[Row] = []
            for alarm in self.report.alarms:
                interval = "" if alarm.low is None or alarm.high is None else f"{alarm.low:.5g} to {alarm.high:.5g}"
                value = "" if alarm.value is None else number_with_unit(alarm.value, alarm.unit)
                cells = alarm.kind, alarm.name, value, interval, f"{alarm.trajectory} {alarm.t:.1f} s"
                rows.append(Row.of(*cells, f"{alarm.detected_after_m:.1f}", ", ".join(alarm.alternatives)))
            titles = ("name", "value", "interval", "told in")
            words = [Column(title, numeric=False, priority=title == "interval") for title in titles]
            head = columns("kind", *words, "after (m)", Column("or", numeric=False))
            tables.append(Table("alarms", head, tuple(rows)))
        if self.report.proposals:
            rows = []
            for each in self.report.proposals:
                ratio = each.held_out.error_ratio
                error = "" if ratio is None else f"{ratio - 1:+.0%}"
                value = number_with_unit(each.value, unit_of(each.name))
                rows.append(Row.of(each.name, value, each.verdict, f"{each.held_out.metres:.0f}", error))
            head = columns("proposal", "value", Column("verdict", numeric=False), "judged on (m)", "error there")
            tables.append(Table("proposals", head, tuple(rows)))
        return tables

    def remarks(self) -> Sequence[Remark]:
        lines = [Remark(f"{alarm.name}: {alarm.advice}", "warning") for alarm in self.report.alarms if alarm.advice]
        if self.asked is not None and self.proposed is None:
            lines.append(Remark(f"no change was accepted: {self.asked} is not written", "warning"))
        if self.proposed is not None:
            lines.append(Remark(f"{self.proposed} holds the accepted values", "good"))
        return lines

    def next_step(self) -> NextStep:
        accepted = [each for each in self.report.proposals if each.accepted and not each.rolled_back]
        if accepted and self.proposed is None:
            command: tuple[object, ...] = ("omnibench", "guard", *self.sources, "--calibration", self.file)
            return NextStep(
                f"{', '.join(each.name for each in accepted)} changed",
                "write the calibration with the accepted values",
                (*command, "-o", "changed.yaml"),
            )
        if accepted:
            return NextStep(
                f"{', '.join(each.name for each in accepted)} changed",
                "see what that gains",
                ("omnibench", "evaluate", self.proposed, *self.sources),
            )
        faults = [alarm for alarm in self.report.alarms if alarm.kind == "fault"]
        if faults:
            return NextStep(f"{faults[-1].name}", "look at that wheel and its encoder, then check the recording again")
        changes = [alarm for alarm in self.report.alarms if alarm.kind == "change"]
        if changes:
            advice = changes[-1].advice or "record more after the change"
            command = ("omnibench", "calibrate", *self.sources, "-o", "calibration.yaml")
            return NextStep(f"{changes[-1].name} may have changed", f"{advice}, or calibrate anew", command)
        return NextStep("the calibration holds", "")

    def figures(self) -> Sequence[FigureGrid]:
        """The evidence for the likeliest changes over the way."""
        history, names = self.guard.history, self.guard.hypotheses.names
        if not history:
            return ()
        metres = np.array([point[0] for point in history])
        strengths = [point[1] for point in history]
        strongest = sorted(range(len(names)), key=lambda j: -max(float(row[j]) for row in strengths))[:_CURVES]
        traces, legend = [], []
        for number, j in enumerate(strongest):
            item = LegendItem(names[j], names[j], PALETTE[number % len(PALETTE)])
            legend.append(item)
            hover = f"{names[j]}<br>%{{x:.0f}} m: %{{y:.1f}}"
            traces.append(line(item, 1.6, metres, np.array([row[j] for row in strengths]), hover=hover))
        figure = plot(*traces, x_title="driven (m)", y_title="evidence")
        figure.add_hline(y=THRESHOLD, line_dash="dash", annotation_text="told from here on")
        words = f"Evidence for {', '.join(names[j] for j in strongest)} over {metres[-1]:.0f} m."
        return (FigureGrid((Figure("Evidence for a change", figure, words),), tuple(legend), 1, name="evidence"),)

    def document(self) -> Document:
        report = self.report
        changes = sum(alarm.kind in ("change", "fault") for alarm in report.alarms)
        tiles = (
            Fact("driven", f"{report.metres:.0f} m"),
            Fact("changes and faults", f"{changes}"),
            Fact("bursts and the reference", f"{len(report.alarms) - changes}"),
        )
        answer = answer_section(self.sentence(), tiles, *self.tables(), *self.figures())
        subtitle = f"{self.guard.calibration.name}, against the reference of {self.dataset}"
        return Document(
            f"Guard of {self.guard.calibration.robot.name}", subtitle, (answer,), simulated_badge(self.simulated)
        )

    def json(self) -> GuardReport:
        return self.report
