"""Coverage of the 95 % intervals of a model that discover has extended, over simulated recordings of few commands.

    python tests/studies/interval_coverage.py --out coverage.jsonl --sets 1000 [--only "start 5"] [--table]

One line of JSON a set, added as it comes: run again with the same file, and it goes on where it was. With --table the
table is printed from what is there. Those of calibrators: estimate_study.py.

The truth shares nothing with what fits: every run is one exact arc of constant twist, in closed form, and the robot's
wheel equations (Eq. 3) stand here. Kinds of noise, beside white noise of 5 mm and 5 mrad of every pose:

- white: nothing else.
- start: start poses that are off by 1 cm and 1 degree.
- walk: a random walk of 5 mm and 5 mrad per sqrt s.
- bias: an error of the whole run of 1 cm and 0.01 rad.
- commands: the path of every command is pulled by 1 cm / s and 0.01 rad / s, alike in all its repetitions, so that no
  matrix fits.
- slight: that of commands, an eighth as strong.
- once: that of walk, in runs without repetition.
- turn: that of bias, in straight runs without repetition beside a single run that turns on the spot.
- sessions: the reference of every session has a scale that is off by 2 %, as with a wheel or a map that changes by day.

Clusters are commands, each driven three times in one session, but once where there are no repetitions; for ``sessions``
they are sessions of four commands that are driven twice. The model is extended by the effect that is there, a drift of
the heading.
"""

from __future__ import annotations

import argparse
import math
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from results_file import ResultsFile, in_processes
from scipy.stats import binomtest

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.discover.fit import extend, fit_matrix
from omnibench.discover.significance import Group
from omnibench.fit.trajectory_fit import usable_runs
from omnibench.registry import effects
from omnibench.robot.kinematics import Array, Robot, Wheel

KINDS = ("white", "start", "walk", "bias", "once", "turn", "slight", "commands", "sessions")
CLUSTERS = (5, 8, 12)
SPEED, TURNS = 0.25, (0.5, -0.5, 0.0)  # m/s, rad/s
TIMES = 0.2 * np.arange(1, 21)  # s, wheel samples
STAMPS = np.append(0.0, TIMES[1::2])  # s, reference poses
DRIFT = 0.003  # rad/s, of the heading, where an effect is hidden
UNITS = np.array([0.01, 0.01, 0.01])  # m, m, rad: what sizes of noise are given in
WHITE = 0.5  # of these
PULLED = {"commands": 1.0, "slight": 0.125}  # of these a second
ANGLES = np.radians([60.0, 180.0, 300.0])
ROBOT = Robot(
    name="APR-02",
    wheels=tuple(
        Wheel(name=name, radius=0.148, distance=0.195, angle=angle) for name, angle in zip("abc", ANGLES, strict=True)
    ),
)


@dataclass(frozen=True)
class Case:
    """One cell of the table."""

    kind: str
    clusters: int

    def __str__(self) -> str:
        return f"{self.kind} {self.clusters}"


@dataclass(frozen=True)
class Row:
    """Intervals of one set: of the nine elements of the matrix, then of the effect.

    errors: about the truth, in the standard deviations that are stated. reach: half-widths of the intervals, likewise.
    """

    case: str
    seed: int
    errors: tuple[float, ...]
    reach: tuple[float, ...]
    source: str

    @property
    def covered(self) -> Array:
        """True for intervals that hold the truth."""
        return np.abs(self.errors) < np.array(self.reach)


def simulated(kind: str, clusters: int, seed: int, drift: float = 0.0) -> tuple[Dataset, Array]:
    """Recordings with one kind of noise, and the true geometry (9,): radii (m), distances (m), angles (rad).

    drift: rate of turn that the wheels do not show, rad/s.
    """
    rng = np.random.default_rng([zlib.crc32(kind.encode()), clusters, seed])
    design = np.concatenate([np.full(3, 0.148), np.full(3, 0.195), ANGLES])
    truth = design + np.repeat([0.002, 0.004, math.radians(1)], 3) * rng.standard_normal(9)
    by_session = kind == "sessions"
    alone = kind in ("once", "turn")
    commands, sessions, repetitions = (4, clusters, 2) if by_session else (clusters, 1, 1 if alone else 3)
    first = rng.uniform(0, 2 * math.pi)
    twists = [
        np.array([SPEED * math.cos(angle), SPEED * math.sin(angle), 0.0 if kind == "turn" else TURNS[number % 3]])
        for number, angle in enumerate(first + 2 * math.pi * np.arange(commands) / commands)
    ]
    if kind == "turn":
        twists.append(np.array([0.0, 0.0, TURNS[0]]))
    pulls = PULLED.get(kind, 0.0) * UNITS * rng.standard_normal((len(twists), 3))
    scales = 1 + 0.02 * rng.standard_normal(sessions) * by_session
    runs = []
    for session, command, repetition in product(range(sessions), range(len(twists)), range(repetitions)):
        poses = arc(twists[command] + [0.0, 0.0, drift], STAMPS)
        poses[:, :2] *= scales[session]
        poses += np.outer(STAMPS, pulls[command]) + noise_of(kind, rng)
        runs.append(
            Trajectory(
                f"{session}-{command}-{repetition}",
                "train",
                TIMES,
                np.tile(wheel_rates(truth, twists[command]), (len(TIMES), 1)),
                STAMPS,
                poses,
                command=str(command),
                repetition=repetition,
                session=str(session),
                started_at=20.0 * len(runs),
            )
        )
    return make_dataset("coverage", ROBOT, float(TIMES[0]), tuple(runs), simulated=True), truth


