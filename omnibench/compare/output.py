"""The folder of a comparison: effective config, summary.json, tables, calibrations."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, fields
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Any, get_type_hints

import polars as pl

from omnibench import files as disk
from omnibench.compare.config import THEORETICAL_NAME, CompareConfig
from omnibench.compare.result import Cell, ComparisonResult, EntryStatistics, MethodInCell, RunRecord, ScoredFit
from omnibench.config import read_yaml, to_json, to_yaml
from omnibench.data.dataset import SPLITS, Dataset
from omnibench.errors import DataError
from omnibench.fit.calibrator import calibration_of_fit
from omnibench.fit.intervals import Interval
from omnibench.fit.prior import mount_is_fitted
from omnibench.fit.uncertainty import NoCovarianceError, physical_parameters, uncertainty_of
from omnibench.registry import calibrators
from omnibench.robot.calibration import Calibration, ModelExtension, Row, covariance_rows, write_calibration
from omnibench.robot.physical import PhysicalParameter

# First line of config.yaml in a folder of results. A folder whose config.yaml lacks it is not written to.
_MARK = "# The effective config of a {}; the results beside it were made with it."


def _noun(config: CompareConfig) -> str:
    return "study" if config.robots else "comparison"


def check_output(folder: Path | None, config: CompareConfig, *, force: bool = False) -> None:
    """Check the folder of results before the work.

    DataError: it is a file, or it holds anything but an earlier one of the same name, and not ``force``.
    """
    if folder is None:
        return
    noun = _noun(config)
    disk.check_results_folder(folder, _MARK.format(noun), noun, force=force)
    if force or not (folder / "config.yaml").is_file():
        return
    earlier = read_yaml(folder / "config.yaml")
    name, others = earlier.get("name"), earlier.get("datasets") or {}
    if name != config.name:
        raise DataError(f"{folder}: holds the {noun} {name!r}; name another folder for {config.name!r}, or --force")
    if config.datasets and not set(others) & set(config.datasets):
        raise DataError(
            f"{folder}: holds a comparison on {', '.join(map(repr, others))}; name another folder for "
            f"{', '.join(map(repr, config.datasets))}, or --force"
        )


def prepare_output(config: CompareConfig, folder: Path | None, *, force: bool = False) -> Path:
    """The folder to write to, with the effective config in it.

    Default: ``results/<config name>/<time>``, with a link ``latest``. DataError when it cannot be written to, or as
    ``check_output`` does.
    """
    check_output(folder, config, force=force)
    chosen = folder or disk.new_results_folder(disk.RESULTS / config.name)
    disk.write_text(chosen / "config.yaml", f"{_MARK.format(_noun(config))}\n{to_yaml(config)}")
    if folder is None:
        disk.link_latest(chosen)
    return chosen


def write_results(result: ComparisonResult) -> None:
    """Write summary.json, the tables and the calibration of every entry's typical run."""
    # The calibration files of an earlier comparison in the folder: the config may have other entries now
    try:
        rows = json.loads((result.output / "summary.json").read_text(encoding="utf-8"))["statistics"]
        written = [row for row in rows if row["answers"] and row["calibrator"] != THEORETICAL_NAME]
        before = [(row["dataset"], row["label"]) for row in written]
    except (OSError, ValueError, KeyError, TypeError):
        before = []
    earlier = _calibration_files(result.output, before)
    disk.write_text(result.output / "summary.json", to_json(summary(result)) + "\n")
    for name, make in result_tables(result).items():
        disk.write_table(result.output / f"{name}.parquet", make())
    for file in earlier.values():
        disk.remove(file)
    fitted = _fitted(result)
    for key, file in _calibration_files(result.output, fitted).items():
        write_calibration(calibration_of(fitted[key], result), file)


def calibration_file(result: ComparisonResult, dataset: str, label: str) -> Path | None:
    """The file with the calibration of an entry's typical run; None for one that has none."""
    return _calibration_files(result.output, _fitted(result)).get((dataset, label))


