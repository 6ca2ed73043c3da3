"""Sentences on what references other than poses leave open, and which measurement would tell it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.data.references.run_references import UNITS
from omnibench.fit.observations.open_combinations import with_open_combinations
from omnibench.fit.parameterisation import MatrixElements
from omnibench.fit.shrinkage.prior import default_mount
from omnibench.fit.span import Unidentified, directions_kept, driven_span
from omnibench.robot.kinematics import Array, Robot
from omnibench.words import plural

_MOST = 0.9  # share, squared, of a motion's part in the open combinations from which on it is called open; chosen


def open_sentences(robot: Robot, runs: Sequence[Trajectory], unidentified: Unidentified = "keep") -> tuple[str, ...]:
    """A sentence for each part of the matrix that the runs' references leave open; none where all runs have poses."""
    if all(run.references is None for run in runs):
        return ()
    kept = directions_kept(robot, driven_span(runs), unidentified)
    searched = MatrixElements(robot, "row", kept, default_mount(robot) == "known")
    searched = with_open_combinations(searched, runs)
    end = "keeps the design values" if unidentified != "shrink" else "rests on the design and its tolerance"
    return tuple(_sentences(searched, runs, end))


def _of_several(end: str) -> str:
    """The end of a sentence on several things: keep and rest for keeps and rests."""
    return end.replace("keeps ", "keep ").replace("rests ", "rest ")


def _sentences(searched: MatrixElements, runs: Sequence[Trajectory], end: str) -> Iterator[str]:
    angles = any(run.has_poses or _has(run, "rad") for run in runs)
    left = searched.open
    if left is None or not len(left):
        if not angles:
            yield (
                "no reference tells the heading: row 3 (heading) is known only through the places that the robot "
                "reached on curves; measure turned angles (kind turn) to know it better"
            )
        return
    signals = searched.start.size // 3
    driven = np.linalg.svd(np.eye(signals) - searched.null.T @ searched.null)
    motions = driven.U[:, driven.S > 0.5].T  # directions of drive signals along which the matrix is searched
    shares = [_share(left, row, motions) for row in range(3)]
    said = np.zeros((0, left.shape[1]))
    if min(shares[2]) > _MOST:
        said = np.vstack([said, *[_element(left, 2, motion) for motion in motions]])
        yield (
            f"no reference tells of turning: row 3 (heading) of the matrix {end}; measure turned angles (kind turn), "
            "headings, or where the robot ends after curves (kind displacement)"
        )
    if min(shares[0]) > _MOST and (not searched.rows[1, 1] or min(shares[1]) > _MOST):
        said = np.vstack([said, *[_element(left, row, motion) for row in (0, 1) for motion in motions]])
        yield (
            f"no reference tells of lengths: rows 1 (x) and 2 (y) of the matrix {_of_several(end)}; "
            "measure distances or displacements"
        )
    turned = _turned(searched)
    if searched.rows[1, 1] and np.linalg.norm(left @ turned) ** 2 > _MOST * float(turned @ turned) > 0:
        said = np.vstack([said, turned])
        yield (
            "no reference tells which way the robot's x axis points: distances, and positions in a frame in which the "
            f"start is not known, are the same for all of them; the direction of x {end}; measure a displacement "
            "from the start"
        )
    rest = len(left) - int(np.linalg.matrix_rank(left @ said.T, tol=0.3)) if len(said) else len(left)
    if rest > 0:
        yield (
            f"{plural(rest, 'further combination' if len(said) else 'combination')} of matrix elements that the "
            f"references tell to worse than 10 % {end if rest == 1 else _of_several(end)}: "
            "drive other motions, or measure more exactly"
        )


def _has(run: Trajectory, unit: str) -> bool:
    return run.references is not None and any(UNITS[kind] == unit for kind in run.references.kinds.tolist())


def _share(left: Array, row: int, motions: Array) -> list[float]:
    """Squared shares of a row's parts along motions (q, M) in the open combinations."""
    return [float(np.square(left @ _element(left, row, motion)).sum()) for motion in motions]


def _element(left: Array, row: int, motion: Array) -> Array:
    """The combination (3M,) of elements that is a row's along a motion (M,)."""
    element = np.zeros((3, len(motion)))
    element[row] = motion
    assert element.size == left.shape[1]
    return element.ravel()


def _turned(searched: MatrixElements) -> Array:
    """The change (3M,) of the elements, in units of their rows' largest, when the robot's frame is turned."""
    design = searched.start.reshape(3, -1)
    change = np.vstack([-design[1], design[0], np.zeros(design.shape[1])]).ravel()
    turned: Array = replace(searched, open=None).projection @ change / searched.units
    return turned
