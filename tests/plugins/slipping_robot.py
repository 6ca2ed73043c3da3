"""Recordings of a robot with a slip that no matrix has, made by code that shares no odometry with the package."""

import math

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.testing import synthetic_robot

PERIOD = 0.05  # s
_FINE = 20  # steps of the true motion in a sample


def slipping(seed: int = 0, sessions: int = 5, seconds: float = 8.0) -> Dataset:
    """Runs of a three-wheeled robot that turns less, and slides outwards, the faster it turns while driving."""
    rng, robot = np.random.default_rng(seed), synthetic_robot(3)
    to_wheels = np.linalg.inv(robot.inverse_kinematic_matrix)
    commands = [(0.2, math.radians(60 * way), turn) for way, turn in enumerate([-1.0, -0.7, -0.4, 0.4, 0.7, 1.0])]
    trajectories = []
    for number in range((sessions + 1) * len(commands)):
        session, command = divmod(number, len(commands))
        speed, direction, turn = np.array(commands[command]) * rng.uniform(0.95, 1.05, 3)
        samples = round(seconds / PERIOD)
        times = PERIOD * np.arange(1, samples + 1)
        rates, poses = np.zeros((samples, 3)), np.zeros((samples + 1, 3))
        for k in range(samples):
            wanted = np.array([speed * math.cos(direction), speed * math.sin(direction), turn])
            wanted *= min(1.0, times[k]) * (1 + 0.1 * math.sin(times[k]))
            rates[k] = to_wheels @ wanted
            vx, vy, w = wanted
            w -= 0.15 * w**3
            vx, vy = vx + 0.04 * w * vy, vy - 0.04 * w * vx
            x, y, heading = poses[k]
            for _ in range(_FINE):
                step = PERIOD / _FINE
                heading += w * step / 2
                x += (vx * math.cos(heading) - vy * math.sin(heading)) * step
                y += (vx * math.sin(heading) + vy * math.cos(heading)) * step
                heading += w * step / 2
            poses[k + 1] = x, y, heading
        noise = rng.normal(0, 1, poses.shape) * [1e-3, 1e-3, 2e-3]
        noise[0] = 0
        trajectories.append(
            Trajectory(
                id=f"run{number}",
                split="train" if session < sessions else "validation",
                times=times,
                rates=rates,
                pose_times=np.append(0.0, times),
                poses=poses + noise,
                session=f"session {session}",
            )
        )
    return make_dataset("slipping", robot, PERIOD, trajectories)
