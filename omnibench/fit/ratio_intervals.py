"""Confidence intervals of ratios of means over commands or runs: a mean cost, an improvement, a paired difference.

Every run has a numerator and a denominator: the cost of a calibration and that of the design values (their ratio is 1
minus the improvement), a cost and 1 (a mean cost), a difference of two costs and 1 (a paired mean difference). The
runs of a command share the error that the model makes on it, so they are no independent draws: where runs repeat
commands, commands are the unit. With the sums C_u and D_u over the runs of unit u, u = 1..n, the estimate is

    R = sum_u C_u / sum_u D_u.                                                                     (R1)

**Ten units or more.** A value rho is the true ratio if the paired differences C_u - rho D_u have mean 0, of which the
statistic of the paired t test tells (C and D are means over the units, S_CC, S_DD, S_CD the covariances of these means,
with n - 1 in the denominator):

    T(rho) = (C - rho D) / sqrt(S_CC - 2 rho S_CD + rho^2 S_DD).                                   (R2)

The 95 % interval is the set of all rho that are not rejected (Fieller, J. R. Stat. Soc. B 16:175, 1954),

    -q_low <= T(rho) <= q_high,                                                                    (R3)

so that an improvement's interval leaves out 0 if and only if the paired difference of the costs is significant. The
quantiles are those of T in B resamples of the units about the estimate, which see skewness (Hwang, Stat. Sinica 5:161,
1995): with E_u = C_u - R D_u and counts w_u of a multinomial draw,

    T* = E* / sqrt((V* - E*^2) / (n - 1)),   E* = sum_u w_u E_u / n,   V* = sum_u w_u E_u^2 / n.   (R4)

The ends are roots of a quadratic in rho, the smaller with q = q_high and the larger with q = q_low:

    (D^2 - q^2 S_DD) rho^2 - 2 (C D - q^2 S_CD) rho + C^2 - q^2 S_CC = 0.                          (R5)

Where D^2 <= q^2 S_DD, as when one unit outweighs all others, (R3) has no bounds, and no interval is stated.

**Three to nine units** are too few to resample, and (R3) with Student's t has no bounds too often. The interval is that
of Student's t with n - 1 degrees of freedom and the jackknife's standard error s of g(R), where R_u is the ratio
without unit u (Tukey 1958), and g the logarithm, which knows that costs are positive, or for differences the identity:

    g(R) +- t s,   s^2 = (n - 1) / n sum_u (g(R_u) - mean of them)^2.                              (R6)

Two units or one have no interval.

tests/studies/improvement_coverage.py tells how often the intervals hold the truth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import stdtrit

from omnibench.config import Model
from omnibench.data.dataset import Trajectory
from omnibench.fit.noise import grouped
from omnibench.robot.kinematics import Array
from omnibench.robot.physical import INTERVAL
from omnibench.words import plural

UnitName = Literal["command", "run"]
FEWEST = 3  # units of an interval: that of two would reach 13 standard errors to either side
# Fewest units that are resampled. Of five commands 37 to 67 % of the bootstrapped intervals have no bounds, of ten 0 to
# 11 % (tests/studies/improvement_coverage.py --methods --kinds usual tails unequal).
BOOTSTRAPPED = 10
_WIDEST = 30.0  # logarithm of a ratio: e^30 stands for what cannot be bounded
_ALIKE = 1e-12  # share of the numerators: differences between units below it are rounding


class Bootstrap(Model):
    """The units that intervals rest on, and the resamples that are drawn of them from ten units on."""

    resamples: int = Field(2000, ge=100, le=100_000)
    seed: int = Field(0, ge=0)
    unit: UnitName | None = Field(
        None, description="what counts as one independent draw; default: commands where runs repeat them, else runs"
    )


@dataclass(frozen=True)
class Interval:
    """A value with its 95 % interval; low and high are None where the units are too few to say."""

    value: float
    low: float | None
    high: float | None

    @property
    def known(self) -> tuple[float, float] | None:
        """Both ends, or None."""
        return None if self.low is None or self.high is None else (self.low, self.high)

    def holds(self, value: float) -> bool:
        """True unless the interval excludes a value; one without ends excludes none."""
        return self.known is None or self.known[0] <= value <= self.known[1]


@dataclass(frozen=True, eq=False)
class Units:
    """Independent draws among Z runs. of_run (Z,): index of each run's unit."""

    name: UnitName
    of_run: NDArray[np.intp]

    @property
    def count(self) -> int:
        """Number of units."""
        return int(self.of_run.max(initial=-1)) + 1

    @property
    def method(self) -> Literal["bootstrap", "Student's t", "none"]:
        """Method of their intervals."""
        return "none" if self.count < FEWEST else "bootstrap" if self.count >= BOOTSTRAPPED else "Student's t"

    @property
    def words(self) -> str:
        """The basis of an interval: ``bootstrap over 36 commands``."""
        if self.method == "none":
            return f"no interval from {plural(self.count, self.name)}"
        return f"{self.method} over {plural(self.count, self.name)}"

    def sums(self, values: Array) -> Array:
        """Sums (n,) over the runs of each unit."""
        return np.asarray(np.bincount(self.of_run, weights=values, minlength=self.count).astype(float))


