"""The result of a study: cells of a robot, training, regime and judged kind with every method's errors; the answer.

The ratio of two methods' mean errors in a cell has intervals by sessions and by runs. A cell has pairs (f, z): the
calibration of training set f judged on run z. With the errors a and b of two methods and sums over all pairs, the ratio
is

    R = sum a_fz / sum b_fz.                                                                       (S1)

The runs of a session share its day, floor and clocks, and so do all calibrations from one session: sessions are the
independent draws, of training and of judged runs. With R_s the ratio without the pairs of session s, n_g sessions in
the group g (those that train, those that judge; one group where these are the same), the variance of log R is that of
the jackknife for several samples (Arvesen, Ann. Math. Stat. 40:2076, 1969),

    v = sum_g v_g,   v_g = (n_g - 1) / n_g sum_(s in g) (log R_s - their mean)^2,                  (S2)

and the interval that of Student's t with Satterthwaite's degrees of freedom (Biometrics Bulletin 2:110, 1946),

    log R +- t sqrt(v),   df = v^2 / sum_g v_g^2 / (n_g - 1).                                      (S3)

Where a group has fewer than three sessions, runs take their place, which say less: a day that differs goes unseen.
Of C cells that are judged together each has an interval of level 1 - 0.05 / C (Bonferroni), so that all of them hold
in 95 of 100 studies.

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
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit
from scipy.stats import friedmanchisquare, rankdata, studentized_range

from omnibench.environment import Environment
from omnibench.fit.intervals import FEWEST, Interval
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array
from omnibench.robot.physical import INTERVAL
from omnibench.study.config import StudyConfig
from omnibench.study.study_plan import AS_RECORDED, Fold, JudgedFit, PlannedFit, StudiedRobot, Training
from omnibench.views import Shown
from omnibench.words import plural

UnitOfCell = Literal["session", "run"]
Members = NDArray[np.bool_]
_ALIKE = 1e-9  # share of the sums: smaller differences between ratios are rounding


@dataclass(frozen=True, eq=False)
class Pairs:
    """The pairs of a cell. folds (n,), runs (n,): index of each pair's training set and judged run.

    trained_in (n,), judged_in (n,): names of the sessions; None: training runs that are not of one session.
    """

    folds: Array
    runs: Array
    trained_in: tuple[str | None, ...]
    judged_in: tuple[str | None, ...]

    @property
    def sessions(self) -> int:
        """Number of sessions that judge; 0 where some run names none."""
        return 0 if None in self.judged_in else len(set(self.judged_in))

    def groups(self, unit: UnitOfCell) -> list[list[Members]]:
        """For each group the pairs (n,) of bool that each of its units has a part in."""
        if unit == "run":
            return [[self.runs == run for run in np.unique(self.runs)]]
        trained, judged = _members(self.trained_in), _members(self.judged_in)
        if len(trained) < 2:  # one training set, or no session of its own: given
            return [list(judged.values())]
        if trained.keys() & judged.keys():
            none = np.zeros(len(self.runs), dtype=bool)
            names = [*judged, *(name for name in trained if name not in judged)]
            return [[judged.get(name, none) | trained.get(name, none) for name in names]]
        return [list(trained.values()), list(judged.values())]

    @property
    def unit(self) -> UnitOfCell:
        """The units that the interval rests on: sessions where each group has three, else runs."""
        return "session" if self.sessions and min(map(len, self.groups("session"))) >= FEWEST else "run"


@dataclass(frozen=True)
class CellRatio:
    """Ratio of two methods' mean errors in a cell, with the 95 % interval and that of its family of cells.

    unit: what they rest on; units: their number in words.
    """

    value: float
    alone: Interval
    in_family: Interval
    unit: UnitOfCell
    units: str

    @property
    def equal(self) -> bool:
        """True if the two differ by rounding alone."""
        return abs(self.value - 1) < _ALIKE

    @property
    def verdict(self) -> Literal["better", "worse", "undecided"]:
        """The verdict of the family's interval: which side of 1 it lies on."""
        if self.equal or self.in_family.known is None or self.in_family.holds(1.0):
            return "undecided"
        return "better" if self.value < 1 else "worse"


