"""What recordings can tell of a robot before anything is fitted: of which motions, how well, and what stays open."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from omnibench.config import Model
from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.least_squares.noise import NoiseEstimate, estimate_noise
from omnibench.fit.parameterisation import WheelGeometry
from omnibench.fit.span import (
    DrivenSpan,
    State,
    aligned,
    direction_in_words,
    driven_span,
    motion_in_words,
    unidentified_directions,
)
from omnibench.fit.uncertainty.information import information_of_runs
from omnibench.fit.uncertainty.physical import (
    matrix_slopes,
    parameter_scale,
    told_parameters,
    unit_of,
)
from omnibench.fit.uncertainty.unidentified import open_directions
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration, OdometryBatch

ROWS = ("x", "y", "heading")
# A row that the data tell no better than this along a direction is not told: calibrations are about a few per cent,
# and the box about the design is +-25 % wide.
LARGEST_DEVIATION = 0.10


class DirectionIdentifiability(Model):
    """What the data tell of the matrix along one direction of wheel rates.

    motion: what the designed robot does there (``turning on the spot``; empty: the wheels only slip). share: how much
    it is driven, RMS, of the most driven direction. state: driven; weak (driven so little that slip alone may have
    done it); undriven. deviations: the predicted standard deviation of each row (x, y, heading) along the direction, as
    a share of the row's largest element, when every reference pose is used; None where undriven.
    """

    direction: str
    motion: str
    share: float
    state: State
    deviations: tuple[float, float, float] | None


class ParameterIdentifiability(Model):
    """Whether the data tell a physical parameter by itself, and the standard deviation (its unit) to be expected.

    deviation: None where it is not told.
    """

    name: str
    unit: str
    design: float
    told: bool
    deviation: float | None


class Identifiability(Model):
    """What can be told from some runs, predicted at the design or at a quick linear fit.

    sentences: what cannot be told, in words, and which runs would help.
    """

    directions: tuple[DirectionIdentifiability, ...]
    parameters: tuple[ParameterIdentifiability, ...]
    noise: Noise
    noise_source: str
    sentences: tuple[str, ...]


def identifiability(
    robot: Robot, trajectories: Sequence[Trajectory], integration: Integration = "arc"
) -> Identifiability:
    """What the runs tell of the matrix, along every direction of wheel rates, and of the wheels' geometry.

    Standard deviations are those of the Cramer-Rao bound: no estimator without bias has smaller ones. The noise is what
    the repetitions of commands show, or, where none is repeated, all that a quick linear fit leaves. A model that does
    not fit adds to them. DataError when there are no trajectories.
    """
    span = driven_span(trajectories)
    estimate, matrix = _quick_noise(robot, trajectories, span, integration)
    information = information_of_runs(trajectories, matrix, integration, estimate.noise).sum(axis=0)
    rows = np.abs(robot.inverse_kinematic_matrix).max(axis=1)
    found = np.concatenate([aligned(span.strong, robot), unidentified_directions(robot, span)])
    driven = found[[span.state(direction) != "undriven" for direction in found]]
    deviations = iter(_deviations(information, driven) / rows)
    directions = tuple(_direction(robot, span, direction, deviations) for direction in found)
    parameters = _parameters(robot, span, information)
    return Identifiability(
        directions=directions,
        parameters=parameters,
        noise=estimate.noise,
        noise_source=estimate.description,
        sentences=(
            *open_directions(robot, span),
            *_rough_rows(directions),
            *_open_parameters(robot, parameters),
        ),
    )


def _rough_rows(directions: Sequence[DirectionIdentifiability]) -> Iterator[str]:
    """A sentence for every direction that is driven, and yet told badly."""
    for each in directions:
        if each.state != "driven" or each.deviations is None:
            continue
        rough = [
            f"row {number} ({name}) to {100 * value:.0f} %"
            for number, (name, value) in enumerate(zip(ROWS, each.deviations, strict=True), 1)
            if value > LARGEST_DEVIATION
        ]
        if rough:
            motion = f" ({each.motion})" if each.motion else ""
            yield (
                f"of {each.direction}{motion} the data tell {', '.join(rough)} of the row's largest element at best "
                "(standard deviation): record more or longer runs"
            )


def _open_parameters(robot: Robot, parameters: Sequence[ParameterIdentifiability]) -> Iterator[str]:
    """A sentence about physical parameters that other recordings would tell."""
    _, _, directions = np.linalg.svd(robot.inverse_kinematic_matrix)
    ever = told_parameters(robot, directions[3:])
    untold = [each.name for each, could in zip(parameters, ever, strict=True) if could and not each.told]
    if untold:
        yield f"of the wheels' geometry these recordings do not tell {', '.join(untold)}"


def _quick_noise(
    robot: Robot, trajectories: Sequence[Trajectory], span: DrivenSpan, integration: Integration
) -> tuple[NoiseEstimate, Array]:
    """The noise of the poses by a linear fit, and the fit's matrix (3, N).

    Headings are linear in row 3; positions, with the headings of the reference, in rows 1 and 2. Directions that are
    not driven keep the design values.
    """
    usable = [run for run in trajectories if len(run.pose_times) > 1]
    if not usable:
        raise DataError("no trajectory has a reference pose after its start; nothing can be identified")
    design = robot.inverse_kinematic_matrix
    batch = OdometryBatch([run.reference_log for run in usable], integration)
    moved = np.concatenate([run.poses[1:] - run.poses[0] for run in usable])
    basis = span.driven.T
    headings = [np.interp(np.append(0.0, run.times[:-1]), run.pose_times, run.poses[:, 2]) for run in usable]
    matrix = design.copy()
    matrix[2] += basis @ np.linalg.lstsq(batch.driven @ basis, moved[:, 2] - batch.driven @ design[2], rcond=None)[0]
    columns = batch.position_design(headings)
    missing = moved[:, 0] + 1j * moved[:, 1] - columns @ (design[0] + 1j * design[1])
    change = basis @ np.linalg.lstsq(columns @ basis, missing, rcond=None)[0]
    matrix[0] += change.real
    matrix[1] += change.imag
    poses = batch.poses(matrix[None])[0]
    residuals = np.split(
        poses - np.concatenate([run.poses[1:] for run in usable]),
        np.cumsum([len(run.poses) - 1 for run in usable])[:-1],
    )
    return estimate_noise(usable, residuals), matrix


def _deviations(information: Array, driven: Array) -> Array:
    """Standard deviations (q, 3) of the rows along orthonormal directions (q, N) that are fitted together."""
    basis = np.kron(np.eye(3), driven)
    variances = np.diag(_inverse(basis @ information @ basis.T))
    deviations: Array = np.sqrt(variances).reshape(3, -1).T
    return deviations


def _inverse(information: Array) -> Array:
    """The inverse of an information matrix; enormous, not infinite, where nothing is known."""
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 1e-14 * max(float(values.max(initial=0.0)), 1e-300))
    inverse: Array = (vectors / values) @ vectors.T
    return inverse


def _direction(
    robot: Robot, span: DrivenSpan, direction: Array, deviations: Iterator[Array]
) -> DirectionIdentifiability:
    """One direction; if it is driven the next deviations (3,) are its own."""
    state = span.state(direction)
    own: tuple[float, float, float] | None = None
    if state != "undriven":
        x, y, heading = map(float, next(deviations))
        own = x, y, heading
    return DirectionIdentifiability(
        direction=direction_in_words(direction, robot.wheel_names),
        motion=motion_in_words(direction, robot),
        share=span.share(direction),
        state=state,
        deviations=own,
    )


def _parameters(robot: Robot, span: DrivenSpan, information: Array) -> tuple[ParameterIdentifiability, ...]:
    """The physical parameters, as the identified directions tell them, the rest of the matrix being unknown."""
    kept = unidentified_directions(robot, span)
    told = told_parameters(robot, kept)
    design = WheelGeometry(robot).start
    known = np.kron(np.eye(3), np.eye(kept.shape[1]) - kept.T @ kept)
    unit = parameter_scale(design)
    slopes = known @ matrix_slopes(robot, design) * unit
    covariance = np.linalg.pinv(slopes.T @ information @ slopes, rcond=1e-12, hermitian=True)
    deviations = unit * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return tuple(
        ParameterIdentifiability(
            name=name,
            unit=unit_of(name),
            design=float(value),
            told=tells,
            deviation=float(deviation) if tells else None,
        )
        for name, value, tells, deviation in zip(WheelGeometry(robot).names, design, told, deviations, strict=True)
    )
