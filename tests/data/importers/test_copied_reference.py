"""A reference that is the robot's own odometry is recognised for every class of robots; an independent one is not."""

from __future__ import annotations

import numpy as np
import pytest
from sample_robots import APR_02, WHEELED

from omnibench.data.dataset import Trajectory, make_dataset
from omnibench.data.importers.copied_reference import follows_the_wheels
from omnibench.robot.kinematics import Array, CarDrive, Robot

PERIOD, SAMPLES = 0.02, 3000  # s: a minute of driving
EVERY = 3  # samples from one reference pose to the next
each_robot = pytest.mark.parametrize("robot", [APR_02, *WHEELED], ids=lambda robot: robot.name)


def driven(robot: Robot) -> tuple[Array, Array, Array]:
    """Rates (F, N), steering angles (F, S) at the samples' ends, and twists (F, 3) of a smooth drive from rest."""
    times = PERIOD * np.arange(1, SAMPLES + 1)
    ahead, turn = robot.motions[0], robot.motions[-1]
    speed = 0.3 * np.minimum(times, 1.0)
    bend = np.sin(times / 2) + 0.4 * np.sin(1.3 * times + 1)
    twists = speed[:, None] * (ahead + 0.9 * bend[:, None] * turn)
    if len(robot.motions) == 3:
        twists += speed[:, None] * 0.3 * np.cos(times / 3)[:, None] * robot.motions[1]
    rates, steering = robot.drive.commands(twists @ robot.signal_equations.T)
    return rates, np.unwrap(steering, axis=0), twists


def run(robot: Robot, rates: Array, steering: Array, headings: Array, late: int) -> Trajectory:
    """A run with a reference that shows the headings (F + 1,) at the samples' ends, some samples late."""
    times = PERIOD * np.arange(SAMPLES + 1)
    shown = np.arange(0, SAMPLES + 1, EVERY)
    poses = np.column_stack([np.zeros((len(shown), 2)), headings[np.maximum(shown - late, 0)]])
    angles = steering if robot.drive.steered else None
    data = make_dataset(
        robot.name, robot, PERIOD, [Trajectory("run", "train", times[1:], rates, times[shown], poses, steering=angles)]
    )
    return data.trajectories[0]


def odometry(robot: Robot, rates: Array, steering: Array, of_a_driver: bool = False) -> Array:
    """Headings (F + 1,) of a controller with wrong radii and distances, which takes the newest steering angle.

    of_a_driver: a car's by the tangent of its mean angle; of a robot that steers, after a wrong zero and scale.
    """
    drive = robot.drive
    if isinstance(drive, CarDrive) and of_a_driver:
        turns = 1.07 * rates.mean(axis=1) * robot.wheels[0].radius * np.tan(steering.mean(axis=1) + 0.02) / 0.5
    else:
        wrong = robot.inverse_kinematic_matrix[2] * np.linspace(0.9, 1.1, len(drive.names))
        turns = drive.signals(rates, 1.02 * steering + 0.02 if of_a_driver else steering) @ wrong
    return np.append(0.0, np.cumsum(turns * PERIOD))


@each_robot
@pytest.mark.parametrize("late", [0, 1, 2])
def test_the_robot_s_own_odometry_is_recognised(robot: Robot, late: int) -> None:
    rates, steering, _ = driven(robot)
    noisy = rates * (1 + 0.01 * np.random.default_rng(1).normal(size=rates.shape))
    residual = follows_the_wheels([run(robot, noisy, steering, odometry(robot, noisy, steering), late)])
    assert residual is not None
    assert residual < 3e-4


@pytest.mark.parametrize("robot", [each for each in WHEELED if each.drive.steered], ids=lambda robot: robot.name)
def test_odometry_that_reads_the_steering_otherwise_is_recognised(robot: Robot) -> None:
    rates, steering, _ = driven(robot)
    headings = odometry(robot, rates, steering, of_a_driver=True)
    assert follows_the_wheels([run(robot, rates, steering, headings, 0)]) is not None


@each_robot
def test_an_independent_reference_is_not_taken_for_odometry(robot: Robot) -> None:
    rng = np.random.default_rng(2)
    rates, steering, twists = driven(robot)
    noisy = rates * (1 + 0.01 * rng.normal(size=rates.shape))  # slip
    true = np.append(0.0, np.cumsum(twists[:, 2] * PERIOD)) + 1e-3 * rng.normal(size=SAMPLES + 1)
    assert follows_the_wheels([run(robot, noisy, steering, true, 0)]) is None
