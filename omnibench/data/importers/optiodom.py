"""Importer of the OptiOdom recordings: four robots with encoders and motion capture.

Kinematics of the authors with wheel angles d (m): diff v = (dR + dL)/2, w = (dR - dL)/L; tricyc v = d cos phi,
w = d sin phi / L; omni3 vx = (-d0 + d1)/sqrt(3), vy = (-d0 - d1 + 2 d2)/3, w = -(d0 + d1 + d2)/(3 L); omni4
v = (d0 - d1 + d2 - d3)/4, vn = (-d0 - d1 + d2 + d3)/4, w = -(d0 + d1 + d2 + d3)/(2 (L1 + L2)).
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from omnibench.data.clock_matching import median_period
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.delimited import NumberTable, read_numbers
from omnibench.data.importer import Importer
from omnibench.data.splits import Names, complete, divided
from omnibench.errors import DataError, nearest
from omnibench.files import read_text
from omnibench.registry import Options, importers
from omnibench.robot.kinematics import Array, Robot, Wheel, in_the_middle
from omnibench.words import plural


@dataclass(frozen=True)
class Geometry:
    """Design values by a session's metadata, m. lengths: L, or L1 and L2. diameters: of the wheels."""

    lengths: tuple[float, ...]
    diameters: tuple[float, ...]

    def __str__(self) -> str:
        return f"L {_listed(self.lengths)} m, D {_listed(self.diameters)} m"


@dataclass(frozen=True)
class LogFormat:
    """Columns of a robot's own log, counted from 0, the time.

    ticks: of each wheel; signs: to its sense in omnibench. commands: v, vn (if any) and omega; none: they are not
    logged. in_ticks: they are in ticks and rad a cycle, not in m/s and rad/s.
    """

    fields: int
    ticks: tuple[int, ...]
    signs: tuple[int, ...]
    commands: tuple[int, ...] = ()
    in_ticks: bool = False


@dataclass(frozen=True)
class Kind:
    """A robot. columns: of its run files after the pose, ticks first; signs: to the wheels' sense in omnibench."""

    title: str
    columns: tuple[str, ...]
    signs: tuple[int, ...]
    lengths: int
    diameters: int
    log: LogFormat
    wheels: Callable[[Geometry], tuple[Wheel, ...]]

    @property
    def ticks(self) -> tuple[str, ...]:
        """The columns with ticks, one for each wheel with a measured rate."""
        return self.columns[: len(self.signs)]


def _listed(values: tuple[float, ...]) -> str:
    return f"{values[0]:g}" if len(set(values)) == 1 else ", ".join(f"{value:g}" for value in values)


def _diff(geometry: Geometry) -> tuple[Wheel, ...]:
    half = geometry.lengths[0] / 2
    right, left = (diameter / 2 for diameter in geometry.diameters)
    return (
        Wheel(name="right", type="fixed", radius=right, x=0.0, y=-half),
        Wheel(name="left", type="fixed", radius=left, x=0.0, y=half),
    )


def _tricyc(geometry: Geometry) -> tuple[Wheel, ...]:
    (length,), (diameter,) = geometry.lengths, geometry.diameters
    rear = (("rear_left", 1), ("rear_right", -1))  # their radius and distance apart are not known and do not count
    return (
        Wheel(name="front", type="steered", radius=diameter / 2, x=length, y=0.0),
        *(
            Wheel(name=name, type="fixed", radius=diameter / 2, x=0.0, y=side * length / 2, measured=False)
            for name, side in rear
        ),
    )


def _omni3(geometry: Geometry) -> tuple[Wheel, ...]:
    return tuple(
        Wheel(
            name=str(index),
            radius=diameter / 2,
            distance=geometry.lengths[0],
            angle=math.radians(axle),
            roller_angle=0.0,
        )
        for index, (diameter, axle) in enumerate(zip(geometry.diameters, (300, 60, 180), strict=True))
    )


