"""How far the calibrator posterior errs in the standard deviations that it states: 1 if these are right.

``python tests/studies/posterior_coverage.py [REPETITIONS]``. Simulated: a differential drive whose radii, track and
lost wheel rate are drawn from the prior, and whose floor slips otherwise in each run: by 1 % ahead and 2 % in turns.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.fit.calibrator import run_calibrator
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Robot, Wheel
from omnibench.testing import synthetic_problem

Array = NDArray[np.float64]
ROBOT = Robot(
    name="two", wheels=(Wheel(name="left", type="fixed", radius=0.05, x=0, y=0.15),
                        Wheel(name="right", type="fixed", radius=0.05, x=0, y=-0.15))
)  # fmt: skip
RATE, SECONDS = 20.0, 15.0  # Hz, s
COMMANDS = ((0.3, 0.0), (0.2, 0.5), (0.2, -0.5), (0.0, 0.6), (0.0, -0.6), (0.3, 0.3))  # m/s, rad/s
SLIP = np.array([0.01, 0.02])


def main(repetitions: int = 40) -> None:
    """Print the table."""
    print("runs   x row   turn row   lost rate")
    for runs in (4, 6, 12, 24):
        ratios = np.array([ratios_of(np.random.default_rng([runs, seed]), runs) for seed in range(repetitions)])
        x, turn, lost = np.sqrt(np.square(ratios[:, [0, 4, 6]]).mean(axis=0))
        print(f"{runs:4d}  {x:6.2f}  {turn:9.2f}  {lost:10.2f}", flush=True)


def ratios_of(rng: np.random.Generator, runs: int) -> Array:
    """Error over stated deviation of the elements, row by row, and of the lost rate; 0 where none is stated."""
    truth, lost = drawn_robot(rng)
    problem = problem_of([driven(rng, truth, lost, COMMANDS[number % len(COMMANDS)], number) for number in range(runs)])
    result = run_calibrator(calibrators.create("posterior"), problem)
    assert result.matrix is not None and result.extension is not None  # noqa: PT018
    deviations = np.sqrt(np.diag(np.array(result.extension.covariance)))
    errors = np.append((result.matrix - truth).ravel(), result.extension.effects[0].parameters["c"] + lost)
    ratios: Array = np.where(deviations > 0, errors / np.where(deviations > 0, deviations, 1.0), 0.0)
    return ratios


def problem_of(runs: list[Trajectory]) -> CalibrationProblem:
    """The problem of calibrating the robot by some runs."""
    return synthetic_problem(robot=ROBOT, trajectories=tuple(runs))


def drawn_robot(rng: np.random.Generator) -> tuple[Array, float]:
    """A true matrix (3, 2) and the rate that its turning wheels lose, rad/s."""
    radii = 0.05 * (1 + 0.01 * rng.normal(size=2))
    ahead, turning = 1 + rng.normal(0, [0.02, 0.05])
    left, right = radii * ahead / 2, radii * turning / 0.3
    return np.array([left, [0.0, 0.0], [-right[0], right[1]]]), float(rng.normal(0, 0.004))


def driven(
    rng: np.random.Generator, truth: Array, lost: float, command: tuple[float, float], number: int
) -> Trajectory:
    """A run of a command: wheel rates as encoders tell them, and poses of motion capture every 0.1 s."""
    times = np.arange(1, int(RATE * SECONDS) + 1) / RATE
    rates = np.tile(np.linalg.solve(truth[[0, 2]], command), (len(times), 1))
    ahead, turning = np.array(command) * (1 + SLIP * rng.normal(size=2))
    headings = turning * np.append(0.0, times)
    middle = headings[:-1] + turning / RATE / 2
    chord = ahead / RATE * np.sinc(turning / RATE / 2 / np.pi)
    steps = np.column_stack([chord * np.cos(middle), chord * np.sin(middle)])
    poses = np.column_stack([np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]), headings])[::2]
    poses[1:] += rng.normal(0, [0.001, 0.001, 0.002], poses[1:].shape)
    return Trajectory(f"{number}", "train", times, rates + lost * np.sign(rates), np.append(0.0, times)[::2], poses)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
