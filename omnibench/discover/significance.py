"""Significance of chi-square differences by groups of columns, corrected for the number of groups that were tried.

A group is the slopes of the poses by all parameters of an effect, or by all functions of a basis.

Where nothing is missing, the residuals of a run are as likely as their opposites, whatever their distribution and
however they are correlated within the run. Flipping the signs of whole runs at random therefore gives the distribution
of the largest chi-square difference by chance (Westfall and Young, Resampling-based multiple testing, 1993). Groups
that are plainly significant are taken out of the residuals before, so that they do not count as noise.

With Q the chi-square difference of a group of d columns, v the mean of Q / d under the flips (at least 1) and t the
number of groups of its kind, of which the best is taken, the evidence of the group by itself is

    z = -log10 P(chi2(d) > Q / v) - log10 t,    at least 0,                                                        (1)

and the evidence of flip b is the largest of all groups, m_b = max z. The evidence of what was observed is the z of the
least Q that a group has without any one run, as one run that went wrong is no effect; flips keep all runs, so that the
chance is stated too large rather than too small. Of B flips, the chance p of an evidence z is

    p = (1 + number of m_b >= z) / (B + 1)                                                                         (2)

(Davison and Hinkley, Bootstrap methods and their application, 1997, Eq. 4.11) for groups of one family; for several it
is so many times as large (Bonferroni). Where hardly any flip reaches z, an exponential tail is fitted to the k largest
m_b (Knijnenburg et al., "Fewer permutations, more accurate P-values", Bioinformatics 25, 2009, with shape 0): z of a
single group is -log10 of a uniform number, and so exponential itself. With m_(k) the least of these k, above which
k - 1 lie, by maximum likelihood:

    p = k / B exp(-(z - m_(k)) / s),    s = sum of m_b - m_(k) over the k largest / (k - 1).                        (3)

How much the group that stands out most explains beyond chance, in standard deviations of a chi-square, is

    surplus = max over groups of w - mean over flips of their max of w,    w = (Q - d v) / (v sqrt(2 d)).          (4)

Bayes factor. Let the residuals of all runs, whitened, be X b + e with e ~ N(0, I), where X are the d columns of a group
and Q the chi-square difference that they make. With Zellner's g-prior b ~ N(0, g (X'X)^-1) the Bayes factor of the
group against nothing is

    B(g) = (1 + g)^(-d/2) exp(Q g / (1 + g) / 2),                                                                  (5)

largest at g = Q / d - 1, where 2 ln B is the conditional maximum likelihood criterion of George and Foster
("Calibration and empirical Bayes variable selection", Biometrika 87, 2000):

    2 ln B = Q - d (1 + max(ln(Q / d), 0)).                                                                        (6)

Below Q = d, where no g raises (5) above 1, (6) is negative, as their criterion is: to explain little costs.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from io import BufferedRandom
from itertools import accumulate, pairwise
from typing import Literal, overload

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from omnibench.discover.covariates import Basis
from omnibench.fit.trajectory_fit import Given, Whitened, given
from omnibench.robot.effects.effect import Effect, Forms, Parameter
from omnibench.robot.kinematics import Array

Kind = Literal["matrix", "effect", "covariate"]


@dataclass(frozen=True, eq=False)
class Group:
    """Columns that belong together; ``index`` says which of all columns they are.

    A group of an effect has its linear parameters in the columns' order, the values of its shapes, and the number of
    shapes that are tried; ``forms`` are the columns of the parameters by which its form can differ from the textbook's,
    ``family`` these parameters. A group of a generic basis has ``basis``.
    """

    kind: Kind
    name: str
    index: tuple[int, ...]
    effect: Effect | None = None
    parameters: tuple[Parameter, ...] = ()
    shapes: Mapping[str, float] = field(default_factory=dict)
    tries: int = 1
    forms: tuple[int, ...] = ()
    family: Forms | None = None
    basis: Basis | None = None


def best_shapes(groups: Sequence[Group], chi_square: Sequence[float]) -> list[int]:
    """Indices of the groups with the largest chi-square difference, one a name, in the order of the names."""
    best: dict[str, int] = {}
    for index, group in enumerate(groups):
        if chi_square[index] > chi_square[best.setdefault(group.name, index)]:
            best[group.name] = index
    return list(best.values())


_IN_MEMORY = 64_000_000  # bytes; what is beyond goes to a temporary file (chosen: two stores are open at a time)


@dataclass(frozen=True, eq=False)
class _Block:
    """Some of the runs. edges: of their rows. values: their rows, None if these are in the file, from ``offset`` on."""

    edges: tuple[int, ...]
    shape: tuple[int, ...]
    values: NDArray[np.float32] | None
    offset: int


class ColumnStore(Sequence[Array]):
    """Columns (K, ..., p) of each run, rounded to 32 bits; runs are read one after another, in the order of storing."""

    def __init__(self) -> None:
        self._blocks: list[_Block] = []
        self._file: BufferedRandom | None = None
        self._held = self._written = 0  # bytes

    def append(self, columns: Array, counts: Sequence[int]) -> None:
        """Add the columns (rows, ..., p) of some runs, of which each has so many of the rows."""
        values = np.ascontiguousarray(columns, dtype=np.float32)
        edges = tuple(accumulate(counts, initial=0))
        if self._held + values.nbytes > _IN_MEMORY and self._write(values):
            self._blocks.append(_Block(edges, values.shape, None, self._written - values.nbytes))
        else:
            self._held += values.nbytes
            self._blocks.append(_Block(edges, values.shape, values, 0))

    def _write(self, values: NDArray[np.float32]) -> bool:
        """Write to the file; False where there is no room for it."""
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the store
            self._file.seek(self._written)
            self._file.write(values.data)
        except OSError:
            return False
        self._written += values.nbytes
        return True

    def blocks(self) -> Iterator[tuple[slice, list[Array]]]:
        """Runs that are stored together, and the columns of each."""
        first = 0
        for block in self._blocks:
            values, last = self._read(block), first + len(block.edges) - 1
            yield slice(first, last), [values[low:high] for low, high in pairwise(block.edges)]
            first = last

    def _read(self, block: _Block) -> NDArray[np.float32]:
        if block.values is not None:
            return block.values
        assert self._file is not None  # the block is in it
        values = np.empty(block.shape, dtype=np.float32)
        self._file.seek(block.offset)
        self._file.readinto(values.data)
        return values

    @property
    def rows(self) -> int:
        """The number of rows of all runs."""
        return sum(block.shape[0] for block in self._blocks)

    def __iter__(self) -> Iterator[Array]:
        for _, of_runs in self.blocks():
            yield from of_runs

    def __len__(self) -> int:
        return sum(len(block.edges) - 1 for block in self._blocks)

    @overload
    def __getitem__(self, run: int) -> Array: ...
    @overload
    def __getitem__(self, run: slice) -> Sequence[Array]: ...
    def __getitem__(self, run: int | slice) -> Array | Sequence[Array]:
        if isinstance(run, slice):
            return list(self)[run]
        for runs, columns in self.blocks():
            if run < runs.stop:
                return columns[run - runs.start]
        raise IndexError(run)


# tests/studies/constants.py varies each number by 0.5 and 2 on small blind sets: no verdict and no name changes.
_TOGETHER = 2000  # columns whose signs are changed at once, so that memory is small (chosen)
_FLIPS = 499  # B; Eq. (3) gives chances smaller than 1 / B (at 5 %, 99 would do: Davison and Hinkley, section 4.2.5)
_TAIL = 0.1  # k / B: Knijnenburg et al. fit no more than a quarter of the flips
_ENOUGH = 0.25  # share of the k that must reach z for Eq. (2): 12 flips, at least 10 in Knijnenburg et al.
_PLAIN = 3.0  # z, Eq. (1), from which on a group is plainly significant: so much by chance is one group of 1000
_MOST_TAKEN = 3  # groups, at most, that are taken out of the residuals that stand for noise: as many as are named


@dataclass(frozen=True, eq=False)
class Family:
    """Groups that are tested together. chance (B,): the largest evidence of them in each random flip, sorted."""

    groups: int
    chance: Array

    def p_value(self, evidence: float) -> float:
        """The chance that any of the groups reaches an evidence where nothing is missing."""
        chance = self.chance
        exceeded = int((chance >= evidence).sum())
        tail = max(int(_TAIL * len(chance)), 1)
        if exceeded >= int(_ENOUGH * tail):
            return (exceeded + 1) / (len(chance) + 1)  # Eq. (2)
        edge = float(chance[-tail])
        scale = max(float((chance[-tail:] - edge).sum()) / max(tail - 1, 1), 1e-3)  # above 0 where all flips tie
        return float(max(tail / len(chance) * np.exp(-(evidence - edge) / scale), 1e-300))  # Eq. (3)


@dataclass(frozen=True, eq=False)
class Significance:
    """Chi-square differences of G groups and how significant they are.

    chi_square (G,): the differences Q. steady (G,): these without the run that adds most. rank (G,): degrees of freedom
    d. spread (G,): mean difference v by chance per degree of freedom. evidence (G,): z of Eq. (1), without the run that
    adds most. families: of these groups, in turn. surplus: Eq. (4). surplus_of: the group that has it.
    """

    groups: tuple[Group, ...]
    chi_square: Array
    steady: Array
    rank: Array
    spread: Array
    evidence: Array
    families: tuple[Family, ...]
    surplus: float
    surplus_of: int

    @property
    def excess(self) -> Array:
        """Chi-square differences (G,) less what chance makes of them, at least 0."""
        return np.maximum(self.chi_square - self.rank * self.spread, 0.0)

    def p_value(self, index: int) -> float:
        """The chance that any of the groups is as significant as the one at ``index`` where nothing is missing.

        Each family is as likely to hold it (Bonferroni).
        """
        ends = np.cumsum([family.groups for family in self.families])
        family = self.families[int(np.searchsorted(ends, index, side="right"))]
        return min(len(self.families) * family.p_value(float(self.evidence[index])), 1.0)

    @property
    def best(self) -> int:
        """Index of the most significant group."""
        return self.surest[0]

    @cached_property
    def surest(self) -> list[int]:
        """Indices of the groups, the most significant first."""
        return sorted(range(len(self.groups)), key=lambda index: (self.p_value(index), -float(self.evidence[index])))

    @property
    def best_shapes(self) -> list[int]:
        """Indices of the groups with the largest chi-square difference, one a name, of those that have any rank."""
        known = np.flatnonzero(self.rank).tolist()
        return [
            known[index] for index in best_shapes([self.groups[row] for row in known], self.chi_square[known].tolist())
        ]

    @property
    def surplus_chi_square(self) -> tuple[float, float]:
        """The chi-square difference that the surplus stands for, and its standard deviation by chance."""
        scatter = float(np.sqrt(2 * max(self.rank[self.surplus_of], 1.0)) * self.spread[self.surplus_of])
        return max(self.surplus, 0.0) * scatter, scatter


def together(first: Significance, second: Significance | None) -> Significance:
    """Significance of the groups of both, whose families stay apart: what is rough in one makes no noise in another."""
    if second is None:
        return first
    surer = second.surplus > first.surplus
    return Significance(
        groups=(*first.groups, *second.groups),
        **{
            name: np.concatenate([getattr(each, name) for each in (first, second)])
            for name in ("chi_square", "steady", "rank", "spread", "evidence")
        },
        families=(*first.families, *second.families),
        surplus=max(first.surplus, second.surplus),
        surplus_of=second.surplus_of + len(first.groups) if surer else first.surplus_of,
    )


def significance_of(
    data: Whitened, fitted: Sequence[int], groups: Sequence[Group], rng: np.random.Generator
) -> Significance:
    """Chi-square differences of groups beyond the columns ``fitted``, and their significance."""
    now = given(data, fitted)
    roots = [now.roots(group.index) for group in groups]
    scores = [now.scores[:, list(group.index)] @ root for group, root in zip(groups, roots, strict=True)]
    noise = _noise_scores(data, list(fitted), groups)
    by_chance = [noise.scores[:, list(group.index)] @ root for group, root in zip(groups, roots, strict=True)]
    return significance_of_scores(groups, scores, by_chance, rng)


def significance_of_scores(
    groups: Sequence[Group],
    scores: Sequence[Array],
    by_chance: Sequence[Array],
    rng: np.random.Generator,
    *,
    studentised: bool = False,
) -> Significance:
    """Significance of groups by the scores (Z, d) that each has in every run, independent and of unit variance in sum.

    by_chance: scores that stand for noise. studentised: the unit is the scores' own scatter, by which a sum that is no
    chance is measured too small: chi-square differences are then Q = q / (1 - q / Z) of sums of squares q.
    """
    rank = np.array([of_runs.shape[1] for of_runs in scores], dtype=float)
    tries = np.array([group.tries for group in groups], dtype=float)
    runs = len(scores[0]) if studentised and scores else np.inf
    chi_square = _student(np.array([float(np.square(of_runs.sum(axis=0)).sum()) for of_runs in scores]), runs)
    steady = _student(np.array([_without_any_one(of_runs) for of_runs in scores]), runs)
    spread = np.maximum([float(np.square(of_runs).sum()) / max(of_runs.shape[1], 1) for of_runs in by_chance], 1.0)
    signs = rng.choice([-1.0, 1.0], size=(_FLIPS, len(by_chance[0]) if by_chance else 0))
    flipped = _student(_flipped(signs, by_chance), runs)
    chance = _evidence(flipped, rank, spread, tries)
    evidence = _evidence(steady[None], rank, spread, tries)[0]
    scatter = np.sqrt(2 * np.maximum(rank, 1.0)) * spread
    beyond = (chi_square - rank * spread) / scatter  # Eq. (4)
    usual = float(np.mean(((flipped - rank * spread) / scatter).max(axis=1)))
    best = int(beyond.argmax())
    return Significance(
        groups=tuple(groups),
        chi_square=chi_square,
        steady=steady,
        rank=rank,
        spread=spread,
        evidence=evidence,
        families=(Family(len(groups), np.sort(chance.max(axis=1))),),
        surplus=float(beyond[best]) - usual,
        surplus_of=best,
    )


def _student(squares: Array, runs: float) -> Array:
    """Chi-square differences by sums of squares in units of the scores' own scatter over so many runs."""
    return squares / np.maximum(1 - squares / runs, 1 / runs)


