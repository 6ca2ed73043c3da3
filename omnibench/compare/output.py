"""The folder of a comparison: effective config, summary.json, tables, calibrations."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import asdict, fields
from datetime import datetime
from pathlib import Path
from typing import Any

import polars as pl

from omnibench.compare.config import CompareConfig
from omnibench.compare.results import ComparisonResult, EntryStatistics, Interval, ScoredRun
from omnibench.config import to_yaml
from omnibench.data.dataset import Dataset
from omnibench.errors import DataError
from omnibench.files import replacing, write_text
from omnibench.robot.calibration import Calibration, Provenance, write_calibration


def prepare_output(config: CompareConfig, folder: Path | None) -> Path:
    """The folder to write to, with the effective config in it.

    Default: ``results/<config name>/<time>``, with a link ``latest``. DataError when it cannot be written to, or
    holds another comparison.
    """
    if folder is None:
        parent = Path("results") / config.name
        folder = parent / datetime.now().strftime("%Y-%m-%dT%H-%M-%S")
        write_text(folder / "config.yaml", to_yaml(config))
        _link(parent / "latest", folder.name)
        return folder
    if folder.is_file():
        raise DataError(f"{folder}: is a file; name a folder for the results")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "config.yaml").is_file():
        raise DataError(f"{folder}: holds other files; name a new folder, or one of an earlier comparison")
    write_text(folder / "config.yaml", to_yaml(config))
    return folder


def write_results(result: ComparisonResult) -> None:
    """Write summary.json, the tables and the calibration of every entry's typical run."""
    write_text(result.output / "summary.json", json.dumps(summary(result), indent=1, allow_nan=False) + "\n")
    for name, rows in (
        ("runs", [_run_row(run) for run in result.runs]),
        ("errors", list(_error_rows(result))),
        ("history", list(_history_rows(result.runs))),
        ("statistics", [_statistics_row(entry) for entry in result.statistics]),
    ):
        with replacing(result.output / f"{name}.parquet") as partial:
            pl.DataFrame(rows, infer_schema_length=None).write_parquet(partial)
    for entry in result.statistics:
        if entry.typical is not None and entry.calibrator != "theoretical":
            file = re.sub(r"[^A-Za-z0-9_.-]+", "_", f"{entry.dataset}-{entry.label}").strip("_")
            calibration = calibration_of(entry.typical, result)
            write_calibration(calibration, result.output / "calibrations" / f"{file}.yaml")


def summary(result: ComparisonResult) -> dict[str, Any]:
    """The content of summary.json."""
    return {
        "name": result.config.name,
        "dataset": ", ".join(result.datasets),
        "simulated": {name: dataset.simulated for name, dataset in result.datasets.items()},
        "cost": result.config.cost.name,
        "integration": result.config.integration,
        "budget": result.config.budget.model_dump(),
        "runs": [run.record.model_dump(mode="json") for run in result.runs],
        "statistics": [_statistics_row(entry) for entry in result.statistics],
        "warnings": list(result.warnings),
        "environment": result.environment.model_dump(),
    }


def calibration_of(run: ScoredRun, result: ComparisonResult) -> Calibration:
    """The calibration file of a run with an answer."""
    dataset: Dataset = result.datasets[run.record.dataset]
    assert run.record.matrix is not None  # only runs with an answer are written
    return Calibration(
        name=f"{run.record.dataset} {run.record.label}",
        robot=dataset.robot,
        sample_period=dataset.sample_period,
        matrix=run.record.matrix,
        integration=result.config.integration,
        provenance=Provenance(
            dataset=dataset.name,
            dataset_hash=dataset.hash,
            simulated=dataset.simulated,
            calibrator=run.record.calibrator,
            options=run.record.options,
            seed=run.record.seed,
            cost=result.config.cost.name,
            box=run.record.box,
            versions=result.environment.versions,
            training_cost=run.record.train_cost,
            validation_cost=run.record.validation_cost,
            outcome=run.record.outcome,
            reason=run.record.reason,
        ),
    )


def _link(link: Path, target: str) -> None:
    """Point ``link`` at the newest results; without links in the file system it is left out."""
    temporary = link.with_name(f".{link.name}.{target}")
    try:
        temporary.symlink_to(target, target_is_directory=True)
        temporary.replace(link)
    except OSError:
        temporary.unlink(missing_ok=True)


def _run_row(run: ScoredRun) -> dict[str, Any]:
    row = run.record.model_dump(mode="json")
    for name in ("options", "parameters"):  # nested values of no fixed shape
        row[name] = json.dumps(row[name])
    return row


def _statistics_row(entry: EntryStatistics) -> dict[str, Any]:
    values = {item.name: getattr(entry, item.name) for item in fields(entry) if item.name != "typical"}
    row = {name: asdict(value) if isinstance(value, Interval) else value for name, value in values.items()}
    return row | {"typical_seed": None if entry.typical is None else entry.typical.record.seed}


def _error_rows(result: ComparisonResult) -> Iterable[dict[str, Any]]:
    for run in result.runs:
        for split, errors, costs in (
            ("train", run.train_errors, run.train_costs),
            ("validation", run.validation_errors, run.validation_costs),
        ):
            if errors is None or costs is None:
                continue
            trajectories = result.datasets[run.record.dataset].split("train" if split == "train" else "validation")
            for trajectory, error, cost in zip(trajectories, errors.tolist(), costs.tolist(), strict=True):
                yield {
                    "dataset": run.record.dataset,
                    "label": run.record.label,
                    "seed": run.record.seed,
                    "split": split,
                    "trajectory": trajectory.id,
                    "command": trajectory.command,
                    "x_error_m": error[0],
                    "y_error_m": error[1],
                    "heading_error_rad": error[2],
                    "cost": cost,
                }


def _history_rows(runs: Iterable[ScoredRun]) -> Iterable[dict[str, Any]]:
    for run in runs:
        for step in run.history:
            yield {
                "dataset": run.record.dataset,
                "label": run.record.label,
                "seed": run.record.seed,
                "evaluations": step.evaluations,
                "seconds": step.seconds,
                "best_cost": step.cost,
            }
