"""Estimates of an effect that looks like outliers: radii that depend on the direction in which a wheel turns.

    python tests/studies/outlier_study.py --out sets.jsonl --sets 350 [--whole 25] [--jobs 1] [--table]

A robot with three omni wheels drives 48 commands four times each; a camera sees it with plain Gaussian noise. Each
wheel drives farther one way than the other, by +0.6, -0.4 and +0.8 %. Every set is fitted as discover fits it once the
effect is named: the plain matrix, then matrix and effect. The first --whole sets are discovered as a whole, too, from
the recording to the named effect, and the table says whether both agree.

The truth shares nothing with what fits: runs are arcs in closed form, and the wheel equations stand here. One line of
JSON a set, added as it comes: run again with the same file, and it goes on where it was.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from interval_coverage import arc
from results_file import ResultsFile, in_processes
from scipy.stats import binomtest

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.discover.discover import discover_effects
from omnibench.discover.fit import extend, fit_matrix
from omnibench.discover.significance import Group
from omnibench.fit.trajectory_fit import usable_runs
from omnibench.processes import one_thread
from omnibench.registry import effects
from omnibench.robot.kinematics import Robot, Wheel

EFFECT = "direction_dependent_radius"
TRUTH = np.array([0.006, -0.004, 0.008])  # half the relative difference between both directions, of each wheel
REPETITIONS = 4
SPEED, SECONDS, TURNS, DIRECTIONS = 0.25, 6.0, (0.0, 0.4, -0.4), 16  # m/s, s, rad/s
NOISES = (0.0045, 0.006)  # m and rad, of every pose of even and of odd seeds
ANGLES = np.radians([60.0, 180.0, 300.0])
TIMES = 0.1 * np.arange(1, 61)  # s, wheel samples
STAMPS = np.append(0.0, TIMES[3::4])  # s, reference poses
LEVEL = 0.95


@dataclass(frozen=True)
class Row:
    """One set. values, reach (3,): estimates and half-widths of their intervals; whole: by the whole of discover."""

    seed: int
    whole: bool
    values: tuple[float, ...]
    reach: tuple[float, ...]
    outliers: int
    seconds: float


def simulated(seed: int) -> Dataset:
    """A recording in which every wheel drives farther one way than the other."""
    rng = np.random.default_rng([37, seed])
    radius, distance = 0.051 * (1 + 0.01 * rng.standard_normal(3)), 0.195 * (1 + 0.01 * rng.standard_normal(3))
    angle = ANGLES + np.radians(0.5) * rng.standard_normal(3)
    equations = np.column_stack([-np.sin(angle), np.cos(angle), distance]) / radius[:, None]
    first = rng.uniform(0, 2 * np.pi)
    runs = []
    for repetition, direction, turn in product(range(REPETITIONS), range(DIRECTIONS), TURNS):
        heading = first + 2 * np.pi * direction / DIRECTIONS
        twist = np.array([SPEED * np.cos(heading), SPEED * np.sin(heading), turn])
        rolled = equations @ twist  # what the wheels would show if they drove alike both ways
        rates = np.where(rolled > 0, rolled / (1 + TRUTH), rolled / (1 - TRUTH))
        poses = arc(twist, STAMPS)
        poses[1:] += NOISES[seed % 2] * rng.standard_normal((len(STAMPS) - 1, 3))
        runs.append(
            Trajectory(
                f"{direction}{turn:+}-{repetition}",
                "train",
                TIMES,
                np.tile(rates, (len(TIMES), 1)),
                STAMPS,
                poses,
                command=f"{direction}{turn:+}",
                repetition=repetition,
                session="s",
                started_at=10.0 * len(runs),
            )
        )
    wheels = tuple(
        Wheel(name=name, radius=0.051, distance=0.195, angle=angle) for name, angle in zip("abc", ANGLES, strict=True)
    )
    return make_dataset("directions", Robot(name="omni3", wheels=wheels), float(TIMES[0]), tuple(runs), simulated=True)


def fitted(seed: int, whole: bool) -> Row:
    """The estimates of one set."""
    dataset, began = simulated(seed), time.perf_counter()
    with one_thread():
        if whole:
            discovery = discover_effects(dataset, seed=seed)
            parameters = [p for effect in discovery.effects if effect.name == EFFECT for p in effect.parameters]
            values = [parameter.value for parameter in parameters if not parameter.shape]
            reach = [parameter.high - parameter.value for parameter in parameters if not parameter.shape]
            outliers = discovery.outliers
        else:
            runs, effect = usable_runs(dataset.split("train")), effects.create(EFFECT)
            plain = fit_matrix(runs, dataset.robot, dataset.sample_period, dataset.robot.inverse_kinematic_matrix)
            model = extend(plain, [Group("effect", EFFECT, (), effect, effect.parameters(dataset.robot))])
            values, reach = model.values.tolist(), model.covariance.reach[-3:].tolist()
            outliers = model.fit.jumps
    return Row(seed, whole, tuple(values), tuple(reach), outliers, round(time.perf_counter() - began, 2))


def table(rows: Sequence[Row]) -> Iterator[str]:
    """Bias and coverage of the three parameters pooled, by the fit alone and by the whole of discover."""
    for whole in (False, True):
        every = [row for row in rows if row.whole == whole]
        named = [row for row in every if len(row.values) == len(TRUTH)]
        if not named:
            continue
        errors, reach = np.array([row.values for row in named]) - TRUTH, np.array([row.reach for row in named])
        # Towards 0 is minus: an effect that is taken for outliers is found too small.
        pooled = (errors * np.sign(TRUTH) / reach).sum(axis=1)
        bias = float(np.mean(pooled) / (np.std(pooled, ddof=1) / np.sqrt(len(pooled)))) if len(pooled) > 1 else np.nan
        hits, trials = int((np.abs(errors) < reach).sum()), errors.size
        exact = binomtest(hits, trials).proportion_ci(LEVEL, "exact")
        poses = [row.outliers for row in named]
        yield (
            f"{'discover' if whole else 'fit and extend':15} {len(named)} of {len(every)} sets name it; "
            f"too small {int((errors * np.sign(TRUTH) < 0).sum())} of {trials}, z of the mean {bias:+.2f}; "
            f"95 % intervals hold in {100 * hits / trials:.1f} % ({100 * exact.low:.1f} to {100 * exact.high:.1f}); "
            f"outliers {min(poses)} to {max(poses)}; {np.mean([row.seconds for row in every]):.1f} s a set"
        )
    by_fit = {row.seed: row for row in rows if not row.whole}
    both = [(by_fit[row.seed], row) for row in rows if row.whole and row.seed in by_fit and row.values]
    if both:
        apart = [np.abs(np.subtract(fit.values, row.values)) / fit.reach for fit, row in both]
        yield f"largest difference between both, {len(both)} sets: {np.max(apart):.2g} half-widths"


def main() -> None:
    """Fit the sets that are missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--sets", type=int, default=350)
    parser.add_argument("--whole", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="only print the table")
    arguments = parser.parse_args()
    file = ResultsFile(arguments.out, Row)
    tasks = [(seed, False) for seed in range(arguments.sets)] + [(seed, True) for seed in range(arguments.whole)]
    done = {(row.seed, row.whole) for row in file.results}
    missing = [] if arguments.table else [task for task in tasks if task not in done]
    for row in in_processes(fitted, missing, arguments.jobs):
        file.add(row)
    print("\n".join(table(file.results)))


if __name__ == "__main__":
    main()
