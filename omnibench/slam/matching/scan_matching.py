"""Matching of one scan against the map: its pose, and how well the scan determines it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omnibench.robot.kinematics import Array
from omnibench.slam.matching.correspondences import Correspondences
from omnibench.slam.matching.map import ScanMap
from omnibench.slam.matching.points import ScanPoints
from omnibench.slam.slam_options import SlamOptions

# The study tests/benchmarks/constants_slam.py varies these numbers by 0.5 and 2. In three rooms poses change by a
# hundredth of their deviations at most. Where scans mislead (round rooms, a quick robot, a mirrored scanner) they stay
# the same but for three: with LOST = 0.1 a scan at a wrong pose counts (NEES 5.2 for 3.6); _CONVINCING = 0.3 moves a
# quick robot by 0.7 deviations; and with _FALSE = 1 or _TRUE = 0.4, which exclude each other, a round room seems to
# tell the heading.
LOST = 0.2  # share of matched points below which a scan does not count as matched
_CONVINCING = 0.6  # share of matched points above which no other pose is searched for
_FEWEST = 30  # points that a scan needs for small_gicp to match it
_COARSE = 4  # every fourth point takes part in the search from afar
_ROUGHLY = 1e-3  # m and rad: smallest step of the search from afar
_SINGULAR = 1e-12  # share of the largest information below which a direction has none: rounding
# A direction of little information is tested by moving the scan along it:
_SUSPECT = 0.02  # share of the largest information below which a direction is tested,
_CERTAIN = 0.98  # or share of its information that errors of the map's normals cannot explain;
_NOTHING = 1e-3  # observability below which it is not worth a test
_TESTED: Array = np.array([0.1, 0.1, 0.05])  # m, m, rad; largest parts of the move with which a direction is tested
_MOST = 200  # points that are moved
_FALSE, _TRUE = 0.5, 0.8  # actual by predicted rise: below the first no information is left, above the second all


@dataclass(frozen=True, eq=False)
class Match:
    """A pose (3,) at which a scan lies on the map, and the algebra of its least squares about that pose.

    Deviations of the pose are (m, m, rad) along the axes of the run's frame. gain (3, 3): share of the pose that comes
    from the scan, the rest comes from the start of the search. observability (3,): this share along each of
    ``directions`` (3, 3; columns, in units of the limits), 0 to 1. information (3, 3): Fisher information of the scan's
    points about the pose. weight (3, 3): gain @ information^-1. by_keyframe {keyframe: (3, 3)}: the information's parts
    by the keyframe that saw the surface. scatter (3, 3): covariance of the gradient. delayed (3, 3): change of the
    gradient with a twist along the same axes that was not deskewed, s. matched: share of the scan's points that lie on
    the map.
    """

    pose: Array
    gain: Array
    observability: Array
    directions: Array
    weight: Array
    information: Array
    by_keyframe: dict[int, Array]
    scatter: Array
    delayed: Array
    matched: float


def search(surroundings: ScanMap, scan: ScanPoints, start: Array, options: SlamOptions) -> Array:
    """The pose (3,) of a scan by small_gicp, from a start (3,); searched from farther away if too few points match."""
    if len(scan.points) < _FEWEST or not surroundings.is_usable:
        return start
    near = surroundings.align(scan.points, start, options.match_distance)
    matched = Correspondences(surroundings, scan, near).matched
    if matched > _CONVINCING:
        return near
    some = scan.points[:: min(_COARSE, len(scan.points) // _FEWEST)]
    rough = surroundings.align(some, start, options.search_distance, _ROUGHLY)
    far = surroundings.align(scan.points, rough, options.match_distance)
    return far if Correspondences(surroundings, scan, far).matched > matched else near


def refine(
    surroundings: ScanMap, scan: ScanPoints, pose: Array, start: Array, options: SlamOptions, steps: int = 2
) -> Match:
    """Improve a pose (3,) by weighted Gauss-Newton without outliers.

    Along directions that the scan does not determine, the pose is that of ``start`` (3,) at every step, so that these
    do not disturb the others. steps: of Gauss-Newton, at least 1.
    """
    limits = options.limits
    for _ in range(steps):
        pairs = Correspondences(surroundings, scan, pose)
        information = pairs.information()
        values, directions = np.linalg.eigh(limits[:, None] * information * limits)
        observability = _observability(pairs, limits[:, None] * directions, values)
        gain = (limits[:, None] * directions) @ (observability[:, None] * directions.T) / limits
        informative = values > _SINGULAR * values[-1]
        inverses = np.divide(1.0, values, out=np.zeros(3), where=informative)
        weight = (limits[:, None] * directions) @ ((observability * inverses)[:, None] * directions.T) * limits
        pose = start + gain @ (pose - start) - weight @ pairs.gradient()
    return Match(
        pose,
        gain,
        observability,
        directions,
        weight,
        information,
        by_keyframe=pairs.by_keyframe(),
        scatter=pairs.scatter(),
        delayed=pairs.delayed(),
        matched=pairs.matched,
    )


def _observability(pairs: Correspondences, directions: Array, information: Array) -> Array:
    """Observability (3,), 0 to 1, of the pose along directions (3, 3; columns) as long as the limits.

    It is I^2 / (1 + I^2) of the certain information I, so steep that nothing of the start remains where a scan
    determines the pose.
    """
    if pairs.matched < LOST:
        return np.zeros(3)
    certain = pairs.certain_information(directions)
    squares = np.square(certain)
    observability: Array = squares / (1 + squares)
    suspect = (information < _SUSPECT * information[-1]) | (certain < _CERTAIN * information)
    for number in np.flatnonzero(suspect & (observability > _NOTHING)):
        observability[number] *= _confirmed_share(pairs, directions[:, number])
    return observability


def _confirmed_share(pairs: Correspondences, direction: Array) -> float:
    """Share of the information along a direction (3,), 0 to 1, that a move of the scan along it confirms.

    The straight pieces fitted to a round wall lock with those of the map as if the wall had edges, but only close to
    where they are.
    """
    step = direction / np.max(np.abs(direction) / _TESTED)
    return float(np.clip((pairs.rise(step, _MOST) - _FALSE) / (_TRUE - _FALSE), 0.0, 1.0))
