"""Recordings of chosen motions, for tests of what can be identified from them."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.robot.kinematics import Array, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.testing.synthetic import synthetic_robot, true_robot

Twist = tuple[float, float, float]
SPEED = 0.25  # m/s

RING: tuple[Twist, ...] = tuple((SPEED * math.cos(a), SPEED * math.sin(a), 0.0) for a in np.arange(8) * math.pi / 4)
TURNS: tuple[Twist, ...] = ((0.0, 0.0, 0.6), (0.0, 0.0, -0.6))
FLOWER: tuple[Twist, ...] = tuple((x, y, turn) for x, y, _ in RING for turn in (-0.5, 0.5))


def driven(
    twists: Sequence[Twist],
    *,
    wheels: Literal[3, 4] = 3,
    repetitions: int = 3,
    noise: float = 0.003,
    slip: float = 0.0,
    seed: int = 0,
) -> list[Trajectory]:
    """Runs of 4 s of a robot that is not as designed, every twist (vx, vy, w) of the design repeated.

    noise: of every reference pose but the start, m, m, rad. slip: standard deviation of each wheel's rate over a run,
    as a share.
    """
    rng = np.random.default_rng(seed)
    robot = synthetic_robot(wheels)
    model = OdometryModel(robot, true_robot(robot).inverse_kinematic_matrix, "arc")
    times: Array = 0.1 * np.arange(1, 41)
    stamps = np.append(0.0, times[3::4])
    runs = []
    for command, twist in enumerate(twists):
        for repetition in range(repetitions):
            rates = np.tile(wheel_equations(robot.wheels) @ np.array(twist), (len(times), 1))
            rates = rates * (1 + slip * rng.standard_normal(rates.shape[1]))
            (poses,) = model.poses([WheelLog(times, rates, np.zeros(3), stamps)])
            poses[1:] += noise * rng.standard_normal(poses[1:].shape)
            name = f"{command}-{repetition}"
            runs.append(
                Trajectory(
                    name, "train", times, rates, stamps, poses, command=str(command), repetition=repetition, session="s"
                )
            )
    return runs
