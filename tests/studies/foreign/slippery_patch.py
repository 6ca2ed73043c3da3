"""Four mecanum wheels on a floor with one slippery patch of irregular outline. Exponential steps, heavy tails."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .recording import Array, size_of, slots, write

SAMPLE, STEPS, SECONDS = 0.025, 2, 8.0  # s, steps a sample, s
POSE = 12  # samples between poses: 0.3 s
RADIUS, AHEAD, BESIDE = 0.06, 0.21, 0.18  # m
PLACES = {"fl": (1, 1), "fr": (1, -1), "rl": (-1, 1), "rr": (-1, -1)}
SOFT = 0.01  # m: the robot is on the patch by and by


def make(folder: Path, seed: int) -> dict[str, Any]:
    """Write a recording of 150 + 90 runs."""
    rng = np.random.default_rng([2, seed])
    wheels_of = _wheel_equations(1 + 0.012 * rng.standard_normal(4), 1 + 0.01 * rng.standard_normal(2))
    commands = _commands()
    planned = slots(len(commands), {"train": 5, "validation": 3}, SECONDS, rng)
    rates = np.array([commands[slot.number] @ wheels_of.T for slot in planned])
    starts = np.column_stack([rng.uniform(-0.5, 0.5, (len(planned), 2)), rng.uniform(-np.pi, np.pi, len(planned))])
    training = np.array([slot.split == "train" for slot in planned])
    outline = 0.2 + 0.25 * rng.random(10)  # m, ten corners around its middle
    middle, sticking = rng.uniform(-0.4, 0.4, 2), rng.uniform(0.3, 0.8)

    def drive(size: float, which: Array, changed: Array) -> Array:
        """Poses (R, K, 3). The wheels slip on the patch, turning less than driving."""
        driven, poses = rates[which] @ changed.T, [starts[which]]
        lost = size * np.array([1.0, 1.0, sticking])
        for share in _profile():
            grip = 1 - np.outer(_inside(poses[-1][:, :2] - middle, outline), lost)
            poses.append(_exponential(poses[-1], SAMPLE / STEPS * share * driven * grip))
        return np.array(poses[:: STEPS * POSE]).transpose(1, 0, 2)

    matrix = np.linalg.pinv(wheels_of)
    still = drive(0.0, training, matrix)
    changes = 1e-5 * np.eye(12).reshape(12, 3, 4)
    columns = np.array([(drive(0.0, training, matrix + change) - still)[:, 1:] / 1e-5 for change in changes])
    stamps = SAMPLE * POSE * np.arange(still.shape[1])
    walk = 0.0025**2 * np.minimum(stamps[1:, None], stamps[1:])
    covariance = np.kron(0.005**2 * np.eye(len(walk)) + walk, np.diag([1.0, 1.0, 0.8]))
    start = np.diag([0.004, 0.004, 0.005]) ** 2  # m, m, rad: the first pose is as noisy as a lens sees it
    turned = [_of_start(run) for run in still]
    whole = covariance + np.array([each @ start @ each.T for each in turned])
    size, reached = size_of(lambda size: (drive(size, training, matrix) - still)[:, 1:], columns, whole, 0.1)
    poses = drive(size, np.ones(len(planned), bool), matrix)
    tails = rng.standard_t(6, (len(planned), len(covariance))) / np.sqrt(1.5)
    poses[:, 1:] += (tails @ np.linalg.cholesky(covariance).T).reshape(len(planned), -1, 3)
    poses[:, 0] += rng.standard_normal((len(planned), 3)) @ np.sqrt(start)
    profile = _profile().reshape(-1, STEPS).mean(axis=1)
    measured = rates[:, None] * profile[:, None] + 0.03 * rng.standard_normal((len(planned), len(profile), 4))
    begin = np.cumsum(rng.uniform(-50, 50, (len(planned), 1, 4)), axis=0)
    angles = begin + np.cumsum(rates[:, None] * profile[:, None], axis=1) * SAMPLE
    times = SAMPLE * np.arange(1, len(profile) + 1)
    recorded = {"times": times, "rates": measured, "angles": angles, "stamps": stamps, "poses": poses}
    write(folder, _robot(), planned, recorded)
    return {
        "kind": "slippery_patch",
        "covariates": ("place",),
        "right_names": ("floor_map",),
        "size": size,
        "noncentrality": reached,
    }


def _robot() -> dict[str, Any]:
    wheels = [
        {"name": name, "type": "mecanum", "radius": RADIUS, "x": ahead * AHEAD, "y": left * BESIDE}
        for name, (ahead, left) in PLACES.items()
    ]
    return {"name": "platform", "wheels": wheels}


def _wheel_equations(radii: Array, arms: Array) -> Array:
    """Rates of the wheels (4, 3) by the twist, rollers in an X from above: vx -+ vy -+ arm w, over the radius."""
    signs = np.array(list(PLACES.values()), dtype=float)
    ahead, left = signs.T
    arm = AHEAD * arms[0] + BESIDE * arms[1]
    return np.column_stack([np.ones(4), -ahead * left, -left * arm]) / (RADIUS * radii)[:, None]


def _commands() -> Array:
    """Twists (C, 3) of forward, sideways and slanting drives, of arcs and of turns on the spot."""
    twists = [
        (speed * np.cos(angle), speed * np.sin(angle), turn)
        for speed, turn, count in ((0.12, 0.0, 6), (0.2, 0.0, 6), (0.16, 0.4, 7), (0.16, -0.4, 7))
        for angle in 2 * np.pi * np.arange(count) / count
    ]
    return np.array([*twists, (0, 0, 0.8), (0, 0, -0.8), (0, 0, 0.4), (0, 0, -0.4)])


def _profile() -> Array:
    """Share (steps,) of the command: raised-cosine ramps of 0.5 s."""
    steps = round(SECONDS / SAMPLE) * STEPS
    time = (np.arange(steps) + 0.5) * SECONDS / steps
    near = np.clip(np.minimum(time, SECONDS - time) / 0.5, 0, 1)
    return 0.5 * (1 - np.cos(np.pi * near))


def _inside(offsets: Array, outline: Array) -> Array:
    """How far (R,) from 0 to 1 places are inside the outline, linear in angle between its corners."""
    corners = np.linspace(-np.pi, np.pi, len(outline) + 1)
    border = np.interp(np.arctan2(offsets[:, 1], offsets[:, 0]), corners, np.append(outline, outline[0]))
    return 1 / (1 + np.exp(np.clip((np.hypot(*offsets.T) - border) / SOFT, -40, 40)))


def _exponential(poses: Array, steps: Array) -> Array:
    """Poses (R, 3) moved by constant twists (R, 3) over one unit of time, along exact arcs."""
    ahead, left, turn = steps.T
    small = np.abs(turn) < 1e-9
    safe = np.where(small, 1.0, turn)
    sine, versine = np.where(small, 1.0, np.sin(safe) / safe), np.where(small, 0.0, (1 - np.cos(safe)) / safe)
    x, y = sine * ahead - versine * left, versine * ahead + sine * left
    cosine, sine = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return poses + np.column_stack([cosine * x - sine * y, sine * x + cosine * y, turn])


def _of_start(run: Array) -> Array:
    """How later poses, all but the first of (K, 3), differ from odometry by an error of the first, (3K - 3, 3)."""
    moved = run[1:] - run[0]
    jacobian = np.tile(np.eye(3), (len(moved), 1, 1))
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -moved[:, 1], moved[:, 0]
    return -jacobian.reshape(-1, 3)
