"""Matching of one scan against the growing map: its pose, and how well the scan determines it.

The map has points on the lines of scans, each with the line's normal, for small_gicp to match against. small_gicp
estimates normals from neighbouring points. On a planar cloud it finds the vertical, and its plane ICP returns the
start. So each point of the map is given to it as an upright cross of five points a millimetre apart: these are its own
five nearest neighbours, and their normal is the line's.

One step is linear in the correspondences of the scan's points with surfaces of the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import small_gicp
from numpy.typing import NDArray

from omnibench.data.scans import Ranges, Scanner
from omnibench.robot.kinematics import Array, rotated, rotation
from omnibench.slam.motion_prior import MotionWithinScan
from omnibench.slam.slam_options import SlamOptions

# rad: a line with a larger standard deviation of its direction is dropped. With half of it and with twice, SLAM's
# median error in three rooms is 1.15 and 1.03 mm in the place of 1.07 mm (tests/studies/constants_slam.py).
_TILT = 0.05


class Lines(NamedTuple):
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
    grown = grow_lines(np.column_stack([ranges, directions, deviations]), rays.astype(np.int64), part_of)
    line, first, last = grown[:, :2], grown[:, 5].astype(int), grown[:, 6].astype(int)
    squared = (line**2).sum(axis=1)
    tilts = (
        line[:, 1] ** 2 * grown[:, 2] - 2 * line[:, 0] * line[:, 1] * grown[:, 3] + line[:, 0] ** 2 * grown[:, 4]
    ) / squared**2
    one, other = (directions[at] / (line * directions[at]).sum(axis=1)[:, None] for at in (first, last))
    half_lengths, normals = np.linalg.norm(other - one, axis=1) / 2, -line / np.sqrt(squared)[:, None]
    counts = np.bincount(part_of[part_of >= 0], minlength=len(line))
    kept = tilts < _TILT**2
    every = Lines((one + other) / 2, normals, half_lengths, counts, tilts, (delays[first] + delays[last]) / 2)
    number = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)  # the last one is for points of no line
    return Lines._make(values[kept] for values in every), number[part_of]


# The study tests/studies/constants_slam.py varies these numbers by 0.5 and 2. In three rooms SLAM's median error
# stays between 0.95 and 1.09 mm (1.07 mm as they are) and the median NEES between 2.2 and 2.6.
_CROSS = 1e-3  # m between the points of a cross
_FEWEST_IN_MAP = 20  # points that a map needs to be matched against
_WORTH = 5  # new points that are worth rebuilding the search tree
_SAME_SIDE = 0.7  # least cosine between normals that may be of one surface: 45 degrees
_FINEST = 1e-5  # m and rad: small_gicp's search ends with a step shorter than this
_ITERATIONS = 20  # iterations of small_gicp, at most


class Surface(NamedTuple):
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
        return Surface._make(values[index] for values in self)


class ScanMap:
    """Surfaces in the run's frame. Later scans add what is new and change nothing that is there.

    spacing: between the points of a surface, m.
    """

    def __init__(self, spacing: float) -> None:
        self.spacing, self._lines, none = spacing, 0, np.zeros(0, int)
        self.surface = Surface(np.zeros((0, 2)), np.zeros((0, 2)), none, none, np.zeros(0), none)

    def __len__(self) -> int:
        return len(self.surface.centres)

    @property
    def is_usable(self) -> bool:
        """True if there are enough points to match against."""
        return len(self) >= _FEWEST_IN_MAP

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
        fresh = zip(self.surface, seen.at(np.flatnonzero(new)), strict=True)
        self.surface = Surface._make(np.concatenate(pair) for pair in fresh)
        centres, normals = _upright(self.surface.centres), self.surface.normals
        along_it, up = _CROSS * _upright(np.column_stack([-normals[:, 1], normals[:, 0]])), np.array([0, 0, _CROSS])
        arms = [centres, centres + along_it, centres - along_it, centres + up, centres - up]
        crosses = np.stack(arms, axis=1)
        self._cloud = small_gicp.PointCloud(crosses.reshape(-1, 3))
        self._tree = small_gicp.KdTree(self._cloud)
        small_gicp.estimate_normals(self._cloud, self._tree, 5)
        return int(new.sum())

    def merge_oldest(self) -> None:
        """Assign what keyframe 0 saw to keyframe 1, and count keyframes from there."""
        self.surface = self.surface._replace(keyframe=np.maximum(self.surface.keyframe - 1, 0))

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


class ScanPoints(NamedTuple):
    """Points and lines of a deskewed scan, in the robot's frame at the scan's stamp.

    points (n, 2): m. rays (n, 2): unit vectors from the scanner to the points. delays (n,): since the scan's stamp, s.
    deviations (n,): standard deviations of the ranges, m. lines: fitted to neighbouring points. line (n,): index of the
    line that a point is part of, or -1.
    """

    points: Array
    rays: Array
    delays: Array
    deviations: Array
    lines: Lines
    line: NDArray[np.int_]

    def deskewed(self, twist: Array) -> ScanPoints:
        """The scan, deskewed by a further twist (3,) in the robot's frame, m/s, m/s, rad/s."""
        lines, motions, line_motions = self.lines, self.delays[:, None] * twist, self.lines.delays[:, None] * twist
        centres, normals = _moved(lines.centres, line_motions), rotated(lines.normals, line_motions[:, 2])
        lines = lines._replace(centres=centres, normals=normals)
        return self._replace(points=_moved(self.points, motions), rays=rotated(self.rays, motions[:, 2]), lines=lines)


