"""Coverage of the 95 % intervals of an improvement over held-out commands that share an error.

    python tests/studies/improvement_coverage.py [--sets 400] [--units 30 12 5] [--kinds whole usual] [--methods]

Kind ``whole`` is the whole way: recordings are simulated, ``calibrate`` fits the matrix to other commands, and its
verdict on n held-out commands of five runs gives the interval. The truth is the improvement by the fitted matrix over
4,000 fresh commands. It shares nothing with what fits: runs are exact arcs in closed form (interval_coverage.py), and
the errors of a run and of a matrix are computed here. Every command's path is pulled by an error of its own, alike in
all of its runs, which no matrix fits; every run has an error of its own, too.

The other kinds draw the errors of the final pose directly, so that thousands of sets take a minute: with E_u of a
command, E_z of a run and G_u of the design values, vectors (3,) of normal numbers, a calibrated run has the error
|E_u + E_z| and the design |E_u + E_z + G_u|. Sizes of E_u, E_z, G_u:

- usual: 1, 0.3, 2; improvement 54 %.
- none: 1, 0.3, 0.3; improvement 4 %.
- runs: 1, 1, 0.3: runs scatter as much as commands.
- large: 0.3, 1, 6; improvement 83 %, one to nine runs a command.
- tails: as usual, E_u times a log-normal number of deviation 0.7: few commands count for most.
- unequal: as tails, with one to nine runs a command.

With --methods other intervals of these kinds stand beside ours: over runs; percentiles of the bootstrap over commands;
Student's t on the ratio; and Hwang's, which are ours from ten units on, with the share of them that has no bounds.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from interval_coverage import ROBOT, STAMPS, TIMES, UNITS, arc, wheel_equations, wheel_rates
from scipy.special import stdtrit
from scipy.stats import binomtest

from omnibench.data.dataset import Split, Trajectory, make_dataset
from omnibench.fit import intervals as ratio_intervals
from omnibench.fit.calibrate import calibrate
from omnibench.fit.intervals import Bootstrap, Clusters, Interval, RatioIntervals
from omnibench.robot.kinematics import Array

REPETITIONS = 5
TRAINING = 12  # commands
POPULATION = 4000  # commands over which the truth is a mean
PULL = 0.6 * UNITS  # m/s, m/s, rad/s: of a command's path
NOISE = 0.5 * UNITS  # m, m, rad: of every pose of a run, and once more of all its poses


@dataclass(frozen=True)
class Kind:
    """Sizes of the errors of a command, of a run and of the design; tails and numbers of runs."""

    command: float
    run: float
    design: float
    tails: float = 0.0
    unequal: bool = False


KINDS = {
    "usual": Kind(1, 0.3, 2),
    "none": Kind(1, 0.3, 0.3),
    "runs": Kind(1, 1, 0.3),
    "large": Kind(0.3, 1, 6, unequal=True),
    "tails": Kind(1, 0.3, 2, tails=0.7),
    "unequal": Kind(1, 0.3, 2, tails=0.7, unequal=True),
}


@dataclass(frozen=True, eq=False)
class Errors:
    """Costs (Z,) of the runs of a set, before and after calibration, and the command (Z,) of each."""

    design: Array
    calibrated: Array
    units: Clusters


def drawn(kind: Kind, commands: int, rng: np.random.Generator) -> Errors:
    """Errors of the final pose of some commands, drawn directly."""
    runs = rng.integers(1, 2 * REPETITIONS, commands) if kind.unequal else np.full(commands, REPETITIONS)
    owner = np.repeat(np.arange(commands), runs)
    shared = kind.command * rng.standard_normal((commands, 3))
    shared *= np.exp(kind.tails * rng.standard_normal((commands, 1)))
    of_design = kind.design * rng.standard_normal((commands, 3))
    errors = shared[owner] + kind.run * rng.standard_normal((len(owner), 3))
    return Errors(
        np.linalg.norm(errors + of_design[owner], axis=1), np.linalg.norm(errors, axis=1), Clusters("command", owner)
    )


def improvement_of(kind: Kind) -> float:
    """The true improvement: over 400,000 commands."""
    errors = drawn(kind, 400_000, np.random.default_rng(0))
    return float(1 - errors.calibrated.sum() / errors.design.sum())


def ours(errors: Errors, seed: int) -> Interval:
    """The interval that ships."""
    found = RatioIntervals(Bootstrap(seed=seed)).improvement(errors.calibrated, errors.design, errors.units)
    assert found is not None
    return found


def methods(errors: Errors, seed: int) -> dict[str, Interval]:
    """The interval that ships, and others."""
    units, rng = errors.units, np.random.default_rng(seed)
    runs = replace(errors, units=Clusters("run", np.arange(len(errors.design))))
    after, before = units.sums(errors.calibrated), units.sums(errors.design)
    count, ratio = units.count, after.sum() / before.sum()
    chosen = rng.integers(count, size=(1000, count))
    low, high = np.percentile(after[chosen].sum(axis=1) / before[chosen].sum(axis=1), [2.5, 97.5])
    error = math.sqrt(count / (count - 1) * float(np.square(after - ratio * before).sum())) / before.sum()
    reach = float(stdtrit(count - 1, 0.975)) * error
    kept = ratio_intervals.BOOTSTRAPPED
    ratio_intervals.BOOTSTRAPPED = ratio_intervals.FEWEST
    resampled = ours(errors, seed)
    ratio_intervals.BOOTSTRAPPED = kept
    return {
        "ours": ours(errors, seed),
        "over runs": ours(runs, seed),
        "percentiles": Interval(1 - ratio, 1 - high, 1 - low),
        "Student's t": Interval(1 - ratio, 1 - ratio - reach, 1 - ratio + reach),
        "Hwang": resampled,
    }


def arcs(commands: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Twists (n, 3) of random commands, and the pulls (n, 3) of their paths, m/s, m/s, rad/s."""
    angles = rng.uniform(0, 2 * math.pi, commands)
    turns = rng.choice([-0.5, 0.0, 0.5], commands)
    twists = np.column_stack([0.25 * np.cos(angles), 0.25 * np.sin(angles), turns])
    return twists, PULL * rng.standard_normal((commands, 3))


