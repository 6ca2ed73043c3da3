"""Checks of a run's references: what reading a data set refuses with its row, and ``make_dataset`` with its run."""

from __future__ import annotations

import numpy as np

from omnibench.data.references.run_references import AT_ONE_TIME, KINDS, References
from omnibench.data.run_checks import LARGEST, Flaw
from omnibench.errors import nearest
from omnibench.robot.kinematics import Array

_LATE = 0.5  # s after the last wheel sample: a later reference is not of this run


def reference_flaw(references: References, times: Array) -> Flaw | None:
    """The first flaw in a run's references, None if there is none. times (F,): ends of its wheel samples, s."""
    for row, kind in enumerate(references.kinds.tolist()):
        what = (
            _kind_flaw(kind)
            or _times_flaw(kind, float(references.t0[row]), float(references.t1[row]), float(times[-1]))
            or _numbers_flaw(kind, references.values[row], references.sigmas[row])
        )
        if what:
            return row, what
    return _rate_flaw(references)


def measurement_flaw(references: References) -> Flaw | None:
    """The first flaw in kinds, values and standard deviations, whatever their times; None if there is none."""
    for row, kind in enumerate(references.kinds.tolist()):
        if what := _kind_flaw(kind) or _numbers_flaw(kind, references.values[row], references.sigmas[row]):
            return row, what
    return _rate_flaw(references)


def _rate_flaw(references: References) -> Flaw | None:
    if np.isfinite(references.rate_sigma) and 0 <= references.rate_sigma <= LARGEST:
        return None
    return 0, f"sigma_rate is {references.rate_sigma:g}; the standard deviation of a gyro's offset is >= 0, rad/s"


def _kind_flaw(kind: str) -> str:
    if kind in KINDS:
        return ""
    return f"kind is {kind!r}; {nearest(kind, KINDS)}it must be one of {', '.join(KINDS)}"


def _times_flaw(kind: str, t0: float, t1: float, end: float) -> str:
    """What is wrong with the times of a reference to a run of ``end`` s; empty if nothing is."""
    for name, value in (("t0", t0), ("t1", t1)):
        if not np.isfinite(value):
            return f"{name} is {value}; remove or repair the row"
        if value < 0:
            return f"{name} is {value:g}; it must not be negative (s since the run's start)"
    if t1 > end + _LATE:
        return f"t1 is {t1:g}, after the run's last wheel sample at {end:g} s; check the clocks, or leave the row out"
    if kind == "position" and t0 != t1:
        return f"t0 is {t0:g} and t1 {t1:g}; a position is that at t1, leave t0 empty"
    if kind == "heading" and t0 not in (0.0, t1):
        return f"t0 is {t0:g}; leave it empty for a heading in a fixed frame, or take kind turn for one since t0"
    if kind not in AT_ONE_TIME and t0 >= t1:
        return f"t0 is {t0:g} and t1 {t1:g}; a {kind} needs t0 < t1"
    return ""


def _numbers_flaw(kind: str, values: Array, sigmas: Array) -> str:
    """What is wrong with the values and standard deviations (2,) of a reference; empty if nothing is."""
    names = ("x", "y") if kind in ("displacement", "position") else ("",)
    for axis, name in enumerate(names):
        value, sigma = (f"{word}_{name}" if name else word for word in ("value", "sigma"))
        if np.isnan(values[axis]):
            return f"{value} is missing; a {kind} needs {' and '.join(_named('value', names))}"
        if np.isnan(sigmas[axis]):
            return f"{sigma} is missing: how exactly the {kind} is known, a standard deviation"
        if not np.isfinite(values[axis]) or abs(values[axis]) > LARGEST:
            return f"{value} is {values[axis]:g}, which no robot can reach; check the units"
        if not 0 < sigmas[axis] <= LARGEST:
            return f"{sigma} is {sigmas[axis]:g}; a standard deviation is > 0 (how exactly the {kind} is known)"
    if kind == "distance" and values[0] < 0:
        return f"value is {values[0]:g}; a distance driven is not negative, backwards or not"
    return ""


def _named(word: str, names: tuple[str, ...]) -> list[str]:
    return [f"{word}_{name}" if name else word for name in names]
