"""A planar laser scanner and its scans, one trajectory at a time, in memory and on disk.

The ray at angle a of a scanner that is tilted by p (nose down) has, with x ahead of the scanner, y to its left and z
up, the direction

    (cos a cos p, sin a, -cos a sin p).                                                          (1)

Over the floor it points to the bearing atan2(sin a, cos a cos p), the share hypot(cos a cos p, sin a) of its length
lies along the floor, and from the height h it meets the floor after h/(cos a sin p), if that is positive.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, model_validator

from omnibench.config import Model, NonNegative, Positive
from omnibench.data.parquet import OpenedTable, parquet_shape, readable, sink_frames
from omnibench.data.stored import Rows, Table, check_columns, refuse, times_flaw
from omnibench.errors import DataError
from omnibench.files import TableFormat, check_file, unquoted_formulas
from omnibench.robot.kinematics import Array

Ranges = NDArray[np.float32]
_COLUMNS = ("trajectory", "t", "ranges")
_ROW_GROUP = 256  # rows of a Parquet row group; about 1 MB
_MOST_ROWS = 4096  # rows of a Parquet file that are read at a time; about 20 MB
_ROWS_OF_CSV = 65536  # rows of a CSV file read at a time: more, since every reading begins at its first line
_FLOOR_MARGIN = 5.0  # standard deviations of a range: one floor range in 3.5 million is shorter (normal noise)


MOST_PITCH = math.radians(60)  # rad; beyond that a plane of rays shows the floor and no room (chosen)


class Mount(Model):
    """Pose of the scanner in the robot's frame."""

    x: FiniteFloat = Field(0.0, description="m, forward")
    y: FiniteFloat = Field(0.0, description="m, left")
    yaw: FiniteFloat = Field(0.0, description="rad, counter-clockwise")
    pitch: float = Field(0.0, ge=-MOST_PITCH, le=MOST_PITCH, description="rad, tilted down ahead")
    height: NonNegative = Field(0.0, description="m above the floor, of a tilted scanner")

    @model_validator(mode="after")
    def _is_above_the_floor_it_is_tilted_to(self) -> Mount:
        if self.pitch and not self.height:
            raise ValueError("a tilted scanner (pitch) needs its height above the floor, m")
        return self

    @property
    def pose(self) -> Array:
        """(3,): m, m, rad."""
        return np.array([self.x, self.y, self.yaw])


class Scanner(Model):
    """A planar scanner: ray i points to angle_min + i angle_increment and is measured i time_increment late."""

    name: str = ""
    rays: int = Field(gt=0, le=100_000, description="ranges of a scan")
    angle_min: FiniteFloat = Field(description="rad, in the scanner's frame, counter-clockwise")
    angle_increment: FiniteFloat = Field(description="rad from ray to ray; negative for clockwise")
    time_increment: NonNegative = Field(0.0, description="s from ray to ray")
    range_min: NonNegative = Field(0.0, description="m; shorter ranges are no measurements")
    range_max: Positive = Field(description="m; longer ranges are no measurements")
    noise: Positive = Field(0.01, description="standard deviation of a range, m")
    far_noise: Positive = Field(0.03, description="standard deviation of ranges beyond far, m")
    far: Positive = Field(10.0, description="m")
    mount: Mount = Mount()

    @model_validator(mode="after")
    def _measures_something(self) -> Scanner:
        if self.range_min >= self.range_max:
            raise ValueError(f"range_min {self.range_min:g} m is not below range_max {self.range_max:g} m")
        if self.angle_increment == 0 and self.rays > 1:
            raise ValueError("angle_increment is 0; all rays would point the same way")
        if abs(self.angle_increment) * (self.rays - 1) > 2 * math.pi + 1e-3:
            raise ValueError(f"{self.rays} rays, {self.angle_increment:g} rad apart, are more than a whole turn")
        return self

    @property
    def angles(self) -> Array:
        """Directions of the rays (R,) in the scanner's frame, rad."""
        return self.angle_min + self.angle_increment * np.arange(self.rays)

    @property
    def bearings(self) -> Array:
        """Directions of the rays (R,) over the floor, in the robot's frame, rad."""
        angles, pitch = self.angles, self.mount.pitch
        if pitch:
            angles = np.arctan2(np.sin(angles), np.cos(angles) * math.cos(pitch))  # Eq. (1)
        return angles + self.mount.yaw

    @property
    def level_shares(self) -> Array:
        """Share (R,) of each ray's length that lies along the floor: 1 where the scanner is not tilted."""
        shares: Array = np.hypot(np.cos(self.angles) * math.cos(self.mount.pitch), np.sin(self.angles))  # Eq. (1)
        return shares if self.mount.pitch else np.ones(self.rays)

    @property
    def floor_ranges(self) -> Array:
        """Ranges (R,) at which the rays meet the floor, m; inf for those that do not."""
        down = np.cos(self.angles) * math.sin(self.mount.pitch)  # Eq. (1)
        falling = down > 0
        return np.where(falling, self.mount.height / np.where(falling, down, 1.0), np.inf)

    @property
    def delays(self) -> Array:
        """Delays (R,) of the rays after the scan's stamp, s."""
        return self.time_increment * np.arange(self.rays)

    def valid(self, ranges: Ranges) -> NDArray[np.bool_]:
        """True for ranges, of any shape, that are measurements."""
        return np.isfinite(ranges) & (ranges >= self.range_min) & (ranges <= self.range_max)

    def on_floor(self, ranges: Ranges | Array) -> NDArray[np.bool_]:
        """True for ranges (..., R) that are the floor's, within five standard deviations."""
        return np.asarray(ranges >= self.floor_ranges - _FLOOR_MARGIN * self.deviations(ranges))

    def deviations(self, ranges: Ranges | Array) -> Array:
        """Standard deviations of ranges of any shape, m."""
        return np.where(np.asarray(ranges) > self.far, self.far_noise, self.noise)