def scan_points(ranges: Ranges, scanner: Scanner, noise_factor: float, within: MotionWithinScan) -> ScanPoints:
    """Points and lines of a scan (R,), over the floor; rays of a tilted scanner that end on the floor are left out.

    noise_factor: ratio of the ranges' noise to that of the scanner's description. within: motion during the scan.
    """
    returned = np.flatnonzero(scanner.valid(ranges) & ~scanner.on_floor(ranges))
    shares, delays = scanner.level_shares[returned], scanner.delays[returned]
    distances = ranges[returned].astype(float) * shares
    deviations = noise_factor * scanner.deviations(ranges[returned]) * shares
    angles = scanner.bearings[returned]
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    mount = np.array([scanner.mount.x, scanner.mount.y])
    motions = within.at(delays)
    points = _moved(mount + distances[:, None] * directions, motions)
    lines, line = fit_lines(points - mount, deviations, delays, returned)
    lines = lines._replace(centres=lines.centres + mount)
    return ScanPoints(points, rotated(directions, motions[:, 2]), delays, deviations, lines, line)


def noise_factor(ranges: Ranges, scanner: Scanner) -> float:
    """Ratio, at least 1, of the noise of ranges (S, R) to that of the scanner's description.

    Estimated by the median of second differences of neighbouring ranges, which are noise nearly everywhere but at
    edges.
    """
    with np.errstate(invalid="ignore"):
        second_differences = ranges[:, 2:] - 2.0 * ranges[:, 1:-1] + ranges[:, :-2]
    valid = scanner.valid(ranges)
    whole = valid[:, 2:] & valid[:, 1:-1] & valid[:, :-2]
    if not whole.any():
        return 1.0
    expected = np.sqrt(6) * scanner.deviations(ranges[:, 1:-1][whole])
    return max(1.0, float(np.median(np.abs(second_differences[whole]) / expected)) / 0.6745)


def _moved(points: Array, motions: Array) -> Array:
    """Points (n, 2) that were seen after motions (n, 3), in the frame from before the motions."""
    half = motions[:, 2] / 2
    return rotated(points, motions[:, 2]) + np.sinc(half / np.pi)[:, None] * rotated(motions[:, :2], half)


# The study tests/studies/constants_slam.py varies these numbers by 0.5 and 2. In three rooms the median error stays
# between 1.04 and 1.14 mm (1.07 mm as they are) and the median NEES between 2.3 and 2.7 (3 for an honest covariance).
_OUTLIER = 4.0  # standard deviations: a point farther from a surface does not match it
_PARALLEL = 0.9  # least cosine between the normals of a point and of its surface
# Standard deviations of a normal: information that so large an error explains does not count. Without it a large round
# room seems to tell the heading (tests/slam/matching/test_slam_matching.py).
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
        return _weighted(self._weights, self._slopes)

    def gradient(self) -> Array:
        """Gradient (3,) of the point-to-line cost 1/2 sum w d^2."""
        return self._slopes.T @ (self._weights * self._distances)

    def certain_information(self, directions: Array) -> Array:
        """Information (k,) along directions (3, k; columns) that errors of the map's normals cannot explain."""
        across, along = self._slopes @ directions, self._along @ directions
        explained = _FEIGNED**2 * self._surface.tilt_variances[:, None] * along**2
        return self._weights @ np.maximum(across**2 - explained, 0.0)

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
        return _weighted(self._weights * (1 + shared), self._slopes)

    def delayed(self) -> Array:
        """Derivative (3, 3) of the gradient with respect to a twist within the scan that was not deskewed, s."""
        return _weighted(self._weights * self._delays, self._slopes)

    def by_keyframe(self) -> dict[int, Array]:
        """Parts (3, 3) of the information, by the keyframe that saw the surface."""
        parts = {int(keyframe): self._surface.keyframe == keyframe for keyframe in np.unique(self._surface.keyframe)}
        return {keyframe: _weighted(self._weights[part], self._slopes[part]) for keyframe, part in parts.items()}


def _weighted(weights: Array, slopes: Array) -> Array:
    return (weights[:, None] * slopes).T @ slopes


def _slopes(directions: Array, seen: Array) -> Array:
    """Derivatives (n, 3) of the points' offsets along directions (n, 2) with respect to the pose."""
    return np.column_stack([directions, directions[:, 1] * seen[:, 0] - directions[:, 0] * seen[:, 1]])


# The study tests/studies/constants_slam.py varies these numbers by 0.5 and 2. In three rooms poses change by a
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
    by_keyframe, scatter, late = pairs.by_keyframe(), pairs.scatter(), pairs.delayed()
    return Match(pose, gain, observability, directions, weight, information, by_keyframe, scatter, late, pairs.matched)


def _observability(pairs: Correspondences, directions: Array, information: Array) -> Array:
    """Observability (3,), 0 to 1, of the pose along directions (3, 3; columns) as long as the limits.

    It is I^2 / (1 + I^2) of the certain information I, so steep that nothing of the start remains where a scan
    determines the pose.
    """
    if pairs.matched < LOST:
        return np.zeros(3)
    certain = pairs.certain_information(directions)
    observability: Array = np.square(certain) / (1 + np.square(certain))
    suspect = (information < _SUSPECT * information[-1]) | (certain < _CERTAIN * information)
    for number in np.flatnonzero(suspect & (observability > _NOTHING)):
        # The share that a move of the scan confirms: the straight pieces fitted to a round wall lock with those of the
        # map as if the wall had edges, but only close to where they are.
        step = directions[:, number] / np.max(np.abs(directions[:, number]) / _TESTED)
        observability[number] *= np.clip((pairs.rise(step, _MOST) - _FALSE) / (_TRUE - _FALSE), 0.0, 1.0)
    return observability
