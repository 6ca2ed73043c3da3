"""A study, from the config to the report: each step is a line of ``run_study``.

Its folder has the effective config, summary.json, and one table with a row for each cell and method.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import polars as pl

from omnibench.compare.config import effective_cost, effective_options, load_calibrators
from omnibench.compare.execute import PRELOAD, execute, resumable
from omnibench.compare.output import check_output, prepare_output
from omnibench.config import read_model, read_yaml, to_json
from omnibench.environment import environment
from omnibench.errors import ConfigError, DataError, UnknownNameError, require_type
from omnibench.files import results_locked, write_table, write_text
from omnibench.fit.calibrator import RunResult
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import ResultStore
from omnibench.processes import one_thread_processes
from omnibench.progress import Reporter, no_progress
from omnibench.registry import PluginFailure
from omnibench.report.render import write_document
from omnibench.study.config import StudyConfig
from omnibench.study.report import study_document
from omnibench.study.study_plan import judge_fits, load_robots, plan_fits
from omnibench.study.study_result import CellRatio, MethodInCell, StudyCell, StudyResult, make_cells


def is_study(path: Path) -> bool:
    """True if a config names robots, as studies do. ConfigError: the file cannot be read."""
    content = read_yaml(path)
    return isinstance(content, Mapping) and "robots" in content


def read_study_config(path: Path | str, data: Mapping[str, Path] | None = None) -> StudyConfig:
    """Read a study's config; its paths come back absolute.

    data: the folder of the recordings in the place of the config's under the name "", that of one robot under its name.
    ConfigError in one line.
    """
    config = read_model(StudyConfig, Path(path))
    places = dict(data or {})
    base = places.pop("", config.data).resolve()
    robots = dict(config.robots)
    for name, place in places.items():
        if name not in robots:
            raise UnknownNameError("robot", name, robots, f"--data of {path}")
        robots[name] = robots[name].model_copy(update={"path": (str(place.resolve()),)})
    if not base.is_dir() and not all(Path(path).is_absolute() for robot in robots.values() for path in robot.path):
        raise ConfigError(
            f"{path}: the recordings are not at {base}; say where they are with --data DIR (omnibench guide data says "
            "where the public ones come from)"
        )
    return config.model_copy(update={"data": base, "robots": robots})


_COLUMNS: dict[str, Any] = {
    "robot": pl.String, "training": pl.String, "regime": pl.String, "judged": pl.String, "fitted": pl.Boolean,
    "simulated": pl.Boolean, "method": pl.String, "family": pl.String, "status": pl.String, "reason": pl.String,
    "fits": pl.Int64, "answers": pl.Int64, "runs": pl.Int64, "sessions": pl.Int64, "cost": pl.Float64,
    "position_m": pl.Float64, "heading_deg": pl.Float64, "design_cost": pl.Float64, "design_position_m": pl.Float64,
    "design_heading_deg": pl.Float64, "ratio": pl.Float64, "low": pl.Float64, "high": pl.Float64,
    "family_low": pl.Float64, "family_high": pl.Float64, "unit": pl.String, "units": pl.String, "seconds": pl.Float64,
    "numbers": pl.String,
    "cost_name": pl.String, "unidentified": pl.String, "matrix": pl.List(pl.Float64),
}  # fmt: skip


def write_results(result: StudyResult) -> None:
    """Write the table and summary.json. DataError: the disk refuses."""
    write_table(result.output / "study.parquet", study_table(result))
    write_text(result.output / "summary.json", to_json(summary(result)) + "\n")


def study_table(result: StudyResult) -> pl.DataFrame:
    """A row for each cell and method, those without an answer among them. Ratios are to the design values, Eq. (6)."""
    rows = [_row(result, cell, method) for cell in result.cells for method in cell.methods.values()] + [
        dict.fromkeys(_COLUMNS) | {"robot": name, "status": "recordings cannot be read", "reason": reason}
        for name, reason in result.broken.items()
    ]
    return pl.DataFrame(rows, _COLUMNS, orient="row")


def summary(result: StudyResult) -> dict[str, Any]:
    """The content of summary.json."""
    return {
        "name": result.config.name,
        "robots": {robot.name: {"runs": len(robot.dataset.trajectories), "simulated": robot.dataset.simulated}
                   for robot in result.robots},
        "broken": dict(result.broken),
        "reference": result.config.reference,
        "geometric_mean": result.geometric_mean,
        "against_best": [
            {"robot": each.cell.key.robot, "training": each.cell.key.training, "judged": each.cell.key.judged,
             "best": each.best, "ratio": each.ratio.value, "low": each.ratio.in_family.low,
             "high": each.ratio.in_family.high, "unit": each.ratio.unit, "verdict": each.ratio.verdict}
            for each in result.against_best
        ],
        "failures": list(result.failures),
        "warnings": list(result.warnings),
        "environment": result.environment.model_dump(),
    }  # fmt: skip


def _row(result: StudyResult, cell: StudyCell, method: MethodInCell) -> dict[str, Any]:
    key, robots = cell.key, {robot.name: robot for robot in result.robots}
    ratio: CellRatio | None = cell.against_design(method.method, len(result.judged_cells))
    heading = method.mean("heading")
    return {
        "robot": key.robot, "training": key.training, "regime": key.regime, "judged": key.judged, "fitted": key.fitted,
        "simulated": robots[key.robot].dataset.simulated, "method": method.method, "family": method.family,
        "status": method.status, "reason": method.reason, "fits": method.fits, "answers": method.answers,
        "runs": len(set(cell.pairs.runs.tolist())), "sessions": cell.pairs.sessions, "cost": method.mean("cost"),
        "position_m": method.mean("position"), "heading_deg": None if heading is None else math.degrees(heading),
        "design_cost": float(cell.design["cost"].mean()),
        "design_position_m": float(cell.design["position"].mean()),
        "design_heading_deg": math.degrees(float(cell.design["heading"].mean())),
        "ratio": ratio and ratio.value, "low": ratio and ratio.alone.low, "high": ratio and ratio.alone.high,
        "family_low": ratio and ratio.in_family.low, "family_high": ratio and ratio.in_family.high,
        "unit": ratio and ratio.unit, "units": ratio and ratio.units,
        "seconds": method.seconds if result.config.timing else None,
        "numbers": method.numbers, "cost_name": method.cost, "unidentified": method.unidentified,
        "matrix": None if method.matrix is None else method.matrix.ravel().tolist(),
    }  # fmt: skip


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
    check_output(output, config, "study", force=force)
    with ExitStack() as lock:
        if output is not None:
            lock.enter_context(results_locked(output))
        failures, config = _with_methods(config)
        robots, broken = load_robots(config, progress)
        if not robots:
            name, reason = next(iter(broken.items()))
            raise DataError(f"no robot's recordings can be read, the first: {name}: {reason}")
        fits = plan_fits(config, robots)
        folder = prepare_output(config, output, "study", force=force)
        if output is None:
            lock.enter_context(results_locked(folder))
        store = ResultStore(folder / "runs", RunResult)
        asked = {index: fit.run for index, fit in enumerate(fits) if fit.run is not None}
        plan = list(asked.values())
        with resumable(plan, store, folder, "fits"):
            with ExitStack() as opened:
                workers = config.workers or os.cpu_count() or 1
                choice = BackendChoice(name=config.backend, workers=workers, tls=config.tls)
                backend = opened.enter_context(open_backend(choice, PRELOAD, progress))
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
