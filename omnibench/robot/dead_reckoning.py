"""Odometry of arrays: wheel rates in, poses out, for whoever has no data set."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

from numpy.typing import ArrayLike

from omnibench.errors import require_choice, require_type
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.kinematics import Wheel as Wheel
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration
from omnibench.robot.wheel_logs import log_of_arrays


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
    if integration is not None:
        require_choice("integration", integration, get_args(Integration))
    if isinstance(robot, Robot):
        model = OdometryModel.of_design(robot, integration or "arc")
    else:
        require_type(robot, Calibration, "read_calibration, or a Robot with omnibench.Robot(name=..., wheels=[...])")
        model = robot.model
        model = replace(model, integration=integration or model.integration)
    log = log_of_arrays(model.robot, times, rates, start=start, stamps=stamps, steering=steering, angles=angles)
    return model.poses([log])[0]
