"""Statistics of a comparison: of entries over their seeds, with paired differences; of cells over several robots.

Statistics of entries: medians over seeds, intervals over commands or runs, paired differences.

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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from scipy.stats import friedmanchisquare, rankdata, studentized_range

from omnibench.compare import result as results
from omnibench.compare.config import AS_RECORDED
from omnibench.compare.plan import Fold
from omnibench.compare.ratios import Pairs
from omnibench.compare.result import Cell, EntryStatistics, Measure, ScoredFit, SplitScore
from omnibench.data.dataset import Dataset, Split
from omnibench.fit.evaluate import judge, nothing_held_out
from omnibench.fit.intervals import Bootstrap, Interval, RatioIntervals
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array

# Share of the standard error of the best cost: a smaller difference is of no practical interest (chosen).
NEGLIGIBLE_SHARE = 0.1


def entry_statistics(runs: Sequence[ScoredFit], bootstrap: Bootstrap) -> tuple[EntryStatistics, ...]:
    """Statistics of every entry on every data set, in the order of the runs.

    An entry is practically equal to another when the 95 % interval of the paired difference of their typical runs'
    validation costs (training costs where there is no validation split) contains zero, or the difference is below a
    tenth of the standard error of the other's cost; where there is no interval, that is undecided. The best entry of a
    data set has the lowest training cost among those that are not known to differ from the one of lowest validation
    cost.
    """
    groups: dict[tuple[str, str], list[ScoredFit]] = {}
    for run in runs:
        groups.setdefault((run.record.dataset, run.record.label), []).append(run)
    # The run of median training cost (the worse one of two), of those with an answer
    typical: dict[tuple[str, str], ScoredFit | None] = {}
    for key, group in groups.items():
        answered = [run for run in group if run.record.train_cost is not None]
        ranked = sorted(answered, key=lambda run: (run.record.train_cost, run.record.seed))
        typical[key] = ranked[len(ranked) // 2] if ranked else None
    intervals = RatioIntervals(bootstrap)
    statistics = []
    for (dataset, label), group in groups.items():
        best = _best([run for (name, _), run in typical.items() if name == dataset and run is not None], intervals)
        median, records = typical[dataset, label], [run.record for run in group]
        costs = [record.train_cost for record in records if record.train_cost is not None]
        scores, design = ({}, {}) if median is None else (median.scores, median.design)
        difference, equal = None, None
        if median is not None and best is not None:
            difference, equal = _against_best(median, best, intervals)
        statistics.append(
            EntryStatistics(
                dataset=dataset,
                label=label,
                calibrator=records[0].calibrator,
                parameterisation=records[0].parameterisation,
                box=records[0].box,
                runs=len(group),
                answers=len(costs),
                typical=median,
                train_median=_median(costs),
                train_spread=float(np.subtract(*np.percentile(costs, [75, 25]))) if costs else None,
                costs={split: intervals.mean(score.costs, score.units) for split, score in scores.items()},
                improvements={
                    split: intervals.improvement(score.costs, design[split].costs, score.units, score.rounding)
                    for split, score in scores.items()
                },
                difference=difference,
                practically_equal=equal,
                is_best=median is not None and median is best,
                gap_median=_median(record.gap for record in records),
                proven_gap_median=_median(record.proven_gap for record in records),
                evaluations_median=_median(record.evaluations for record in records),
                seconds_median=_median(record.seconds for record in records),
                reference_evaluations_median=_median(
                    record.seconds / record.reference_seconds for record in records if record.reference_seconds
                ),
            )
        )
    return tuple(statistics)


def _median(values: Iterable[float | None]) -> float | None:
    """The median of those that are known; None without any."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def design_costs(runs: Sequence[ScoredFit], bootstrap: Bootstrap) -> dict[str, dict[Split, Interval]]:
    """The mean cost of the design values, by data set and split."""
    designs = {run.record.dataset: run.design for run in runs}
    intervals = RatioIntervals(bootstrap)
    return {
        dataset: {split: intervals.mean(score.costs, score.units) for split, score in design.items()}
        for dataset, design in designs.items()
    }