def recorded(geometry: Array, commands: int, split: Split, rng: np.random.Generator) -> Iterator[Trajectory]:
    """Runs of random commands, five of each."""
    for number, (twist, pull) in enumerate(zip(*arcs(commands, rng), strict=True)):
        for repetition in range(REPETITIONS):
            poses = arc(twist, STAMPS) + np.outer(STAMPS, pull)
            poses[1:] += NOISE * rng.standard_normal((len(STAMPS) - 1, 3)) + NOISE * rng.standard_normal(3)
            yield Trajectory(
                f"{split}-{number}-{repetition}",
                split,
                TIMES,
                np.tile(wheel_rates(geometry, twist), (len(TIMES), 1)),
                STAMPS,
                poses,
                command=f"{split}-{number}",
                repetition=repetition,
            )


def whole_way(commands: int, seed: int) -> tuple[Interval, float]:
    """The verdict of ``calibrate`` on one simulated set, and the true improvement by its matrix."""
    rng = np.random.default_rng([seed, commands])
    design = np.concatenate([np.full(3, 0.148), np.full(3, 0.195), np.radians([60.0, 180.0, 300.0])])
    geometry = design + np.repeat([0.002, 0.004, math.radians(1)], 3) * rng.standard_normal(9)
    runs = [*recorded(geometry, TRAINING, "train", rng), *recorded(geometry, commands, "validation", rng)]
    dataset = make_dataset("improvement", ROBOT, float(TIMES[0]), runs, simulated=True)
    calibration = calibrate(dataset, "closed_form").calibration
    assert calibration.provenance is not None
    found = calibration.provenance.held_out
    assert found is not None
    assert found.improvement is not None
    twists, pulls = arcs(POPULATION, rng)
    ends = np.array([arc(twist, STAMPS[-1:])[0] for twist in twists]) + STAMPS[-1] * pulls
    ends += NOISE * (rng.standard_normal((POPULATION, 3)) + rng.standard_normal((POPULATION, 3)))
    wheels = twists @ wheel_equations(geometry).T
    costs = []
    for matrix in (calibration.matrix_array, np.linalg.inv(wheel_equations(design))):
        odometry = np.array([arc(twist, STAMPS[-1:])[0] for twist in wheels @ matrix.T])
        costs.append(np.linalg.norm(odometry - ends, axis=1).mean())
    return Interval(found.improvement, found.low, found.high), float(1 - costs[0] / costs[1])


def share(hits: Sequence[bool]) -> str:
    """The share of hits in % with its interval (Wilson)."""
    interval = binomtest(sum(hits), len(hits)).proportion_ci(0.95, "wilson")
    return f"{100 * np.mean(hits):5.1f} ({100 * interval.low:4.1f} to {100 * interval.high:5.1f})"


def table(kinds: Sequence[str], units: Sequence[int], sets: int, others: bool) -> Iterator[str]:
    """A line for every kind and number of commands: how many % of the intervals hold the truth, and lie above 0."""
    for name in kinds:
        truth = 0.0 if name == "whole" else improvement_of(KINDS[name])
        for commands in units:
            if name == "whole":
                found = [whole_way(commands, seed) for seed in range(sets)]
                columns = {"ours": [(interval, true) for interval, true in found]}
            else:
                rng = np.random.default_rng(commands)
                every = [drawn(KINDS[name], commands, rng) for _ in range(sets)]
                rows = [
                    methods(each, seed) if others else {"ours": ours(each, seed)} for seed, each in enumerate(every)
                ]
                columns = {key: [(row[key], truth) for row in rows] for key in rows[0]}
            words = []
            for key, cells in columns.items():
                hits = share([interval.holds(true) for interval, true in cells])
                widths = [high - low for low, high in (interval.known or (0, math.inf) for interval, _ in cells)]
                without = np.mean([interval.known is None for interval, _ in cells])
                above = 100 * np.mean([interval.low is not None and interval.low > 0 for interval, _ in cells])
                words.append(
                    f"{key} {hits} width {np.median(widths):.2f}, none {100 * without:.0f} %, above 0 {above:.0f} %"
                )
            yield f"{name:8s} {commands:3d}  {'; '.join(words)}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=400)
    parser.add_argument("--units", type=int, nargs="+", default=[30, 12, 5])
    parser.add_argument("--kinds", nargs="+", default=["whole", *KINDS], choices=["whole", *KINDS])
    parser.add_argument("--methods", action="store_true", help="other intervals beside ours")
    arguments = parser.parse_args()
    print("95 % intervals of the improvement that hold the truth, % (simulated commands that share an error)")
    for line in table(arguments.kinds, arguments.units, arguments.sets, arguments.methods):
        print(line, flush=True)


if __name__ == "__main__":
    main()