def _fitted(result: ComparisonResult) -> dict[tuple[str, str], ScoredFit]:
    """The typical runs that have a calibration file, by data set and label."""
    return {
        (entry.dataset, entry.label): entry.typical
        for entry in result.statistics
        if entry.typical is not None and entry.calibrator != THEORETICAL_NAME
    }


def _calibration_files(folder: Path, entries: Iterable[tuple[str, str]]) -> dict[tuple[str, str], Path]:
    """The calibration files of entries, which are given by data set and label."""
    known = list(entries)
    names = file_names(f"{dataset}-{label}" for dataset, label in known)
    return {entry: folder / "calibrations" / f"{name}.yaml" for entry, name in zip(known, names, strict=True)}


def file_names(texts: Iterable[str]) -> list[str]:
    """Names for files or folders of some texts, in their order; they differ by more than case."""
    chosen: list[str] = []
    for text in texts:
        plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", text).strip("_.") or "entry"
        names = chain([plain], (f"{plain}-{number}" for number in count(2)))
        taken = {name.lower() for name in chosen}
        chosen.append(next(name for name in names if name.lower() not in taken))
    return chosen


def summary(result: ComparisonResult) -> dict[str, Any]:
    """The content of summary.json."""
    return {
        "name": result.config.name,
        **(_of_robots(result) if result.config.robots else _of_datasets(result)),
        "warnings": list(result.warnings),
        "environment": result.environment.model_dump(),
    }


def _of_robots(result: ComparisonResult) -> dict[str, Any]:
    return {
        "robots": {
            name: {"runs": len(dataset.trajectories), "simulated": dataset.simulated}
            for name, dataset in result.datasets.items()
        },
        "broken": dict(result.broken),
        "reference": result.config.reference,
        "geometric_mean": result.geometric_mean,
        "against_best": [
            {name: getattr(each.cell.key, name) for name in ("robot", "training", "judged")}
            | {
                "best": each.best,
                "ratio": each.ratio.value,
                "low": each.ratio.in_family.low,
                "high": each.ratio.in_family.high,
                "unit": each.ratio.unit,
                "verdict": each.ratio.verdict,
            }
            for each in result.against_best
        ],
        "failures": list(result.failures),
    }


def _of_datasets(result: ComparisonResult) -> dict[str, Any]:
    # The units and the method of the intervals of each data set and split
    designs = {run.record.dataset: run.design for run in result.runs}
    return {
        "dataset": ", ".join(result.datasets),
        "simulated": {name: dataset.simulated for name, dataset in result.datasets.items()},
        "cost": result.config.cost_name,
        **({} if result.config.loss == "squares" else {"loss": result.config.loss}),
        "integration": result.config.integration,
        "budget": result.config.budget.model_dump(),
        "runs": [run.record.model_dump(mode="json") for run in result.runs],
        "statistics": [_statistics_row(entry) for entry in result.statistics],
        "intervals": {
            name: {
                split: {"unit": score.units.name, "units": score.units.count, "method": score.units.method}
                for split, score in design.items()
            }
            for name, design in designs.items()
        },
        "held_out": {name: {"label": each.label} | each.verdict.model_dump() for name, each in result.held_out.items()},
        "sessions": {name: list(sentences) for name, sentences in result.sessions.items()},
        "certificates": [certificate.model_dump() for certificate in result.certificates],
    }


