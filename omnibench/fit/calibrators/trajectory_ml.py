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
(uncertainty/sandwich.py), also where no repetition shows the noise.

With a robust loss poses and starts that are off have less weight (least_squares/robust_noise.py), and the noise is that
of the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from omnibench.config import Positive
from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.least_squares.gauss_newton import BoxedFit, Descent, descend, first_fit
from omnibench.fit.least_squares.noise import FIRST_NOISE, NoiseEstimate, is_near, whiteners
from omnibench.fit.least_squares.nuisance_noise import FitNoise, noise_of_fit
from omnibench.fit.least_squares.nuisances import TURN, Nuisances, Weighting
from omnibench.fit.least_squares.robust_noise import RobustNoise, robust_noise
from omnibench.fit.least_squares.trajectory_covariance import FitCovariance
from omnibench.fit.least_squares.trajectory_fit import TrajectoryFit
from omnibench.fit.loss.cost_weights import cost_weightings, mean_curvature
from omnibench.fit.loss.robust_cost import RobustCost, loss_of
from omnibench.fit.observations.reference_fit import ReferenceFit
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.uncertainty.intervals import EstimatedCovariance
from omnibench.registry import Options, calibrators
from omnibench.robot.kinematics import Array

# Rounds of noise and fit settle after two or three; only where the clocks' errors are estimated, too, do they take more
# than five. In tests/studies/constants_fit.py five rounds at most, or a change of 0.2, move an estimate with clocks
# by 0.1 and 0.2 of its standard deviation; 20 rounds, a change of 0.05 and half and twice _NEAR move none.
_MOST_ROUNDS = 10
_FIRST_WEIGHTS = 5  # fits with Huber's weights before the noise is estimated from poses that are not off
_MOST_REWEIGHTED = 50  # fits by the weights of a robust cost
_WALKS = 2  # times that the walk of the odometry beside references is estimated, and the fit done again
_NEAR = 0.01  # share of the largest component of the noise by which components of the same noise differ
_STILL = 0.1  # standard errors: a smaller change of the vector ends the rounds


class TrajectoryMLOptions(Options):
    """Nuisances of each run, weights and covariance."""

    start: Literal["auto", "exact", "noisy"] = Field(
        "auto", description="start headings of the runs: noisy where repetitions show it, exact, or at least as poses"
    )
    clock: Literal["none", "offset", "offset_and_slope"] = Field("none", description="of the reference, for each run")
    clock_offset: Positive = Field(0.2, description="its expected size, s")
    clock_slope: Positive = Field(0.003, description="its expected size, s per s")
    weights: Literal["auto", "noise", "cost"] = Field(
        "auto", description="of the noise, of the problem's cost, or the latter only where the model misfits"
    )
    covariance: Literal["auto", "model", "robust"] = Field(
        "auto",
        description="from the noise, from the scatter of the runs, or the latter only where the model misfits or no "
        "command is repeated",
    )
    tolerance: float = Field(1e-3, gt=0, description="largest last step, standard errors")

    @model_validator(mode="after")
    def _covariance_belongs_to_weights(self) -> TrajectoryMLOptions:
        if self.covariance == "model" and self.weights == "cost":
            raise ValueError("covariance: model is that of noise weights; with weights: cost use robust")
        return self


