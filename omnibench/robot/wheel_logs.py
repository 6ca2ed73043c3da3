"""Wheel logs of what a user gives: arrays, a run, or a table of one run or several."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from omnibench.errors import DataError
from omnibench.robot.arrays import finite_array, frame_of
from omnibench.robot.kinematics import Robot
from omnibench.robot.odometry import WheelLog

_ORIGIN = (0.0, 0.0, 0.0)


def log_of_arrays(
    robot: Robot,
    times: ArrayLike,
    rates: ArrayLike,
    *,
    start: ArrayLike = _ORIGIN,
    stamps: ArrayLike | None = None,
    steering: ArrayLike | None = None,
    angles: ArrayLike | None = None,
) -> WheelLog:
    """The wheel log of a robot from arrays; ``odometry`` says what they are. stamps: default: ``times``.

    DataError: a shape, a time or a value is wrong.
    """
    log = WheelLog(
        times=finite_array("times", times, 1),
        rates=finite_array("rates", rates, 2),
        start=finite_array("start", start, 1),
        stamps=finite_array("stamps", times if stamps is None else stamps, 1),
        wheel_angles=None if angles is None else finite_array("angles", angles, 2),
        steering=None if steering is None else finite_array("steering", steering, 2),
        drive=None if robot.drive.direct else robot.drive,
    )
    _check(robot, log)
    return log


def logs_of(robot: Robot, wheels: Any, start: ArrayLike | None) -> Iterator[tuple[str | None, WheelLog]]:
    """The wheel logs of a run, or of a table with the columns of a data set's wheels; stamps at 0 and every sample.

    Each with the run's name, None where the table has no column ``trajectory``. start: that of all runs; default: of a
    run its own, of a table the origin. DataError: columns are missing or values are wrong.
    """
    if hasattr(wheels, "pose_times"):  # a Trajectory
        log = log_of_arrays(
            robot,
            wheels.times,
            wheels.rates,
            start=wheels.start if start is None else start,
            stamps=np.append(0.0, wheels.times),
            steering=wheels.steering,
            angles=wheels.angles,
        )
        yield None, replace(log, started_at=wheels.started_at, session=wheels.session)
        return
    table = frame_of("wheels", wheels)
    steered, named = robot.drive.steered, "trajectory" in table.columns
    needed = ["t", *(f"omega_{name}" for name in robot.wheel_names), *(f"steer_{name}" for name in steered)]
    if missing := [name for name in needed if name not in table.columns]:
        raise DataError(f"wheels: column {missing[0]} is missing; a table has {', '.join(needed)}")
    phases = [f"phi_{name}" for name in robot.wheel_names]
    for name, run in table.group_by("trajectory", maintain_order=True) if named else [((None,), table)]:
        yield (
            name[0],
            log_of_arrays(
                robot,
                run["t"],
                run.select(f"omega_{wheel}" for wheel in robot.wheel_names),
                start=_ORIGIN if start is None else start,
                stamps=np.append(0.0, run["t"]),
                steering=run.select(f"steer_{wheel}" for wheel in steered) if steered else None,
                angles=run.select(phases) if set(phases) <= set(table.columns) else None,
            ),
        )


def _check(robot: Robot, log: WheelLog) -> None:
    """DataError: shapes do not agree with each other and the robot, or times do not increase."""
    steered = robot.drive.steered
    if steered and log.steering is None:
        raise DataError(f"steering is missing: angles (F, {len(steered)}) of the wheels {', '.join(steered)}, rad")
    samples = len(log.times)
    rows = "a row for each of the times, a column for each of the wheels"
    of_wheels, of_steered = f"{rows} {', '.join(robot.wheel_names)}", f"{rows} {', '.join(steered)}"
    for name, array, shape, axes in (
        ("rates", log.rates, (samples, len(robot.wheel_names)), of_wheels),
        ("angles", log.wheel_angles, (samples, len(robot.wheel_names)), of_wheels),
        ("steering", log.steering, (samples, len(steered)), of_steered),
        ("start", log.start, (3,), "x, y in m and heading in rad"),
    ):
        if array is not None and array.shape != shape:
            raise DataError(f"{name} has shape {array.shape}, expected {shape}: {axes}")
    for name, values, least in (("times", log.times, np.nextafter(0.0, 1.0)), ("stamps", log.stamps, 0.0)):
        steps = np.diff(values, prepend=values[0] - 1.0)
        for row in np.flatnonzero((steps <= 0) | (values < least))[:1]:
            rule = "> 0" if name == "times" else ">= 0"
            raise DataError(f"{name}, row {row + 1}: it is {values[row]:g}; times increase and are {rule}")
