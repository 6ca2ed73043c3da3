"""Four rigid wheels that skid on dry friction: tracks widen on the spot. Balance of forces by Newton's method, arcs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from .recording import Array, size_of, slots, write

STEP, SAMPLE, POSE, SECONDS = 0.01, 0.04, 0.2, 6.0  # s
RADIUS, AHEAD, BESIDE = 0.08, 0.16, 0.2  # m
PLACES = {"fl": (1, 1), "fr": (1, -1), "rl": (-1, 1), "rr": (-1, -1)}
CREEP = 0.04  # sliding as a share of the rim's speed at which friction is 0.76 of its limit
DRAG = 0.03  # rolling resistance, of the load


def make(folder: Path, seed: int) -> dict[str, Any]:
    """Write a recording of 135 + 81 runs."""
    rng = np.random.default_rng([8, seed])
    radius, beside = RADIUS * (1 + 0.01 * rng.standard_normal(2)), BESIDE * (1 + 0.02 * rng.standard_normal())
    commands = _commands()
    planned = slots(len(commands), {"train": 5, "validation": 3}, SECONDS, rng)
    numbers = np.array([slot.number for slot in planned])
    sides = commands @ np.array([[1.0, -BESIDE * 1.5], [1.0, BESIDE * 1.5]]).T / RADIUS  # rates left, right
    load, across = rng.uniform(-0.25, 0.25), rng.uniform(0.55, 0.95)
    moved = np.array([_balanced(pair * radius, beside, load, across) for pair in sides])  # twists (C, 3)
    free, *_ = np.linalg.lstsq(sides, moved, rcond=None)
    matrix = free.T
    departs = moved - sides @ free
    shares = _profile(STEP * (np.arange(round(SECONDS / STEP)) + 0.5))
    starts = np.column_stack([rng.uniform(-0.4, 0.4, (len(planned), 2)), rng.uniform(-np.pi, np.pi, len(planned))])
    training = np.array([slot.split == "train" for slot in planned])

    def drive(size: float, which: Array, changed: Array = matrix) -> Array:
        """Poses (R, K, 3). size: share of what no matrix makes of the balance; 1: as it is."""
        twists = (sides @ changed.T + size * departs)[numbers[which]]
        return _arcs(starts[which], twists, shares)[:, :: round(POSE / STEP)]

    still = drive(0.0, training)
    steps = 1e-5 * np.eye(6).reshape(6, 3, 2)
    columns = np.array([(drive(0.0, training, matrix + step) - still)[:, 1:] / 1e-5 for step in steps])
    stamps = POSE * np.arange(still.shape[1])
    in_time = np.eye(len(stamps) - 1) + 0.6 + 0.4 * np.minimum(stamps[1:, None], stamps[1:])
    covariance = np.kron(in_time, np.diag([0.005, 0.005, 0.006]) ** 2)
    size, reached = size_of(lambda size: (drive(size, training) - still)[:, 1:], columns, covariance[None], 0.3)
    poses = drive(size, np.ones(len(planned), bool))
    tails = rng.standard_t(8, (len(planned), len(covariance))) / np.sqrt(8 / 6)
    poses[:, 1:] += (tails @ np.linalg.cholesky(covariance).T).reshape(len(planned), -1, 3)
    profile = shares.reshape(-1, round(SAMPLE / STEP)).mean(axis=1)
    exact = sides[numbers][:, None, [0, 1, 0, 1]] * profile[:, None]
    begin = np.cumsum(rng.uniform(-30, 30, (len(planned), 1, 4)), axis=0)
    recorded = {
        "times": SAMPLE * np.arange(1, len(profile) + 1),
        "rates": exact + 0.02 * rng.standard_normal(exact.shape),
        "angles": begin + np.cumsum(exact, axis=1) * SAMPLE,
        "stamps": stamps,
        "poses": poses,
    }
    wheels = [
        {"name": name, "type": "fixed", "radius": RADIUS, "x": ahead * AHEAD, "y": left * BESIDE}
        for name, (ahead, left) in PLACES.items()
    ]
    write(folder, {"name": "rover", "skid": True, "wheels": wheels}, planned, recorded)
    return {
        "kind": "skid_icr",
        "covariates": ("command", "wheel rate"),
        "right_names": ("icr_curvature",),
        "size": size,
        "noncentrality": reached,
    }


def _balanced(rims: Array, beside: float, load: float, across: float) -> Array:
    """Twist (3,) at which friction on the four wheels is in balance, for rims' speeds (2,), m/s, left and right.

    load: by how much the front carries more, of the half. across: friction along the axle, of that along the rim.
    """
    places = np.array([(AHEAD * ahead, beside * left) for ahead, left in PLACES.values()])
    weights = np.array([1 + load * ahead for ahead, _ in PLACES.values()])
    speeds = np.where(places[:, 1] > 0, rims[0], rims[1])
    unit = max(np.abs(rims).max(), 1e-9)

    def left_over(twist: Array) -> Array:
        """Sums (3,) of forces and torque on the body."""
        ahead, left = twist[0] - places[:, 1] * twist[2], twist[1] + places[:, 0] * twist[2]
        along = speeds - ahead
        sliding = np.hypot(along, left) / unit
        share = np.tanh(sliding / CREEP) / np.maximum(sliding, 1e-9) / unit
        push, shove = weights * share * along, -weights * share * across * left
        push = push - weights * DRAG * np.tanh(ahead / (0.02 * unit))
        return np.array([push.sum(), shove.sum(), (places[:, 0] * shove - places[:, 1] * push).sum() / beside])

    start = np.array([rims.mean(), 0.0, (rims[1] - rims[0]) / (3 * beside)])
    return least_squares(left_over, start, x_scale=unit, xtol=1e-12, ftol=1e-12, gtol=1e-12).x


def _commands() -> Array:
    """Speeds and rates of turn (C, 2): straight both ways, arcs from tight to wide, turns on the spot."""
    straight = [(0.5, 0.0), (0.25, 0.0), (-0.35, 0.0)]
    arcs = [
        (speed, side * speed / radius)
        for radius, speeds in ((0.15, (0.12,)), (0.3, (0.2, 0.1)), (0.6, (0.3,)), (1.0, (0.4, 0.2)), (1.8, (0.5,)))
        for speed in speeds
        for side in (-1, 1)
    ]
    spots = [(0.0, turn) for turn in (0.5, -0.5, 1.0, -1.0, 1.4, -1.4)]
    return np.array([*straight, *arcs, *spots, (-0.3, 0.4), (-0.3, -0.4), (-0.15, 0.8), (-0.15, -0.8)])


def _profile(time: Array) -> Array:
    """Share (T,) of the command: half cosines of 0.5 s up and down."""
    near = np.clip(np.minimum(time, SECONDS - time) / 0.5, 0, 1)
    return (1 - np.cos(np.pi * near)) / 2


def _arcs(starts: Array, twists: Array, shares: Array) -> Array:
    """Poses (R, T + 1, 3) by arcs at constant twists share * twists (R, 3), by complex numbers."""
    step = STEP * shares
    turned = np.concatenate([[0.0], np.cumsum(step)]) * twists[:, 2:] + starts[:, 2:]
    half = step * twists[:, 2:] / 2
    chord = (twists[:, :1] + 1j * twists[:, 1:2]) * step * np.sinc(half / np.pi) * np.exp(1j * (turned[:, :-1] + half))
    path = np.concatenate([np.zeros((len(starts), 1)), np.cumsum(chord, axis=1)], axis=1)
    return np.stack([starts[:, :1] + path.real, starts[:, 1:2] + path.imag, turned], axis=-1)
