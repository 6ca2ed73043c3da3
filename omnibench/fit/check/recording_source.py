"""The recording that a check reads: a data set, or what an importer reads, with the options by which it was read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from omnibench.data.checks.finding import Finding
from omnibench.data.checks.misread_search import Recorded
from omnibench.data.dataset import Dataset
from omnibench.data.importer import Importer
from omnibench.data.storage import load_dataset
from omnibench.data.stored.dataset_folders import dataset_folders
from omnibench.data.stored.periods import median_period
from omnibench.errors import ConfigError, DataError
from omnibench.files import check_source
from omnibench.registry import importers

_BAGS = (".mcap", ".bag", ".db3")
_ANY_RATE = 1e9  # rad/s: the option ``fastest`` with which rates in any unit are read
# Periods, s, of wheels and of poses that are more likely in another unit; chosen: no encoder is read less often.
_SLOWEST, _SLOWEST_POSES, _FASTEST = 1.5, 5.0, 3e-4
_UNITS = ("ms", "us")
_EXPLAINED = 0.35  # share of the way that the wheels may leave unexplained with the right unit of time; chosen


@dataclass(frozen=True, eq=False)
class RecordingSource:
    """A data set and how it was read.

    importer, options: by which ``source`` is read again. folder: of the data set, where it is one. findings: those
    of reading it. in_memory: ``source`` is only where the data set would be saved, whatever stands there. places: the
    folders of a data set that are several.
    """

    dataset: Dataset
    importer: str
    source: Path
    options: Mapping[str, Any]
    folder: Path | None = None
    findings: tuple[Finding, ...] = field(default=())
    in_memory: bool = False
    places: tuple[Path, ...] = ()

    @property
    def readable(self) -> bool:
        """True if the source can be read again."""
        return not self.in_memory and self.source.exists()


def read_source(
    source: Path | Sequence[Path],
    form: str | None = None,
    options: Mapping[str, Any] | None = None,
    robot: Path | None = None,
) -> RecordingSource:
    """Read a data set folder, or several, or recordings with an importer, which is recognised unless it is given.

    DataError or ConfigError in one line where it cannot be read.
    """
    given = dict(options or {}) | ({"robot": str(robot)} if robot else {})
    places = dataset_folders(source)
    if len(places) > 1:
        if form or given:
            raise ConfigError(
                f"{places[0]} and {len(places) - 1} more: an importer reads one source; import each by itself"
            )
        return replace(of_dataset(load_dataset(places)), places=tuple(places))
    (source,) = places
    check_source(source)
    name = form or recognised(source)
    if name == "dataset" and not given:
        return _of_folder(source)
    return _imported(name, source, given)


def _of_folder(folder: Path) -> RecordingSource:
    """A data set folder, in other units of time if it cannot be read, or makes no sense, in s."""
    try:
        dataset = load_dataset(folder)
    except DataError:
        if (mended := _by_other_times("dataset", folder, {})) is None:
            raise
        return replace(mended, folder=folder)
    mended = _by_other_times("dataset", folder, {}) if odd_times(dataset) else None
    return of_dataset(dataset, folder) if mended is None else replace(mended, folder=folder)


def of_dataset(dataset: Dataset, folder: Path | None = None) -> RecordingSource:
    """A data set with the source and options that it was imported with, where it knows them."""
    place = folder or Path(dataset.name)
    imported = dataset.imported
    if imported is None or not Path(imported.source).exists():
        return RecordingSource(dataset, "dataset", place, {}, place, in_memory=folder is None)
    return RecordingSource(dataset, imported.importer, Path(imported.source), imported.options, place)


def recognised(source: Path) -> str:
    """The importer of a source, by its files. ConfigError: it is none that is known."""
    if (source / "dataset.yaml").is_file():
        return "dataset"
    if source.is_file():
        return "rosbag" if source.suffix in _BAGS else "csv"
    if (source / "metadata.yaml").is_file() or any(source.glob("*.mcap")) or any(source.glob("*.bag")):
        return "rosbag"
    for pattern, name in (
        ("command.csv", "table1"),
        ("*_metadata.csv", "optiodom"),
        ("*.csv", "csv"),
        ("*.txt", "csv"),
    ):
        if next(source.rglob(pattern), None) is not None:
            return name
    raise ConfigError(f"{source}: no recording is recognised there; name the importer with --format (omnibench list)")


def _imported(name: str, source: Path, given: Mapping[str, Any]) -> RecordingSource:
    """A source read by an importer, in other units of time if it cannot be read, or makes no sense, in those given."""
    try:
        dataset = _read(name, source, given)
    except DataError:
        if (mended := _by_other_times(name, source, given)) is None:
            raise
        return mended
    mended = _by_other_times(name, source, given) if odd_times(dataset) else None
    return mended or RecordingSource(dataset, name, source, given)


def _by_other_times(name: str, source: Path, given: Mapping[str, Any]) -> RecordingSource | None:
    """The source by the other units of time that make sense; None if none does."""
    for finding in other_times(name, given):
        if (mended := attempt(name, source, {**given, **finding.changes})) is not None:
            return RecordingSource(mended, name, source, given, findings=(finding,))
    return None


def _read(name: str, source: Path, given: Mapping[str, Any]) -> Dataset:
    """The data set of a source, also if its rates are too fast for any wheel, which is what a check tells then."""
    entry = importers.entry(name, "--format")
    options = entry.cls.completed(given, source)
    if "name" in entry.options.model_fields:
        options.setdefault("name", source.resolve().stem)

    def read(settings: Mapping[str, Any]) -> Dataset:
        importer: Importer = importers.create(name, settings)
        return importer.read(source)

    try:
        dataset = read(options)
    except DataError as refusal:
        if "fastest" in given or "fastest" not in entry.options.model_fields:
            raise
        try:
            dataset = read({**options, "fastest": _ANY_RATE})
        except DataError:
            raise refusal from None
    if not dataset.referenced:
        raise DataError(
            f"{source}: it has no reference poses; import it, which makes them from its scans, and check that"
        )
    return dataset


def attempt(name: str, source: Path, options: Mapping[str, Any]) -> Dataset | None:
    """The data set of a source by other options, if its times and its motion make sense then."""
    try:
        dataset = _read(name, source, options)
    except (DataError, ConfigError):
        return None
    if odd_times(dataset):
        return None
    fit = recorded(dataset).fit()
    return dataset if fit is not None and fit.left[0] < _EXPLAINED else None


def recorded(dataset: Dataset) -> Recorded:
    """The runs of a data set that have poses."""
    runs = [run for run in dataset.trajectories if run.has_poses]
    return Recorded(dataset.robot, [run.log(run.pose_times) for run in runs], [run.poses for run in runs])


def odd_times(dataset: Dataset) -> bool:
    """True if samples or poses follow each other so slowly, or so fast, that their times are likely in another unit."""
    posed = [run for run in dataset.trajectories if run.has_poses]
    wheels = median_period(dataset.trajectories)
    poses = float(np.median(np.concatenate([np.diff(run.pose_times) for run in posed]))) if posed else 1.0
    return wheels > _SLOWEST or wheels < _FASTEST or poses > _SLOWEST_POSES or poses < _FASTEST


def other_times(name: str, given: Mapping[str, Any]) -> Iterator[Finding]:
    """Findings that another unit of time would mend: of all times, of the poses' and of the wheels'."""
    fields = importers.entry(name).options.model_fields
    wheels, poses = "wheel_time_unit", "pose_time_unit"
    if wheels not in fields or poses not in fields:
        return
    for unit in _UNITS:
        yield _time_unit({wheels: unit, poses: unit})
        yield _time_unit({poses: unit})
        yield _time_unit({wheels: unit, poses: given.get(poses) or "s"})


def _time_unit(changes: Mapping[str, Any]) -> Finding:
    units = {key.split("_")[0]: value for key, value in changes.items() if value != "s"}
    which = (
        "all times" if len(units) == 2 else "the times of the wheels" if "wheel" in units else "the times of the poses"
    )
    unit = next(iter(units.values()))
    where = "the recording" if len(units) == 2 else "the reference" if "pose" in units else "all wheels"
    return Finding(
        kind="time_unit",
        what=f"{which} look like {unit}; they are read in s",
        where=where,
        severity="error",
        changes=changes,
    )
