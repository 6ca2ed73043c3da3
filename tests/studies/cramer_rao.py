"""Efficiency of trajectory_ml against the Cramer-Rao bound, and coverage of its 95 % intervals.

    python tests/studies/cramer_rao.py --sets 1000 --workers 2

Simulated flowers that differ in seed alone, for several proportions of the noise. The bound is computed apart from
the estimator: dense covariances of all poses of a command, derivatives by central differences, the encoders' noise
carried through to the poses. A spread is the standard deviation of an element's error about the truth, over the sets.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import stats

from omnibench.fit.calibrator import run_calibrator
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.registry import calibrators, costs
from omnibench.robot.kinematics import Array, Robot, Wheel, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.robot.physical import EstimatedCovariance
from omnibench.simulate.commands import Commands
from omnibench.simulate.config import EncoderNoise, FlowerConfig, Session, Truth
from omnibench.simulate.source import simulate_dataset
from omnibench.simulate.truth import true_matrix

ROBOT = Robot(
    name="APR-02",
    wheels=tuple(
        Wheel(name=name, radius=0.148, distance=0.195, angle=np.radians(angle))
        for name, angle in (("a", 60.0), ("b", 180.0), ("c", 300.0))
    ),
)
# White noise of a wheel rate that is sampled at 20 Hz; 0.02 rad/s at 100 Hz, as in configs/apr02.yaml, drives the wheel
# angles alike.
_ENCODER = 0.009
NOISES = {
    "as apr02": EncoderNoise(
        encoder=_ENCODER,
        pose_position=0.0055,
        pose_heading=0.0055,
        walk_position=0.0033,
        walk_heading=0.0033,
        bias_position=0.0088,
        bias_heading=0.0088,
    ),
    "mostly white": EncoderNoise(
        encoder=_ENCODER, pose_position=0.01, pose_heading=0.005, walk_position=0.001, walk_heading=0.001
    ),
    "mostly walk": EncoderNoise(
        encoder=_ENCODER, pose_position=0.002, pose_heading=0.002, walk_position=0.006, walk_heading=0.005
    ),
    "mostly bias": EncoderNoise(
        encoder=_ENCODER, pose_position=0.005, pose_heading=0.004, bias_position=0.02, bias_heading=0.015
    ),
}


def flower(noise: EncoderNoise, seed: int = 1) -> FlowerConfig:
    """A small flower: 18 commands, four times each; 6 s, poses twice a second."""
    return FlowerConfig(
        robot=ROBOT,
        sample_period=0.05,
        pose_period=0.5,
        commands=Commands(directions_deg=(0, 60, 120, 180, 240, 300), turn_rates=(-0.35, 0.0, 0.35)),
        repetitions=4,
        truth=Truth(published="palacin2023_eq8"),
        integration="arc",
        noise=noise,
        train=Session(seed=seed, distance=1.2),
        order="sorted",
    )


def cramer_rao_bound(config: FlowerConfig) -> Array:
    """Cramer-Rao bound (9, 9) on the covariance of the matrix elements on such a data set.

    The poses less the odometry scatter by the reference's noise and, through the derivatives of the poses by every
    wheel rate, by the encoders'. That the rates in the derivatives are noisy themselves is of second order.
    """
    noise, matrix = config.noise, true_matrix(config.truth, config.robot)
    information = np.zeros((9, 9))
    commands = {run.command: run for run in simulate_dataset(config).dataset.trajectories}
    for run in commands.values():
        assert run.targets is not None
        times, stamps = run.times, run.pose_times[1:]
        assert run.v is not None
        assert run.alpha is not None
        assert run.omega is not None
        twist = np.array([run.v * np.cos(run.alpha), run.v * np.sin(run.alpha), run.omega])
        rates = np.tile(wheel_equations(config.robot.wheels) @ twist, (len(times), 1))

        def poses(elements: Array, moved: Array, times: Array = times, stamps: Array = stamps) -> Array:
            model = OdometryModel(config.robot, elements.reshape(3, 3), config.integration)
            return model.poses([WheelLog(times, moved, np.zeros(3), stamps)])[0].T.ravel()  # all x, all y, all headings

        slopes = _derivative(lambda elements, rates=rates: poses(elements, rates), matrix.ravel(), 1e-5)
        by_rate = _derivative(lambda flat, rates=rates: poses(matrix, flat.reshape(rates.shape)), rates.ravel(), 1e-4)
        common = np.minimum.outer(stamps, stamps)
        covariance = noise.encoder**2 * by_rate @ by_rate.T
        for index, kind in enumerate(("position", "position", "heading")):
            part = slice(index * len(stamps), (index + 1) * len(stamps))
            white, walk, bias = (getattr(noise, f"{each}_{kind}") for each in ("pose", "walk", "bias"))
            covariance[part, part] += white**2 * np.eye(len(stamps)) + walk**2 * common + bias**2
        information += config.repetitions * slopes.T @ np.linalg.solve(covariance, slopes)
    return np.linalg.inv(information)


def _derivative(function: object, point: Array, step: float) -> Array:
    assert callable(function)
    columns = [
        (function(point + offset) - function(point - offset)) / (2 * step) for offset in step * np.eye(len(point))
    ]
    return np.stack(columns, axis=1)


@dataclass(frozen=True)
class Fitted:
    """Result on one data set: errors, covered (9,): of the elements. robust: True if the covariance is from scatter."""

    errors: Array
    covered: Array
    robust: bool


def fitted(seed: int, noise: EncoderNoise, calibrator: str = "trajectory_ml") -> Fitted:
    """One simulated data set, calibrated."""
    config = flower(noise, seed)
    dataset = simulate_dataset(config).dataset
    runs = dataset.split("train")
    problem = CalibrationProblem(
        dataset.robot,
        runs,
        costs.create("final_pose"),
        make_parameterisation("matrix", dataset.robot, runs, box="row"),
        integration=config.integration,
        budget=Budget(),
        seed=1,
    )
    result = run_calibrator(calibrators.create(calibrator), problem)
    assert result.matrix is not None, result.reason
    errors = (result.matrix - true_matrix(config.truth, config.robot)).ravel()
    covered = np.zeros(9, dtype=bool)
    if result.covariance is not None and result.degrees_of_freedom is not None:
        covered = np.abs(errors) < EstimatedCovariance(result.covariance, result.degrees_of_freedom).reach
    return Fitted(errors, covered, "noise model" not in result.reason)


def main() -> None:
    """Print, for every proportion of the noise, spread over bound and coverage of every element."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--noise", choices=[*NOISES, "all"], default="all")
    parser.add_argument("--calibrator", default="trajectory_ml")
    arguments = parser.parse_args()
    count = arguments.sets
    chance = np.sqrt(stats.chi2.ppf([0.025, 0.975], count) / count)
    low, high = stats.binom.interval(0.95, count, 0.95)
    print(f"{count} simulated data sets each; spread over bound of an efficient estimator, by chance: ", end="")
    print(f"{chance[0]:.3f} to {chance[1]:.3f}; coverage of a 95 % interval: {low / count:.3f} to {high / count:.3f}")
    with ProcessPoolExecutor(arguments.workers) as pool:
        for name in NOISES if arguments.noise == "all" else [arguments.noise]:
            work = partial(fitted, noise=NOISES[name], calibrator=arguments.calibrator)
            results = list(pool.map(work, range(10_000, 10_000 + count), chunksize=8))
            errors = np.array([each.errors for each in results])
            bound = np.sqrt(np.diag(cramer_rao_bound(flower(NOISES[name]))))
            spread = np.sqrt(np.square(errors).mean(axis=0)) / bound
            bias = errors.mean(axis=0) / bound
            coverage = np.array([each.covered for each in results]).mean(axis=0)
            interval = stats.binomtest(round(coverage.mean() * count), count).proportion_ci(method="exact")
            mean = f"mean coverage {coverage.mean():.3f} ({interval.low:.3f} to {interval.high:.3f})"
            print(f"\n{name}: {sum(each.robust for each in results)} sets with a covariance from scatter")
            print("element   bound (1 sd)  spread/bound  mean error/bound  coverage")
            for row in range(9):
                element = f"m{row // 3 + 1}{row % 3 + 1}"
                print(
                    f"{element:9s} {bound[row]:.3e}     {spread[row]:.3f}         {bias[row]:+.3f}            "
                    f"{coverage[row]:.3f}"
                )
            print(f"all       spread/bound {spread.min():.3f} to {spread.max():.3f}; {mean}")


if __name__ == "__main__":
    main()
