"""Covariance of the poses of SLAM and of the map that they made: a Schmidt-Kalman (consider) filter.

A consider filter counts errors that it does not correct, with their correlations (Schmidt, Application of state-space
methods to navigation problems, Adv. Control Systems 3:293, 1966; Jazwinski, Stochastic Processes and Filtering Theory,
1970, section 8.4; Woodbury and Junkins, On the consider Kalman filter, AIAA 2010-7752). Here these are

    x = (mu, xi_0, ..., xi_m, xi)   with the covariance P,                                        (P1)

mu the error of the motion in units of its standard deviation, the same in the whole run, xi_j that of keyframe j and xi
that of the last pose. Each xi is a small motion of the whole run's frame (m, m, rad), which moves a pose p by

    dp = D(p) xi,   D(p) = [1 0 -y; 0 1 x; 0 0 1].                                                (P2)

The search for the next pose starts where the motion since the last pose p', with standard deviations s along the
robot's axes T(p'), leads. Errors of the motion act at its beginning:

    d_start = D(p) xi + D(p) D(p')^-1 T(p') diag(s) mu.                                           (P3)

The scan moves the pose from there by the gain G towards the pose of least squares, p = start + G (p* - start). With
I_j the part of the information I that lies on surfaces of keyframe j, n the noise of the gradient (covariance S) and K
its derivative by a twist within the scan, whose standard deviations are k along the robot's axes,

    d_p* = I^-1 (sum_j I_j D(p) xi_j + n + K T(p) diag(k) nu),   cov(nu) = 1                      (P4)
    d_p  = (1 - G) d_start + W sum_j I_j D(p) xi_j + W (n + K T(p) diag(k) nu),   W = G I^-1.     (P5)

The first two terms are R x, so that the covariance of the pose, and that with all other errors, is

    cov(d_p) = R P R' + W S W' + (W K T diag(k)) (W K T diag(k))'                                 (P6)
    cov(d_p, x) = R P,   xi = D(p)^-1 d_p.                                                        (P7)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from omnibench.robot.kinematics import Array, relative, rotation
from omnibench.slam.motion_prior import length
from omnibench.slam.scan_matching import LOST, Match
from omnibench.slam.slam_options import SlamOptions

# The study tests/studies/constants_slam.py varies these numbers by 0.5 and 2. In three rooms, in round ones, with a
# quick robot and with a mirrored scanner the warnings stay the same, except that _DEGENERATE = 1 warns always and
# _BEYOND = 10 misses the mirrored scanner.
_DEGENERATE = 0.5  # observability below which a direction counts as not measured by a scan
_OFTEN = 0.1  # share of a run's scans that may be degenerate without a warning
_BEYOND = 5.0  # times the odometry's stated error: a larger disagreement is no error of calibration
_NOISE = 0.01  # m: noise of the motion between two poses of SLAM, at most
_MOST_SHARE = 10.0  # largest disagreement that is reported: the odometry may even stand still
_FEWEST = 3  # motions that are needed for a judgement


@dataclass(frozen=True)
class PathWarning:
    """A problem of one run, or of several.

    along: its direction, if it has one, as the square of x + iy in the run's frame: a direction and its opposite have
    the same square, so that squares of several runs can be added up. share: size of the problem, if it has one; it is
    put where the problem's text has {share}.
    """

    problem: str
    along: complex | None = None
    share: float | None = None

    def __str__(self) -> str:
        if self.share is not None:
            return self.problem.format(share=f"{100 * self.share:.0f} %")
        if self.along is None:
            return self.problem
        degrees = round(float(np.degrees(np.angle(self.along)) / 2)) % 180
        return f"{self.problem} along {degrees} deg of the run's frame"


def path_warnings(matches: Sequence[Match], options: SlamOptions, odometry: Array | None) -> tuple[PathWarning, ...]:
    """Warnings about a run. odometry (S, 3): poses at the stamps of its scans, if it has any."""
    return (*_weak_matches(matches), *([] if odometry is None else _disagreement(matches, options, odometry)))


def merged_warning(warnings: Sequence[PathWarning]) -> PathWarning:
    """One warning for several runs with one problem: along their mean direction, with the mean of their shares."""
    directions = [warning.along for warning in warnings if warning.along is not None]
    shares = [warning.share for warning in warnings if warning.share is not None]
    return PathWarning(
        warnings[0].problem, sum(directions) if directions else None, sum(shares) / len(shares) if shares else None
    )


def _weak_matches(matches: Sequence[Match]) -> Iterator[PathWarning]:
    if any(match.matched < LOST for match in matches):
        yield PathWarning("less than a fifth of a scan lies on the map, and its pose is the start of the search")
    degenerate = [match for match in matches if match.matched >= LOST and match.observability.min() < _DEGENERATE]
    if len(degenerate) <= _OFTEN * len(matches):
        return
    worst = np.array([match.directions[:, match.observability.argmin()] for match in degenerate])
    x, y, heading = worst.T
    if (np.abs(heading) > np.hypot(x, y)).mean() > 0.5:
        yield PathWarning("scans tell too little of the heading")
    else:
        yield PathWarning("scans tell too little", complex(((x + 1j * y) ** 2).sum()))


def _disagreement(matches: Sequence[Match], options: SlamOptions, odometry: Array) -> Iterator[PathWarning]:
    """Compare motions from scan to scan in the robot's frame, so that an early error does not count again later."""
    motions = [
        (relative(*ours), relative(*theirs))
        for ours, theirs, measured in zip(
            pairwise(match.pose for match in matches),
            pairwise(odometry),
            pairwise(match.matched >= LOST and match.observability.min() >= _DEGENERATE for match in matches),
            strict=True,
        )
        if all(measured) or options.start == "odometry"  # else a direction that is not measured shows no motion
    ]
    if len(motions) < _FEWEST:
        return
    apart = _typical([ours - theirs for ours, theirs in motions])
    driven = _typical([theirs for _, theirs in motions])
    if apart > _BEYOND * options.odometry_error * driven + _NOISE:
        yield PathWarning(
            "poses and odometry disagree by {share} of the motion: is the scanner mirrored, or is its mount or the "
            "robot's wheels given wrongly?",
            share=min(apart / max(driven, _NOISE / _MOST_SHARE), _MOST_SHARE),
        )