def held_out_verdicts(
    statistics: Sequence[EntryStatistics], datasets: Mapping[str, Dataset], bootstrap: Bootstrap
) -> dict[str, results.EntryVerdict]:
    """The verdict of each data set's validation runs on its best calibration, if a calibrator gave an answer.

    The best calibration is the best entry, or, where that is not fitted, the fitted one of lowest judged cost.
    """
    verdicts = {}
    for name, dataset in datasets.items():
        fitted = [
            (not entry.is_best, _judged_cost(entry.typical), entry.label, entry.typical)
            for entry in statistics
            if entry.dataset == name and entry.typical is not None and calibrators.entry(entry.calibrator).cls.fitted
        ]
        if fitted:
            _, _, label, run = min(fitted, key=itemgetter(0, 1))
            verdict, held_out = nothing_held_out(), dataset.split("validation")
            if held_out:
                verdict = judge(run.design["validation"].errors, run.scores["validation"].errors, held_out, bootstrap)
            verdicts[name] = results.EntryVerdict(label, verdict)
    return verdicts


def is_mean(run: ScoredFit) -> bool:
    """True if the run's cost is the mean of its trajectories' costs, as the intervals and differences suppose."""
    train = run.scores.get("train")
    return train is None or bool(np.isclose(train.costs.mean(), train.cost, rtol=1e-6, atol=0.0))


def _best(competing: Sequence[ScoredFit], intervals: RatioIntervals) -> ScoredFit | None:
    """The run of lowest training cost among those practically equal to the one of lowest judged cost."""
    if not competing:
        return None
    lowest = min(competing, key=_judged_cost)
    rivals = [run for run in competing if _against_best(run, lowest, intervals)[1] is not False]
    return min(rivals, key=lambda run: (run.record.train_cost or 0.0, _judged_cost(run)))


def _judged(run: ScoredFit) -> SplitScore:
    """The score that an answer is judged by: on the validation split where there is one."""
    return run.scores["validation" if "validation" in run.scores else "train"]


def _judged_cost(run: ScoredFit) -> float:
    return float(_judged(run).costs.mean())


def _against_best(run: ScoredFit, best: ScoredFit, intervals: RatioIntervals) -> tuple[Interval, bool | None]:
    """The paired difference in judged cost from the best run, and whether the two are practically equal, if known."""
    score, of_best = _judged(run), _judged(best)
    difference = intervals.difference(score.costs - of_best.costs, score.units)
    if difference.known is None:
        return difference, True if run is best else None
    # The standard error of the best mean cost by the sums over its units
    left = of_best.units.sums(of_best.costs - of_best.costs.mean())
    deviation = float(np.sqrt(len(left) / (len(left) - 1) * np.square(left).sum()) / len(of_best.costs))
    return difference, bool(difference.holds(0.0) or abs(difference.value) <= NEGLIGIBLE_SHARE * deviation)


