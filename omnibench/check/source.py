"""A recording and the options by which it was read: read otherwise, and the one command that reads it so."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np

from omnibench.check.hypotheses import FEWEST_TICKS, RATE_UNITS
from omnibench.check.misreadings import Recorded
from omnibench.config import as_yaml, validate
from omnibench.data.dataset import Dataset
from omnibench.data.finding import Finding, error
from omnibench.data.importers.dataset_folder import DatasetOptions, importer_of, read_dataset, recordings_of
from omnibench.data.recording import Recording
from omnibench.data.recording_options import ReferenceOptions, quantity_of
from omnibench.data.runs import dataset_of
from omnibench.data.storage import dataset_folders, in_few_words, load_dataset
from omnibench.data.stored import median_period
from omnibench.errors import ConfigError, DataError
from omnibench.files import check_source
from omnibench.registry import importers

_BAGS = (".mcap", ".bag", ".db3")
_FILES = {"command.csv": "table1", "*_metadata.csv": "optiodom", "*.csv": "csv", "*.txt": "csv"}  # names of importers
_ANY_RATE = 1e9  # rad/s: the option ``fastest`` with which rates in any unit are read
# Periods, s, of wheels and of poses that are more likely in another unit; chosen: no encoder is read less often.
_SLOWEST, _SLOWEST_POSES, _FASTEST = 1.5, 5.0, 3e-4
_FEWEST_POSITIONS = 5  # positions of a run without poses, of fewer it is not compared with the wheels; chosen
_UNEXPLAINED = 0.35  # share of the way that wheels may not explain in the right unit of time; chosen
_COLUMNS = {"wheel_order": ("joints", "wheel_columns"), "steering_order": ("steering_joints", "steering_columns")}


@dataclass(frozen=True, eq=False)
class RecordingSource:
    """A data set and how it was read.

    importer, options: by which ``source`` is read again. folder: of the data set, where it is one. findings: those of
    reading it. in_memory: ``source`` is only where the data set would be saved, whatever stands there. places: the
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

    @cached_property
    def reading(self) -> tuple[list[Recording], ReferenceOptions] | None:
        """The recordings as their reader gives them, and the options; None if the source cannot be read again."""
        if self.places:
            return None
        try:
            if not self.readable:
                return _of_runs(self.dataset, {})
            importer, again = importer_of(self.importer, self.source, self.options)
            if not again and isinstance(importer.options, ReferenceOptions) and hasattr(importer, "recordings"):
                return importer.recordings(self.source, []), importer.options
            return _of_runs(importer.read(self.source), again)
        except (DataError, ConfigError):
            return None

    def other_quantities(self) -> Iterator[Finding]:
        """Findings that the wheels are positions, increments or rates, whichever they are not read as."""
        if self.reading is None or not (quantities := {each.wheels.unit for each in self.reading[0]}):
            return
        present = min(quantities)
        unit = present.partition("/")[0]
        names = {"": "positions", "/sample": "increments since the row before", "/s": "rates"}
        for ending, quantity in names.items():
            if unit != "rpm" and (other := f"{unit}{ending}") != present:
                what = f"the wheels look like {quantity} ({other}); read as {quantity_of(present)} ({present})"
                yield error("wheel_unit", what, "all wheels", {"wheel_quantity": other})

    def mended(self, findings: Sequence[Finding]) -> RecordingSource | None:
        """The recording, read again with the options that mend these findings; None if it cannot be read so."""
        if self.reading is None:
            return None
        recordings, present = self.reading
        options = self.mended_options(findings)
        changed = {key: value for key, value in options.items() if self.options.get(key) != value}
        try:
            read = validate(type(present), {**present.model_dump(exclude_unset=True), **changed}, "options")
            if "wheel_unit" in changed:
                recordings = [replace(each, wheels=replace(each.wheels, unit=read.wheel_unit)) for each in recordings]
            dataset = replace(dataset_of(recordings, read, []), name=self.dataset.name)
        except (DataError, ConfigError):
            return None
        return replace(self, dataset=dataset, findings=tuple(findings))

    def mended_options(self, findings: Sequence[Finding]) -> dict[str, Any]:
        """The options with the changes of findings, which are relative to those by which the recording was read."""
        options = dict(self.options)
        for key, value in (change for finding in findings for change in finding.changes.items()):
            options |= _changed(self, options, key, value)
            if key in _COLUMNS and options.get("columns"):  # names that now stand in the lists
                lists = [options.get(option) or () for other in _COLUMNS.values() for option in other]
                listed = {str(name) for names in lists for name in names}
                options["columns"] = {k: name for k, name in options["columns"].items() if str(name) not in listed}
                options = {k: v for k, v in options.items() if k != "columns" or v}
        return options

    def settings(self, findings: Sequence[Finding]) -> list[str]:
        """The options, KEY=VALUE, by which findings are mended, beside those by which the recording was read."""
        mended = self.mended_options(findings)
        return [f"{key}={as_yaml(value)}" for key, value in mended.items() if self.options.get(key) != value]

    def with_fixes(self, findings: Sequence[Finding]) -> list[Finding]:
        """The findings, each with the options that mend it where they are not set already."""
        fixed = []
        for finding in findings:
            typed = self.settings([finding]) if finding.changes else []
            fixed.append(finding.model_copy(update={"fix": " --set ".join(typed)}) if typed else finding)
        return fixed

    def command(self, findings: Sequence[Finding]) -> str:
        """The command line that reads it again, mended; of a data set in memory it says that it is to be saved."""
        if not self.settings(findings):
            return ""
        if self.places:
            return f'for each in {in_few_words(self.places)}; do omnibench check "$each"; done'
        saved = "" if self.readable else f"  # after save_dataset(dataset, {str(self.source)!r})"
        return self.import_command(self.mended_options(findings)) + saved

    def next_command(self) -> str:
        """The command line that goes on where nothing is to be mended: calibrate a data set, or first import a log."""
        places = self.places or ([self.folder] if self.folder and (self.folder / "dataset.yaml").is_file() else [])
        if places:
            return f"omnibench calibrate {in_few_words(places)} -o calibration.yaml"
        return self.import_command(self.options)

    def import_command(self, options: Mapping[str, Any]) -> str:
        """The command line that imports the source by some options."""
        if self.folder is None:
            target = Path("data") / (_title(self.source) or "recording")
        else:
            target = self.folder.with_name(f"{self.folder.name}_mended") if self.importer == "dataset" else self.folder
        words = ["omnibench", "import", self.importer, str(self.source), "-o", str(target), "--force"]
        for key, value in options.items():
            words += ["--set", f"{key}={as_yaml(value)}"]
        return shlex.join(words)


