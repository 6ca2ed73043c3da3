"""The result of a study: its cells, the answer to whether the reference method beats the best published one.

Ranks: Friedman's test asks whether k methods that were all judged in N cells differ at all; two whose mean ranks are
closer than the critical difference of Nemenyi's test are not told apart (Demsar, J. Mach. Learn. Res. 7:1, 2006):

    CD = q sqrt(k (k + 1) / (6 N)),                                                                (K1)

q being the 95 % point of the studentised range of k, divided by sqrt 2. It takes cells for independent; cells of one
robot share runs, so the critical difference is a lower bound.

Profiles: the share of cells in which a method's error is at most t times that of the best one there (Dolan and More,
Math. Program. 91:201, 2002). Where a method has no answer its error is infinite.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.stats import friedmanchisquare, rankdata, studentized_range

from omnibench.environment import Environment
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array
from omnibench.study.cells import CellRatio, MethodInCell, StudyCell
from omnibench.study.config import StudyConfig
from omnibench.study.study_plan import JudgedFit, PlannedFit, StudiedRobot
from omnibench.study.trainings import AS_RECORDED
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


_LEVEL = 0.95
_FEWEST_METHODS = 3  # methods that Friedman's test compares at least
_FEWEST_CELLS = 2


@dataclass(frozen=True, eq=False)
class Ranking:
    """Mean ranks (k,) of methods over cells, 1 the best, in that order. p_value: Friedman's.

    critical_difference: of mean ranks, Eq. (K1). groups: indices of the first and last of methods that are not told
    apart.
    """

    methods: tuple[str, ...]
    ranks: Array
    cells: int
    p_value: float
    critical_difference: float
    groups: tuple[tuple[int, int], ...]


def ranking(cells: Sequence[StudyCell], methods: Sequence[str]) -> Ranking | None:
    """The ranks of the methods that answered in every cell; None where methods or cells are too few."""
    # The methods that answered in every cell
    names = tuple(
        name
        for name in methods
        if all(name in cell.methods and cell.methods[name].errors is not None for cell in cells)
    )
    if len(names) < _FEWEST_METHODS or len(cells) < _FEWEST_CELLS:
        return None
    errors = np.array([[cell.methods[name].mean("cost") for name in names] for cell in cells], dtype=float)
    ranks = np.array([rankdata(of_cell) for of_cell in errors]).mean(axis=0)
    order = np.argsort(ranks, kind="stable")
    k, count = len(names), len(cells)
    quantile = float(studentized_range.ppf(_LEVEL, k, np.inf)) / math.sqrt(2)
    difference = quantile * math.sqrt(k * (k + 1) / (6 * count))
    alike = bool(np.ptp(errors, axis=1).max() == 0)
    p_value = 1.0 if alike else float(friedmanchisquare(*errors.T).pvalue)
    ordered = ranks[order]
    return Ranking(
        tuple(names[index] for index in order), ordered, count, p_value, difference, _groups(ordered, difference)
    )


def _groups(ranks: Array, difference: float) -> tuple[tuple[int, int], ...]:
    """The longest stretches of ordered ranks whose ends are closer than a difference."""
    spans: list[tuple[int, int]] = []
    for first in range(len(ranks)):
        last = int(np.searchsorted(ranks, ranks[first] + difference, side="right")) - 1
        if last > first and (not spans or last > spans[-1][1]):
            spans.append((first, last))
    return tuple(spans)


@dataclass(frozen=True, eq=False)
class Profile:
    """Performance profile of a method: the errors' ratios to the best in each cell, sorted, those of answers only."""

    method: str
    ratios: Array
    cells: int

    def share(self, factor: float) -> float:
        """The share of all cells in which its error is at most ``factor`` times the best."""
        return float(np.searchsorted(self.ratios, factor * (1 + 1e-12), side="right")) / self.cells


def profiles(cells: Sequence[StudyCell], methods: Sequence[str]) -> tuple[Profile, ...]:
    """The profile of every method that was asked in all cells and answered in some."""
    best = [
        min((mean for each in cell.methods.values() if (mean := each.mean("cost")) is not None), default=math.inf)
        for cell in cells
    ]
    made = []
    for name in methods:
        if not all(name in cell.methods for cell in cells):
            continue
        means = [cell.methods[name].mean("cost") for cell in cells]
        ratios = [
            mean / lowest if lowest > 0 else 1.0 for mean, lowest in zip(means, best, strict=True) if mean is not None
        ]
        if ratios:
            made.append(Profile(name, np.sort(ratios), len(cells)))
    return tuple(made)
