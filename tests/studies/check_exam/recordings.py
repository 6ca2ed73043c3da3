"""The real recordings as plain numbers, read from their original files by readers of the exam's own."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
NAMES = ("omni3", "diff", "tricyc", "omni4", "robotino", "tricycle_corelli")
TURN = 2 * math.pi  # rad
# The authors' first guess of the steering encoder's scale is 0.1, with which the design's motions are 75 % wrong; a fit
# of scale, zero, radius and wheelbase to motions over 1 s (soft L1) gives 0.564, -3.5 deg, 0.00169 m and 1.38 m.
_CORELLI_STEERING = 0.564
_ALIKE = 0.25  # of the numbers that a drive is summed up in: farther apart are other commands
_LEAST_WAY = 0.1  # m, of turns on the spot


@dataclass(frozen=True, eq=False)
class Run:
    """One drive. times (F,): of the counts, s. counts (F, N): positions of the wheels, ticks. steering (F, S): rad.

    pose_times (K,), s, and poses (K, 3): x, y (m), heading (rad). Both times are by clocks of their own.
    """

    name: str
    session: str
    command: str
    times: Array
    counts: Array
    steering: Array
    pose_times: Array
    poses: Array

    @property
    def seconds(self) -> float:
        return float(self.times[-1] - self.times[0])


@dataclass(frozen=True, eq=False)
class Recording:
    """Runs of one robot. robot: content of its robot.yaml; ticks: of a turn of each wheel.

    forward: design matrix from drive signals to the twist of the robot's centre, m and rad per rad.
    """

    robot: str
    description: dict[str, Any]
    wheels: tuple[str, ...]
    steered: tuple[str, ...]
    ticks: float
    forward: Array
    runs: tuple[Run, ...] = field(default=())

    def of(self, runs: list[Run]) -> Recording:
        return replace(self, runs=tuple(runs))


def _wheel(name: str, radius: float, **values: Any) -> dict[str, Any]:
    return {"name": name, "radius": radius, **values}


def _numbered(folder: Path) -> list[Path]:
    return sorted(folder.glob("*/*/*_run-*.csv"))


def _rows(file: Path) -> Array:
    lines = [line.strip().rstrip(",") for line in file.read_text().splitlines() if line.strip()]
    return np.array([[float(text) for text in line.split(",")] for line in lines])


def _optiodom(robot: str, columns: int, signs: tuple[int, ...], per_turn: float) -> list[Run]:
    """Runs of the OptiOdom authors: ``t, x, y, theta``, then increments, then (tricyc) the steering angle."""
    runs = []
    for file in _numbered(DATA / "optiodom" / robot):
        rows = _rows(file)
        increments = rows[:, 4 : 4 + columns] * signs * per_turn
        increments[0] = 0.0  # what row 0 holds belongs to the time before it
        shape, session = file.parts[-3], file.parts[-2]
        number = re.search(r"run-(\d+)", file.name)
        assert number is not None
        name = f"{shape}_{session}_{number.group(1)}"
        counts = np.round(np.cumsum(increments, axis=0), 6)
        steering = rows[:, 4 + columns :] if robot == "tricyc" else np.empty((len(rows), 0))
        runs.append(Run(name, f"{shape}_{session}", "", rows[:, 0], counts, steering, rows[:, 0].copy(), rows[:, 1:4]))
    return runs


def _omni3() -> Recording:
    radius, lever = 0.051, 0.195
    axles = {"w0": 300, "w1": 60, "w2": 180}
    wheels = [_wheel(name, radius, type="omni", distance=lever, angle_deg=angle) for name, angle in axles.items()]
    root = 1 / math.sqrt(3)
    third = 1 / 3
    # With the signs of the files turned round (all three), so that positive rates turn the robot counter-clockwise.
    forward = -radius * np.array([[-root, root, 0], [-third, -third, 2 * third], [-third / lever] * 3])
    return Recording(
        "omni3",
        {"name": "omni3", "wheels": wheels},
        tuple(axles),
        (),
        12 * 1024,
        forward,
        tuple(_optiodom("omni3", 3, (-1, -1, -1), 1.0)),
    )


def _diff() -> Recording:
    radius, apart = 0.042, 0.2
    wheels = [
        _wheel("right", radius, type="fixed", x=0.0, y=-apart / 2),
        _wheel("left", radius, type="fixed", x=0.0, y=apart / 2),
    ]
    forward = radius * np.array([[0.5, 0.5], [0, 0], [1 / apart, -1 / apart]])
    runs = _optiodom("diff", 2, (1, 1), 1.0)
    return Recording("diff", {"name": "diff", "wheels": wheels}, ("right", "left"), (), 43.7 * 64, forward, tuple(runs))


def _tricyc() -> Recording:
    radius, length = 0.0325, 0.15
    rear: dict[str, Any] = {"type": "fixed", "x": 0.0, "measured": False}
    wheels = [
        _wheel("front", radius, type="steered", x=length, y=0.0),
        _wheel("rear_left", radius, y=0.075, **rear),
        _wheel("rear_right", radius, y=-0.075, **rear),
    ]
    forward = radius * np.array([[1, 0], [0, 0], [0, 1 / length]])  # signals: omega cos phi, omega sin phi
    runs = _optiodom("tricyc", 1, (1,), 1.0)
    return Recording("tricyc", {"name": "tricyc", "wheels": wheels}, ("front",), ("front",), 1600, forward, tuple(runs))


def _omni4() -> Recording:
    radius, half = 0.03, 0.1
    corners = (("front_left", 1, 1), ("front_right", 1, -1), ("rear_left", -1, 1), ("rear_right", -1, -1))
    wheels = [
        _wheel(name, radius, type="mecanum", x=x * half, y=y * half, roller_angle_deg=45.0 * x * y)
        for name, x, y in corners
    ]
    # v = mean, vn = (-fl + fr + rl - rr) / 4, w = (-fl + fr - rl + rr) / (4 (half + half)), all wheels forward
    forward = radius / 4 * np.array([[1, 1, 1, 1], [-1, 1, 1, -1], np.array([-1, 1, -1, 1]) / (2 * half)])
    runs = _optiodom("omni4", 4, (1, -1, 1, -1), 11520.0)
    names = tuple(name for name, _, _ in corners)
    return Recording("omni4", {"name": "omni4", "wheels": wheels}, names, (), 11520, forward, tuple(runs))


def _robotino() -> Recording:
    radius, lever = 0.040, 0.125
    axles = {"one": 60, "two": 180, "three": 300}
    wheels = [_wheel(name, radius, type="omni", distance=lever, angle_deg=angle) for name, angle in axles.items()]
    inverse = np.array(
        [[-math.sin(angle), math.cos(angle), lever] for angle in map(math.radians, axles.values())]
    )  # rates times the radius for a twist
    runs = []
    for file in sorted((DATA / "robotino").rglob("exp*.csv")):
        lines = file.read_text().splitlines()
        names = lines[2].split(";")
        rows = np.array([[float(text or "nan") for text in line.split(";")] for line in lines[3:] if line.strip()])
        column = {name: rows[:, index] for index, name in enumerate(names) if name}
        times = column["t"] * 1e-3
        counts = np.column_stack([column["m1pos"], column["m2pos"], column["m3pos"]])
        poses = np.column_stack(
            [-column["ypos"] * 1.83716e-3, -column["xpos"] * 1.84046e-3, np.unwrap(np.radians(column["ang"]))]
        )
        empty = np.empty((len(times), 0))
        runs.append(Run(file.stem, "table", "", times, counts, empty, times.copy(), poses))
    description = {"name": "robotino", "wheels": wheels}
    return Recording("robotino", description, tuple(axles), (), 2000 * 16, radius * np.linalg.inv(inverse), tuple(runs))


def _corelli() -> Recording:
    """The tricycle of tricycle_corelli: one drive; the counter's register unwrapped, steering in rad of the axle."""
    radius, length, ahead = 0.0106141 / TURN, 1.4, 1.5
    rear: dict[str, Any] = {"type": "fixed", "x": 0.0, "measured": False}
    wheels = [
        _wheel("front", radius, type="steered", x=length, y=0.0),
        _wheel("rear_left", radius, y=0.3, **rear),
        _wheel("rear_right", radius, y=-0.3, **rear),
    ]
    number = r"[-+0-9.eE]+"
    rows = []
    for line in (DATA / "tricycle_corelli" / "dataset.txt").read_text().splitlines():
        if line.startswith("time:"):
            values = [float(text) for text in re.findall(rf"(?<=\s){number}(?=\s|$)", line)]
            rows.append(values)
    table = np.array(rows)
    times, steer, traction = table[:, 0] - table[0, 0], table[:, 1], table[:, 2]
    kept = np.append(True, np.diff(times) > 0)
    steps = np.diff(traction[kept])
    counts = np.append(0.0, np.cumsum(steps - 2.0**32 * np.round(steps / 2.0**32)))
    angle = np.where(steer > 4096, steer - 8192, steer) * TURN / 8192 * _CORELLI_STEERING
    poses = table[:, -3:]
    description = {"name": "tricycle_corelli", "mount": {"x": ahead}, "wheels": wheels}
    forward = radius * np.array([[1, 0], [0, ahead / length], [0, 1 / length]])  # of the tracked point
    run = Run("drive", "drive", "", times[kept], counts[:, None], angle[kept, None], times[kept].copy(), poses[kept])
    return Recording("tricycle_corelli", description, ("front",), ("front",), 5000, forward, (run,))


