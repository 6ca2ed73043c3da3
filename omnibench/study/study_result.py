"""The result of a study: its cells, the answer to whether the reference method beats the best published one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from omnibench.environment import Environment
from omnibench.registry import calibrators
from omnibench.study.cell_intervals import CellRatio
from omnibench.study.cells import MethodInCell, StudyCell
from omnibench.study.config import StudyConfig
from omnibench.study.judging import JudgedFit
from omnibench.study.regimes import AS_RECORDED
from omnibench.study.study_plan import PlannedFit, StudiedRobot
from omnibench.views import Shown


@dataclass(frozen=True, eq=False)
class AgainstBest:
    """The reference method beside the published method of least mean error in a cell, Eq. (6)."""

    cell: StudyCell
    best: str
    ratio: CellRatio


@dataclass(frozen=True, eq=False, repr=False)
class StudyResult(Shown):
    """Everything that the report shows. broken: why recordings could not be read, by robot."""

    config: StudyConfig
    output: Path
    robots: tuple[StudiedRobot, ...]
    broken: Mapping[str, str]
    fits: tuple[JudgedFit, ...]
    cells: tuple[StudyCell, ...]
    environment: Environment
    warnings: tuple[str, ...]

    @property
    def judged_cells(self) -> tuple[StudyCell, ...]:
        """Cells of recorded training runs that other runs judge: what verdicts, ranks and profiles rest on."""
        return tuple(cell for cell in self.cells if not cell.key.fitted and cell.key.regime == AS_RECORDED)

    @cached_property
    def against_best(self) -> tuple[AgainstBest, ...]:
        """The reference method against the best published one, in every judged cell that has both."""
        name = self.config.reference or ""
        rivals = [(cell, _best_published(cell)) for cell in self.judged_cells if name]
        compared = [
            (cell, best.method)
            for cell, best in rivals
            if best is not None and name in cell.methods and cell.methods[name].errors is not None
        ]
        found = []
        for cell, best in compared:
            ratio = cell.between(name, best, len(compared))
            assert ratio is not None  # both have answers
            found.append(AgainstBest(cell, best, ratio))
        return tuple(found)

    @property
    def geometric_mean(self) -> float | None:
        """Geometric mean over cells of the reference's error as a ratio to the best published one's."""
        return mean_ratio([each.ratio.value for each in self.against_best])

    @property
    def failures(self) -> tuple[str, ...]:
        """A line for every fit that failed or gave an invalid answer."""
        return tuple(
            f"{', '.join(filter(None, _place(each.fit)))}: {each.outcome}: {each.reason}"
            for each in self.fits
            if str(each.outcome) in ("failed", "invalid")
        )

    @property
    def nothing_answered(self) -> bool:
        """True if no method that is fitted, or none of all if there are no such, gave an answer anywhere."""
        fitted = [each for each in self.fits if calibrators.entry(each.fit.method.name).cls.fitted]
        return not any(each.answered for each in fitted or self.fits)


def mean_ratio(ratios: Sequence[float]) -> float | None:
    """The geometric mean of some ratios; None of none, or where one is 0."""
    return float(np.exp(np.mean(np.log(ratios)))) if ratios and min(ratios) > 0 else None


def _place(fit: PlannedFit) -> tuple[str, ...]:
    """Robot, training, fold, regime and method with its seed; empty where there is nothing to say."""
    regime = "" if fit.regime == AS_RECORDED else fit.regime
    return fit.robot.name, fit.training.name, fit.fold.name, regime, f"{fit.method.shown} seed {fit.seed}"


def _best_published(cell: StudyCell) -> MethodInCell | None:
    published = [each for each in cell.methods.values() if each.family == "published" and each.errors is not None]
    return min(published, key=lambda each: each.mean("cost") or 0.0) if published else None


def answered_everywhere(cells: Sequence[StudyCell], methods: Sequence[str]) -> tuple[str, ...]:
    """The methods that have an answer in every one of some cells."""
    return tuple(
        name
        for name in methods
        if all(name in cell.methods and cell.methods[name].errors is not None for cell in cells)
    )
