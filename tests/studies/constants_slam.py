"""Study of the constants of SLAM: what would change if each were half or twice as large.

    python tests/studies/constants_slam.py --out constants_slam.jsonl [--part slam] [--only motion_prior] [--table]

Runs in simulated rooms; constant_study.py says what the table holds.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
from constant_study import Answer, Part, Value, carry_out, estimates, stated, words
from slam_study import Run, drive, flower_command

from omnibench.data.scans import TrajectoryScans
from omnibench.simulate.commands import Command
from omnibench.simulate.floor_plan import RoomPlan, make_plan
from omnibench.simulate.lidar import Lidar
from omnibench.slam.slam_dataset import run_slam
from omnibench.slam.slam_options import SlamOptions


@cache
def scanned(room: str) -> tuple[Run, ...]:
    """Two runs in a room."""
    plan = make_plan(RoomPlan(plan=room), room)
    return tuple(drive(plan, Lidar(), flower_command(n), np.random.default_rng([5, n])) for n in (1, 3))


def of_path(run: Run, start: Literal["odometry", "last_pose"], lidar: Lidar) -> Answer:
    """The figures of one run."""
    path = run_slam(run.scans, lidar.scanner, SlamOptions(start=start), np.zeros(3), run.odometry)
    errors = (path.poses - run.true)[1:]
    deviations = np.sqrt(np.diagonal(path.covariances[1:], axis1=1, axis2=2))
    nees = (errors * np.linalg.solve(path.covariances[1:], errors[:, :, None])[:, :, 0]).sum(axis=1)
    return {
        "poses": estimates(path.poses[1:], deviations),
        "deviations": stated(deviations),
        "words": words(*path.warnings),
        "error mm": Value(kind="error", values=(1e3 * float(np.hypot(*errors[:, :2].T).mean()),)),
        "nees": Value(kind="nees", values=(float(nees.mean()),)),
    }


def answers_of_slam() -> Answer:
    """Poses in three rooms from both starts, their errors and how honest their covariances are."""
    starts: tuple[Literal["odometry", "last_pose"], ...] = ("odometry", "last_pose")
    found = {
        f"{room}, {start}, {index}": of_path(run, start, Lidar())
        for room in ("furnished_room", "hall", "corridor")
        for start in starts
        for index, run in enumerate(scanned(room))
    }
    return {f"{name}: {figure}": value for name, of in found.items() for figure, value in of.items()}


@cache
def hard_runs() -> dict[str, tuple[Run, Lidar]]:
    """Runs in rooms that hide the heading, of a quick robot, and of a scanner that is mounted upside down."""
    runs = {}
    few = Lidar(rays=361)
    for corners, radius, lidar in ((72, 3.0, Lidar()), (400, 8.0, Lidar()), (400, 3.0, few)):
        angles = 2 * np.pi * np.arange(corners) / corners
        boundary = tuple((radius * math.cos(angle), radius * math.sin(angle)) for angle in angles)
        plan = make_plan(RoomPlan(boundary=boundary, start=(0.0, 0.0, 0.0)), "round")
        run = drive(plan, lidar, flower_command(2), np.random.default_rng([5, 2]), distance=0.9)
        runs[f"{corners} corners of {radius:g} m, {lidar.rays} rays"] = run, lidar
    furnished = make_plan(RoomPlan(plan="furnished_room"), "furnished")
    for turn in (-1.2, 1.2):
        run = drive(furnished, Lidar(), Command(0.5, 1.0, turn), np.random.default_rng(7))
        runs[f"quickly, {turn} rad/s"] = run, Lidar()
    right = scanned("furnished_room")[0]
    mirrored = TrajectoryScans(right.scans.times, np.ascontiguousarray(right.scans.ranges[:, ::-1]))
    return runs | {"mirrored": (replace(right, scans=mirrored), Lidar())}


def answers_of_hard_slam() -> Answer:
    """Poses where scans mislead or tell little."""
    found = {
        name: of_path(run, "last_pose" if name.startswith("quickly") else "odometry", lidar)
        for name, (run, lidar) in hard_runs().items()
    }
    return {f"{name}: {figure}": value for name, of in found.items() for figure, value in of.items()}


PARTS = {
    "slam": Part("omnibench.slam", answers_of_slam),
    "hard_slam": Part("omnibench.slam", answers_of_hard_slam),
}

if __name__ == "__main__":
    carry_out(PARTS, __doc__)
