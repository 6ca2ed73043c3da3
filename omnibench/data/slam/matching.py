"""One scan against the map: its pose, and what the match tells of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.data.slam.map import ScanMap
from omnibench.data.slam.options import SlamOptions
from omnibench.data.slam.points import ScanPoints
from omnibench.robot.kinematics import Array

_COARSE = 4  # of so many points one, until the pose is roughly known
_FEWEST = 30  # points that small_gicp is asked to match
_ROUGHLY = 1e-3  # m and rad
LOST = 0.2  # of the points: when fewer match, the scan tells nothing
_OUTLIER = 4.0  # standard deviations
_PARALLEL = 0.9  # least cosine between normals of one surface
_FEIGNED = 4.0  # standard deviations of a normal that may be no more than its error
_GRAZING = 0.25  # least share of a range's variance that counts across a surface


@dataclass(frozen=True, eq=False)
class Match:
    """A pose (3,) at which a scan lies on the map, and the algebra of its least squares about that pose.

    Deviations are (m, m, rad) of the robot's pose, along the axes of the run's frame. gain (3, 3): how far the scan and
    not the start of the search tells the pose. told (3,): the same along each of ``directions`` (3, 3; columns, in
    units of the limits), 0 to 1. information (3, 3): of the scan's points. by_keyframe {keyframe: (3, 3)}: its parts.
    scatter (3, 3): covariance of information @ deviation. matched: share of the scan's points.
    """

    pose: Array
    gain: Array
    told: Array
    directions: Array
    information: Array
    by_keyframe: dict[int, Array]
    scatter: Array
    matched: float


def search(surroundings: ScanMap, scan: ScanPoints, start: Array, options: SlamOptions) -> Array:
    """The pose (3,) of a scan by small_gicp, first with few points from afar, then with all."""
    if len(scan.points) < _FEWEST or not len(surroundings):
        return start
    coarse = scan.points[:: min(_COARSE, len(scan.points) // _FEWEST)]
    rough = surroundings.align(coarse, start, options.search_distance, _ROUGHLY)
    return surroundings.align(scan.points, rough, options.match_distance)


def refine(
    surroundings: ScanMap, scan: ScanPoints, found: Array, start: Array, options: SlamOptions, steps: int = 2
) -> Match:
    """The pose near the one that was found, every point weighted by its noise and outliers left out.

    Along directions that the scan does not tell it is that of ``start`` (3,), at every step: so these do not disturb
    the others. steps: of Gauss-Newton.
    """
    limits = np.array([options.constrained_position, options.constrained_position, options.constrained_heading])
    pose = found
    for _ in range(steps):
        pairs = _Pairs(surroundings, scan, pose, options.spacing)
        information = pairs.information()
        told, directions = _told(pairs, information, limits)
        gain = (limits[:, None] * directions) @ (told[:, None] * directions.T) / limits
        better = pose - np.linalg.pinv(information, hermitian=True) @ pairs.gradient()
        pose = start + gain @ (better - start)
    by_keyframe, scatter = pairs.by_keyframe(), pairs.scatter()
    return Match(pose, gain, told, directions, information, by_keyframe, scatter, pairs.matched)


def _told(pairs: _Pairs, information: Array, limits: Array) -> tuple[Array, Array]:
    """How far points tell the pose: shares (3,) along directions (3, 3; columns) in units of the limits.

    The share rises so steeply with the information that, where scans tell the pose, nothing of the start remains.
    """
    if pairs.matched < LOST:
        return np.zeros(3), np.eye(3)
    _, directions = np.linalg.eigh(limits[:, None] * information * limits)
    squares = np.square(pairs.certain_information(limits[:, None] * directions))
    return squares / (1 + squares), directions


class _Pairs:
    """Points of a scan and the surfaces of the map that they lie on, at a pose."""

    def __init__(self, surroundings: ScanMap, scan: ScanPoints, pose: Array, spacing: float) -> None:
        cosine, sine = np.cos(pose[2]), np.sin(pose[2])
        turn = np.array([[cosine, sine], [-sine, cosine]])
        straight = np.flatnonzero((scan.line >= 0) & (len(surroundings) > 0))  # what is not straight misleads at corners and edges
        seen = scan.points[straight] @ turn  # from the robot, along the axes of the run's frame
        index, _ = surroundings.nearest(pose[:2] + seen)
        surface = surroundings.surface.at(index)
        rays = scan.rays[straight] @ turn
        tangents = np.column_stack([-surface.normals[:, 1], surface.normals[:, 0]])
        away = pose[:2] + seen - surface.centres
        distances = (surface.normals * away).sum(axis=1)
        facing = -(surface.normals * rays).sum(axis=1)
        variances = scan.deviations[straight] ** 2 * np.maximum(facing**2, _GRAZING)
        near = np.abs((tangents * away).sum(axis=1)) < spacing
        alike = (surface.normals * (scan.lines.normals @ turn)[scan.line[straight]]).sum(axis=1) > _PARALLEL
        kept = np.flatnonzero(near & alike & (facing > 0) & (np.abs(distances) < _OUTLIER * np.sqrt(variances)))
        self._points = len(scan.points)
        self._surface = surface.at(kept)
        self._distances, self._weights = distances[kept], 1 / variances[kept]
        self._slopes = _slopes(self._surface.normals, seen[kept])
        _, self._line = np.unique(self._surface.line, return_inverse=True)
        self._along = _slopes(tangents[kept], seen[kept])

    def information(self) -> Array:
        return self._slopes.T @ (self._weights[:, None] * self._slopes)

    def gradient(self) -> Array:
        return self._slopes.T @ (self._weights * self._distances)

    @property
    def matched(self) -> float:
        """Share of the scan's points."""
        return len(self._weights) / self._points

    def scatter(self) -> Array:
        """The covariance of the gradient: noise of this scan and of the map's lines."""
        # Points on one line share its error, which is that of so many rays.
        shared = np.bincount(self._line)[self._line] / self._surface.rays if len(self._line) else 0.0
        return self._slopes.T @ ((self._weights * (1 + shared))[:, None] * self._slopes)

    def certain_information(self, directions: Array) -> Array:
        """Information along directions (3, k; columns) that errors of the map's normals cannot feign: (k,)."""
        moved, feigned = self._slopes @ directions, self._along @ directions
        doubtful = _FEIGNED**2 * self._surface.tilt_variances[:, None] * feigned**2
        certain: Array = self._weights @ np.maximum(moved**2 - doubtful, 0.0)
        return certain

    def by_keyframe(self) -> dict[int, Array]:
        keyframes = self._surface.keyframe
        parts = {}
        for keyframe in np.unique(keyframes):
            chosen: NDArray[np.bool_] = keyframes == keyframe
            slopes = self._slopes[chosen]
            parts[int(keyframe)] = slopes.T @ (self._weights[chosen, None] * slopes)
        return parts


def _slopes(directions: Array, seen: Array) -> Array:
    """Derivatives (n, 3) of the points' offsets along directions (n, 2) with respect to the pose."""
    return np.column_stack([directions, directions[:, 1] * seen[:, 0] - directions[:, 0] * seen[:, 1]])
