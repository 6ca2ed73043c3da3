"""Differential drive by two belts with a bad splice: ripple at every turn of a belt, not of its wheel. Heun's rule."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .recording import Array, size_of, slots, write

SAMPLE, SECONDS, POSE = 0.01, 7.0, 20  # s, s, samples between poses
RADIUS, TRACK = 0.075, 0.42  # m
BELTS = (61, 67, 71, 73, 79, 83, 89)  # teeth; primes, so that no belt fits a whole number of turns


def make(folder: Path, seed: int) -> dict[str, Any]:
    """Write a recording of 140 + 80 runs."""
    rng = np.random.default_rng([3, seed])
    radii, track = RADIUS * (1 + 0.01 * rng.standard_normal(2)), TRACK * (1 + 0.015 * rng.standard_normal())
    matrix = np.array([radii / 2, [0.0, 0.0], radii / track * [-1, 1]])
    commands = _commands()
    planned = slots(len(commands), {"train": 7, "validation": 4}, SECONDS, rng)
    wheels_of = np.array([[1, -TRACK / 2], [1, TRACK / 2]]) / RADIUS
    asked = np.array([commands[slot.number] @ wheels_of.T for slot in planned])
    time = SAMPLE * np.arange(round(SECONDS / SAMPLE) + 1)
    rates = asked[:, None] * _profile(time)[:, None]  # (R, T + 1, 2)
    back = rng.uniform(-25, 25, (len(planned), 1, 2))  # rad, between the runs
    whole = _trapezes(rates)
    begin = np.cumsum(back + whole[:, -1:], axis=0) - whole[:, -1:]  # the encoders count on for both sessions
    angles = begin + whole
    starts = np.column_stack([rng.uniform(-0.3, 0.3, (len(planned), 2)), rng.uniform(-np.pi, np.pi, len(planned))])
    training = np.array([slot.split == "train" for slot in planned])
    turns = rng.integers(26, 41) / rng.choice(BELTS)  # of a belt, to one of its wheel
    splice = rng.uniform(-np.pi, np.pi, 2)
    shape = rng.uniform(0.1, 0.4)  # of the second harmonic

    def drive(size: float, which: Array, changed: Array = matrix) -> Array:
        phase = turns * angles[which] + splice
        rolled = rates[which] * (1 + size * (np.cos(phase) + shape * np.cos(2 * phase + 1)))
        return _integrated(starts[which], rolled @ changed.T)[:, ::POSE]

    still = drive(0.0, training)
    changes = 1e-5 * np.eye(6).reshape(6, 3, 2)
    columns = np.array([(drive(0.0, training, matrix + change) - still)[:, 1:] / 1e-5 for change in changes])
    stamps = SAMPLE * POSE * np.arange(still.shape[1])
    # White noise, a bias of the run and a slow random walk; the heading is better than the position.
    in_time = 0.8 * np.eye(len(stamps) - 1) + 1.5 + 0.1 * np.minimum(stamps[1:, None], stamps[1:])
    covariance = np.kron(in_time, np.diag([0.004, 0.004, 0.003]) ** 2)
    size, reached = size_of(lambda size: (drive(size, training) - still)[:, 1:], columns, covariance[None], 0.01)
    poses = drive(size, np.ones(len(planned), bool))
    noise = rng.standard_normal((len(planned), len(covariance))) @ np.linalg.cholesky(covariance).T
    poses[:, 1:] += noise.reshape(len(planned), -1, 3)
    exact = np.diff(whole, axis=1) / SAMPLE
    recorded = {
        "times": time[1:],
        "rates": exact + 0.015 * rng.standard_normal(exact.shape),
        "angles": angles[:, 1:] + 5e-4 * rng.standard_normal(exact.shape),
        "stamps": stamps,
        "poses": poses,
    }
    robot = {"name": "belt drive", "wheels": [_wheel("left", 1), _wheel("right", -1)]}
    write(folder, robot, planned, recorded)
    return {"kind": "belt_ripple", "covariates": ("wheel angle",), "size": size, "noncentrality": reached}


def _wheel(name: str, side: int) -> dict[str, Any]:
    return {"name": name, "type": "fixed", "radius": RADIUS, "x": 0.0, "y": side * TRACK / 2}


def _commands() -> Array:
    """Speeds and rates of turn (C, 2): straight both ways, arcs of three radii, turns on the spot."""
    straight = [(speed, 0.0) for speed in (0.3, 0.2, 0.12, -0.2)]
    arcs = [(speed, side * speed / radius) for speed in (0.25, 0.15) for radius in (0.4, 0.8, 1.5) for side in (-1, 1)]
    return np.array([*straight, *arcs, (0.0, 0.5), (0.0, -0.5), (0.0, 1.0), (0.0, -1.0)])


def _profile(time: Array) -> Array:
    """Share (T,) of the command: trapezoidal, from rest to rest, 0.4 s up and 0.25 s down."""
    return np.clip(np.minimum(time / 0.4, (SECONDS - time) / 0.25), 0, 1)


def _trapezes(rates: Array) -> Array:
    """Integrals (R, T + 1, 2) of rates at the samples' ends."""
    steps = SAMPLE / 2 * (rates[:, 1:] + rates[:, :-1])
    return np.concatenate([np.zeros_like(rates[:, :1]), np.cumsum(steps, axis=1)], axis=1)


def _integrated(starts: Array, twists: Array) -> Array:
    """Poses (R, T + 1, 3) by Heun's rule: trapezes of the heading, then of the world velocity."""
    heading = starts[:, None, 2:] + _trapezes(twists[:, :, 2:])
    cosine, sine = np.cos(heading[..., 0]), np.sin(heading[..., 0])
    ahead, left = twists[..., 0], twists[..., 1]
    velocity = np.stack([cosine * ahead - sine * left, sine * ahead + cosine * left], axis=-1)
    return np.concatenate([starts[:, None, :2] + _trapezes(velocity), heading], axis=-1)
