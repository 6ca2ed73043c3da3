"""Combinations of matrix elements that references other than poses leave open, and that keep the design values.

In units of the largest element of each row, the references have the information A about the elements that may be
fitted. Along an eigenvector with the eigenvalue a their standard deviation is 1/sqrt(a). Where that is larger than the
design's own, the references say nothing that is worth having: distances never tell of turning, and positions
whose frame is not the robot's do not tell which way the robot's x axis points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.fit.observations.reference_batch import ReferenceBatch
from omnibench.fit.observations.reference_rows import reference_rows
from omnibench.fit.parameterisation import MatrixElements, Parameterisation
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration

# Share of a row's largest element: a larger standard deviation tells less than the design does, whose wheels are known
# to 2 % and their common errors to 5 % (shrinkage/prior.py), and two of them and a half reach the box of 25 %.
WORST = 0.10
# Standard deviation, m and rad, for which reference poses count beside the others: that of a first guess (noise.py).
_OF_POSES = 0.01


# Share, squared, of an element in the open directions from which on it counts as open: what 5 % of the design there
# leave of it is then 0.2 % (as _UNIDENTIFIED of uncertainty/physical.py).
_SHARE = 1e-3


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
    information: Array = columns.T @ columns
    return information


def open_directions(searched: MatrixElements, information: Array) -> Array:
    """Directions (q, 3M), orthonormal in units of the rows' largest elements, that an information leaves open."""
    units = searched.units
    basis = np.linalg.svd(searched.projection * units / units[:, None])
    allowed = basis.U[:, basis.S > _SHARE]
    columns = units[:, None] * allowed
    values, vectors = np.linalg.eigh(columns.T @ information @ columns)
    directions: Array = (allowed @ vectors[:, values < WORST**-2.0]).T
    return directions
