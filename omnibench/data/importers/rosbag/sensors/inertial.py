"""Headings of an inertial sensor (sensor_msgs/Imu): its orientation where it tells one, else its rate of turn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from omnibench.data.importers.orientation import planar_headings
from omnibench.data.importers.rosbag.bag import Bag, Topic
from omnibench.data.importers.rosbag.message_streams import MessageFilter, Stamps, possible
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array

_FASTEST = 100.0  # rad/s; no robot turns faster


@dataclass(frozen=True, eq=False)
class Inertial:
    """Messages at stamps (K,), ns: rates of turn (K,), rad/s, and headings and their sigmas (K,), rad, or None."""

    stamps: Stamps
    rates: Array
    headings: Array | None
    sigmas: Array | None


def read_inertial(bag: Bag, topic: Topic, sigma: float | None, gyro: bool, warnings: list[str]) -> Inertial:
    """The messages of a topic; what is left out is added to ``warnings``.

    sigma: rad, of all headings; None: by their covariances. gyro: leave the orientations out. DataError: the headings'
    covariances are not known, or too few messages are left.
    """
    messages = MessageFilter(bag, topic)
    rows, numbers, stamps = [], [], []
    for record, stamp, row in messages.decoded(_reading):
        rows.append(row)
        numbers.append(record.number)
        stamps.append(stamp)
    table = np.array(rows, dtype=float).reshape(-1, 7)
    number, times = np.array(numbers, dtype=np.int64), np.array(stamps, dtype=np.int64)
    oriented = not gyro and len(table) > 0 and bool((table[:, 5] != -1).all())
    if oriented:
        headings = planar_headings(table[:, :4])
        good = messages.keep(~headings.flawed, number, "with a wrong orientation, or tilted by over 20 degrees")
    else:
        good = messages.keep(possible(table[:, 4:5], _FASTEST), number, "without a rate of turn")
    good = good[messages.in_order(times[good], number[good])]
    messages.require(len(good))
    warnings.extend(messages.warnings())
    rates = np.where(np.isfinite(table[good, 4]), table[good, 4], 0.0)
    if not oriented:
        return Inertial(times[good], rates, None, None)
    variances = table[good, 6]
    if sigma is None and not (np.isfinite(variances) & (variances > 0)).all():
        raise DataError(
            f"{bag.path}: topic {topic.name}: its orientations have no covariance; say how exact they are, a standard "
            "deviation in degrees: --set heading_sigma_deg=2, or take its rates of turn: --set imu=gyro"
        )
    sigmas = np.sqrt(variances) if sigma is None else np.full(len(good), sigma)
    return Inertial(times[good], rates, headings.headings[good], sigmas)


def _reading(message: Any) -> tuple[float, ...]:
    """Orientation, rate of turn, the first of the orientation's covariances (-1: there is none) and that of its yaw."""
    turn, covariance = message.orientation, np.asarray(message.orientation_covariance, dtype=float)
    return tuple(
        float(value)
        for value in (turn.x, turn.y, turn.z, turn.w, message.angular_velocity.z, covariance[0], covariance[8])
    )
