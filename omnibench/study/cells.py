"""Cells of a study: robot, training, regime and judged kind, with the errors of every method in each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from omnibench.compare.plan import PlannedRun
from omnibench.fit.calibrator import Calibrator, as_answered
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array
from omnibench.study.cell_intervals import CellRatio, Pairs, cell_ratio
from omnibench.study.judging import JudgedFit
from omnibench.study.regimes import AS_RECORDED
from omnibench.study.study_plan import StudiedRobot
from omnibench.study.trainings import Fold, Training

Measure = Literal["cost", "position", "heading"]
MEASURES: tuple[Measure, ...] = ("cost", "position", "heading")


@dataclass(frozen=True)
class CellKey:
    """Name of a cell. fitted: the judged runs are those that trained: training errors, which no verdict rests on."""

    robot: str
    training: str
    regime: str
    judged: str
    fitted: bool

    @property
    def words(self) -> str:
        """The cell in words."""
        regime = "" if self.regime == AS_RECORDED else f", {self.regime}"
        return f"{self.robot}: {self.training} -> {self.judged}{regime}"


@dataclass(frozen=True, eq=False)
class MethodInCell:
    """One method in a cell. errors: by measure, (n,) of each pair, means over seeds; the design's where it has none.

    fits, answers: how many were asked for and answered; outcomes: how many ended so. reason: of the first without an
    answer. seconds: median of a fit; numbers: what the method says of its first answer, matrix (3, M): that answer's.
    cost, unidentified: what was minimised, and what became of motions that were hardly driven; empty where it was never
    asked.
    """

    method: str
    family: str
    fits: int
    outcomes: Mapping[str, int]
    reason: str
    errors: Mapping[Measure, Array] | None
    seconds: float | None
    numbers: str
    answers: int
    cost: str = ""
    unidentified: str = ""
    matrix: Array | None = None

    def mean(self, measure: Measure) -> float | None:
        """Mean error over the pairs: Eq. (6), m, or rad."""
        return None if self.errors is None else float(self.errors[measure].mean())

    @property
    def status(self) -> str:
        """``answered``, or the commonest reason in a word why not; in how many fits, where these differ."""
        if self.answers == self.fits:
            return "answered"
        if self.answers:
            return f"answered in {self.answers} of {self.fits}"
        return max(self.outcomes, key=lambda outcome: self.outcomes[outcome])


@dataclass(frozen=True, eq=False)
class StudyCell:
    """A cell: its pairs, the design values' errors and the methods by name."""

    key: CellKey
    pairs: Pairs
    design: Mapping[Measure, Array]
    methods: Mapping[str, MethodInCell]

    def against_design(self, method: str, cells: int) -> CellRatio | None:
        """A method's mean error, Eq. (6), as a ratio to the design values'; None without an answer."""
        errors = self.methods[method].errors if method in self.methods else None
        return None if errors is None else cell_ratio(errors["cost"], self.design["cost"], self.pairs, cells)

    def between(self, method: str, other: str, cells: int) -> CellRatio | None:
        """The ratio of two methods' mean errors, Eq. (6); None where one has no answer."""
        one, two = self.methods[method].errors, self.methods[other].errors
        if one is None or two is None:
            return None
        return cell_ratio(one["cost"], two["cost"], self.pairs, cells)


def make_cells(judged: Sequence[JudgedFit], design: Mapping[str, Array]) -> tuple[StudyCell, ...]:
    """All cells, in the order of the fits. design: by robot, errors (Z, 3) of the design values."""
    groups: dict[tuple[str, str, str], list[JudgedFit]] = {}
    for each in judged:
        groups.setdefault((each.fit.robot.name, each.fit.training.name, each.fit.regime), []).append(each)
    cells = []
    for (robot_name, training_name, regime), fits in groups.items():
        robot, training = fits[0].fit.robot, fits[0].fit.training
        for fitted, kinds in ((False, training.kinds), (True, training.fitted_kinds)):
            for kind in kinds:
                if fitted and regime != AS_RECORDED:
                    continue
                key = CellKey(robot_name, training_name, regime, kind, fitted)
                cells.append(_cell(key, robot, training, fits, design[robot_name]))
    return tuple(cells)


def _cell(key: CellKey, robot: StudiedRobot, training: Training, fits: Sequence[JudgedFit], design: Array) -> StudyCell:
    pairs = _pairs(robot, training.folds, key)
    folds = {id(fold): number for number, fold in enumerate(training.folds)}
    by_method: dict[str, list[JudgedFit]] = {}
    for each in fits:
        by_method.setdefault(each.fit.method.shown, []).append(each)
    designs = np.broadcast_to(design, (len(training.folds), *design.shape))
    return StudyCell(
        key,
        pairs,
        _measured(designs, pairs),
        {name: _method(name, of_one, folds, pairs, designs) for name, of_one in by_method.items()},
    )


def _pairs(robot: StudiedRobot, folds: Sequence[Fold], key: CellKey) -> Pairs:
    runs = robot.dataset.trajectories
    listed = [
        (number, index)
        for number, fold in enumerate(folds)
        for index in ((fold.fitted or {}) if key.fitted else fold.judged).get(key.judged, ())
    ]
    return Pairs(
        np.array([number for number, _ in listed], dtype=int),
        np.array([index for _, index in listed], dtype=int),
        tuple(folds[number].session for number, _ in listed),
        tuple(runs[index].session for _, index in listed),
    )


def _method(
    name: str, fits: Sequence[JudgedFit], folds: Mapping[int, int], pairs: Pairs, designs: Array
) -> MethodInCell:
    answered = [each for each in fits if each.errors is not None]
    silent = next((each.reason for each in fits if each.errors is None), "")
    errors = None
    if answered:
        seeds = list(dict.fromkeys(each.fit.seed for each in fits))
        of_seeds = []
        for seed in seeds:
            of_folds = np.array(designs)
            for each in answered:
                if each.fit.seed == seed and each.errors is not None:
                    of_folds[folds[id(each.fit.fold)]] = each.errors
            of_seeds.append(_measured(of_folds, pairs))
        errors = {measure: np.mean([of_one[measure] for of_one in of_seeds], axis=0) for measure in MEASURES}
    runs = [each.fit.run for each in fits if each.fit.run is not None]
    seconds = [each.result.seconds for each in answered if each.result is not None]
    return MethodInCell(
        method=name,
        family=fits[0].fit.method.family,
        fits=len(fits),
        outcomes=Counter(str(each.outcome) for each in fits),
        reason=silent,
        errors=errors,
        seconds=float(np.median(seconds)) if seconds else None,
        numbers=answered[0].reason if answered else "",
        answers=len(answered),
        cost=", ".join(dict.fromkeys(run.config.objective for run in runs)),
        unidentified=", ".join(
            dict.fromkeys(as_answered(_class(run), run.config.unidentified, None)[0] for run in runs)
        ),
        matrix=next((each.result.matrix for each in answered if each.result is not None), None),
    )


def _class(run: PlannedRun) -> type[Calibrator]:
    """The class of a run's calibrator."""
    found: type[Calibrator] = calibrators.entry(run.entry.name).cls
    return found


def _measured(errors: Array, pairs: Pairs) -> dict[Measure, Array]:
    """Eq. (6), distances (m) and headings (rad), (n,) each, from errors (folds, Z, 3)."""
    of_pairs = errors[pairs.folds, pairs.runs]
    return {
        "cost": np.linalg.norm(of_pairs, axis=1),
        "position": np.hypot(of_pairs[:, 0], of_pairs[:, 1]),
        "heading": np.abs(of_pairs[:, 2]),
    }