def _omni4(geometry: Geometry) -> tuple[Wheel, ...]:
    x, y = (length / 2 for length in geometry.lengths)
    corners = (("front_left", 1, 1), ("front_right", 1, -1), ("rear_left", -1, 1), ("rear_right", -1, -1))
    return tuple(
        Wheel(
            name=name,
            type="mecanum",
            radius=diameter / 2,
            x=ahead * x,
            y=side * y,
            roller_angle=ahead * side * math.pi / 4,
        )
        for (name, ahead, side), diameter in zip(corners, geometry.diameters, strict=True)
    )


KINDS = {
    "diff": Kind(
        "differential drive, encoders at 20 Hz",
        ("ticks_right", "ticks_left"),
        (1, 1),
        1,
        2,
        LogFormat(8, (2, 1), (1, 1), (6, 7), in_ticks=True),
        _diff,
    ),
    "omni3": Kind(
        "three-wheeled omnidirectional robot, encoders at 25 Hz",
        ("ticks_0", "ticks_1", "ticks_2"),
        (-1, -1, -1),
        1,
        3,
        LogFormat(10, (1, 2, 3), (1, 1, 1), (7, 8, 9)),
        _omni3,
    ),
    "omni4": Kind(
        "mecanum base, encoders at 100 Hz",
        ("turns_0", "turns_1", "turns_2", "turns_3"),
        (1, -1, 1, -1),
        2,
        4,
        LogFormat(11, (1, 2, 3, 4), (-1, 1, -1, 1), (8, 9, 10)),
        _omni4,
    ),
    "tricyc": Kind(
        "tricycle with a driven and steered front wheel, encoders at 20 Hz",
        ("ticks", "steering"),
        (1,),
        1,
        1,
        LogFormat(3, (1,), (1,)),
        _tricyc,
    ),
}
"""The robots by their type in the metadata."""


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


@dataclass(frozen=True, eq=False)
class LogStretch:
    """Rows of a log: times (F,) s; ticks (F, N) and angles (F, N), rad, in the sense of the wheels of omnibench;
    commanded twists (F, 3) m/s, m/s, rad/s, or None."""

    times: Array
    ticks: Array
    angles: Array
    commands: Array | None


@dataclass(frozen=True, eq=False)
class SessionLog:
    """The robot's own log of a session. runs (F,): number of the run of each row. path: its size, in a name's words."""

    file: Path
    path: str
    runs: NDArray[np.intp]
    rows: LogStretch

    @property
    def begin(self) -> float:
        """Time of the first row, s."""
        return float(self.rows.times[0])

    def stretch(self, run: int, first: int, count: int) -> LogStretch | None:
        """``count`` rows of one run from its row ``first`` on; None when the log does not hold them."""
        rows = np.flatnonzero(self.runs == run)[first : first + count]
        if len(rows) < count:
            return None
        whole = self.rows
        commands = None if whole.commands is None else whole.commands[rows]
        return LogStretch(whole.times[rows], whole.ticks[rows], whole.angles[rows], commands)


def read_log(session: SessionMetadata) -> SessionLog | None:
    """The session's log, if it is there. DataError names the file and the line that is wrong."""
    file = session.file.with_name(f"{session.name}.csv")
    if not file.is_file():
        return None
    form = session.kind.log
    header: list[list[str]] = []
    run, runs, rows = None, [], []
    for line, text in enumerate(read_text(file).splitlines(), 1):
        fields = text.split(",")
        if fields[0] == "Run:":
            if len(fields) < 2 or not fields[1].strip().isdigit():
                raise DataError(f"{file}, line {line}: expected the number of a run after 'Run:'")
            run = int(fields[1])
        elif fields[0] in ("RUNFINISHED", "METHODFINISHED") or fields[0].startswith("+++"):
            run = None
        elif run is not None:
            runs.append(run)
            if len(fields) < form.fields:
                raise DataError(f"{file}, line {line}: it has {len(fields)} fields, expected {form.fields}")
            try:
                numbers = [float(field) for field in fields[: form.fields]]
            except ValueError as error:
                raise DataError(f"{file}, line {line}: {error}") from None
            if not all(map(math.isfinite, numbers)):
                raise DataError(f"{file}, line {line}: a value is not finite; remove or repair the row")
            rows.append(numbers)
        elif not rows:
            header.append(fields)
    if not rows:
        raise DataError(f"{file}: it holds no run")
    table = np.array(rows)
    ticks = table[:, form.ticks] * form.signs
    angles = np.cumsum(ticks, axis=0) * session.angle_per_tick
    stretch = LogStretch(table[:, 0], ticks, angles, _commands(session, table))
    return SessionLog(file, _path(header), np.array(runs), stretch)


