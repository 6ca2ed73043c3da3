"""Three omni wheels on a cable that pulls them towards its anchor once it is taut. Adams-Bashforth, SLAM that jumps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .recording import Array, size_of, slots, write

STEP, SAMPLE, POSE, SECONDS = 0.005, 0.05, 0.25, 7.5  # s
RADIUS, DISTANCE, AXLES = 0.0625, 0.14, np.radians([0.0, 120.0, 240.0])  # m, m, rad


def make(folder: Path, seed: int) -> dict[str, Any]:
    """Write a recording of 125 + 75 runs."""
    rng = np.random.default_rng([5, seed])
    radii, axles = RADIUS * (1 + 0.012 * rng.standard_normal(3)), AXLES + 0.01 * rng.standard_normal(3)
    wheels_of = np.column_stack([-np.sin(axles), np.cos(axles), np.full(3, DISTANCE)]) / radii[:, None]
    matrix = np.linalg.inv(wheels_of)
    commands = _commands()
    planned = slots(len(commands), {"train": 5, "validation": 3}, SECONDS, rng)
    rates = np.array([commands[slot.number] @ wheels_of.T for slot in planned])
    starts = np.column_stack([rng.uniform(-0.7, 0.7, (len(planned), 2)), rng.uniform(-np.pi, np.pi, len(planned))])
    training = np.array([slot.split == "train" for slot in planned])
    bearing, away = rng.uniform(-np.pi, np.pi), rng.uniform(1.2, 1.8)  # rad, m: the anchor
    anchor, slack = away * np.array([np.cos(bearing), np.sin(bearing)]), away * rng.uniform(0.8, 1.1)  # m

    def drive(size: float, which: Array, changed: Array = matrix) -> Array:
        return _integrated(starts[which], rates[which], changed, anchor, slack, size)[:, :: round(POSE / STEP)]

    still = drive(0.0, training)
    changes = 1e-5 * np.eye(9).reshape(9, 3, 3)
    columns = np.array([(drive(0.0, training, matrix + change) - still)[:, 1:] / 1e-5 for change in changes])
    stamps = POSE * np.arange(still.shape[1])
    # White noise beside steps of the SLAM's map, which come once in 2 s on average.
    in_time = 0.7 * np.eye(len(stamps) - 1) + 0.5 * np.minimum(stamps[1:, None], stamps[1:])
    scales = np.array([0.005, 0.005, 0.006])  # m, m, rad
    covariance = np.kron(in_time, np.diag(scales**2))
    size, reached = size_of(lambda size: (drive(size, training) - still)[:, 1:], columns, covariance[None], 0.05)
    poses = drive(size, np.ones(len(planned), bool))
    stepped = rng.random((*poses.shape[:2], 1)) < POSE / 2.0
    jumps = np.cumsum(stepped * rng.standard_normal(poses.shape), axis=1)
    poses[:, 1:] += scales * (np.sqrt(0.7) * rng.standard_normal(poses.shape) + jumps)[:, 1:]
    profile = _profile(STEP * (np.arange(round(SECONDS / STEP)) + 0.5)).reshape(-1, round(SAMPLE / STEP)).mean(axis=1)
    exact = rates[:, None] * profile[:, None]
    begin = np.cumsum(rng.uniform(-40, 40, (len(planned), 1, 3)), axis=0)
    recorded = {
        "times": SAMPLE * np.arange(1, len(profile) + 1),
        "rates": exact + 0.02 * rng.standard_normal(exact.shape),
        "angles": begin + np.cumsum(exact, axis=1) * SAMPLE,
        "stamps": stamps,
        "poses": poses,
    }
    wheels = [
        {"name": f"m{index}", "type": "omni", "radius": RADIUS, "distance": DISTANCE, "angle": float(angle)}
        for index, angle in enumerate(AXLES)
    ]
    write(folder, {"name": "tethered", "wheels": wheels}, planned, recorded)
    return {"kind": "tether_pull", "covariates": ("place",), "size": size, "noncentrality": reached}


def _commands() -> Array:
    """Twists (C, 3): a square's sides at two speeds, circles both ways in six directions, turns on the spot."""
    sides = [(speed * np.cos(a), speed * np.sin(a), 0.0) for speed in (0.1, 0.22) for a in np.pi / 2 * np.arange(4)]
    circles = [
        (0.16 * np.cos(a), 0.16 * np.sin(a), turn) for turn in (0.5, -0.5) for a in np.pi / 6 + np.pi / 3 * np.arange(6)
    ]
    return np.array([*sides, *circles, (0, 0, 0.6), (0, 0, -0.6), (0, 0, 1.1), (0, 0, -1.1), (0.22, 0, 0.25)])


def _profile(time: Array) -> Array:
    """Share (T,) of the command: a smooth step of 0.6 s up and one down."""
    near = np.clip(np.minimum(time, SECONDS - time) / 0.6, 0, 1)
    return near**2 * (3 - 2 * near)


def _integrated(starts: Array, rates: Array, matrix: Array, anchor: Array, slack: float, creep: float) -> Array:
    """Poses (R, T + 1, 3) by Adams-Bashforth steps of second order. creep: m/s for a metre of stretch at full speed."""
    shares = _profile(STEP * np.arange(round(SECONDS / STEP)))
    rolling = np.abs(rates).mean(axis=1) * RADIUS / 0.2  # a wheel gives way only while it rolls
    poses, before = [starts], None
    for share in shares:
        pose, twist = poses[-1], share * rates @ matrix.T
        cosine, sine = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        slope = np.column_stack(
            [cosine * twist[:, 0] - sine * twist[:, 1], sine * twist[:, 0] + cosine * twist[:, 1], twist[:, 2]]
        )
        cable = anchor - pose[:, :2]
        length = np.hypot(*cable.T)
        stretch = np.maximum(length - slack, 0.0)
        slope[:, :2] += (creep * share * rolling * stretch / length)[:, None] * cable
        poses.append(pose + STEP * (slope if before is None else 1.5 * slope - 0.5 * before))
        before = slope
    return np.array(poses).transpose(1, 0, 2)