@dataclass(frozen=True, eq=False)
class TrajectoryScans:
    """Scans of one trajectory. times (S,): stamps of the first rays, s. ranges (S, R), m; inf: nothing was seen."""

    times: Array
    ranges: Ranges


class Scans:
    """The scans of a data set, which are read one trajectory at a time, so that no more than that is in memory.

    recorded: of each trajectory that has scans their stamps (S,), s, and what reads their ranges (S, R), m.
    """

    _place = ""  # where they are, for messages

    def __init__(self, scanner: Scanner, recorded: Mapping[str, tuple[Array, Callable[[], Ranges]]]) -> None:
        self.scanner, self._recorded = scanner, dict(recorded)

    @property
    def trajectories(self) -> tuple[str, ...]:
        """Ids of the trajectories that have scans."""
        return tuple(self._recorded)

    def times(self, trajectory: str) -> Array:
        """The stamps of a trajectory's scans (S,), s. DataError: there are none."""
        if trajectory not in self._recorded:
            raise DataError(f"{self._place}trajectory {trajectory} has no scans")
        return self._recorded[trajectory][0]

    def of(self, trajectory: str) -> TrajectoryScans:
        """The scans of a trajectory. DataError in one line: there are none, or they are broken."""
        return TrajectoryScans(self.times(trajectory), self._recorded[trajectory][1]())

    def __iter__(self) -> Iterator[tuple[str, TrajectoryScans]]:
        return ((trajectory, self.of(trajectory)) for trajectory in self.trajectories)


class ScansInMemory(Scans):
    """Scans in memory."""

    def __init__(self, scanner: Scanner, scans: Mapping[str, TrajectoryScans]) -> None:
        super().__init__(scanner, {name: (run.times, partial(getattr, run, "ranges")) for name, run in scans.items()})