@dataclass(frozen=True, eq=False)
class TrajectoryEstimate:
    """The estimate of a vector (n,) with its covariance.

    noise: noise model of the reference. nuisances: of each run with reference poses after its start. misfit: evidence
    in words that the model is wrong, or empty. description: source of the covariance, in words. rounds: number of
    rounds of noise and fit. settled: True if they converged.
    """

    vector: Array
    covariance: EstimatedCovariance
    noise: NoiseEstimate
    nuisances: Nuisances
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
            estimate.covariance.matrix,
            estimate.noise.noise,
            estimate.covariance.degrees_of_freedom,
        )

    def estimate(self, problem: CalibrationProblem) -> TrajectoryEstimate:
        """Fit and noise estimated in turn until neither changes, then weights and covariance chosen."""
        fit = first_fit(problem)
        if fit.references is not None:
            self._check_references(problem)
        if not fit.trajectories.runs and fit.references is not None:
            return self._by_references(fit, fit.references)
        stamps = fit.trajectories.stamps
        now = descend(self._with_deviations(fit, 0.0), whiteners(FIRST_NOISE, stamps), _STILL)
        loss = loss_of(problem.objective)
        heavy: RobustNoise | None = None
        for _ in range(0 if loss == "squares" else _FIRST_WEIGHTS):  # Student's t needs a start near its minimum
            heavy = robust_noise(FIRST_NOISE, now.fit.trajectories, "huber", heavy)
            now = descend(now.fit, heavy.weightings(stamps), _STILL)
        noise: FitNoise | None = None
        rounds, settled = 0, False
        while not settled and rounds < _MOST_ROUNDS:
            before, earlier = now.fit, noise
            usual = before.trajectories if heavy is None else heavy.without_jumps(before.trajectories)
            noise = self._noise(usual, earlier)
            fit = self._with_deviations(before, noise.deviations[TURN]).with_walk()
            weightings: Sequence[Weighting] = whiteners(noise.estimate.noise, stamps)
            if heavy is not None:
                heavy = robust_noise(noise.estimate.noise, fit.trajectories, loss, heavy)
                weightings = heavy.weightings(stamps)
            now = descend(fit, weightings, self.options.tolerance)
            moved = now.fit.vector - before.vector
            still = float(moved @ now.data.information @ moved) < _STILL**2
            if heavy is None:  # weights may still change where the noise does not
                still = still or (earlier is not None and is_near(noise.sizes, earlier.sizes, _NEAR))
            settled = now.settled and still
            rounds += 1
        assert noise is not None  # there is at least one round
        return self._conclude(now, noise.estimate, rounds, settled, 1.0 if heavy is None else heavy.curvature)

    def _by_references(self, fit: BoxedFit, references: ReferenceFit) -> TrajectoryEstimate:
        """The estimate where no run has poses: references say how exact they are, their errors how odometry wanders."""
        now = descend(fit, [], self.options.tolerance)
        for _ in range(_WALKS):
            now = descend(now.fit.with_walk(), [], self.options.tolerance)
        references = now.fit.references or references
        return self._conclude(now, references.noise, 1 + _WALKS, now.settled, 1.0)

    def _check_references(self, problem: CalibrationProblem) -> None:
        """ConfigError: an option is asked for that is of poses, and references of other kinds are fitted, too."""
        if loss_of(problem.objective) != "squares":
            raise ConfigError(
                f"trajectory_ml weighs references that are no poses by their own sigma, without the loss "
                f"{loss_of(problem.objective)}: leave the loss out, or take the calibrator closed_form"
            )
        if self.options.weights == "cost":
            raise ConfigError(
                "weights: cost is of poses; references that are no poses have their own sigma: leave weights out"
            )

    def _conclude(
        self, now: Descent, noise: NoiseEstimate, rounds: int, settled: bool, curvature: float
    ) -> TrajectoryEstimate:
        """The maximum likelihood estimate, or the one weighted by the cost if the model misfits; its covariance."""
        options, fit = self.options, now.fit.trajectories
        covariance = self._covariance(now, noise, curvature)
        misfit = covariance.scatter.words if covariance.scatter and covariance.scatter.lack_of_fit else ""
        by_cost = options.weights == "cost" or (
            options.weights == "auto" and bool(misfit) and options.covariance != "model" and now.fit.references is None
        )
        if by_cost:
            held = now.fit.with_nuisances(fit.nuisances.held())
            now, curvature = _descend_cost(held, options.tolerance)
            covariance = self._covariance(now, noise, curvature)
        robust = options.covariance == "robust" or (options.covariance == "auto" and covariance.scatter_stands)
        chosen, words = covariance.chosen(by_cost or robust)
        return TrajectoryEstimate(
            vector=now.fit.vector,
            covariance=chosen,
            noise=noise,
            nuisances=fit.nuisances,
            misfit=misfit,
            description=f"{words}; weighted by the cost" if by_cost else words,
            rounds=rounds,
            settled=settled and now.settled,
        )

    def _covariance(self, now: Descent, noise: NoiseEstimate, curvature: float) -> FitCovariance:
        """The covariances of a descent's vector, held elements with none."""
        problem = now.fit.problem
        unit = np.where(problem.free, problem.upper - problem.lower, 0.0)
        return FitCovariance(now.data, now.fit.runs, noise, unit, curvature, now.fit.freedom_of_walk)

    def _with_deviations(self, fit: BoxedFit, start_heading: float) -> BoxedFit:
        """The fit with the nuisances' standard deviations; those that are not estimated are 0."""
        clock, offset, slope = self.options.clock, self.options.clock_offset, self.options.clock_slope
        asked = [start_heading, offset * (clock != "none"), slope * (clock == "offset_and_slope")]
        deviations = np.array(asked)
        values = np.where(deviations > 0, fit.trajectories.nuisances.values, 0.0)
        return fit.with_nuisances(Nuisances(values, deviations))

    def _noise(self, fit: TrajectoryFit, earlier: FitNoise | None) -> FitNoise:
        """The noise and the deviation of the start headings, from the residuals of a fit."""
        start = self.options.start
        near = None if earlier is None else earlier.estimate.noise
        found = noise_of_fit(fit, [] if start == "exact" else [TURN], near)
        least = found.estimate.noise.pose_heading if start == "noisy" else 0.0
        return replace(found, deviations=np.maximum(found.deviations, [least, 0.0, 0.0]))


def _descend_cost(fit: BoxedFit, tolerance: float) -> tuple[Descent, float]:
    """The minimum of the squares that imitate the problem's cost, by its weights at each fit where it is robust.

    The second value is the curvature of its loss, see RobustNoise.
    """
    objective = fit.problem.objective
    if not isinstance(objective, RobustCost):
        trajectories = fit.trajectories
        return descend(fit, cost_weightings(objective, trajectories.runs, trajectories.residuals), tolerance), 1.0
    for _ in range(_MOST_REWEIGHTED):
        trajectories = fit.trajectories
        now = descend(fit, cost_weightings(objective, trajectories.runs, trajectories.residuals), tolerance)
        moved = now.fit.vector - fit.vector
        if float(moved @ now.data.information @ moved) < tolerance**2:
            return now, mean_curvature(objective, now.fit.trajectories.residuals)
        fit = now.fit
    return replace(now, settled=False), mean_curvature(objective, now.fit.trajectories.residuals)
