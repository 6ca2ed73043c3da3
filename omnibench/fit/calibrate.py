"""Calibration of one robot from one data set, with one calibrator."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from omnibench.config import validate
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.splits import training_split
from omnibench.environment import package_versions
from omnibench.errors import ConfigError, computable, require_type
from omnibench.fit.bootstrap import ElementIntervals, bootstrap_intervals
from omnibench.fit.calibrator import Calibrator, RunResult, as_answered, calibration_of_fit, run_calibrator
from omnibench.fit.evaluate import verdict_on
from omnibench.fit.geometry import FittedParameter, WheelGeometry, fitted_parameters
from omnibench.fit.identifiability import inseparable_in_words, kept_motions, warnings_of_calibration
from omnibench.fit.open_combinations import open_sentences
from omnibench.fit.prior import default_cost, default_mount, default_unidentified
from omnibench.fit.problem import CalibrationProblem, make_problem
from omnibench.fit.ratio_intervals import FEWEST, Units, units_of
from omnibench.fit.settings import CompleteSettings, CostChoice, FitSettings
from omnibench.fit.shrinkage import shrunk
from omnibench.fit.span import WheelDirection
from omnibench.fit.steering_fit import corrected_runs, fit_steering, on_bounds, words_of
from omnibench.fit.uncertainty import NoCovarianceError, Uncertainty, uncertainty_of
from omnibench.jobs.job import Backend
from omnibench.progress import Reporter, no_progress, renamed
from omnibench.registry import calibrators, costs
from omnibench.robot.calibration import Calibration, EffectTerm, ModelExtension, covariance_rows, extended_model
from omnibench.robot.effects.effect import Term
from omnibench.robot.kinematics import Robot
from omnibench.views import Shown


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationRun(Shown):
    """A calibration, the calibrator's result and, where asked for, resampled 95 % intervals of the elements.

    parameters: radius, distance and angle of each wheel, if these were searched. uncertainty: covariance of the
    elements and of the physical parameters; None if there is none, then a warning says why. warnings: one sentence for
    every part of the calibration that the data do not determine. kept: motions that keep the design values; intervals
    hold only if these are right. units: what these resample.
    """

    calibration: Calibration
    result: RunResult
    intervals: ElementIntervals | None
    parameters: tuple[FittedParameter, ...] | None
    uncertainty: Uncertainty | None
    warnings: tuple[str, ...]
    kept: tuple[WheelDirection, ...]
    units: Units

    @property
    def untouched(self) -> tuple[str, ...]:
        """Names of the numbers that the box or the cost kept at the design: not those that are 0 for every such robot.

        Row 2 of a robot that its fixed wheels keep from moving sideways is 0 by design, and nothing there is to fit.
        """
        sideways = self.calibration.robot.slides or any(self.calibration.matrix[1])
        return tuple(name for name in self.result.held if sideways or not name.startswith("m2"))


@computable
def calibrate(
    dataset: Dataset,
    settings: FitSettings | str | None = None,
    *,
    watch: Reporter = no_progress,
    backend: Backend | None = None,
    **choices: Any,
) -> CalibrationRun:
    """Fit the odometry model of a data set's training split.

    settings: every choice of the fit, or the name of a calibrator. choices: fields of FitSettings by their names, in
    the place of those of ``settings`` (calibrator, options, cost, loss, parameterisation, box, limits, integration,
    budget, seed, intervals, unidentified, tolerance, mount, steering).
    watch: told the evaluations and the best cost so far, at most every 0.1 s. backend: solves the resamples of
    ``intervals`` as jobs; default: this process.

    calibrator: default closed_form, or trajectory_ml where training runs have references other than poses, each of
    which it weighs by its own uncertainty.
    loss: how pose errors are weighted in the fit (see fit/loss.py). squares: as the calibrator weights them; huber,
    student_t: poses that are far off have a bounded influence.
    intervals: also draw resampled intervals about the optimum (closed_form only). A warning says so if there are fewer
    than three commands to draw from (runs, where none is repeated).
    unidentified: what is done about motions that the data drive so little that slip alone may explain them, which the
    run's warnings name. ``keep``: the matrix has the design values there; ``fit``: it is fitted there, too (see
    make_parameterisation); ``shrink``: as ``keep``, and the other elements move towards the design, the more the less
    the data determine them (see shrinkage.py). tolerance: how far a design may be off, for ``shrink``.
    mount: pose of the tracked point of a robot that cannot slide: ``known``, as the robot's file says, or ``fit``.
    Cost, unidentified and mount have defaults that depend on the robot (see prior.py).
    steering: ``fit``: gain, play and coupling of the steering, and a car's zero, are fitted before the matrix (see
    steering_fit.py) and are effects of the calibration; ``known``: the measured angles are right.

    Raises UnknownNameError or ConfigError for wrong choices, DataError for an empty training split, and ConfigError
    when the calibrator gives no answer.

    >>> run = calibrate(dataset, cost="trajectory")
    >>> run.calibration.matrix_array.shape, run.result.outcome.value  # (3, M), m and rad per rad of wheel
    ((3, 2), 'converged')
    """
    require_type(dataset, Dataset, "load_dataset")
    robot, training = dataset.robot, training_split(dataset)

    # The choices, with what is usual for this robot and these runs.
    chosen, calibrator = complete_settings(_with_choices(settings, choices), robot, training)

    # The steering first, where it is to be fitted: the matrix is then fitted to the corrected drive signals.
    terms: tuple[Term, ...] = ()
    runs: Sequence[Trajectory] = training
    if chosen.steering == "fit":
        terms = fit_steering(chosen, robot, training, dataset.sample_period, watch)
        runs = corrected_runs(robot, training, terms, dataset.sample_period)

    # The answer, shrunk to the design where that is asked for.
    problem = make_problem(chosen, robot, runs, renamed(watch, calibrator.name))
    result = shrunk(problem, run_calibrator(calibrator, problem), fitted=calibrator.fitted)
    if result.matrix is None or result.vector is None:
        raise ConfigError(f"calibrator {calibrator.name!r} gave no answer ({result.outcome}): {result.reason}")

    # How sure it is.
    uncertainty, without_covariance = None, ""
    if calibrator.fitted:
        try:
            uncertainty = uncertainty_of(problem, result)
        except NoCovarianceError as error:
            without_covariance = str(error)
    units = units_of(training)
    drawn = None
    if chosen.intervals and units.count >= FEWEST and uncertainty:
        drawn = bootstrap_intervals(problem, result.vector, units=units, rng=problem.rng, backend=backend)

    # The calibration file, and what the data leave open.
    searched = problem.parameterisation
    return CalibrationRun(
        calibration=_calibration(dataset, chosen, problem, result, terms, uncertainty),
        result=result,
        intervals=drawn,
        parameters=fitted_parameters(searched, result.vector) if isinstance(searched, WheelGeometry) else None,
        uncertainty=uncertainty,
        warnings=tuple(_warnings(chosen, calibrator, problem, runs, terms, units, without_covariance)),
        kept=kept_motions(robot, problem.span, searched.name, chosen.unidentified),
        units=units,
    )


def default_calibrator(training: Sequence[Trajectory]) -> str:
    """The calibrator where none is given: the one that weighs references by their uncertainty, if there are some."""
    return "closed_form" if all(run.references is None for run in training) else "trajectory_ml"


def _with_choices(settings: FitSettings | str | None, choices: dict[str, Any]) -> FitSettings:
    """Settings, or those of a calibrator by its name, in which choices that are not None replace the fields they name.

    ConfigError: a choice is unknown, or its value is wrong.
    """
    if isinstance(settings, FitSettings):
        choices = dict(settings) | choices
    elif settings is not None:
        choices = {"calibrator": settings} | choices
    return validate(FitSettings, {name: value for name, value in choices.items() if value is not None}, "calibrate")


def complete_settings(
    settings: FitSettings, robot: Robot, training: Sequence[Trajectory]
) -> tuple[CompleteSettings, Calibrator]:
    """Settings completed by what is usual for a robot and its runs, and their calibrator.

    UnknownNameError or ConfigError: a name is unknown, or two choices contradict each other.
    """
    name = settings.calibrator or default_calibrator(training)
    calibrator: Calibrator = calibrators.create(name, settings.options)
    choice = settings.cost or CostChoice(name=default_cost(robot, len(training)))
    costs.create(choice.name, choice.options)
    unidentified = settings.unidentified or default_unidentified(robot)
    unidentified, mount = as_answered(calibrator, unidentified, settings.mount)
    if settings.intervals and not calibrator.exact:
        raise ConfigError("intervals are drawn about a minimum to rounding: use the calibrator closed_form")
    if settings.intervals and settings.loss != "squares":
        raise ConfigError(
            "resampled intervals are drawn about the minimum of a sum of norms: leave out the loss "
            f"{settings.loss}, or the resampling, since a calibration has other intervals, too"
        )
    if settings.intervals and unidentified == "shrink":
        raise ConfigError(
            "resampled intervals are drawn about a minimum, which a shrunk answer is not: set unidentified to keep; a "
            "shrunk answer has intervals of its own"
        )
    if settings.tolerance is not None and unidentified != "shrink":
        raise ConfigError(f"tolerance is of the design, for unidentified: shrink, and unidentified is {unidentified}")
    if settings.steering == "fit" and calibrator.extends:
        raise ConfigError(f"calibrator {name!r} adds effects of its own; leave out steering: fit, or take another")
    complete = {
        "calibrator": name,
        "options": calibrator.options.model_dump(mode="json"),
        "cost": choice,
        "parameterisation": settings.parameterisation or calibrator.parameterisation,
        "unidentified": unidentified,
        "mount": mount,
    }
    return CompleteSettings(**(dict(settings) | complete)), calibrator


def _calibration(
    dataset: Dataset,
    settings: CompleteSettings,
    problem: CalibrationProblem,
    result: RunResult,
    terms: tuple[Term, ...],
    uncertainty: Uncertainty | None,
) -> Calibration:
    """The calibration of an answer, with how it came about. The costs in the file are without a loss."""
    assert result.matrix is not None  # there is an answer
    robot, training, validation = dataset.robot, dataset.split("train"), dataset.split("validation")
    extension = result.extension or ModelExtension(effects=tuple(map(EffectTerm.of, terms)))
    covariance = covariance_rows(uncertainty.covariance) if uncertainty and not terms else None
    model = extended_model(robot, result.matrix, problem.integration, dataset.sample_period, extension)
    noise = uncertainty.noise if uncertainty else result.noise
    squares = settings.loss == "squares"
    cost = costs.create(settings.cost.name, settings.cost.options)
    provenance = settings.provenance | {
        "box": problem.box,
        "unidentified": settings.unidentified,
        "tolerance": settings.tolerance,
        "mount": None if robot.slides else settings.mount or default_mount(robot),
        "unshrunk_cost": result.shrinkage.unshrunk_cost if result.shrinkage and squares else None,
        "on_bounds": result.at_bounds,
        "versions": package_versions(),
        "training_cost": result.cost if squares else cost.of_model(model, training),
        "validation_cost": cost.of_model(model, validation) if validation else None,
        "outcome": result.outcome,
        "reason": result.reason,
        "held_out": verdict_on(model, training, validation),
    }
    return calibration_of_fit(
        f"{dataset.name} {settings.calibrator}",
        dataset,
        result.matrix,
        provenance,
        integration=problem.integration,
        noise=noise if any(run.has_poses for run in problem.trajectories) else None,
        **dict(extension) | {"covariance": extension.covariance or covariance},
    )


def _warnings(
    settings: CompleteSettings,
    calibrator: Calibrator,
    problem: CalibrationProblem,
    runs: Sequence[Trajectory],
    terms: Sequence[Term],
    units: Units,
    without_covariance: str,
) -> Iterator[str]:
    """Sentences on what the data leave open, and on what the fit assumes.

    without_covariance: why the calibration has no covariance; empty for one that has.
    """
    robot, searched = problem.robot, problem.parameterisation
    yield from warnings_of_calibration(robot, problem.span, searched.name, settings.unidentified)
    yield from open_sentences(robot, runs, settings.unidentified, settings.mount, span=problem.span)
    if isinstance(searched, WheelGeometry) and calibrator.fitted:
        yield from inseparable_in_words(searched, problem.unidentified, problem.left_open)
    yield from problem.moved_ends
    if without_covariance:
        yield without_covariance
    if terms:
        yield (
            f"the steering was fitted first ({words_of(terms)}); the matrix's intervals take these numbers for exact, "
            "and the file has no covariance"
        )
    for number in on_bounds(robot, terms) if terms else ():
        yield (
            f"{number} lies on the bound of what is searched, so that these runs hardly tell it, or it stands for "
            "something else; take the fit only for drives that steer as these do"
        )
    if settings.intervals and units.count < FEWEST:
        yield f"no resampled intervals: {units.words}; {FEWEST} are needed"
