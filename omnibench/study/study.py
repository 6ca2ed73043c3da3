"""A study, from the config to the report: each step is a line of ``run_study``."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from omnibench.compare.effective_config import effective_cost, effective_options, load_calibrators
from omnibench.compare.execute import PRELOAD, execute, resumable
from omnibench.environment import environment
from omnibench.errors import DataError, require_type
from omnibench.files import results_locked
from omnibench.fit.calibrator import RunResult
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.result_store import ResultStore
from omnibench.processes import one_thread_processes
from omnibench.progress import Reporter, no_progress
from omnibench.registry import PluginFailure
from omnibench.report.render import write_document
from omnibench.study.cells import make_cells
from omnibench.study.config import StudyConfig
from omnibench.study.judging import judge_fits
from omnibench.study.report.study_report import study_document
from omnibench.study.study_output import check_output, prepare_output, write_results
from omnibench.study.study_plan import load_robots, plan_fits
from omnibench.study.study_result import StudyResult


def run_study(
    config: StudyConfig, output: Path | None = None, progress: Reporter = no_progress, *, force: bool = False
) -> StudyResult:
    """Fit every method on every training set of every robot, judge the answers, and write table and report.

    output: the folder of results; fits whose results are there are not repeated. progress: told of reading, of every
    fit and of judging. force: write into a folder with other files.

    ConfigError or DataError: the config or the folder is unfit, no robot's recordings can be read, or the disk refuses.
    Interrupted: Ctrl-C; the results of all fits that had ended are kept.
    """
    require_type(config, StudyConfig, "study.read_study_config")
    check_output(output, config, force=force)
    with ExitStack() as lock:
        if output is not None:
            lock.enter_context(results_locked(output))
        failures, config = _with_methods(config)
        robots, broken = load_robots(config, progress)
        if not robots:
            name, reason = next(iter(broken.items()))
            raise DataError(f"no robot's recordings can be read, the first: {name}: {reason}")
        fits = plan_fits(config, robots)
        folder = prepare_output(config, output, force=force)
        if output is None:
            lock.enter_context(results_locked(folder))
        store = ResultStore(folder / "runs", RunResult)
        asked = {index: fit.run for index, fit in enumerate(fits) if fit.run is not None}
        plan = list(asked.values())
        with resumable(plan, store, folder, "fits"):
            with ExitStack() as opened:
                backend = opened.enter_context(open_backend(_backend(config), PRELOAD, progress))
                opened.enter_context(one_thread_processes(PRELOAD))
                results = dict(zip(asked, execute(plan, store, progress, backend), strict=True))
            judged, design = judge_fits(fits, results, config.integration, progress)
            result = StudyResult(
                config=config,
                output=folder,
                robots=robots,
                broken=broken,
                fits=judged,
                cells=make_cells(judged, design),
                environment=environment(),
                warnings=(
                    *(f"plug-in {each.origin} cannot be imported: {each.error}" for each in failures),
                    *(f"{robot.name}: {warning}" for robot in robots for warning in robot.dataset.warnings),
                ),
            )
            write_results(result)
            write_document(study_document(result), folder / "report.html")
        return result


def _with_methods(config: StudyConfig) -> tuple[list[PluginFailure], StudyConfig]:
    """Load the plug-ins; the config with every default of every option. ConfigError: an unknown name or option.

    The fits of a plug-in that cannot be imported, or whose constructor raises, fail with that error.
    """
    failures = load_calibrators(config.plugins, [method.name for method in config.methods])
    methods = []
    for index, method in enumerate(config.methods):
        place = f"config {config.name}: methods.{index}"
        options = effective_options(method.name, method.options, place)
        changes: dict[str, Any] = {"options": options.model_dump(mode="json")}
        if method.cost is not None:
            changes["cost"] = effective_cost(method.cost, place)
        methods.append(method.model_copy(update=changes))
    return failures, config.model_copy(update={"methods": tuple(methods)})


def _backend(config: StudyConfig) -> BackendChoice:
    return BackendChoice(name=config.backend, workers=config.workers or os.cpu_count() or 1, tls=config.tls)
