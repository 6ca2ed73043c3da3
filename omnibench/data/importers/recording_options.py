"""Options that importers of recordings by any robot share, and the data set made with them."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, Field

from omnibench.config import Positive, read_yaml, validate
from omnibench.data.alignment import median_period
from omnibench.data.dataset import Dataset, Split, Trajectory, make_dataset
from omnibench.data.scans import Scans
from omnibench.data.splits import Names, divided, remaining
from omnibench.registry import Options
from omnibench.robot.kinematics import Robot


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
