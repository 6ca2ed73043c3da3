"""Points of a scan and the surfaces of the map that they lie on: the algebra of one step of scan matching."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array
from omnibench.slam.matching.map import ScanMap
from omnibench.slam.matching.points import ScanPoints

_OUTLIER = 4.0  # standard deviations
_PARALLEL = 0.9  # least cosine between normals of one surface
_FEIGNED = 4.0  # standard deviations of a normal that may be no more than its error
_GRAZING = 0.25  # least share of a range's variance that counts across a surface


class Correspondences:
    """Correspondences at a pose (3,) of the robot, whose deviations are (m, m, rad) along the axes of the run's frame.

    matched: share of the scan's points that have a surface.
    """

    def __init__(self, surroundings: ScanMap, scan: ScanPoints, pose: Array) -> None:
        cosine, sine = np.cos(pose[2]), np.sin(pose[2])
        turn = np.array([[cosine, sine], [-sine, cosine]])
        # What is not straight misleads at corners and edges.
        straight = np.flatnonzero((scan.line >= 0) & surroundings.is_usable)
        seen = scan.points[straight] @ turn  # from the robot, along the axes of the run's frame
        index, _ = surroundings.nearest(pose[:2] + seen)
        normals = surroundings.surface.normals[index]
        tangents = np.column_stack([-normals[:, 1], normals[:, 0]])
        away = pose[:2] + seen - surroundings.surface.centres[index]
        distances, aside = (normals * away).sum(axis=1), (tangents * away).sum(axis=1)
        facing = -(normals * (scan.rays[straight] @ turn)).sum(axis=1)
        variances = scan.deviations[straight] ** 2 * np.maximum(facing**2, _GRAZING)
        normals_seen = (scan.lines.normals @ turn)[scan.line[straight]]
        alike = (normals * normals_seen).sum(axis=1) > _PARALLEL
        on = (np.abs(aside) < surroundings.spacing) & (np.abs(distances) < _OUTLIER * np.sqrt(variances))
        kept = np.flatnonzero(on & alike & (facing > 0))
        self.matched = len(kept) / len(scan.points)
        self._surface = surroundings.surface.at(index[kept])
        self._distances, self._weights = distances[kept], 1 / variances[kept]
        self._slopes = _slopes(normals[kept], seen[kept])
        self._along = _slopes(tangents[kept], seen[kept])
        self._delays = scan.delays[straight[kept]]
        self._surroundings, self._pose, self._seen = surroundings, pose, seen[kept]
        self._seen_normals = normals_seen[kept]

    def information(self) -> Array:
        """Of the points about the pose, (3, 3)."""
        return self._weighted(self._weights, self._slopes)

    def gradient(self) -> Array:
        """Of half the weighted squares of the points' distances from their surfaces, (3,)."""
        return self._slopes.T @ (self._weights * self._distances)

    def certain_information(self, directions: Array) -> Array:
        """Information along directions (3, k; columns) that errors of the map's normals cannot feign: (k,)."""
        moved, feigned = self._slopes @ directions, self._along @ directions
        doubtful = _FEIGNED**2 * self._surface.tilt_variances[:, None] * feigned**2
        certain: Array = self._weights @ np.maximum(moved**2 - doubtful, 0.0)
        return certain

    def rise(self, step: Array, most: int) -> float:
        """How far the squares of distances rise if the pose moves by a step (3,), as a share of what slopes promise.

        There the points find their surfaces anew; those that find none do not count. The mean of both ways, so that it
        does not matter whether the pose is the best. 1 where nothing rises. most: points that are asked, at most.
        """
        some = slice(None, None, 1 + len(self._weights) // most)
        seen, weights, limit = self._seen[some], self._weights[some], _OUTLIER**2
        distances, slopes, normals_seen = self._distances[some], self._slopes[some], self._seen_normals[some]
        rises = promised = 0.0
        for moved in (step, -step):
            cosine, sine = np.cos(moved[2]), np.sin(moved[2])
            turn = np.array([[cosine, sine], [-sine, cosine]])
            points = self._pose[:2] + moved[:2] + seen @ turn
            index, apart = self._surroundings.nearest(points)
            surface = self._surroundings.surface
            normals, away = surface.normals[index], points - surface.centres[index]
            across = (normals * away).sum(axis=1)
            alike = (normals * (normals_seen @ turn)).sum(axis=1) > _PARALLEL
            there = alike & (apart**2 - across**2 < self._surroundings.spacing**2)
            before = (weights * distances**2)[there]
            rises += float((np.minimum(weights * across**2, limit)[there] - before).sum())
            promised += float((np.minimum(weights * (distances + slopes @ moved) ** 2, limit)[there] - before).sum())
        return rises / promised if promised > 0 else 1.0

    def scatter(self) -> Array:
        """Covariance of the gradient (3, 3): noise of this scan and of the map's lines."""
        if not len(self._weights):
            return np.zeros((3, 3))
        # Points on one line share its error, which is that of so many rays.
        _, line = np.unique(self._surface.line, return_inverse=True)
        shared = np.bincount(line)[line] / self._surface.rays
        return self._weighted(self._weights * (1 + shared), self._slopes)

    def delayed(self) -> Array:
        """What a twist along the same axes that was not deskewed makes of the gradient, (3, 3), s."""
        return self._weighted(self._weights * self._delays, self._slopes)

    def by_keyframe(self) -> dict[int, Array]:
        """Parts of the information by the keyframe that saw the surface."""
        parts = {}
        for keyframe in np.unique(self._surface.keyframe):
            chosen: NDArray[np.bool_] = self._surface.keyframe == keyframe
            parts[int(keyframe)] = self._weighted(self._weights[chosen], self._slopes[chosen])
        return parts

    @staticmethod
    def _weighted(weights: Array, slopes: Array) -> Array:
        product: Array = (weights[:, None] * slopes).T @ slopes
        return product


def _slopes(directions: Array, seen: Array) -> Array:
    """Derivatives (n, 3) of the points' offsets along directions (n, 2) with respect to the pose."""
    return np.column_stack([directions, directions[:, 1] * seen[:, 0] - directions[:, 0] * seen[:, 1]])