def _commands(session: SessionMetadata, table: Array) -> Array | None:
    """Commanded twists (F, 3), m/s, m/s, rad/s; None where the log has none."""
    form = session.kind.log
    if not form.commands:
        return None
    if not form.in_ticks:
        return table[:, form.commands]
    cycle = float(np.median(np.diff(table[:, 0])))
    speed, turn = table[:, form.commands].T
    metres = session.angle_per_tick * float(np.mean(session.geometry.diameters)) / 2
    return np.column_stack([speed * metres, np.zeros(len(table)), turn]) / cycle


def _path(header: Sequence[Sequence[str]]) -> str:
    """Size of the path as a part of a command's name: radius and shrinkage of circles, or the length of a side.

    A log of the differential drive also says by what geometry the robot drove it.
    """
    said = {key: value for line in header for key, value in zip(line[::2], line[1::2], strict=False)}
    shrinkage = next((value for key, value in said.items() if key.startswith("Rrate(")), "")  # its end is garbled
    length = said.get("L(LmxLm):") or said.get("L(Lm):")
    radius = said.get("R(m):")
    if [len(line) for line in header] == [1, 4, 4]:  # the tricycle's: path; L, D, offset, ticks; N, size, %, turns
        (kind,), _, (_, size, shrinkage, _) = header
        radius, length = (size, None) if kind == "circular" else (None, size)
    try:
        size = f"_r{float(radius):g}x{float(shrinkage) / 100:g}" if radius else f"_l{float(length or ''):g}"
        if "b0(m):" in said:
            size += f"_b{float(said['b0(m):']):g}d{float(said['dL0(m):']):g}"
    except (KeyError, ValueError):
        return ""
    return size


_POSE = ("t", "x", "y", "theta")
_SAME_SPEED = 0.02  # m/s, rad/s: commands below are standstill
_SAME_TICKS = 1e-6  # logs of turns are rounded to some digits
_DESCRIPTION = (
    "INESC TEC {} and OptiTrack; Sousa, Petry, Costa, Moreira: "
    "OptiOdom, J. Intell. Robot. Syst. 105:39 (2022), doi 10.1007/s10846-022-01630-3. Encoders and OptiTrack were "
    "synchronised by hand, run by run: offsets up to 0.2 s and a drift of about 0.1 s a minute remain."
)


class OptiodomOptions(Options):
    """Choice of groups that train and validate. A group is the folder that holds session folders: circular, square."""

    robot: Literal["diff", "omni3", "omni4", "tricyc"] | None = Field(
        None, description="the robot to import where the source holds several; its sessions' metadata say their type"
    )
    train: Names = Field((), description="groups that train; default: the first by name")
    validation: Names = Field((), description="groups that validate; default: all others")
    log: bool = Field(True, description="read commands and absolute wheel angles from each session's own log")
    name: str = Field("optiodom", min_length=1, description="name of the data set")
    robot_name: str | None = Field(None, min_length=1, description="default: inesc_tec_ and its type")
    source: str = Field(
        "public GitHub repository sousarbarb/optiodom, commit 8e025fd7", description="origin of the recording"
    )


