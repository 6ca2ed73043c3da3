"""Time of a wheel sample in the odometry of the live node: with a learned calibration, against the plain stream.

    pytest --dist no tests/studies/bench_stream.py

Both drive the same random samples of three wheels; those of the learned one are partly outside the training domain,
where its network fades.
"""

from __future__ import annotations

import time

import numpy as np
from learned_samples import a_learned_calibration
from pytest_benchmark.fixture import BenchmarkFixture

from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import OdometryStream
from omnibench.testing.synthetic import synthetic_robot

PERIOD = 0.01  # s
SAMPLES = 2_000
ROBOT = synthetic_robot(3)
ANGLES = PERIOD * np.random.default_rng(0).normal(0, 4, (SAMPLES, 3))  # rad in a sample
DRIVEN = [[x, y, turn] for x in (-0.3, 0.0, 0.3) for y in (-0.3, 0.0, 0.3) for turn in (-1.0, 0.0, 1.0)]


def drive(stream: OdometryStream) -> None:
    for angles in ANGLES:
        stream.drive(angles, PERIOD)


def seconds_a_sample(model: OdometryModel) -> float:
    """The best of a few tries, of the processor's time: other work on the machine does not count."""
    spent = []
    for _ in range(5):
        began = time.process_time()
        drive(model.stream())
        spent.append((time.process_time() - began) / SAMPLES)
    return min(spent)


def test_a_sample_with_a_learned_calibration_against_the_plain_stream(benchmark: BenchmarkFixture) -> None:
    model = a_learned_calibration(ROBOT, DRIVEN, PERIOD, sizes=(16,)).model
    plain = seconds_a_sample(OdometryModel.of_design(ROBOT, "arc"))
    benchmark.pedantic(lambda: drive(model.stream()), rounds=5)
    seconds = seconds_a_sample(model)
    benchmark.extra_info |= {"a sample, ms": 1e3 * seconds, "times the plain stream": seconds / plain}
    assert seconds < 2e-4
