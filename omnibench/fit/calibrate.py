"""Calibration of one robot from one data set, with one calibrator.

Fit of what turns the drive signals themselves: gain and play of a steering, its coupling to wheels, a car's zero.

A matrix is linear in the drive signals, and these are not in a steering's parameters q. For given q the best matrix
K(q) is found by the closed form; with C the cost, what is minimised over q is

    c(q) = min_K C(K, q),    dc/dq = dC/dq at K(q) held,                                                 (1)

since C has no slope in K at its minimum (envelope theorem). C is under Huber's loss, which is smooth and bears poses
that have jumped; the matrix of the calibration is fitted afterwards, as it always is. A lag of the steering is not
among them: a wrong clock of the reference looks alike, and ``discover`` tells when it can.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from typing import Any

import numpy as np
import scipy

from omnibench.config import validate
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.splits import training_split
from omnibench.environment import package_versions
from omnibench.errors import ConfigError, computable, require_type
from omnibench.fit.bootstrap import ElementIntervals, bootstrap_intervals
from omnibench.fit.calibrator import Calibrator, RunResult, as_answered, calibration_of_fit, run_calibrator
from omnibench.fit.evaluate import verdict_on
from omnibench.fit.geometry import WheelGeometry
from omnibench.fit.identifiability import inseparable_in_words, kept_motions, warnings_of_calibration
from omnibench.fit.loss import RobustCost, norms_of, with_ends_from_others, with_loss
from omnibench.fit.open_combinations import open_sentences
from omnibench.fit.prior import default_cost, default_mount, default_unidentified
from omnibench.fit.problem import Budget, CalibrationProblem, make_problem
from omnibench.fit.ratio_intervals import FEWEST, Units, units_of
from omnibench.fit.settings import CompleteSettings, CostChoice, FitSettings
from omnibench.fit.shrinkage import shrunk
from omnibench.fit.span import WheelDirection
from omnibench.fit.uncertainty import NoCovarianceError, Uncertainty, physical_parameters, uncertainty_of
from omnibench.jobs.job import Backend
from omnibench.progress import Progress, Reporter, no_progress, renamed
from omnibench.registry import calibrators, costs, effects
from omnibench.robot.calibration import Calibration, EffectTerm, ModelExtension, covariance_rows, extended_model
from omnibench.robot.corrections import corrected, needs_of
from omnibench.robot.effects.effect import Parameter, Term
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.physical import PhysicalParameter, PhysicalReading
from omnibench.robot.signals import signals_of
from omnibench.views import Shown

_GAIN = "steering_gain"
FITTED = (_GAIN, "steering_play", "steering_offset", "steering_coupling")
# Factors on the measured angle from which the search begins: gears between an encoder and its wheel are seldom known
# worse than this, and between two of them the cost has one minimum (tests/fit/test_wheeled_fits.py).
_FACTORS = (0.5, 1.0, 2.0, 4.0, 8.0)
_GAINS = (-0.95, 15.0)  # bounds of the gain, which counts from 0
_WIDER = 3.0  # times the plausible range, of play and zero
_SCRUB = 0.1  # m: a wheel stands no farther from the axis about which it steers, by as much as which it then rolls
_WORTH = 0.01  # share of the cost that an effect beside the gain must take off; chosen
_STEP = 1e-4  # of the usual size: of central differences
_ON_BOUND = 1e-6  # share of the way between a number's bounds: what is closer to one lies on it
_MOST = 40  # matrices of the search
_TOLERANCE = 1e-7  # m or rad per rad of wheel, of each matrix


@dataclass(frozen=True)
class _Number:
    """One searched number: its effect's name, its parameter, its bounds and a usual size, in the parameter's unit."""

    effect: str
    parameter: Parameter
    low: float
    high: float
    usual: float

    @classmethod
    def of(cls, effect: str, parameter: Parameter, robot: Robot) -> _Number:
        """The number of a robot; a turn of a small wheel, or of a motor in its place, couples more than of a large."""
        if effect == _GAIN:
            return cls(effect, parameter, *_GAINS, parameter.largest)
        if effect == "steering_coupling":
            most = _SCRUB / float(robot.radii.min())
            return cls(effect, parameter, -_FACTORS[-1] * most, _FACTORS[-1] * most, most)  # of the measured angle
        return cls(effect, parameter, _WIDER * parameter.low, _WIDER * parameter.high, parameter.largest)


def _numbers_of(robot: Robot) -> list[_Number]:
    """The searched numbers of a robot; none where it does not steer."""
    chosen = [effects.create(name) for name in FITTED]
    return [
        _Number.of(effect.name, parameter, robot)
        for effect in chosen
        if effect.applies(robot)
        for parameter in effect.parameters(robot)
    ]


def fit_steering(
    settings: CompleteSettings,
    robot: Robot,
    runs: Sequence[Trajectory],
    sample_period: float,
    watch: Reporter = no_progress,
) -> tuple[Term, ...]:
    """The effects of a robot's steering that fit runs best; sample_period: nominal, s.

    ConfigError: the robot has no steering, the cost is no sum of norms, or no matrix can be fitted.
    """
    loss = "huber" if settings.loss == "squares" else settings.loss
    smooth = settings.model_copy(
        update={
            "parameterisation": "matrix",
            "unidentified": "keep",
            "tolerance": None,
            "loss": loss,
            "budget": Budget(),
        }
    )
    return SteeringFit(robot, tuple(runs), sample_period, smooth, watch).terms()


@dataclass(frozen=True, eq=False)
class SteeringFit:
    """The search for the steering's parameters on some runs, with a robust cost."""

    robot: Robot
    runs: tuple[Trajectory, ...]
    sample_period: float
    settings: CompleteSettings
    watch: Reporter = no_progress

    def terms(self) -> tuple[Term, ...]:
        """The effects of the steering that fit best. ConfigError: the robot has none, or no matrix can be fitted."""
        numbers = self._numbers
        usual = np.array([number.usual for number in numbers])
        names = np.array([number.effect for number in numbers])
        starts = np.zeros((len(_FACTORS), len(numbers)))
        starts[:, names == _GAIN] = ((np.array(_FACTORS) - 1) / usual[names == _GAIN])[:, None]
        bounds = np.array([(number.low, number.high) for number in numbers]) / usual[:, None]
        vector, least = self._least(min(starts, key=lambda start: self._told(start)[0]), bounds)
        for effect in dict.fromkeys(names[names != _GAIN].tolist()):  # what hardly helps is left out, one by one
            without = np.where((names == effect)[:, None], 0.0, bounds)
            found, cost = self._least(np.where(names == effect, 0.0, vector), without)
            if cost <= (1 + _WORTH) * least:
                vector, least, bounds = found, cost, without
        self.watch(Progress("steering", result=""))
        kept = set(names[bounds.any(axis=1)].tolist())
        return tuple(term for term in self._as_terms(vector) if term.name in kept)

    def _least(self, start: Array, bounds: Array) -> tuple[Array, float]:
        """The vector (n,) of least cost between bounds (n, 2), and that cost."""
        found = scipy.optimize.minimize(
            self._told, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxfun": _MOST}
        )
        return found.x, float(found.fun)

    def _told(self, vector: Array) -> tuple[float, Array]:
        """The cost, of which ``watch`` is told."""
        value, slopes = self.cost(vector)
        self.watch(Progress("steering", next(self._count), None, "fit", value))
        return value, slopes

    @cached_property
    def _count(self) -> Iterator[int]:
        return count(1)

    def cost(self, vector: Array) -> tuple[float, Array]:
        """c(q) of Eq. (1) and its derivatives (n,), at a vector (n,) in units of the usual sizes."""
        terms = self._as_terms(vector)
        # The matrix (3, M) of least cost, and that cost
        runs = corrected_runs(self.robot, self.runs, terms, self.sample_period)
        assert self._smooth  # refuses what is no sum of norms
        problem = make_problem(self.settings, self.robot, runs)
        result = run_calibrator(calibrators.create("closed_form", {"tolerance": _TOLERANCE}), problem)
        if result.matrix is None or result.cost is None:
            raise ConfigError(f"steering: no matrix could be fitted ({result.outcome}): {result.reason}")
        matrix, value = result.matrix, result.cost
        return value, self._slopes(vector, matrix)

    @cached_property
    def _smooth(self) -> RobustCost:
        """The cost that is minimised. ConfigError: the one that was asked for is no sum of norms."""
        cost = costs.create(self.settings.cost.name, self.settings.cost.options)
        if norms_of(cost) is None:
            raise ConfigError(f"steering: fit needs a cost that is a sum of norms, which {cost.name} is not")
        smooth = with_loss(cost, self.settings.loss)
        assert isinstance(smooth, RobustCost)  # it is one of norms
        return smooth

    @property
    def _numbers(self) -> list[_Number]:
        numbers = _numbers_of(self.robot)
        if not numbers:
            raise ConfigError(f"steering: fit is for wheels that steer; robot {self.robot.name} has none")
        return numbers

    def _as_terms(self, vector: Array) -> tuple[Term, ...]:
        """The effects at a vector in units of their usual sizes."""
        values: dict[str, dict[str, float]] = {}
        for number, share in zip(self._numbers, vector.tolist(), strict=True):
            values.setdefault(number.effect, {})[number.parameter.name] = share * number.usual
        return tuple(Term(effects.create(name), of_effect) for name, of_effect in values.items())

    def _slopes(self, vector: Array, matrix: Array) -> Array:
        """Derivatives (n,) of the cost of a matrix (3, M) by a vector (n,), by central differences, Eq. (1).

        Starts and ends that have jumped follow from the vector, too, as in the problem whose cost this is.
        """
        slopes, integration = np.empty(len(vector)), self.settings.integration
        for index in range(len(vector)):
            values = []
            for step in (-_STEP, _STEP):
                moved = vector.copy()
                moved[index] += step
                runs = corrected_runs(self.robot, self.runs, self._as_terms(moved), self.sample_period)
                last = self._smooth.stamps == "final"
                runs, _ = with_ends_from_others(runs, self.robot, integration, self._smooth.of_poses, last=last)
                batch = self._smooth.batch(runs, integration)
                errors = batch.poses(matrix[None]) - self._smooth.reference(runs)
                values.append(float(self._smooth.combine(errors, batch.trajectory)[0]))
            slopes[index] = (values[1] - values[0]) / (2 * _STEP)
        return slopes


