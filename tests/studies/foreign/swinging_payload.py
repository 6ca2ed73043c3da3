"""Four omni wheels under a hanging load that swings on after every ramp and drags the wheels. Symplectic Euler."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .recording import Array, size_of, slots, write

SAMPLE, STEPS, POSE = 0.02, 4, 15  # s, steps a sample, samples between poses
SECONDS, RAMP = 6.6, 0.4  # s
RADIUS, DISTANCE, AXLES = 0.1, 0.26, np.radians([45.0, 135.0, 225.0, 315.0])  # m, m, rad


def make(folder: Path, seed: int) -> dict[str, Any]:
    """Write a recording of 144 + 108 runs."""
    rng = np.random.default_rng([4, seed])
    radii, axles = RADIUS * (1 + 0.01 * rng.standard_normal(4)), AXLES + 0.008 * rng.standard_normal(4)
    distances = DISTANCE * (1 + 0.01 * rng.standard_normal(4))
    wheels_of = np.column_stack([-np.sin(axles), np.cos(axles), distances]) / radii[:, None]
    matrix = np.linalg.pinv(wheels_of)
    commands = _commands()
    planned = slots(len(commands), {"train": 4, "validation": 3}, SECONDS, rng)
    rates = np.array([commands[slot.number] @ wheels_of.T for slot in planned])
    starts = np.column_stack([rng.uniform(-0.2, 0.2, (len(planned), 2)), rng.uniform(-np.pi, np.pi, len(planned))])
    training = np.array([slot.split == "train" for slot in planned])
    swing, damping = 2 * np.pi * rng.uniform(0.35, 0.6), rng.uniform(0.03, 0.08)  # rad/s, of critical

    def drive(size: float, which: Array, changed: Array = matrix) -> Array:
        """Poses (R, K, 3). size: creep of the wheels by the load's pull, s (m/s by m/s2)."""
        return _integrated(starts[which], rates[which] @ changed.T, swing, damping, size)[:, :: STEPS * POSE]

    still = drive(0.0, training)
    changes = 1e-5 * np.eye(12).reshape(12, 3, 4)
    columns = np.array([(drive(0.0, training, matrix + change) - still)[:, 1:] / 1e-5 for change in changes])
    stamps = SAMPLE * POSE * np.arange(still.shape[1])
    ages = np.abs(stamps[1:, None] - stamps[1:])
    in_time = np.exp(-ages / 0.5) + 0.5 * np.eye(len(ages)) + 0.05 * np.minimum(stamps[1:, None], stamps[1:])
    covariance = np.kron(in_time, np.diag([0.005, 0.005, 0.004]) ** 2)
    size, reached = size_of(lambda size: (drive(size, training) - still)[:, 1:], columns, covariance[None], 0.03)
    poses = drive(size, np.ones(len(planned), bool))
    noise = rng.standard_normal((len(planned), len(covariance))) @ np.linalg.cholesky(covariance).T
    poses[:, 1:] += noise.reshape(len(planned), -1, 3)
    shares = _shares().reshape(-1, STEPS).mean(axis=1)
    exact = rates[:, None] * shares[:, None]
    begin = np.cumsum(rng.uniform(-30, 30, (len(planned), 1, 4)), axis=0)
    recorded = {
        "times": SAMPLE * np.arange(1, len(shares) + 1),
        "rates": exact + 0.02 * rng.standard_normal(exact.shape),
        "angles": begin + np.cumsum(exact, axis=1) * SAMPLE,
        "stamps": stamps,
        "poses": poses,
    }
    wheels = [
        {"name": f"w{index}", "radius": RADIUS, "distance": DISTANCE, "angle": float(angle)}
        for index, angle in enumerate(AXLES, 1)
    ]
    write(folder, {"name": "crane", "wheels": wheels}, planned, recorded)
    covariates = ("acceleration", "elapsed time")
    return {"kind": "swinging_payload", "covariates": covariates, "size": size, "noncentrality": reached}


def _commands() -> Array:
    """Twists (C, 3) in all directions at two speeds, some with a turn, and turns on the spot."""
    golden = np.pi * (3 - np.sqrt(5))
    driven = [
        (speed * np.cos(golden * index), speed * np.sin(golden * index), turn)
        for index, (speed, turn) in enumerate([(0.15, 0.0), (0.3, 0.0), (0.2, 0.45), (0.2, -0.45)] * 8)
    ]
    return np.array([*driven, (0, 0, 0.7), (0, 0, -0.7), (0, 0, 0.35), (0, 0, -0.35)])


def _shares() -> Array:
    """Share (steps,) of the command at every step: linear ramps."""
    steps = round(SECONDS / SAMPLE) * STEPS
    time = (np.arange(steps) + 0.5) * SAMPLE / STEPS
    return np.clip(np.minimum(time, SECONDS - time) / RAMP, 0, 1)


def _integrated(starts: Array, twists: Array, swing: float, damping: float, creep: float) -> Array:
    """Poses (R, T + 1, 3). The load hangs above the middle: p'' = -swing^2 p - 2 damping swing p' - a, in the body.

    a: acceleration of the robot as commanded, w x v included; its pull swing^2 p makes the wheels creep.
    """
    step, shares = SAMPLE / STEPS, _shares()
    slopes = np.gradient(shares, step)
    poses = [starts]
    place, speed = np.zeros((len(starts), 2)), np.zeros((len(starts), 2))
    for share, slope in zip(shares, slopes, strict=True):
        vx, vy, w = share * twists.T
        felt = slope * twists[:, :2] + np.column_stack([-w * vy, w * vx])
        speed = speed + step * (-(swing**2) * place - 2 * damping * swing * speed - felt)
        place = place + step * speed
        body = np.column_stack([vx, vy]) + creep * swing**2 * place
        pose = poses[-1]
        heading = pose[:, 2] + step * w  # symplectic: the new heading turns the step
        cosine, sine = np.cos(heading - step * w / 2), np.sin(heading - step * w / 2)
        across = cosine * body[:, 0] - sine * body[:, 1], sine * body[:, 0] + cosine * body[:, 1]
        poses.append(np.column_stack([pose[:, 0] + step * across[0], pose[:, 1] + step * across[1], heading]))
    return np.array(poses).transpose(1, 0, 2)
