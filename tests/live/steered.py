"""Robots that steer, with calibrations, and the messages that they send while they drive."""

from dataclasses import replace
from typing import Any, Final

import numpy as np
from drives import NOISE, PERIOD, Drive
from sample_robots import fixed, make_robot, steered

from omnibench.data.dataset import Trajectory, make_dataset
from omnibench.live.drive import Recording
from omnibench.live.wire import JointState
from omnibench.robot.calibration import Calibration, covariance_rows, matrix_rows
from omnibench.robot.kinematics import Robot

_CORNERS = {"fl": (0.2, 0.15), "fr": (0.2, -0.15), "rl": (-0.2, 0.15), "rr": (-0.2, -0.15)}
SWERVE: Final = make_robot("swerve", *(steered(name, *place) for name, place in _CORNERS.items()))
SKID: Final = make_robot("skid", *(fixed(name, *place) for name, place in _CORNERS.items()), skid=True)


def steered_calibration(robot: Robot = SWERVE, **changes: Any) -> Calibration:
    """A calibration of a robot whose matrix is some percent off the design."""
    design = robot.inverse_kinematic_matrix
    off = 1 + 0.03 * np.sin(np.arange(design.size)).reshape(design.shape)
    plain = Calibration(
        name=f"{robot.name} off",
        robot=robot,
        sample_period=PERIOD,
        matrix=matrix_rows(design * off),
        integration="arc",
        noise=NOISE,
        covariance=covariance_rows(1e-8 * np.eye(design.size)),
    )
    return plain.model_copy(update=changes)


def steered_drive(seconds: float = 1.0, *, seed: int = 1, using: Calibration | None = None) -> Drive:
    """A lively drive: wheel rates that wander by some rad/s, and steering that swings within half a right angle."""
    chosen = using or steered_calibration()
    rng = np.random.default_rng(seed)
    count = round(seconds / PERIOD) + 1
    wheels, steered = len(chosen.robot.wheel_names), len(chosen.robot.drive.steered)
    times = PERIOD * np.arange(count)
    phase = rng.uniform(0, 6, (wheels + steered, 1))
    wandering = np.sin(0.8 * times + phase) + 0.1 * rng.standard_normal((len(phase), count))
    rates, steering = 1.5 * wandering[:wheels] + 0.7, 0.7 * wandering[wheels:]
    steering[:, 0] = steering[:, 1]
    angles = np.vstack([np.zeros(wheels), np.cumsum(PERIOD * rates.T[1:], axis=0)]) + rng.uniform(-3, 3, wheels)
    return Drive(angles, chosen, steering.T)


def only(sample: JointState, *names: str) -> JointState:
    """Some joints of a message."""
    places = [sample.names.index(name) for name in names]
    return replace(sample, names=names, positions=sample.positions[places], velocities=sample.velocities[places])


def recording(seed: int = 1, runs: int = 3, *, using: Calibration | None = None, pose_every: int = 10) -> Recording:
    """Runs of 0.4 s with poses that are those of a calibration, exactly."""
    chosen = using or steered_calibration()
    made = []
    for number in range(runs):
        path, start = steered_drive(0.4, seed=seed + number, using=chosen), np.array([0.3 * number, 1.0, 0.7 - number])
        log = replace(path.log, start=start, stamps=np.append(0.0, path.times[pose_every - 1 :: pose_every]))
        rates, (poses,) = log.rates, chosen.model.poses([log])
        made.append(
            Trajectory(f"run {number}", "train", path.times, rates, log.stamps, poses, steering=path.steering[1:])
        )
    return Recording(make_dataset("steered", chosen.robot, PERIOD, made))
