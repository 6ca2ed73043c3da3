"""Makes the recording of a row of the table."""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any
from zlib import crc32

import numpy as np
from numpy.random import Generator

from strangers.bags import write_bag
from strangers.faults import spoil
from strangers.files import FORMS, lines, names, text, write_positions, write_robot, write_tables
from strangers.motion import (
    STEP,
    Array,
    Log,
    Robot,
    changed,
    commands,
    design,
    profile,
    recorded,
    simulate,
    slightly_off,
    wheel_motion,
)  # fmt: skip

Row = dict[str, Any]
_RECORD = ("hz", "pose_hz", "noise", "walk", "tracked")


def make(row: Row, folder: Path, shared: Path) -> Log | None:
    """Write the files of a row into a folder; its log, None for a case of other makers."""
    seed = crc32(f"{row.get('robot')} {row['name']}".encode())
    if "case" in row:
        copy_case(row, made(shared), folder)
        return None
    if "car" in row:
        return _commanded(folder, seed, **row["car"])
    robot = design(row["robot"], **row.get("design", {}))
    true = _true(robot, row["true"]) if row.get("true") else slightly_off(robot)
    motions = {name: [segment] for name, segment in row.get("motions", {}).items()}
    motions = motions or commands(row["robot"], row.get("v", 0.3), row.get("w", 0.8), row.get("seconds", 6.0))
    motions = {name: motions[name] for name in row.get("only", motions)}
    record = {key: row[key] for key in _RECORD if key in row}
    if "bag" in row:
        twists, full = profile([segment for segments in motions.values() for segment in segments] * 2)
        drive = recorded(np.random.default_rng(seed), twists, *wheel_motion(true, twists, full), **record)
        log = Log(robot, true, {"drive": drive})
        write_bag(drive, write_robot(log, folder) / "drive.bag", **row["bag"])
        return log
    log = simulate(robot, seed, motions, true=true, repeats=row.get("repeats", 3), **record)
    if row.get("clean"):
        write_tables(log, folder / "clean")
    spoil(log, np.random.default_rng(seed), row.get("do", {}))
    form, prefix = row.get("form"), row.get("prefix", "phi")
    if form == "positions":
        write_positions(log, folder / "log", row.get("scale", 1.0))
    elif form:
        for name, run in log.runs.items():
            FORMS[form](run, names(log, prefix), write_robot(log, folder / "log") / name)
    else:
        write_tables(log, folder / "log", prefix)
    return log


def _true(robot: Robot, factors: dict[str, dict[str, float]]) -> Robot:
    for name, of_wheel in factors.items():
        robot = changed(robot, of_wheel, "" if name == "all" else name)
    return robot


@cache
def made(shared: Path) -> Path:
    """A copy of the shared cases in which all their makers have run."""
    folder = Path(mkdtemp(prefix="strangers-cases-")) / "cases"
    shutil.copytree(shared, folder, copy_function=shutil.copyfile)
    for place in [folder, *(path for path in folder.rglob("*") if path.is_dir())]:
        place.chmod(0o755)
    for maker in sorted(folder.glob("*/*.py"), key=lambda file: (file.name != "make.py", file)):
        subprocess.run([sys.executable, maker.name], cwd=maker.parent, check=True, capture_output=True)
    return folder


def copy_case(row: Row, cases: Path, folder: Path) -> None:
    case = cases / row["case"]
    if row.get("importer") == "rosbag":
        shutil.copy(case / "bags" / f"{row['files']}.bag", folder / "drive.bag")
    else:
        shutil.copytree(case / row["files"], folder / "log")
    for option in row["options"]:
        if option.startswith("robot="):
            file = option.removeprefix("robot=")
            shutil.copy(case / file if (case / file).is_file() else next(cases.glob(f"*/{file}")), folder)


# A car whose steering is a command in -1..1 that a servo follows late, and whose only wheel is a speed in m/s.
_WHEELBASE, _RADIUS, _SECONDS = 0.18, 0.03, 100.0  # m, m, s


def _steps(rng: Generator, shortest: float, longest: float, low: float, high: float) -> Array:
    """A command (n,) at 1 kHz that changes at random times, smoothed over 0.2 s."""
    values: list[Array] = []
    count = round(_SECONDS / STEP)
    while sum(map(len, values)) < count + 200:
        values.append(np.full(round(rng.uniform(shortest, longest) / STEP), rng.uniform(low, high)))
    smooth: Array = np.convolve(np.concatenate(values), np.full(200, 1 / 200), "valid")[:count]
    return smooth


def _commanded(
    folder: Path, seed: int, scale: float, zero: float, lag: float = 0, delay: float = 0, held: int = 1
) -> Log:
    """Two drives of 100 s at 100 Hz. lag, delay: s, of first order and pure; held: rows for which a sensor repeats."""
    rng = np.random.default_rng(seed)
    robot = design("car", radius=_RADIUS, x=_WHEELBASE)
    robot["wheels"] = [robot["wheels"][0], robot["wheels"][1] | {"name": "rear", "y": 0.0}]
    log = Log(robot, robot)
    for name in ("drive_1", "drive_2"):
        command, speed = np.round(_steps(rng, 0.8, 3.0, -1.0, 1.0), 3), _steps(rng, 2.0, 6.0, 0.4, 1.4)
        late = np.concatenate([np.full(round(delay / STEP), command[0]), command])[: len(command)]
        angle, state = np.empty_like(late), late[0]
        for row, target in enumerate(late):
            state += (target - state) * (1 - math.exp(-STEP / lag) if lag else 1.0)
            angle[row] = scale * state + zero
        twists = np.column_stack([speed, np.zeros_like(speed), speed * np.tan(angle) / _WHEELBASE])
        run = recorded(rng, twists, speed[:, None] / _RADIUS, angle[:, None], hz=100.0, pose_hz=100.0, walk=0.003)
        rows = (run.times / STEP).round().astype(int).clip(max=len(command) - 1)
        told = np.column_stack([speed + rng.normal(0, 0.005, len(speed)), command])[rows]
        told = told[np.arange(len(told)) // held * held]
        head = ["t", "speed", "steering", "x", "y", "theta"]
        table = [map(text, row) for row in np.column_stack([run.times, told, run.poses])]
        (write_robot(log, folder / "log") / f"{name}.csv").write_text(lines([head, *map(list, table)]))
        log.runs[name] = run
    return log
