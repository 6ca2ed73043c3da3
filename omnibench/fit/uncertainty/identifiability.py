"""Identifiability: how precisely recordings determine a robot's matrix and geometry, before anything is fitted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from omnibench.config import Model
from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.geometry import WheelGeometry, unit_of
from omnibench.fit.least_squares.noise import GIVEN, NoiseEstimate
from omnibench.fit.least_squares.roots import roots_of
from omnibench.fit.linear_fit import linear_fit
from omnibench.fit.observations.open_combinations import information_of_references, with_open_combinations
from omnibench.fit.observations.open_in_words import open_sentences
from omnibench.fit.parameterisation import MatrixElements
from omnibench.fit.shrinkage.prior import default_mount
from omnibench.fit.span import DrivenSpan, State, driven_span, unidentified_directions, wheel_directions
from omnibench.fit.uncertainty.information import information_of_runs, noise_of_matrix
from omnibench.fit.uncertainty.physical import (
    identified_parameters,
    known_slopes,
)
from omnibench.fit.uncertainty.unidentified import open_directions
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration
from omnibench.robot.stored.odometry_of_stored import odometry_of

ROWS = ("x", "y", "heading")
# Standard deviation, as a share of a row's largest element, above which the row counts as rough along a direction:
# calibrations change rows by a few per cent, and the box about the design is +-25 % wide. Half of it and twice say the
# same of three recordings (tests/studies/constants_fit.py).
LARGEST_DEVIATION = 0.10
UNTOLD = 10.0  # the same share from which on references other than poses tell nothing, as other sentences say
_OPEN = 1e-14  # share of the largest eigenvalue of the information: less is rounding, and the direction is open


class DirectionIdentifiability(Model):
    """Precision with which the data determine the matrix along one direction of wheel rates.

    motion: the design robot's motion under these rates (``turning on the spot``; empty: the wheels only slip). share:
    RMS wheel angle along it, relative to the strongest direction. state: driven; weak (so little that slip alone may
    explain it); undriven. deviations: predicted standard deviation of each row (x, y, heading) along the direction, as
    a share of the row's largest element, when every reference pose is used; None where undriven.
    """

    direction: str
    motion: str
    share: float
    state: State
    deviations: tuple[float, float, float] | None


class ParameterIdentifiability(Model):
    """A physical parameter. told: True if the data identify it; deviation: predicted, standard; None if not told."""

    name: str
    unit: str
    design: float
    told: bool
    deviation: float | None


class Identifiability(Model):
    """Predicted precision of a calibration on some runs.

    sentences: what the runs do not determine, in words, and which runs would help.
    """

    directions: tuple[DirectionIdentifiability, ...]
    parameters: tuple[ParameterIdentifiability, ...]
    noise: Noise
    noise_source: str
    sentences: tuple[str, ...]


def identifiability(
    robot: Robot, trajectories: Sequence[Trajectory], integration: Integration = "arc"
) -> Identifiability:
    """Precision with which runs determine the matrix, along every direction of wheel rates, and the wheels' geometry.

    Standard deviations are those of the Cramer-Rao bound: no unbiased estimator has smaller ones, and a model that does
    not fit has larger ones. The noise is estimated from repetitions of commands or, without any, from all residuals of
    a quick linear fit. DataError when there are no trajectories.
    """
    span = driven_span(trajectories)
    estimate, matrix = _quick_noise(robot, trajectories, span, integration)
    posed = [run for run in trajectories if run.has_poses]
    information = information_of_runs(posed, matrix, integration, estimate.noise).sum(axis=0)
    if measured := [run for run in trajectories if run.references is not None]:
        information = information + information_of_references(robot, measured, integration, poses=False)
    rows = robot.row_scales
    every = wheel_directions(robot, span)
    driven = np.array([each.rates for each in every if each.state != "undriven"]).reshape(-1, matrix.shape[1])
    deviations = iter((deviations_along(information, driven) / rows).tolist())
    directions = tuple(
        DirectionIdentifiability(
            direction=each.words,
            motion=each.motion,
            share=each.share,
            state=each.state,
            deviations=None if each.state == "undriven" else tuple(next(deviations)),
        )
        for each in every
    )
    left_open = with_open_combinations(
        MatrixElements(robot, "row", unidentified_directions(robot, span), known_mount=False), trajectories
    ).open
    parameters = _parameters(robot, span, information, left_open)
    return Identifiability(
        directions=directions,
        parameters=parameters,
        noise=estimate.noise,
        noise_source=estimate.description,
        sentences=(
            *open_directions(every),
            *open_sentences(robot, trajectories),
            *_rough_rows(directions),
            *_open_parameters(robot, parameters),
        ),
    )


def _rough_rows(directions: Sequence[DirectionIdentifiability]) -> Iterator[str]:
    """A sentence for every driven direction along which a row is only roughly determined."""
    for direction in directions:
        if direction.state != "driven" or direction.deviations is None:
            continue
        rough = [
            f"row {number} ({name}) to {100 * value:.0f} %"
            for number, (name, value) in enumerate(zip(ROWS, direction.deviations, strict=True), 1)
            if LARGEST_DEVIATION < value < UNTOLD
        ]
        if rough:
            motion = f" ({direction.motion})" if direction.motion else ""
            yield (
                f"of {direction.direction}{motion} the data tell {', '.join(rough)} of the row's largest element "
                "at best (standard deviation): record more or longer runs"
            )


def _open_parameters(robot: Robot, parameters: Sequence[ParameterIdentifiability]) -> Iterator[str]:
    """A sentence about physical parameters that these recordings do not identify, but others could."""
    _, _, directions = np.linalg.svd(robot.inverse_kinematic_matrix)
    ever = identified_parameters(_geometry(robot), directions[len(robot.motions) :])
    missing = [
        parameter.name for parameter, could in zip(parameters, ever, strict=True) if could and not parameter.told
    ]
    if missing:
        yield f"of the wheels' geometry these recordings do not tell {', '.join(missing)}"


def _quick_noise(
    robot: Robot, trajectories: Sequence[Trajectory], span: DrivenSpan, integration: Integration
) -> tuple[NoiseEstimate, Array]:
    """Noise of the poses by a linear fit, and the fit's matrix (3, N). Undriven directions keep the design values."""
    usable = [run for run in trajectories if run.has_poses]
    if not usable and any(run.references is not None for run in trajectories):
        return GIVEN, robot.inverse_kinematic_matrix
    if not usable:
        raise DataError("no trajectory has a reference pose after its start; nothing can be identified")
    odometry = odometry_of([run.reference_log for run in usable], integration)
    reference = np.concatenate([run.poses[1:] for run in usable])
    matrix = linear_fit(odometry, usable, reference, robot.inverse_kinematic_matrix, span.driven)
    return noise_of_matrix(usable, matrix, integration), matrix