def arc(twist: Array, times: Array) -> Array:
    """Poses (K, 3) of a robot that drives with a constant twist (m/s, m/s, rad/s) from the origin, in closed form."""
    forward, left, turn = twist
    heading = turn * times
    chord = (np.exp(1j * heading) - 1) / (1j * turn) if turn else times
    path = (forward + 1j * left) * chord
    return np.column_stack([path.real, path.imag, heading])


def wheel_equations(geometry: Array) -> Array:
    """Wheel equations (3, 3) of three omni wheels, Eq. (3): their rates (rad/s) by the robot's twist."""
    radius, distance, angle = geometry.reshape(3, 3)
    return np.column_stack([-np.sin(angle), np.cos(angle), distance]) / radius[:, None]


def wheel_rates(geometry: Array, twist: Array) -> Array:
    """Wheel rates (3,) of a twist, rad/s."""
    return wheel_equations(geometry) @ twist


def noise_of(kind: str, rng: np.random.Generator) -> Array:
    """Errors (K, 3) of one run's reference poses, m, m, rad; the first is that of the start pose."""
    later = len(STAMPS) - 1
    errors = np.vstack([np.zeros(3), WHITE * rng.standard_normal((later, 3))])
    extra = rng.standard_normal((later, 3))
    if kind == "start":
        errors[0] = extra[0] * [1.0, 1.0, 1.75]
    elif kind in ("walk", "once"):
        errors[1:] += 0.5 * np.cumsum(np.sqrt(np.diff(STAMPS))[:, None] * extra, axis=0)
    elif kind in ("bias", "turn"):
        errors[1:] += extra[0]
    return UNITS * errors


def covered(case: Case, seed: int) -> Row:
    """Extend the model of one set by the drift of the heading, and compare the intervals with the truth."""
    dataset, geometry = simulated(case.kind, case.clusters, seed, DRIFT)
    start = dataset.robot.inverse_kinematic_matrix
    plain = fit_matrix(usable_runs(dataset.split("train")), dataset.robot, dataset.sample_period, start)
    effect = effects.create("heading_drift")
    model = extend(plain, [Group("effect", effect.name, (), effect, effect.parameters(dataset.robot))])
    truth = np.append(np.linalg.inv(wheel_equations(geometry)), DRIFT)
    deviations = model.covariance.standard_deviations
    errors = (np.append(model.fit.model.matrix, model.values) - truth) / deviations
    reach = model.covariance.reach / deviations
    source = model.fit.noise.description
    return Row(str(case), seed, tuple(errors.round(4).tolist()), tuple(reach.round(4).tolist()), source)


def cases(only: Sequence[str] = ()) -> list[Case]:
    """All cells of the table, or those whose names hold one of some texts."""
    every = [Case(*each) for each in product(KINDS, CLUSTERS)]
    return [case for case in every if not only or any(text in str(case) for text in only)]


def table(rows: Iterable[Row], chosen: Iterable[Case]) -> Iterator[str]:
    """A line for every cell: coverage with its 95 % interval (Wilson), each set counted as one trial."""
    rows = list(rows)
    yield f"{'':28s} sets   elements, %              effect, %                least   stated / seen"
    for case in chosen:
        own = [row for row in rows if row.case == str(case)]
        if own:
            hits = np.array([row.covered for row in own])
            seen = np.sqrt(np.mean(np.square([row.errors for row in own]), axis=0))
            yield (
                f"{case!s:28s} {len(own):4d}   {share(hits[:, :9])}    {share(hits[:, 9:])}    "
                f"{100 * hits.mean(axis=0).min():4.1f}    {np.mean(1 / seen):.2f}"
            )


def share(hits: Array) -> str:
    """The mean of hits (n, m) in %, with its interval as if the m of a set were one."""
    interval = binomtest(round(hits.mean() * len(hits)), len(hits)).proportion_ci(0.95, "wilson")
    return f"{100 * hits.mean():5.1f} ({100 * interval.low:4.1f} to {100 * interval.high:5.1f})"


def main() -> None:
    """Fit the sets that are missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--sets", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", action="append", default=[], help="part of a cell's name; may be given several times")
    parser.add_argument("--table", action="store_true", help="only print the table")
    arguments = parser.parse_args()
    chosen, file = cases(arguments.only), ResultsFile(arguments.out, Row)
    if not arguments.table:
        done = {(row.case, row.seed) for row in file.results}
        wanted = [(case, seed) for seed in range(arguments.sets) for case in chosen]
        missing = [(case, seed) for case, seed in wanted if (str(case), seed) not in done]
        for row in in_processes(covered, missing, arguments.jobs):
            file.add(row)
    print("\n".join(table(file.results, chosen)))


if __name__ == "__main__":
    main()
