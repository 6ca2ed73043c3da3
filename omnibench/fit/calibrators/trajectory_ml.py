"""Maximum likelihood over whole trajectories: every reference pose, weighted by the noise that repetitions show.

The reference errors of a run are white noise, a random walk and a bias (fit/noise.py), of variances that come from the
differences between repetitions of a command. The generalised least squares that they weight is the statistically
efficient estimator as long as the model is right. Nuisances of each run:

- The start pose. The reference at t = 0 is an observation, too; its position error is a bias of the run, exactly, and
  so is in the noise model already. Its heading error also turns the path, which tells it from a biased heading: its
  variance is estimated from the repetitions and is zero where none shows, so that exact starts (simulation) lose no
  information and noisy ones (real recordings) do no harm.
- Offset and slope of the reference's clock, where asked for, about zero with a weak expectation of their size.

Where the runs scatter more than their noise explains, no matrix is right, and the best one depends on what it is for:
then the squared pose errors at the stamps of the problem's cost are minimised, starts and clocks left as the
likelihood had them. In both cases the covariance is honest: that of the noise, or of the scatter (fit/sandwich.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field
from scipy import stats

from omnibench.errors import DataError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.cost import SumOfNorms
from omnibench.fit.gauss_newton import Descent, descend
from omnibench.fit.noise import LEAST_WHITE, NoiseEstimate, estimate_noise
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.sandwich import Pulls, Sandwich, sandwich
from omnibench.fit.start_noise import separate_start_noise
from omnibench.fit.trajectory_fit import OFFSET, SLOPE, TURN, Estimate, Linearisation, TrajectoryFit, Weighting
from omnibench.registry import Options, calibrators
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

# Before anything is known of the noise: 1 cm or 0.01 rad, and as much again in a second.
_FIRST = Noise(pose_position=0.01, pose_heading=0.01, walk_position=0.01, walk_heading=0.01)
_MOST_ROUNDS = 10
# The model counts as wrong where chance exceeds the scatter of the runs once in a thousand times.
_CHANCE = 0.001


class TrajectoryMLOptions(Options):
    """What is a nuisance of each run, and what weights and covariance rest on."""

    start: Literal["auto", "exact", "noisy"] = Field(
        "auto", description="start headings of the runs: noisy where repetitions show it, exact, or at least as poses"
    )
    clock: Literal["none", "offset", "offset_and_slope"] = Field("none", description="of the reference, for each run")
    clock_offset: float = Field(0.2, gt=0, allow_inf_nan=False, description="its expected size, s")
    clock_slope: float = Field(0.003, gt=0, allow_inf_nan=False, description="its expected size, s per s")
    weights: Literal["auto", "noise", "cost"] = Field(
        "auto", description="of the noise, of the problem's cost, or the latter only where the model misfits"
    )
    covariance: Literal["auto", "model", "robust"] = Field(
        "auto", description="from the noise, from the scatter of the runs, or the latter only where the model misfits"
    )
    tolerance: float = Field(1e-3, gt=0, description="largest last step, standard errors")


@dataclass(frozen=True, eq=False)
class TrajectoryEstimate:
    """All that is estimated.

    vector (n,), covariance (n, n) of it with its degrees_of_freedom. noise: of the reference. start_heading: standard
    deviation of the start headings, rad. start_corrections (Z, 3): what is to be added to the start poses, m, m, rad;
    clocks (Z, 2): offset (s) and slope of each run's reference clock. trajectories: ids of the Z runs.
    misfit: what shows that the model is wrong, or empty. description: what the covariance rests on.
    """

    vector: Array
    covariance: Array
    degrees_of_freedom: int
    noise: NoiseEstimate
    start_heading: float
    start_corrections: Array
    clocks: Array
    trajectories: tuple[str, ...]
    misfit: str
    description: str
    rounds: int
    settled: bool


@calibrators.register("trajectory_ml")
class TrajectoryML(Calibrator):
    """Efficient estimator: all reference poses, weighted by the noise that repetitions show; gives a covariance."""

    Options = TrajectoryMLOptions
    options: TrajectoryMLOptions
    stochastic = False

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """The estimate, whatever the problem's cost is unless the model misfits. DataError without reference poses."""
        found = self.estimate(problem)
        state = "settled" if found.settled else "not settled"
        reason = f"{state} after {found.rounds} rounds of noise and fit; covariance from {found.description}"
        return Solution(found.vector, reason, found.settled, found.covariance, found.noise.noise)

    def estimate(self, problem: CalibrationProblem) -> TrajectoryEstimate:
        """The estimate with all that belongs to it."""
        fit = TrajectoryFit(problem.trajectories, problem.parameterisation, problem.integration)
        begin = Estimate(problem.start, np.zeros((len(fit.trajectories), 3)))
        now = descend(problem, fit, begin, fit.whiteners(_FIRST), self._deviations(0.0), 0.1)
        for rounds in range(1, _MOST_ROUNDS + 1):
            before = now.estimate.vector
            noise, start_heading = self._noise(fit, now.estimate)
            deviations = self._deviations(start_heading)
            held = Estimate(before, np.where(deviations > 0, now.estimate.nuisances, 0.0))
            now = descend(problem, fit, held, fit.whiteners(noise.noise), deviations, self.options.tolerance)
            moved = now.estimate.vector - before
            settled = float(moved @ now.linear.information.sum(axis=0) @ moved) < 0.01
            if settled and now.settled:
                break
        return self._judged(problem, fit, now, noise, start_heading, rounds)

    def _judged(
        self,
        problem: CalibrationProblem,
        fit: TrajectoryFit,
        now: Descent,
        noise: NoiseEstimate,
        start_heading: float,
        rounds: int,
    ) -> TrajectoryEstimate:
        """The likeliest estimate, or another where it misfits, with its covariance."""
        options = self.options
        corrections = _start_corrections(fit, now.estimate, noise.noise)
        spread = _spread(problem, fit, now.linear)
        lack = spread.words if spread is not None and spread.lack_of_fit else ""
        by_cost = options.weights == "cost" or bool(lack and options.weights == "auto" and options.covariance != "model")
        if by_cost:
            weightings = _cost_weightings(problem, fit, now.estimate)
            now = descend(problem, fit, now.estimate, weightings, np.zeros(3), options.tolerance)
            spread = _spread(problem, fit, now.linear)
        model = _inverse(problem, now.linear)
        covariance, freedom, words = model, noise.degrees_of_freedom, f"the noise model: {noise.description}"
        if by_cost and spread is None:
            raise DataError("too few runs for the covariance of a fit that is weighted by the cost; use weights: noise")
        if spread is not None and options.covariance != "model":
            scatter = _full(problem, spread.covariance)
            if by_cost or options.covariance == "robust" or _wider_than(model, scatter, spread.degrees_of_freedom):
                covariance, freedom, words = scatter, spread.degrees_of_freedom, spread.words
        if lack and by_cost:
            words += "; so the squared pose errors of the cost are minimised, not those that the noise weights"
        return TrajectoryEstimate(
            vector=now.estimate.vector,
            covariance=covariance,
            degrees_of_freedom=freedom,
            noise=noise,
            start_heading=start_heading,
            start_corrections=corrections,
            clocks=now.estimate.nuisances[:, [OFFSET, SLOPE]],
            trajectories=tuple(run.id for run in fit.trajectories),
            misfit=lack,
            description=words,
            rounds=rounds,
            settled=now.settled,
        )

    def _deviations(self, start_heading: float) -> Array:
        """Expected sizes (3,) of the nuisances; 0 for those that are none."""
        clock = self.options.clock
        offset = 0.0 if clock == "none" else self.options.clock_offset
        return np.array([start_heading, offset, self.options.clock_slope if clock == "offset_and_slope" else 0.0])

    def _noise(self, fit: TrajectoryFit, estimate: Estimate) -> tuple[NoiseEstimate, float]:
        """The noise and the deviation of the start headings, by the residuals of an estimate."""
        straight = estimate.nuisances.copy()
        straight[:, TURN] = 0.0
        estimate = Estimate(estimate.vector, straight)
        residuals = fit.residuals(estimate)
        found = estimate_noise(fit.trajectories, residuals)
        if self.options.start == "exact":
            return found, 0.0
        apart = separate_start_noise(fit.trajectories, residuals, fit.turning(estimate), found.noise)
        least = apart.noise.pose_heading if self.options.start == "noisy" else 0.0
        return replace(found, noise=apart.noise), max(apart.start_heading, least)


