"""Speed of evaluating candidates, as ratios against direct NumPy in the same run.

    pytest --dist no tests/studies/bench_evaluator.py

"Direct NumPy" is Eq. (1), (2) and (6) written out below, all trajectories at once, independent of omnibench's code.
omnibench's own direct path (OdometryBatch), which computes the same in fewer operations, is a second yardstick.
The recordings are those of configs/apr02.yaml, simulated.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from sample_robots import CAR, DIFFERENTIAL, MECANUM, SWERVE
from wheeled_recordings import recorded

from omnibench.compare.config import read_compare_config
from omnibench.data.dataset import make_dataset
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.registry import costs
from omnibench.robot.kinematics import Array, Robot

CONFIG = Path(__file__).parents[2] / "configs" / "apr02.yaml"
BATCH = 200


@cache
def flower_problem(sample_period: float = 0.01, cost: str = "final_pose") -> CalibrationProblem:
    """The problem of the config at a given sampling rate."""
    config = read_compare_config(CONFIG)
    ((name, source),) = config.datasets.items()
    simulated = source.simulate.model_copy(update={"sample_period": sample_period, "validation": None})
    dataset = source.model_copy(update={"simulate": simulated}).load(name)
    training = dataset.split("train")
    return CalibrationProblem(
        dataset.robot,
        training,
        costs.create(cost),
        make_parameterisation("matrix", dataset.robot, training, box="paper"),
        integration=config.integration,
        budget=Budget(evaluations=10**9, seconds=1e6),
        seed=1,
    )


def candidates(problem: CalibrationProblem, count: int = BATCH) -> Array:
    """Uniform random candidates in the box."""
    return problem.from_unit(np.random.default_rng(0).uniform(size=(count, int(problem.free.sum()))))


def direct_numpy(problem: CalibrationProblem) -> Callable[[Array], float]:
    """Eq. (1), (2) and (6) in plain NumPy, one candidate (3M,) a call."""
    runs = problem.trajectories
    rates = np.stack([run.signals for run in runs])  # (Z, F, M)
    durations = np.diff(runs[0].times, prepend=0.0)
    start = np.stack([run.start for run in runs])
    final = np.stack([run.final_pose for run in runs])

    def cost(candidate: Array) -> float:
        vx, vy, omega = np.moveaxis(rates @ candidate.reshape(3, -1).T, -1, 0)
        turned = np.cumsum(omega * durations, axis=1)
        heading = start[:, 2:] + np.hstack([np.zeros((len(runs), 1)), turned[:, :-1]])
        x = start[:, 0] + ((vx * np.cos(heading) - vy * np.sin(heading)) * durations).sum(axis=1)
        y = start[:, 1] + ((vx * np.sin(heading) + vy * np.cos(heading)) * durations).sum(axis=1)
        error = np.stack([x, y, start[:, 2] + turned[:, -1]], axis=1) - final
        return float(np.sqrt((error**2).sum(axis=1)).mean())

    return cost


def median_seconds(call: Callable[[], object], rounds: int) -> float:
    """The median time of a call."""
    times = []
    for _ in range(rounds):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def test_batch_of_200(benchmark) -> None:
    problem = flower_problem()
    problem.build_evaluator()
    population = candidates(problem)
    plain = direct_numpy(problem)
    found = benchmark.pedantic(problem.cost, (population,), rounds=300, warmup_rounds=20)
    numpy_seconds = median_seconds(lambda: plain(population[0]), 50)
    own_seconds = median_seconds(lambda: problem.values(population[:20]), 10) / 20
    each = benchmark.stats.stats.median / BATCH
    difference = max(abs(value - plain(one)) for value, one in zip(found, population, strict=True))
    own_difference = float(np.abs(found - problem.values(population)).max())
    benchmark.extra_info |= {
        "microseconds": each * 1e6,
        "times faster than direct NumPy": numpy_seconds / each,
        "times faster than omnibench's direct path": own_seconds / each,
        "largest difference": max(difference, own_difference),
    }
    assert max(difference, own_difference) <= 1e-11
    assert numpy_seconds / each >= 250


@pytest.mark.parametrize("robot", [DIFFERENTIAL, CAR, MECANUM, SWERVE], ids=lambda robot: robot.name)
def test_batch_of_200_for_robots_of_other_classes(benchmark, robot: Robot) -> None:
    """Two, three, four and eight drive signals; as many runs and samples as in the flower, and its box."""
    runs = recorded(
        robot, robot.inverse_kinematic_matrix, np.random.default_rng(0), repetitions=15, samples=558, period=0.01
    )
    dataset = make_dataset(robot.name, robot, 0.01, runs, simulated=True)
    problem = CalibrationProblem(
        robot,
        dataset.trajectories,
        costs.create("final_pose"),
        make_parameterisation("matrix", robot, dataset.trajectories, box="paper"),
        integration="euler",
        budget=Budget(evaluations=10**9, seconds=1e6),
        seed=1,
    )
    assert problem.build_evaluator() is not None
    population = candidates(problem)
    plain = direct_numpy(problem)
    found = benchmark.pedantic(problem.cost, (population,), rounds=100, warmup_rounds=10)
    numpy_seconds = median_seconds(lambda: plain(population[0]), 30)
    each = benchmark.stats.stats.median / BATCH
    difference = float(np.abs(found - problem.values(population)).max())
    benchmark.extra_info |= {"times faster than direct NumPy": numpy_seconds / each, "largest difference": difference}
    assert difference <= 1e-11
    assert robot is SWERVE or numpy_seconds / each >= 250


def test_one_at_a_time(benchmark) -> None:
    problem = flower_problem()
    problem.build_evaluator()
    one = candidates(problem, 1)
    plain = direct_numpy(problem)
    benchmark.pedantic(problem.cost, (one,), rounds=2000, warmup_rounds=50)
    ratio = median_seconds(lambda: plain(one[0]), 50) / benchmark.stats.stats.median
    benchmark.extra_info["times faster than direct NumPy"] = ratio
    assert ratio > 15


@pytest.mark.parametrize("period", [0.01, 0.001])
def test_building(benchmark, period: float) -> None:
    problem = flower_problem(period)

    def build() -> int:
        problem._evaluator_tried = False
        evaluator = problem.build_evaluator()
        assert evaluator is not None
        return evaluator.size

    size = benchmark.pedantic(build, rounds=3)
    benchmark.extra_info["megabytes"] = size / 1e6
    assert size < 50e6
    assert period < 0.01 or benchmark.stats.stats.median < 1.0


def test_ten_times_the_sampling_rate(benchmark) -> None:
    slow, fast = flower_problem(0.01), flower_problem(0.001)
    for problem in (slow, fast):
        problem.build_evaluator()
        problem.cost(candidates(problem))
    population = candidates(fast)
    benchmark.pedantic(fast.cost, (population,), rounds=300, warmup_rounds=20)
    # In turns, so that other load on the machine slows both down.
    pairs = [
        (median_seconds(lambda: fast.cost(population), 5), median_seconds(lambda: slow.cost(population), 5))
        for _ in range(40)
    ]
    ratio = float(np.median([fine / coarse for fine, coarse in pairs]))
    benchmark.extra_info["time at 1 kHz / time at 100 Hz"] = ratio
    assert 0.8 < ratio < 1.2