@importers.register("optiodom")
class Optiodom(Importer):
    """OptiOdom recordings (Sousa et al. 2022): session folders with runs of encoders and motion capture.

    The source is any folder above session folders of one robot, or one of them; a session is found by
    ``<session>_metadata.csv``, which says the robot's type: diff (a differential drive), tricyc (a tricycle), omni3
    (three omni wheels) or omni4 (four mecanum wheels). Beside it are ``<session>_run-NN.csv`` (t, x, y, theta, then
    increments of each wheel in ticks, of omni4 in turns; tricyc also has the steering angle, rad; no header) and the
    robot's own log ``<session>.csv``, from which come commands and absolute wheel angles. Wheels that the authors count
    the other way round than omnibench are negated here: omni3's, whose axles point to 300, 60, 180 degrees, and omni4's
    on the right. A row's ticks were driven since the row before; the row at t = 0 only gives the start pose.

    Where sessions state different dimensions, the commonest are the robot's (of equally many the first session's), and
    a warning and the description say so.

    Runs share a command when group, direction, path (radius and shrinkage or length; of diff also the dimensions by
    which the robot drove it), speed and total turn (to the nearest quarter, by the odometry by which the robot drove)
    agree. v, alpha and omega are medians over the commanded motion. tricyc does not log commands, and most sessions of
    omni4 have no log: the direction is then by that odometry, too, and so is the length (to 0.1 m) in the place of an
    unknown path.

    Splits: with one group and no options every second run of a command validates. With two or more the first group by
    name trains and the others validate; ``train`` and ``validation`` say otherwise (patterns such as ``circ*`` work).
    Groups that neither names are left out.
    """

    Options = OptiodomOptions
    options: OptiodomOptions

    def read(self, source: Path) -> Dataset:
        """All sessions under ``source``; DataError names the file and the row of what is wrong."""
        # The sessions of the one robot to import.
        sessions = [read_metadata(file) for file in sorted(source.resolve().rglob("*_metadata.csv"))]
        if not sessions:
            raise DataError(f"{source}: no *_metadata.csv below it; name a folder with OptiOdom sessions (data/omni3)")
        found = sorted({session.robot for session in sessions})
        wanted = self.options.robot
        if wanted is None and len(found) > 1:
            raise DataError(
                f"{source}: it holds recordings of {plural(len(found), 'robot')}, {', '.join(found)}; import one at a "
                f"time: name its folder, or --set robot={found[0]}"
            )
        if wanted is not None and wanted not in found:
            raise DataError(f"{source}: it holds no recordings of robot {wanted}; found: {', '.join(found)}")
        sessions = [session for session in sessions if wanted in (None, session.robot)]
        # The commonest geometry, of equally common ones the first session's; and a note if there are others.
        (geometry, most), *others = Counter(session.geometry for session in sessions).most_common()
        notes = []
        if others:
            rest = "; ".join(f"{other} in {count}" for other, count in others)
            notes.append(
                f"sessions state different dimensions of the robot: those of {most} of {len(sessions)} are taken, "
                f"{geometry} (others: {rest})"
            )
        wheels = sessions[0].kind.wheels(geometry)
        robot = Robot(name=self.options.robot_name or f"inesc_tec_{sessions[0].robot}", wheels=wheels)
        logs = [read_log(session) if self.options.log else None for session in sessions]
        unlogged = [session.name for session, log in zip(sessions, logs, strict=True) if log is None]
        if self.options.log and unlogged:
            notes.append(
                f"{len(unlogged)} of {plural(len(sessions), 'session')} have no log ({', '.join(unlogged)}): commands "
                "are named after the motion by the wheels there, and absolute wheel angles are left out of all runs"
            )
        runs = [
            _read_run(session, index, log, self.options.log)
            for session, log in zip(sessions, logs, strict=True)
            for index in range(len(session.runs))
        ]
        groups = [session.group for session in sessions for _ in session.runs]
        train, validation = self.options.train, self.options.validation
        if not train and not validation and len(set(groups)) > 1:
            train = (min(groups),)
        dataset = make_dataset(
            self.options.name,
            robot,
            median_period([run.pose_times for run in runs]),
            divided(complete(runs), train, validation, "group", names=groups),
            description=" ".join(
                [_DESCRIPTION.format(sessions[0].kind.title), *(f"{note[:1].upper()}{note[1:]}." for note in notes)]
            ),
            source=self.options.source,
            licence="MIT",
        )
        return replace(dataset, warnings=(*notes, *dataset.warnings))


