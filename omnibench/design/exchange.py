"""Exact designs: how often to drive each of some candidate runs, by an exchange of runs against a criterion.

A run of candidate c gives Fisher information F_c (p, p) of some parameters. n_c runs of each candidate give

    M = sum_c n_c F_c.                                                   (O1)

Runs are added where the merit of a design rises most for its cost; then runs of one candidate are exchanged for runs of
another until no exchange raises the design's score (Fedorov, Theory of Optimal Experiments, 1972). What results is a
local optimum. Criteria are D-optimality (d_optimality.py) and the margins of names (discover/experiments.py).
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array

Counts = NDArray[np.intp]

# Smallest gain of a score that counts. Smaller ones are rounding, and exchanging runs for them may never end.
_NO_GAIN = 1e-6
_BLOCK = 256  # designs that are tried at once


class Criterion(ABC):
    """A criterion by which designs (C,), numbers of runs of each candidate, are compared.

    information (C, p, p): of one run of each candidate. costs (C,): of one run of each, > 0. An exchange takes runs of
    a candidate away and adds runs of another; it is a row of four numbers: the one, how many, the other, how many.
    """

    def __init__(self, information: Array, costs: Array) -> None:
        self.information, self.costs = information, costs

    def __len__(self) -> int:
        return len(self.costs)

    def sum(self, counts: Array | Counts) -> Array:
        """The information M (p, p) of counts (C,) of runs, Eq. (O1)."""
        return np.tensordot(counts, self.information, 1)

    def sum_after(self, moment: Array, exchanges: Counts) -> Array:
        """The information (n, p, p) after exchanges (n, 4) in a design of information (p, p)."""
        removed, fewer, added, more = exchanges.T
        without = moment - fewer[:, None, None] * self.information[removed]
        return without + more[:, None, None] * self.information[added]

    def cost(self, counts: Array | Counts) -> Array:
        """The total costs (...) of counts (..., C) of runs."""
        return np.asarray(counts @ self.costs)

    @abstractmethod
    def merit(self, information: Array) -> Array:
        """Merit (n,) of information (n, p, p), for the sake of which runs are added."""

    @abstractmethod
    def score(self, information: Array, costs: Array) -> Array:
        """Score (n,) of designs by their information (n, p, p) and costs (n,), which exchanges raise."""

    @abstractmethod
    def additions(self, counts: Counts) -> tuple[Counts, Array]:
        """Exchanges (n, 4) that add runs to a design and are allowed, and the costs (n,) of what they lead to."""

    @abstractmethod
    def exchanges(self, counts: Counts) -> tuple[Counts, Array, Array]:
        """Exchanges (n, 4) in a design that are allowed, costs (n,), and upper limits (n,) on the scores after them."""


def after(counts: Counts, exchanges: Counts) -> Counts:
    """The designs (n, C) to which exchanges (n, 4) lead from one (C,)."""
    designs, rows = np.tile(counts, (len(exchanges), 1)), np.arange(len(exchanges))
    removed, fewer, added, more = exchanges.T
    designs[rows, removed] -= fewer
    designs[rows, added] += more
    return designs


def grown(criterion: Criterion, counts: Counts, least: float = 0.0) -> Counts | None:
    """The design with more runs of the candidate that raises the merit most for its cost.

    least: gain per cost that is worth it; None where there is no more.
    """
    moment, best = criterion.sum(counts), None
    merit = criterion.merit(moment[None])[0]
    additions, costs = criterion.additions(counts)
    costs = costs - criterion.cost(counts)
    for first in range(0, len(additions), _BLOCK):
        block = slice(first, first + _BLOCK)
        gains = (criterion.merit(criterion.sum_after(moment, additions[block])) - merit) / costs[block]
        if gains.max() > least:
            best, least = additions[block][gains.argmax()], gains.max()
    return None if best is None else after(counts, best[None])[0]


def exchanged(criterion: Criterion, counts: Counts, enough: float = np.inf) -> Counts:
    """The design after exchanges, until none would raise its score any more or the score is enough.

    The exchanges with the highest limits are tried first, and of each block the best one is made.
    """
    while True:
        moment = criterion.sum(counts)
        score = criterion.score(moment[None], criterion.cost(counts)[None])[0]
        if score >= enough:
            return counts
        exchanges, costs, limits = criterion.exchanges(counts)
        gaining = np.flatnonzero(limits > score + _NO_GAIN)
        order = gaining[np.argsort(-limits[gaining], kind="stable")]
        for first in range(0, len(order), _BLOCK):
            block = order[first : first + _BLOCK]
            scores = criterion.score(criterion.sum_after(moment, exchanges[block]), costs[block])
            if scores.max() > score + _NO_GAIN:
                counts = after(counts, exchanges[block[scores.argmax()]][None])[0]
                break
        else:
            return counts
