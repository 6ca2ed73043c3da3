"""The growing map: points on the lines of scans, each with the line's normal, for small_gicp to match against.

small_gicp estimates normals from neighbouring points, and on a planar cloud finds the vertical: its plane ICP then
returns where it began. So each point of the map is given to it as an upright cross of five points a millimetre apart,
whose five nearest neighbours are itself and whose normal so is the line's.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import small_gicp
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array
from omnibench.slam.matching.lines import Lines

_CROSS = 1e-3  # m
_FEWEST = 20  # points, without which nothing is matched
_WORTH = 5  # new points, for which a map is made anew
_SAME_SIDE = 0.7  # cosine between normals of what may be the same surface
_FINEST = 1e-5  # m and rad; small_gicp's search ends with a step shorter than this
_ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class Surface:
    """Points of the map. centres (m, 2), m. normals (m, 2): unit, towards where they were seen from.

    line (m,): which line each is part of. rays (m,): that the line was fitted to. tilt_variances (m,), rad^2.
    keyframe (m,): which keyframe saw it.
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
    """Where surfaces were seen, in the run's frame. What is there stays; later scans add what is new.

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
        """Whether there is enough to match against."""
        return len(self) >= _FEWEST

    def add(self, lines: Lines, pose: Array, keyframe: int) -> int:
        """Add what is new of a scan's lines, seen from a pose (3,), if that is worth it; how many points that were."""
        seen = self._sampled(lines, pose, keyframe)
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
        self._rebuild()
        return int(new.sum())

    def merge_oldest(self) -> None:
        """What keyframe 0 saw counts as seen by the next; all others are one less."""
        keyframes = np.maximum(self.surface.keyframe - 1, 0)
        self.surface = replace(self.surface, keyframe=keyframes)

    def nearest(self, points: Array) -> tuple[NDArray[np.int_], Array]:
        """For points (n, 2) the nearest of the map: index (n,) and distance (n,), m."""
        if not len(points):
            return np.zeros(0, dtype=int), np.zeros(0)
        found, squared = self._tree.batch_knn_search(_upright(points), 1)
        return (found[:, 0] // 5).astype(int), np.sqrt(squared[:, 0])

    def align(self, points: Array, start: Array, distance: float, finest: float = _FINEST) -> Array:
        """The pose (3,) at which points (n, 2) lie best on the map, by small_gicp's plane ICP, from a start (3,).

        distance: m; a point farther than that from the map is not matched.
        """
        cosine, sine = np.cos(start[2]), np.sin(start[2])
        guess = np.eye(4)
        guess[:2, :2] = [[cosine, -sine], [sine, cosine]]
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
        found = result.T_target_source
        turned = np.arctan2(found[1, 0], found[0, 0]) - start[2]
        heading = start[2] + turned - 2 * np.pi * np.round(turned / (2 * np.pi))
        return np.array([found[0, 3], found[1, 3], heading])

    def _sampled(self, lines: Lines, pose: Array, keyframe: int) -> Surface:
        counts = np.maximum(1, np.ceil(2 * lines.half_lengths / self.spacing).astype(int))
        line = np.repeat(np.arange(len(counts)), counts)
        place = np.arange(len(line)) - np.repeat(np.cumsum(counts) - counts, counts)
        along = ((2 * place + 1) / counts[line] - 1) * lines.half_lengths[line]
        tangents = np.column_stack([-lines.normals[:, 1], lines.normals[:, 0]])[line]
        cosine, sine = np.cos(pose[2]), np.sin(pose[2])
        turn = np.array([[cosine, sine], [-sine, cosine]])
        return Surface(
            centres=pose[:2] + (lines.centres[line] + along[:, None] * tangents) @ turn,
            normals=lines.normals[line] @ turn,
            line=self._lines + line,
            rays=lines.rays[line],
            tilt_variances=lines.tilt_variances[line],
            keyframe=np.full(len(line), keyframe),
        )

    def _rebuild(self) -> None:
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


def _upright(points: Array) -> Array:
    return np.column_stack([points, np.zeros(len(points))])
