"""Positions of a receiver of satellites (sensor_msgs/NavSatFix), east and north of the first fix."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from omnibench.data.importers.rosbag.bag import Bag, Topic
from omnibench.data.importers.rosbag.message_streams import MessageFilter, Stamps
from omnibench.data.importers.rosbag.sensors.local_plane import east_north
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array

_UNKNOWN = 0  # position_covariance_type: COVARIANCE_TYPE_UNKNOWN
_HIGHEST = 1e5  # m; an altitude beyond is garbage


@dataclass(frozen=True, eq=False)
class Fixes:
    """Fixes at stamps (K,), ns: positions (K, 2), east and north of the first, m; sigmas (K, 2), m."""

    stamps: Stamps
    positions: Array
    sigmas: Array


def read_fixes(bag: Bag, topic: Topic, sigma: float | None, warnings: list[str]) -> Fixes:
    """The fixes of a topic; those without a position are left out, and added to ``warnings``.

    sigma: m, of all fixes; None: by their covariances. DataError: these are not known, or too few fixes are left.
    """
    messages = MessageFilter(bag, topic)
    rows, numbers, stamps = [], [], []
    for record, stamp, row in messages.decoded(_fix):
        rows.append(row)
        numbers.append(record.number)
        stamps.append(stamp)
    table = np.array(rows, dtype=float).reshape(-1, 6)
    number, times = np.array(numbers, dtype=np.int64), np.array(stamps, dtype=np.int64)
    good = messages.keep(table[:, 0] >= 0, number, "without a fix (status -1)")
    possible = (np.abs(table[:, 1]) <= 90) & (np.abs(table[:, 2]) <= 360)
    good = good[messages.keep(possible[good], number[good], "without latitude and longitude")]
    if sigma is None:
        known = (np.isfinite(table[:, 4:]) & (table[:, 4:] > 0)).all(axis=1)
        if not known[good].any() and len(good):
            raise DataError(
                f"{bag.path}: topic {topic.name}: its fixes have no covariance; say how exact they are, a standard "
                "deviation in m: --set fix_sigma=1.5"
            )
        good = good[messages.keep(known[good], number[good], "without a covariance (set fix_sigma)")]
    good = good[messages.in_order(times[good], number[good])]
    messages.require(len(good))
    warnings.extend(messages.warnings())
    chosen = table[good]
    height = float(chosen[0, 3]) if abs(chosen[0, 3]) < _HIGHEST else 0.0
    positions = east_north(chosen[:, 1], chosen[:, 2], (float(chosen[0, 1]), float(chosen[0, 2])), height)
    sigmas = np.sqrt(chosen[:, 4:]) if sigma is None else np.full_like(positions, sigma)
    return Fixes(times[good], positions, sigmas)


def _fix(message: Any) -> tuple[float, ...]:
    """Status, latitude, longitude, altitude, and the variances of east and north, NaN where they are not known."""
    covariance = np.asarray(message.position_covariance, dtype=float).reshape(3, 3)
    unknown = int(message.position_covariance_type) == _UNKNOWN
    variances = (np.nan, np.nan) if unknown else (covariance[0, 0], covariance[1, 1])
    place = (message.latitude, message.longitude, message.altitude)
    return tuple(float(value) for value in (message.status.status, *place, *variances))
