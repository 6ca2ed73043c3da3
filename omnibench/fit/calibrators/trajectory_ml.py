"""Maximum likelihood over whole trajectories: every reference pose, weighted by the noise that repetitions show.

The reference errors of a run are white noise, a random walk and a bias (fit/noise.py), whose variances are
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
(fit/sandwich.py), also where no repetition shows the noise.

With a robust loss poses and starts that are off by more than the noise explains have less weight, and the noise is that
of the others. An error of a pose is compared with what the other poses of its run say of it. With u its difference from
that and V the variance of u under the noise, diagonal over the coordinates, and s the scale of all poses by Eq. (2) or
(4) of fit/loss.py, at least 1, its weight w (Eq. 5 there, 1 for no error) gives the pose the variance

    V / w,   w = w(x / s),   x^2 = u' V^-1 u,                                                              (1)

so that V (1/w - 1) adds to its white noise: the scale mixtures of normal errors that t distributions are, and the
weights of a robust loss, for errors that are not independent (Lange, Little and Taylor 1989, section 2). A start that
is off shifts a run. Where the likeliest shift has a weight of less than a fifth by the same rule, over the runs, with
the noise's bias in V, its square adds to that of the bias. A heading that is off there turns the
path, too: the run then has the weight. Misfit of the model is in all runs, and in s.

The covariance is from the noise model or from the scatter of the runs. In coordinates in which the information of all
runs is the unit matrix, the scatter of d directions, S, has the unit matrix for its expectation under the noise model.
Where commands and sessions scatter no more than their repetitions explain, which the sandwich tests, it is wider than
that at the level a if

    tr S / d > chi2(1 - a; v) / v,                                                                        (2)

v being the degrees of freedom of the sandwich's trace, its Eq. (9). The noise model itself is known from D differences
between runs. The part of the noise that all poses of a run share is one number a difference and coordinate, and a
position has two coordinates of the same variance. The variances of positions have at least

    2 D                                                                                                   (3)

degrees of freedom, more where white noise dominates. Those of headings have one coordinate, and D. (3) is taken for
all numbers: with such a shared part, of the elements of the heading's row 99 % of the intervals hold the truth with
D = 4, and 97 % with D = 6.

Without repetitions the residuals of D runs stand in for differences. Of the 3 D numbers of the shared parts a fit of n
numbers leaves 3 D - n, and for the variances of positions two thirds of these,

    2 D - 2 n / 3.                                                                                        (4)

One is taken where that is less. Likelihood does not know what the fit has taken either, and finds variances that are
too small. So the scatter of the runs, which is corrected for that, stands for the noise model wherever the runs are
enough for it: from five runs of configs/small.yaml, each command driven once, the noise model's intervals hold the
truth in 87 %, those of the scatter in 96 %.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field, model_validator
from scipy.special import chdtri

from omnibench.config import Positive
from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError, DataError
from omnibench.fit import trajectory_fit
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.gauss_newton import BoxedFit, Descent, descend, first_fit
from omnibench.fit.loss import OFF, Loss, LossName, RobustCost, cost_weightings, loss_of, make_loss, mean_curvature
from omnibench.fit.noise import FIRST_NOISE, ExtraVariance, NoiseEstimate, Whitener, is_near, roots_of, whiteners
from omnibench.fit.problem import CalibrationProblem
from omnibench.fit.sandwich import CHANCE, Sandwich, Scores, sandwich
from omnibench.fit.trajectory_fit import EstimatedCovariance
from omnibench.registry import Options, calibrators
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

_PASSES = 3  # of weights that follow from each other: neighbours that are off hide each other
# Share of the noise model's variance below which the scatter is rounding. The noise is 1e-9 m or rad at least; exact
# models of exact poses leave 1e-14 of its variance, Euler steps in flowers 1e10 times it.
_ROUNDING = 1e-6
# Rounds of noise and fit settle after two or three; only where the clocks' errors are estimated, too, do they take more
# than five. In tests/studies/constants_fit.py five rounds at most, or a change of 0.2, move an estimate with clocks
# by 0.1 and 0.2 of its standard deviation; 20 rounds, a change of 0.05 and half and twice _NEAR move none.
_MOST_ROUNDS = 10
_FIRST_WEIGHTS = 5  # fits with Huber's weights before the noise is estimated from poses that are not off
_MOST_REWEIGHTED = 50  # fits by the weights of a robust cost
_WALKS = 2  # times that the walk of the odometry beside references is estimated, and the fit done again
_NEAR = 0.01  # share of the largest component of the noise by which components of the same noise differ
_STILL = 0.1  # standard errors: a smaller change of the vector ends the rounds


@dataclass(frozen=True, eq=False)
class RunWeights:
    """Weights of a run: of its poses (K,), and as a whole; and the variances that stand for them.

    near: False if the run's start is off.
    """

    poses: Array
    whole: float
    extra: ExtraVariance
    near: bool


@dataclass(frozen=True, eq=False)
class RobustWeighting:
    """Whitens residuals of a run as its Whitener does, at variances that its weights change."""

    whitener: Whitener
    weight: float

    def __call__(self, residuals: Array) -> Array:
        """Weighted residuals (K, 3) or derivatives (K, 3, n)."""
        return float(np.sqrt(self.weight)) * self.whitener(residuals)


@dataclass(frozen=True, eq=False)
class RobustNoise:
    """Weights of every run under a noise.

    curvature: mean of the loss's second derivatives over that of the weights, by which these overstate the information.
    """

    noise: Noise
    runs: tuple[RunWeights, ...]
    curvature: float

    def weightings(self, stamps: Sequence[Array]) -> list[RobustWeighting]:
        """The weighting of every run, whose poses have stamps (K,)."""
        return [
            RobustWeighting(Whitener(self.noise, times, of_run.extra), of_run.whole)
            for times, of_run in zip(stamps, self.runs, strict=True)
        ]

    def without_jumps(self, fit: trajectory_fit.TrajectoryFit) -> trajectory_fit.TrajectoryFit:
        """The fit without the poses, and without the runs, that are off; the whole fit if nothing were left."""
        chosen = [np.flatnonzero(of_run.poses >= OFF) for of_run in self.runs]
        near = [index for index, of_run in enumerate(self.runs) if of_run.near and len(chosen[index])]
        if not near:
            return fit
        runs = tuple(trajectory_fit.with_poses(fit.runs[index], np.append(0, 1 + chosen[index])) for index in near)
        return replace(fit, runs=runs, nuisances=replace(fit.nuisances, values=fit.nuisances.values[near]))


def robust_noise(
    noise: Noise, fit: trajectory_fit.TrajectoryFit, loss: LossName, before: RobustNoise | None = None
) -> RobustNoise:
    """The weights of a fit's runs under a noise, from earlier ones."""
    of_pose, of_position, of_heading = (make_loss(loss, coordinates) for coordinates in (3, 2, 1))
    assert of_pose is not None  # the calibrator has checked that it is no loss of squares
    assert of_position is not None
    assert of_heading is not None
    if before is None:
        nothing = [np.zeros(len(stamps)) for stamps in fit.stamps]
        extras = [ExtraVariance((zeros, 0.0), (zeros, 0.0)) for zeros in nothing]
    else:
        extras = [run.extra for run in before.runs]
    unbiased = noise.model_copy(update={"bias_position": 0.0, "bias_heading": 0.0})
    bias = np.square([noise.bias_position, noise.bias_position, noise.bias_heading])
    for _ in range(_PASSES):
        left_out = [
            Whitener(noise, stamps, extra).left_out(residuals)
            for stamps, extra, residuals in zip(fit.stamps, extras, fit.residuals, strict=True)
        ]
        usual = [
            np.maximum(variances - np.stack([extra.position[0], extra.position[0], extra.heading[0]], axis=1), 1e-300)
            for (_, variances), extra in zip(left_out, extras, strict=True)
        ]
        norms = [np.sqrt((np.square(u) / v).sum(axis=1)) for (u, _), v in zip(left_out, usual, strict=True)]
        weights, curvature = _weights(of_pose, np.concatenate(norms))
        of_runs = np.split(weights, np.cumsum([len(of_run) for of_run in norms])[:-1])
        poses = [(v[:, 0] * (1 / w - 1), v[:, 2] * (1 / w - 1)) for v, w in zip(usual, of_runs, strict=True)]
        # Likeliest shifts (Z, 3) of the runs, and their variances with the bias.
        likeliest = [
            Whitener(unbiased, stamps, ExtraVariance((position, 0.0), (heading, 0.0))).shift(residuals)
            for stamps, (position, heading), residuals in zip(fit.stamps, poses, fit.residuals, strict=True)
        ]
        shifts = np.array([shift for shift, _ in likeliest])
        variances = np.array([of_shift for _, of_shift in likeliest]) + bias
        positions, _ = _weights(of_position, np.sqrt((np.square(shifts) / variances)[:, :2].sum(axis=1)))
        headings, _ = _weights(of_heading, np.abs(shifts[:, 2]) / np.sqrt(variances[:, 2]))
        positions, headings = (np.where(of_start < OFF, of_start, 1.0) for of_start in (positions, headings))
        squares = np.square(shifts)
        extras = [
            ExtraVariance((of_position, float(first)), (of_heading, float(second)))
            for (of_position, of_heading), first, second in zip(
                poses,
                np.where(positions < 1, squares[:, :2].mean(axis=1), 0.0),
                np.where(headings < 1, squares[:, 2], 0.0),
                strict=True,
            )
        ]
    near = (positions == 1) & (headings == 1)
    runs = zip(of_runs, headings, extras, near, strict=True)
    return RobustNoise(noise, tuple(RunWeights(w, float(whole), x, bool(n)) for w, whole, x, n in runs), curvature)


