"""References in units that cannot be right: millimetres, centimetres or degrees, by the design model's odometry."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from omnibench.data.checks.finding import Kind
from omnibench.data.checks.misreading import POSITION_UNITS, Misreading
from omnibench.data.checks.option_words import warning_of
from omnibench.data.references.run_references import KINDS, UNITS, ReferenceKind, References
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

# How many times too large references in another unit are, and that unit.
_FACTORS = {"m": POSITION_UNITS, "rad": ((float(np.degrees(1)), "deg"),)}
_NEAR = 1.5  # a ratio to the odometry within this factor of a unit's is that unit; chosen: designs are off by less
_LEAST = {"m": 0.02, "rad": 0.05}  # m, rad: motions that are smaller tell nothing of a unit; chosen


def odd_references(robot: Robot, runs: Iterable[tuple[WheelLog, References]]) -> list[str]:
    """A warning for each kind of reference whose values are as large as in another unit, of some runs' references."""
    ratios: dict[str, list[float]] = {kind: [] for kind in KINDS}
    model = OdometryModel.of_design(robot, "arc")
    for log, references in runs:
        if not len(references):
            continue
        sizes, driven = _sizes(model, log, references)
        for kind, size, expected in zip(references.kinds.tolist(), sizes, driven, strict=True):
            if expected > _LEAST[UNITS[kind]] and np.isfinite(size):
                ratios[kind].append(size / expected)
    return [warning for kind in KINDS for warning in _warnings(robot, kind, ratios[kind])]


def _warnings(robot: Robot, kind: ReferenceKind, ratios: Sequence[float]) -> list[str]:
    if not ratios:
        return []
    ratio = float(np.median(ratios))
    for factor, unit in _FACTORS[UNITS[kind]]:
        if factor / _NEAR < ratio < factor * _NEAR:
            what = (
                f"references of kind {kind} are {ratio:.3g} times what the wheels say, as if they were in "
                f"{'degrees' if unit == 'deg' else unit}: they must be in {UNITS[kind]}"
            )
            option: Kind = "heading_unit" if UNITS[kind] == "rad" else "position_unit"
            found = Misreading(option, what, f"references of kind {kind}", {option: unit}).finding()
            return [warning_of(robot, found, unit=True)]
    return []


def _sizes(model: OdometryModel, log: WheelLog, references: References) -> tuple[Array, Array]:
    """Magnitudes (R,) of what was measured and of the same by a model; positions and compass headings since the first.

    NaN for the first of those.
    """
    first, last = (_at(model, log, stamps) for stamps in (references.t0, references.t1))
    values = references.values.copy()
    for kind in ("position", "heading"):
        chosen = references.fixed_frame & (references.kinds == kind)
        if chosen.any():
            values[chosen] -= values[chosen][0]
            values[np.flatnonzero(chosen)[0]] = np.nan
            first[0][chosen], first[1][chosen] = last[0][chosen][0], last[1][chosen][0]
    size = np.where(references.planar, np.hypot(values[:, 0], values[:, 1]), np.abs(values[:, 0]))
    moved = last[0] - first[0]
    expected = np.select(
        [references.kinds == "distance", references.planar],
        [last[1] - first[1], np.hypot(moved[:, 0], moved[:, 1])],
        np.abs(moved[:, 2]),
    )
    return size, expected


def _at(model: OdometryModel, log: WheelLog, stamps: Array) -> tuple[Array, Array]:
    """Poses (S, 3) and distances driven (S,) at stamps (S,), in any order."""
    order = np.argsort(stamps)
    wanted = replace(log, stamps=stamps[order])
    poses, lengths = np.empty((len(stamps), 3)), np.empty(len(stamps))
    poses[order], lengths[order] = model.poses([wanted])[0], model.lengths([wanted])[0]
    return poses, lengths