def calibration_of(run: ScoredFit, result: ComparisonResult) -> Calibration:
    """The calibration file of a run with an answer."""
    dataset: Dataset = result.datasets[run.record.dataset]
    assert run.matrix is not None  # only runs with an answer are written
    # How sure the answer is, and what it means
    uncertainty, parameters = None, dict[str, PhysicalParameter]()
    if run.result.vector is not None:
        problem, settings, cls = run.fit.problem(), run.fit.settings, calibrators.entry(run.fit.settings.calibrator).cls
        if cls.fitted:
            with suppress(NoCovarianceError):  # it is no minimum
                uncertainty = uncertainty_of(problem, run.result)
        effects = run.result.extension.effects if run.result.extension else ()
        asked = None if cls.as_is else settings.mount  # of which an answer that stands as it is knows nothing
        fitted = mount_is_fitted(dataset.robot, asked, by_prior=cls.weighs_design and settings.tolerance is None)
        reading = physical_parameters(problem, run.result, uncertainty, effects, fitted_mount=fitted)
        parameters = {each.name: each for each in reading.parameters}
    covariance = covariance_rows(uncertainty.covariance) if uncertainty else None
    extension = run.result.extension or ModelExtension(effects=(), covariance=covariance)
    of_record = {"calibrator", "options", "seed", "box", "outcome", "reason"}
    provenance = run.record.model_dump(include=of_record) | {
        "cost": run.fit.settings.cost.name,
        "loss": None if result.config.loss == "squares" else result.config.loss,
        "on_bounds": run.record.at_bounds,
        "versions": result.environment.versions,
        "training_cost": run.record.train_cost,
        "validation_cost": run.record.validation_cost,
    }
    return calibration_of_fit(
        f"{run.record.dataset} {run.record.label}",
        dataset,
        run.matrix,
        provenance,
        integration=result.config.integration,
        noise=uncertainty.noise if uncertainty else run.result.noise if run.result.extension else None,
        parameters=parameters,
        **dict(extension),
    )


# Column types, for columns in which every value may be missing.
_RUN = {"dataset": pl.String, "label": pl.String, "seed": pl.Int64}
_HISTORY_COLUMNS = _RUN | {"evaluations": pl.Int64, "seconds": pl.Float64, "best_cost": pl.Float64}
_ERROR_COLUMNS = (
    _RUN
    | {"split": pl.String, "trajectory": pl.String, "command": pl.String}
    | dict.fromkeys(("x_error_m", "y_error_m", "heading_error_rad", "cost"), pl.Float64)
)
_COLUMN_OF: dict[Any, Any] = {
    float | None: pl.Float64,
    str | None: pl.String,
    bool | None: pl.Boolean,
    tuple[str, ...]: pl.List(pl.String),
    tuple[Row, Row, Row] | None: pl.List(pl.List(pl.Float64)),
    Interval | None: pl.Struct(dict.fromkeys(("value", "low", "high"), pl.Float64)),
}
_INTERVAL_COLUMNS = {name: _COLUMN_OF[Interval | None] for split in SPLITS for name in (split, f"{split}_improvement")}


_CELL_COLUMNS: dict[str, Any] = {
    "robot": pl.String, "training": pl.String, "regime": pl.String, "judged": pl.String, "fitted": pl.Boolean,
    "simulated": pl.Boolean, "method": pl.String, "family": pl.String, "status": pl.String, "reason": pl.String,
    "fits": pl.Int64, "answers": pl.Int64, "runs": pl.Int64, "sessions": pl.Int64, "cost": pl.Float64,
    "position_m": pl.Float64, "heading_deg": pl.Float64, "design_cost": pl.Float64, "design_position_m": pl.Float64,
    "design_heading_deg": pl.Float64, "ratio": pl.Float64, "low": pl.Float64, "high": pl.Float64,
    "family_low": pl.Float64, "family_high": pl.Float64, "unit": pl.String, "units": pl.String, "seconds": pl.Float64,
    "numbers": pl.String,
    "cost_name": pl.String, "unidentified": pl.String, "matrix": pl.List(pl.Float64),
}  # fmt: skip


