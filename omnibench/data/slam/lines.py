"""Straight pieces of the surroundings, fitted to neighbouring rays of a scan.

A line n.p = d is seen along the direction phi at the range 1 / (a cos phi + b sin phi) with (a, b) = n / d. The fit is
to the ranges, which alone are noisy: one to the points would tilt towards the scanner.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from omnibench.data.scans import Scanner
from omnibench.robot.kinematics import Array

_SIZES = (128, 64, 32, 16, 8)  # rays of a piece, tried in this order
_FULL, _FEWEST = 0.5, 6  # of them at least this share and number has to return
_LONGEST = 3.0  # m
_TILT = 0.05  # rad; a line whose direction is less certain is none
_STEPS = 2  # of Gauss-Newton, from an algebraic fit


@dataclass(frozen=True, eq=False)
class Lines:
    """Straight pieces. centres (m, 2), m. normals (m, 2): unit, towards the scanner. half_lengths (m,), m.

    rays (m,): how many were fitted. tilt_variances (m,): of the normals' direction, rad^2. delays (m,): since the
    scan's stamp, s.
    """

    centres: Array
    normals: Array
    half_lengths: Array
    rays: NDArray[np.int_]
    tilt_variances: Array
    delays: Array


_FIELDS = tuple(field.name for field in fields(Lines))


def fit_lines(
    ranges: Array, valid: NDArray[np.bool_], deviations: Array, scanner: Scanner, velocity: Array
) -> tuple[Lines, NDArray[np.int_]]:
    """Straight pieces, and for each ray (R,) the index of the piece it is part of, or -1.

    ranges, valid, deviations: (R,) of one scan, m. velocity (2,): of the scanner, in its frame, m/s. Each piece is in
    the frame of the scanner as it stood when the middle of the piece was measured.
    """
    part_of = np.where(valid, -1, -2)  # -2: nothing returned
    found: list[Lines] = []
    approach = np.cos(scanner.angles) * velocity[0] + np.sin(scanner.angles) * velocity[1]
    for size in _SIZES:
        known = sum(len(lines.rays) for lines in found)
        found.append(_fit_blocks(size, ranges, approach, part_of, deviations, scanner, known))
    return Lines(*(np.concatenate([getattr(each, name) for each in found]) for name in _FIELDS)), np.maximum(
        part_of, -1
    )


def _fit_blocks(
    size: int,
    ranges: Array,
    approach: Array,
    part_of: NDArray[np.int_],
    deviations: Array,
    scanner: Scanner,
    known: int,
) -> Lines:
    """Lines through blocks of neighbouring rays that are part of none; numbers their rays from ``known`` on.

    approach (R,): speed of the scanner along each ray, m/s.
    """
    blocks = len(ranges) // size
    part = part_of[: blocks * size].reshape(blocks, size)
    chosen = np.flatnonzero((part == -1).sum(axis=1) >= max(_FULL * size, _FEWEST))
    mask = part[chosen] == -1
    r, speed, deviation = (
        array[: blocks * size].reshape(blocks, size)[chosen] for array in (ranges, approach, deviations)
    )
    from_middle = np.arange(size) - (size - 1) / 2
    r = r + speed * scanner.time_increment * from_middle
    angles = scanner.angle_increment * from_middle
    basis = np.stack([np.cos(angles), np.sin(angles)])
    roots = mask / deviation  # of the weights
    slopes = (r * r * roots)[:, None] * basis  # of the range by its inverse
    line = _solve(slopes, r * roots)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(_STEPS):
            fitted = 1.0 / (line @ basis)
            slopes = (-(fitted**2) * roots)[:, None] * basis
            line = line + _solve(slopes, (r - fitted) * roots)
        fitted = 1.0 / (line @ basis)
        misfit = ((roots * (r - fitted)) ** 2).sum(axis=1)
        first, last = mask.argmax(axis=1), size - 1 - mask[:, ::-1].argmax(axis=1)
        rows = np.arange(len(chosen))
        begin, end = (fitted[rows, at][:, None] * basis.T[at] for at in (first, last))
        lengths = np.linalg.norm(end - begin, axis=1)
        freedom = mask.sum(axis=1) - 2
        straight = (misfit < freedom + 3 * np.sqrt(2 * freedom)) & (fitted > 0).all(axis=1) & (lengths < _LONGEST)
        squared = (line**2).sum(axis=1)
        across = np.column_stack([-line[:, 1], line[:, 0]]) / squared[:, None]
        covariances = _inverse(slopes @ np.swapaxes(slopes, 1, 2))
        tilts = np.einsum("mi,mij,mj->m", across, covariances, across)
        straight &= tilts < _TILT**2
    kept = np.flatnonzero(straight)
    part[chosen[kept]] = np.where(mask[kept], known + np.arange(len(kept))[:, None], -2)
    middle = chosen[kept] * size + (size - 1) / 2
    angle = scanner.angle_min + scanner.angle_increment * middle
    return Lines(
        centres=turned((begin[kept] + end[kept]) / 2, angle),
        normals=turned((-line / np.sqrt(squared)[:, None])[kept], angle),
        half_lengths=lengths[kept] / 2,
        rays=mask[kept].sum(axis=1),
        tilt_variances=tilts[kept],
        delays=scanner.time_increment * middle,
    )


def _solve(design: Array, wanted: Array) -> Array:
    """Least squares of every block: design (m, 2, k), wanted (m, k); (m, 2)."""
    right = design @ wanted[:, :, None]
    return (_inverse(design @ np.swapaxes(design, 1, 2)) @ right)[:, :, 0]


def _inverse(matrices: Array) -> Array:
    """Of symmetric matrices (m, 2, 2); infinite where there is none."""
    a, b, c = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
    return np.stack([np.stack([c, -b], axis=1), np.stack([-b, a], axis=1)], axis=1) / (a * c - b * b)[:, None, None]


def turned(vectors: Array, angles: Array | float) -> Array:
    """Vectors (n, 2) turned by angles, rad: (n,) or one."""
    cosine, sine = np.cos(angles), np.sin(angles)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.column_stack([cosine * x - sine * y, sine * x + cosine * y])
