"""Small recordings and problems that several tests of the fit share."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.cost import Cost
from omnibench.fit.geometry import GeometryLimits
from omnibench.fit.loss import LossName, with_loss
from omnibench.fit.parameterisation import Box, ExplicitBox, ParameterisationName
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.progress import Reporter, no_progress
from omnibench.registry import Options, costs
from omnibench.robot.calibration import Calibration, matrix_rows
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import Integration
from omnibench.testing.synthetic import synthetic_robot, synthetic_trajectories

Wheels = Literal[3, 4]


def noisy_trajectories(
    wheels: Wheels = 3, noise: float = 0.01, seed: int = 0, integration: Integration = "arc", encoder: float = 0.02
) -> tuple[Trajectory, ...]:
    """Twelve runs of a robot off its design.

    noise: of every reference pose but the start, m, m, rad. encoder: of every wheel rate, rad/s.
    """
    rng = np.random.default_rng(seed)

    def disturbed(run: Trajectory) -> Trajectory:
        poses = run.poses + np.vstack([np.zeros(3), noise * rng.standard_normal((len(run.poses) - 1, 3))])
        return replace(run, poses=poses, rates=run.rates + encoder * rng.standard_normal(run.rates.shape))

    return tuple(disturbed(run) for run in synthetic_trajectories(synthetic_robot(wheels), integration))


def make_problem(
    trajectories: Sequence[Trajectory] | None = None,
    *,
    wheels: Wheels = 3,
    robot: Robot | None = None,
    cost: str = "final_pose",
    loss: LossName = "squares",
    parameterisation: ParameterisationName = "matrix",
    box: Box = "row",
    limits: GeometryLimits | None = None,
    integration: Integration = "arc",
    evaluations: int = 60_000,
    seconds: float = 600.0,
    seed: int = 1,
    watch: Reporter = no_progress,
) -> CalibrationProblem:
    """A problem on ``trajectories``, by default noisy ones of the synthetic robot with so many wheels."""
    chosen = robot or synthetic_robot(wheels)
    runs = noisy_trajectories(wheels, integration=integration) if trajectories is None else trajectories
    return CalibrationProblem(
        chosen,
        runs,
        with_loss(costs.create(cost), loss),
        make_parameterisation(parameterisation, chosen, runs, box=box, limits=limits),
        integration=integration,
        budget=Budget(evaluations=evaluations, seconds=seconds),
        seed=seed,
        watch=watch,
    )


def box_between(lower: Array, upper: Array) -> ExplicitBox:
    """An explicit box of two matrices (3, N)."""
    low, high = (tuple(tuple(row) for row in side.tolist()) for side in (lower, upper))
    return ExplicitBox(lower=low, upper=high)


class Scripted(Calibrator):
    """A calibrator that does what a test says."""

    name = "scripted"

    def __init__(self, script: Callable[[CalibrationProblem], Any]) -> None:
        super().__init__(Options())
        self._script = script

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        answer: Solution = self._script(problem)
        return answer


class Worst(Cost):
    """The largest pose error, a cost that is no sum of norms."""

    name = "worst"

    def combine(self, errors: Array, trajectory: Any) -> Array:  # noqa: ARG002
        return np.asarray(np.linalg.norm(errors, axis=-1).max(axis=-1))


def design_of(dataset: Dataset, integration: Integration = "euler") -> Calibration:
    """The design values of a data set's robot, as a calibration."""
    return Calibration(
        name="design",
        robot=dataset.robot,
        sample_period=dataset.sample_period,
        matrix=matrix_rows(dataset.robot.inverse_kinematic_matrix),
        integration=integration,
    )