class ScansOnDisk(Scans):
    """A table of scans. Stamps and names are checked at once, ranges when a trajectory's scans are read.

    DataError in one line names the file, the row (1 is the first) and what is wrong.
    """

    def __init__(self, file: Path, scanner: Scanner, trajectories: Iterable[str]) -> None:
        self.file, self._place, self._table = file, f"{file}: ", OpenedTable.of(file)
        if in_parquet := file.suffix == ".parquet":
            parquet_shape(file)
        else:
            check_file(file, text=True)
        with readable(file):
            check_columns(file, list(self._table.lazy().collect_schema()), _COLUMNS)
        frame = self._table.rows(["trajectory", "t"])
        table = Table(file, frame if in_parquet else unquoted_formulas(frame))
        times, ids = table.numbers("t"), list(trajectories)
        recorded: dict[str, tuple[Array, Callable[[], Ranges]]] = {}
        for index, rows in table.rows_by_run(ids, "the table of trajectories"):
            of_run = times[rows]
            if (flaw := times_flaw(of_run, of_run < 0, "it must not be negative")) is not None:
                raise table.fail(int(rows[flaw[0]]), flaw[1])
            recorded[ids[index]] = of_run, partial(self._ranges, rows, ids[index], of_run)
        super().__init__(scanner, recorded)

    def _ranges(self, rows: Rows, trajectory: str, times: Array) -> Ranges:
        """The ranges (S, R) of a trajectory's rows, which are read in parts. DataError names the row of a flaw."""
        rays = self.scanner.rays
        ranges = np.empty((len(rows), rays), np.float32)
        most = _MOST_ROWS if self.file.suffix == ".parquet" else _ROWS_OF_CSV
        edges = np.flatnonzero(np.diff(rows // most)) + 1
        for part in np.split(np.arange(len(rows)), edges):
            check, first, last = partial(refuse, self.file, rows[part]), int(rows[part[0]]), int(rows[part[-1]])
            column = self._table.rows(["ranges"], first, last - first + 1)["ranges"][rows[part] - first]
            if isinstance(column.dtype, pl.Array):
                column = column.arr.to_list()
            if column.dtype == pl.String:  # in CSV a cell is text with blanks between the numbers
                texts = column.str.strip_chars().str.split(" ")
                column = texts.list.eval(pl.element().cast(pl.Float32, strict=False))
                broken = texts.list.len() != column.list.drop_nulls().list.len()
                check(broken.fill_null(value=False), "ranges must be numbers, in CSV with a blank between them")
            if not isinstance(column.dtype, pl.List) or not column.dtype.inner.is_numeric():
                raise DataError(f"{self.file}: column 'ranges' holds {column.dtype}, expected lists of numbers")
            lengths = column.list.len().fill_null(0)
            check(lengths != rays, f"the scan has {{}} ranges, but scanner.rays is {rays}", lengths)
            ranges[part] = column.explode().cast(pl.Float32).fill_null(np.nan).to_numpy().reshape(-1, rays)
            unknown = np.isnan(ranges[part]).any(axis=1)
            check(unknown, "a range is missing or NaN; write inf where nothing was seen")
        empty = ~self.scanner.valid(ranges).any(axis=1)
        for row in np.flatnonzero(empty)[:1].tolist():
            seen = ranges[row][np.isfinite(ranges[row])]
            in_millimetres = len(seen) > 0 and self.scanner.valid(seen / 1000).mean() > 0.5
            limits = f"from {self.scanner.range_min:g} to {self.scanner.range_max:g} m"
            way = "they look like mm, give m" if in_millimetres else "remove the row"
            what = f"the scan of trajectory {trajectory} at {times[row]:g} s is empty: no range {limits}; {way}"
            refuse(self.file, rows, empty, what)
        return ranges


def write_scans(scans: Scans, table_format: TableFormat, trajectories: Iterable[str], file: Path) -> None:
    """Write the scans of ``trajectories``, of those that have some; one trajectory's are in memory at a time.

    Ranges are written in single precision. DataError: scans cannot be read. OSError: the disk refuses.
    """
    as_text = table_format == "csv"

    def frames() -> Iterator[pl.DataFrame]:
        for trajectory in filter(set(scans.trajectories).__contains__, trajectories):
            of_run = scans.of(trajectory)
            for first in range(0, len(of_run.times), _ROW_GROUP):
                part = slice(first, first + _ROW_GROUP)
                ranges = pl.Series(np.asarray(of_run.ranges[part], dtype=np.float32)).arr.to_list()
                if as_text:
                    ranges = ranges.cast(pl.List(pl.String)).list.join(" ")
                yield pl.DataFrame({"trajectory": trajectory, "t": of_run.times[part], "ranges": ranges}, schema=types)
            del of_run  # before the next one's are read

    types = {"trajectory": pl.String(), "t": pl.Float64(), "ranges": pl.String() if as_text else pl.List(pl.Float32)}
    sink_frames(frames(), types, table_format, _ROW_GROUP, file)
