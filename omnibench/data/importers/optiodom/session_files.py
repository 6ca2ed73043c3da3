"""The metadata of one OptiOdom session."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path

from omnibench.data.importers.optiodom.robots import KINDS, Geometry, Kind
from omnibench.errors import DataError, nearest
from omnibench.files import read_text

_RUN = re.compile(r"_run-(\d+)\.csv$")


@dataclass(frozen=True)
class SessionMetadata:
    """Content of ``<session>_metadata.csv``, and the run files beside it.

    robot: its type. gear and resolution (ticks per turn of the motor); starts: when each run's file begins in the
    session's log, s after the run's begin there.
    """

    file: Path
    group: str
    name: str
    robot: str
    geometry: Geometry
    gear: float
    resolution: float
    starts: tuple[float, ...]
    runs: tuple[Path, ...]

    @property
    def kind(self) -> Kind:
        """What its files hold."""
        return KINDS[self.robot]

    @property
    def angle_per_tick(self) -> float:
        """Wheel angle of one tick, rad."""
        return 2 * math.pi / (self.gear * self.resolution)


def run_number(file: Path) -> int:
    """The number in the name of a run's file."""
    match = _RUN.search(file.name)
    assert match is not None  # only such files are collected
    return int(match.group(1))


def read_metadata(file: Path) -> SessionMetadata:
    """Read a session's metadata and find its runs. DataError names the file and the key that is wrong."""
    values = {fields[0].strip(): fields[1:] for fields in csv.reader(read_text(file).splitlines()) if fields}
    robot = "".join(values.get("type", [])[:1]).strip()
    if robot not in KINDS:
        raise DataError(f"{file}: type is {robot!r}; {nearest(robot, KINDS)}it must be one of {', '.join(KINDS)}")
    kind = KINDS[robot]
    diameters = _numbers(file, values, "Di", kind.diameters)
    lengths = _numbers(file, values, "Li", kind.lengths)
    (gear,) = _numbers(file, values, "ngear", 1)
    (resolution,) = _numbers(file, values, "encRes", 1)
    for key, number in (("Di", min(diameters)), ("Li", min(lengths)), ("ngear", gear), ("encRes", resolution)):
        if number <= 0:
            raise DataError(f"{file}: {key} is {number:g}, it must be above 0")
    name = file.name.removesuffix("_metadata.csv")
    runs = sorted(path for path in file.parent.glob(f"{name}_run-*.csv") if _RUN.search(path.name))
    if not runs:
        raise DataError(f"{file.parent}: no {name}_run-NN.csv beside {file.name}")
    starts = _numbers(file, values, "odo_ti", None) if "odo_ti" in values else ()
    return SessionMetadata(
        file, file.parent.parent.name, name, robot, Geometry(lengths, diameters), gear, resolution, starts, tuple(runs)
    )


def _numbers(file: Path, values: dict[str, list[str]], key: str, count: int | None) -> tuple[float, ...]:
    if key not in values:
        raise DataError(f"{file}: key {key!r} is missing; {nearest(key, values)}found: {', '.join(values)}")
    texts = [text.strip() for text in values[key] if text.strip()]
    try:
        numbers = tuple(float(text) for text in texts)
    except ValueError:
        raise DataError(f"{file}: {key} is {', '.join(texts)!r}, expected numbers") from None
    if (count is not None and len(numbers) != count) or not all(map(math.isfinite, numbers)):
        raise DataError(f"{file}: {key} is {', '.join(texts)!r}, expected {count or 'finite'} numbers")
    return numbers
