"""Further runs with the robot of a hidden set: those of a proposed experiment, or more of what was recorded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import yaml

from omnibench.data.dataset import Dataset, make_dataset
from omnibench.robot.kinematics import Array

from .experiment import SAMPLE, Command, Run
from .motion import Correction, Grid
from .sets import Truth, make_of, recorded

PLACING = 15.0  # s before a run, as a proposal counts them
_SESSION, _NUMBER = "further", 99  # name and number of the session


def proposed_runs(config: str, rng: np.random.Generator) -> list[Run]:
    """The runs of an experiment's YAML, in a random order."""
    (source,) = yaml.safe_load(config)["datasets"].values()
    wanted = [
        (
            Command(
                listed.get("speed", 0.0),
                math.radians(listed.get("direction_deg", 0.0)),
                listed.get("turn_rate", 0.0),
                listed["duration"],
            ),
            math.radians(listed.get("heading_deg") or 0.0),
        )
        for listed in source["simulate"]["commands"]["listed"]
        for _ in range(listed.get("repetitions", 1))
    ]
    return _driven([wanted[index] for index in rng.permutation(len(wanted))], rng)


def recorded_again(runs: Sequence[Run], minutes: float, rng: np.random.Generator) -> list[Run]:
    """As many more of the recorded commands as fit into some minutes, each as often as the others."""
    commands = list(dict.fromkeys(run.command for run in runs))
    wanted, left = [], 60 * minutes
    for number in range(10_000):
        command = commands[(7 * number) % len(commands)]  # 7 and 36 have no common factor
        left -= command.samples * SAMPLE + PLACING
        if left < 0:
            break
        wanted.append((command, 0.0))
    return _driven(wanted, rng)


def joined(dataset: Dataset, truth: Truth, runs: Sequence[Run], rng: np.random.Generator) -> Dataset:
    """A hidden set's training runs, and further ones of the same robot with the same effects."""
    grid, correction = Grid(runs, truth.matrix), Correction()
    for each, seed in zip(truth.hidden, truth.seeds, strict=True):
        correction += make_of(truth.kind, each.name, truth.form)(grid, each.values, np.random.default_rng(seed))
    further = recorded(grid, correction, truth.disturbance, rng)
    both = [*dataset.split("train"), *(replace(run, id=f"further-{run.id}") for run in further)]
    return make_dataset(dataset.name, dataset.robot, dataset.sample_period, both, simulated=True)


def _driven(wanted: Sequence[tuple[Command, float]], rng: np.random.Generator) -> list[Run]:
    """Runs of commands at headings, rad, one after the other."""
    runs: list[Run] = []
    started_at, angles = 0.0, rng.uniform(-math.pi, math.pi, 3)
    commands = list(dict.fromkeys(command for command, _ in wanted))
    for command, heading in wanted:
        number = commands.index(command)
        repetition = 1 + sum(run.command == command for run in runs)
        start: Array = np.array([0.0, 0.0, heading])
        runs.append(Run("train", _SESSION, _NUMBER, started_at, command, number, repetition, start, angles.copy()))
        started_at += command.samples * SAMPLE + rng.uniform(8, PLACING)
        angles += rng.uniform(-40, 40, len(angles))
    return runs
