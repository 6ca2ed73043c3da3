"""Errors of a model at references other than poses: by run, and by kind."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.data.references.run_references import KINDS, UNITS, ReferenceKind
from omnibench.fit.observations.reference_batch import ReferenceBatch, predicted_by
from omnibench.fit.observations.reference_rows import ReferenceRows, reference_rows
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration


def with_mean_errors(errors: Array, matrix: Array, runs: Sequence[Trajectory], integration: Integration) -> Array:
    """Final pose errors (Z, 3) of a matrix, those of runs without poses replaced by their ``mean_errors``."""
    for index, run in enumerate(runs):
        if not run.has_poses and run.references is not None:
            rows = reference_rows([run], "none")
            errors[index] = _means(rows, ReferenceBatch(rows, integration).poses(matrix[None])[0] - rows.observed)
    return errors


def mean_errors(model: OdometryModel, run: Trajectory) -> Array:
    """Mean error (3,) of a model at the lengths and places of a run (m), 0, and at its angles (rad); 0 of none."""
    rows = reference_rows([run], "none")
    return _means(rows, predicted_by(model, rows) - rows.observed)


def _means(rows: ReferenceRows, errors: Array) -> Array:
    placed, turned = rows.lengths != "", rows.angles != ""
    lengths = np.linalg.norm(errors[placed, :2], axis=1)
    return np.array(
        [lengths.mean() if placed.any() else 0.0, 0.0, np.abs(errors[turned, 2]).mean() if turned.any() else 0.0]
    )


def measured_parts(runs: Sequence[Trajectory]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """True (Z,) for runs of which a length or place was measured, and (Z,) for those of which an angle was."""
    units = [
        {"m", "rad"}
        if run.has_poses or run.references is None
        else {UNITS[kind] for kind in run.references.kinds.tolist()}
        for run in runs
    ]
    return np.array(["m" in of_run for of_run in units]), np.array(["rad" in of_run for of_run in units])


def errors_by_kind(model: OdometryModel, runs: Sequence[Trajectory]) -> dict[ReferenceKind, Array]:
    """Magnitudes (n, 2) of a model's errors at the references of each kind: m or rad, and in sigmas."""
    measured = [run for run in runs if run.references is not None]
    if not measured:
        return {}
    rows = reference_rows(measured, "none")
    errors = predicted_by(model, rows) - rows.observed
    ratios = np.square(errors / np.where(rows.measured, rows.whole_sigmas, np.inf))
    found: dict[ReferenceKind, Array] = {}
    for kind in KINDS:
        own = rows.kinds_in(kind)
        if not own.any():
            continue
        part = slice(2, 3) if UNITS[kind] == "rad" else slice(0, 2)
        size = np.linalg.norm(errors[own][:, part], axis=1)
        counts = rows.measured[own][:, part].sum(axis=1)
        found[kind] = np.column_stack([size, np.sqrt(ratios[own][:, part].sum(axis=1) / counts)])
    return found