def _of_runs(dataset: Dataset, given: Mapping[str, Any]) -> tuple[list[Recording], ReferenceOptions]:
    """The runs of a data set as recordings."""
    options = DatasetOptions(robot=dataset.robot, **given)
    return recordings_of(replace(dataset, scans=None), options), options


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
            several = f"{places[0]} and {len(places) - 1} more"
            raise ConfigError(f"{several}: an importer reads one source; import each by itself")
        return replace(of_dataset(load_dataset(places)), places=tuple(places))
    (source,) = places
    check_source(source)
    name = form or recognised(source)
    stored = name == "dataset" and not settings
    try:
        dataset = load_dataset(source) if stored else _read(name, source, settings)
    except DataError:
        # Where the times cannot be read in the units that are given, they may be in others.
        for finding in other_times(settings):
            with suppress(DataError, ConfigError):
                dataset = _read(name, source, {**settings, **finding.changes})
                if sensible(dataset):
                    folder = source if stored else None
                    return RecordingSource(dataset, name, source, settings, folder, (finding,))
        raise
    return of_dataset(dataset, source) if stored else RecordingSource(dataset, name, source, settings)


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
    for pattern, name in _FILES.items():
        if next(source.rglob(pattern), None) is not None:
            return name
    raise ConfigError(f"{source}: no recording is recognised there; name the importer with --format (omnibench list)")