def corrected_runs(
    robot: Robot, runs: Sequence[Trajectory], terms: Sequence[Term], sample_period: float
) -> tuple[Trajectory, ...]:
    """Runs whose rates are the drive signals (F, M) of a robot with effects on its wheels and steering angles."""
    design, needs = robot.inverse_kinematic_matrix, needs_of(terms)
    made = []
    for run in runs:
        true = corrected(terms, signals_of(run.final_log, robot, design, sample_period, needs))
        signals = robot.drive.signals(true.rates, true.steering)
        made.append(replace(run, rates=signals, steering=None, drive=None, angles=None))
    return tuple(made)


def on_bounds(robot: Robot, terms: Sequence[Term]) -> tuple[str, ...]:
    """The fitted numbers of a robot that lie on a bound of the search other than 0, in words."""
    values = {(term.name, name): value for term in terms for name, value in term.values.items()}
    found = []
    for number in _numbers_of(robot):
        value = values.get((number.effect, number.parameter.name), 0.0)
        near = _ON_BOUND * (number.high - number.low)
        if value and any(bound and abs(value - bound) <= near for bound in (number.low, number.high)):
            found.append(f"{number.effect.replace('_', ' ')} {value:.3g}")
    return tuple(found)


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
    """A calibration, the calibrator's result and, where asked for, resampled 95 % intervals of the elements.

    parameters: radii, track or wheelbase or distances, angles, ..., which the matrix and its effects mean; none where
    it has no such reading. uncertainty: covariance of the elements; None if there is none, then a warning says why.
    warnings: one sentence for every part of the calibration that the data do not determine. kept: motions that keep the
    design values; intervals hold only if these are right. units: what these resample.
    """

    calibration: Calibration
    result: RunResult
    intervals: ElementIntervals | None
    parameters: tuple[PhysicalParameter, ...]
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
    loss: how pose errors are weighted in the fit. squares: as the calibrator weights them; huber,
    student_t: poses that are far off have a bounded influence.
    intervals: also draw resampled intervals about the optimum (closed_form only). A warning says so if there are fewer
    than three commands to draw from (runs, where none is repeated).
    unidentified: what is done about motions that the data drive so little that slip alone may explain them, which the
    run's warnings name. ``keep``: the matrix has the design values there; ``fit``: it is fitted there, too; ``shrink``:
    as ``keep``, and the other elements move towards the design, the more the less the data determine them. tolerance:
    how far a design may be off, for ``shrink``, as a share of each row's largest element.
    mount: pose of the tracked point: ``known``, as the robot's file says, or ``fit``. The matrix of a robot that slides
    is the same either way, and the place is told from the distances of its wheels, as far as these are as designed.
    Cost, unidentified and mount have defaults that depend on the robot: of few runs the whole trajectory is the cost;
    robots whose wheels say their type shrink, but those on omni wheels; the tracked point of tricycles and cars is
    fitted.
    steering: ``fit``: gain, play and coupling of the steering, and a car's zero, are fitted before the matrix
    and are effects of the calibration; ``known``: the measured angles are right.

    Raises UnknownNameError or ConfigError for wrong choices, DataError for an empty training split, and ConfigError
    when the calibrator gives no answer.

    >>> run = calibrate(dataset, cost="trajectory")
    >>> run.calibration.matrix_array.shape, run.result.outcome.value  # (3, M), m and rad per rad of wheel
    ((3, 2), 'converged')
    """
    require_type(dataset, Dataset, "load_dataset")
    robot, training = dataset.robot, training_split(dataset)

    # The choices, with what is usual for this robot and these runs.
    asked = _with_choices(settings, choices)
    chosen, calibrator = complete_settings(asked, robot, training)

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

    # The physical parameters, the calibration file, and what the data leave open.
    searched = problem.parameterisation
    extension = result.extension or ModelExtension(effects=tuple(map(EffectTerm.of, terms)))
    fitted_mount = (asked.mount or default_mount(robot)) == "fit"
    reading = physical_parameters(problem, result, uncertainty, extension.effects, fitted_mount=fitted_mount)
    return CalibrationRun(
        calibration=_calibration(dataset, chosen, problem, result, extension, uncertainty, reading),
        result=result,
        intervals=drawn,
        parameters=reading.parameters,
        uncertainty=uncertainty,
        warnings=tuple(_warnings(chosen, calibrator, problem, runs, terms, units, without_covariance, reading.doubt)),
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
    if robot.slides:  # the matrix may be any, and where the tracked point stands is read from it
        mount = settings.mount
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
        parameters={each.name: each for each in reading.parameters},
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
    doubt: str,
) -> Iterator[str]:
    """Sentences on what the data leave open, and on what the fit assumes.

    without_covariance: why the calibration has no covariance; empty for one that has. doubt: of the parameters.
    """
    robot, searched = problem.robot, problem.parameterisation
    yield from warnings_of_calibration(robot, problem.span, searched.name, settings.unidentified)
    yield from open_sentences(robot, runs, settings.unidentified, settings.mount, span=problem.span)
    if isinstance(searched, WheelGeometry) and calibrator.fitted:
        yield from inseparable_in_words(searched, problem.unidentified, problem.left_open)
    yield from problem.moved_ends
    if without_covariance:
        yield without_covariance
    if doubt:
        yield doubt
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
