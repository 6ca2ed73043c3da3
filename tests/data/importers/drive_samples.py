"""A small robot's drives with rests and turns, as a recorder would write them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from sample_robots import DIFFERENTIAL as ROBOT

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

DIFF: dict[str, Any] = ROBOT.model_dump(mode="json")  # as a file has it
MODEL = OdometryModel.of_design(ROBOT, "arc")
PERIOD, POSE_PERIOD = 0.02, 0.1  # s


@dataclass(frozen=True)
class Drive:
    """Wheel samples that end at ``times`` (F,), s, with rates (F, 2), rad/s, and noisy poses (K, 3) at pose_times."""

    times: Array
    rates: Array
    pose_times: Array
    poses: Array


def drive(
    seed: int, length: float = 20.0, start: tuple[float, float, float] = (0.5, -0.3, 0.4), noise: float = 1.0
) -> Drive:
    """A second of rest, then speeds and turns that change every second or so, and a second of rest."""
    rng = np.random.default_rng(seed)
    times = PERIOD * np.arange(1, round(length / PERIOD) + 1)
    knots = np.arange(0.0, length + 1, 1.0)
    speed = np.interp(times, knots, rng.uniform(0.05, 0.4, len(knots)))
    turn = np.interp(times, knots, rng.uniform(-1.0, 1.0, len(knots)))
    driving = np.clip(np.minimum(times - 1.0, length - 1.0 - times), 0.0, 0.5) / 0.5
    twists = np.column_stack([speed, np.zeros_like(speed), turn]) * driving[:, None]
    rates = twists @ np.linalg.pinv(MODEL.matrix).T
    pose_times = POSE_PERIOD * np.arange(0, round(length / POSE_PERIOD) + 1)
    (poses,) = MODEL.poses([WheelLog(times, rates, np.array(start), pose_times)])
    return Drive(times, rates, pose_times, poses + noise * rng.normal(0, (0.001, 0.001, 0.002), poses.shape))


def trajectory(name: str, of: Drive, split: str = "train") -> Trajectory:
    """The drive as a run of a data set."""
    return Trajectory(name, split, of.times, of.rates, of.pose_times, of.poses)  # type: ignore[arg-type]


def dataset(*runs: Trajectory) -> Dataset:
    """The runs as a data set of the robot."""
    return make_dataset("drives", ROBOT, PERIOD, runs)


def odometry_error(data: Dataset) -> float:
    """Largest distance, m, of the design's odometry from the reference at any pose."""
    model = OdometryModel.of_design(data.robot, "arc")
    odometry = model.poses([run.reference_log for run in data.trajectories])
    errors = [poses - run.poses[1:] for run, poses in zip(data.trajectories, odometry, strict=True)]
    return max(float(np.hypot(*error[:, :2].T).max()) for error in errors)
