"""Odometry of arrays: wheel rates in, poses out, for whoever has no data set."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from omnibench.errors import DataError, require_choice, require_type
from omnibench.robot.arrays import finite_array
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.kinematics import Wheel as Wheel
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, WheelLog


def odometry(
    robot: Robot | Calibration,
    times: ArrayLike,
    rates: ArrayLike,
    *,
    steering: ArrayLike | None = None,
    start: ArrayLike = (0.0, 0.0, 0.0),
    stamps: ArrayLike | None = None,
    integration: Integration | None = None,
    angles: ArrayLike | None = None,
) -> Array:
    """Poses (K, 3) of a robot's odometry: x, y in m and the heading in rad, not wrapped.

    robot: its design, or a calibration, effects included. times (F,): end of each wheel sample, s, > 0. rates (F, N):
    mean rate of every measured wheel over the sample, rad/s. steering (F, S): of the steered wheels at the samples'
    ends, rad. start (3,): pose at t = 0. stamps (K,): when poses are wanted, s; default: ``times``. integration: path
    within a sample; default: ``arc``, or the calibration's. angles (F, N): of the wheels, rad, for effects that need
    them. Source: Eq. (1) and (2) of Palacin et al. 2023.

    DataError: a shape, a time or a value is wrong, or an effect needs data that are not given. ConfigError: ``robot``
    is neither.

    >>> import numpy as np
    >>> cart = Robot(name="cart", wheels=[
    ...     Wheel(name="left", type="fixed", radius=0.05, x=0, y=0.15),
    ...     Wheel(name="right", type="fixed", radius=0.05, x=0, y=-0.15)])
    >>> times = np.arange(1, 101) * 0.02
    >>> poses = odometry(cart, times, np.full((100, 2), 4.0))  # 2 s at 0.05 m x 4 rad/s
    >>> poses.shape, bool(np.allclose(poses[-1], [0.4, 0, 0]))
    ((100, 3), True)
    """
    log = WheelLog(
        times=finite_array("times", times, 1),
        rates=finite_array("rates", rates, 2),
        start=finite_array("start", start, 1),
        stamps=finite_array("stamps", times if stamps is None else stamps, 1),
        wheel_angles=None if angles is None else finite_array("angles", angles, 2),
        steering=None if steering is None else finite_array("steering", steering, 2),
    )
    if integration is not None:
        require_choice("integration", integration, get_args(Integration))
    if isinstance(robot, Robot):
        model = OdometryModel.of_design(robot, integration or "arc")
    else:
        require_type(robot, Calibration, "read_calibration, or a Robot with omnibench.Robot(name=..., wheels=[...])")
        model = robot.model
        model = replace(model, integration=integration or model.integration)
    _check(model.robot, log)
    if not model.robot.drive.direct:
        log = replace(log, drive=model.robot.drive)
    return model.poses([log])[0]


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
