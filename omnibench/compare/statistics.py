"""Statistics of the entries: medians over seeds, bootstrap intervals over trajectories, paired differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from omnibench.compare.config import Bootstrap
from omnibench.compare.result import EntryStatistics, Interval, ScoredRun, SplitStatistics
from omnibench.data.dataset import Split
from omnibench.robot.kinematics import Array

# Share of the standard error of the best cost: a smaller difference is of no practical interest (chosen).
NEGLIGIBLE_SHARE = 0.1


def entry_statistics(runs: Sequence[ScoredRun], bootstrap: Bootstrap) -> tuple[EntryStatistics, ...]:
    """Statistics of every entry on every data set, in the order of the runs.

    An entry is practically equal to another when the 95 % interval of the paired difference of their typical runs'
    validation costs (training costs where there is no validation split) contains zero, or the difference is below a
    tenth of the standard error of the other's cost. The best entry of a data set has the lowest training cost among
    those that are practically equal to the one of lowest validation cost.
    """
    groups: dict[tuple[str, str], list[ScoredRun]] = {}
    for run in runs:
        groups.setdefault((run.record.dataset, run.record.label), []).append(run)
    typical = {key: _typical(group) for key, group in groups.items()}
    draws = _Draws(bootstrap)
    statistics = []
    for (dataset, label), group in groups.items():
        competing = [run for (name, _), run in typical.items() if name == dataset and run is not None]
        best = _best(competing, draws)
        statistics.append(_statistics(group, typical[dataset, label], best, draws))
    return tuple(statistics)


def design_costs(runs: Sequence[ScoredRun], bootstrap: Bootstrap) -> dict[str, dict[Split, Interval]]:
    """The mean cost of the design values, by data set and split."""
    designs = {run.record.dataset: run.design for run in runs}
    draws = _Draws(bootstrap)
    return {
        dataset: {split: _mean(score.costs, draws) for split, score in design.items()}
        for dataset, design in designs.items()
    }


def is_mean(run: ScoredRun) -> bool:
    """True if the run's cost is the mean of its trajectories' costs, as the intervals and differences suppose."""
    train = run.scores.get("train")
    return train is None or bool(np.isclose(train.costs.mean(), train.cost, rtol=1e-6, atol=0.0))


def _best(competing: Sequence[ScoredRun], draws: _Draws) -> ScoredRun | None:
    """The run of lowest training cost among those practically equal to the one of lowest judged cost."""
    if not competing:
        return None
    lowest = min(competing, key=_judged_cost)
    level = [run for run in competing if _against_best(run, lowest, draws)[1]]
    return min(level, key=lambda run: (run.record.train_cost or 0.0, _judged_cost(run)))


def _statistics(
    group: Sequence[ScoredRun],
    typical: ScoredRun | None,
    best: ScoredRun | None,
    draws: _Draws,
) -> EntryStatistics:
    record = group[0].record
    costs = [run.record.train_cost for run in group if run.record.train_cost is not None]
    gaps = [run.record.gap for run in group if run.record.gap is not None]
    proven = [run.record.proven_gap for run in group if run.record.proven_gap is not None]
    difference, equal = None, None
    if typical is not None and best is not None:
        difference, equal = _against_best(typical, best, draws)
    return EntryStatistics(
        dataset=record.dataset,
        label=record.label,
        calibrator=record.calibrator,
        parameterisation=record.parameterisation,
        box=record.box,
        runs=len(group),
        answers=len(costs),
        typical=typical,
        train_median=float(np.median(costs)) if costs else None,
        train_spread=float(np.subtract(*np.percentile(costs, [75, 25]))) if costs else None,
        splits={} if typical is None else _by_split(typical, draws),
        difference=difference,
        practically_equal=equal,
        is_best=typical is not None and typical is best,
        gap_median=float(np.median(gaps)) if gaps else None,
        proven_gap_median=float(np.median(proven)) if proven else None,
        evaluations_median=float(np.median([run.record.evaluations for run in group])),
        seconds_median=float(np.median([run.record.seconds for run in group])),
    )


def _by_split(run: ScoredRun, draws: _Draws) -> dict[Split, SplitStatistics]:
    return {
        split: SplitStatistics(
            cost=_mean(score.costs, draws),
            improvement=_improvement(score.costs, run.design[split].costs, draws),
        )
        for split, score in run.scores.items()
    }


class _Draws:
    """Bootstrap resamples of trajectories, shared by all entries, so that differences are paired."""

    def __init__(self, bootstrap: Bootstrap) -> None:
        self._bootstrap = bootstrap
        self._by_size: dict[int, NDArray[np.intp]] = {}

    def of(self, count: int) -> NDArray[np.intp]:
        """Indices (resamples, count) of ``count`` trajectories, drawn with replacement."""
        if count not in self._by_size:
            rng = np.random.default_rng(self._bootstrap.seed)
            self._by_size[count] = rng.integers(count, size=(self._bootstrap.resamples, count))
        return self._by_size[count]

    def interval(self, count: int, value: float, statistic: Callable[[NDArray[np.intp]], Array]) -> Interval:
        """``value`` with the 2.5 and 97.5 percentiles of a statistic over the resamples of ``count`` trajectories."""
        low, high = np.percentile(statistic(self.of(count)), [2.5, 97.5])
        return Interval(value, float(low), float(high))


def _typical(group: Sequence[ScoredRun]) -> ScoredRun | None:
    """The run of median training cost (the worse one of two), of those with an answer."""
    answered = [run for run in group if run.record.train_cost is not None]
    ranked = sorted(answered, key=lambda run: (run.record.train_cost, run.record.seed))
    return ranked[len(ranked) // 2] if ranked else None


def _judged(run: ScoredRun) -> Array:
    """The costs (Z,) that an answer is judged by: validation costs where there are any."""
    return run.scores["validation" if "validation" in run.scores else "train"].costs


def _judged_cost(run: ScoredRun) -> float:
    return float(_judged(run).mean())


def _mean(costs: Array, draws: _Draws) -> Interval:
    return draws.interval(len(costs), float(costs.mean()), lambda chosen: costs[chosen].mean(1))


def _improvement(costs: Array, theoretical: Array, draws: _Draws) -> Interval | None:
    if not theoretical.any():
        return None
    return draws.interval(
        len(costs),
        float(1 - costs.mean() / theoretical.mean()),
        lambda chosen: 1 - costs[chosen].mean(1) / theoretical[chosen].mean(1),
    )


def _against_best(run: ScoredRun, best: ScoredRun, draws: _Draws) -> tuple[Interval, bool]:
    """The paired difference in judged cost from the best run, and whether the two are practically equal."""
    costs, best_costs = _judged(run), _judged(best)
    paired = costs - best_costs
    difference = draws.interval(len(paired), float(paired.mean()), lambda chosen: paired[chosen].mean(1))
    negligible = NEGLIGIBLE_SHARE * float(best_costs.std(ddof=1)) / np.sqrt(len(costs)) if len(costs) > 1 else 0.0
    return difference, bool(difference.low <= 0 <= difference.high or abs(difference.value) <= negligible)
