"""What makes poses of SLAM doubtful, in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from omnibench.robot.kinematics import Array
from omnibench.robot.planar import relative
from omnibench.slam.matching.scan_matching import LOST, Match
from omnibench.slam.motion_prior import length
from omnibench.slam.slam_options import SlamOptions

_UNTOLD = 0.5  # share of a direction that scans tell: when it is less,
_OFTEN = 0.1  # in more than this share of the scans, it is said
_BEYOND = 5.0  # times the odometry's error, which it may be wrong by
_NOISE = 0.01  # m; the same of poses, from scan to scan
_MOST_SHARE = 10.0  # that is told; odometry may even stand still
_FEWEST = 3  # motions that are judged


@dataclass(frozen=True)
class Doubt:
    """A problem of one run or of several. along: the square of a direction's x + iy in the run's frame, if it has one.

    A direction and its opposite are the same; their squares are, too, and can be added up. share: how large it is, if
    that is told; its place in the problem is {share}.
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


def doubts_of(matches: Sequence[Match], options: SlamOptions, odometry: Array | None) -> tuple[Doubt, ...]:
    """What is doubtful of a run. odometry (S, 3): poses at the stamps of its scans, if it has any."""
    return (*_doubts(matches), *([] if odometry is None else _disagreement(matches, options, odometry)))


def together(doubts: Sequence[Doubt]) -> Doubt:
    """The same problem of several runs, along their mean direction, as large as in the mean."""
    directions = [doubt.along for doubt in doubts if doubt.along is not None]
    shares = [doubt.share for doubt in doubts if doubt.share is not None]
    return Doubt(
        doubts[0].problem, sum(directions) if directions else None, sum(shares) / len(shares) if shares else None
    )


def _doubts(matches: Sequence[Match]) -> Iterator[Doubt]:
    if any(match.matched < LOST for match in matches):
        yield Doubt("less than a fifth of a scan lies on the map, and its pose is the start of the search")
    untold = [match for match in matches if match.matched >= LOST and match.told.min() < _UNTOLD]
    if len(untold) <= _OFTEN * len(matches):
        return
    worst = np.array([match.directions[:, match.told.argmin()] for match in untold])
    x, y, heading = worst.T
    if (np.abs(heading) > np.hypot(x, y)).mean() > 0.5:
        yield Doubt("scans tell too little of the heading")
    else:
        yield Doubt("scans tell too little", complex(((x + 1j * y) ** 2).sum()))


def _disagreement(matches: Sequence[Match], options: SlamOptions, odometry: Array) -> Iterator[Doubt]:
    """Motions from scan to scan, in the robot's frame, so that an early error does not count again later."""
    motions = [
        (relative(*ours), relative(*theirs))
        for ours, theirs, told in zip(
            pairwise(match.pose for match in matches),
            pairwise(odometry),
            pairwise(match.matched >= LOST and match.told.min() >= _UNTOLD for match in matches),
            strict=True,
        )
        if all(told) or options.start == "odometry"  # else what is not told is no motion
    ]
    if len(motions) < _FEWEST:
        return
    apart = _typical([ours - theirs for ours, theirs in motions])
    driven = _typical([theirs for _, theirs in motions])
    if apart > _BEYOND * options.odometry_error * driven + _NOISE:
        yield Doubt(
            "poses and odometry disagree by {share} of the motion: is the scanner mirrored, or is its mount or the "
            "robot's wheels given wrongly?",
            share=min(apart / max(driven, _NOISE / _MOST_SHARE), _MOST_SHARE),
        )


def _typical(motions: Sequence[Array]) -> float:
    """Root mean square length of motions (3,), m."""
    return float(np.sqrt(np.mean([length(motion) ** 2 for motion in motions])))