def _read(name: str, source: Path, given: Mapping[str, Any]) -> Dataset:
    """The data set of a source, also if its rates are too fast for any wheel, which is what a check tells then."""
    options = dict(given)
    if "name" in importers.entry(name, "--format").options.model_fields:
        options.setdefault("name", _title(source.resolve()))
    try:
        importer, again = importer_of(name, source, options)
        dataset = read_dataset(importer, source, again)
    except DataError as refusal:
        if "fastest" in given:
            raise
        try:
            dataset = _read(name, source, {**options, "fastest": _ANY_RATE})
        except (DataError, ConfigError):
            raise refusal from None
    if not dataset.referenced:
        lacking = "it has no reference poses; import it, which makes them from its scans, and check that"
        raise DataError(f"{source}: {lacking}")
    return dataset


def _title(source: Path) -> str:
    """The title of a source: the name of its folder, or of its file without the ending."""
    return source.name if source.is_dir() else source.stem


def sensible(dataset: Dataset) -> bool:
    """True if the times of a data set are usual, and its wheels explain its motion."""
    if odd_times(dataset):
        return False
    fit = recorded(dataset).fit()
    return fit is not None and bool(fit.unexplained[0] < _UNEXPLAINED)


def recorded(dataset: Dataset) -> Recorded:
    """The runs of a data set that have poses; where none has, those with positions in a fixed frame, headings 0."""
    runs = [run for run in dataset.trajectories if run.has_poses]
    if runs:
        return Recorded(dataset.robot, [run.log(run.pose_times) for run in runs], [run.poses for run in runs])
    logs, positions = [], []
    for run in dataset.trajectories:
        if run.references is not None:
            seen = run.references.only(run.references.kinds == "position")
            if len(seen) >= _FEWEST_POSITIONS:
                logs.append(run.log(seen.t1))
                positions.append(np.column_stack([seen.values, np.zeros(len(seen))]))
    return Recorded(dataset.robot, logs, positions, without_headings=True)


def odd_times(dataset: Dataset) -> bool:
    """True if samples or poses follow each other so slowly, or so fast, that their times are likely in another unit."""
    posed = [run for run in dataset.trajectories if run.has_poses]
    wheels = median_period(dataset.trajectories)
    poses = float(np.median(np.concatenate([np.diff(run.pose_times) for run in posed]))) if posed else 1.0
    return wheels > _SLOWEST or wheels < _FASTEST or poses > _SLOWEST_POSES or poses < _FASTEST


def other_times(given: Mapping[str, Any]) -> Iterator[Finding]:
    """Findings that another unit of time would mend: of all times, of the poses' and of the wheels'."""
    wheels, poses = "wheel_time_unit", "pose_time_unit"
    for unit in ("ms", "us", "ns"):
        for changes, which, where in (
            ({wheels: unit, poses: unit}, "all times", "the recording"),
            ({poses: unit}, "the times of the poses", "the reference"),
            ({wheels: unit, poses: given.get(poses) or "s"}, "the times of the wheels", "all wheels"),
        ):
            yield error("time_unit", f"{which} look like {unit}; they are read in s", where, changes)