def cell_ratio(errors: Array, others: Array, pairs: Pairs, cells: int) -> CellRatio:
    """The ratio of the mean of errors (n,) to that of others (n,) over a cell's pairs; cells: size of its family."""
    unit = pairs.unit
    groups = pairs.groups(unit)
    ratio = float(errors.sum() / others.sum()) if others.sum() > 0 else math.inf
    parts = [_variance(errors, others, group) for group in groups]
    words = " and ".join(plural(len(group), unit) for group in groups)
    return CellRatio(
        ratio,
        _interval(ratio, parts, INTERVAL),
        _interval(ratio, parts, 1 - (1 - INTERVAL) / cells),
        unit,
        words,
    )


def _members(names: Sequence[str | None]) -> dict[str, Members]:
    known = list(dict.fromkeys(name for name in names if name is not None))
    given = np.array(names, dtype=object)
    return {name: given == name for name in known}


def _variance(errors: Array, others: Array, group: Sequence[Members]) -> tuple[float, int] | None:
    """v_g of Eq. (S2) and its degrees of freedom; None where it is not known."""
    if len(group) < FEWEST:
        return None
    upper = errors.sum() - np.array([errors[members].sum() for members in group])
    lower = others.sum() - np.array([others[members].sum() for members in group])
    if not ((upper > 0) & (lower > 0)).all():
        return None
    logarithms = np.log(upper / lower)
    around = logarithms - logarithms.mean()
    around[np.abs(around) < _ALIKE] = 0.0
    count = len(group)
    return (count - 1) / count * float(np.square(around).sum()), count - 1


def _interval(ratio: float, parts: Sequence[tuple[float, int] | None], level: float) -> Interval:
    """The interval of Eq. (S3)."""
    known = [part for part in parts if part is not None]
    if len(known) < len(parts) or not 0 < ratio < math.inf:
        return Interval(ratio, None, None)
    variance = sum(part for part, _ in known)
    if variance == 0:
        return Interval(ratio, ratio, ratio)
    freedom = variance**2 / sum(part**2 / count for part, count in known)
    reach = float(stdtrit(freedom, (1 + level) / 2)) * math.sqrt(variance)
    return Interval(ratio, ratio * math.exp(-min(reach, 30.0)), ratio * math.exp(min(reach, 30.0)))


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

    def mean(self, method: str) -> float | None:
        """A method's mean error, Eq. (6); None where it was not asked, or has no answer."""
        return self.methods[method].mean("cost") if method in self.methods else None

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
        cost=", ".join(dict.fromkeys(run.settings.objective for run in runs)),
        unidentified=", ".join(dict.fromkeys(run.settings.unidentified for run in runs)),
        matrix=next((each.result.matrix for each in answered if each.result is not None), None),
    )


def _measured(errors: Array, pairs: Pairs) -> dict[Measure, Array]:
    """Eq. (6), distances (m) and headings (rad), (n,) each, from errors (folds, Z, 3)."""
    of_pairs = errors[pairs.folds, pairs.runs]
    return {
        "cost": np.linalg.norm(of_pairs, axis=1),
        "position": np.hypot(of_pairs[:, 0], of_pairs[:, 1]),
        "heading": np.abs(of_pairs[:, 2]),
    }


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
        compared = []
        for cell in self.judged_cells if name else ():
            published = [
                each for each in cell.methods.values() if each.family == "published" and each.errors is not None
            ]
            if published and cell.mean(name) is not None:
                compared.append((cell, min(published, key=lambda each: each.mean("cost") or 0.0).method))
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
    names = tuple(name for name in methods if all(cell.mean(name) is not None for cell in cells))
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
    # The longest stretches of ordered ranks whose ends are closer than a difference
    spans: list[tuple[int, int]] = []
    for first in range(len(ordered)):
        last = int(np.searchsorted(ordered, ordered[first] + difference, side="right")) - 1
        if last > first and (not spans or last > spans[-1][1]):
            spans.append((first, last))
    return Ranking(tuple(names[index] for index in order), ordered, count, p_value, difference, tuple(spans))


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
