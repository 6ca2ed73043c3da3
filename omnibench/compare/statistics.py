"""Statistics of the entries: medians over seeds, intervals over commands or runs, paired differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import itemgetter

import numpy as np

from omnibench.compare.result import EntryStatistics, EntryVerdict, ScoredRun, SplitScore, SplitStatistics
from omnibench.data.dataset import Dataset, Split
from omnibench.fit.evaluate import judge, nothing_held_out
from omnibench.fit.intervals import Bootstrap, Interval, RatioIntervals
from omnibench.fit.sessions import compare_sessions
from omnibench.registry import calibrators
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration

# Share of the standard error of the best cost: a smaller difference is of no practical interest (chosen).
NEGLIGIBLE_SHARE = 0.1


def entry_statistics(runs: Sequence[ScoredRun], bootstrap: Bootstrap) -> tuple[EntryStatistics, ...]:
    """Statistics of every entry on every data set, in the order of the runs.

    An entry is practically equal to another when the 95 % interval of the paired difference of their typical runs'
    validation costs (training costs where there is no validation split) contains zero, or the difference is below a
    tenth of the standard error of the other's cost; where there is no interval, that is undecided. The best entry of a
    data set has the lowest training cost among those that are not known to differ from the one of lowest validation
    cost.
    """
    groups: dict[tuple[str, str], list[ScoredRun]] = {}
    for run in runs:
        groups.setdefault((run.record.dataset, run.record.label), []).append(run)
    typical = {key: _typical(group) for key, group in groups.items()}
    intervals = RatioIntervals(bootstrap)
    statistics = []
    for (dataset, label), group in groups.items():
        competing = [run for (name, _), run in typical.items() if name == dataset and run is not None]
        best = _best(competing, intervals)
        median_run = typical[dataset, label]
        record = group[0].record
        costs = [run.record.train_cost for run in group if run.record.train_cost is not None]
        gaps = [run.record.gap for run in group if run.record.gap is not None]
        proven = [run.record.proven_gap for run in group if run.record.proven_gap is not None]
        difference, equal = None, None
        if median_run is not None and best is not None:
            difference, equal = _against_best(median_run, best, intervals)
        splits: dict[Split, SplitStatistics] = {}
        if median_run is not None:
            for split, score in median_run.scores.items():
                cost, designed = intervals.mean(score.costs, score.units), median_run.design[split].costs
                improvement = intervals.improvement(score.costs, designed, score.units, score.rounding)
                splits[split] = SplitStatistics(cost, improvement)
        records = [run.record for run in group]
        ratios = [each.seconds / each.reference_seconds for each in records if each.reference_seconds]
        statistics.append(
            EntryStatistics(
                dataset=record.dataset,
                label=record.label,
                calibrator=record.calibrator,
                parameterisation=record.parameterisation,
                box=record.box,
                runs=len(group),
                answers=len(costs),
                typical=median_run,
                train_median=float(np.median(costs)) if costs else None,
                train_spread=float(np.subtract(*np.percentile(costs, [75, 25]))) if costs else None,
                splits=splits,
                difference=difference,
                practically_equal=equal,
                is_best=median_run is not None and median_run is best,
                gap_median=float(np.median(gaps)) if gaps else None,
                proven_gap_median=float(np.median(proven)) if proven else None,
                evaluations_median=float(np.median([run.record.evaluations for run in group])),
                seconds_median=float(np.median([run.record.seconds for run in group])),
                reference_evaluations_median=float(np.median(ratios)) if ratios else None,
            )
        )
    return tuple(statistics)


def design_costs(runs: Sequence[ScoredRun], bootstrap: Bootstrap) -> dict[str, dict[Split, Interval]]:
    """The mean cost of the design values, by data set and split."""
    designs = {run.record.dataset: run.design for run in runs}
    intervals = RatioIntervals(bootstrap)
    return {
        dataset: {split: intervals.mean(score.costs, score.units) for split, score in design.items()}
        for dataset, design in designs.items()
    }


def held_out_verdicts(
    statistics: Sequence[EntryStatistics], datasets: Mapping[str, Dataset], bootstrap: Bootstrap
) -> dict[str, EntryVerdict]:
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
            verdicts[name] = EntryVerdict(label, verdict)
    return verdicts


def sessions_that_differ(datasets: Mapping[str, Dataset], integration: Integration) -> dict[str, tuple[str, ...]]:
    """By data set, sentences on sessions that differ or could not be compared by the design values (any would do)."""
    found = {
        name: compare_sessions(OdometryModel.of_design(dataset.robot, integration), dataset.trajectories)
        for name, dataset in datasets.items()
    }
    return {name: (*comparison.sentences, *comparison.doubts) for name, comparison in found.items()}


def is_mean(run: ScoredRun) -> bool:
    """True if the run's cost is the mean of its trajectories' costs, as the intervals and differences suppose."""
    train = run.scores.get("train")
    return train is None or bool(np.isclose(train.costs.mean(), train.cost, rtol=1e-6, atol=0.0))


def _best(competing: Sequence[ScoredRun], intervals: RatioIntervals) -> ScoredRun | None:
    """The run of lowest training cost among those practically equal to the one of lowest judged cost."""
    if not competing:
        return None
    lowest = min(competing, key=_judged_cost)
    rivals = [run for run in competing if _against_best(run, lowest, intervals)[1] is not False]
    return min(rivals, key=lambda run: (run.record.train_cost or 0.0, _judged_cost(run)))


def _typical(group: Sequence[ScoredRun]) -> ScoredRun | None:
    """The run of median training cost (the worse one of two), of those with an answer."""
    answered = [run for run in group if run.record.train_cost is not None]
    ranked = sorted(answered, key=lambda run: (run.record.train_cost, run.record.seed))
    return ranked[len(ranked) // 2] if ranked else None


def _judged(run: ScoredRun) -> SplitScore:
    """The score that an answer is judged by: on the validation split where there is one."""
    return run.scores["validation" if "validation" in run.scores else "train"]


def _judged_cost(run: ScoredRun) -> float:
    return float(_judged(run).costs.mean())


def _against_best(run: ScoredRun, best: ScoredRun, intervals: RatioIntervals) -> tuple[Interval, bool | None]:
    """The paired difference in judged cost from the best run, and whether the two are practically equal, if known."""
    score, of_best = _judged(run), _judged(best)
    difference = intervals.difference(score.costs - of_best.costs, score.units)
    if difference.known is None:
        return difference, True if run is best else None
    negligible = NEGLIGIBLE_SHARE * _standard_error(of_best)
    return difference, bool(difference.holds(0.0) or abs(difference.value) <= negligible)


def _standard_error(score: SplitScore) -> float:
    """The standard error of a mean cost by the sums over its units."""
    left = score.units.sums(score.costs - score.costs.mean())
    return float(np.sqrt(len(left) / (len(left) - 1) * np.square(left).sum()) / len(score.costs))
