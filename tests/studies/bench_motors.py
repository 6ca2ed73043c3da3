"""Speed of driving a session, against real time and against the same loop in plain Python.

    pytest --dist no tests/studies/bench_motors.py

The session is the training session of configs/apr02.yaml: 36 commands, 5 times each, three wheels.
"""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
import time
from functools import cache
from itertools import product

import numpy as np
from pytest_benchmark.fixture import BenchmarkFixture

from omnibench.robot.kinematics import Array, Robot, Wheel
from omnibench.simulate.commands import Command
from omnibench.simulate.motion_commands import CommandLink, MotionProfile, command_motion, target_rates
from omnibench.simulate.motors import Controller, DrivenRun, Encoder, Motor, drive_session

PERIOD = 0.01
APR_02 = Robot(
    name="APR-02",
    wheels=tuple(
        Wheel(name=name, radius=0.148, distance=0.195, angle=math.radians(angle))
        for name, angle in (("a", 60), ("b", 180), ("c", 300))
    ),
)


@cache
def targets() -> list[Array]:
    """Target rates of the session's 180 runs."""
    rng = np.random.default_rng(0)
    commands = [
        Command(0.2, math.radians(30 * way), turn) for way, turn, _ in product(range(12), (-0.35, 0, 0.35), range(5))
    ]
    profile, link = MotionProfile(), CommandLink()
    return [
        target_rates(APR_02, command_motion(each, 1.116, 6.0, profile, link, PERIOD, 0.6, rng)) for each in commands
    ]


def drive(told: list[Array]) -> list[DrivenRun]:
    return drive_session(Motor(), Controller(), Encoder(), told, PERIOD, np.zeros(3))


def timed_short_run() -> tuple[float, str]:
    """Seconds that the first half second of a run takes, and a hash of its result."""
    told = [targets()[0][:50]]
    drive([told[0][:1]])
    started = time.perf_counter()
    (run,) = drive(told)
    seconds = time.perf_counter() - started
    return seconds, hashlib.sha256(run.wheel_angles.tobytes() + run.rates.tobytes()).hexdigest()


def test_a_session_against_real_time(benchmark: BenchmarkFixture) -> None:
    told = targets()
    drive(told[:1])  # compiles
    benchmark.pedantic(drive, (told,), rounds=3)
    real = sum(len(each) for each in told) * PERIOD
    seconds = benchmark.stats.stats.min if benchmark.stats else math.nan
    benchmark.extra_info |= {"recorded, s": real, "driven in, s": seconds, "times real time": real / seconds}
    assert seconds < 3


def test_planning_a_session(benchmark: BenchmarkFixture) -> None:
    benchmark.pedantic(targets.__wrapped__, rounds=1)


def test_the_loop_against_plain_python(benchmark: BenchmarkFixture) -> None:
    """The loop compiled and interpreted, the latter in a process of its own, gives the same bits."""
    seconds, bits = benchmark.pedantic(timed_short_run, rounds=1)
    code = "from bench_motors import timed_short_run; print(*timed_short_run())"
    here = os.path.dirname(__file__)
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": here}
    told = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    plain, plain_bits = told.stdout.split()
    benchmark.extra_info |= {"compiled, s": seconds, "plain, s": float(plain), "times faster": float(plain) / seconds}
    assert bits == plain_bits
