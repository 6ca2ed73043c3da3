"""Noise with heavy tails: single poses, and starts of runs, that are off by more than the noise explains.

An error of a pose is compared with what the other poses of its run say of it. With u its difference from that and V
the variance of u under the noise, diagonal over the coordinates, and s the scale of all poses by Eq. (2) or (4) of
fit/loss/losses.py, at least 1, its weight w (Eq. 5 there, 1 for no error) gives the pose the variance

    V / w,   w = w(x / s),   x^2 = u' V^-1 u,                                                              (1)

so that V (1/w - 1) adds to its white noise: the scale mixtures of normal errors that t distributions are, and the
weights of a robust loss, for errors that are not independent (Lange, Little and Taylor 1989, section 2). A start that
is off shifts a run. Where the likeliest shift has a weight of less than a fifth by the same rule, over the runs, with
the noise's bias in V, its square adds to that of the bias. A heading that is off there turns the
path, too: the run then has the weight. Misfit of the model is in all runs, and in s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.fit.least_squares.noise import ExtraVariance, Whitener
from omnibench.fit.least_squares.trajectory_fit import TrajectoryFit
from omnibench.fit.least_squares.usable_runs import with_poses
from omnibench.fit.loss.losses import OFF, Loss, LossName, make_loss
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

_PASSES = 3  # of weights that follow from each other: neighbours that are off hide each other


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

    def without_jumps(self, fit: TrajectoryFit) -> TrajectoryFit:
        """The fit without the poses, and without the runs, that are off; the whole fit if nothing were left."""
        chosen = [np.flatnonzero(of_run.poses >= OFF) for of_run in self.runs]
        kept = [index for index, of_run in enumerate(self.runs) if of_run.near and len(chosen[index])]
        if not kept:
            return fit
        runs = tuple(with_poses(fit.runs[index], np.append(0, 1 + chosen[index])) for index in kept)
        return replace(fit, runs=runs, nuisances=replace(fit.nuisances, values=fit.nuisances.values[kept]))


def robust_noise(noise: Noise, fit: TrajectoryFit, loss: LossName, before: RobustNoise | None = None) -> RobustNoise:
    """The weights of a fit's runs under a noise, from earlier ones."""
    of_pose, of_position, of_heading = (make_loss(loss, coordinates) for coordinates in (3, 2, 1))
    assert of_pose is not None  # the calibrator has checked that it is no loss of squares
    assert of_position is not None
    assert of_heading is not None
    extras = [_none(len(stamps)) for stamps in fit.stamps] if before is None else [run.extra for run in before.runs]
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
        shifts, variances = _shifts(noise, fit, poses)
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


def _none(count: int) -> ExtraVariance:
    return ExtraVariance((np.zeros(count), 0.0), (np.zeros(count), 0.0))


def _weights(loss: Loss, norms: Array) -> tuple[Array, float]:
    """Weights (S,) of norms (S,), Eq. (1), and the curvature of the loss, see RobustNoise."""
    shares = np.full(len(norms), 1 / len(norms))
    ratios = norms / max(float(loss.scales(norms[None], shares)[0]), 1.0)
    return loss.weights(ratios) / float(loss.weights(np.zeros(1))[0]), loss.mean_curvature(ratios, shares)


def _shifts(noise: Noise, fit: TrajectoryFit, poses: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Likeliest shifts (Z, 3) of the runs, whose poses have extra variances, and their variances with the bias."""
    unbiased = noise.model_copy(update={"bias_position": 0.0, "bias_heading": 0.0})
    found = [
        Whitener(unbiased, stamps, ExtraVariance((position, 0.0), (heading, 0.0))).shift(residuals)
        for stamps, (position, heading), residuals in zip(fit.stamps, poses, fit.residuals, strict=True)
    ]
    bias = np.square([noise.bias_position, noise.bias_position, noise.bias_heading])
    return np.array([shift for shift, _ in found]), np.array([of_shift for _, of_shift in found]) + bias