def _flipped(signs: Array, scores: Sequence[Array]) -> Array:
    """Chi-square differences (B, G) of groups by their scores (Z, d), the signs of whole runs changed B times."""
    chi_square = np.zeros((len(signs), len(scores)))
    first = 0
    for last in range(1, len(scores) + 1):
        columns = [of_runs.shape[1] for of_runs in scores[first:last]]
        if last == len(scores) or sum(columns) >= _TOGETHER:
            squares = np.square(signs @ np.concatenate(scores[first:last], axis=1))
            totals = np.cumsum(np.concatenate([np.zeros((len(signs), 1)), squares], axis=1), axis=1)
            ends = np.cumsum(columns)
            chi_square[:, first:last] = totals[:, ends] - totals[:, ends - columns]
            first = last
    return chi_square


def _without_any_one(scores: Array) -> float:
    """The chi-square difference without the run that adds most to it: one run that went wrong is no effect."""
    total = scores.sum(axis=0)
    return float(np.square(total - scores).sum(axis=1).min(initial=np.inf)) if scores.size else 0.0


def _noise_scores(data: Whitened, fitted: list[int], groups: Sequence[Group]) -> Given:
    """Scores (Z, p) that stand for noise: of the residuals without up to three groups that are plainly significant."""
    taken = list(fitted)
    now = given(data, taken)
    for _ in range(_MOST_TAKEN if groups else 0):
        chi_square = np.array([now.chi_square(group.index) for group in groups])
        rank = np.array([now.rank(group.index) for group in groups], dtype=float)
        tries = np.array([group.tries for group in groups])
        evidence = _evidence(chi_square[None], rank, np.ones(len(groups)), tries)[0]
        best = int(evidence.argmax())
        if evidence[best] < _PLAIN:
            break
        taken += groups[best].index
        now = now.given(groups[best].index)
    if len(taken) == len(fitted):
        return now
    values, _ = given(data, []).estimate(taken)
    return given(data.less(taken, values), fitted)


def _evidence(chi_square: Array, rank: Array, spread: Array, tries: Array) -> Array:
    """Evidence z of chi-square differences (B, G), Eq. (1), the best of so many tries (Bonferroni)."""
    scaled, freedom = chi_square / spread, np.maximum(rank, 1.0)
    with np.errstate(divide="ignore"):
        single = -np.log10(chdtrc(freedom, scaled))
    evidence: Array = np.where(rank > 0, np.maximum(single - np.log10(tries), 0.0), 0.0)
    return evidence


def log_evidence(chi_square: Array, rank: Array) -> Array:
    """Logarithms of Bayes factors (n,) of chi-square differences with so many degrees of freedom, Eq. (6)."""
    growth = np.log(np.maximum(chi_square / np.maximum(rank, 1), 1.0))
    evidence: Array = (chi_square - rank - rank * growth) / 2
    return evidence
