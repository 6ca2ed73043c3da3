"""Maximum likelihood over whole trajectories: every reference pose, weighted by the noise that repetitions show.

The reference errors of a run are white noise, a random walk and a bias (least_squares/noise.py), whose variances are
estimated from the differences between repetitions of a command. Generalised least squares with these variances is
statistically efficient as long as the model is right. Nuisances of each run:

- The start pose. The reference at t = 0 is an observation, too. Its position error is exactly a bias of the run, which
  the noise model contains. Its heading error also turns the path, which distinguishes it from a biased heading: its
  variance is estimated from the repetitions and is zero if insignificant, so that exact starts (simulation) lose no
  information and noisy ones (real recordings) do no harm.
- Offset and slope of the reference's clock, where asked for, with a weak prior about zero.

Where the runs scatter more than their noise explains, no matrix is right, and the best one depends on its purpose: the
squared pose errors at the stamps of the problem's cost are then minimised, with starts and clocks kept as the
likelihood found them. The covariance is that of the noise model, or the sandwich of the scatter
(uncertainty/sandwich.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from omnibench.errors import DataError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.cost_weights import cost_weightings
from omnibench.fit.least_squares.gauss_newton import Descent, descend
from omnibench.fit.least_squares.noise import NoiseEstimate, estimate_noise
from omnibench.fit.least_squares.start_noise import separate_start_noise
from omnibench.fit.least_squares.trajectory_covariance import FitCovariance
from omnibench.fit.least_squares.trajectory_fit import OFFSET, SLOPE, TURN, Estimate, TrajectoryFit
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

# First guess of the noise, replaced after one fit: 1 cm or 0.01 rad, and as much again in a second.
_FIRST = Noise(pose_position=0.01, pose_heading=0.01, walk_position=0.01, walk_heading=0.01)
_MOST_ROUNDS = 10
_STILL = 0.1  # standard errors: a smaller change of the vector ends the rounds of noise and fit; chosen


class TrajectoryMLOptions(Options):
    """Nuisances of each run, weights and covariance."""

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

    @model_validator(mode="after")
    def _covariance_belongs_to_weights(self) -> TrajectoryMLOptions:
        if self.covariance == "model" and self.weights == "cost":
            raise ValueError("covariance: model is that of noise weights; with weights: cost use robust")
        return self


@dataclass(frozen=True, eq=False)
class TrajectoryEstimate:
    """The estimate with its nuisances and covariance.

    vector (n,), its covariance (n, n) and degrees_of_freedom. noise: noise model of the reference. start_heading:
    standard deviation of the start headings, rad. start_corrections (Z, 3): corrections added to the start poses, m, m,
    rad. clocks (Z, 2): offset (s) and slope of each run's reference clock. trajectories: ids of the Z runs. misfit:
    evidence in words that the model is wrong, or empty. description: source of the covariance, in words. rounds: number
    of rounds of noise and fit. settled: True if they converged.
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
        """The estimate, which depends on the problem's cost only if the model misfits. DataError without poses."""
        estimate = self.estimate(problem)
        state = "settled" if estimate.settled else "not settled"
        reason = f"{state} after {estimate.rounds} rounds of noise and fit; covariance from {estimate.description}"
        return Solution(
            estimate.vector,
            reason,
            estimate.settled,
            estimate.covariance,
            estimate.noise.noise,
            estimate.degrees_of_freedom,
        )

    def estimate(self, problem: CalibrationProblem) -> TrajectoryEstimate:
        """Fit and noise estimated in turn until neither changes, then weights and covariance chosen."""
        fit = TrajectoryFit(problem.trajectories, problem.parameterisation, problem.integration)
        begin = Estimate(problem.start, np.zeros((len(fit.trajectories), 3)))
        now = descend(problem, fit, begin, fit.whiteners(_FIRST), self._deviations(0.0), 0.1)
        noise: _Noise | None = None
        rounds, settled = 0, False
        while not settled and rounds < _MOST_ROUNDS:
            before, earlier = now.estimate, noise
            noise = self._noise(fit, before, earlier)
            deviations = self._deviations(noise.start_heading)
            held = Estimate(before.vector, np.where(deviations > 0, before.nuisances, 0.0))
            now = descend(problem, fit, held, fit.whiteners(noise.estimate.noise), deviations, self.options.tolerance)
            moved = now.estimate.vector - before.vector
            still = float(moved @ now.linear.information.sum(axis=0) @ moved) < _STILL**2
            settled = now.settled and (still or (earlier is not None and noise.is_near(earlier)))
            rounds += 1
        assert noise is not None  # there is at least one round
        return self._conclude(problem, fit, now, noise, rounds, settled)

    def _conclude(
        self,
        problem: CalibrationProblem,
        fit: TrajectoryFit,
        now: Descent,
        with_starts: _Noise,
        rounds: int,
        settled: bool,
    ) -> TrajectoryEstimate:
        """The maximum likelihood estimate, or the one weighted by the cost if the model misfits; its covariance."""
        options, noise = self.options, with_starts.estimate
        corrections = _start_corrections(fit, now.estimate, noise.noise)
        covariance = FitCovariance(problem, now.linear, fit.trajectories)
        misfit = covariance.scatter.words if covariance.lack_of_fit and covariance.scatter else ""
        by_cost = options.weights == "cost" or (
            options.weights == "auto" and bool(misfit) and options.covariance != "model"
        )
        if by_cost:
            weightings = cost_weightings(problem.objective, fit.trajectories, fit.residuals(now.estimate))
            now = descend(problem, fit, now.estimate, weightings, np.zeros(3), options.tolerance)
            covariance = FitCovariance(problem, now.linear, fit.trajectories)
        matrix, freedom, words = self._covariance(covariance, noise, by_cost)
        return TrajectoryEstimate(
            vector=now.estimate.vector,
            covariance=matrix,
            degrees_of_freedom=freedom,
            noise=noise,
            start_heading=with_starts.start_heading,
            start_corrections=corrections,
            clocks=now.estimate.nuisances[:, [OFFSET, SLOPE]],
            trajectories=tuple(run.id for run in fit.trajectories),
            misfit=misfit,
            description=words,
            rounds=rounds,
            settled=settled and now.settled,
        )

    def _covariance(self, covariance: FitCovariance, noise: NoiseEstimate, by_cost: bool) -> tuple[Array, int, str]:
        """The covariance (n, n), its degrees of freedom and its source in words."""
        asked, scatter = self.options.covariance, covariance.scatter
        robust = by_cost or asked == "robust" or (asked == "auto" and covariance.scatter_is_wider)
        if not robust:
            return covariance.model, noise.degrees_of_freedom, f"the noise model ({noise.description})"
        if scatter is None:
            raise DataError("too few runs for a covariance from their scatter; use covariance: model, weights: noise")
        words = f"{scatter.words}; weighted by the cost" if by_cost else scatter.words
        return scatter.covariance, scatter.degrees_of_freedom, words

    def _deviations(self, start_heading: float) -> Array:
        """Standard deviations (3,) of the nuisances; 0 for those that are not estimated."""
        clock = self.options.clock
        offset = 0.0 if clock == "none" else self.options.clock_offset
        return np.array([start_heading, offset, self.options.clock_slope if clock == "offset_and_slope" else 0.0])

    def _noise(self, fit: TrajectoryFit, estimate: Estimate, earlier: _Noise | None) -> _Noise:
        """The noise and the deviation of the start headings, from the residuals of an estimate."""
        straight = estimate.nuisances.copy()
        straight[:, TURN] = 0.0
        estimate = Estimate(estimate.vector, straight)
        residuals = fit.residuals(estimate)
        near = None if earlier is None else earlier.estimate.noise
        noise = estimate_noise(fit.trajectories, residuals, near)
        if self.options.start == "exact":
            return _Noise(noise, 0.0)
        apart = separate_start_noise(fit.trajectories, residuals, fit.turning(estimate), noise.noise)
        least = apart.noise.pose_heading if self.options.start == "noisy" else 0.0
        return _Noise(replace(noise, noise=apart.noise), max(apart.start_heading, least))


