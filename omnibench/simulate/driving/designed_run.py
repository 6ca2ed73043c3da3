"""A run of a command by a robot that is exactly as designed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.robot.model import OdometryModel
from omnibench.simulate.driving.timed_command import TimedCommand
from omnibench.simulate.flower import commanded_rates, commanded_steering, stamps_of_run


def run_as_designed(model: OdometryModel, timed: TimedCommand, periods: tuple[float, float], name: str) -> Trajectory:
    """The run of a command with wheel rates by the design values, and poses by a model, from the origin on.

    periods: of the wheel samples and of the reference poses, s.
    """
    robot, command = model.robot, timed.command
    times, pose_times = stamps_of_run(timed.duration, *periods)
    still = Trajectory(
        name,
        "train",
        times,
        commanded_rates(robot, command, times, timed.ramp, timed.variation),
        pose_times,
        np.zeros((len(pose_times), 3)),
        steering=commanded_steering(robot, command, times, timed.variation),
        drive=None if robot.drive.direct else robot.drive,
    )
    (poses,) = model.poses([still.log(pose_times)])
    return replace(
        still,
        poses=poses,
        command=name,
        v=command.speed,
        alpha=command.direction,
        omega=command.turn_rate,
        duration=float(times[-1]),
        distance=command.speed * (float(times[-1]) - timed.ramp),
    )
