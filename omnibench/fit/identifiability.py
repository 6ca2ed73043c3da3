"""Identifiability: how precisely recordings determine a robot's matrix and geometry, before anything is fitted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from omnibench.config import Model
from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit import span as spans
from omnibench.fit.geometry import WheelGeometry
from omnibench.fit.linear_fit import linear_fit
from omnibench.fit.noise import GIVEN, roots_of
from omnibench.fit.open_combinations import information_of_references, open_sentences, with_open_combinations
from omnibench.fit.parameterisation import MatrixElements, ParameterisationName
from omnibench.fit.prior import default_mount
from omnibench.fit.trajectory_fit import information_of_runs, noise_of_matrix
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration
from omnibench.robot.physical import unit_of
from omnibench.robot.stored_odometry import odometry_of

# Both are far above the rounding of derivatives (1e-10) and below any share that a direction of wheel rates can have;
# half of each and twice name the same parameters (tests/studies/constants_fit.py).
_UNIDENTIFIED = 1e-3  # share of a parameter's axis in the unidentified space from which on it is not identified
_NO_CHANGE = 1e-6  # share of the largest singular value below which a change of the geometry leaves the matrix as it is
_ROUNDING = 1e-12  # strength of a change, in units of its scale, that is none: nothing of the matrix may be known
# Share of the strongest direction: one that is driven less is mentioned, since slip counts five times as much along it.
# Half of it and twice say the same of three recordings (tests/studies/constants_fit.py).
_LITTLE_SHARE = 0.2
ROWS = ("x", "y", "heading")
# Standard deviation, as a share of a row's largest element, above which the row counts as rough along a direction:
# calibrations change rows by a few per cent, and the box about the design is +-25 % wide. Half of it and twice say the
# same of three recordings (tests/studies/constants_fit.py).
LARGEST_DEVIATION = 0.10
UNTOLD = 10.0  # the same share from which on references other than poses tell nothing, as other sentences say
_OPEN = 1e-14  # share of the largest eigenvalue of the information: less is rounding, and the direction is open


def known_slopes(geometry: WheelGeometry, kept: Array, left_open: Array | None = None) -> Array:
    """Derivatives (3M, n) of the matrix elements by the numbers of a geometry in units of their scale, at the design.

    kept (q, M): directions of drive signals along which the matrix is unknown; the derivatives are 0 there.
    left_open (r, 3M): combinations of elements that are unknown, too, as MatrixElements has them.
    """
    known = MatrixElements(geometry.robot, "row", kept, known_mount=False, open=left_open).projection
    return known @ geometry.slopes(geometry.start) * geometry.scale


def identified_parameters(geometry: WheelGeometry, kept: Array, left_open: Array | None = None) -> tuple[bool, ...]:
    """True (n,) for the numbers that a matrix identifies which is unknown along the directions ``kept`` (q, M).

    left_open (r, 3M): combinations of its elements that are unknown, too, as MatrixElements has them.

    Linearised about the design: a parameter is identified if every change of the geometry that moves it changes the
    known part of the matrix.
    """
    return tuple(bool(share < _UNIDENTIFIED) for share in np.diag(_unseen_changes(geometry, kept, left_open)))


def inseparable_parameters(
    geometry: WheelGeometry, kept: Array, left_open: Array | None = None
) -> tuple[tuple[str, ...], ...]:
    """Groups of numbers that cannot be told apart: a change of one is made up for by the others of its group.

    kept, left_open as for ``identified_parameters``; the numbers that are not identified are those of all groups. A
    group of one is a number of which nothing is known. The changes that are not seen form a space; its projection is
    zero between numbers of different groups.
    """
    projection = _unseen_changes(geometry, kept, left_open)
    left = [index for index, share in enumerate(np.diag(projection)) if share >= _UNIDENTIFIED]
    groups = []
    while left:
        group, reached = [], [left[0]]
        while reached:
            number = reached.pop()
            group.append(number)
            left.remove(number)
            tied = [other for other in left if abs(projection[number, other]) > _UNIDENTIFIED]
            reached += [other for other in tied if other not in reached]
        groups.append(tuple(geometry.names[index] for index in sorted(group)))
    return tuple(groups)


def inseparable_in_words(geometry: WheelGeometry, kept: Array, left_open: Array | None = None) -> Iterator[str]:
    """A sentence for each group of a geometry's numbers that cannot be told apart."""
    for group in inseparable_parameters(geometry, kept, left_open):
        if len(group) == 1:
            yield f"these data say nothing of {group[0]}: it stays where the search left it"
        else:
            yield (
                f"these data cannot tell {', '.join(group[:-1])} and {group[-1]} apart: a change of one is made up for "
                "by the others, so that no such number is known by itself, only what they do together in the motions "
                "that were driven"
            )


