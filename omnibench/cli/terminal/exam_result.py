"""The answer of ``omnibench exam grade``: figures with their intervals, and the mark of every set."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from omnibench.report.blocks import Column, Row, Table, columns
from omnibench.report.result import NextStep, Remark, Result
from omnibench.simulate.exam_marks import ExamMarks
from omnibench.words import plural

_FIGURES = {
    "right": "hidden effects: right name",
    "class": "hidden effects: in the class that was given",
    "unknown": "hidden effects: not found",
    "wrong": "names given that are wrong",
    "none_right": "nothing hidden: said none",
    "false_alarms": "nothing hidden: false alarm",
    "place_f1": "covariates (F1)",
}


class ExamResult(Result):
    """Marks of an exam as tables."""

    title = "exam"

    def __init__(self, marks: ExamMarks) -> None:
        self.marks = marks
        missing = len(marks.by_set) - marks.answered
        self.warnings = [f"no answer on {plural(missing, 'set')}, which count as unknown"] if missing else []

    def sentence(self) -> str:
        right, in_class, wrong = (self.marks.rates[name] for name in ("right", "class", "wrong"))
        hidden, wrong_names = plural(int(right.of), "hidden effect"), plural(int(wrong.count), "wrong name")
        return f"{right.count} of {hidden} named and {in_class.count} in a class; {wrong_names}."

    def opening(self) -> Sequence[Remark]:
        return [Remark(self.sentence())]

    def tables(self) -> Sequence[Table]:
        rows = []
        for name, words in _FIGURES.items():
            rate = self.marks.rates[name]
            share = "" if rate.share is None else f"{100 * rate.share:.0f} %"
            interval = "" if rate.share is None else f"{100 * rate.low:.0f} to {100 * rate.high:.0f} %"
            count = "" if name == "place_f1" else f"{rate.count:g} of {rate.of:g}"
            rows.append(Row.of(words, count, share, interval))
        figures = Table("figures", columns("figure", "count", "share", "95 % interval"), tuple(rows))
        marked = []
        for each in self.marks.by_set:
            hidden = ", ".join(f"{name}: {mark}" for name, mark in zip(each.hidden, each.marks, strict=True))
            cells = each.name, each.robot, hidden or "nothing", each.verdict, ", ".join(each.wrong)
            marked.append(Row.of(*cells, ", ".join(each.places)))
        titles = ("robot", "hidden", "verdict", "wrong")
        others = [Column(title, numeric=False) for title in titles]
        head = columns("set", *others, Column("covariates named", numeric=False, priority=1))
        return [figures, Table("sets", head, tuple(marked))]

    def next_step(self) -> NextStep:
        return NextStep(f"{self.marks.answered} of {plural(len(self.marks.by_set), 'set')} were answered")

    def json(self) -> dict[str, Any]:
        return self.marks.document
