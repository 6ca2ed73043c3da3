"""References: single measurements of a run's motion without motion capture, each with its own uncertainty."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from omnibench.data.stored import LARGEST, Flaw
from omnibench.errors import nearest, require_type
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.views import Brief

ReferenceKind = Literal["distance", "turn", "displacement", "position", "heading"]
KINDS: tuple[ReferenceKind, ...] = get_args(ReferenceKind)
PLANAR: frozenset[str] = frozenset({"displacement", "position"})  # kinds of two numbers, x and y
TURN = 2 * np.pi  # rad
AT_ONE_TIME: frozenset[str] = frozenset({"position", "heading"})  # kinds of an instant, t1, where t0 is not given
UNITS: Mapping[str, Literal["m", "rad"]] = {kind: "rad" if kind in ("turn", "heading") else "m" for kind in KINDS}


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
        kinds = np.array([each.kind for each in given], dtype=str)
        # As of a run to come: -inf is its start, inf its end, and in the place of t0 the same time as t1.
        starts = np.where(np.isin(kinds, list(AT_ONE_TIME)), np.inf, -np.inf).tolist()
        t0 = [start if each.t0 is None else each.t0 for each, start in zip(given, starts, strict=True)]
        t1 = [np.inf if each.t1 is None else each.t1 for each in given]
        pairs = [(np.resize(each.value, 2), np.resize(each.sigma, 2)) for each in given]  # one number stands for both
        values, sigmas = np.array(pairs, dtype=float).reshape(-1, 2, 2).swapaxes(0, 1)
        times = np.array([t0, t1], dtype=float)
        measured = cls(kinds, times[0], times[1], values, sigmas, start_known, rate_sigma)
        values[~measured.planar, 1] = sigmas[~measured.planar, 1] = np.nan
        return measured.of_run(0.0, end).by_time()

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
        return self.only(np.lexsort((self.t0, self.t1)))

    def only(self, rows: NDArray[Any]) -> References:
        """Some of these measurements, by their indices, or by True (R,)."""
        return replace(self, **{name: getattr(self, name)[rows] for name in ("kinds", "t0", "t1", "values", "sigmas")})

    def of_run(self, zero: float, end: float) -> References:
        """These measurements by the time of a run that began at ``zero`` and lasted ``end`` s.

        t0 = -inf becomes the run's start, and t1 = inf its end.
        """
        t1 = np.where(np.isposinf(self.t1), end, self.t1 - zero)
        t0 = np.where(np.isneginf(self.t0), 0.0, self.t0 - zero)
        return replace(self, t0=np.where(np.isposinf(t0), t1, t0), t1=t1)

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


NUMBERS = ("t0", "t1", "value", "value_x", "value_y", "sigma", "sigma_x", "sigma_y", "sigma_rate")


def references_of(kinds: NDArray[np.str_], numbers: Mapping[str, Array], *, start_known: bool = False) -> References:
    """The references of rows with a kind (R,) and numbers (R,) by NUMBERS, NaN where a cell is empty.

    An empty t1 becomes inf, the end of a run; an empty t0 -inf, its start, or t1 of what is measured at one time. The
    largest sigma_rate is that of the run.
    """
    planar, instant = np.isin(kinds, list(PLANAR)), np.isin(kinds, list(AT_ONE_TIME))
    t1 = np.where(np.isnan(numbers["t1"]), np.inf, numbers["t1"])
    t0 = np.where(np.isnan(numbers["t0"]), np.where(instant, t1, -np.inf), numbers["t0"])
    values = np.column_stack([np.where(planar, numbers["value_x"], numbers["value"]), numbers["value_y"]])
    sigmas = np.column_stack([numbers["sigma_x"], numbers["sigma_y"]])
    sigmas = np.where(np.isnan(sigmas) | ~planar[:, None], numbers["sigma"][:, None], sigmas)
    values[~planar, 1] = sigmas[~planar, 1] = np.nan
    rates = np.append(np.nan_to_num(numbers["sigma_rate"]), 0.0)
    return References(kinds, t0, t1, values, sigmas, start_known, float(rates[np.abs(rates).argmax()]))


LATE = 0.5  # s after the last wheel sample: a later reference is not of this run


def reference_flaw(references: References, end: float | None) -> Flaw | None:
    """The first flaw in a run's references, None if there is none.

    end: of its wheel samples, s; None: whatever the times of the references are.
    """
    return next(_flaws(references, end), None)


def _flaws(references: References, end: float | None) -> Iterator[Flaw]:
    columns = (references.kinds, references.t0, references.t1, references.values, references.sigmas)
    for row, (kind, t0, t1, values, sigmas) in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
        if kind not in KINDS:
            yield row, f"kind is {kind!r}; {nearest(kind, KINDS)}it must be one of {', '.join(KINDS)}"
        if end is not None:
            for name, value in (("t0", t0), ("t1", t1)):
                if not 0 <= value < np.inf:
                    yield row, f"{name} is {value:g}; s since the run's start, finite and not negative"
            if t1 > end + LATE:
                yield row, f"t1 is {t1:g}, after the wheels' end at {end:g} s; check the clocks, or leave the row out"
            if kind == "position" and t0 != t1:
                yield row, f"t0 is {t0:g} and t1 {t1:g}; a position is that at t1, leave t0 empty"
            if kind == "heading" and t0 not in (0.0, t1):
                yield row, f"t0 is {t0:g}; leave it empty for a heading in a fixed frame, or take kind turn"
            if kind not in AT_ONE_TIME and t0 >= t1:
                yield row, f"t0 is {t0:g} and t1 {t1:g}; a {kind} needs t0 < t1"
        axes = ("_x", "_y") if kind in PLANAR else ("",)
        for axis, value, sigma in zip(axes, values, sigmas, strict=False):
            if np.isnan(value):
                yield row, f"value{axis} is missing; a {kind} needs {' and '.join(f'value{name}' for name in axes)}"
            if not abs(value) <= LARGEST:
                yield row, f"value{axis} is {value:g}, which no robot can reach; check the units"
            if not 0 < sigma <= LARGEST:
                stated = "missing" if np.isnan(sigma) else f"{sigma:g}"
                yield row, f"sigma{axis} is {stated}; a standard deviation is > 0 (how exactly the {kind} is known)"
        if kind == "distance" and values[0] < 0:
            yield row, f"value is {values[0]:g}; a distance driven is not negative, backwards or not"
    if not 0 <= references.rate_sigma <= LARGEST:
        yield 0, f"sigma_rate is {references.rate_sigma:g}; the standard deviation of a gyro's offset is >= 0, rad/s"


def with_whole_turns(robot: Robot, log: WheelLog, references: References) -> References:
    """The references with the whole turns added to headings that bring each step closest to the design's odometry.

    log: of the run, from its start pose. Turned angles stay as they are: three turns are 18.85 rad.
    """
    values = references.values.copy()
    absolute = references.fixed_frame & (references.kinds == "heading")
    counted = (references.kinds == "heading") & ~absolute
    for chosen, known, first in ((absolute, references.start_known, log.start[2]), (counted, True, 0.0)):
        if chosen.any():
            begin, start = ([0.0], [first]) if known else ([], [])  # time and heading of the run's start
            wanted = replace(log, start=np.zeros(3), stamps=np.append(begin, references.t1[chosen]))
            (headings,), _ = unwrap(robot, [wanted], [np.append(start, values[chosen, 0])])
            values[chosen, 0] = headings[len(begin) :]
    return replace(references, values=values)


_POSES_AT_ONCE = 200_000  # whose odometry is in memory when headings are unwrapped: 40 MB; chosen


def unwrap(robot: Robot, logs: Sequence[WheelLog], headings: Sequence[Array]) -> tuple[list[Array], list[int]]:
    """Continuous headings (rad), as given where they are, and the indices of trajectories in which they are ambiguous.

    Every increment gets the whole turns that bring it closest to the design model's odometry. Where the reference is
    dense this is the nearest turn; where it is sparse, the odometry tells how often the robot turned in between. A
    trajectory is ambiguous if the two still differ by more than a quarter turn between two reference poses.
    """
    model = OdometryModel.of_design(robot, "arc")
    blocks = (np.cumsum([len(heading) for heading in headings]) // _POSES_AT_ONCE).tolist()
    parts = groupby(zip(blocks, logs, strict=True), key=itemgetter(0))
    odometries = (odometry for _, part in parts for odometry in model.poses([log for _, log in part]))
    unwrapped, ambiguous = list[Array](), list[int]()
    for index, (odometry, heading) in enumerate(zip(odometries, headings, strict=True)):
        driven = odometry[:, 2]
        # Whole turns that bring each step closest to the odometry's; continuous headings stay as they are to the bit.
        turns = np.round((np.diff(driven) - np.diff(heading)) / TURN)
        continuous = heading + TURN * np.append(0.0, np.cumsum(turns))
        unwrapped.append(heading if continuous.tobytes() == heading.tobytes() else continuous)
        if np.abs(np.diff(continuous) - np.diff(driven)).max(initial=0.0) > TURN / 4:
            ambiguous.append(index)
    return unwrapped, ambiguous
