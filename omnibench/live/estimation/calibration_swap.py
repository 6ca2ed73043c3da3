"""Calibration swap: another calibration takes over at the next wheel sample, if it is the same robot's."""

from __future__ import annotations

import time

import numpy as np

from omnibench.errors import DataError, OmnibenchError
from omnibench.live.estimation.extrapolation_monitor import ExtrapolationMonitor
from omnibench.live.estimation.health import SwapRecord
from omnibench.live.estimation.robot_state import RobotState, wheel_angle_effects
from omnibench.robot.calibration import Calibration
from omnibench.robot.signals import of_centre

_OTHER_ROBOT = 0.5  # share of a row's largest element; chosen: no calibration moves a matrix so far from its design


def swap_calibration(state: RobotState, calibration: Calibration) -> None:
    """Continue with another calibration; poses do not jump. DataError: it is not this robot's, or cannot be run."""
    try:
        check_same_robot(calibration, state.calibration)
        odometry = state.odometry.continued(calibration)
        reference = state.reference.continued(calibration.model)
    except OmnibenchError as error:
        record_refused_swap(state, calibration.name, str(error))
        raise DataError(str(error)) from None
    state.calibration, state.odometry, state.reference = calibration, odometry, reference
    state.monitor = ExtrapolationMonitor(state.name, calibration)
    state.guessed_angles = wheel_angle_effects(calibration)
    state.counts.swaps += 1
    state.last_swap = SwapRecord(accepted=True, name=calibration.name, reason="runs", at=time.time())


def record_refused_swap(state: RobotState, name: str | None, reason: str) -> None:
    """Count a calibration that was sent and refused. name: the calibration's, if it could be read."""
    state.counts.swaps_refused += 1
    state.last_swap = SwapRecord(accepted=False, name=name, reason=reason, at=time.time())


def check_same_robot(calibration: Calibration, running: Calibration) -> None:
    """DataError: a calibration has other wheels than the running one, or its matrix is far off the design's.

    The tracked point may be another one; matrices of the robot's centre are compared.
    """
    calibration.check_wheels(running.robot, "this robot")
    matrix = of_centre(calibration.robot, calibration.matrix_array.T).T
    for robot in (calibration.robot, running.robot):
        centred = robot.model_copy(update={"mount": None})
        off = np.abs(matrix - centred.inverse_kinematic_matrix).max(axis=1) / centred.row_scales
        if off.max() > _OTHER_ROBOT:
            raise DataError(
                f"row {int(off.argmax()) + 1} of the matrix is {off.max():.0%} off the design of robot "
                f"{robot.name!r}; is it another robot's, or in other units?"
            )