@dataclass(frozen=True)
class _Noise:
    """The noise of the reference, and the standard deviation of the start headings, rad."""

    estimate: NoiseEstimate
    start_heading: float

    def is_near(self, other: _Noise) -> bool:
        """True if no component differs by more than 1 % of the largest component."""
        ours, theirs = (
            np.array([*noise.estimate.noise.model_dump().values(), noise.start_heading]) for noise in (self, other)
        )
        return bool((np.abs(ours - theirs) <= 0.01 * np.maximum(ours, theirs).max()).all())


def _start_corrections(fit: TrajectoryFit, estimate: Estimate, noise: Noise) -> Array:
    """Corrections (Z, 3) that are added to the start poses, m, m, rad: the likeliest shift and turn of each run."""
    corrections = np.zeros((len(fit.trajectories), 3))
    corrections[:, 2] = estimate.nuisances[:, TURN]
    if noise.bias_position:
        weightings = fit.whiteners(noise.model_copy(update={"bias_position": 0.0}))
        for row, (weigh, errors) in enumerate(zip(weightings, fit.residuals(estimate), strict=True)):
            ones, residuals = weigh(np.ones_like(errors))[:, :2], weigh(errors)[:, :2]
            information = noise.bias_position**-2 + np.square(ones).sum(axis=0)
            corrections[row, :2] = -(ones * residuals).sum(axis=0) / information
    return corrections
