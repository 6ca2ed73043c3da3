"""Runs of robots on fixed and steered wheels."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from sample_robots import CAR, DIFFERENTIAL, SWERVE, TRICYCLE

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

ROBOTS = (DIFFERENTIAL, TRICYCLE, CAR, SWERVE)
_PERIOD = 0.1  # s


def driven(robot: Robot, runs: int = 6, samples: int = 80, seed: int = 1, wrong: float = 0.03) -> Dataset:
    """Runs at changing speeds on curves both ways and straight on, of a robot whose true matrix is ``wrong`` (a share)
    off its design; the motion is smooth, as steering angles are."""
    rng = np.random.default_rng(seed)
    design = robot.inverse_kinematic_matrix
    truth = design * (1 + wrong * rng.standard_normal(design.shape))
    times = _PERIOD * np.arange(1, samples + 1)
    paths = []
    for number in range(runs):
        rates, steering = _commanded(robot, number, times, rng)
        stamps = np.append(0.0, times[4::5])
        start = np.array([0.3, -0.2, 0.7 * number])
        log = WheelLog(times, rates, start, stamps, steering=steering, drive=None if steering is None else robot.drive)
        (poses,) = OdometryModel(robot, truth, "arc").poses([log])
        paths.append(Trajectory(f"run-{number}", "train", times, rates, stamps, poses, steering=steering))
    return make_dataset(robot.name, robot, _PERIOD, paths)


def _commanded(robot: Robot, number: int, times: Array, rng: np.random.Generator) -> tuple[Array, Array | None]:
    """Wheel rates and steering angles of one run: curves to the left and right by turns, every third run straight."""
    ahead, turn = robot.motions[0], robot.motions[-1]
    sharpness = (0.0, 0.5, -0.5)[number % 3]
    weave = 0.2 * np.sin(0.4 * times + rng.uniform(0, 6))
    twists = 0.2 * (1 + 0.2 * np.sin(0.5 * times))[:, None] * ahead + (sharpness + weave)[:, None] * turn
    rates, steering = robot.drive.commands(twists @ robot.signal_equations.T)
    return rates, steering if robot.drive.steered else None


def changed(
    dataset: Dataset, *, wheels: Sequence[float] | float = 1.0, steering: float = 1.0, zero: float = 0.0
) -> str:
    """Warnings of the data set with its rates and its steering angles times factors, these shifted by ``zero``, rad."""
    runs = [
        replace(
            run,
            rates=run.rates * np.asarray(wheels),
            steering=None if run.steering is None else run.steering * steering + zero,
        )
        for run in dataset.trajectories
    ]
    return "; ".join(make_dataset("changed", dataset.robot, dataset.sample_period, runs).warnings)
