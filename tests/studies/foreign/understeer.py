"""A 1:10 car on rubber tyres that slip and slide, its servo late: a single-track model with Fiala tyres at 1 kHz."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .recording import Array, size_of, slots, write

STEP, SAMPLE, POSE, SECONDS = 0.001, 0.02, 0.1, 4.0  # s
RADIUS, FRONT, REAR = 0.033, 0.14, 0.12  # m: of the wheels, and from the centre of mass to the axles
MASS, INERTIA = 2.4, 0.035  # kg, kg m2
SLOW = 0.3  # m/s, below which slip angles are taken as at this speed
GRAVITY = 9.81  # m/s2


def make(folder: Path, seed: int, *, as_built: bool = False) -> dict[str, Any]:
    """Write a recording of 140 + 84 runs. as_built: not made small, as of the car itself."""
    rng = np.random.default_rng([7, seed])
    radius, wheelbase = RADIUS * (1 + 0.01 * rng.standard_normal()), (FRONT + REAR) * (1 + 0.01 * rng.standard_normal())
    matrix = radius * np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1 / wheelbase]])
    commands = _commands()
    planned = slots(len(commands), {"train": 5, "validation": 3}, SECONDS, rng)
    time = STEP * np.arange(round(SECONDS / STEP) + 1)
    numbers = [slot.number for slot in planned]
    speeds = np.array([speed for speed, _, _ in commands])[numbers, None] * _profile(time)
    told = np.array([_told(time, angle, way) for _, angle, way in commands])[numbers]
    starts = np.column_stack([rng.uniform(-0.5, 0.5, (len(planned), 2)), rng.uniform(-np.pi, np.pi, len(planned))])
    training = np.array([slot.split == "train" for slot in planned])
    tyres = {
        "friction": rng.uniform(0.5, 0.9),
        "front": rng.uniform(22, 32),  # N/rad, of both tyres
        "rear": rng.uniform(34, 48),
        "lag": rng.uniform(0.015, 0.04),  # s, of a digital servo
        "fastest": rng.uniform(5.0, 9.0),  # rad/s, of the steering
    }
    true = _driven(speeds, told, wheelbase, tyres)
    signals = np.stack([speeds, speeds * np.tan(told)], axis=-1) / radius
    departs = true - signals @ matrix.T

    def drive(size: float, which: Array, changed: Array = matrix) -> Array:
        """Poses (R, K, 3) of the middle of the rear axle. size: share of what slip and servo change; 1: as built."""
        twists = signals[which] @ changed.T + size * departs[which]
        return _integrated(starts[which], twists)[:, :: round(POSE / STEP)]

    still = drive(0.0, training)
    steps = 1e-5 * np.eye(6).reshape(6, 3, 2)
    columns = np.array([(drive(0.0, training, matrix + step) - still)[:, 1:] / 1e-5 for step in steps])
    stamps = POSE * np.arange(still.shape[1])
    # Motion capture: white noise, and markers that creep on the body with an Ornstein-Uhlenbeck process.
    in_time = np.eye(len(stamps) - 1) + 0.7 * np.exp(-np.abs(stamps[1:, None] - stamps[1:]) / 0.6)
    in_time += 0.3 * np.minimum(stamps[1:, None], stamps[1:])
    covariance = np.kron(in_time, np.diag([0.003, 0.003, 0.004]) ** 2)
    size, reached = 1.0, np.inf
    if not as_built:
        size, reached = size_of(lambda size: (drive(size, training) - still)[:, 1:], columns, covariance[None], 0.05)
    poses = drive(size, np.ones(len(planned), bool))
    noise = rng.standard_normal((len(planned), len(covariance))) @ np.linalg.cholesky(covariance).T
    poses[:, 1:] += noise.reshape(len(planned), -1, 3)
    every = round(SAMPLE / STEP)
    way = np.cumsum((speeds[:, 1:] + speeds[:, :-1]) / 2 * STEP, axis=1)[:, every - 1 :: every, None] / radius
    begin = np.cumsum(rng.uniform(-80, 80, (len(planned), 1, 1)), axis=0)
    rates = np.diff(way, axis=1, prepend=0.0) / SAMPLE
    recorded = {
        "times": SAMPLE * np.arange(1, way.shape[1] + 1),
        "rates": rates + 0.05 * rng.standard_normal(way.shape),
        "angles": begin + way,
        "steering": told[:, every::every, None],
        "stamps": stamps,
        "poses": poses,
    }
    wheels = [
        {"name": "axle", "type": "fixed", "radius": RADIUS, "x": 0.0, "y": 0.0},
        {"name": "front", "type": "steered", "radius": RADIUS, "x": FRONT + REAR, "y": 0.0, "driven": False},
    ]
    write(folder, {"name": "model car", "wheels": wheels}, planned, recorded)
    return {
        "kind": "understeer",
        "covariates": ("command", "wheel rate", "acceleration"),
        "right_names": ("understeer", "understeer_limit", "servo_lag", "servo_rate_limit", "steering_lag"),
        "size": size,
        "noncentrality": reached,
    }


def _commands() -> list[tuple[float, float, int]]:
    """Speed, m/s, steering angle, rad, and how often it is turned to the other side: straight drives, curves, slaloms.

    The harder curves at the higher speeds ask for more than the tyres give.
    """
    straight = [(speed, 0.0, 0) for speed in (0.6, 1.6, 2.6)]
    curves = [
        (speed, side * angle, 0)
        for speed, angles in ((0.5, (0.15, 0.35)), (1.2, (0.12, 0.3)), (1.9, (0.1, 0.2)), (2.6, (0.06, 0.15)))
        for angle in angles
        for side in (-1, 1)
    ]
    slaloms = [(0.8, 0.3, 3), (1.5, -0.2, 2), (1.5, 0.1, 4), (2.4, 0.1, 2)]
    wide = [(speed, side * 0.05, 0) for speed in (1.2, 1.9) for side in (-1, 1)]
    return [*straight, *curves, *wide, *slaloms, (0.4, -0.4, 1)]


def _profile(time: Array) -> Array:
    """Share (T,) of the speed: linear ramps of 0.6 s, at rest for 0.2 s at both ends."""
    return np.clip(np.minimum(time - 0.2, SECONDS - 0.2 - time) / 0.6, 0, 1)


def _told(time: Array, angle: float, turns: int) -> Array:
    """Commanded steering angles (T,), rad: a step, turned to the other side so many times, and back to 0 at the end.

    They change in the middle of a sample, so that the reading at its end is late by as much as it is early.
    """
    begin, end = 0.6 + SAMPLE / 2, SECONDS - 0.7 + SAMPLE / 2
    switches = begin + SAMPLE * np.round(np.linspace(0, end - begin, turns + 2) / SAMPLE)
    part = np.searchsorted(switches, time + STEP / 2) - 1
    return np.where((part >= 0) & (part <= turns), angle * (-1.0) ** part, 0.0)


def _driven(speeds: Array, told: Array, wheelbase: float, tyres: dict[str, float]) -> Array:
    """Twists (R, T, 3) of the middle of the rear axle of cars at speeds ahead (R, T), m/s.

    The speed along the car is held by its motor; sway and yaw follow the side forces of the tyres,

        m (v' + u w) = F_front cos(delta) + F_rear,    I w' = a F_front cos(delta) - b F_rear.
    """
    sway, yaw, delta = np.zeros((3, len(speeds)))
    ahead, behind = wheelbase * FRONT / (FRONT + REAR), wheelbase * REAR / (FRONT + REAR)
    loads = MASS * GRAVITY * np.array([behind, ahead]) / wheelbase
    twists = np.zeros((*speeds.shape, 3))
    for sample in range(speeds.shape[1]):
        speed = speeds[:, sample]
        twists[:, sample] = np.column_stack([speed, sway - behind * yaw, yaw])
        turned = np.clip((told[:, sample] - delta) / tyres["lag"], -tyres["fastest"], tyres["fastest"])
        delta = delta + STEP * turned
        rolling = np.maximum(speed, SLOW)
        front = delta - np.arctan((sway + ahead * yaw) / rolling)
        rear = -np.arctan((sway - behind * yaw) / rolling)
        of_front = _fiala(front, tyres["front"], tyres["friction"] * loads[0]) * np.cos(delta)
        of_rear = _fiala(rear, tyres["rear"], tyres["friction"] * loads[1])
        standing = np.minimum(speed / SLOW, 1.0)  # a car that hardly rolls goes where its wheels point
        sway = sway + STEP * ((of_front + of_rear) / MASS - speed * yaw)
        yaw = yaw + STEP * (ahead * of_front - behind * of_rear) / INERTIA
        kinematic = speed * np.tan(delta) / wheelbase
        yaw = standing * yaw + (1 - standing) * kinematic
        sway = standing * sway + (1 - standing) * behind * kinematic
    return twists


def _fiala(slip: Array, stiffness: float, most: float) -> Array:
    """Side force (R,), N, at slip angles (R,), rad: a cubic that ends at the friction's limit."""
    asked = np.clip(stiffness * np.tan(slip) / (3 * most), -1, 1)
    return most * asked * (3 - 3 * np.abs(asked) + asked**2)


def _integrated(starts: Array, twists: Array) -> Array:
    """Poses (R, T + 1, 3) by the trapezoidal rule of the heading, then of the velocity over the floor."""
    mean = (twists[:, 1:] + twists[:, :-1]) / 2
    turned = np.cumsum(STEP * mean[..., 2], axis=1)
    heading = starts[:, 2:] + np.concatenate([np.zeros((len(starts), 1)), turned], axis=1)
    over_floor = (twists[..., 0] + 1j * twists[..., 1]) * np.exp(1j * heading)
    moved = np.cumsum(STEP / 2 * (over_floor[:, 1:] + over_floor[:, :-1]), axis=1)
    path = np.concatenate([np.zeros((len(starts), 1)), moved], axis=1)
    return np.stack([starts[:, :1] + path.real, starts[:, 1:2] + path.imag, heading], axis=-1)
