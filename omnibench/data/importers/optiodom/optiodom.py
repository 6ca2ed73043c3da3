"""Importer of the OptiOdom recordings: three-wheeled omni robot, encoders and motion capture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import Field

from omnibench.data.alignment import median_period
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.delimited import NumberTable, read_numbers
from omnibench.data.importer import Importer
from omnibench.data.importers.optiodom.session_files import (
    SessionLog,
    SessionMetadata,
    read_log,
    read_metadata,
    run_number,
)
from omnibench.data.splits import Names, complete, divided
from omnibench.errors import DataError
from omnibench.registry import Options, importers
from omnibench.robot.kinematics import Array, Robot, Wheel

_COLUMNS = ("t", "x", "y", "theta", "ticks_0", "ticks_1", "ticks_2")
_AXLES_DEG = (300, 60, 180)
_SAME_SPEED = 0.02  # m/s, rad/s: commands below are standstill
_DESCRIPTION = (
    "INESC TEC three-wheeled omnidirectional robot, encoders at 25 Hz and OptiTrack; Sousa, Petry, Costa, Moreira: "
    "OptiOdom, J. Intell. Robot. Syst. 105:39 (2022), doi 10.1007/s10846-022-01630-3. Encoders and OptiTrack were "
    "synchronised by hand, run by run: offsets up to 0.2 s and a drift of about 0.1 s a minute remain."
)


class OptiodomOptions(Options):
    """Choice of groups that train and validate. A group is the folder that holds session folders: circular, square."""

    train: Names = Field((), description="groups that train; default: the first by name")
    validation: Names = Field((), description="groups that validate; default: all others")
    log: bool = Field(True, description="read commands and absolute wheel angles from each session's own log")
    name: str = Field("optiodom", min_length=1, description="name of the data set")
    robot_name: str = Field("inesc_tec_omni3", min_length=1)
    source: str = "public GitHub repository sousarbarb/optiodom, commit 8e025fd7"


@importers.register("optiodom")
class Optiodom(Importer):
    """OptiOdom recordings (Sousa et al. 2022): session folders with runs of encoders and motion capture.

    The source is any folder above session folders, or one of them; a session is found by ``<session>_metadata.csv``.
    Beside it are ``<session>_run-NN.csv`` (t, x, y, theta, three tick increments; no header) and the robot's own log
    ``<session>.csv``, from which come commands and absolute wheel angles. The authors' wheels 0, 1, 2 turn the other
    way round and stand at 300, 60, 180 degrees in the convention of omnibench, so ticks are negated here. A row's ticks
    were driven since the row before; the row at t = 0 only gives the start pose.

    Runs share a command when group, direction, radius and its shrinkage, speed and total commanded turn (to the nearest
    quarter) agree. v, alpha and omega are medians over the commanded motion.

    Splits: with one group and no options every second run of a command validates. With two or more the first group by
    name trains and the others validate; ``train`` and ``validation`` say otherwise (patterns such as ``circ*`` work).
    Groups that neither names are left out.
    """

    Options = OptiodomOptions
    options: OptiodomOptions

    def read(self, source: Path) -> Dataset:
        """All sessions under ``source``; DataError names the file and the row of what is wrong."""
        sessions = [read_metadata(file) for file in sorted(source.resolve().rglob("*_metadata.csv"))]
        if not sessions:
            raise DataError(f"{source}: no *_metadata.csv below it; name a folder with OptiOdom sessions (data/omni3)")
        robot = self._robot(sessions)
        runs = [run for session in sessions for run in _read_session(session, self.options.log)]
        groups = [session.group for session in sessions for _ in session.runs]
        train, validation = self.options.train, self.options.validation
        if not train and not validation and len(set(groups)) > 1:
            train = (min(groups),)
        return make_dataset(
            self.options.name,
            robot,
            median_period([run.pose_times for run in runs]),
            divided(complete(runs), train, validation, "group", names=groups),
            description=_DESCRIPTION,
            source=self.options.source,
            licence="MIT",
        )

    def _robot(self, sessions: Sequence[SessionMetadata]) -> Robot:
        first = sessions[0]
        for session in sessions[1:]:
            if session.geometry != first.geometry:
                raise DataError(f"{session.file}: geometry differs from {first.file}; import one robot at a time")
        wheels = (
            Wheel(
                name=str(index),
                radius=diameter / 2,
                distance=first.distance,
                angle=math.radians(axle),
                roller_angle=0.0,
            )
            for index, (diameter, axle) in enumerate(zip(first.diameters, _AXLES_DEG, strict=True))
        )
        return Robot(name=self.options.robot_name, wheels=tuple(wheels))


@dataclass(frozen=True)
class _Command:
    """The command of a run by the session's log: m/s, rad, rad/s, m."""

    name: str
    v: float
    alpha: float
    omega: float
    distance: float


def _read_session(session: SessionMetadata, with_log: bool) -> list[Trajectory]:
    log = read_log(session) if with_log else None
    return [_read_run(session, index, log) for index in range(len(session.runs))]


def _read_run(session: SessionMetadata, index: int, log: SessionLog | None) -> Trajectory:
    table = read_numbers(session.runs[index], _COLUMNS, header_lines=0)
    if len(table.values) < 2:
        raise DataError(f"{table.file}: a run needs two rows or more")
    times = table.increasing("t") - table.values[0, 0]
    ticks = table.columns(_COLUMNS[4:])
    driven = -ticks * session.angle_per_tick
    run = Trajectory(
        id=f"{session.group}_{session.runs[index].stem}",
        split="train",
        times=times[1:],
        rates=driven[1:] / np.diff(times)[:, None],
        pose_times=times,
        poses=table.columns(("x", "y", "theta")),
        session=session.name,
        duration=float(times[-1]),
    )
    return run if log is None else _with_log(run, session, log, table, ticks)


def _with_log(
    run: Trajectory, session: SessionMetadata, log: SessionLog, table: NumberTable, ticks: Array
) -> Trajectory:
    number = run_number(table.file)
    start = session.starts[number - 1] if number <= len(session.starts) else 0.0
    part = log.stretch(number, round(start / float(np.median(np.diff(run.pose_times)))), len(table.values))
    if part is None or not np.array_equal(part.ticks, -ticks):
        raise DataError(
            f"{log.file}: does not hold the ticks of {table.file.name}; import with log: false to do without"
        )
    command = _command(session, log, part.commands, part.times)
    return replace(
        run,
        angles=part.angles[1:],
        started_at=float(part.times[0] - log.begin),
        command=command.name,
        v=command.v,
        alpha=command.alpha,
        omega=command.omega,
        distance=command.distance,
    )


def _command(session: SessionMetadata, log: SessionLog, twists: Array, times: Array) -> _Command:
    """The command behind commanded twists (rows, 3) in m/s, m/s, rad/s."""
    speeds = np.hypot(twists[:, 0], twists[:, 1])
    moving = (speeds > _SAME_SPEED) | (np.abs(twists[:, 2]) > _SAME_SPEED)
    durations = np.diff(times, prepend=times[0])
    turned = math.degrees(float(twists[:, 2] @ durations))
    vx, vy, omega = np.median(twists[moving], axis=0) if moving.any() else np.zeros(3)
    alpha = math.atan2(vy, vx)
    direction = round(math.degrees(alpha) / 5) * 5
    turn = round(turned / 90) * 90
    name = f"{session.group}_a{direction}_turn{turn:+d}_v{speeds.max():.2g}{log.path}"
    return _Command(name, float(np.hypot(vx, vy)), alpha, float(omega), float(speeds @ durations))
