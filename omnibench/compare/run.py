"""A comparison from config to report."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from omnibench.compare.config import CompareConfig
from omnibench.compare.execute import Progress, execute
from omnibench.compare.output import prepare_output, write_results
from omnibench.compare.plan import PlannedRun, effective_config, load_calibrators, load_datasets, make_plan
from omnibench.compare.report import write_report
from omnibench.compare.results import ComparisonResult
from omnibench.compare.scoring import score
from omnibench.compare.statistics import entry_statistics
from omnibench.compare.store import RunStore
from omnibench.environment import environment
from omnibench.errors import Interrupted
from omnibench.fit.calibrator import RunResult


class Silent:
    """Progress that nobody watches."""

    def planned(self, runs: int) -> None: ...
    def began(self, run: PlannedRun) -> None: ...
    def moved(self, run: PlannedRun, evaluations: int, best: float) -> None: ...
    def ended(self, run: PlannedRun, result: RunResult, reused: bool) -> None: ...


def run_comparison(
    config: CompareConfig, output: Path | None = None, progress: Progress | None = None
) -> ComparisonResult:
    """Run every calibrator of the config on every data set, score, and write the report.

    ``output``: a folder; runs that are there already are not run again. Raises ConfigError or DataError for what the
    user can put right, and Interrupted on Ctrl-C, when everything that had ended is kept.
    """
    failures = load_calibrators(config)
    config = effective_config(config)
    datasets = load_datasets(config)
    plan = make_plan(config, datasets)
    folder = prepare_output(config, output)
    results = _executed(plan, folder, progress or Silent(), config.workers or os.cpu_count() or 1)
    runs = score(plan, results, datasets)
    result = ComparisonResult(
        config=config,
        output=folder,
        datasets=datasets,
        runs=runs,
        statistics=entry_statistics(runs, config.bootstrap),
        environment=environment(),
        warnings=(
            *(f"plug-in {failure.origin} cannot be imported: {failure.error}" for failure in failures),
            *(f"data set {name}: {warning}" for name, dataset in datasets.items() for warning in dataset.warnings),
        ),
    )
    write_results(result)
    write_report(result, folder / "report.html")
    return result


def _executed(plan: Sequence[PlannedRun], folder: Path, progress: Progress, workers: int) -> list[RunResult]:
    store = RunStore(folder / "runs")
    try:
        return execute(plan, store, progress, workers)
    except KeyboardInterrupt:
        kept = sum(store.get(run.key) is not None for run in plan)
        message = f"interrupted; {kept} of {len(plan)} runs are kept in {folder}: run again with --output {folder}"
        raise Interrupted(message) from None