def make_cells(judged: Sequence[ScoredFit], design: Mapping[str, Array]) -> tuple[Cell, ...]:
    """All cells, in the order of the fits. design: by robot, errors (Z, 3) of the design values."""
    groups: dict[tuple[str, str, str], dict[str, list[ScoredFit]]] = {}
    for each in judged:
        place = each.fit.robot.name, each.fit.training.name, each.fit.regime
        groups.setdefault(place, {}).setdefault(each.fit.label, []).append(each)
    cells = []
    for (robot, training_name, regime), of_methods in groups.items():
        fit = next(iter(of_methods.values()))[0].fit
        folds, runs = fit.training.folds, fit.robot.dataset.trajectories
        designs = np.broadcast_to(design[robot], (len(folds), *design[robot].shape))
        methods = {name: _method(name, fits) for name, fits in of_methods.items()}
        errors = {name: _by_seeds(fits, folds, designs) for name, fits in of_methods.items()}
        places = [(kind, False) for kind in fit.training.kinds]
        trained = dict.fromkeys(kind for fold in folds for kind in fold.fitted or ())
        places += [(kind, True) for kind in trained if regime == AS_RECORDED]
        for kind, fitted in places:
            listed = [
                (number, index)
                for number, fold in enumerate(folds)
                for index in ((fold.fitted or {}) if fitted else fold.judged).get(kind, ())
            ]
            numbers, indices = np.array(listed, dtype=int).T
            trained_in = tuple(folds[number].session for number in numbers)
            pairs = Pairs(numbers, indices, trained_in, tuple(runs[index].session for index in indices))
            in_cell = {}
            for name, method in methods.items():
                measured = [_measured(of_seed, pairs) for of_seed in errors[name]]
                means = {name: np.mean([of[name] for of in measured], axis=0) for name in results.MEASURES}
                in_cell[name] = replace(method, errors=means) if method.answers else method
            key = results.CellKey(robot, training_name, regime, kind, fitted)
            cells.append(Cell(key, pairs, _measured(designs, pairs), in_cell))
    return tuple(cells)


def _by_seeds(fits: Sequence[ScoredFit], folds: Sequence[Fold], designs: Array) -> list[Array]:
    """A method's errors (folds, Z, 3) by seed, the design's where it has no answer."""
    of_seeds = {each.fit.settings.seed: np.array(designs) for each in fits}
    numbers = {id(fold): number for number, fold in enumerate(folds)}
    for each in fits:
        if each.errors is not None:
            of_seeds[each.fit.settings.seed][numbers[id(each.fit.fold)]] = each.errors
    return list(of_seeds.values())


def _method(name: str, fits: Sequence[ScoredFit]) -> results.MethodInCell:
    """A method in all cells of its fits, without their errors."""
    answered = [each for each in fits if each.errors is not None]
    asked = [each.fit.settings for each in fits if not each.fit.refusal]
    return results.MethodInCell(
        method=name,
        family=fits[0].fit.entry.family,
        fits=len(fits),
        outcomes=Counter(str(each.result.outcome) for each in fits),
        reason=next((each.result.reason for each in fits if each.errors is None), ""),
        errors=None,
        seconds=_median(each.result.seconds for each in answered),
        numbers=answered[0].result.reason if answered else "",
        answers=len(answered),
        cost=", ".join(dict.fromkeys(settings.objective for settings in asked)),
        unidentified=", ".join(dict.fromkeys(settings.unidentified for settings in asked)),
        matrix=answered[0].result.matrix if answered else None,
    )


def _measured(errors: Array, pairs: Pairs) -> dict[Measure, Array]:
    """Eq. (6), distances (m) and headings (rad), (n,) each, from errors (folds, Z, 3)."""
    of_pairs = errors[pairs.folds, pairs.runs]
    return {
        "cost": np.linalg.norm(of_pairs, axis=1),
        "position": np.hypot(of_pairs[:, 0], of_pairs[:, 1]),
        "heading": np.abs(of_pairs[:, 2]),
    }


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


def ranking(cells: Sequence[Cell], methods: Sequence[str]) -> Ranking | None:
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


def profiles(cells: Sequence[Cell], methods: Sequence[str], factors: Array) -> dict[str, Array]:
    """Performance profiles: the share (F,) of cells in which a method's error is at most ``factors`` times the best.

    Of every method that was asked in all cells and answered in some.
    """
    shares = {}
    for name in methods:
        if not all(name in cell.methods for cell in cells):
            continue
        ratios = np.full(len(cells), np.inf)
        for number, cell in enumerate(cells):
            mean = cell.mean(name)
            if mean is not None:
                best = min(other for each in cell.methods.values() if (other := each.mean("cost")) is not None)
                ratios[number] = mean / best if best > 0 else 1.0
        if np.isfinite(ratios).any():
            shares[name] = np.mean(ratios[:, None] <= factors * (1 + 1e-12), axis=0)
    return shares