def _changed(read: RecordingSource, options: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """The options that one change sets, relative to the present ones."""
    present = options.get(key)
    match key:
        case "wheel_order" | "steering_order":
            return _reordered(read, options, key, value)
        case "pose_order":  # x and y exchanged are mirrored, and turned by a right angle
            turned = round(float(options.get("heading_offset_deg", 0.0)) - 90, 3)
            return {"pose_signs": _product(options.get("pose_signs"), [1, -1, 1]), "heading_offset_deg": turned}
        case "wheel_signs" | "pose_signs":
            return {key: _product(present, value)}
        case "steering_signs":  # offsets are added after the signs
            offsets = options.get("steering_offsets_deg")
            turned_back = {"steering_offsets_deg": _product(offsets, value)} if offsets else {}
            return {key: _product(present, value), **turned_back}
        case "steering_factors":
            return {"steering_scale": _one_or_all(_product(options.get("steering_scale"), value))}
        case "steering_offsets_deg":
            offsets = zip(_listed(present, len(value), 0.0), value, strict=True)
            return {key: _one_or_all([round(before + offset, 3) for before, offset in offsets])}
        case "heading_offset_deg" | "steering_lag":
            return {key: round(float(present or 0.0) + value, 3)}
        case "rate_factors":
            return _geared(read, options, value)
        case "wheel_quantity":
            return {"wheel_unit": value}
        case "wheel_unit":
            unit = _unit_of_wheels(read, options)
            if unit.startswith("rad") and (unit == "rad/s" or value != "rpm"):  # the same quantity in another unit
                return {key: value if unit == "rad/s" else value.replace("/s", unit.removeprefix("rad"))}
            return _geared(read, options, [float(f"{RATE_UNITS[value]:.6g}")] * len(read.dataset.robot.wheel_names))
        case "leave_out":
            before = [present] if isinstance(present, str) else list(present or ())
            return {key: [*before, *(name for name in map(escape, value) if name not in before)]}
        case "wheels":
            return {key: {**(present or {}), **value}}
    return {key: value}


def _reordered(read: RecordingSource, options: Mapping[str, Any], key: str, order: Sequence[int]) -> dict[str, Any]:
    """The option that names columns, in another order, and with it those that have a value for each wheel."""
    fields = importers.entry(read.importer).options.model_fields
    option = next((name for name in _COLUMNS[key] if name in fields), _COLUMNS[key][1])
    names = list(options.get(option) or ())
    if not names and read.reading is not None:  # those of the source, in the robot's order
        wheels = read.reading[0][0].wheels
        names = list(wheels.columns if key == "wheel_order" else wheels.steering_columns)
    changed: dict[str, Any] = {option: [names[column] for column in order]} if names else {}
    for other in ("wheel_signs", "ticks_per_turn", "gear_ratio") if key == "wheel_order" else ():
        if isinstance(options.get(other), list | tuple) and len(options[other]) == len(order):
            changed[other] = [options[other][column] for column in order]
    return changed


def _geared(read: RecordingSource, options: Mapping[str, Any], factors: Sequence[float]) -> dict[str, Any]:
    """The option of the ticks, or of the gears, by which the wheels' rates become those divided by factors."""
    unit, turns = _unit_of_wheels(read, options), [2 * math.pi * factor for factor in factors]
    if unit.startswith("rad") and not options.get("gear_ratio") and min(turns) > FEWEST_TICKS:
        ticks = _one_or_all(_product(None, [float(f"{turn:.3g}") for turn in turns]))
        return {"wheel_unit": unit.replace("rad", "ticks"), "ticks_per_turn": ticks}
    option = "ticks_per_turn" if options.get("ticks_per_turn") else "gear_ratio"
    return {option: _one_or_all(_product(options.get(option), factors))}


def _unit_of_wheels(read: RecordingSource, options: Mapping[str, Any]) -> str:
    return str(options.get("wheel_unit") or (read.reading[0][0].wheels.unit if read.reading else "rad/s"))


def _listed(present: Any, count: int, default: float) -> list[float]:
    """The values of an option: one that is given for all, or none, ``count`` times."""
    values = list(present) if isinstance(present, list | tuple) else [] if present is None else [present]
    return (values or [default]) * count if len(values) < 2 else values


def _product(present: Any, factors: Sequence[float]) -> list[float]:
    """The values of an option times factors, of which either may be one for all."""
    count = max(len(factors), len(present) if isinstance(present, list | tuple) else 1)
    both = zip(_listed(present, count, 1), _listed(list(factors), count, 1), strict=True)
    values = [one * other for one, other in both]
    return [value if isinstance(value, int) else float(f"{value:.6g}") for value in values]


def _one_or_all(values: Sequence[float]) -> Any:
    """One value where all are the same."""
    return values[0] if len(set(values)) == 1 else list(values)
