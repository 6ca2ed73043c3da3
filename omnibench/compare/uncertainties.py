"""Uncertainty of a comparison's answers."""

from __future__ import annotations

from collections.abc import Sequence

from omnibench.compare.plan import UNBOUNDED, PlannedRun
from omnibench.compare.result import EntryStatistics, ScoredRun
from omnibench.fit.calibrator import RunResult
from omnibench.fit.uncertainty.uncertainty import NoCovarianceError, Uncertainty, uncertainty_of


def typical_uncertainties(
    plan: Sequence[PlannedRun],
    results: Sequence[RunResult],
    scored: Sequence[ScoredRun],
    statistics: Sequence[EntryStatistics],
) -> dict[tuple[str, str], Uncertainty]:
    """The uncertainty of every entry's typical run, by data set and label; none where its answer is no minimum."""
    typical = [entry.typical for entry in statistics]
    uncertainties = {}
    for run, result, done in zip(plan, results, scored, strict=True):
        if run.box_name == UNBOUNDED or not any(done is one for one in typical):
            continue
        try:
            uncertainties[run.dataset_name, run.label] = uncertainty_of(run.task.problem(), result)
        except NoCovarianceError:
            continue
    return uncertainties