def units_of(runs: Sequence[Trajectory], unit: UnitName | None = None) -> Units:
    """The units of some runs: their commands, a run without one being its own, or the runs themselves.

    unit: default ``command`` where runs repeat commands, else ``run``.
    """
    commands = [run.command for run in runs if run.command is not None]
    name = unit or ("command" if len(set(commands)) < len(commands) else "run")
    keys = [(True, run.command) if name == "command" and run.command else (False, run.id) for run in runs]
    of_run = np.zeros(len(runs), dtype=np.intp)
    for index, members in enumerate(grouped(keys)):
        of_run[list(members)] = index
    return Units(name, of_run)


class RatioIntervals:
    """Intervals of ratios with the same resamples for all, so that comparisons are paired."""

    def __init__(self, bootstrap: Bootstrap) -> None:
        self._bootstrap = bootstrap
        self._counts: dict[int, Array] = {}

    def ratio(self, numerators: Array, denominators: Array, units: Units) -> Interval:
        """The ratio of two sums of costs over runs (Z,), with its interval. The denominators' sum must not be 0."""
        return self._interval(numerators, denominators, units, logarithm=True)

    def mean(self, costs: Array, units: Units) -> Interval:
        """The mean of costs (Z,), one a run."""
        return self.ratio(costs, np.ones(len(costs)), units)

    def difference(self, differences: Array, units: Units) -> Interval:
        """The mean of paired differences of costs (Z,), one a run; it may be 0 even where all are positive."""
        return self._interval(differences, np.ones(len(differences)), units, logarithm=False)

    def _interval(self, numerators: Array, denominators: Array, units: Units, *, logarithm: bool) -> Interval:
        """The interval of a ratio; logarithm: the function g of Eq. (R6), else the identity."""
        upper, lower = units.sums(numerators), units.sums(denominators)
        ratio = float(numerators.mean() / denominators.mean())  # Eq. (R1)
        if units.count < FEWEST:
            return Interval(ratio, None, None)
        errors = upper - ratio * lower
        if np.abs(errors).max() <= _ALIKE * np.abs(numerators).sum():
            return Interval(ratio, ratio, ratio)
        if units.count < BOOTSTRAPPED:
            return _jackknifed(ratio, upper, lower, logarithm)
        # Quantiles of Eq. (R3) by Eq. (R4).
        count = units.count
        if count not in self._counts:
            rng = np.random.default_rng(self._bootstrap.seed)
            drawn = rng.multinomial(count, np.full(count, 1 / count), size=self._bootstrap.resamples)
            self._counts[count] = drawn / count
        means = self._counts[count] @ errors
        spreads = np.maximum(self._counts[count] @ np.square(errors) - np.square(means), 0.0)
        # A resample of one unit only, or of equal ones, has no spread: it counts as far from the estimate.
        spreads = np.maximum(spreads, np.finfo(float).eps * np.square(errors).max())
        statistics = means / np.sqrt(spreads / (count - 1))
        least, most = np.percentile(statistics, [50 * (1 - INTERVAL), 50 * (1 + INTERVAL)])
        below, above = max(-float(least), 0.0), max(float(most), 0.0)
        low, high = _end(upper, lower, above, -1), _end(upper, lower, below, 1)
        return Interval(ratio, None, None) if low is None or high is None else Interval(ratio, low, high)

    def improvement(self, values: Array, before: Array, units: Units, rounding: float = 0.0) -> Interval | None:
        """The share of the costs ``before`` (Z,) that is gone; None where their mean is not above ``rounding``."""
        if before.mean() <= rounding:
            return None
        ratio = self.ratio(values, before, units)
        if ratio.low is None or ratio.high is None:
            return Interval(1 - ratio.value, None, None)
        return Interval(1 - ratio.value, 1 - ratio.high, 1 - ratio.low)


def _jackknifed(ratio: float, upper: Array, lower: Array, logarithm: bool) -> Interval:
    """The interval of a ratio of sums (n,) by Eq. (R6), on the scale of its logarithm or its own."""
    count = len(upper)
    rest = lower.sum() - lower
    others = (upper.sum() - upper) / np.where(rest > 0, rest, np.nan)
    if not np.isfinite(others).all() or (logarithm and not (others > 0).all()):
        return Interval(ratio, None, None)
    scaled = np.log(others) if logarithm else others
    error = math.sqrt((count - 1) / count * float(np.square(scaled - scaled.mean()).sum()))
    reach = float(stdtrit(count - 1, (1 + INTERVAL) / 2)) * error
    if logarithm:
        return Interval(ratio, ratio * math.exp(-reach), ratio * math.exp(min(reach, _WIDEST)))
    return Interval(ratio, ratio - reach, ratio + reach)


def _end(upper: Array, lower: Array, quantile: float, side: Literal[-1, 1]) -> float | None:
    """The smaller (-1) or larger (1) root of Eq. (R5); None where the denominators' mean may be 0."""
    mean, of_lower = float(upper.mean()), float(lower.mean())
    covariance = np.cov(upper, lower) / len(upper)
    square = quantile * quantile
    leading = of_lower**2 - square * covariance[1, 1]
    if leading <= 0:
        return None
    middle = mean * of_lower - square * covariance[0, 1]
    constant = mean**2 - square * covariance[0, 0]
    root = math.sqrt(max(middle * middle - leading * constant, 0.0))
    return float((middle + side * root) / leading)