@dataclass(frozen=True)
class _Motion:
    """A run's motion: medians of speed, m/s, direction, rad, and rate of turn, rad/s, while it moves; the greatest
    speed, m/s; length, m, and turn, rad, in all."""

    v: float
    alpha: float
    omega: float
    fastest: float
    distance: float
    turned: float

    @classmethod
    def of(cls, twists: Array, durations: Array) -> _Motion:
        """The motion of twists (rows, 3) in m/s, m/s, rad/s for durations (rows,), s."""
        speeds = np.hypot(twists[:, 0], twists[:, 1])
        moving = (speeds > _SAME_SPEED) | (np.abs(twists[:, 2]) > _SAME_SPEED)
        vx, vy, omega = np.median(twists[moving], axis=0) if moving.any() else np.zeros(3)
        v, alpha = float(np.hypot(vx, vy)), math.atan2(vy, vx)
        turned = float(twists[:, 2] @ durations)
        return cls(v, alpha, float(omega), float(speeds.max()), float(speeds @ durations), turned)


def _read_run(session: SessionMetadata, index: int, log: SessionLog | None, with_log: bool) -> Trajectory:
    columns = (*_POSE, *session.kind.columns)
    table = read_numbers(session.runs[index], columns, header_lines=0)
    if len(table.values) < 2:
        raise DataError(f"{table.file}: a run needs two rows or more")
    times = table.increasing("t") - table.values[0, 0]
    ticks = table.columns(session.kind.ticks) * session.kind.signs
    driven = ticks * session.angle_per_tick
    run = Trajectory(
        id=f"{session.group}_{session.runs[index].stem}",
        split="train",
        times=times[1:],
        rates=driven[1:] / np.diff(times)[:, None],
        pose_times=times,
        poses=table.columns(_POSE[1:]),
        session=session.name,
        duration=float(times[-1]),
        steering=table.columns(("steering",))[1:] if "steering" in table else None,
    )
    if not with_log:
        return run
    return _with_command(run, session) if log is None else _with_log(run, session, log, table, ticks)


def _with_log(
    run: Trajectory, session: SessionMetadata, log: SessionLog, table: NumberTable, ticks: Array
) -> Trajectory:
    match = _RUN.search(table.file.name)
    assert match is not None  # only such files are collected
    number = int(match.group(1))
    start = session.starts[number - 1] if number <= len(session.starts) else 0.0
    part = log.stretch(number, round(start / float(np.median(np.diff(run.pose_times)))), len(table.values))
    if part is None or not np.allclose(part.ticks, ticks, rtol=0, atol=_SAME_TICKS):
        raise DataError(
            f"{log.file}: does not hold the ticks of {table.file.name}; import with log: false to do without"
        )
    run = replace(run, angles=part.angles[1:], started_at=float(part.times[0] - log.begin))
    if part.commands is None:
        return _with_command(run, session, log)
    told = _Motion.of(part.commands, np.diff(part.times, prepend=part.times[0]))
    run = replace(run, v=told.v, alpha=told.alpha, omega=told.omega, distance=told.distance)
    return _with_command(run, session, log, told)


def _with_command(
    run: Trajectory, session: SessionMetadata, log: SessionLog | None = None, told: _Motion | None = None
) -> Trajectory:
    """The run with the name of its command: what was told, as far as the log has it, and what the robot made of that by
    the odometry by which it drove."""
    robot = Robot(name=session.robot, wheels=session.kind.wheels(session.geometry))
    middle = None if run.steering is None else in_the_middle(run.steering)
    twists = robot.drive.signals(run.rates, middle) @ robot.inverse_kinematic_matrix.T
    driven = _Motion.of(twists, np.diff(run.times, prepend=0.0))
    direction = round(math.degrees((told or driven).alpha) / 5) * 5
    turn = round(math.degrees(driven.turned) / 90) * 90
    speed = f"_v{told.fastest:.2g}" if told else ""
    path = log.path if log else f"_{driven.distance:.1f}m"
    return replace(run, command=f"{session.group}_a{direction}_turn{turn:+d}{speed}{path}")
