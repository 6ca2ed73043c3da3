"""Small recordings for the tests of replay."""

import math
from typing import Any

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.live.drive import Recording
from omnibench.robot.calibration import EffectTerm
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.simulate.commands import Commands
from omnibench.simulate.config import EncoderNoise, FlowerConfig, Session, Tolerances, Truth
from omnibench.simulate.source import simulate_dataset
from omnibench.testing import synthetic_robot

PERIOD = 0.02  # s
ROBOT = synthetic_robot()
MODEL = OdometryModel.of_design(ROBOT, "arc")


def random_run(name: str, rng: np.random.Generator, *, samples: int = 40, tail: int = 0, **known: Any) -> Trajectory:
    """A run with wheel rates that change, from anywhere, its reference with noise every fifth sample.

    tail: samples by which the wheels go on after the last reference pose.
    """
    times = PERIOD * np.arange(1, samples + tail + 1)
    rates = rng.normal(0.0, 2.0, (len(times), len(ROBOT.wheels)))
    stamps = np.append(0.0, times[4:samples:5])
    start = np.append(rng.normal(0.0, 2.0, 2), rng.uniform(-math.pi, math.pi))
    (poses,) = MODEL.poses([WheelLog(times, rates, start, stamps)])
    return Trajectory(name, "train", times, rates, stamps, poses + rng.normal(0.0, 0.01, poses.shape), **known)


def random_dataset(seed: int, runs: int = 3, **known: Any) -> Dataset:
    """Runs as above with a sample period of PERIOD."""
    rng = np.random.default_rng(seed)
    return make_dataset("random", ROBOT, PERIOD, [random_run(f"run {n}", rng, **known) for n in range(runs)])


def simulated_recording(
    noise: EncoderNoise | None = None, repetitions: int = 1, effects: tuple[EffectTerm, ...] = ()
) -> Recording:
    """Six commands of 1 s, repeated, by a robot that is not as designed."""
    config = FlowerConfig(
        robot=ROBOT,
        sample_period=0.01,
        pose_period=0.1,
        commands=Commands(speeds=(0.3,), directions_deg=(0, 120, 240), turn_rates=(-0.5, 0.5)),
        repetitions=repetitions,
        truth=Truth(tolerances=Tolerances(radius=0.02, distance=0.02, angle_deg=1, seed=5), effects=effects),
        noise=noise or EncoderNoise(),
        train=Session(seed=1, distance=0.3),
    )
    simulation = simulate_dataset(config)
    return Recording(simulation.dataset, simulation.truth)


def homogeneous(pose: Array) -> Array:
    """A pose (3,) as a matrix (3, 3) that acts on points of the plane."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    return np.array([[cosine, -sine, pose[0]], [sine, cosine, pose[1]], [0.0, 0.0, 1.0]])