def _typical(motions: Sequence[Array]) -> float:
    """Root mean square length of motions (3,), m."""
    return float(np.sqrt(np.mean([length(motion) ** 2 for motion in motions])))


# m^2, m^2, rad^2: least covariance that is stated, for a start pose that is exact by definition. A hundredth of the
# variances that poses of SLAM have (tests/studies/slam_study.py), so that a covariance can be inverted. Half of it
# and twice change stated deviations by 3 % at most (tests/studies/constants_slam.py).
FLOOR: Array = np.diag([1e-4, 1e-4, 1e-5]) ** 2


class PoseErrors:
    """The joint covariance of the motion's error, of every keyframe and of the last pose.

    start (3,): the first pose. moved (3,): standard deviations of the motion until then, in the robot's frame, m, m,
    rad; default: the first pose is exact.
    """

    def __init__(self, start: Array, moved: Array | None = None) -> None:
        # Errors of the motion, of every keyframe and of the last pose, three rows each. The motion's error, in units of
        # its standard deviation, is the same in the whole run.
        self._joint = np.zeros((6, 6))
        self._joint[:3, :3] = np.eye(3)
        self._pose = start
        if moved is not None:
            row = np.linalg.solve(_deviation(start), rotation(start[2]) * moved)  # Eq. (P2): xi = D^-1 T diag(s) mu
            self._joint[-3:, :3], self._joint[:3, -3:] = row, row.T
            self._joint[-3:, -3:] = _square(row)

    def step(self, match: Match, moved: Array, skew: Array) -> Array:
        """Go on to the pose of a match, and return its covariance (3, 3).

        moved (3,): standard deviations of the motion from the last pose to the start, in the robot's frame, m, m, rad.
        skew (3,): standard deviations of the twist within the scan, m/s, m/s, rad/s.
        """
        before, here = _deviation(self._pose), _deviation(match.pose)
        rest = np.eye(3) - match.gain
        row = np.zeros((3, len(self._joint)))  # R of Eq. (P5)
        row[:, :3] = rest @ here @ np.linalg.solve(before, rotation(self._pose[2]) * moved)  # Eq. (P3)
        row[:, -3:] = rest @ here
        for keyframe, part in match.by_keyframe.items():
            row[:, 3 + 3 * keyframe : 6 + 3 * keyframe] += match.weight @ part @ here
        noise = match.weight @ match.scatter @ match.weight.T + _square(
            match.weight @ match.delayed @ (rotation(match.pose[2]) * skew)
        )
        covariance = row @ self._joint @ row.T + noise  # Eq. (P6)
        back = np.linalg.inv(here)  # Eq. (P7)
        across = back @ row @ self._joint[:, :-3]
        self._joint[-3:, :-3], self._joint[:-3, -3:] = across, across.T
        self._joint[-3:, -3:] = back @ covariance @ back.T
        self._pose = match.pose
        return covariance + FLOOR

    @property
    def covariance(self) -> Array:
        """Covariance of the last pose (3, 3)."""
        here = _deviation(self._pose)
        return here @ self._joint[-3:, -3:] @ here.T + FLOOR

    @property
    def keyframes(self) -> int:
        """Number of keyframes."""
        return len(self._joint) // 3 - 2

    def keep(self, skewed: Array | None = None) -> None:
        """Make the last pose a keyframe.

        skewed (3,): standard deviations of the shift of what its scan saw, along the robot's axes, m, m, rad; default:
        none.
        """
        size = len(self._joint)
        every = np.concatenate([np.arange(size), np.arange(size - 3, size)])
        self._joint = self._joint[np.ix_(every, every)]
        if skewed is not None:
            kept = slice(size - 3, size)
            self._joint[kept, kept] += _square(
                np.linalg.solve(_deviation(self._pose), rotation(self._pose[2]) * skewed)
            )

    def merge_oldest(self) -> None:
        """Remove keyframe 0; the next one, whose error is larger, stands for it."""
        others = np.delete(np.arange(len(self._joint)), [3, 4, 5])
        self._joint = self._joint[np.ix_(others, others)]


def _square(matrix: Array) -> Array:
    return matrix @ matrix.T


def _deviation(pose: Array) -> Array:
    """Derivative (3, 3) of a pose with respect to a small motion of the run's frame."""
    return np.array([[1.0, 0.0, -pose[1]], [0.0, 1.0, pose[0]], [0.0, 0.0, 1.0]])
