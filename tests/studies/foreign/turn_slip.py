"""Differential drive on wide tyres whose treads are twisted in curves and scrub. Brush tyres, RK4, two-rate clock."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .recording import Array, size_of, slots, write

STEP, SAMPLE, POSE, SECONDS = 0.005, 0.02, 0.2, 7.0  # s
RADIUS, TRACK = 0.06, 0.36  # m
ALONG, ACROSS = 15, 4  # bristles along the contact patch, and on one half of its width


def make(folder: Path, seed: int) -> dict[str, Any]:
    """Write a recording of 160 + 96 runs."""
    rng = np.random.default_rng([6, seed])
    radii, track = RADIUS * (1 + 0.01 * rng.standard_normal(2)), TRACK * (1 + 0.015 * rng.standard_normal())
    matrix = np.array([radii / 2, [0.0, 0.0], radii / track * [-1, 1]])
    commands = _commands()
    planned = slots(len(commands), {"train": 5, "validation": 3}, SECONDS, rng)
    wheels_of = np.array([[1, -TRACK / 2], [1, TRACK / 2]]) / RADIUS
    asked = np.array([commands[slot.number] @ wheels_of.T for slot in planned])
    half_steps = STEP / 2 * np.arange(2 * round(SECONDS / STEP) + 1)
    rates = asked[:, None] * _profile(half_steps)[:, None]  # (R, 2T + 1, 2)
    starts = np.column_stack([rng.uniform(-0.3, 0.3, (len(planned), 2)), rng.uniform(-np.pi, np.pi, len(planned))])
    stamps = POSE * np.arange(round(SECONDS / POSE) + 1)
    training = np.array([slot.split == "train" for slot in planned])
    patch, width = rng.uniform(0.02, 0.05), rng.uniform(0.015, 0.035)  # m, half the length and width of a contact
    grip = patch * rng.uniform(0.04, 0.1)  # m: a bristle in the middle slides when it is bent farther

    def drive(size: float, which: Array, changed: Array = matrix) -> Array:
        """Poses (R, K, 3). size: stiffness of a tread against twist, of that along the way."""
        twists = rates[which] @ changed.T
        return _integrated(starts[which], _scrubbed(twists, size, patch, width, grip))[:, :: round(POSE / STEP)]

    still = drive(0.0, training)
    changes = 1e-5 * np.eye(6).reshape(6, 3, 2)
    columns = np.array([(drive(0.0, training, matrix + change) - still)[:, 1:] / 1e-5 for change in changes])
    ages = np.abs(stamps[1:, None] - stamps[1:])
    in_time = 0.8 * np.eye(len(ages)) + np.exp(-ages / 0.8) + 0.08 * np.minimum(stamps[1:, None], stamps[1:])
    covariance = np.kron(in_time, np.diag([0.003, 0.003, 0.003]) ** 2)
    size, reached = size_of(lambda size: (drive(size, training) - still)[:, 1:], columns, covariance[None], 0.05)
    poses = drive(size, np.ones(len(planned), bool))
    noise = rng.standard_normal((len(planned), len(covariance))) @ np.linalg.cholesky(covariance).T
    poses[:, 1:] += noise.reshape(len(planned), -1, 3)
    turned = STEP / 6 * (rates[:, :-2:2] + 4 * rates[:, 1:-1:2] + rates[:, 2::2])
    within = np.concatenate([np.zeros_like(turned[:, :1]), np.cumsum(turned, axis=1)], axis=1)
    begin = np.cumsum(rng.uniform(-30, 30, (len(planned), 1, 2)) + within[:, -1:], axis=0) - within[:, -1:]
    angles = (begin + within)[:, :: round(SAMPLE / STEP)] + 2e-4 * rng.standard_normal((len(planned), 351, 2))
    recorded = {
        "times": SAMPLE * np.arange(1, angles.shape[1]),
        "rates": np.diff(angles, axis=1) / SAMPLE,
        "angles": angles[:, 1:],
        "stamps": stamps,
        "poses": poses,
    }
    robot = {"name": "on wide tyres", "wheels": [_wheel("left", 1), _wheel("right", -1)]}
    write(folder, robot, planned, recorded)
    return {
        "kind": "turn_slip",
        "covariates": ("command", "wheel rate"),
        "right_names": ("turn_slip",),
        "size": size,
        "noncentrality": reached,
    }


def _wheel(name: str, side: int) -> dict[str, Any]:
    return {"name": name, "type": "fixed", "radius": RADIUS, "x": 0.0, "y": side * TRACK / 2}


def _scrubbed(twists: Array, stiffness: float, patch: float, width: float, grip: float) -> Array:
    """Twists (..., 3) of a robot whose tyres resist being turned: their torque is borne by slip along the way.

    A bristle at the distance y from the middle of a tyre, whose wheel goes along a path of the curvature c, is bent by
    c y s once it is a way s into the contact patch, until it slides; the pressure is a parabola of s. The torques of
    both wheels are held by opposite forces along the way, for which one tyre slips ahead and the other behind.
    """
    arm, (speed, turn) = TRACK / 2, (twists[..., 0], twists[..., 2])
    ways = (np.arange(ALONG) + 0.5) / ALONG * 2 * patch
    offsets = (np.arange(ACROSS) + 0.5) / ACROSS * width
    rims = [np.abs(speed - side * arm * turn) for side in (1, -1)]  # left, right
    torque = np.zeros(turn.shape)
    for rim in rims:
        curvature = np.abs(turn) / np.maximum(rim, 1e-3)
        for way in ways:
            held = grip * way * (2 * patch - way) / patch**2
            for offset in offsets:
                torque += np.minimum(curvature * offset * way, held) * offset
    # A force is slip times the sum of the ways of all bristles, so that their stiffness counts no more.
    slip = stiffness * np.sign(turn) * torque / (2 * arm) / (ACROSS * ways.sum())
    changed = twists.copy()
    changed[..., 0] += slip * (rims[0] - rims[1]) / 2
    changed[..., 2] -= slip * (rims[0] + rims[1]) / (2 * arm)
    return changed


def _commands() -> Array:
    """Speeds and rates of turn (C, 2): straight both ways, arcs of six radii, turns on the spot."""
    straight = [(speed, 0.0) for speed in (0.35, 0.2, -0.25)]
    arcs = [
        (speed, side * speed / radius)
        for radius, speeds in ((0.1, (0.1,)), (0.2, (0.15,)), (0.35, (0.25,)), (0.6, (0.3, 0.15)), (1.0, (0.3,)))
        for speed in speeds
        for side in (-1, 1)
    ]
    backward = [(-0.2, 0.4), (-0.2, -0.4), (-0.12, 0.9), (-0.12, -0.9)]
    around = [(0.3, 0.15), (0.3, -0.15), (0.22, 0.9), (0.22, -0.9), (0.3, 0.75), (0.3, -0.75)]
    spots = [(0.0, turn) for turn in (0.5, -0.5, 0.9, -0.9, 1.4, -1.4, 0.7)]
    return np.array([*straight, *arcs, *backward, *around, *spots])


def _profile(time: Array) -> Array:
    """Share (T,) of the command: smooth ramps of 0.5 s."""
    near = np.clip(np.minimum(time, SECONDS - time) / 0.5, 0, 1)
    return near**2 * (3 - 2 * near)


def _integrated(starts: Array, twists: Array) -> Array:
    """Poses (R, T + 1, 3) by Runge-Kutta steps of fourth order, from twists (R, 2T + 1, 3) at half steps.

    The heading is an integral of its own, and with it known Runge-Kutta's rule is Simpson's.
    """
    turned = STEP / 6 * (twists[:, :-2:2, 2] + 4 * twists[:, 1:-1:2, 2] + twists[:, 2::2, 2])
    at_steps = starts[:, 2:] + np.concatenate([np.zeros((len(starts), 1)), np.cumsum(turned, axis=1)], axis=1)
    half = STEP / 24 * (5 * twists[:, :-2:2, 2] + 8 * twists[:, 1:-1:2, 2] - twists[:, 2::2, 2])
    between = at_steps[:, :-1] + half
    ends, middles = np.exp(1j * at_steps), np.exp(1j * between)
    ahead = twists[..., 0]
    moved = STEP / 6 * (ahead[:, :-2:2] * ends[:, :-1] + 4 * ahead[:, 1:-1:2] * middles + ahead[:, 2::2] * ends[:, 1:])
    path = np.concatenate([np.zeros((len(starts), 1)), np.cumsum(moved, axis=1)], axis=1)
    return np.stack([starts[:, :1] + path.real, starts[:, 1:2] + path.imag, at_steps], axis=-1)
