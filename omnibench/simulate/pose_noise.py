"""Noise of simulated reference poses."""

from __future__ import annotations

import numpy as np

from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array


def reference_noise(noise: Noise, times: Array, rng: np.random.Generator) -> Array:
    """Noise (K, 3) of the reference poses in m, m, rad; none at t = 0, where the start pose is exact."""
    white = np.array([noise.pose_position, noise.pose_position, noise.pose_heading])
    walk = np.array([noise.walk_position, noise.walk_position, noise.walk_heading])
    bias = np.array([noise.bias_position, noise.bias_position, noise.bias_heading])
    steps = np.sqrt(np.diff(times))[:, None] * rng.standard_normal((len(times) - 1, 3))
    after_start = (
        bias * rng.standard_normal(3)
        + walk * np.cumsum(steps, axis=0)
        + white * rng.standard_normal((len(times) - 1, 3))
    )
    return np.vstack([np.zeros(3), after_start])
