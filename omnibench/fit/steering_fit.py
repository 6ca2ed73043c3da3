"""Fit of what turns the drive signals themselves: gain and play of a steering, its coupling to wheels, a car's zero.

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

import numpy as np
from scipy.optimize import minimize

from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError
from omnibench.fit.calibrator import run_calibrator
from omnibench.fit.loss import RobustCost, norms_of, with_ends_from_others, with_loss
from omnibench.fit.problem import Budget, make_problem
from omnibench.fit.settings import CompleteSettings
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import calibrators, costs, effects
from omnibench.robot.corrections import corrected, needs_of
from omnibench.robot.effects.effect import Parameter, Term
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import signals_of

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
        found = minimize(self._told, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxfun": _MOST})
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
        matrix, value = self._best_matrix(corrected_runs(self.robot, self.runs, terms, self.sample_period))
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

    def _best_matrix(self, runs: Sequence[Trajectory]) -> tuple[Array, float]:
        """The matrix (3, M) of least cost, and that cost."""
        assert self._smooth  # refuses what is no sum of norms
        problem = make_problem(self.settings, self.robot, runs)
        result = run_calibrator(calibrators.create("closed_form", {"tolerance": _TOLERANCE}), problem)
        if result.matrix is None or result.cost is None:
            raise ConfigError(f"steering: no matrix could be fitted ({result.outcome}): {result.reason}")
        return result.matrix, result.cost

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
