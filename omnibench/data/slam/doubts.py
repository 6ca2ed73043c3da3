"""What makes poses of SLAM doubtful, in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.data.slam.matching import LOST, Match

_UNTOLD = 0.5  # share of a direction that scans tell: when it is less,
_OFTEN = 0.1  # in more than this share of the scans, it is said


@dataclass(frozen=True)
class Doubt:
    """A problem of one run or of several. along: the square of a direction's x + iy in the run's frame, if it has one.

    A direction and its opposite are the same; their squares are, too, and can be added up.
    """

    problem: str
    along: complex | None = None

    def __str__(self) -> str:
        if self.along is None:
            return self.problem
        degrees = round(float(np.degrees(np.angle(self.along)) / 2)) % 180
        return f"{self.problem} along {degrees} deg of the run's frame"


def doubts_of(matches: Sequence[Match]) -> tuple[Doubt, ...]:
    """What is doubtful of a run."""
    return tuple(_doubts(matches))


def together(doubts: Sequence[Doubt]) -> Doubt:
    """The same problem of several runs, along their mean direction."""
    directions = [doubt.along for doubt in doubts if doubt.along is not None]
    return Doubt(doubts[0].problem, sum(directions) if directions else None)


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
