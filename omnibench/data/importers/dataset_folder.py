"""Importer of data sets: a data set folder, read again with options that mend what is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field, model_validator

from omnibench.config import validate
from omnibench.data.dataset import Dataset
from omnibench.data.importer import Importer
from omnibench.data.recording import Notes, PoseReadings, Recording, RunAttributes, ScanReadings, WheelReadings
from omnibench.data.recording_options import SECONDS, ReferenceOptions
from omnibench.data.runs import dataset_of
from omnibench.data.scans import Ranges, Scans
from omnibench.data.splits import Names, joined
from omnibench.data.storage import load_dataset, read_recorded
from omnibench.errors import ConfigError, DataError, nearest
from omnibench.registry import importers

_POSE = ("x", "y", "theta")


class DatasetOptions(ReferenceOptions):
    """How the columns of a data set are to be read."""

    group: ClassVar[str] = "Columns of the data set"

    name: str = Field("dataset", min_length=1, description="name of the data set")
    wheel_columns: Names = Field((), description="its wheels in the robot's order, as [b,a]; default by name")
    steering_columns: Names = Field((), description="its steered wheels in the robot's order; default by name")
    pose_columns: Names = Field(_POSE, description="columns of x, y and heading, as [y,x,theta]")
    join: Names = Field((), description="folders of further data sets of this robot, whose runs are added as they are")

    @model_validator(mode="after")
    def _columns_fit_together(self) -> DatasetOptions:
        self.require_one_each("wheel_columns", "steering_columns")
        if sorted(self.pose_columns) != sorted(_POSE):
            raise ValueError(f"pose_columns is {', '.join(self.pose_columns)}; give x, y and theta in another order")
        if self.quantity != "rates":
            raise ValueError(f"wheel_unit {self.wheel_unit}: a data set holds rates; give rpm, deg/s, rev/s or ticks/s")
        return self


@importers.register("dataset")
class DatasetFolder(Importer):
    """A data set folder, read again with options that mend it: units, signs, order of wheels, times, clocks, cuts,
    robot.

    Options are relative to what the data set holds: ``wheel_signs=[-1,1,1]`` turns wheel a round, whatever it was
    imported with. The robot is the data set's unless ``robot`` is given. Splits, commands and sessions stay; ``train``
    and ``validation`` divide the runs anew. Units, signs and clocks hold for distances, turns and the like, too, that
    were measured in the place of poses; a run that is cut keeps those within one of its parts.
    """

    Options = DatasetOptions
    options: DatasetOptions

    @classmethod
    def completed(cls, options: Mapping[str, Any], source: Path) -> dict[str, Any]:
        """The options with the data set's own robot, where none is given."""
        file = source / "dataset.yaml"
        if not file.is_file():
            raise DataError(f"{source}: it has no dataset.yaml; name the folder of a data set")
        return {"robot": file, **options}

    def read(self, source: Path) -> Dataset:
        """The data set as the options say. DataError as for ``load_dataset``."""
        recorded, options = read_recorded(source), self.options
        said = {key: getattr(options, key) or getattr(recorded, key) for key in ("description", "source", "licence")}
        return _reread(recorded, options.model_copy(update=said), [])

    def recordings(self, source: Path, notes: Notes) -> list[Recording]:  # noqa: ARG002 (as of other importers)
        """The runs of the data set as recordings, as they stand in its tables."""
        return recordings_of(read_recorded(source), self.options)


def read_again(dataset: Dataset, settings: Mapping[str, Any], place: str) -> Dataset:
    """The data set of an importer with options of ``import dataset``, relative to what it holds. ConfigError.

    place: the importer, for messages. Warnings of what cannot be right are made anew, other notes stay.
    """
    known = {key: getattr(dataset, key) for key in ("robot", "name", "description", "source", "licence")}

    def by(settings: Mapping[str, Any], notes: Notes) -> Dataset:
        return _reread(dataset, validate(DatasetOptions, {**known, **settings}, place), notes)

    before = by({}, []).warnings
    notes = [warning for warning in dataset.warnings if warning not in before]
    again = by(settings, notes)
    return again if dataset.referenced else replace(again, referenced=False, warnings=tuple(notes))


