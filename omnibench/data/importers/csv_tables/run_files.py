"""The files of wheels and of poses of every run under a source."""

from __future__ import annotations

from pathlib import Path

from omnibench.data.importers.csv_tables.csv_options import POSE_SUFFIXES, CsvOptions
from omnibench.errors import DataError


def find_runs(source: Path, options: CsvOptions) -> dict[str, tuple[Path, Path]]:
    """The files of wheels and of poses of every run by its name."""
    suffixes = (options.pose_suffix,) if options.pose_suffix else POSE_SUFFIXES
    if source.is_file():
        run = source.name.removesuffix(options.wheel_suffix)
        beside = [file for suffix in suffixes if (file := source.with_name(run + suffix)).is_file()]
        return {run if beside else source.stem: (source, beside[0] if beside else source)}
    wheels = {_run_name(file, source, options.wheel_suffix): file for file in source.rglob(f"*{options.wheel_suffix}")}
    poses = {
        _run_name(file, source, suffix): file for suffix in suffixes for file in sorted(source.rglob(f"*{suffix}"))
    }
    if not wheels:
        raise DataError(
            f"{source}: no *{options.wheel_suffix} below it; name the folder of the runs, or set wheel_suffix (and "
            "pose_suffix to the same where a file holds wheels and poses)"
        )
    for name in sorted(wheels):
        if name not in poses:
            missing = " or ".join(name + suffix for suffix in suffixes)
            raise DataError(f"{wheels[name]}: run {name!r} has no {missing}; set pose_suffix")
    for name in sorted(poses):
        if name not in wheels:
            raise DataError(f"{poses[name]}: run {name!r} has no {name}{options.wheel_suffix}; set wheel_suffix")
    return {name: (wheels[name], poses[name]) for name in sorted(wheels)}


def _run_name(file: Path, source: Path, suffix: str) -> str:
    return file.relative_to(source).as_posix().removesuffix(suffix)
