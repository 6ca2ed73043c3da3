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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import cycle
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray
from pydantic import Field

from omnibench.config import Model, read_yaml
from omnibench.data.clock_matching import usual_period
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.delimited import read_numbers
from omnibench.data.importer import Importer
from omnibench.data.splits import Names, complete, divided
from omnibench.errors import DataError, nearest
from omnibench.files import read_text
from omnibench.registry import Options, importers
from omnibench.robot.kinematics import Array, Robot, in_the_middle
from omnibench.words import plural

RobotType = Literal["diff", "omni3", "omni4", "tricyc"]
_SOURCE = "public GitHub repository sousarbarb/optiodom, commit 8e025fd7"
_RUN = re.compile(r"_run-(\d+)\.csv$")
_POSE = ("t", "x", "y", "theta")
_SAME_SPEED = 0.02  # m/s, rad/s: commands below are standstill
_SAME_TICKS = 1e-6  # logs of turns are rounded to some digits


class Kind(Model):
    """A robot, and the columns of its files; ``optiodom.yaml`` says what each means."""

    title: str
    description: str
    lengths: int
    wheels: tuple[dict[str, Any], ...]
    columns: tuple[str, ...]
    signs: tuple[int, ...]
    log_fields: int
    log_ticks: tuple[int, ...]
    log_signs: tuple[int, ...]
    log_commands: tuple[int, ...] = ()

    def robot(self, lengths: Sequence[float], diameters: Sequence[float], name: str) -> Robot:
        """The robot of these dimensions, m. Of a tricycle, whose metadata state one diameter, all wheels have this."""
        scales = {"x": lengths[0], "y": lengths[-1], "distance": lengths[0]}
        wheels = []
        for wheel, diameter in zip(self.wheels, cycle(diameters), strict=False):
            scaled = {key: wheel[key] * scale for key, scale in scales.items() if key in wheel}
            wheels.append({**wheel, **scaled, "radius": diameter / 2})
        return Robot.model_validate({"name": name, "wheels": wheels})


@cache
def kinds() -> dict[str, Kind]:
    """The robots by their type in the metadata."""
    content = read_yaml(Path(__file__).with_suffix(".yaml"))
    return {name: Kind(**kind, description=content["description"]) for name, kind in content["robots"].items()}


@dataclass(frozen=True)
class Session:
    """Content of ``<session>_metadata.csv``, and the run files beside it by their numbers.

    group: name of the folder that holds session folders. robot: its type. lengths, diameters: design values, m: L, or
    L1 and L2; of the wheels. angle_per_tick: of a wheel, rad. starts: when each run's file begins in the session's log,
    s after the run's begin there.
    """

    file: Path
    name: str
    group: str
    robot: str
    lengths: tuple[float, ...]
    diameters: tuple[float, ...]
    angle_per_tick: float
    starts: tuple[float, ...]
    runs: dict[int, Path]

    @property
    def dimensions(self) -> str:
        """The design values in words; those that are all the same once."""
        shown = [values[:1] if len(set(values)) == 1 else values for values in (self.lengths, self.diameters)]
        lengths, diameters = (", ".join(f"{value:g}" for value in values) for values in shown)
        return f"L {lengths} m, D {diameters} m"


def read_metadata(file: Path) -> Session:
    """Read a session's metadata and find its runs. DataError names the file and the key that is wrong."""
    rows = csv.reader(read_text(file).splitlines())
    values = {key.strip(): [cell.strip() for cell in cells if cell.strip()] for key, *cells in filter(None, rows)}
    robot = "".join(values.get("type", [])[:1])
    if (kind := kinds().get(robot)) is None:
        raise DataError(f"{file}: type is {robot!r}; {nearest(robot, kinds())}it must be one of {', '.join(kinds())}")
    numbers: dict[str, tuple[float, ...]] = {}
    texts = {"odo_ti": [], **values}
    counts = {"Di": len(kind.signs), "Li": kind.lengths, "ngear": 1, "encRes": 1, "odo_ti": len(texts["odo_ti"])}
    for key, count in counts.items():
        if key not in texts:
            raise DataError(f"{file}: key {key!r} is missing; {nearest(key, values)}found: {', '.join(values)}")
        try:
            numbers[key] = tuple(map(float, texts[key]))
        except ValueError:
            numbers[key] = ()
        least, above = (-math.inf, "") if key == "odo_ti" else (0.0, " above 0")
        if len(numbers[key]) != count or not all(least < number < math.inf for number in numbers[key]):
            raise DataError(f"{file}: {key} is {', '.join(texts[key])}, expected {count} numbers{above}")
    name = file.name.removesuffix("_metadata.csv")
    files = sorted(file.parent.glob(f"{name}_run-*.csv"))
    runs = {int(match[1]): path for path in files if (match := _RUN.search(path.name))}
    if not runs:
        raise DataError(f"{file.parent}: no {name}_run-NN.csv beside {file.name}")
    tick = 2 * math.pi / (numbers["ngear"][0] * numbers["encRes"][0])
    group = file.parent.parent.name
    return Session(file, name, group, robot, numbers["Li"], numbers["Di"], tick, numbers["odo_ti"], runs)