def _reread(recorded: Dataset, options: DatasetOptions, notes: Notes) -> Dataset:
    """A data set by the options; its sample period stays unless these say another, or another unit of times."""
    recordings = recordings_of(recorded, options)
    dataset = dataset_of(recordings, options, notes, simulated=recorded.simulated)
    if not options.sample_period and options.wheel_time_unit == "s":
        dataset = replace(dataset, sample_period=recorded.sample_period)
    return joined(dataset, [load_dataset(folder) for folder in options.join])


def recordings_of(dataset: Dataset, options: DatasetOptions) -> list[Recording]:
    """The runs of a data set as recordings. ConfigError: it has no wheel of a name that the options give."""
    robot, scans = dataset.robot, dataset.scans
    wheels = _chosen(options.wheel_columns or options.robot.wheel_names, robot.wheel_names, "omega_", "wheel_columns")
    axles = options.steering_columns or options.robot.drive.steered
    steering = _chosen(axles, robot.drive.steered, "steer_", "steering_columns")
    names, turning, steered = (tuple(wheels.values()), tuple(steering.values())), list(wheels), list(steering)
    poses = [_POSE.index(column) for column in options.pose_columns]
    factors, second = options.wheel_factors(options.wheel_unit), SECONDS[options.wheel_time_unit]
    scanned = set() if scans is None else set(scans.trajectories)
    recordings = []
    for run in dataset.trajectories:
        others = {} if run.odometry is None else {"odometry": run.odometry}
        if run.angles is not None:
            others["angles"] = run.angles[:, turning] * factors
        if run.targets is not None:
            others["targets"] = run.targets[:, turning] * (options.wheel_signs or 1)
        rates, unit = run.rates[:, turning], options.wheel_unit
        angles = None if run.steering is None or not steered else run.steering[:, steered]
        readings = WheelReadings(run.times, rates, unit, angles, *names, begin=0.0, others=others)
        covariances = None if run.pose_covariances is None else run.pose_covariances[:, poses][:, :, poses]
        seen = PoseReadings(run.pose_times, run.poses[:, poses], covariances) if run.start_known else None
        measured = None if run.references is None else run.references.open_ended(float(run.times[-1]))
        known = {key: getattr(run, key) for key in ("command", "repetition", "split", "session", "started_at")}
        numbers = {key: getattr(run, key) for key in ("v", "alpha", "omega", "duration", "distance")}
        sent = None if run.sent is None else run.sent * (second, 1, 1, 1, second)
        said, seeing = RunAttributes(**known, numbers=numbers, sent=sent), None
        if scans is not None and run.id in scanned:
            seeing = ScanReadings(scans.scanner, run.id, scans.times(run.id), partial(_ranges, scans, run.id))
        place = f"trajectory {run.id}"
        recordings.append(Recording(run.id, place, readings, seen, measured, attributes=said, scans=seeing, a_run=True))
    return recordings


def _ranges(scans: Scans, run: str, rows: Any) -> Ranges:
    return scans.of(run).ranges[rows]


def _chosen(names: Sequence[str], known: Sequence[str], prefix: str, option: str) -> dict[int, str]:
    """The wheels that an option names, with or without a prefix, by their indices among those that are known."""
    bare = [name.removeprefix(prefix) for name in names]
    for name in bare:
        if name not in known:
            shown = ", ".join(known) or "none"
            raise ConfigError(f"the data set has no wheel {name!r}; {nearest(name, known)}found: {shown}; set {option}")
    if len(set(bare)) < len(bare):
        raise ConfigError(f"{option} names one wheel twice: {', '.join(names)}; name each once")
    return {known.index(name): name for name in bare}


def importer_of(name: str, source: Path, options: Mapping[str, Any]) -> tuple[Importer, dict[str, Any]]:
    """The importer called ``name`` with its options, completed by the source; and the options that it does not have.

    These are options of ``import dataset``, as if the data set that it gives was imported again. UnknownNameError,
    ConfigError or DataError in one line.
    """
    entry = importers.entry(name)
    others = DatasetOptions.model_fields.keys() - entry.options.model_fields.keys()
    again = {key: value for key, value in options.items() if key in others}
    own = {key: value for key, value in options.items() if key not in again}
    return importers.create(name, entry.cls.completed(own, source)), again


def read_dataset(importer: Importer, source: Path, again: Mapping[str, Any]) -> Dataset:
    """The data set of a source, read again by options that its importer does not have.

    Its poses are placeholders where they must be made of scans. ConfigError or DataError in one line.
    """
    dataset = importer.read(source)
    return read_again(dataset, again, f"importer {importer.name!r}") if again else dataset
