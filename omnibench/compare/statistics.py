"""What can be said of the entries: medians over seeds, bootstrap intervals over trajectories, paired differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from omnibench.compare.config import Bootstrap
from omnibench.compare.result import EntryStatistics, Interval, ScoredRun
from omnibench.robot.kinematics import Array

# A difference below this share of the best cost's own standard error is of no practical interest.
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
        rivals = [run for (name, _), run in typical.items() if name == dataset and run is not None]
        best = _best(rivals, draws)
        statistics.append(_statistics(group, typical[dataset, label], best, draws))
    return tuple(statistics)


def _best(rivals: Sequence[ScoredRun], draws: _Draws) -> ScoredRun | None:
    """Noise does not choose between entries that are practically equal: the training cost does."""
    if not rivals:
        return None
    lowest = min(rivals, key=_judged_cost)
    level = [run for run in rivals if _against_best(run, lowest, draws)[1]]
    return min(level, key=lambda run: (run.record.train_cost or 0.0, _judged_cost(run)))


def is_mean(run: ScoredRun) -> bool:
    """Whether the run's cost is the mean of its trajectories' costs, as the intervals and differences suppose."""
    cost, costs = run.record.train_cost, run.train_costs
    return cost is None or costs is None or bool(np.isclose(costs.mean(), cost, rtol=1e-6, atol=0.0))


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
    train = None if typical is None else typical.train_costs
    validation = None if typical is None else typical.validation_costs
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
        train=_mean(train, draws),
        train_improvement=_improvement(train, group[0].theoretical_train_costs, draws),
        validation=_mean(validation, draws),
        validation_improvement=_improvement(validation, group[0].theoretical_validation_costs, draws),
        difference=difference,
        practically_equal=equal,
        is_best=typical is not None and typical is best,
        gap_median=float(np.median(gaps)) if gaps else None,
        proven_gap_median=float(np.median(proven)) if proven else None,
        evaluations_median=float(np.median([run.record.evaluations for run in group])),
        seconds_median=float(np.median([run.record.seconds for run in group])),
    )


class _Draws:
    """Bootstrap resamples of trajectories; the same for every entry, so that differences are paired."""

    def __init__(self, bootstrap: Bootstrap) -> None:
        self._bootstrap = bootstrap
        self._by_size: dict[int, NDArray[np.intp]] = {}

    def of(self, count: int) -> NDArray[np.intp]:
        """Indices (resamples, count) drawn with replacement."""
        if count not in self._by_size:
            rng = np.random.default_rng(self._bootstrap.seed)
            self._by_size[count] = rng.integers(count, size=(self._bootstrap.resamples, count))
        return self._by_size[count]

    def interval(self, count: int, value: float, statistic: Callable[[NDArray[np.intp]], Array]) -> Interval:
        low, high = np.percentile(statistic(self.of(count)), [2.5, 97.5])
        return Interval(value, float(low), float(high))


def _typical(group: Sequence[ScoredRun]) -> ScoredRun | None:
    """The run of median training cost (the worse one of two), of those with an answer."""
    answered = [run for run in group if run.record.train_cost is not None]
    ranked = sorted(answered, key=lambda run: (run.record.train_cost, run.record.seed))
    return ranked[len(ranked) // 2] if ranked else None


def _judged(run: ScoredRun) -> Array:
    costs = run.validation_costs if run.validation_costs is not None else run.train_costs
    assert costs is not None  # only runs with an answer are judged
    return costs


def _judged_cost(run: ScoredRun) -> float:
    return float(_judged(run).mean())


def _mean(costs: Array | None, draws: _Draws) -> Interval | None:
    if costs is None:
        return None
    return draws.interval(len(costs), float(costs.mean()), lambda chosen: costs[chosen].mean(1))


def _improvement(costs: Array | None, theoretical: Array | None, draws: _Draws) -> Interval | None:
    if costs is None or theoretical is None or not theoretical.any():
        return None
    return draws.interval(
        len(costs),
        float(1 - costs.mean() / theoretical.mean()),
        lambda chosen: 1 - costs[chosen].mean(1) / theoretical[chosen].mean(1),
    )


def _against_best(run: ScoredRun, best: ScoredRun, draws: _Draws) -> tuple[Interval, bool]:
    own, other = _judged(run), _judged(best)
    paired = own - other
    difference = draws.interval(len(paired), float(paired.mean()), lambda chosen: paired[chosen].mean(1))
    negligible = NEGLIGIBLE_SHARE * float(other.std(ddof=1)) / np.sqrt(len(other)) if len(other) > 1 else 0.0
    return difference, bool(difference.low <= 0 <= difference.high or abs(difference.value) <= negligible)