_READERS: dict[str, Callable[[], Recording]] = {
    "omni3": _omni3,
    "diff": _diff,
    "tricyc": _tricyc,
    "omni4": _omni4,
    "robotino": _robotino,
    "tricycle_corelli": _corelli,
}


@cache
def recording(robot: str) -> Recording:
    """All runs of a robot."""
    read = _READERS[robot]()
    if robot == "robotino":  # each run drives another direction
        return read.of([replace(run, command=f"c{number:02d}") for number, run in enumerate(read.runs)])
    return commanded(read)


def commanded(recording: Recording) -> Recording:
    """The recording with a command for each run: runs that drive the same motions for the same way share one."""
    leaders: list[tuple[str, Array]] = []
    runs = []
    for run in recording.runs:
        drive = _outline(run)
        found = next((name for name, other in leaders if (np.abs(drive - other) < _ALIKE).all()), None)
        if found is None:
            found = f"c{len(leaders) + 1:02d}"
            leaders.append((found, drive))
        runs.append(replace(run, command=found))
    return recording.of(runs)


def _outline(run: Run) -> Array:
    """A drive in nine numbers: logarithm of its way; in each third turn (rad) and mean direction of travel, as x, y."""
    track = np.column_stack([run.poses[:, :2], np.unwrap(run.poses[:, 2])])[::5]
    step, heading = np.diff(track, axis=0), track[:-1, 2]
    ways = np.hypot(*step[:, :2].T)
    done = np.cumsum(ways + 0.1 * np.abs(step[:, 2]))
    third = np.minimum((3 * done / done[-1]).astype(int), 2)
    numbers = [math.log(max(float(ways.sum()), _LEAST_WAY))]
    for part in (third == index for index in range(3)):
        along = np.exp(-1j * heading[part]) @ (step[part, 0] + 1j * step[part, 1]) / max(ways[part].sum(), 0.03)
        numbers += [0.2 * float(step[part, 2].sum()), along.real, along.imag]
    return np.array(numbers)
