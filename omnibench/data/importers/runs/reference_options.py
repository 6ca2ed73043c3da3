"""Options that say how the reference poses of a recording are to be read, and where its runs are cut."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

from pydantic import Field, FiniteFloat, model_validator

from omnibench.config import Positive
from omnibench.data.importers.recording_options import RecordingOptions
from omnibench.words import plural

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
