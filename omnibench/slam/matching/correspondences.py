"""Correspondences of a scan's points with surfaces of the map: the algebra of one step of scan matching."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array
from omnibench.robot.planar import rotation
from omnibench.slam.matching.map import ScanMap
from omnibench.slam.matching.points import ScanPoints

# The study tests/benchmarks/constants_slam.py varies these numbers by 0.5 and 2. In three rooms the median error stays
# between 1.04 and 1.14 mm (1.07 mm as they are) and the median NEES between 2.3 and 2.7 (3 for an honest covariance).
_OUTLIER = 4.0  # standard deviations: a point farther from a surface does not match it
_PARALLEL = 0.9  # least cosine between the normals of a point and of its surface
# Standard deviations of a normal: information that so large an error explains does not count. Without it a large round
# room seems to tell the heading (tests/slam/matching/test_slam_shapes.py).
_FEIGNED = 4.0
_GRAZING = 0.25  # least share of a range's variance across a surface that is seen at a grazing angle


class Correspondences:
    """Points of a scan and their surfaces, as seen from a pose (3,) of the robot.

    Derivatives are with respect to the pose (m, m, rad) along the axes of the run's frame. matched: share of the scan's
    points that have a surface.
    """

    def __init__(self, surroundings: ScanMap, scan: ScanPoints, pose: Array) -> None:
        turn = rotation(pose[2])[:2, :2].T
        # Points that lie on no line mislead at corners and edges.
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
        """Fisher information (3, 3) of the points about the pose."""
        return self._weighted(self._weights, self._slopes)

    def gradient(self) -> Array:
        """Gradient (3,) of the point-to-line cost 1/2 sum w d^2."""
        return self._slopes.T @ (self._weights * self._distances)

    def certain_information(self, directions: Array) -> Array:
        """Information (k,) along directions (3, k; columns) that errors of the map's normals cannot explain."""
        across, along = self._slopes @ directions, self._along @ directions
        explained = _FEIGNED**2 * self._surface.tilt_variances[:, None] * along**2
        certain: Array = self._weights @ np.maximum(across**2 - explained, 0.0)
        return certain

    def rise(self, step: Array, most: int) -> float:
        """Actual rise of the cost when the pose moves by a step (3,), as a share of the rise that the slopes predict.

        At the moved pose the points are matched anew; those without a surface do not count. Both directions of the step
        are added up, so that the pose need not be the minimum. 1 where no rise is predicted. most: points that are
        used, at most.
        """
        chosen = slice(None, None, 1 + len(self._weights) // most)
        seen, weights, limit = self._seen[chosen], self._weights[chosen], _OUTLIER**2
        distances, slopes, normals_seen = self._distances[chosen], self._slopes[chosen], self._seen_normals[chosen]
        rises = predicted = 0.0
        for moved in (step, -step):
            turn = rotation(moved[2])[:2, :2].T
            points = self._pose[:2] + moved[:2] + seen @ turn
            index, apart = self._surroundings.nearest(points)
            surface = self._surroundings.surface
            normals, away = surface.normals[index], points - surface.centres[index]
            across = (normals * away).sum(axis=1)
            alike = (normals * (normals_seen @ turn)).sum(axis=1) > _PARALLEL
            there = alike & (apart**2 - across**2 < self._surroundings.spacing**2)
            before = (weights * distances**2)[there]
            rises += float((np.minimum(weights * across**2, limit)[there] - before).sum())
            predicted += float((np.minimum(weights * (distances + slopes @ moved) ** 2, limit)[there] - before).sum())
        return rises / predicted if predicted > 0 else 1.0

    def scatter(self) -> Array:
        """Covariance (3, 3) of the gradient from the noise of this scan and of the map's lines."""
        if not len(self._weights):
            return np.zeros((3, 3))
        # Points on one line share its error, which falls with the number of rays that the line was fitted to.
        _, line = np.unique(self._surface.line, return_inverse=True)
        shared = np.bincount(line)[line] / self._surface.rays
        return self._weighted(self._weights * (1 + shared), self._slopes)

    def delayed(self) -> Array:
        """Derivative (3, 3) of the gradient with respect to a twist within the scan that was not deskewed, s."""
        return self._weighted(self._weights * self._delays, self._slopes)

    def by_keyframe(self) -> dict[int, Array]:
        """Parts (3, 3) of the information, by the keyframe that saw the surface."""
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
