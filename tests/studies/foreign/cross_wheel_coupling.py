"""Three omni wheels on a slack chassis: each slips the more, the faster its neighbour turns. RK4, OU noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .recording import Array, size_of, slots, write

STEP, SAMPLE, POSE, SECONDS = 0.01, 0.02, 0.2, 6.0  # s
RADIUS, DISTANCE, AXLES = 0.05, 0.17, np.radians([30.0, 150.0, 270.0])  # m, m, rad
LAG, TICK = 0.12, 2 * np.pi / 16384  # s, of the motors; rad, of the encoders
FAST = 5.0  # rad/s, the unit of the neighbour's rate


def make(folder: Path, seed: int) -> dict[str, Any]:
    """Write a recording of 144 + 96 runs."""
    rng = np.random.default_rng([1, seed])
    radius, distance = (value * (1 + 0.015 * rng.standard_normal(3)) for value in (RADIUS, DISTANCE))
    axles = AXLES + np.radians(0.6) * rng.standard_normal(3)
    wheels_of = np.column_stack([-np.sin(axles), np.cos(axles), distance]) / radius[:, None]
    matrix = np.linalg.inv(wheels_of)
    commands = _commands()
    planned = slots(len(commands), {"train": 6, "validation": 4}, SECONDS, rng)
    half_steps = STEP / 2 * np.arange(2 * round(SECONDS / STEP) + 1)
    rates = np.array([commands[slot.number] @ wheels_of.T for slot in planned])[:, None] * _profile(half_steps)[:, None]
    starts = np.column_stack([rng.uniform(-0.4, 0.4, (len(planned), 2)), rng.uniform(-np.pi, np.pi, len(planned))])
    stamps = POSE * np.arange(round(SECONDS / POSE) + 1)
    training = np.array([slot.split == "train" for slot in planned])
    neighbour = rng.choice([1, -1])  # whose rate it is

    def drive(size: float, which: Array, changed: Array = matrix) -> Array:
        turned = rates[which]
        gripping = turned * (1 - size * np.abs(np.roll(turned, neighbour, axis=2)) / FAST)
        return _integrated(starts[which], gripping @ changed.T)[:, :: round(POSE / STEP)]

    still = drive(0.0, training)
    columns = np.array(
        [(drive(0.0, training, matrix + change) - still)[:, 1:] / 1e-5 for change in 1e-5 * np.eye(9).reshape(9, 3, 3)]
    )
    scales = np.array([0.004, 0.004, 0.005])  # m, m, rad
    between = np.abs(stamps[1:, None] - stamps[1:])
    in_time = np.eye(len(between)) + 0.6 * np.exp(-between / 1.2) + 0.8  # white, OU and the run's bias
    covariance = np.kron(in_time, np.diag(scales**2))
    size, reached = size_of(lambda size: (drive(size, training) - still)[:, 1:], columns, covariance[None], 0.01)
    poses = drive(size, np.ones(len(planned), bool))
    noise = rng.standard_normal((len(planned), len(covariance))) @ np.linalg.cholesky(covariance).T
    poses[:, 1:] += noise.reshape(len(planned), -1, 3)
    angles = _angles(rates, rng)
    recorded = {
        "times": SAMPLE * np.arange(1, angles.shape[1]),
        "rates": np.diff(angles, axis=1) / SAMPLE,
        "angles": angles[:, 1:],
        "stamps": stamps,
        "poses": poses,
    }
    robot = {"name": "trio", "wheels": [_wheel(name, angle) for name, angle in zip("abc", AXLES, strict=True)]}
    write(folder, robot, planned, recorded)
    # A product of two wheels' rates is a function of the command, and in part of a wheel's rate.
    covariates = ("wheel rate", "command")
    return {
        "kind": "cross_wheel_coupling",
        "covariates": covariates,
        "right_names": ("cross_wheel_coupling",),
        "size": size,
        "noncentrality": reached,
    }


def _wheel(name: str, angle: float) -> dict[str, Any]:
    return {"name": name, "radius": RADIUS, "distance": DISTANCE, "angle": float(angle)}


def _commands() -> Array:
    """Twists (C, 3): two speeds in eight directions each, with and without turning, and turns on the spot."""
    around = 2 * np.pi * np.arange(8) / 8
    driven = [
        (speed * np.cos(angle + shift), speed * np.sin(angle + shift), turn)
        for speed, turn, shift, angles in (
            (0.25, 0.0, 0.0, around),
            (0.18, 0.6, 0.2, around),
            (0.12, -0.8, 0.5, around[::2]),
        )
        for angle in angles
    ]
    return np.array([*driven, *((0.0, 0.0, turn) for turn in (-1.2, -0.5, 0.5, 1.2))])


def _profile(time: Array) -> Array:
    """The motors' answer to a command that ends 0.6 s before the run."""
    end = SECONDS - 0.6
    rising = 1 - np.exp(-time / LAG)
    return np.where(time < end, rising, (1 - np.exp(-end / LAG)) * np.exp(-np.maximum(time - end, 0) / LAG))


def _integrated(starts: Array, twists: Array) -> Array:
    """Poses (R, T + 1, 3) by Runge-Kutta steps of fourth order, from twists (R, 2T + 1, 3) at half steps."""

    def slope(heading: Array, twist: Array) -> Array:
        cosine, sine = np.cos(heading), np.sin(heading)
        across = cosine * twist[:, 0] - sine * twist[:, 1], sine * twist[:, 0] + cosine * twist[:, 1]
        return np.column_stack([*across, twist[:, 2]])

    poses = [starts]
    for index in range(0, twists.shape[1] - 2, 2):
        pose, (first, middle, last) = poses[-1], twists[:, index : index + 3].transpose(1, 0, 2)
        one = slope(pose[:, 2], first)
        two = slope(pose[:, 2] + STEP / 2 * one[:, 2], middle)
        three = slope(pose[:, 2] + STEP / 2 * two[:, 2], middle)
        four = slope(pose[:, 2] + STEP * three[:, 2], last)
        poses.append(pose + STEP / 6 * (one + 2 * two + 2 * three + four))
    return np.array(poses).transpose(1, 0, 2)


def _angles(rates: Array, rng: np.random.Generator) -> Array:
    """What the encoders count (R, samples + 1, 3), rad, at every sample, with the way back between the runs."""
    turned = STEP / 6 * (rates[:, :-2:2] + 4 * rates[:, 1:-1:2] + rates[:, 2::2])
    within = np.concatenate([np.zeros_like(turned[:, :1]), np.cumsum(turned, axis=1)], axis=1)
    begin = np.cumsum(rng.uniform(-60, 60, (len(rates), 1, 3)), axis=0)
    return np.round((begin + within)[:, :: round(SAMPLE / STEP)] / TICK) * TICK
