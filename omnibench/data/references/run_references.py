"""What is known of a run's motion without motion capture: single measurements, each with its own uncertainty."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from omnibench.errors import require_type
from omnibench.robot.kinematics import Array
from omnibench.views import Brief

ReferenceKind = Literal["distance", "turn", "displacement", "position", "heading"]
KINDS: tuple[ReferenceKind, ...] = get_args(ReferenceKind)
PLANAR: frozenset[str] = frozenset({"displacement", "position"})  # kinds of two numbers, x and y
AT_ONE_TIME: frozenset[str] = frozenset({"position", "heading"})  # kinds of an instant, t1, where t0 is not given
UNITS: Mapping[str, Literal["m", "rad"]] = MappingProxyType(
    {kind: "rad" if kind in ("turn", "heading") else "m" for kind in KINDS}
)


@dataclass(frozen=True)
class Reference:
    """One measurement of a run's motion.

    kind: ``distance`` driven along the path from t0 to t1 (m), ``turn`` (rad, counter-clockwise), ``displacement``
    (x, y, m, in the robot's frame at t0), ``position`` (x, y, m, in a fixed frame) or ``heading`` (rad) at t1.
    value, sigma: one number, or x and y; one sigma counts for both. sigma: standard deviation, > 0. t1: s; None: the
    run's end. t0: s; None: the run's start, and of a position or a heading none: it is that in the fixed frame. A
    heading with t0 = 0 is a gyro's, counted from the run's start.
    """

    kind: ReferenceKind
    value: float | tuple[float, float]
    sigma: float | tuple[float, float]
    t1: float | None = None
    t0: float | None = None


@dataclass(frozen=True, eq=False, repr=False)
class References(Brief):
    """The R measurements of one run.

    kinds (R,): of KINDS. t0, t1 (R,): s; equal for what is measured at one time. values, sigmas (R, 2): the second of
    kinds of one number is NaN. start_known: True if the run's start pose is known in the frame of positions and
    headings; else it is a nuisance of the run. rate_sigma: standard deviation, rad/s, of a gyro's offset, which times
    the span is in every turn and heading from the start, and is the same in all runs of a session. Before a recording
    is cut into runs, -inf is the start of a run to come, and inf its end.
    """

    kinds: NDArray[np.str_]
    t0: Array
    t1: Array
    values: Array
    sigmas: Array
    start_known: bool = False
    rate_sigma: float = 0.0

    @classmethod
    def of(
        cls, references: Iterable[Reference], end: float, *, start_known: bool = False, rate_sigma: float = 0.0
    ) -> References:
        """The measurements of a run that ends after ``end`` s, by their times. ConfigError: one is no Reference.

        >>> tape = Reference("distance", 3.03, 0.003)  # m, driven from the run's start to its end
        >>> len(References.of([tape], end=10.0))
        1
        """
        given = list(references)
        for each in given:
            require_type(each, Reference, "Reference(kind, value, sigma)")
        t1 = np.array([end if each.t1 is None else each.t1 for each in given], dtype=float)
        t0 = np.array(
            [
                each.t0 if each.t0 is not None else until if each.kind in AT_ONE_TIME else 0.0
                for each, until in zip(given, t1, strict=True)
            ],
            dtype=float,
        )
        values, sigmas = (
            np.array([_pair(each.kind, pair) for each, pair in zip(given, pairs, strict=True)]).reshape(-1, 2)
            for pairs in ([each.value for each in given], [each.sigma for each in given])
        )
        kinds = np.array([each.kind for each in given], dtype=str)
        return cls(kinds, t0, t1, values, sigmas, start_known, rate_sigma).by_time()

    def __len__(self) -> int:
        return len(self.kinds)

    @cached_property
    def planar(self) -> NDArray[np.bool_]:
        """True (R,) for measurements of two numbers, x and y."""
        return np.isin(self.kinds, list(PLANAR))

    @cached_property
    def fixed_frame(self) -> NDArray[np.bool_]:
        """True (R,) for positions, and for headings that are not counted from another time."""
        return (self.kinds == "position") | ((self.kinds == "heading") & (self.t0 == self.t1))

    @cached_property
    def gyro(self) -> NDArray[np.bool_]:
        """True (R,) for angles since another time, in which a gyro's offset adds up."""
        return (self.kinds == "turn") | ((self.kinds == "heading") & (self.t0 < self.t1))

    def by_time(self) -> References:
        """These measurements in the order of t1, then t0."""
        order = np.lexsort((self.t0, self.t1))
        t0, t1, values, sigmas = (array[order] for array in (self.t0, self.t1, self.values, self.sigmas))
        return replace(self, kinds=self.kinds[order], t0=t0, t1=t1, values=values, sigmas=sigmas)

    def with_values(self, values: Array) -> References:
        """These measurements with other values (R, 2)."""
        return replace(self, values=values)

    def of_run(self, zero: float, end: float, kept: NDArray[np.bool_] | slice = slice(None)) -> References:
        """These measurements, or those kept (R,), by the time of a run that began at ``zero`` and lasted ``end`` s.

        t0 = -inf becomes the run's start, and t1 = inf its end.
        """
        kinds, t0, t1 = self.kinds[kept], self.t0[kept] - zero, self.t1[kept] - zero
        t0, t1 = np.where(np.isneginf(t0), 0.0, t0), np.where(np.isposinf(t1), end, t1)
        t0 = np.where(np.isposinf(t0), t1, t0)
        return replace(self, kinds=kinds, t0=t0, t1=t1, values=self.values[kept], sigmas=self.sigmas[kept])

    def open_ended(self, end: float) -> References:
        """These measurements of a run of ``end`` s, with -inf for its start and inf for its end: see ``of_run``."""
        spans = self.t0 < self.t1
        t0 = np.where(spans & (self.t0 == 0), -np.inf, self.t0)
        t1 = np.where(spans & (self.t1 == end) & (self.kinds != "heading"), np.inf, self.t1)
        return replace(self, t0=t0, t1=t1)

    @property
    def content(self) -> tuple[Hashable, ...]:
        """All of it as plain values, for digests."""
        arrays = (np.ascontiguousarray(array, dtype=float) for array in (self.t0, self.t1, self.values, self.sigmas))
        # Left out where it says nothing, as tables leave it out.
        offset = (self.rate_sigma,) * bool(self.rate_sigma > 0 and self.gyro.any())
        return (tuple(self.kinds.tolist()), self.start_known, *(array.tobytes() for array in arrays), *offset)


def _pair(kind: str, given: float | tuple[float, float]) -> tuple[float, float]:
    """Two numbers; the second is NaN for kinds of one number, and the first again where one is given for both."""
    first, *others = np.atleast_1d(np.asarray(given, dtype=float)).tolist()
    if kind not in PLANAR:
        return first, np.nan
    return first, others[0] if others else first