def _cost_weightings(problem: CalibrationProblem, fit: TrajectoryFit, estimate: Estimate) -> list[Weighting]:
    """Pose errors at the stamps of the problem's cost, weighted as it does, each run the same, of unit size."""
    cost = problem.objective
    scale = np.array(cost.weights if isinstance(cost, SumOfNorms) else (1.0, 1.0, 1.0))
    chosen: list[Weighting] = [
        _Errors(scale / np.sqrt(1 if cost.stamps == "final" else len(run.pose_times) - 1), cost.stamps == "final")
        for run in fit.trajectories
    ]
    residuals = fit.residuals(estimate)
    squares = sum(float(np.square(weigh(own)).sum()) for weigh, own in zip(chosen, residuals, strict=True))
    size = max(np.sqrt(squares / len(chosen)), LEAST_WHITE)
    return [_Errors(weigh.scale / size, weigh.final) for weigh in chosen if isinstance(weigh, _Errors)]


@dataclass(frozen=True, eq=False)
class _Errors:
    """Residuals of a run times ``scale`` (3,): those of all poses, or of the last alone."""

    scale: Array
    final: bool

    def __call__(self, residuals: Array) -> Array:
        chosen = residuals[-1:] if self.final else residuals
        weighted: Array = chosen * self.scale.reshape(3, *([1] * (residuals.ndim - 2)))
        return weighted


