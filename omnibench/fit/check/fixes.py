"""Command line that mends a finding: the import of its source, with more options beside those that were given."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np

from omnibench.data.checks.finding import Finding
from omnibench.data.checks.misread_search import Recorded
from omnibench.data.checks.misreading import as_yaml
from omnibench.data.dataset import Dataset
from omnibench.data.importer import Importer
from omnibench.data.storage import load_dataset
from omnibench.data.stored_rows import median_period
from omnibench.data.tables import dataset_folders, in_few_words
from omnibench.errors import ConfigError, DataError
from omnibench.files import check_source
from omnibench.registry import importers

_BAGS = (".mcap", ".bag", ".db3")
_ANY_RATE = 1e9  # rad/s: the option ``fastest`` with which rates in any unit are read
# Periods, s, of wheels and of poses that are more likely in another unit; chosen: no encoder is read less often.
_SLOWEST, _SLOWEST_POSES, _FASTEST = 1.5, 5.0, 3e-4
_UNITS = ("ms", "us")
_EXPLAINED = 0.35  # share of the way that the wheels may leave unexplained with the right unit of time; chosen
_RATES = {"rpm": 2 * 3.141592653589793 / 60, "deg/s": 3.141592653589793 / 180, "rev/s": 2 * 3.141592653589793}
_POSITIONS = {"deg/s": "deg", "rev/s": "rev"}
_HEADER = 10_000  # characters of a header that are looked at
_TABLES = 8  # whose headers are looked at
_IDENTITY = {"position_unit": "m", "heading_unit": "rad", "wheel_time_unit": "s", "pose_time_unit": "s"}
_COLUMNS = {"wheel_order": "wheel_columns", "steering_order": "steering_columns", "pose_order": "pose_columns"}


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
    settings = dict(options or {}) | ({"robot": str(robot)} if robot else {})
    places = dataset_folders(source)
    if len(places) > 1:
        if form or settings:
            raise ConfigError(
                f"{places[0]} and {len(places) - 1} more: an importer reads one source; import each by itself"
            )
        return replace(of_dataset(load_dataset(places)), places=tuple(places))
    (source,) = places
    check_source(source)
    name = form or recognised(source)
    is_dataset = name == "dataset" and not settings
    # Other units of time are tried where the source cannot be read, or makes no sense, in those given.
    try:
        dataset = load_dataset(source) if is_dataset else _read(name, source, settings)
    except DataError:
        if (mended := _by_other_times(name, source, settings)) is None:
            raise
    else:
        mended = _by_other_times(name, source, settings) if odd_times(dataset) else None
    if mended is not None:
        return replace(mended, folder=source) if is_dataset else mended
    return of_dataset(dataset, source) if is_dataset else RecordingSource(dataset, name, source, settings)


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


class CannotBeTypedError(Exception):
    """The importer of a recording has no option for a fix."""


def with_fixes(read: RecordingSource, findings: Sequence[Finding]) -> list[Finding]:
    """The findings, each with the command that mends it where there is one."""
    return [
        finding.model_copy(update={"fix": command(read, [finding])})
        if finding.changes and (not finding.fix or finding.severity == "error")
        else finding
        for finding in findings
    ]


def command(read: RecordingSource, findings: Sequence[Finding]) -> str:
    """The command line that reads a recording again, mended; of a data set in memory it says that it is to be saved."""
    changes = [finding.changes for finding in findings if finding.changes]
    if not changes:
        return ""
    if read.places:
        return f'for each in {in_few_words(read.places)}; do omnibench check "$each"; done'
    saved = "" if read.readable else f"  # after save_dataset(dataset, {str(read.source)!r})"
    target = _target(read)
    try:
        options = mended_options(read, read.importer, read.options, changes)
        return _import(read.importer, read.source, options, target) + saved
    except CannotBeTypedError:
        options = mended_options(read, "dataset", {}, changes)
    if read.folder is not None and (read.folder / "dataset.yaml").is_file():
        return _import("dataset", read.folder, options, _beside(read.folder)) + saved
    first = _import(read.importer, read.source, read.options, target)
    return f"{first} && {_import('dataset', target, options, _beside(target))}{saved}"


def next_command(read: RecordingSource) -> str:
    """The command line that goes on where nothing is to be mended: a data set is calibrated, a log imported first."""
    places = read.places or ([read.folder] if read.folder and (read.folder / "dataset.yaml").is_file() else [])
    if places:
        return f"omnibench calibrate {in_few_words(places)} -o calibration.yaml"
    return _import(read.importer, read.source, read.options, _target(read))


def _target(read: RecordingSource) -> Path:
    """The folder of the data set that is written."""
    if read.folder is None:
        return Path("data") / (read.source.stem or "recording")
    return _beside(read.folder) if read.importer == "dataset" else read.folder


def _beside(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}_mended")


def _import(importer: str, source: Path, options: Mapping[str, Any], output: Path) -> str:
    words = ["omnibench", "import", importer, str(source), "-o", str(output), "--force"]
    for key, value in options.items():
        words += ["--set", f"{key}={as_yaml(value)}"]
    return shlex.join(words)


def mended_options(
    read: RecordingSource, importer: str, given: Mapping[str, Any], changes: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """The options with all changes. CannotBeTypedError: the importer lacks one of them."""
    options = dict(given)
    for change in changes:
        for key, value in change.items():
            options = _with_change(read, importer, options, key, value)
    fields = importers.entry(importer).options.model_fields
    for key in options:
        if key not in fields:
            raise CannotBeTypedError(key)
    return options


def _with_change(
    read: RecordingSource, importer: str, options: Mapping[str, Any], key: str, value: Any
) -> dict[str, Any]:
    """The options after one change, relative to them."""
    robot = read.dataset.robot
    changed = dict(options)
    if key in _COLUMNS:
        changed = _permuted(read, importer, options, _COLUMNS[key], value)
        for option in ("wheel_signs", "ticks_per_turn", "gear_ratio") if key == "wheel_order" else ():
            if isinstance(options.get(option), list | tuple) and len(options[option]) == len(value):
                changed[option] = [options[option][column] for column in value]
    elif key in ("wheel_signs", "pose_signs"):
        changed[key] = _product(options.get(key), value)
    elif key == "rate_factors":
        changed |= _geared(options, value)
    elif key == "wheel_quantity":
        changed["wheel_unit"] = value
    elif key == "wheel_unit":
        changed |= _wheel_unit(options, value, len(robot.wheel_names))
    elif key == "steering_signs":
        changed["steering_signs"] = _product(options.get("steering_signs"), value)
        if options.get("steering_offsets_deg"):
            changed["steering_offsets_deg"] = _product(options["steering_offsets_deg"], value)
    elif key == "steering_factors":
        changed["steering_scale"] = _one_or_all(_product(options.get("steering_scale"), value))
    elif key == "steering_offsets_deg":
        offsets = zip(_listed(options.get(key), len(value), 0.0), value, strict=True)
        changed[key] = _one_or_all([round(present + offset, 3) for present, offset in offsets])
    elif key == "heading_offset_deg":
        changed[key] = round(float(options.get(key, 0.0)) + value, 3)
    elif key == "leave_out":
        before = options.get(key, [])
        changed[key] = [*([before] if isinstance(before, str) else before), *map(escape, value)]
    elif key in _IDENTITY and options.get(key) not in (None, _IDENTITY[key], value):
        raise CannotBeTypedError(key)
    else:
        changed[key] = value
    return changed


def _wheel_unit(options: Mapping[str, Any], unit: str, count: int) -> dict[str, Any]:
    present = options.get("wheel_unit", "rad/s")
    if present == "rad/s":
        return {"wheel_unit": unit}
    if present == "rad" and unit in _POSITIONS:
        return {"wheel_unit": _POSITIONS[unit]}
    return _geared(options, [float(f"{1 / _RATES[unit]:.6g}")] * count)


def _geared(options: Mapping[str, Any], factors: Sequence[float]) -> dict[str, Any]:
    """The option of the ticks, or of the gears, by which the wheels' rates become those divided by factors."""
    option = "ticks_per_turn" if options.get("ticks_per_turn") else "gear_ratio"
    return {option: _one_or_all(_product(options.get(option), factors))}


