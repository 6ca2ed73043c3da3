"""Calibration of one robot from one data set, with one calibrator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from omnibench.config import validate
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.splits import training_split
from omnibench.environment import package_versions
from omnibench.errors import ConfigError, computable, require_type
from omnibench.fit.calibrator import Calibrator, RunResult, as_answered, calibration_of_fit, run_calibrator
from omnibench.fit.estimate import Nuisances, corrected_runs, estimate_with_steering, usual_problem
from omnibench.fit.evaluate import verdict_on
from omnibench.fit.geometry import WheelGeometry
from omnibench.fit.identifiability import inseparable_in_words, kept_motions, warnings_of_calibration
from omnibench.fit.open_combinations import open_sentences
from omnibench.fit.path_errors import slip_of
from omnibench.fit.prior import default_cost, default_mount, mount_is_fitted
from omnibench.fit.problem import CalibrationProblem, make_problem
from omnibench.fit.settings import CompleteSettings, CostChoice, FitSettings
from omnibench.fit.span import WheelDirection
from omnibench.fit.uncertainty import NoCovarianceError, Uncertainty, physical_parameters, uncertainty_of
from omnibench.jobs.job import Backend
from omnibench.progress import Progress, Reporter, no_progress, renamed
from omnibench.registry import calibrators, costs
from omnibench.robot.calibration import Calibration, EffectTerm, ModelExtension, covariance_rows, extended_model
from omnibench.robot.effects.effect import Term
from omnibench.robot.kinematics import Robot
from omnibench.robot.physical import PhysicalParameter, PhysicalReading
from omnibench.robot.stored_odometry import read_by, workers
from omnibench.views import Shown

DEFAULT = "map"  # calibrator where none is given


def words_of(terms: Sequence[Term]) -> str:
    """The fitted numbers in words."""
    said = []
    for term in terms:
        units = {parameter.name: parameter.unit for parameter in term.effect.fixed_parameters}
        said += [
            f"{term.name.replace('_', ' ')} {value:.3g}" + (f" {units[name]}" if units[name] != "1" else "")
            for name, value in term.values.items()
        ]
    return ", ".join(said)


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationRun(Shown):
    """A calibration, and the calibrator's result.

    parameters: radii, track or wheelbase or distances, angles, ..., which the matrix and its effects mean; none where
    it has no such reading. uncertainty: covariance of the elements; None if there is none, then a warning says why.
    warnings: one sentence for every part of the calibration that the data do not determine. kept: motions that keep the
    design values; intervals hold only if these are right.
    """

    calibration: Calibration
    result: RunResult
    parameters: tuple[PhysicalParameter, ...]
    uncertainty: Uncertainty | None
    warnings: tuple[str, ...]
    kept: tuple[WheelDirection, ...]

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
    watch: told the evaluations and the best cost so far, at most every 0.1 s. backend: its workers read the samples of
    very many runs; default: this process.

    calibrator: default map, the most probable model given the references and the design.
    loss: how pose errors are weighted in the fit. squares: as the calibrator weights them; huber, student_t: poses that
    are far off have a bounded influence.
    unidentified: what a calibrator that does not weigh the design does about motions that the data drive so little that
    slip alone may explain them, which the run's warnings name. ``keep``: the matrix has the design values there;
    ``fit``: it is fitted there, too. tolerance: standard deviation of the design's elements, for map; default: that of
    the robot's class.
    mount: pose of the tracked point: ``known``, as the robot's file says, or ``fit``. Of a robot that slides the
    matrix of calibrators but map is the same, and the place is told from the distances of its wheels, as far as these
    are as designed.
    Cost and mount have defaults that depend on the robot: on few runs the whole trajectory is the cost; the tracked
    point of tricycles and cars is fitted.
    steering: ``fit``: gain, play and coupling of the steering, and a car's zero, are estimated, too, and are effects of
    the calibration; ``known``: the measured angles are right.

    Raises UnknownNameError or ConfigError for wrong choices, DataError for an empty training split, and ConfigError
    when the calibrator gives no answer.

    >>> run = calibrate(dataset, cost="trajectory")
    >>> run.calibration.matrix_array.shape, run.result.outcome.value  # (3, M), m and rad per rad of wheel
    ((3, 2), 'converged')
    """
    require_type(dataset, Dataset, "load_dataset")
    robot, training = dataset.robot, training_split(dataset)

    # The choices that are not None in the place of the settings' own, with what is usual for this robot and its runs.
    if settings is not None:
        choices = (dict(settings) if isinstance(settings, FitSettings) else {"calibrator": settings}) | choices
    asked = validate(FitSettings, {name: value for name, value in choices.items() if value is not None}, "calibrate")
    chosen, calibrator = complete_settings(asked, robot, training)

    # The steering first, where it is to be fitted: the matrix is then fitted to the corrected drive signals.
    terms: tuple[Term, ...] = ()
    runs: Sequence[Trajectory] = training
    if chosen.steering == "fit" and not calibrator.weighs_design:
        watch(Progress("steering"))
        of_runs = replace(usual_problem(robot, training, chosen.integration), unknowns=(), nuisances=Nuisances())
        terms = estimate_with_steering(of_runs).terms
        runs = corrected_runs(robot, training, terms, dataset.sample_period)

    # The answer.
    problem = make_problem(chosen, robot, runs, renamed(watch, calibrator.name))
    with read_by(backend or workers()):
        result = run_calibrator(calibrator, problem)
    if result.matrix is None or result.vector is None:
        raise ConfigError(f"calibrator {calibrator.name!r} gave no answer ({result.outcome}): {result.reason}")

    # What the data leave open, and how sure the answer is.
    searched, span, treatment = problem.parameterisation, problem.span, chosen.unidentified
    warnings = [*warnings_of_calibration(robot, span, searched.name, treatment)]
    warnings += open_sentences(robot, runs, treatment, chosen.mount, span=span)
    if isinstance(searched, WheelGeometry) and calibrator.fitted:
        warnings += inseparable_in_words(searched, problem.unidentified, problem.left_open)
    warnings += problem.moved_ends
    uncertainty = None
    if calibrator.fitted:
        try:
            uncertainty = uncertainty_of(problem, result)
        except NoCovarianceError as error:
            warnings.append(str(error))

    # The physical parameters and the calibration file.
    extension = result.extension or ModelExtension(effects=tuple(map(EffectTerm.of, terms)))
    by_prior = calibrator.weighs_design and chosen.tolerance is None
    fitted_mount = mount_is_fitted(robot, asked.mount, by_prior=by_prior)
    reading = physical_parameters(problem, result, uncertainty, extension.effects, fitted_mount=fitted_mount)
    warnings += [reading.doubt] if reading.doubt else []
    if terms:
        warnings.append(
            f"the steering was fitted first ({words_of(terms)}); the matrix's intervals take these numbers for exact, "
            "and the file has no covariance"
        )
    return CalibrationRun(
        calibration=_calibration(dataset, chosen, problem, result, extension, uncertainty, reading),
        result=result,
        parameters=reading.parameters,
        uncertainty=uncertainty,
        warnings=tuple(warnings),
        kept=kept_motions(robot, span, searched.name, treatment),
    )


