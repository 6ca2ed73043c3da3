"""Noise of the reference poses and of the encoders, in the kinds that a null set is made of."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

from .experiment import SAMPLE
from .motion import Grid

REFERENCE = Noise(
    pose_position=0.0055,
    pose_heading=0.0055,
    walk_position=0.0033,
    walk_heading=0.0033,
    bias_position=0.0088,
    bias_heading=0.0088,
)
VALIDATION = 1.07  # the later session is a little noisier


@dataclass(frozen=True)
class Disturbance:
    """A kind of noise. reference: white, walk and bias as in a calibration file; encoder: of every wheel rate, rad/s.

    correlated: standard deviation of an AR(1) process beside the white noise, as a share of it. heavy: the white noise
    follows Student's t with 3 degrees of freedom. outliers: share of poses that jump by 5 to 20 deviations. slip:
    white noise of the true twist, m and rad per sqrt s: errors of the heading then go on into the position.
    """

    reference: Noise = REFERENCE
    encoder: float = 0.02
    correlated: float = 0.0
    heavy: bool = False
    outliers: float = 0.0
    slip: float = 0.0

    def known(self, matrix: Array) -> Noise:
        """White, walk and bias with the encoders' part in the walk: the true noise, where the kind is "plain"."""
        spread = self.encoder * np.sqrt(SAMPLE)
        across = spread * np.linalg.norm(matrix[:2]) / np.sqrt(2)
        turning = spread * np.linalg.norm(matrix[2])
        walk_position, walk_heading = self.reference.walk_position, self.reference.walk_heading
        return self.reference.model_copy(
            update={
                "walk_position": float(np.hypot(walk_position, across)),
                "walk_heading": float(np.hypot(walk_heading, turning)),
            }
        )

    def of_poses(self, grid: Grid, rng: np.random.Generator) -> Array:
        """Noise (s, 3) of the reference poses, m, m, rad; none at t = 0, where the start pose is exact."""
        return np.concatenate([self._of_run(run.stamps, rng) for run in grid.runs])

    def of_rates(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        """Noise of measured wheel rates, rad/s."""
        return self.encoder * rng.standard_normal(shape)

    def _of_run(self, stamps: Array, rng: np.random.Generator) -> Array:
        count, steps = len(stamps) - 1, np.diff(stamps)[:, None]
        noise = self.reference
        white = np.array([noise.pose_position, noise.pose_position, noise.pose_heading])
        walk = np.array([noise.walk_position, noise.walk_position, noise.walk_heading])
        bias = np.array([noise.bias_position, noise.bias_position, noise.bias_heading])
        draws = rng.standard_t(3, (count, 3)) / np.sqrt(3) if self.heavy else rng.standard_normal((count, 3))
        errors = white * draws + bias * rng.standard_normal(3)
        errors += walk * np.cumsum(np.sqrt(steps) * rng.standard_normal((count, 3)), axis=0)
        if self.correlated:
            errors += self.correlated * white * _autoregressive(steps, rng.uniform(0.3, 2.0), rng)
        if self.outliers:
            jumps = white * rng.uniform(5, 20, (count, 1)) * rng.choice([-1.0, 1.0], (count, 3))
            errors += np.where(rng.random((count, 1)) < self.outliers, jumps, 0.0)
        return np.vstack([np.zeros(3), errors])


def _autoregressive(steps: Array, constant: float, rng: np.random.Generator) -> Array:
    """An AR(1) process (K, 3) of unit variance and this time constant (s), at stamps with these steps (K, 1)."""
    draws = rng.standard_normal((len(steps), 3))
    states = [draws[0]]
    for draw, kept in zip(draws[1:], np.exp(-steps[1:, 0] / constant), strict=True):
        states.append(kept * states[-1] + np.sqrt(1 - kept**2) * draw)
    return np.array(states)


PLAIN = Disturbance()
DISTURBANCES = {
    "plain": PLAIN,
    "correlated": Disturbance(correlated=1.0),
    "heavy_tailed": Disturbance(heavy=True),
    "outliers": Disturbance(outliers=0.02),
    "encoder": Disturbance(encoder=0.1),
    "slip": Disturbance(slip=0.004),
    "mixed": Disturbance(correlated=0.7, heavy=True, outliers=0.02, encoder=0.05),
}
NULL_KINDS = tuple(DISTURBANCES)


def scaled(disturbance: Disturbance, factor: float) -> Disturbance:
    """The same kind with all noise of the reference multiplied."""
    reference = Noise(**{name: factor * value for name, value in disturbance.reference.model_dump().items()})
    return replace(disturbance, reference=reference)
