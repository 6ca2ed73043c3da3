"""References of a recording: other units than read, another drive than the wheels', what they leave open."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from omnibench.check.evidence import Evidence
from omnibench.check.hypotheses import POSITION_UNITS
from omnibench.data.dataset import Trajectory
from omnibench.data.finding import Finding, Kind, error
from omnibench.data.references import KINDS, UNITS, ReferenceKind, References
from omnibench.fit.open_combinations import open_sentences
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

_REACHED = 0.05  # share of a run's time after which its last pose comes at least; chosen
# Share of the squares of the whole runs' turns that the best matrix does not explain: at most 0.005 on OptiOdom's
# recordings, and 0.68 to 1.45 where the poses of each run were given to one of another command.
_UNEXPLAINED = 0.25
_TURNED = 0.5  # rad, root mean square of the runs' turns: less of it tells nothing; chosen
_FEWEST = 3  # runs whose turns a matrix of a few numbers cannot all follow; chosen
# How many times too large references in another unit are, and that unit; and the option that says so.
_FACTORS = {"m": POSITION_UNITS, "rad": ((float(np.degrees(1)), "deg"),)}
_OPTIONS: dict[str, Kind] = {"m": "position_unit", "rad": "heading_unit"}
_NEAR = 1.5  # a ratio to the odometry within this factor of a unit's is that unit; chosen: designs are off by less
_LEAST = {"m": 0.02, "rad": 0.05}  # m, rad: motions that are smaller tell nothing of a unit; chosen


def odd_references(evidence: Evidence) -> Iterator[Finding]:
    """Kinds of references whose values are as large as in another unit; beside poses no option mends them alone."""
    ratios: dict[ReferenceKind, list[float]] = {kind: [] for kind in KINDS}
    model = OdometryModel.of_design(evidence.dataset.robot, "arc")
    for run in evidence.dataset.trajectories:
        if run.references is None or not len(run.references):
            continue
        sizes, driven = _sizes(model, run, run.references)
        for kind, size, expected in zip(run.references.kinds.tolist(), sizes, driven, strict=True):
            if expected > _LEAST[UNITS[kind]] and np.isfinite(size):
                ratios[kind].append(size / expected)
    for kind, values in ratios.items():
        ratio, must = float(np.median(values)) if values else 0.0, UNITS[kind]
        for factor, unit in _FACTORS[must]:
            if factor / _NEAR < ratio < factor * _NEAR:
                what = f"references of kind {kind} are {ratio:.3g} times what the wheels say, as if they were in "
                what += f"{'degrees' if unit == 'deg' else unit}: they must be in {must}"
                where, option = f"references of kind {kind}", _OPTIONS[must]
                fix = "write these references in m and rad, as the poses are, and import again"
                yield (
                    error(option, what, where, fix=fix) if evidence.runs else error(option, what, where, {option: unit})
                )


def _sizes(model: OdometryModel, run: Trajectory, references: References) -> tuple[Array, Array]:
    """Magnitudes (R,) of what was measured and of the same by a model; positions and compass headings since the first.

    NaN for the first of those.
    """
    stamps, places = np.unique([references.t0, references.t1], return_inverse=True)
    log = run.log(stamps)
    first, last = model.poses([log])[0][places.reshape(2, -1)]  # (R, 3), poses at the begin and at the end of each
    begin, end = model.lengths([log])[0][places.reshape(2, -1)]
    values = references.values.copy()
    for kind in ("position", "heading"):
        chosen = references.fixed_frame & (references.kinds == kind)
        if chosen.any():
            values[chosen] -= values[chosen][0]
            values[np.flatnonzero(chosen)[0]] = np.nan
            first[chosen] = last[chosen][0]
    size = np.where(references.planar, np.hypot(values[:, 0], values[:, 1]), np.abs(values[:, 0]))
    moved = last - first
    kinds = [references.kinds == "distance", references.planar]
    expected = np.select(kinds, [end - begin, np.hypot(moved[:, 0], moved[:, 1])], np.abs(moved[:, 2]))
    return size, expected


def early_references(evidence: Evidence) -> Iterator[Finding]:
    """The finding that the poses of most runs end long before their wheels."""
    runs = evidence.aligned
    early = [run for run in runs if run.references is None and run.pose_times[-1] < _REACHED * run.times[-1]]
    if 2 * len(early) > len(runs):
        what = f"the poses of {plural(len(early), 'run')} end long before the wheels, as after "
        what += f"{early[0].pose_times[-1]:.2g} s of {early[0].times[-1]:.3g} s"
        fix = "say the unit of the poses' times (pose_time_unit), or record poses to the end of each run"
        yield error("reference_foreign", what, "the reference", fix=fix)


def unrelated_references(evidence: Evidence) -> Iterator[Finding]:
    """The finding that no matrix explains how the reference turns, as where poses are of other drives.

    It is judged by the share of the squares of the runs' turns that the best matrix does not explain.
    """
    windows, fit = evidence.windows, evidence.fit
    if windows is None or fit is None or len(evidence.runs) < _FEWEST:
        return
    turned = np.bincount(windows.run, windows.turned)
    missed = turned - np.bincount(windows.run, windows.driven @ fit.matrix[2])
    if np.sqrt(np.mean(turned**2)) < _TURNED:
        return
    if (share := float((missed**2).sum() / (turned**2).sum())) > _UNEXPLAINED:
        what = f"the wheels explain {max(0.0, 1 - share):.0%} of how the reference turns"
        fix = "see whether wheels and poses of each run are of the same drive, and name the robot's wheels right"
        yield error("reference_foreign", what, "the reference", fix=fix)


def left_open(evidence: Evidence) -> Iterator[Finding]:
    """Findings on what the training runs leave open: with no reference of turning, or none of lengths, a warning."""
    training = evidence.dataset.split("train")
    for number, sentence in enumerate(open_sentences(evidence.dataset.robot, training) if training else ()):
        what, _, fix = sentence.rpartition("; " if "; " in sentence else ": ")
        missing = what.startswith(("no reference tells of turning", "no reference tells of lengths"))
        yield Finding(
            kind="motion_missing" if missing else "references_leave_open",
            what=what,
            where="the recording" if not number else f"the recording, {number + 1}",
            severity="warning" if missing else "note",
            fix=fix,
        )
