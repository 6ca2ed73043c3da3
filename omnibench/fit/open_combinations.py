"""Combinations of matrix elements that references other than poses leave open, and that keep the design values.

In units of the largest element of each row, the references have the information A about the elements that may be
fitted. Along an eigenvector with the eigenvalue a their standard deviation is 1/sqrt(a). Where that is larger than the
design's own, the references say nothing that is worth having: distances never tell of turning, and positions
whose frame is not the robot's do not tell which way the robot's x axis points.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.fit.geometry import Parameterisation
from omnibench.fit.parameterisation import MatrixElements
from omnibench.fit.prior import MountChoice, default_mount
from omnibench.fit.reference_rows import ReferenceBatch, measured_parts, reference_rows
from omnibench.fit.span import DrivenSpan, Treatment, directions_kept, driven_span
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration
from omnibench.words import plural

# Share of a row's largest element: a larger standard deviation tells less than the design does, whose wheels are known
# to 2 % and their common errors to 5 % (fit/prior.py), and two of them and a half reach the box of 25 %.
WORST = 0.10
# Standard deviation, m and rad, for which reference poses count beside the others: that of a first guess (noise.py).
_OF_POSES = 0.01
# Share, squared, of an element in the open directions from which on it counts as open: what 5 % of the design there
# leave of it is then 0.2 % (as _UNIDENTIFIED of fit/identifiability.py).
_SHARE = 1e-3
_MOST = 0.9  # share, squared, of a motion's part in the open combinations from which on it is called open; chosen


def with_open_combinations(searched: MatrixElements, runs: Sequence[Trajectory]) -> MatrixElements:
    """The elements, less the combinations that the runs' references leave open; as they are where all have poses."""
    if all(run.references is None for run in runs):
        return searched
    directions = open_directions(searched, information_of_references(searched.robot, runs))
    return replace(searched, open=directions)


def elements_open(searched: Parameterisation) -> NDArray[np.bool_]:
    """True (3M,) for the matrix elements that depend on a combination which is left open and keeps the design."""
    if not isinstance(searched, MatrixElements) or searched.open is None:
        return np.zeros(searched.slopes(searched.start).shape[0], dtype=bool)
    return np.asarray(np.square(searched.open).sum(axis=0) > _SHARE)


def information_of_references(
    robot: Robot, runs: Sequence[Trajectory], integration: Integration = "arc", *, poses: bool = True
) -> Array:
    """Information (3M, 3M) of the references of some runs about the elements at the design; poses: of these, too."""
    rows = reference_rows(runs, "reference" if poses else "none")
    sigmas = np.where(rows.of_references[:, None], rows.whole_sigmas, _OF_POSES)
    weights = np.where(rows.measured, 1 / np.nan_to_num(sigmas, nan=1.0), 0.0)
    design = robot.inverse_kinematic_matrix
    jacobian = ReferenceBatch(rows, integration).jacobian(design).reshape(len(rows.trajectory), 3, -1)
    columns = (jacobian * weights[..., None]).reshape(-1, design.size)
    return columns.T @ columns


def open_directions(searched: MatrixElements, information: Array) -> Array:
    """Directions (q, 3M), orthonormal in units of the rows' largest elements, that an information leaves open."""
    units = searched.units
    basis = np.linalg.svd(searched.projection * units / units[:, None])
    allowed = basis.U[:, basis.S > _SHARE]
    columns = units[:, None] * allowed
    values, vectors = np.linalg.eigh(columns.T @ information @ columns)
    return (allowed @ vectors[:, values < WORST**-2.0]).T


def open_sentences(
    robot: Robot,
    runs: Sequence[Trajectory],
    treatment: Treatment = "keep",
    mount: MountChoice | None = None,
    *,
    span: DrivenSpan | None = None,
) -> tuple[str, ...]:
    """A sentence for each part of the matrix that the runs' references leave open; none where all runs have poses."""
    if all(run.references is None for run in runs):
        return ()
    kept = directions_kept(robot, span or driven_span(runs), treatment)
    searched = MatrixElements(robot, "row", kept, (mount or default_mount(robot)) == "known")
    searched = with_open_combinations(searched, runs)
    weighed = treatment == "weigh"
    one = "rests on the design and its tolerance" if weighed else "keeps the design values"
    several = "rest on the design and its tolerance" if weighed else "keep the design values"
    return tuple(_sentences(searched, runs, one, several))


def _sentences(searched: MatrixElements, runs: Sequence[Trajectory], one: str, several: str) -> Iterator[str]:
    left = searched.open
    if left is None or not len(left):
        if not measured_parts(runs)[1].any():
            yield (
                "no reference tells the heading: row 3 (heading) is known only through the places that the robot "
                "reached on curves; measure turned angles (kind turn) to know it better"
            )
        return
    signals = searched.start.size // 3
    driven = np.linalg.svd(np.eye(signals) - searched.null.T @ searched.null)
    motions = driven.U[:, driven.S > 0.5].T  # directions of drive signals along which the matrix is searched
    # The combinations (3, q, 3M) of elements that are a row's along the motions, and their squared shares (3, q).
    parts = np.einsum("rs,qm->rqsm", np.eye(3), motions).reshape(3, len(motions), -1)
    shares = [[float(np.square(left @ part).sum()) for part in of_row] for of_row in parts]
    said = np.zeros((0, left.shape[1]))
    if min(shares[2]) > _MOST:
        said = np.vstack([said, parts[2]])
        yield (
            f"no reference tells of turning: row 3 (heading) of the matrix {one}; measure turned angles (kind turn), "
            "headings, or where the robot ends after curves (kind displacement)"
        )
    if min(shares[0]) > _MOST and (not searched.rows[1, 1] or min(shares[1]) > _MOST):
        said = np.vstack([said, parts[0], parts[1]])
        yield (
            f"no reference tells of lengths: rows 1 (x) and 2 (y) of the matrix {several}; "
            "measure distances or displacements"
        )
    # The change (3M,) of the elements, in units of their rows' largest, when the robot's frame is turned
    design = searched.start.reshape(3, -1)
    change = np.vstack([-design[1], design[0], np.zeros(design.shape[1])]).ravel()
    turned: Array = replace(searched, open=None).projection @ change / searched.units
    if searched.rows[1, 1] and np.linalg.norm(left @ turned) ** 2 > _MOST * float(turned @ turned) > 0:
        said = np.vstack([said, turned])
        yield (
            "no reference tells which way the robot's x axis points: distances, and positions in a frame in which the "
            f"start is not known, are the same for all of them; the direction of x {one}; measure a displacement "
            "from the start"
        )
    rest = len(left) - int(np.linalg.matrix_rank(left @ said.T, tol=0.3)) if len(said) else len(left)
    if rest > 0:
        yield (
            f"{plural(rest, 'further combination' if len(said) else 'combination')} of matrix elements that the "
            f"references tell to worse than 10 % {one if rest == 1 else several}: "
            "drive other motions, or measure more exactly"
        )
