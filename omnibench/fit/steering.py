"""Fit of what turns the drive signals themselves: gain and play of a steering, its coupling to wheels, a car's zero.

A matrix is linear in the drive signals, and these are not in a steering's parameters q. For given q the best matrix
K(q) is found by the closed form; with C the cost, what is minimised over q is

    c(q) = min_K C(K, q),    dc/dq = dC/dq at K(q) held,                                                 (1)

since C has no slope in K at its minimum (envelope theorem). C is under Huber's loss, which is smooth and bears poses
that have jumped; the matrix of the calibration is fitted afterwards, as it always is. A lag of the steering is not
among them: a wrong clock of the reference looks alike, and ``discover`` tells when it can.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.optimize import minimize

from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError
from omnibench.fit.calibrator import run_calibrator
from omnibench.fit.cost import Cost
from omnibench.fit.loss.robust_cost import RobustCost, norms_of, with_loss
from omnibench.fit.parameterisation import Box
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.fit.shrinkage.prior import MountChoice
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import calibrators, effects
from omnibench.robot.corrected import corrected, needs_of
from omnibench.robot.effects.effect import Parameter
from omnibench.robot.effects.term import Term
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration
from omnibench.robot.signals import signals_of

SteeringChoice = Literal["known", "fit"]

_GAIN = "steering_gain"
FITTED = (_GAIN, "steering_play", "steering_offset", "steering_coupling")
# Factors on the measured angle from which the search begins: gears between an encoder and its wheel are seldom known
# worse than this, and between two of them the cost has one minimum (tests/fit/test_steering.py).
_FACTORS = (0.5, 1.0, 2.0, 4.0, 8.0)
_GAINS = (-0.95, 15.0)  # bounds of the gain, which counts from 0
_WIDER = 3.0  # times the plausible range, of play and zero
_SCRUB = 0.1  # m: a wheel stands no farther from the axis about which it steers, by as much as which it then rolls
_STEP = 1e-4  # of the largest plausible size: of central differences
_AT = 1e-6  # of the largest plausible size: how near a bound counts as on it
_MOST = 40  # matrices of the search
_TOLERANCE = 1e-7  # m or rad per rad of wheel, of each matrix


@dataclass(frozen=True)
class _Number:
    """One searched number: its effect's name, its parameter and its bounds, in the parameter's unit."""

    effect: str
    parameter: Parameter
    low: float
    high: float

    @classmethod
    def of(cls, effect: str, parameter: Parameter, robot: Robot) -> _Number:
        """The number of a robot; a turn of a small wheel, or of a motor in its place, couples more than of a large."""
        if effect == _GAIN:
            return cls(effect, parameter, *_GAINS)
        if effect == "steering_coupling":
            most = _SCRUB / float(robot.radii.min())
            return cls(effect, parameter, -most, most)
        return cls(effect, parameter, _WIDER * parameter.low, _WIDER * parameter.high)


@dataclass(frozen=True, eq=False)
class SteeringFit:
    """The search for the steering's parameters on some runs, with one cost."""

    robot: Robot
    runs: tuple[Trajectory, ...]
    sample_period: float
    objective: Cost
    box: Box
    mount: MountChoice | None
    integration: Integration
    seed: int
    watch: Reporter = no_progress

    def terms(self) -> tuple[Term, ...]:
        """The effects of the steering that fit best. ConfigError: the robot has none, or no matrix can be fitted."""
        numbers = self._numbers
        count = 0

        def cost(vector: Array) -> tuple[float, Array]:
            nonlocal count
            terms = self._as_terms(vector)
            matrix, value = self._best_matrix(corrected_runs(self.robot, self.runs, terms, self.sample_period))
            count += 1
            self.watch(Progress("steering", count, None, "fit", value))
            return value, self._slopes(vector, matrix)

        largest = np.array([number.parameter.largest for number in numbers])
        gain = next(index for index, number in enumerate(numbers) if number.effect == _GAIN)
        starts = np.zeros((len(_FACTORS), len(numbers)))
        starts[:, gain] = (np.array(_FACTORS) - 1) / largest[gain]
        best = min(starts, key=lambda start: cost(start)[0])
        bounds = [(number.low / unit, number.high / unit) for number, unit in zip(numbers, largest, strict=True)]
        found = minimize(cost, best, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxfun": _MOST})
        return self._as_terms(found.x)

    @cached_property
    def _smooth(self) -> Cost:
        """The cost that is minimised. ConfigError: the one that was asked for is no sum of norms."""
        if norms_of(self.objective) is None:
            raise ConfigError(f"steering: fit needs a cost that is a sum of norms, which {self.objective.name} is not")
        return self.objective if isinstance(self.objective, RobustCost) else with_loss(self.objective, "huber")

    @property
    def _numbers(self) -> list[_Number]:
        chosen = [effects.create(name) for name in FITTED]
        numbers = [
            _Number.of(effect.name, parameter, self.robot)
            for effect in chosen
            if effect.applies(self.robot)
            for parameter in effect.parameters(self.robot)
        ]
        if not numbers:
            raise ConfigError(f"steering: fit is for wheels that steer; robot {self.robot.name} has none")
        return numbers

    def _as_terms(self, vector: Array) -> tuple[Term, ...]:
        """The effects at a vector in units of their largest plausible sizes."""
        values: dict[str, dict[str, float]] = {}
        for number, share in zip(self._numbers, vector.tolist(), strict=True):
            values.setdefault(number.effect, {})[number.parameter.name] = share * number.parameter.largest
        return tuple(Term(effects.create(name), of_effect) for name, of_effect in values.items())

    def _best_matrix(self, runs: Sequence[Trajectory]) -> tuple[Array, float]:
        """The matrix (3, M) of least cost, and that cost."""
        searched = make_parameterisation("matrix", self.robot, runs, box=self.box, mount=self.mount)
        problem = CalibrationProblem(
            self.robot, runs, self._smooth, searched, integration=self.integration, budget=Budget(), seed=self.seed
        )
        result = run_calibrator(calibrators.create("closed_form", {"tolerance": _TOLERANCE}), problem)
        if result.matrix is None or result.cost is None:
            raise ConfigError(f"steering: no matrix could be fitted ({result.outcome}): {result.reason}")
        return result.matrix, result.cost

    def _slopes(self, vector: Array, matrix: Array) -> Array:
        """Derivatives (n,) of the cost of a matrix (3, M) by a vector (n,), by central differences, Eq. (1)."""
        slopes = np.empty(len(vector))
        for index in range(len(vector)):
            values = []
            for step in (-_STEP, _STEP):
                moved = vector.copy()
                moved[index] += step
                runs = corrected_runs(self.robot, self.runs, self._as_terms(moved), self.sample_period)
                batch = self._smooth.batch(runs, self.integration)
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
    """Names of the fitted effects with a number on a bound of its search, other than 0: runs hardly tell these."""
    named = []
    for term in terms:
        for parameter in term.effect.parameters(robot):
            number, value = _Number.of(term.name, parameter, robot), term.values[parameter.name]
            if value and not number.low + _AT * parameter.largest < value < number.high - _AT * parameter.largest:
                named.append(term.name.replace("_", " "))
    return tuple(named)


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
