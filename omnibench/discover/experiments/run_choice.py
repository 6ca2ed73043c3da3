"""Choice of the runs that tell competing effects apart in the least time.

Runs of one command after another are added, each time those that raise the mean margins of all pairs most for their
seconds, until every name would be sure; then runs that turned out to be dispensable are taken away, and commands are
exchanged for others that take less time. What results is a local optimum.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.discover.experiments.separation import Prospect, Separation
from omnibench.robot.kinematics import Array

Counts = NDArray[np.intp]
LONGEST = 3600.0  # s of an experiment: nobody drives longer to settle a name (chosen)
_SURE = 0.95  # chance that the right name is sure; two standard deviations give 0.977, uncertain sizes take from it
_BATCHES = (2, 4, 8)  # runs of a command that are added at once, each command twice at least: their scatter shows
_PREPARING = 30.0  # s by which a further command must shorten the driving: it has to be prepared, too (chosen)
_ROUNDS = 3  # of exchanges: the third changes nothing in omni3
_KEPT = 15  # best commands of each pair of effects: of the others none is chosen in omni3 or the studies' flower


@dataclass(frozen=True, eq=False)
class Choice:
    """Chosen runs.

    counts (C,): of each candidate. chance: that the right name is sure. chance_recorded: the same after as long of the
    recorded commands. sure (m, m): pairs that are told apart.
    """

    counts: Counts
    chance: float
    chance_recorded: float
    sure: NDArray[np.bool_]


def choose_runs(separation: Separation, information: Array, seconds: Array, recorded: float) -> Choice:
    """The cheapest runs that tell all members apart, or as many pairs of them as can be told.

    information (C, p, p): of one run of each candidate. seconds (C,): that it takes. recorded: s that a recorded run
    takes.
    """
    kept = _promising(separation, information, seconds)
    problem = _Problem(separation, information[kept], seconds[kept])
    counts = problem.greedy()
    sure = problem.sure(problem.prospect(counts))
    counts = problem.pruned(counts, sure)
    for _ in range(_ROUNDS):
        counts = problem.exchanged(counts, sure)
    every = np.zeros(len(seconds), dtype=np.intp)
    every[kept] = counts
    as_many = float(every @ seconds) / recorded
    again = separation.prospect(as_many * separation.recorded_mean)
    return Choice(every, problem.prospect(counts).chance(sure), again.chance(sure), sure)


def _promising(separation: Separation, information: Array, seconds: Array) -> NDArray[np.intp]:
    """Indices of the candidates that alone raise the margin of some pair most for their seconds."""
    few = _BATCHES[1]
    gains = separation.prospect(few * information).mean_margins - separation.prospect(0 * information[:1]).mean_margins
    per_second = (gains / seconds[:, None, None]).reshape(len(seconds), -1)
    best = np.argsort(-per_second, axis=0)[:_KEPT]
    return np.unique(best[:, per_second.max(axis=0) > 0])


class _Problem:
    """Candidates with their information (C, p, p) and seconds (C,)."""

    def __init__(self, separation: Separation, information: Array, seconds: Array) -> None:
        self._separation, self._information, self._seconds = separation, information, seconds

    def prospect(self, counts: Counts) -> Prospect:
        """The prospect after counts (..., C) runs."""
        return self._separation.prospect(np.tensordot(counts, self._information, 1))

    def cost(self, counts: Counts) -> Array:
        """Seconds (...) of counts (..., C) runs, with preparing their commands."""
        of_each: Array = counts @ self._seconds + _PREPARING * (counts > 0).sum(axis=-1)
        return of_each

    def sure(self, prospect: Prospect) -> NDArray[np.bool_]:
        """Pairs (..., m, m) that are told apart whichever of the two is right."""
        chances = prospect.chances
        both: NDArray[np.bool_] = np.minimum(chances, np.swapaxes(chances, -1, -2)) >= _SURE
        return both

    def greedy(self) -> Counts:
        """Counts with runs added until all pairs are told apart, no run helps, or the time is over."""
        counts: Counts = np.zeros(len(self._seconds), dtype=np.intp)
        for _ in range(int(LONGEST)):
            now = self.prospect(counts)
            if self.sure(now).all():
                break
            larger = self._with_more(counts)
            taken = self.cost(larger) - self.cost(counts)
            inside = larger @ self._seconds <= LONGEST
            gains = (self.prospect(larger).mean_margins - now.mean_margins).sum(axis=(-2, -1)) / taken
            gains[~inside] = 0
            best = int(gains.argmax())
            if gains[best] * LONGEST < 0.5:
                break
            counts = larger[best]
        return counts

    def _with_more(self, counts: Counts) -> Counts:
        """Counts (n, C) with a batch of runs more of one candidate."""
        each = np.eye(len(counts), dtype=np.intp)
        return np.concatenate([counts + batch * each for batch in _BATCHES])

    def pruned(self, counts: Counts, wanted: NDArray[np.bool_]) -> Counts:
        """Counts without the runs that the wanted pairs can do without, the longest first."""
        while True:
            fewer = np.array(list(self._with_fewer(counts)), dtype=np.intp).reshape(-1, len(counts))
            if not len(fewer):
                return counts
            enough = (self.sure(self.prospect(fewer)) | ~wanted).all(axis=(-2, -1))
            if not enough.any():
                return counts
            counts = fewer[np.where(enough, self.cost(fewer), np.inf).argmin()]

    def _with_fewer(self, counts: Counts) -> Iterator[Counts]:
        for index in np.flatnonzero(counts):
            for left in (0, counts[index] - 1):
                if left == 0 or left >= _BATCHES[0]:
                    fewer = counts.copy()
                    fewer[index] = left
                    yield fewer

    def exchanged(self, counts: Counts, wanted: NDArray[np.bool_]) -> Counts:
        """Counts with each command exchanged for runs of another one where that takes less time."""
        each = np.eye(len(counts), dtype=np.intp)
        for index in np.flatnonzero(counts):
            without = counts.copy()
            without[index] = 0
            most = counts[index] + 3
            others = np.concatenate([without + number * each for number in range(1, most)])
            often_enough = ((others == 0) | (others >= _BATCHES[0])).all(axis=1)
            others = others[often_enough & (self.cost(others) < self.cost(counts) - 1)]
            if not len(others):
                continue
            enough = (self.sure(self.prospect(others)) | ~wanted).all(axis=(-2, -1))
            if enough.any():
                counts = others[np.where(enough, self.cost(others), np.inf).argmin()]
        return counts