def _unseen_changes(geometry: WheelGeometry, kept: Array, left_open: Array | None) -> Array:
    """The projection (n, n) onto changes of a geometry, in units of its scale, that leave the known matrix as it is.

    Linearised about the design.
    """
    rows = np.repeat(geometry.robot.row_scales, len(geometry.robot.drive.names))
    slopes = known_slopes(geometry, kept, left_open) / rows[:, None]
    _, strengths, directions = np.linalg.svd(np.vstack([slopes, np.zeros((slopes.shape[1], slopes.shape[1]))]))
    unidentified = directions[strengths <= max(_NO_CHANGE * strengths[0], _ROUNDING)]
    return unidentified.T @ unidentified


def open_directions(directions: Sequence[spans.WheelDirection]) -> Iterator[str]:
    """A sentence for every direction that the runs drive little or not at all."""
    kept = "calibration keeps the design values there"
    for each in directions:
        words, motion, share = each.words, each.motion, each.share_in_words
        verb = "turn the robot" if motion == "turning on the spot" else motion.replace("moving", "move the robot", 1)
        if each.identified:
            continue
        if each.state == "undriven" and motion:
            yield (
                f"no run drives the wheels along {words} ({motion}): the matrix is not determined along it, "
                f"and {kept}; {_advice(motion)}"
            )
        elif each.state == "undriven":
            alone = len(directions) == 4 and sum(other.state == "undriven" for other in directions) == 1
            expected = ", as for any robot on four wheels that does not slip" if alone else ""
            yield f"no run drives the wheels along {words}{expected}: the matrix is not determined along it, and {kept}"
        elif motion:
            yield (
                f"these recordings hardly {verb}: they drive the wheels along {words} ({motion}) with "
                f"{share}, which slip alone can do; what row 3 (heading) says of it cannot be identified, nor what "
                f"rows 1 (x) and 2 (y) say; {kept}, unless it is told to fit them; {_advice(motion)}"
            )
        else:
            yield f"the wheels go along {words}, which only slips, with {share}: slip cannot be identified, and {kept}"
    for each in directions:
        if each.identified and each.share < _LITTLE_SHARE:
            yield (
                f"the runs drive the wheels along {each.words}{f' ({each.motion})' if each.motion else ''} with only "
                f"{each.share_in_words}: slip counts {1 / each.share:.0f} times as much there"
            )


def _advice(motion: str) -> str:
    """The recordings that would identify a motion, as an imperative."""
    if motion == "turning on the spot":
        return "record turns, on the spot or while driving"
    return "record other motions, too" if "while" in motion else f"record runs {motion.removeprefix('moving ')}"


def kept_motions(
    robot: Robot, span: spans.DrivenSpan, parameterisation: ParameterisationName, treatment: spans.Treatment
) -> tuple[spans.WheelDirection, ...]:
    """Motions that runs with this span do not identify, of which a calibration keeps the design values."""
    if parameterisation == "geometry" or treatment == "weigh":
        return ()
    directions = spans.wheel_directions(robot, span)
    open_ones = (each for each in directions if not each.identified and each.motion)
    return tuple(each for each in open_ones if not (each.state == "weak" and treatment == "fit"))


