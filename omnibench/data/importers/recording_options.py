"""Options that importers of recordings by any robot share, and the data set made with them."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, FiniteFloat, model_validator

from omnibench.config import Positive, read_yaml, validate
from omnibench.data.clock_matching import median_period
from omnibench.data.dataset import Dataset, Split, Trajectory, make_dataset
from omnibench.data.scans import Scans
from omnibench.data.splits import Names, divided, remaining
from omnibench.registry import Options
from omnibench.robot.kinematics import Robot
from omnibench.words import plural


def _load(value: Any) -> Any:
    if value in (None, ""):
        raise ValueError("nothing is given; name the robot's YAML file, as robot=robot.yaml")
    if not isinstance(value, str | Path):
        return value
    content = read_yaml(Path(value))
    # A dataset.yaml and a calibration file hold the robot among other things.
    return validate(Robot, content.get("robot", content) if isinstance(content, Mapping) else content, str(value))


RobotOption = Annotated[Robot, BeforeValidator(_load)]
"""A robot as in dataset.yaml, or the path of a YAML file that holds one: by itself, or under the key ``robot`` as a
dataset.yaml or a calibration file does."""


class RecordingOptions(Options):
    """The robot, which runs train and validate, and what the data set says of itself."""

    group: ClassVar[str] = "Robot and runs"

    robot: RobotOption = Field(
        description="name and wheels: --set robot=FILE.yaml, or robot.yaml in the source or beside it; "
        "omnibench import csv --template DIR writes one"
    )
    train: Names = Field((), description="patterns of run names that train")
    validation: Names = Field((), description="patterns of run names that validate")
    leave_out: Names = Field((), description="patterns of the names of runs that are left out")
    sample_period: Positive | None = Field(None, description="s; default: the median of the wheel samples")
    name: str = Field("recording", min_length=1, description="name of the data set")
    description: str = Field("", description="description of the data set")
    source: str = Field("", description="origin of the recording")
    licence: str = Field("", description="licence of the recording")

    def divided(
        self,
        runs: Sequence[Trajectory],
        *,
        otherwise: Sequence[Split] | None = None,
        alike: Sequence[Hashable] | None = None,
        kind: str = "run",
    ) -> list[Trajectory]:
        """The runs with their splits and repetitions, without those that are left out; as for ``splits.divided``."""
        kept = list(range(len(runs)))
        if self.leave_out:
            names = remaining([run.id for run in runs], self.leave_out, kind)
            kept = [index for index, run in enumerate(runs) if run.id in names]
        return divided(
            [runs[index] for index in kept],
            self.train,
            self.validation,
            kind,
            otherwise=None if otherwise is None else [otherwise[index] for index in kept],
            alike=None if alike is None else [alike[index] for index in kept],
        )

    def dataset(self, runs: Sequence[Trajectory], scans: Scans | None = None) -> Dataset:
        """The data set of these runs. DataError as for ``make_dataset``."""
        return make_dataset(
            self.name,
            self.robot,
            self.sample_period or median_period([run.times for run in runs]),
            runs,
            description=self.description,
            source=self.source,
            licence=self.licence,
            scans=scans,
        )


PositionUnit = Literal["m", "cm", "mm"]
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
TimeUnit = Literal["s", "ms", "us", "ns"]
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
HeadingUnit = Literal["rad", "deg"]
RADIANS = {"rad": 1.0, "deg": math.pi / 180}
Sign = Literal[1, -1]
# s per s; chosen: clocks of computers drift by some 1e-5, and a time column in another unit is off by a factor of 1000
_LARGEST_DRIFT = 0.1


class ReferenceOptions(RecordingOptions):
    """Unit, signs, heading and clock of the reference poses, and what ends a run."""

    group: ClassVar[str] = "Reference poses, clocks and cuts"

    position_unit: PositionUnit = Field("m", description="unit of x and y of the poses")
    pose_signs: tuple[Sign, ...] = Field((), description="factors of x, y and heading, each 1 or -1, as [1,-1,-1]")
    heading_offset_deg: FiniteFloat = Field(0.0, description="deg, added to the headings, after the signs")
    pose_time_offset: FiniteFloat = Field(0.0, description="s, added to the times of the poses")
    pose_time_drift: Annotated[float, Field(gt=-_LARGEST_DRIFT, lt=_LARGEST_DRIFT)] = Field(
        0.0, description="s per s since the first pose, added to the times of the poses"
    )
    clocks: Literal["same", "match"] = Field(
        "same", description="match: find offset and drift of each recording from wheels and poses"
    )
    longest_gap: Positive | None = Field(
        None, description="s; a run is cut where wheels or poses are missing for longer; default: as it came"
    )
    jumps: Literal["keep", "cut"] = Field("keep", description="cut: a run ends where the reference jumps")
    start_at_rest: bool = Field(False, description="true: a run begins where the robot last stood before it drives")

    @model_validator(mode="after")
    def _reference_fits_together(self) -> ReferenceOptions:
        if len(self.pose_signs) not in (0, 3):
            given = plural(len(self.pose_signs), "value")
            raise ValueError(f"pose_signs has {given}, expected 3, of x, y and heading: [1,-1,-1]")
        return self

    @property
    def cuts(self) -> bool:
        """True if runs are cut at anything but what every recording is cut at."""
        return self.longest_gap is not None or self.jumps == "cut" or self.start_at_rest


def units_of(options: ReferenceOptions, radian: float = 1.0) -> Sequence[float]:
    """Factors of x, y and heading as recorded, in m, m and rad, with their signs. radian: of the headings."""
    metre = METRES[options.position_unit]
    signs = options.pose_signs or (1, 1, 1)
    return metre * signs[0], metre * signs[1], radian * signs[2]
