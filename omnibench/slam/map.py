"""The growing map: points on the lines of scans, each with the line's normal, for small_gicp to match against.

small_gicp estimates normals from neighbouring points. On a planar cloud it finds the vertical, and its plane ICP
returns the start. So each point of the map is given to it as an upright cross of five points a millimetre apart: these
are its own five nearest neighbours, and their normal is the line's.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import small_gicp
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array, rotation

# rad: a line with a larger standard deviation of its direction is dropped. With half of it and with twice, SLAM's
# median error in three rooms is 1.15 and 1.03 mm in the place of 1.07 mm (tests/studies/constants_slam.py).
_TILT = 0.05


@dataclass(frozen=True, eq=False)
class Lines:
    """Line segments.

    centres (m, 2): m. normals (m, 2): unit vectors towards the scanner. half_lengths (m,): m. rays (m,): number of rays
    that were fitted. tilt_variances (m,): variances of the normals' directions, rad^2. delays (m,): times since the
    scan's stamp, s.
    """

    centres: Array
    normals: Array
    half_lengths: Array
    rays: NDArray[np.int_]
    tilt_variances: Array
    delays: Array


def fit_lines(
    points: Array, deviations: Array, delays: Array, rays: NDArray[np.intp]
) -> tuple[Lines, NDArray[np.int_]]:
    """Line segments, and for each point (n,) the index of the segment that it is part of, or -1.

    points (n, 2): from the scanner, m. deviations (n,): standard deviations of their ranges, m. delays (n,): since the
    scan's stamp, s. rays (n,): their numbers in the scan.
    """
    from omnibench.slam.line_growth import grow_lines  # numba takes half a second to load

    ranges = np.hypot(points[:, 0], points[:, 1])
    directions = points / ranges[:, None]
    part_of = np.empty(len(points), dtype=np.int64)
    cosines, sines = np.ascontiguousarray(directions.T)
    grown = grow_lines(ranges, cosines, sines, np.ascontiguousarray(deviations), rays.astype(np.int64), part_of)
    line, first, last = grown[:, :2], grown[:, 5].astype(int), grown[:, 6].astype(int)
    squared = (line**2).sum(axis=1)
    tilts = (
        line[:, 1] ** 2 * grown[:, 2] - 2 * line[:, 0] * line[:, 1] * grown[:, 3] + line[:, 0] ** 2 * grown[:, 4]
    ) / squared**2
    kept = np.flatnonzero(tilts < _TILT**2)
    ends = [directions[at] / (line * directions[at]).sum(axis=1)[:, None] for at in (first, last)]
    lines = Lines(
        centres=((ends[0] + ends[1]) / 2)[kept],
        normals=(-line / np.sqrt(squared)[:, None])[kept],
        half_lengths=np.linalg.norm(ends[1] - ends[0], axis=1)[kept] / 2,
        rays=np.bincount(part_of[part_of >= 0], minlength=len(line))[kept],
        tilt_variances=tilts[kept],
        delays=((delays[first] + delays[last]) / 2)[kept],
    )
    number = np.full(len(line) + 1, -1)  # the last one is for points that are part of no line
    number[kept] = np.arange(len(kept))
    return lines, number[part_of]


# The study tests/studies/constants_slam.py varies these numbers by 0.5 and 2. In three rooms SLAM's median error
# stays between 0.95 and 1.09 mm (1.07 mm as they are) and the median NEES between 2.2 and 2.6.
_CROSS = 1e-3  # m between the points of a cross
_FEWEST = 20  # points that a map needs to be matched against
_WORTH = 5  # new points that are worth rebuilding the search tree
_SAME_SIDE = 0.7  # least cosine between normals that may be of one surface: 45 degrees
_FINEST = 1e-5  # m and rad: small_gicp's search ends with a step shorter than this
_ITERATIONS = 20  # iterations of small_gicp, at most


@dataclass(frozen=True, eq=False)
class Surface:
    """Points of the map.

    centres (m, 2): m. normals (m, 2): unit vectors towards the scanner that saw them. line (m,): number of the line
    that a point is part of. rays (m,): number of rays that the line was fitted to. tilt_variances (m,): variances
    of the normals' directions, rad^2. keyframe (m,): number of the keyframe that saw it.
    """

    centres: Array
    normals: Array
    line: NDArray[np.int_]
    rays: NDArray[np.int_]
    tilt_variances: Array
    keyframe: NDArray[np.int_]

    def at(self, index: NDArray[np.int_]) -> Surface:
        """Some of the points, in the order of ``index``."""
        return Surface(*(getattr(self, name)[index] for name in _FIELDS))


_FIELDS = tuple(field.name for field in fields(Surface))


class ScanMap:
    """Surfaces in the run's frame. Later scans add what is new and change nothing that is there.

    spacing: between the points of a surface, m.
    """

    def __init__(self, spacing: float) -> None:
        self.spacing = spacing
        self.surface = Surface(
            np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0, int)
        )
        self._lines = 0

    def __len__(self) -> int:
        return len(self.surface.centres)

    @property
    def is_usable(self) -> bool:
        """True if there are enough points to match against."""
        return len(self) >= _FEWEST

    def add(self, lines: Lines, pose: Array, keyframe: int) -> int:
        """Add the new part of a scan's lines, seen from a pose (3,), if it is large enough; return how many points."""
        counts = np.maximum(1, np.ceil(2 * lines.half_lengths / self.spacing).astype(int))
        line = np.repeat(np.arange(len(counts)), counts)
        place = np.arange(len(line)) - np.repeat(np.cumsum(counts) - counts, counts)
        along = ((2 * place + 1) / counts[line] - 1) * lines.half_lengths[line]
        tangents = np.column_stack([-lines.normals[:, 1], lines.normals[:, 0]])[line]
        turn = rotation(pose[2])[:2, :2].T
        seen = Surface(
            centres=pose[:2] + (lines.centres[line] + along[:, None] * tangents) @ turn,
            normals=lines.normals[line] @ turn,
            line=self._lines + line,
            rays=lines.rays[line],
            tilt_variances=lines.tilt_variances[line],
            keyframe=np.full(len(line), keyframe),
        )
        new = np.ones(len(seen.centres), dtype=bool)
        if len(self) and len(new):
            near, distance = self.nearest(seen.centres)
            alike = (self.surface.normals[near] * seen.normals).sum(axis=1) > _SAME_SIDE
            new = (distance > self.spacing) | (~alike & (distance > self.spacing / 4))
        if new.sum() < _WORTH:
            return 0
        self._lines += len(lines.rays)
        fresh = seen.at(np.flatnonzero(new))
        self.surface = Surface(
            *(np.concatenate([getattr(self.surface, name), getattr(fresh, name)]) for name in _FIELDS)
        )
        centres, normals = self.surface.centres, self.surface.normals
        crosses = np.zeros((len(centres), 5, 3))
        crosses[:, :, :2] = centres[:, None]
        step = _CROSS * np.column_stack([-normals[:, 1], normals[:, 0]])
        crosses[:, 1, :2] += step
        crosses[:, 2, :2] -= step
        crosses[:, 3, 2], crosses[:, 4, 2] = _CROSS, -_CROSS
        self._cloud = small_gicp.PointCloud(crosses.reshape(-1, 3))
        self._tree = small_gicp.KdTree(self._cloud)
        small_gicp.estimate_normals(self._cloud, self._tree, 5)
        return int(new.sum())

    def merge_oldest(self) -> None:
        """Assign what keyframe 0 saw to keyframe 1, and count keyframes from there."""
        keyframes = np.maximum(self.surface.keyframe - 1, 0)
        self.surface = replace(self.surface, keyframe=keyframes)

    def nearest(self, points: Array) -> tuple[NDArray[np.int_], Array]:
        """Index (n,) and distance (n,), m, of the map's point nearest to each of the points (n, 2)."""
        if not len(points):
            return np.zeros(0, dtype=int), np.zeros(0)
        indices, squared = self._tree.batch_knn_search(_upright(points), 1)
        return (indices[:, 0] // 5).astype(int), np.sqrt(squared[:, 0])

    def align(self, points: Array, start: Array, distance: float, finest: float = _FINEST) -> Array:
        """The pose (3,) at which points (n, 2) lie best on the map, by small_gicp's plane ICP, from a start (3,).

        distance: m; a point farther than that from the map is not matched.
        """
        guess = np.eye(4)
        guess[:2, :2] = rotation(start[2])[:2, :2]
        guess[:2, 3] = start[:2]
        result = small_gicp.align(
            self._cloud,
            small_gicp.PointCloud(_upright(points)),
            self._tree,
            guess,
            registration_type="PLANE_ICP",
            max_correspondence_distance=distance,
            max_iterations=_ITERATIONS,
            rotation_epsilon=finest,
            translation_epsilon=finest,
        )
        transform = result.T_target_source
        turned = np.arctan2(transform[1, 0], transform[0, 0]) - start[2]
        heading = start[2] + turned - 2 * np.pi * np.round(turned / (2 * np.pi))
        return np.array([transform[0, 3], transform[1, 3], heading])


def _upright(points: Array) -> Array:
    return np.column_stack([points, np.zeros(len(points))])