def _header_words(source: Path) -> set[str]:
    """Words of the first lines of a source's tables."""
    files = [source] if source.is_file() else sorted(source.rglob("*.csv"))
    words: set[str] = set()
    for file in files[:_TABLES]:
        with file.open(errors="replace") as lines:
            words |= set(re.split(r"[\s,;]+", lines.readline(_HEADER).strip()))
    return words


def _permuted(
    read: RecordingSource, importer: str, options: Mapping[str, Any], key: str, order: Sequence[int]
) -> dict[str, Any]:
    """The options with columns in another order. key: wheel_columns, steering_columns or pose_columns.

    CannotBeTypedError: the names of the columns are not known.
    """
    robot, mapping = read.dataset.robot, options.get("columns") or {}
    unit = str(options.get("wheel_unit", "rad/s"))
    by_unit = "omega_" if unit.endswith("/s") or unit == "rpm" else "ticks_" if "ticks" in unit else "phi_"
    names, prefix = {
        "wheel_columns": (robot.wheel_names, by_unit),
        "steering_columns": (robot.drive.steered, "steer_"),
        "pose_columns": (("x", "y", "theta"), ""),
    }[key]
    if importer == "dataset":
        columns = list(options.get(key) or names)
    elif importer == "csv":
        present = options.get(key) or [prefix + name for name in names]
        columns = [
            str(mapping.get(prefix + name) or mapping.get(name) or column)
            for name, column in zip(names, present, strict=True)
        ]
        if not options.get(key) and not set(columns) <= _header_words(read.source):
            raise CannotBeTypedError(key)
    else:
        raise CannotBeTypedError(key)
    changed = {**options, key: [columns[column] for column in order]}
    if mapping:
        others = {name: column for name, column in mapping.items() if str(column) not in columns}
        changed = {name: value for name, value in changed.items() if name != "columns"}
        changed |= {"columns": others} if others else {}
    return changed


def _listed(present: Any, count: int, default: float) -> list[float]:
    values = present if isinstance(present, list | tuple) else [] if present is None else [present]
    return list(values) * count if len(values) == 1 else list(values) or [default] * count


def _product(present: Any, factors: Sequence[float]) -> list[float]:
    count = max(len(factors), len(present) if isinstance(present, list | tuple) else 1)
    both = zip(_listed(present, count, 1), _listed(list(factors), count, 1), strict=True)
    return [
        value if isinstance(value, int) else float(f"{value:.6g}") for value in (one * other for one, other in both)
    ]


def _one_or_all(values: Sequence[float]) -> Any:
    """One value where all are the same."""
    return values[0] if len(set(values)) == 1 else list(values)
