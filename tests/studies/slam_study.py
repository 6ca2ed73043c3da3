"""Accuracy of SLAM in each room, and consistency of its covariances.

    python tests/studies/slam_study.py --runs 36 --rooms furnished_room hall corridor --starts odometry last_pose

Flower runs of a robot whose odometry is wrong as that of a real one (the design matrix, driven with the paper's Eq. 8).
Every row, one a room and start, is a line of JSON: errors at the end and over all poses (mm, deg), drift, the mean NEES
(3 for an honest covariance) over all poses and at the end, and the bias: the mean error in the robot's frame, along and
across the commanded direction, with its standard error, half-way and at the end. What repeats with the command is what
a calibration or a discovery on such poses would be led by.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from functools import partial

import numpy as np

from omnibench.data.scans import TrajectoryScans
from omnibench.data.true_poses import TruePath
from omnibench.processes import one_thread
from omnibench.robot.kinematics import Array, Robot, Wheel, published_matrix
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.simulate.commands import Command
from omnibench.simulate.floor_plan import FloorPlan, RoomPlan, make_plan
from omnibench.simulate.lidar import Lidar, measure_scans, scan_stamps
from omnibench.simulate.motion_commands import CommandLink, MotionProfile, command_motion, target_rates
from omnibench.slam.slam_dataset import SlamPath, run_slam
from omnibench.slam.slam_options import SlamOptions

ROBOT = Robot(
    name="APR-02",
    wheels=tuple(
        Wheel(name=name, radius=0.148, distance=0.195, angle=np.radians(angle))
        for name, angle in (("a", 60.0), ("b", 180.0), ("c", 300.0))
    ),
)
DESIGN = OdometryModel.of_design(ROBOT, "arc")
TRUE = OdometryModel(ROBOT, published_matrix("palacin2023_eq8"), "arc")
ROOMS = ("furnished_room", "hall", "corridor")
PLACEMENT = np.array([0.02, 0.02, np.radians(2.0)])  # standard deviations of where a run starts


@dataclass(frozen=True, eq=False)
class Run:
    """A run's scans, and where the robot truly was at their stamps."""

    command: Command
    log: WheelLog
    scans: TrajectoryScans
    true: Array

    def odometry(self, times: Array) -> Array:
        stamps, place = np.unique(times, return_inverse=True)
        poses: Array = DESIGN.poses([WheelLog(self.log.times, self.log.rates, np.zeros(3), stamps)])[0][place]
        return poses


def drive(plan: FloorPlan, lidar: Lidar, command: Command, rng: np.random.Generator, distance: float = 1.2) -> Run:
    """One run of a command, from about the room's start."""
    motion = command_motion(command, distance, 6.0, MotionProfile(), CommandLink(), 0.01, 0.6, rng)
    fine = np.linspace(0.0, motion.times[-1], 1 + round(motion.times[-1] / 0.001))
    log = WheelLog(motion.times, target_rates(ROBOT, motion), np.zeros(3), fine)
    (path,) = TRUE.poses([log])
    x, y, heading = plan.start + PLACEMENT * rng.standard_normal(3)
    way = (path[:, 0] + 1j * path[:, 1]) * np.exp(1j * heading)
    track = TruePath(fine, np.column_stack([x + way.real, y + way.imag, heading + path[:, 2]]))
    stamps = scan_stamps(lidar, float(motion.times[-1]), rng)
    scans = measure_scans(plan, lidar, track, stamps, rng)
    return Run(command, log, scans, TruePath(fine, path).at(stamps))


def flower_command(number: int) -> Command:
    """One of the 36 of the paper, in an order that mixes them."""
    return Command(0.2, np.radians(30 * (7 * number % 12)), (-0.35, 0.0, 0.35)[number % 3])


def study(room: str, options: SlamOptions, runs: int, seed: int = 0) -> dict[str, object]:
    """A row of the study."""
    plan, lidar = make_plan(RoomPlan(plan=room), room), Lidar()
    paths: list[SlamPath] = []
    driven: list[Run] = []
    seconds = 0.0
    for number in range(runs):
        rng = np.random.default_rng([seed, number])
        run = drive(plan, lidar, flower_command(number), rng)
        began = time.process_time()
        with one_thread():
            paths.append(run_slam(run.scans, lidar.scanner, options, np.zeros(3), run.odometry))
        seconds += time.process_time() - began
        driven.append(run)
    errors = [path.poses - run.true for path, run in zip(paths, driven, strict=True)]
    nees = [_nees(error, path.covariances) for error, path in zip(errors, paths, strict=True)]
    final = np.array([error[-1] for error in errors])
    every = np.concatenate([error[1:] for error in errors])
    along = [_along_command(error, run) for error, run in zip(errors, driven, strict=True)]
    return {
        "room": room,
        "start": options.start,
        "runs": runs,
        "final": _size(final),
        "every": _size(every),
        "nees": round(float(np.mean(np.concatenate([each[1:] for each in nees]))), 2),
        "nees_final": round(float(np.mean([each[-1] for each in nees])), 2),
        "bias_halfway": _bias(np.array([error[len(error) // 2] for error in along])),
        "bias_final": _bias(np.array([error[-1] for error in along])),
        "stated_final_mm_deg": _in_mm_deg(np.sqrt(np.mean([np.diag(path.covariances[-1]) for path in paths], axis=0))),
        "matched_min": round(min(float(path.matched.min()) for path in paths), 2),
        "problems": sorted({str(warning) for path in paths for warning in path.warnings}),
        "ms_per_scan": round(1000 * seconds / sum(len(path.times) for path in paths), 2),
    }


def _nees(errors: Array, covariances: Array) -> Array:
    nees: Array = np.einsum("ki,ki->k", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0])
    return nees


def _along_command(errors: Array, run: Run) -> Array:
    """Errors along and across the commanded direction, and of the heading."""
    turned = (errors[:, 0] + 1j * errors[:, 1]) * np.exp(-1j * (run.true[:, 2] + run.command.direction))
    return np.column_stack([turned.real, turned.imag, errors[:, 2]])


def _size(errors: Array) -> dict[str, float]:
    position, heading = 1000 * np.hypot(errors[:, 0], errors[:, 1]), np.degrees(np.abs(errors[:, 2]))
    return {
        "mean_mm": round(float(position.mean()), 3),
        "p95_mm": round(float(np.quantile(position, 0.95)), 3),
        "max_mm": round(float(position.max()), 3),
        "mean_deg": round(float(heading.mean()), 4),
        "p95_deg": round(float(np.quantile(heading, 0.95)), 4),
    }


def _bias(errors: Array) -> dict[str, list[float]]:
    spread = errors.std(axis=0)
    return {
        "mean_mm_deg": _in_mm_deg(errors.mean(axis=0)),
        "standard_error_mm_deg": _in_mm_deg(spread / np.sqrt(len(errors))),
    }


def _in_mm_deg(values: Array) -> list[float]:
    return [round(float(value), 4) for value in values * [1000, 1000, np.degrees(1.0)]]


def main() -> None:
    """A line of JSON for each room and start."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=12, help="of each room and start")
    parser.add_argument("--rooms", nargs="+", default=ROOMS, choices=ROOMS)
    parser.add_argument("--starts", nargs="+", default=("odometry",), choices=("odometry", "last_pose"))
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    row = partial(study, runs=given.runs, seed=given.seed)
    for room in given.rooms:
        for start in given.starts:
            print(json.dumps(row(room, SlamOptions(start=start))), flush=True)


if __name__ == "__main__":
    main()
