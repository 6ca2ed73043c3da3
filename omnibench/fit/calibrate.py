"""Calibration of one robot from one data set, with one calibrator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.splits import training_split
from omnibench.environment import package_versions
from omnibench.errors import ConfigError, computable, require_choice, require_range, require_type
from omnibench.fit.bootstrap import ElementIntervals, bootstrap_intervals
from omnibench.fit.calibrator import Calibrator, RunResult, as_answered, run_calibrator
from omnibench.fit.cost import Cost
from omnibench.fit.evaluate import verdict_on
from omnibench.fit.geometry import FittedParameter, GeometryLimits, WheelGeometry, fitted_parameters
from omnibench.fit.identifiability import inseparable_in_words, kept_motions, warnings_of_calibration
from omnibench.fit.loss import LossName, with_loss
from omnibench.fit.open_combinations import open_sentences, with_open_combinations
from omnibench.fit.parameterisation import (
    Box,
    BoxName,
    ExplicitBox,
    MatrixElements,
    ParameterisationName,
)
from omnibench.fit.prior import MountChoice, default_cost, default_mount, default_unidentified
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.fit.ratio_intervals import FEWEST, Units, units_of
from omnibench.fit.shrinkage import shrunk
from omnibench.fit.span import Unidentified, WheelDirection, driven_span, unidentified_directions
from omnibench.fit.steering_fit import SteeringChoice, SteeringFit, corrected_runs, on_bounds, words_of
from omnibench.fit.uncertainty import NoCovarianceError, Uncertainty, uncertainty_of
from omnibench.jobs.job import Backend
from omnibench.progress import Reporter, no_progress, renamed
from omnibench.registry import calibrators, costs
from omnibench.robot.calibration import (
    Calibration,
    EffectTerm,
    ModelExtension,
    Provenance,
    covariance_rows,
    extended_model,
    fitted_calibration,
    matrix_rows,
)
from omnibench.robot.effects.effect import Term
from omnibench.robot.kinematics import Robot
from omnibench.robot.odometry import Integration
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
    calibrator: str | None = None,
    *,
    options: Mapping[str, Any] | None = None,
    cost: str | None = None,
    loss: LossName = "squares",
    parameterisation: ParameterisationName | None = None,
    box: Box = "row",
    limits: GeometryLimits | None = None,
    integration: Integration = "arc",
    budget: Budget | None = None,
    seed: int = 1,
    intervals: bool = False,
    unidentified: Unidentified | None = None,
    mount: MountChoice | None = None,
    steering: SteeringChoice = "known",
    tolerance: float | None = None,
    watch: Reporter = no_progress,
    backend: Backend | None = None,
) -> CalibrationRun:
    """Fit the odometry model of a data set's training split.

    calibrator: default closed_form, or trajectory_ml where training runs have references other than poses, each of
    which it weighs by its own uncertainty.
    intervals: also draw resampled intervals about the optimum (closed_form only), unless there are fewer than three
    commands (runs, where none is repeated) or too few for a covariance, of which a warning tells.
    loss: of the cost's pose errors when they are fitted. squares: as the calibrator takes them; huber, student_t: poses
    that are far off have a bounded influence (see fit/loss.py).
    unidentified: for motions that the data drive so little that slip alone may explain them, ``keep`` the design values
    or ``fit`` them (see make_parameterisation); ``shrink`` keeps them and shrinks what else is hardly known to the
    design, of the given tolerance (see shrinkage.py). The run's warnings name them. mount: ``known``, or ``fit`` where
    the tracked point stands. Default of these and of the cost: by the robot (see prior.py). steering: ``fit`` first
    finds gain, play and coupling of the steering and a car's zero (see steering_fit.py), effects from then on.
    watch: told the evaluations and the best cost so far, at most every 0.1 s. backend: solves the resamples of
    ``intervals`` as jobs; default: this process.

    Raises UnknownNameError or ConfigError for wrong arguments, DataError for an empty training split, and ConfigError
    when the calibrator gives no answer.

    >>> run = calibrate(dataset, cost="trajectory")
    >>> run.calibration.matrix_array.shape, run.result.outcome.value  # (3, M), m and rad per rad of wheel
    ((3, 2), 'converged')
    """
    require_type(dataset, Dataset, "load_dataset")
    for what, value, words in (
        ("loss", loss, LossName),
        ("parameterisation", parameterisation, ParameterisationName),
        ("box", None if isinstance(box, ExplicitBox) else box, BoxName),
        ("integration", integration, Integration),
        ("unidentified", unidentified, Unidentified),
        ("mount", mount, MountChoice),
        ("steering", steering, SteeringChoice),
    ):
        if value is not None:
            require_choice(what, value, get_args(words))
    require_range("seed", seed, 0, whole=True)
    if tolerance is not None:
        require_range("tolerance", tolerance, 1e-9)
    budget = Budget() if budget is None else budget
    require_type(budget, Budget, "Budget(evaluations=...)")
    training = training_split(dataset)
    calibrator = calibrator or default_calibrator(training)
    chosen: Calibrator = calibrators.create(calibrator, options)
    cost = cost or default_cost(dataset.robot, len(training))
    plain: Cost = costs.create(cost)
    objective = with_loss(plain, loss)
    unidentified, mount = as_answered(chosen, unidentified or default_unidentified(dataset.robot), mount)
    _check_choices(chosen, loss, unidentified, tolerance, intervals)
    terms: tuple[Term, ...] = ()
    driven = training
    if steering == "fit":
        if chosen.extends:
            raise ConfigError(
                f"calibrator {calibrator!r} adds effects of its own; leave out steering: fit, or take another"
            )
        settings = (objective, box, mount, integration, seed)
        terms = SteeringFit(dataset.robot, training, dataset.sample_period, *settings, watch).terms()
        driven = corrected_runs(dataset.robot, training, terms, dataset.sample_period)
    searched = make_parameterisation(
        parameterisation or chosen.parameterisation,
        dataset.robot,
        driven,
        box=box,
        limits=limits,
        unidentified=unidentified,
        mount=mount,
        tolerance=tolerance,
    )
    problem = CalibrationProblem(
        dataset.robot,
        driven,
        objective,
        searched,
        integration=integration,
        budget=budget,
        seed=seed,
        shrinks=unidentified == "shrink",
        watch=renamed(watch, calibrator),
    )
    result = shrunk(problem, run_calibrator(chosen, problem), fitted=chosen.fitted)
    if result.matrix is None or result.vector is None:
        raise ConfigError(f"calibrator {calibrator!r} gave no answer ({result.outcome}): {result.reason}")
    uncertainty, untold = _uncertainty(problem, result, chosen)
    fit = _Fit(dataset, calibrator, chosen, problem, result, terms, uncertainty)
    calibration = fit.calibration(
        cost=cost,
        plain=plain,
        loss=loss,
        unidentified=unidentified,
        tolerance=tolerance,
        mount=mount,
    )
    units = units_of(training)
    drawn = None
    if intervals and units.count >= FEWEST and uncertainty:
        drawn = bootstrap_intervals(problem, result.vector, units=units, rng=problem.rng, backend=backend)
    return CalibrationRun(
        calibration=calibration,
        result=result,
        intervals=drawn,
        parameters=fitted_parameters(searched, result.vector) if isinstance(searched, WheelGeometry) else None,
        uncertainty=uncertainty,
        warnings=(
            *warnings_of_calibration(dataset.robot, driven, searched.name, unidentified),
            *open_sentences(dataset.robot, driven, unidentified),
            *_inseparable(problem, chosen),
            *problem.moved_ends,
            *untold,
            *_doubts_of_steering(dataset.robot, terms),
            *_too_few_units(intervals, units),
        ),
        kept=kept_motions(dataset.robot, driven, searched.name, unidentified),
        units=units,
    )


def default_calibrator(training: Sequence[Trajectory]) -> str:
    """The calibrator where none is given: the one that weighs references by their uncertainty, if there are some."""
    return "closed_form" if all(run.references is None for run in training) else "trajectory_ml"


def _check_choices(
    chosen: Calibrator, loss: LossName, unidentified: Unidentified, tolerance: float | None, intervals: bool
) -> None:
    """ConfigError: two choices contradict each other."""
    if intervals and not chosen.exact:
        raise ConfigError("intervals are drawn about a minimum to rounding: use the calibrator closed_form")
    if intervals and loss != "squares":
        raise ConfigError(
            f"resampled intervals are drawn about the minimum of a sum of norms: leave out the loss {loss}, or the "
            "resampling, since a calibration has other intervals, too"
        )
    if tolerance is not None and unidentified != "shrink":
        raise ConfigError(f"tolerance is of the design, for unidentified: shrink, and unidentified is {unidentified}")
    if intervals and unidentified == "shrink":
        raise ConfigError(
            "resampled intervals are drawn about a minimum, which a shrunk answer is not: set unidentified to keep; a "
            "shrunk answer has intervals of its own"
        )


@dataclass(frozen=True, eq=False)
class _Fit:
    """A fit that gave an answer, before it is a calibration file."""

    dataset: Dataset
    calibrator: str
    chosen: Calibrator
    problem: CalibrationProblem
    result: RunResult
    terms: tuple[Term, ...]
    uncertainty: Uncertainty | None

    def calibration(
        self,
        *,
        cost: str,
        plain: Cost,
        loss: LossName,
        unidentified: Unidentified,
        tolerance: float | None,
        mount: MountChoice | None,
    ) -> Calibration:
        """The calibration, with how it came about. plain: the cost without its loss, which costs in the file are of."""
        dataset, problem, result, uncertainty = self.dataset, self.problem, self.result, self.uncertainty
        assert result.matrix is not None  # there is an answer
        robot, validation = dataset.robot, dataset.split("validation")
        extension = result.extension or ModelExtension(effects=tuple(map(EffectTerm.of, self.terms)))
        covariance = covariance_rows(uncertainty.covariance) if uncertainty and not self.terms else None
        model = extended_model(robot, result.matrix, problem.integration, dataset.sample_period, extension)
        noise = uncertainty.noise if uncertainty else result.noise
        squares = loss == "squares"
        return fitted_calibration(
            name=f"{dataset.name} {self.calibrator}",
            robot=robot,
            sample_period=dataset.sample_period,
            matrix=matrix_rows(result.matrix),
            integration=problem.integration,
            effects=extension.effects,
            noise=noise if any(run.has_poses for run in problem.trajectories) else None,
            covariance=extension.covariance or covariance,
            driven=extension.driven,
            plain=extension.plain,
            provenance=Provenance(
                dataset=dataset.name,
                dataset_hash=dataset.hash,
                fitted=dataset.fingerprints("train"),
                simulated=dataset.simulated,
                calibrator=self.calibrator,
                options=self.chosen.options.model_dump(mode="json"),
                seed=problem.seed,
                cost=cost,
                loss=None if loss == "squares" else loss,
                box=problem.box,
                unidentified=unidentified,
                tolerance=tolerance,
                mount=None if robot.slides else mount or default_mount(robot),
                unshrunk_cost=result.shrinkage.unshrunk_cost if result.shrinkage and squares else None,
                on_bounds=result.at_bounds,
                versions=package_versions(),
                training_cost=result.cost if squares else plain.of_model(model, training_split(dataset)),
                validation_cost=plain.of_model(model, validation) if validation else None,
                outcome=result.outcome,
                reason=result.reason,
                held_out=verdict_on(model, dataset.split("train"), validation),
            ),
        )


def _inseparable(problem: CalibrationProblem, calibrator: Calibrator) -> tuple[str, ...]:
    """Sentences on numbers of a fitted geometry that the data cannot tell apart; none of a matrix."""
    if not isinstance(problem.parameterisation, WheelGeometry) or not calibrator.fitted:
        return ()
    kept = unidentified_directions(problem.robot, driven_span(problem.trajectories))
    known = MatrixElements(problem.robot, "row", kept, known_mount=False)
    left_open = with_open_combinations(known, problem.trajectories).open
    return inseparable_in_words(problem.parameterisation, kept, left_open)


def _doubts_of_steering(robot: Robot, terms: tuple[Term, ...]) -> tuple[str, ...]:
    """Sentences on a steering that was fitted first; none where it was not."""
    if not terms:
        return ()
    return (
        f"the steering was fitted first ({words_of(terms)}); the matrix's intervals take these numbers for exact, and "
        "the file has no covariance",
        *(
            f"{number} lies on the bound of what is searched, so that these runs hardly tell it, or it stands for "
            "something else; take the fit only for drives that steer as these do"
            for number in on_bounds(robot, terms)
        ),
    )


def _too_few_units(intervals: bool, units: Units) -> tuple[str, ...]:
    """A sentence where resampled intervals were asked for and there are too few units; none else."""
    if not intervals or units.count >= FEWEST:
        return ()
    return (f"no resampled intervals: {units.words}; {FEWEST} are needed",)


def _uncertainty(
    problem: CalibrationProblem, result: RunResult, calibrator: Calibrator
) -> tuple[Uncertainty | None, tuple[str, ...]]:
    """The uncertainty of an answer, or a warning why it has none; neither if nothing was fitted."""
    if not calibrator.fitted:
        return None, ()
    try:
        return uncertainty_of(problem, result), ()
    except NoCovarianceError as error:
        return None, (str(error),)
