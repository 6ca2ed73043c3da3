"""One scan against the map: its pose, and what the match tells of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omnibench.robot.kinematics import Array
from omnibench.slam.matching.correspondences import Pairs
from omnibench.slam.matching.map import ScanMap
from omnibench.slam.matching.points import ScanPoints
from omnibench.slam.slam_options import SlamOptions

LOST = 0.2  # of the points: when fewer match, the scan tells nothing
_CONVINCING = 0.6  # of the points: when more match, no other pose is looked for
_FEWEST = 30  # points that small_gicp is asked to match
_COARSE = 4  # of so many points one, for the search from afar
_ROUGHLY = 1e-3  # m and rad; how finely that ends
_SINGULAR = 1e-12  # of the largest information
_SUSPECT = 0.02  # of the largest information: what is less is tried out, and so is
_CERTAIN = 0.98  # what is certain to a lesser share than this
_NOTHING = 1e-3  # that is told is not
_TRIED: Array = np.array([0.1, 0.1, 0.05])  # m, m, rad; how far
_MOST = 200  # points that are asked
_FALSE, _TRUE = 0.5, 0.8  # of the rise promised: what is less is no information, what is more is taken as it is


@dataclass(frozen=True, eq=False)
class Match:
    """A pose (3,) at which a scan lies on the map, and the algebra of its least squares about that pose.

    Deviations are (m, m, rad) of the robot's pose, along the axes of the run's frame. gain (3, 3): how far the scan and
    not the start of the search tells the pose. told (3,): the same along each of ``directions`` (3, 3; columns, in
    units of the limits), 0 to 1. weight (3, 3): gain @ information^-1. information (3, 3): of the scan's points.
    by_keyframe {keyframe: (3, 3)}: its parts. scatter (3, 3): covariance of information @ deviation. delayed (3, 3):
    what a twist along the same axes that was not deskewed makes of information @ deviation, s. matched: share of the
    scan's points.
    """

    pose: Array
    gain: Array
    told: Array
    directions: Array
    weight: Array
    information: Array
    by_keyframe: dict[int, Array]
    scatter: Array
    delayed: Array
    matched: float


def search(surroundings: ScanMap, scan: ScanPoints, start: Array, options: SlamOptions) -> Array:
    """The pose (3,) of a scan by small_gicp from a start (3,): near it, and from afar if that is not convincing."""
    if len(scan.points) < _FEWEST or not surroundings.is_usable:
        return start
    near = surroundings.align(scan.points, start, options.match_distance)
    matched = Pairs(surroundings, scan, near).matched
    if matched > _CONVINCING:
        return near
    some = scan.points[:: min(_COARSE, len(scan.points) // _FEWEST)]
    rough = surroundings.align(some, start, options.search_distance, _ROUGHLY)
    far = surroundings.align(scan.points, rough, options.match_distance)
    return far if Pairs(surroundings, scan, far).matched > matched else near


def refine(
    surroundings: ScanMap, scan: ScanPoints, found: Array, start: Array, options: SlamOptions, steps: int = 2
) -> Match:
    """The pose near the one that was found, every point weighted by its noise and outliers left out.

    Along directions that the scan does not tell it is that of ``start`` (3,), at every step: so these do not disturb
    the others. steps: of Gauss-Newton, at least 1.
    """
    limits = options.limits
    pose = found
    for _ in range(steps):
        pairs = Pairs(surroundings, scan, pose)
        information = pairs.information()
        values, directions = np.linalg.eigh(limits[:, None] * information * limits)
        told = _told(pairs, limits[:, None] * directions, values)
        gain = (limits[:, None] * directions) @ (told[:, None] * directions.T) / limits
        tells = values > _SINGULAR * values[-1]
        inverses = np.divide(1.0, values, out=np.zeros(3), where=tells)
        weight = (limits[:, None] * directions) @ ((told * inverses)[:, None] * directions.T) * limits
        pose = start + gain @ (pose - start) - weight @ pairs.gradient()
    return Match(
        pose,
        gain,
        told,
        directions,
        weight,
        information,
        by_keyframe=pairs.by_keyframe(),
        scatter=pairs.scatter(),
        delayed=pairs.delayed(),
        matched=pairs.matched,
    )


def _told(pairs: Pairs, directions: Array, information: Array) -> Array:
    """How far points tell the pose along directions (3, 3; columns) as long as the limits: (3,).

    The share rises so steeply with the information (3,) that, where scans tell the pose, nothing of the start remains.
    """
    if pairs.matched < LOST:
        return np.zeros(3)
    certain = pairs.certain_information(directions)
    squares = np.square(certain)
    told: Array = squares / (1 + squares)
    suspect = (information < _SUSPECT * information[-1]) | (certain < _CERTAIN * information)
    for number in np.flatnonzero(suspect & (told > _NOTHING)):
        told[number] *= _borne_out(pairs, directions[:, number])
    return told


def _borne_out(pairs: Pairs, direction: Array) -> float:
    """How far the information along a direction (3,) is true, 0 to 1, tried out some way along it.

    Straight pieces of a round wall lock with those of the map as if the wall had edges, but only near where they are.
    """
    step = direction / np.max(np.abs(direction) / _TRIED)
    return float(np.clip((pairs.rise(step, _MOST) - _FALSE) / (_TRUE - _FALSE), 0.0, 1.0))
