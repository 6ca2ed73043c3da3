"""A small recording for the tests of its report: a robot of known truth in a room that it really scans."""

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from driven_path import DrivenPath
from sample_robots import APR_02

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.references import Reference, References
from omnibench.data.scans import ScansInMemory
from omnibench.data.true_poses import TruePath
from omnibench.robot.kinematics import Array, wheel_equations
from omnibench.simulate.floor_plan import FloorPlan, RoomPlan, make_plan
from omnibench.simulate.lidar import Lidar, measure_scans, scan_stamps

COMMANDS = {"straight": (0.2, 0.0), "left": (0.2, 0.35), "right": (0.2, -0.35), "spot": (0.0, 0.35)}
TICK = 0.2  # rad/s, of the measured rates
PERIOD = 0.01
NOISE = np.array([0.002, 0.002, 0.001])  # m, m, rad, of the reference


@dataclass(frozen=True, eq=False)
class Sample:
    """A data set with its hidden truth. starts: of the runs in the room."""

    dataset: Dataset
    truth: dict[str, TruePath]
    plan: FloorPlan
    starts: dict[str, Array]


@cache
def sample(repetitions: int = 2, duration: float = 3.0, rays: int = 90) -> Sample:
    """Runs of each command, in a room of 5 x 4 m with a cupboard; the reference has a noise of 2 mm and 1 mrad."""
    plan = make_plan(
        RoomPlan(
            boundary=((0, 0), (5, 0), (5, 4), (0, 4)),
            obstacles=(((4, 3), (5, 3), (5, 4), (4, 4)),),
            start=(2.5, 2.0, 90.0),
        ),
        "room",
    )
    lidar, rng = Lidar(rays=rays, noise=0.001, dropouts=0.0), np.random.default_rng(5)
    runs, scans, truth, starts = [], {}, {}, {}
    times = PERIOD * np.arange(1, round(duration / PERIOD) + 1)
    slower = min(1.0, 3.0 / duration)  # so that long runs stay in the room
    for command, (speed, turn) in COMMANDS.items():
        for repetition in range(repetitions):
            name = f"{command}-{repetition}"
            twist = np.array([speed * math.cos(0.5), speed * math.sin(0.5), turn]) * slower
            target = np.tile(wheel_equations(APR_02.wheels) @ twist, (len(times), 1))
            true = 1.02 * target
            ticks = np.floor(np.cumsum(true, axis=0) / TICK)
            path = DrivenPath(times, np.zeros(3), true @ APR_02.inverse_kinematic_matrix.T * PERIOD, "arc")
            dense = np.append(0.0, times)
            truth[name] = TruePath(dense, path.poses(dense))
            starts[name] = plan.start + np.array([0.05, -0.03, 0.04]) * rng.standard_normal(3)
            stamps = scan_stamps(lidar, duration, rng)
            track = TruePath(dense, in_room(starts[name], truth[name].poses))
            scans[name] = measure_scans(plan, lidar, track, stamps, rng)
            poses = path.poses(stamps)
            poses[1:] += NOISE * rng.standard_normal(poses[1:].shape)
            runs.append(
                Trajectory(
                    id=name,
                    split="train" if repetition == 0 else "validation",
                    times=times,
                    rates=np.diff(ticks, axis=0, prepend=0.0) * TICK,
                    pose_times=stamps,
                    poses=poses,
                    command=command,
                    repetition=repetition,
                    v=speed * slower,
                    alpha=0.5,
                    omega=turn * slower,
                    duration=duration,
                    targets=target,
                    pose_covariances=np.tile(np.diag(NOISE**2), (len(stamps), 1, 1)),
                )
            )
    dataset = make_dataset("in a room", APR_02, PERIOD, runs, simulated=True, scans=ScansInMemory(lidar.scanner, scans))
    return Sample(dataset, truth, plan, starts)


def in_room(start: Array, poses: Array) -> Array:
    """Poses (K, 3) as seen from a start pose, in the frame of that."""
    cosine, sine = math.cos(start[2]), math.sin(start[2])
    turned = poses[:, :2] @ np.array([[cosine, sine], [-sine, cosine]])
    return np.column_stack([turned + start[:2], poses[:, 2] + start[2]])


def with_a_tape(run: Trajectory) -> Trajectory:
    """A run of which only the length of its way is known."""
    length = float(np.hypot(*np.diff(run.poses[:, :2], axis=0).T).sum())
    references = References.of([Reference("distance", length, 0.003)], float(run.times[-1]))
    return replace(run, pose_times=np.zeros(1), poses=np.zeros((1, 3)), references=references)