def warnings_of_calibration(
    robot: Robot, span: spans.DrivenSpan, parameterisation: ParameterisationName, treatment: spans.Treatment
) -> tuple[str, ...]:
    """A sentence for every direction that runs with this span do not identify, and how a calibration treats it."""
    sentences = []
    for each in spans.wheel_directions(robot, span):
        if each.identified or not each.motion:  # where the wheels only slip, no motion of the robot depends on it
            continue
        subject = f"{each.words} ({each.motion}) do"
        if each.state == "weak":
            subject += f": {each.share_in_words}, which slip alone can make"
        if parameterisation == "geometry":
            end = "the geometry cannot keep design values there, so what was fitted to it rests on slip and noise"
        elif treatment == "weigh":
            end = "there the matrix is known by the design and its tolerance"
        elif each.state == "weak" and treatment == "fit":
            end = "what was fitted there rests on slip and noise"
        else:
            end = "kept at the design values"
        sentences.append(f"these data do not identify what wheel rates along {subject}; {end}")
    return tuple(sentences)


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
    state: spans.State
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
    robot: Robot,
    trajectories: Sequence[Trajectory],
    integration: Integration = "arc",
    *,
    span: spans.DrivenSpan | None = None,
) -> Identifiability:
    """Precision with which runs determine the matrix, along every direction of wheel rates, and the wheels' geometry.

    Standard deviations are those of the Cramer-Rao bound: no unbiased estimator has smaller ones, and a model that does
    not fit has larger ones. The noise is estimated from repetitions of commands or, without any, from all residuals of
    a quick linear fit. span: what the runs drive; default: computed here. DataError when there are no trajectories.
    """
    span = span or spans.driven_span(trajectories)
    # Noise of the poses by a linear fit, in which undriven directions keep the design values.
    posed = [run for run in trajectories if run.has_poses]
    noise, matrix = GIVEN, robot.inverse_kinematic_matrix
    if posed:
        odometry = odometry_of([run.reference_log for run in posed], integration)
        matrix = linear_fit(odometry, posed, np.concatenate([run.poses[1:] for run in posed]), matrix, span.driven)
        noise = noise_of_matrix(posed, matrix, integration)
    elif all(run.references is None for run in trajectories):
        raise DataError("no trajectory has a reference pose after its start; nothing can be identified")
    information = information_of_runs(posed, matrix, integration, noise.noise).sum(axis=0)
    if measured := [run for run in trajectories if run.references is not None]:
        information = information + information_of_references(robot, measured, integration, poses=False)
    rows = robot.row_scales
    every = spans.wheel_directions(robot, span)
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
    # The physical parameters, the matrix being unknown along unidentified directions and open combinations.
    kept = spans.unidentified_directions(robot, span)
    geometry = WheelGeometry(robot, fitted_mount=default_mount(robot) == "fit")
    left_open = with_open_combinations(MatrixElements(robot, "row", kept, known_mount=False), trajectories).open
    told = identified_parameters(geometry, kept, left_open)
    slopes = known_slopes(geometry, kept, left_open)
    of_parameters = geometry.scale * np.linalg.norm(roots_of(slopes.T @ information @ slopes), axis=1)
    parameters = tuple(
        ParameterIdentifiability(
            name=name, unit=unit_of(name), design=float(value), told=told, deviation=float(deviation) if told else None
        )
        for name, value, told, deviation in zip(geometry.names, geometry.start, told, of_parameters, strict=True)
    )
    # Parameters that these recordings do not identify, but others could.
    _, _, spanned = np.linalg.svd(robot.inverse_kinematic_matrix)
    ever = identified_parameters(geometry, spanned[len(robot.motions) :])
    missing = [each.name for each, could in zip(parameters, ever, strict=True) if could and not each.told]
    return Identifiability(
        directions=directions,
        parameters=parameters,
        noise=noise.noise,
        noise_source=noise.description,
        sentences=(
            *open_directions(every),
            *open_sentences(robot, trajectories, span=span),
            *_rough_rows(directions),
            *([f"of the wheels' geometry these recordings do not tell {', '.join(missing)}"] if missing else []),
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


def deviations_along(information: Array, directions: Array) -> Array:
    """Standard deviations (q, 3) of the three rows along orthonormal directions (q, N) that are fitted together.

    information (3N, 3N): Fisher information of the matrix elements, row by row.
    """
    basis = np.kron(np.eye(3), directions)
    # Inverse of an information matrix; huge but finite in directions without information
    values, vectors = np.linalg.eigh(basis @ information @ basis.T)
    values = np.maximum(values, _OPEN * max(float(values.max(initial=0.0)), 1e-300))
    return np.sqrt(np.diag((vectors / values) @ vectors.T)).reshape(3, -1).T
