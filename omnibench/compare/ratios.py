"""The ratio of two methods' mean errors in a cell, with intervals by sessions and by runs.

A cell has pairs (f, z): the
calibration of training set f judged on run z. With the errors a and b of two methods and sums over all pairs, the ratio
is

    R = sum a_fz / sum b_fz.                                                                       (S1)

The runs of a session share its day, floor and clocks, and so do all calibrations from one session: sessions are the
independent draws, of training and of judged runs. With R_s the ratio without the pairs of session s, n_g sessions in
the group g (those that train, those that judge; one group where these are the same), the variance of log R is that of
the jackknife for several samples (Arvesen, Ann. Math. Stat. 40:2076, 1969),

    v = sum_g v_g,   v_g = (n_g - 1) / n_g sum_(s in g) (log R_s - their mean)^2,                  (S2)

and the interval that of Student's t with Satterthwaite's degrees of freedom (Biometrics Bulletin 2:110, 1946),

    log R +- t sqrt(v),   df = v^2 / sum_g v_g^2 / (n_g - 1).                                      (S3)

Where a group has fewer than three sessions, runs take their place, which say less: a day that differs goes unseen.
Of C cells that are judged together each has an interval of level 1 - 0.05 / C (Bonferroni), so that all of them hold
in 95 of 100 studies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from omnibench.fit.intervals import FEWEST, Interval
from omnibench.robot.kinematics import Array
from omnibench.robot.physical import INTERVAL
from omnibench.words import plural

UnitOfCell = Literal["session", "run"]
Members = NDArray[np.bool_]
_ALIKE = 1e-9  # share of the sums: smaller differences between ratios are rounding


@dataclass(frozen=True, eq=False)
class Pairs:
    """The pairs of a cell. folds (n,), runs (n,): index of each pair's training set and judged run.

    trained_in (n,), judged_in (n,): names of the sessions; None: training runs that are not of one session.
    """

    folds: Array
    runs: Array
    trained_in: tuple[str | None, ...]
    judged_in: tuple[str | None, ...]

    @property
    def sessions(self) -> int:
        """Number of sessions that judge; 0 where some run names none."""
        return 0 if None in self.judged_in else len(set(self.judged_in))

    def groups(self, unit: UnitOfCell) -> list[list[Members]]:
        """For each group the pairs (n,) of bool that each of its units has a part in."""
        if unit == "run":
            return [[self.runs == run for run in np.unique(self.runs)]]
        trained, judged = _members(self.trained_in), _members(self.judged_in)
        if len(trained) < 2:  # one training set, or no session of its own: given
            return [list(judged.values())]
        if trained.keys() & judged.keys():
            none = np.zeros(len(self.runs), dtype=bool)
            names = [*judged, *(name for name in trained if name not in judged)]
            return [[judged.get(name, none) | trained.get(name, none) for name in names]]
        return [list(trained.values()), list(judged.values())]

    @property
    def unit(self) -> UnitOfCell:
        """The units that the interval rests on: sessions where each group has three, else runs."""
        return "session" if self.sessions and min(map(len, self.groups("session"))) >= FEWEST else "run"


@dataclass(frozen=True)
class CellRatio:
    """Ratio of two methods' mean errors in a cell, with the 95 % interval and that of its family of cells.

    unit: what they rest on; units: their number in words.
    """

    value: float
    alone: Interval
    in_family: Interval
    unit: UnitOfCell
    units: str

    @property
    def equal(self) -> bool:
        """True if the two differ by rounding alone."""
        return abs(self.value - 1) < _ALIKE

    @property
    def verdict(self) -> Literal["better", "worse", "undecided"]:
        """The verdict of the family's interval: which side of 1 it lies on."""
        if self.equal or self.in_family.known is None or self.in_family.holds(1.0):
            return "undecided"
        return "better" if self.value < 1 else "worse"


def cell_ratio(errors: Array, others: Array, pairs: Pairs, cells: int) -> CellRatio:
    """The ratio of the mean of errors (n,) to that of others (n,) over a cell's pairs; cells: size of its family."""
    unit = pairs.unit
    groups = pairs.groups(unit)
    ratio = float(errors.sum() / others.sum()) if others.sum() > 0 else math.inf
    parts = [_variance(errors, others, group) for group in groups]
    words = " and ".join(plural(len(group), unit) for group in groups)
    return CellRatio(
        ratio,
        _interval(ratio, parts, INTERVAL),
        _interval(ratio, parts, 1 - (1 - INTERVAL) / max(cells, 1)),
        unit,
        words,
    )


def _members(names: Sequence[str | None]) -> dict[str, Members]:
    known = list(dict.fromkeys(name for name in names if name is not None))
    given = np.array(names, dtype=object)
    return {name: given == name for name in known}


def _variance(errors: Array, others: Array, group: Sequence[Members]) -> tuple[float, int] | None:
    """v_g of Eq. (S2) and its degrees of freedom; None where it is not known."""
    if len(group) < FEWEST:
        return None
    upper = errors.sum() - np.array([errors[members].sum() for members in group])
    lower = others.sum() - np.array([others[members].sum() for members in group])
    if not ((upper > 0) & (lower > 0)).all():
        return None
    logarithms = np.log(upper / lower)
    around = logarithms - logarithms.mean()
    around[np.abs(around) < _ALIKE] = 0.0
    count = len(group)
    return (count - 1) / count * float(np.square(around).sum()), count - 1


def _interval(ratio: float, parts: Sequence[tuple[float, int] | None], level: float) -> Interval:
    """The interval of Eq. (S3)."""
    known = [part for part in parts if part is not None]
    if len(known) < len(parts) or not 0 < ratio < math.inf:
        return Interval(ratio, None, None)
    variance = sum(part for part, _ in known)
    if variance == 0:
        return Interval(ratio, ratio, ratio)
    freedom = variance**2 / sum(part**2 / count for part, count in known)
    reach = float(stdtrit(freedom, (1 + level) / 2)) * math.sqrt(variance)
    return Interval(ratio, ratio * math.exp(-min(reach, 30.0)), ratio * math.exp(min(reach, 30.0)))