def _weights(loss: Loss, norms: Array) -> tuple[Array, float]:
    """Weights (S,) of norms (S,), Eq. (1), and the curvature of the loss, see RobustNoise."""
    shares = np.full(len(norms), 1 / len(norms))
    ratios = norms / max(float(loss.scales(norms[None], shares)[0]), 1.0)
    return loss.weights(ratios) / float(loss.weights(np.zeros(1))[0]), loss.mean_curvature(ratios, shares)


class FitCovariance:
    """Covariances of the numbers (n,) of a whitened fit, from its noise model and from the scatter of its runs.

    by_model: inverse of the information, zero along undetermined directions. scatter: the sandwich of
    fit/sandwich.py, None if there are too few runs. Both are zero in rows and columns whose ``unit`` (n,) is 0;
    others are the units of the numbers in which directions are judged as undetermined. curvature: of a robust loss, as
    a share of the information of its weights. freedom_of: degrees of freedom (n,) of a covariance (n, n) at most.
    """

    scatter: Sandwich | None = None

    def __init__(
        self,
        data: trajectory_fit.Whitened,
        runs: Sequence[Trajectory],
        noise: NoiseEstimate,
        unit: Array,
        curvature: float = 1.0,
        freedom_of: Callable[[Array], Array] | None = None,
    ) -> None:
        scores, information = data.scores * unit, data.information_of_runs * np.outer(unit, unit)
        roots = roots_of(information.sum(axis=0))
        self._noise, self._roots = noise, unit[:, None] * roots
        fitted = roots.shape[1] if noise.source == "within runs" else 0
        freedom: Array | float = max(2 * noise.degrees_of_freedom - 2 * fitted / 3, 1)  # Eq. (3), (4)
        covariance = self._roots @ self._roots.T
        if freedom_of is not None:
            freedom = np.minimum(freedom, freedom_of(covariance))
        self.by_model = EstimatedCovariance(covariance, freedom)
        if not roots.size:
            return
        with suppress(DataError):
            scatter = sandwich(Scores(scores, curvature * information, runs, np.zeros(len(unit)), information))
            real = float(np.square(scores @ roots).sum()) > _ROUNDING * roots.shape[1]
            self.scatter = replace(
                scatter,
                covariance=scatter.covariance * np.outer(unit, unit),
                clustered=scatter.clustered and real,
                lack_of_fit=scatter.lack_of_fit and real,
            )

    def chosen(self, robust: bool) -> tuple[EstimatedCovariance, str]:
        """The covariance of the noise model or, if ``robust``, of the scatter, and its source in words.

        DataError: the runs are too few for their scatter.
        """
        if not robust:
            return self.by_model, f"the noise model ({self._noise.description})"
        if self.scatter is None:
            raise DataError("too few runs for a covariance from their scatter; use covariance: model, weights: noise")
        return EstimatedCovariance(self.scatter.covariance, self.scatter.effective_freedom), self.scatter.words

    @property
    def scatter_stands(self) -> bool:
        """True if the runs scatter significantly more than the noise model, or than their repetitions explain.

        The scatter stands, too, where no repetition shows the noise.
        """
        if self.scatter is None:
            return False
        if self._noise.source == "within runs" or self.scatter.clustered:
            return True
        back = np.linalg.pinv(self._roots)
        values = np.linalg.eigvalsh(back @ self.scatter.covariance @ back.T)
        freedom = self.scatter.freedom_of_trace
        return float(values.mean()) > float(chdtri(freedom, CHANCE)) / freedom  # Eq. (2)


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
    nuisances: trajectory_fit.Nuisances
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
            # No run has poses: references say how exact they are, their errors how odometry wanders.
            now = descend(fit, [], self.options.tolerance)
            for _ in range(_WALKS):
                now = descend(now.fit.with_walk(), [], self.options.tolerance)
            references = now.fit.references or fit.references
            return self._conclude(now, references.noise, 1 + _WALKS, now.settled, 1.0)
        stamps = fit.trajectories.stamps
        now = descend(self._with_deviations(fit, 0.0), whiteners(FIRST_NOISE, stamps), _STILL)
        loss = loss_of(problem.objective)
        heavy: RobustNoise | None = None
        for _ in range(0 if loss == "squares" else _FIRST_WEIGHTS):  # Student's t needs a start near its minimum
            heavy = robust_noise(FIRST_NOISE, now.fit.trajectories, "huber", heavy)
            now = descend(now.fit, heavy.weightings(stamps), _STILL)
        noise: trajectory_fit.FitNoise | None = None
        rounds, settled = 0, False
        while not settled and rounds < _MOST_ROUNDS:
            before, earlier = now.fit, noise
            usual = before.trajectories if heavy is None else heavy.without_jumps(before.trajectories)
            kinds = [] if self.options.start == "exact" else [trajectory_fit.TURN]
            noise = trajectory_fit.noise_of_fit(usual, kinds, None if earlier is None else earlier.estimate.noise)
            least = noise.estimate.noise.pose_heading if self.options.start == "noisy" else 0.0
            noise = replace(noise, deviations=np.maximum(noise.deviations, [least, 0.0, 0.0]))
            fit = self._with_deviations(before, noise.deviations[trajectory_fit.TURN]).with_walk()
            weightings: Sequence[trajectory_fit.Weighting] = whiteners(noise.estimate.noise, stamps)
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
        deviations = np.array([start_heading, offset * (clock != "none"), slope * (clock == "offset_and_slope")])
        values = np.where(deviations > 0, fit.trajectories.nuisances.values, 0.0)
        return fit.with_nuisances(trajectory_fit.Nuisances(values, deviations))


def _descend_cost(fit: BoxedFit, tolerance: float) -> tuple[Descent, float]:
    """The minimum of the squares that imitate the problem's cost, by its weights at each fit where it is robust.

    The second value is the curvature of its loss, see RobustNoise.
    """
    objective = fit.problem.objective
    settled = False
    for _ in range(_MOST_REWEIGHTED):
        trajectories = fit.trajectories
        now = descend(fit, cost_weightings(objective, trajectories.runs, trajectories.residuals), tolerance)
        moved = now.fit.vector - fit.vector
        settled = not isinstance(objective, RobustCost) or float(moved @ now.data.information @ moved) < tolerance**2
        if settled:
            break
        fit = now.fit
    curvature = 1.0
    if isinstance(objective, RobustCost):
        curvature = mean_curvature(objective, now.fit.trajectories.residuals)
    return replace(now, settled=now.settled and settled), curvature
