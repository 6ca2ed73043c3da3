"""The report's view of a study: robots with their cells, and how methods and cells are shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from omnibench.report.blocks import LegendItem
from omnibench.report.style import THEORETICAL, colours
from omnibench.robot.kinematics import Robot
from omnibench.study.cells import StudyCell
from omnibench.study.regimes import AS_RECORDED
from omnibench.study.study_result import StudyResult

_FAMILIES = {"ours": "omnibench", "published": "published", "baseline": "baseline", "other": ""}


@dataclass(frozen=True, eq=False)
class StudyView:
    """styles: of each method, the same in the whole report. methods: their names, in the config's order."""

    result: StudyResult
    methods: tuple[str, ...]
    styles: Mapping[str, LegendItem]

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots that were read."""
        return tuple(robot.name for robot in self.result.robots)

    def design(self, name: str) -> Robot:
        """The robot called ``name`` as it was drawn."""
        return next(robot.dataset.robot for robot in self.result.robots if robot.name == name)

    def judged(self, robot: str | None = None) -> tuple[StudyCell, ...]:
        """The cells that verdicts rest on, of one robot or of all."""
        return tuple(cell for cell in self.result.judged_cells if robot in (None, cell.key.robot))

    def plain(self, robot: str) -> tuple[StudyCell, ...]:
        """The cells of a robot as recorded: judged ones, then training errors."""
        keys = [(cell, cell.key) for cell in self.result.cells]
        mine = [cell for cell, key in keys if key.robot == robot and key.regime == AS_RECORDED]
        return tuple(sorted(mine, key=lambda cell: cell.key.fitted))

    def family(self, method: str) -> str:
        """A method's family in a word."""
        families = {choice.shown: choice.family for choice in self.result.config.methods}
        return _FAMILIES[families[method]]


def study_view(result: StudyResult) -> StudyView:
    """The view of a result."""
    wanted = {choice.shown: THEORETICAL if choice.name == "theoretical" else None for choice in result.config.methods}
    drawn = colours(wanted)
    styles = {name: LegendItem(f"method-{i}", name, *drawn[name]) for i, name in enumerate(wanted)}
    return StudyView(result, tuple(wanted), styles)


def cell_words(cell: StudyCell) -> str:
    """A cell within its robot: ``circular → square``."""
    return f"{cell.key.training} → {cell.key.judged}"