def _start_corrections(fit: TrajectoryFit, estimate: Estimate, noise: Noise) -> Array:
    """What is to be added to the start poses (Z, 3), m, m, rad: the likeliest shift of each run, and its turn."""
    found = np.zeros((len(fit.trajectories), 3))
    found[:, 2] = estimate.nuisances[:, TURN]
    if noise.bias_position:
        weightings = fit.whiteners(noise.model_copy(update={"bias_position": 0.0}))
        for row, (weigh, own) in enumerate(zip(weightings, fit.residuals(estimate), strict=True)):
            ones, residuals = weigh(np.ones_like(own))[:, :2], weigh(own)[:, :2]
            found[row, :2] = -(ones * residuals).sum(axis=0) / (noise.bias_position**-2 + np.square(ones).sum(axis=0))
    return found


def _spread(problem: CalibrationProblem, fit: TrajectoryFit, linear: Linearisation) -> Sandwich | None:
    """The covariance (free, free) from the scatter of the runs, in widths of the box; None for too few runs."""
    free, unit = problem.free, (problem.upper - problem.lower)[problem.free]
    scores = linear.scores[:, free] * unit
    information = linear.information[:, free][:, :, free] * np.outer(unit, unit)
    try:
        return sandwich(Pulls(scores, information, fit.trajectories, np.zeros(len(unit))))
    except DataError:
        return None


def _inverse(problem: CalibrationProblem, linear: Linearisation) -> Array:
    """The covariance (n, n) that the noise means; zero where held, and along what the data do not tell at all."""
    free, unit = problem.free, (problem.upper - problem.lower)[problem.free]
    information = linear.information.sum(axis=0)[np.ix_(free, free)] * np.outer(unit, unit)
    return _full(problem, np.linalg.pinv(information, rcond=1e-12, hermitian=True))


def _full(problem: CalibrationProblem, covariance: Array) -> Array:
    """A covariance (free, free) in widths of the box as one (n, n) of the vector."""
    free, unit = problem.free, (problem.upper - problem.lower)[problem.free]
    whole = np.zeros((problem.size, problem.size))
    whole[np.ix_(free, free)] = covariance * np.outer(unit, unit)
    return whole


def _wider_than(model: Array, scatter: Array, freedom: int) -> bool:
    """Whether a covariance from scatter is wider, by more than chance, than that of the noise model."""
    values, directions = np.linalg.eigh(model / np.sqrt(np.outer(*[np.maximum(np.diag(model), 1e-300)] * 2)))
    raise NotImplementedError
