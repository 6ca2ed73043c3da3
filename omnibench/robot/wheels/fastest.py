"""Rates that no wheel exceeds: what turns faster was misread, or its counter began anew."""

from __future__ import annotations

import numpy as np

from omnibench.robot.arrays import Array

FASTEST = 100.0  # rad/s; chosen, above the wheels of usual robots
FASTEST_RIM = 5.0  # m/s, of small wheels, which turn faster; chosen


def fastest_rates(radii: Array) -> Array:
    """Rates (N,), rad/s, that no wheels of radii (N,), m, exceed."""
    rates: Array = np.maximum(FASTEST, FASTEST_RIM / radii)
    return rates
