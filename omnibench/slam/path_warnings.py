"""Warnings about the path that SLAM found for a run: lost scans, degenerate scans, disagreement with the odometry."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from omnibench.robot.kinematics import Array, relative
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