@dataclass(frozen=True, eq=False)
class SessionLog:
    """The robot's own log of a session. path: its size, in a name's words. runs (F,): number of the run of each row.

    times (F,): s. ticks, angles (F, N): of the wheels, and rad, in omnibench's sense. commands (F, 3): twists, m/s,
    m/s, rad/s, or (F, 0): they are not logged.
    """

    file: Path
    path: str
    runs: NDArray[np.intp]
    times: Array
    ticks: Array
    angles: Array
    commands: Array


def read_log(session: Session) -> SessionLog | None:
    """The session's log, if it is there. DataError names the file and the line that is wrong."""
    file, kind = session.file.with_name(f"{session.name}.csv"), kinds()[session.robot]
    if not file.is_file():
        return None
    text, line, run = pl.col("text"), pl.col("line"), pl.col("run")
    first = text.str.extract("^([^,]*)")
    number = text.str.extract(r"^Run:,\s*(\d+)\s*(?:,|$)").cast(pl.Int64, strict=False)
    ends = first.is_in(["RUNFINISHED", "METHODFINISHED"]) | first.str.starts_with("+++")
    lines = pl.DataFrame({"text": read_text(file).splitlines()}, {"text": pl.String}).with_row_index("line", 1)
    for row in lines.filter((first == "Run:") & number.is_null())["line"].head(1):
        raise DataError(f"{file}, line {row}: expected the number of a run after 'Run:'")
    # The run that each line stands in, -1 outside of runs; markers are left out.
    lines = lines.with_columns(pl.when(ends).then(-1).otherwise(number).forward_fill().fill_null(-1).alias("run"))
    lines = lines.filter((first != "Run:") & ~ends)
    rows = lines.filter(run >= 0)
    if rows.is_empty():
        raise DataError(f"{file}: it holds no run")
    fields, count = text.str.split(",").list, kind.log_fields
    columns = [fields.get(place, null_on_oob=True).str.strip_chars().alias(f"{place}") for place in range(count)]
    table = rows.select(columns).cast(pl.Float64, strict=False).to_numpy()
    for row in rows["line"].filter(~np.isfinite(table).all(axis=1)).head(1):
        raise DataError(f"{file}, line {row}: expected {count} finite numbers; repair the row")
    header = [row.split(",") for row in lines.filter((run < 0) & (line < rows["line"][0]))["text"]]
    times, ticks, commands = table[:, 0], table[:, kind.log_ticks] * kind.log_signs, table[:, kind.log_commands]
    if len(kind.log_commands) == 2:
        metres = session.angle_per_tick * float(np.mean(session.diameters)) / 2
        speed, turn = commands.T
        commands = np.column_stack([speed * metres, np.zeros(len(table)), turn]) / float(np.median(np.diff(times)))
    angles = np.cumsum(ticks, axis=0) * session.angle_per_tick
    return SessionLog(file, _path(header), rows["run"].to_numpy().astype(np.intp), times, ticks, angles, commands)


def _path(header: Sequence[Sequence[str]]) -> str:
    """Size of the path as a part of a command's name: radius and shrinkage of circles, or the length of a side.

    A log of the differential drive also says by what geometry the robot drove it.
    """
    said = {key: value for line in header for key, value in zip(line[::2], line[1::2], strict=False)}
    shrinkage = next((value for key, value in said.items() if key.startswith("Rrate(")), "")  # its end is garbled
    length, radius = said.get("L(LmxLm):") or said.get("L(Lm):"), said.get("R(m):")
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