def result_tables(result: ComparisonResult) -> dict[str, Callable[[], pl.DataFrame]]:
    """Makers of the tables beside the report: study; of data sets also statistics, runs, errors and history."""
    makers: dict[str, Callable[[ComparisonResult], pl.DataFrame]] = {"study": cell_table}
    if result.config.datasets:
        makers = {"statistics": _statistics, "runs": _runs, "errors": _errors, "history": _history} | makers
    return {name: partial(make, result) for name, make in makers.items()}


def cell_table(result: ComparisonResult) -> pl.DataFrame:
    """A row for each cell and method, those without an answer among them. Ratios are to the design values, Eq. (6)."""
    rows = [_cell_row(result, cell, method) for cell in result.cells for method in cell.methods.values()] + [
        dict.fromkeys(_CELL_COLUMNS) | {"robot": name, "status": "recordings cannot be read", "reason": reason}
        for name, reason in result.broken.items()
    ]
    return pl.DataFrame(rows, _CELL_COLUMNS, orient="row")


def _cell_row(result: ComparisonResult, cell: Cell, method: MethodInCell) -> dict[str, Any]:
    ratio = cell.ratio(method.method, cells=len(result.judged_cells))
    heading = method.mean("heading")
    return asdict(cell.key) | {
        "simulated": result.datasets[cell.key.robot].simulated, "method": method.method, "family": method.family,
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


def _runs(result: ComparisonResult) -> pl.DataFrame:
    rows = [run.record.model_dump(mode="json") for run in result.runs]
    nested = ("options", "parameters")  # of no fixed shape
    return _table([row | {name: json.dumps(row[name]) for name in nested} for row in rows], RunRecord)


def _statistics(result: ComparisonResult) -> pl.DataFrame:
    return _table([_statistics_row(entry) for entry in result.statistics], EntryStatistics, _INTERVAL_COLUMNS)


def _errors(result: ComparisonResult) -> pl.DataFrame:
    rows = [
        (*_key(run), split, trajectory.id, trajectory.command, *error, cost)
        for run in result.runs
        for split, score in run.scores.items()
        for trajectory, error, cost in zip(
            run.fit.robot.dataset.split(split), score.errors.tolist(), score.costs.tolist(), strict=True
        )
    ]
    return pl.DataFrame(rows, _ERROR_COLUMNS, orient="row")


def _history(result: ComparisonResult) -> pl.DataFrame:
    rows = [
        (*_key(run), step.evaluations, step.seconds, step.cost) for run in result.runs for step in run.result.history
    ]
    return pl.DataFrame(rows, _HISTORY_COLUMNS, orient="row")


def _table(rows: list[dict[str, Any]], kind: type, further: Mapping[str, Any] | None = None) -> pl.DataFrame:
    """At least one row made from objects of a class; ``further``: types of columns that are no fields of it."""
    hints = get_type_hints(kind, include_extras=True).items()
    types = {name: _COLUMN_OF[hint] for name, hint in hints if hint in _COLUMN_OF and name in rows[0]}
    types |= further or {}
    return pl.DataFrame(rows, schema_overrides=types, infer_schema_length=None)


def _statistics_row(entry: EntryStatistics) -> dict[str, Any]:
    """An entry's statistics as a flat row, with two columns of intervals for each split."""
    row: dict[str, Any] = {}
    for name in (item.name for item in fields(entry)):
        if name == "costs":
            for split in SPLITS:
                row[split] = _interval_cell(entry.cost(split))
                row[f"{split}_improvement"] = _interval_cell(entry.improvement(split))
        elif name not in ("typical", "improvements"):
            value = getattr(entry, name)
            row[name] = _interval_cell(value) if isinstance(value, Interval) else value
    return row | {"typical_seed": None if entry.typical is None else entry.typical.record.seed}


def _interval_cell(interval: Interval | None) -> dict[str, float | None] | None:
    return None if interval is None else asdict(interval)


def _key(run: ScoredFit) -> tuple[str, str, int]:
    return run.record.dataset, run.record.label, run.record.seed
