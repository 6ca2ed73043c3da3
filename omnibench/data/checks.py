"""Values that are numbers but cannot be right: units and wheels told from the size of what they predict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import permutations, product

import numpy as np

from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import OdometryBatch, WheelLog

_RPM = 2 * math.pi / 60
_DEGREE = math.pi / 180
_MOST_TRAJECTORIES = 24
_STAMPS = 4


def implausible(robot: Robot, logs: Sequence[WheelLog], poses: Sequence[Array], headings: Sequence[Array]) -> list[str]:
    """Warnings about units and wheels, from a comparison of the reference with the design model's odometry.

    ``poses`` are as recorded, ``headings`` the unwrapped ones (rad).
    """
    every = max(1, len(logs) // _MOST_TRAJECTORIES)
    logs, poses, headings = logs[::every], poses[::every], headings[::every]
    odometry = OdometryModel.of_design(robot, "arc").poses(logs)
    moved = _extent([pose[:, :2] for pose in odometry])
    turned = _extent([pose[:, 2:] for pose in odometry])
    moved_reference = _extent([pose[:, :2] for pose in poses])
    turned_reference = _extent([heading[:, None] for heading in headings])
    turned_as_recorded = _extent([pose[:, 2:] for pose in poses])
    largest = max(float(np.abs(pose[:, 2]).max()) for pose in poses)

    if moved == 0 and turned == 0:
        return ["the wheels never turn; check the omega_* columns"]
    warnings = []
    degrees = largest > 2 * math.pi + 0.5 and _about(turned_as_recorded, turned / _DEGREE)
    if degrees:
        warnings.append("theta looks like degrees; it must be rad")
    for unit, factor in (("rpm", _RPM), ("deg/s", _DEGREE)):
        turns_agree = degrees or turned < 0.3 * len(logs) or _about(turned_reference, turned * factor)
        if moved > 0 and _about(moved_reference, moved * factor) and turns_agree:
            return [*warnings, f"wheel rates look like {unit}; omega_* must be rad/s"]
    for unit, factor in (("mm", 1000.0), ("cm", 100.0)):
        if moved > 0 and _about(moved_reference, moved * factor):
            return [*warnings, f"positions look like {unit}; x and y must be m"]
    return warnings or _swapped_wheels(robot, logs, poses, headings)


def _extent(paths: Sequence[Array]) -> float:
    """Farthest that each path comes from its start, summed."""
    return sum(float(np.linalg.norm(path - path[0], axis=1).max()) for path in paths)


def _about(value: float, expected: float, factor: float = 1.6) -> bool:
    return expected > 0 and 1 / factor < value / expected < factor


def _swapped_wheels(
    robot: Robot, logs: Sequence[WheelLog], poses: Sequence[Array], headings: Sequence[Array]
) -> list[str]:
    names = robot.wheel_names
    if len(names) > 4:
        return []
    chosen = [np.unique(np.linspace(0, len(log.stamps) - 1, _STAMPS + 1).astype(int))[1:] for log in logs]
    if not all(len(indices) for indices in chosen):
        return []
    batch = OdometryBatch(
        [WheelLog(log.times, log.rates, log.start, log.stamps[i]) for log, i in zip(logs, chosen, strict=True)], "arc"
    )
    reference = np.concatenate(
        [np.column_stack([p[i, :2], h[i]]) for p, h, i in zip(poses, headings, chosen, strict=True)]
    )
    start = np.concatenate([np.tile(log.start, (len(i), 1)) for log, i in zip(logs, chosen, strict=True)])
    arrangements = list(product(permutations(range(len(names))), product((1, -1), repeat=len(names))))
    design = robot.inverse_kinematic_matrix
    matrices = np.array([_rearranged(design, order, signs) for order, signs in arrangements])
    lever = float(np.mean([wheel.distance for wheel in robot.wheels]))  # weighs rad against m
    weights = np.array([1.0, 1.0, lever])
    errors = np.abs((batch.poses(matrices) - reference) * weights).sum((1, 2))
    motion = np.abs((reference - start) * weights).sum()
    best = int(errors.argmin())
    if errors[0] < 0.5 * motion or errors[best] > 0.3 * errors[0]:
        return []
    order, signs = arrangements[best]
    shown = ", ".join(
        f"{name} <- {'-' if sign < 0 else ''}{names[column]}"
        for name, column, sign in zip(names, order, signs, strict=True)
    )
    return [f"wheels look swapped or sign-flipped; the reference fits with omega of {shown}"]


def _rearranged(matrix: Array, order: Sequence[int], signs: Sequence[int]) -> Array:
    """The matrix that acts on the recorded columns as ``matrix`` does on wheel i = signs[i] * column order[i]."""
    result = np.empty_like(matrix)
    for wheel, (column, sign) in enumerate(zip(order, signs, strict=True)):
        result[:, column] = sign * matrix[:, wheel]
    return result