def deviations_along(information: Array, directions: Array) -> Array:
    """Standard deviations (q, 3) of the three rows along orthonormal directions (q, N) that are fitted together.

    information (3N, 3N): Fisher information of the matrix elements, row by row.
    """
    basis = np.kron(np.eye(3), directions)
    variances = np.diag(_inverse(basis @ information @ basis.T))
    deviations: Array = np.sqrt(variances).reshape(3, -1).T
    return deviations


def _inverse(information: Array) -> Array:
    """Inverse of an information matrix; huge but finite in directions without information."""
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, _OPEN * max(float(values.max(initial=0.0)), 1e-300))
    inverse: Array = (vectors / values) @ vectors.T
    return inverse


def _geometry(robot: Robot) -> WheelGeometry:
    """The geometry that is fitted by default."""
    return WheelGeometry(robot, fitted_mount=default_mount(robot) == "fit")


def _parameters(
    robot: Robot, span: DrivenSpan, information: Array, left_open: Array | None
) -> tuple[ParameterIdentifiability, ...]:
    """Identifiability of the physical parameters if the matrix is unknown along unidentified directions.

    left_open (q, 3M): combinations of elements that references leave open, and that are unknown, too.
    """
    kept, geometry = unidentified_directions(robot, span), _geometry(robot)
    identified = identified_parameters(geometry, kept, left_open)
    slopes = known_slopes(geometry, kept, left_open)
    deviations = geometry.scale * np.linalg.norm(roots_of(slopes.T @ information @ slopes), axis=1)
    return tuple(
        ParameterIdentifiability(
            name=name,
            unit=unit_of(name),
            design=float(value),
            told=told,
            deviation=float(deviation) if told else None,
        )
        for name, value, told, deviation in zip(geometry.names, geometry.start, identified, deviations, strict=True)
    )
