"""Importer of data sets: a data set folder, read again with options that mend what is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field, model_validator

from omnibench.data.dataset import Dataset
from omnibench.data.importer import Importer
from omnibench.data.importers.copied_reference import follows_the_wheels
from omnibench.data.importers.recording_options import RADIANS, SECONDS, HeadingUnit, TimeUnit
from omnibench.data.importers.runs.recording_runs import Columns, in_seconds, reread_runs, scans_of
from omnibench.data.importers.wheel_samples import EncoderOptions, Signs
from omnibench.data.splits import Names, complete, joined
from omnibench.data.storage import load_whole, read_recorded
from omnibench.errors import DataError
from omnibench.registry import importers

_POSE = ("x", "y", "theta")


class DatasetOptions(EncoderOptions):
    """How the columns of a data set are to be read."""

    group: ClassVar[str] = "Columns of the data set"

    name: str = Field("dataset", min_length=1, description="name of the data set")
    wheel_columns: Names = Field((), description="its wheels in the robot's order, as [b,a]; default by name")
    wheel_signs: Signs = Field((), description="-1 for wheels that count the other way round, as [-1,1]")
    wheel_time_unit: TimeUnit = Field("s", description="unit of the times of its wheels, whose rates stay")
    pose_time_unit: TimeUnit = Field("s", description="unit of the times of its poses")
    steering_columns: Names = Field((), description="its steered wheels in the robot's order; default by name")
    pose_columns: Names = Field(_POSE, description="columns of x, y and heading, as [y,x,theta]")
    heading_unit: HeadingUnit = Field("rad", description="unit of the headings as the data set has them")
    join: Names = Field((), description="folders of further data sets of this robot, whose runs are added as they are")

    @model_validator(mode="after")
    def _fits_together(self) -> DatasetOptions:
        self.require_one_each("wheel_columns", "wheel_signs", "steering_columns")
        if sorted(self.pose_columns) != sorted(_POSE):
            raise ValueError(f"pose_columns is {', '.join(self.pose_columns)}; give x, y and theta in another order")
        if self.quantity != "rates":
            raise ValueError(f"wheel_unit {self.wheel_unit}: a data set holds rates; give rpm, deg/s, rev/s or ticks/s")
        return self

    @property
    def signs(self) -> Signs:
        return self.wheel_signs


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
        """The data set as the options say. DataError as for ``load_whole``."""
        options, warnings = self.options, list[str]()
        recorded = read_recorded(source)
        header = recorded.header
        columns = Columns.of(header.robot, options, options.wheel_columns, options.steering_columns)
        poses = [_POSE.index(column) for column in options.pose_columns]
        wheel_second, pose_second = SECONDS[options.wheel_time_unit], SECONDS[options.pose_time_unit]
        parts = reread_runs(
            [in_seconds(columns.read(run, options), wheel_second, pose_second) for run in recorded.trajectories],
            options,
            poses,
            RADIANS[options.heading_unit],
            warnings,
        )
        if not parts:
            raise DataError(f"{source}: no run is left; {warnings[-1] if warnings else 'check the options'}")
        runs = complete([part.run for part in parts])
        numbers = {run.id: run.repetition for run in runs}
        runs = [
            replace(run, repetition=numbers[run.id])
            for run in options.divided(runs, otherwise=[run.split for run in runs])
        ]
        scans = None if recorded.scans is None else scans_of(recorded.scans, parts)
        said = {key: getattr(options, key) or getattr(header, key) for key in ("description", "source", "licence")}
        said["sample_period"] = options.sample_period or header.sample_period * wheel_second
        dataset = replace(options.model_copy(update=said).dataset(runs, scans), simulated=header.simulated)
        if not header.simulated and (residual := follows_the_wheels(dataset.trajectories)) is not None:
            warnings.append(
                "the reference is the robot's odometry: some matrix makes its headings of the wheels to "
                f"{residual:.1g} rad a second; record an independent one"
            )
        dataset = replace(dataset, warnings=(*warnings, *dataset.warnings))
        return joined(dataset, [load_whole(folder) for folder in options.join])