def complete_settings(
    settings: FitSettings, robot: Robot, training: Sequence[Trajectory]
) -> tuple[CompleteSettings, Calibrator]:
    """Settings completed by what is usual for a robot and its runs, and their calibrator.

    UnknownNameError or ConfigError: a name is unknown, or two choices contradict each other.
    """
    name = settings.calibrator or DEFAULT
    calibrator: Calibrator = calibrators.create(name, settings.options)
    choice = settings.cost or CostChoice(name=default_cost(robot, len(training)))
    costs.create(choice.name, choice.options)
    unidentified, mount = as_answered(calibrator, settings.unidentified or "keep", settings.mount)
    if robot.slides:  # the matrix may be any, and where the tracked point stands is read from it
        mount = settings.mount
    if settings.tolerance is not None and not calibrator.weighs_design:
        raise ConfigError(f"tolerance is of the design, which {calibrator.name} does not weigh; take calibrator map")
    if settings.steering == "fit" and calibrator.weighs_design:
        calibrator = calibrators.create(calibrator.name, calibrator.options.model_dump() | {"steering": "fit"})
    elif settings.steering == "fit" and calibrator.extends:
        raise ConfigError(f"calibrator {name!r} adds effects of its own; leave out steering: fit, or take another")
    complete = {
        "calibrator": calibrator.name,
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
    extension: ModelExtension,
    uncertainty: Uncertainty | None,
    reading: PhysicalReading,
) -> Calibration:
    """The calibration of an answer, with how it came about. The costs in the file are without a loss."""
    assert result.matrix is not None  # there is an answer
    robot, training, validation = dataset.robot, dataset.split("train"), dataset.split("validation")
    covariance = covariance_rows(uncertainty.covariance) if uncertainty and not extension.effects else None
    model = extended_model(robot, result.matrix, problem.integration, dataset.sample_period, extension)
    noise = uncertainty.noise if uncertainty else result.noise
    squares = settings.loss == "squares"
    cost = costs.create(settings.cost.name, settings.cost.options)
    provenance = settings.provenance | {
        "box": problem.box,
        "unidentified": settings.unidentified,
        "tolerance": settings.tolerance,
        "mount": settings.mount or (None if robot.slides else default_mount(robot)),
        "on_bounds": result.at_bounds,
        "versions": package_versions(),
        "training_cost": result.cost if squares else cost.of_model(model, training),
        "validation_cost": cost.of_model(model, validation) if validation else None,
        "outcome": result.outcome,
        "reason": result.reason,
        "held_out": verdict_on(model, training, validation),
    }
    calibration = calibration_of_fit(
        f"{dataset.name} {settings.calibrator}",
        dataset,
        result.matrix,
        provenance,
        integration=problem.integration,
        noise=noise if any(run.has_poses for run in problem.trajectories) else None,
        parameters={each.name: each for each in reading.parameters},
        **dict(extension) | {"covariance": extension.covariance or covariance},
    )
    return calibration.model_copy(update={"slip": slip_of(calibration, training)})
