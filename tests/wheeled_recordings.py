"""Simulated recordings of robots of every class, by code that shares no kinematics with the package but the signals.

Arcs are integrated in a few lines of their own: noise on every reference pose, a random walk and a bias of each run,
and encoder noise.
"""

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.robot.kinematics import Array, Robot

PERIOD, SAMPLES, EVERY = 0.1, 60, 10  # s, samples of a run, samples between reference poses
REPETITIONS = 3


def commands(robot: Robot) -> Array:
    """Twists (C, 3) of the robot's centre, m/s, m/s, rad/s: twelve that it can drive without sliding."""
    speeds = 0.3 * np.array([[1, 0], [1, 0.5], [1, -0.5], [-1, 0.3], [0.7, -0.8], [0.7, 0.8]])
    if len(robot.motions) == 3:
        angles = np.arange(12) * np.pi / 6
        turns = np.tile([0.0, 0.5, -0.5], 4)
        return np.column_stack([0.3 * np.cos(angles), 0.3 * np.sin(angles), turns])
    ahead, turning = robot.motions
    twists: Array = np.array([forward * ahead + 2 * turn * turning for forward, turn in np.vstack([speeds, -speeds])])
    return twists


def path(moved: Array) -> Array:
    """Poses (F + 1, 3) from the origin after motions (F, 3) at constant twist, m, m, rad: exact arcs."""
    poses = [np.zeros(3)]
    for x, y, turn in moved:
        px, py, heading = poses[-1]
        if abs(turn) < 1e-9:
            dx, dy = x, y
        else:
            dx = (x * np.sin(turn) - y * (1 - np.cos(turn))) / turn
            dy = (x * (1 - np.cos(turn)) + y * np.sin(turn)) / turn
        c, s = np.cos(heading), np.sin(heading)
        poses.append(np.array([px + c * dx - s * dy, py + s * dx + c * dy, heading + turn]))
    return np.array(poses)


def recorded(
    robot: Robot,
    matrix: Array,
    rng: np.random.Generator,
    noise: float = 1.0,
    repetitions: int = REPETITIONS,
    samples: int = SAMPLES,
    period: float = PERIOD,
) -> list[Trajectory]:
    """Runs of a robot with a matrix of its own; noise: its size, as a multiple of that of the studies."""
    runs = []
    times = period * np.arange(1, samples + 1)
    for number, twist in enumerate(commands(robot)):
        for repetition in range(repetitions):
            wave = np.sin(np.linspace(0.2, np.pi - 0.2, samples))[:, None]
            rates, steering = robot.drive.commands(wave * (robot.signal_equations @ twist))
            rates = rates + 0.02 * noise * rng.standard_normal(rates.shape)
            middle = (np.vstack([steering[:1], steering[:-1]]) + steering) / 2
            moved = robot.drive.signals(rates, middle) @ matrix.T * period
            true = path(moved)[::EVERY]
            walk = np.cumsum(rng.standard_normal(true.shape), axis=0) * 0.003 * np.sqrt(period * EVERY)
            errors = 0.004 * rng.standard_normal(true.shape) + walk + 0.003 * rng.standard_normal(3)
            errors[0] = 0.0
            stamps = period * EVERY * np.arange(len(true))
            name = f"{number}-{repetition}"
            runs.append(
                Trajectory(
                    name, "train", times, rates, stamps, true + noise * errors, command=str(number),
                    repetition=repetition, session="s", steering=steering if steering.shape[1] else None,
                )
            )  # fmt: skip
    return runs