class OptiodomOptions(Options):
    """Choice of groups that train and validate. A group is the folder that holds session folders: circular, square."""

    robot: RobotType | None = Field(None, description="the one to import where the source holds several")
    train: Names = Field((), description="groups that train; default: the first by name")
    validation: Names = Field((), description="groups that validate; default: all others")
    log: bool = Field(True, description="read commands and absolute wheel angles from each session's own log")
    name: str = Field("optiodom", min_length=1, description="name of the data set")
    robot_name: str | None = Field(None, min_length=1, description="default: inesc_tec_ and its type")
    source: str = Field(_SOURCE, description="origin of the recording")


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
        options = self.options
        sessions = [read_metadata(file) for file in sorted(source.resolve().rglob("*_metadata.csv"))]
        if not sessions:
            raise DataError(f"{source}: no *_metadata.csv below it; name a folder with OptiOdom sessions (data/omni3)")
        robots = sorted({session.robot for session in sessions})
        robot, found = options.robot or robots[0], ", ".join(robots)
        if options.robot is None and len(robots) > 1:
            way = f"import one at a time: name its folder, or --set robot={robot}"
            raise DataError(f"{source}: it holds recordings of {plural(len(robots), 'robot')}, {found}; {way}")
        if robot not in robots:
            raise DataError(f"{source}: it holds no recordings of robot {robot}; found: {found}")
        sessions = [session for session in sessions if session.robot == robot]
        # The commonest dimensions, of equally common ones the first session's; and a note if there are others.
        (common, most), *others = Counter((each.lengths, each.diameters) for each in sessions).most_common()
        said = {(each.lengths, each.diameters): each.dimensions for each in sessions}
        notes = []
        if others:
            rest = "; ".join(f"{said[other]} in {count}" for other, count in others)
            taken = f"those of {most} of {len(sessions)} are taken, {said[common]} (others: {rest})"
            notes.append(f"sessions state different dimensions of the robot: {taken}")
        runs, groups, unlogged = list[Trajectory](), list[str](), list[str]()
        for session in sessions:
            log = read_log(session) if options.log else None
            unlogged += [session.name] if log is None and options.log else []
            runs += [_read_run(session, number, log, options.log) for number in session.runs]
            groups += [session.group] * len(session.runs)
        if unlogged:
            without = f"{len(unlogged)} of {plural(len(sessions), 'session')} have no log ({', '.join(unlogged)})"
            instead = "commands are named after the motion by the wheels there, and absolute wheel angles are left out"
            notes.append(f"{without}: {instead} of all runs")
        train = options.train
        if not train and not options.validation and len(set(groups)) > 1:
            train = (min(groups),)
        kind, sentences = kinds()[robot], (f"{note[:1].upper()}{note[1:]}." for note in notes)
        description = " ".join([kind.description.format(kind.title), *sentences])
        described: dict[str, Any] = {"description": description, "source": options.source, "licence": "MIT"}
        design = kind.robot(*common, options.robot_name or f"inesc_tec_{robot}")
        parted = divided(complete(runs), train, options.validation, "group", names=groups)
        period = usual_period([run.pose_times for run in runs])
        dataset = make_dataset(options.name, design, period, parted, **described)
        return replace(dataset, warnings=(*notes, *dataset.warnings))


def _motion(twists: Array, durations: Array) -> dict[str, Any]:
    """The motion of twists (rows, 3) in m/s, m/s, rad/s for durations (rows,), s, as fields of a trajectory.

    v (m/s), alpha (rad) and omega (rad/s) are medians while it moves, distance (m) is the length of it all.
    """
    speeds = np.hypot(twists[:, 0], twists[:, 1])
    moving = (speeds > _SAME_SPEED) | (np.abs(twists[:, 2]) > _SAME_SPEED)
    vx, vy, omega = np.median(twists[moving], axis=0) if moving.any() else np.zeros(3)
    direction = {"v": float(np.hypot(vx, vy)), "alpha": math.atan2(vy, vx), "omega": float(omega)}
    return direction | {"distance": float(speeds @ durations)}


def _read_run(session: Session, number: int, log: SessionLog | None, with_log: bool) -> Trajectory:
    """A run; unless logs are left out, with the name of its command: what was sent to the robot, as far as the log has
    it, and what the robot made of that by the odometry by which it drove."""
    kind = kinds()[session.robot]
    table = read_numbers(session.runs[number], (*_POSE, *kind.columns), header_lines=0)
    if len(table) < 2:
        raise DataError(f"{table.file}: a run needs two rows or more")
    times = table.increasing("t")
    times = times - times[0]
    steps, end = np.diff(times), float(times[-1])
    ticks = table.columns(kind.columns[: len(kind.signs)]) * kind.signs
    rates, poses = ticks[1:] * session.angle_per_tick / steps[:, None], table.columns(_POSE[1:])
    steering = table.columns(("steering",))[1:] if "steering" in table else None
    name = f"{session.group}_{table.file.stem}"
    known: dict[str, Any] = {"session": session.name, "duration": end, "steering": steering}
    run = Trajectory(name, "train", times[1:], rates, times, poses, **known)
    if not with_log:
        return run
    robot = kind.robot(session.lengths, session.diameters, session.robot)
    middle = None if steering is None else in_the_middle(steering)
    driven = robot.drive.signals(rates, middle) @ robot.inverse_kinematic_matrix.T
    motion, turned, speed = _motion(driven, steps), math.degrees(float(driven[:, 2] @ steps)), ""
    alpha, path = motion["alpha"], f"_{motion['distance']:.1f}m"
    if log is not None:
        path, start = log.path, session.starts[number - 1] if number <= len(session.starts) else 0.0
        first = round(start / float(np.median(steps)))
        rows = np.flatnonzero(log.runs == number)[first : first + len(ticks)]
        if len(rows) < len(ticks) or not np.allclose(log.ticks[rows], ticks, rtol=0, atol=_SAME_TICKS):
            raise DataError(f"{log.file}: does not hold the ticks of {table.file.name}; do without it by log: false")
        logged = log.times[rows]
        run = replace(run, angles=log.angles[rows[1:]], started_at=float(logged[0] - log.times[0]))
        if log.commands.size:
            sent = log.commands[rows]
            motion, speed = _motion(sent, np.diff(logged, prepend=logged[0])), f"_v{np.hypot(*sent[:, :2].T).max():.2g}"
            run, alpha = replace(run, **motion), motion["alpha"]
    direction, turn = round(math.degrees(alpha) / 5) * 5, round(turned / 90) * 90
    return replace(run, command=f"{session.group}_a{direction}_turn{turn:+d}{speed}{path}")
