"""Coverage of the 95 % intervals of calibrations from distances, angles, displacements, positions and headings.

    python tests/studies/reference_coverage.py --out coverage.jsonl --sets 300 [--kinds distance turn] [--table]
    python tests/studies/reference_coverage.py --out closed_form.jsonl --sets 100 --calibrator closed_form

One line of JSON a set, added as it comes: run again with the same file, and it goes on where it was. With --table the
table is printed from what is there.

Robots are simulated with exact poses, of which this file makes the references: it shares nothing with what fits them.
Their matrices are drawn from the tolerance of the design, of which map knows. Counted are the elements that have an
interval, and combinations that are independent in the covariance: those that the references tell, and of map's all.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from results_file import ResultsFile, in_processes
from scipy.stats import norm

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.references import Reference, References
from omnibench.fit.calibrate import calibrate
from omnibench.fit.open_combinations import WORST
from omnibench.fit.prior import physical_prior_root, physical_tolerance
from omnibench.robot.calibration import matrix_rows
from omnibench.robot.kinematics import Robot
from omnibench.simulate.config import FlowerConfig, Truth
from omnibench.simulate.source import read_simulation, simulate_dataset

CONFIGS = Path(__file__).parents[2] / "configs"
TAPE, ANGLE, GPS, COMPASS = 0.003, 0.01, 0.02, 0.03  # m, rad, m, rad: standard deviations of what is measured
EVERY = 1.0  # s between positions and headings


@dataclass(frozen=True, eq=False)
class Drive:
    """A run's true path: poses (K, 3) at times (K,), and a source of noise."""

    times: np.ndarray
    poses: np.ndarray
    rng: np.random.Generator

    @property
    def length(self) -> float:
        """The way along the path, m, of arcs from pose to pose."""
        chords = np.hypot(*np.diff(self.poses[:, :2], axis=0).T)
        turns = np.diff(np.unwrap(self.poses[:, 2]))
        return float((chords / np.sinc(turns / (2 * math.pi))).sum())

    def at(self, time: float) -> np.ndarray:
        """The pose (3,) at a time."""
        return np.array([np.interp(time, self.times, column) for column in self.poses.T])


def distances(drive: Drive) -> Iterator[Reference]:
    """A tape along the path."""
    yield Reference("distance", max(drive.length + drive.rng.normal(0, TAPE), 0.0), TAPE)


def turns(drive: Drive) -> Iterator[Reference]:
    """Angle between first and last heading."""
    yield Reference("turn", float(drive.poses[-1, 2] - drive.poses[0, 2] + drive.rng.normal(0, ANGLE)), ANGLE)


def displacements(drive: Drive) -> Iterator[Reference]:
    """Marks on the floor where the run began and where it ended, seen from its beginning."""
    x, y, heading = drive.poses[0]
    across = drive.poses[-1, :2] - (x, y)
    cosine, sine = math.cos(heading), math.sin(heading)
    seen = np.array([cosine * across[0] + sine * across[1], cosine * across[1] - sine * across[0]])
    noisy = seen + drive.rng.normal(0, (TAPE, 2 * TAPE))
    yield Reference("displacement", (float(noisy[0]), float(noisy[1])), (TAPE, 2 * TAPE))


def positions(drive: Drive) -> Iterator[Reference]:
    """A total station in a frame of its own."""
    for time in np.arange(0.0, drive.times[-1] + 1e-9, EVERY):
        noisy = drive.at(float(time))[:2] + drive.rng.normal(0, GPS, 2)
        yield Reference("position", (float(noisy[0]), float(noisy[1])), GPS, t1=float(time))


def headings(drive: Drive) -> Iterator[Reference]:
    """A compass, from -pi to pi."""
    for time in np.arange(0.0, drive.times[-1] + 1e-9, EVERY):
        noisy = drive.at(float(time))[2] + drive.rng.normal(0, COMPASS)
        yield Reference("heading", float(np.angle(np.exp(1j * noisy))), COMPASS, t1=float(time))


KINDS: dict[str, tuple[Callable[[Drive], Iterator[Reference]], ...]] = {
    "distance": (distances,),
    "turn": (turns,),
    "displacement": (displacements,),
    "position": (positions,),
    "heading": (headings,),
    "distance and turn": (distances, turns),
    "displacement and turn": (displacements, turns),
    "position and heading": (positions, headings),
}
OMNI: dict[str, Any] = {"sample_period": 0.05, "pose_period": 0.05, "start": "random", "validation": None}
ROBOTS: dict[str, tuple[str, dict[str, Any], float]] = {  # config, changes, length of the runs (m)
    "omni": ("apr02", OMNI | {"repetitions": 1}, 2.0),
    "diff": ("diff", OMNI | {"repetitions": 2}, 2.0),
}


def reduced(dataset: Dataset, kind: str, rng: np.random.Generator) -> Dataset:
    """A data set whose poses have become references of a kind."""
    return make_dataset("reduced", dataset.robot, dataset.sample_period,
                        [_reduced(run, kind, rng) for run in dataset.trajectories])  # fmt: skip


def _reduced(run: Trajectory, kind: str, rng: np.random.Generator) -> Trajectory:
    drive = Drive(run.pose_times, run.poses, rng)
    given = [reference for make in KINDS[kind] for reference in make(drive)]
    references = References.of(given, float(run.times[-1]))
    return replace(run, pose_times=np.zeros(1), poses=np.zeros((1, 3)), references=references)


@lru_cache(maxsize=4)
def simulated(robot: str, seed: int, encoder: float = 0.02) -> tuple[Dataset, np.ndarray]:
    """A simulated data set with exact poses, and the robot's true matrix. encoder: noise of each wheel rate, rad/s."""
    name, changes, length = ROBOTS[robot]
    flower = read_simulation(CONFIGS / f"{name}.yaml").config
    assert isinstance(flower, FlowerConfig)
    train = flower.train.model_copy(update={"seed": 30_000 + seed, "noise_scale": 0.0, "distance": length})
    truth = Truth(matrix=matrix_rows(_true_matrix(flower.robot, np.random.default_rng([seed, 7]))))
    noise = flower.noise.model_copy(update={"encoder": encoder})
    made = simulate_dataset(flower.model_copy(update={**changes, "train": train, "truth": truth, "noise": noise}))
    return made.dataset, np.array(made.truth.matrix)


def _true_matrix(robot: Robot, rng: np.random.Generator) -> np.ndarray:
    design, root = robot.inverse_kinematic_matrix, physical_prior_root(robot, physical_tolerance(robot), "known")
    off = (root @ rng.normal(size=root.shape[1])).reshape(design.shape)
    off[1] *= bool(design[1].any())  # a robot on two fixed wheels does not slide
    moved: np.ndarray = design + off
    return moved


@dataclass(frozen=True)
class Case:
    """One line of the table."""

    robot: str
    kind: str
    calibrator: str = "map"

    def __str__(self) -> str:
        return f"{self.robot}, {self.kind}, {self.calibrator}"


@dataclass(frozen=True)
class Row:
    """Intervals of one set: errors about the truth over the half-widths, of elements and of independent combinations.

    deviations: errors of the combinations in standard deviations. source: of the intervals, or why there are none.
    """

    case: str
    seed: int
    elements: tuple[float, ...]
    combinations: tuple[float, ...]
    deviations: tuple[float, ...]
    source: str


def covered(case: Case, seed: int) -> Row:
    """Calibrate one simulated set of references and compare it with its truth."""
    exact, truth = simulated(case.robot, seed)
    dataset = reduced(exact, case.kind, np.random.default_rng([seed, *case.kind.encode()]))
    run = calibrate(dataset, case.calibrator, seed=seed)
    if (found := run.uncertainty) is None:
        return Row(str(case), seed, (), (), (), "; ".join(run.warnings))
    reach, spread = ((found.intervals.high - found.intervals.low) / 2).ravel(), found.standard_deviations.ravel()
    off = (run.calibration.matrix_array - truth).ravel()
    told = ~np.isnan(reach) & (spread > 0)  # a robot that cannot slide has elements that are 0
    units = np.repeat(dataset.robot.row_scales, truth.shape[1])
    values, vectors = np.linalg.eigh(found.covariance / np.outer(units, units))
    known = (values > 1e-9 * values.max()) & ((values < WORST**2) | (case.calibrator == "map"))
    away = (vectors.T @ (off / units))[known] / np.sqrt(values[known])
    quantiles = np.where(told, reach / np.where(spread > 0, spread, 1.0), 0.0)
    shares = np.square(vectors.T[known] * (spread / units)) * told  # of the elements in a combination
    quantile = (shares @ quantiles) / np.maximum(shares.sum(axis=1), 1e-300)
    quantile = np.where(shares.any(axis=1), quantile, norm.ppf(0.975))
    rounded = [tuple(each.round(4).tolist()) for each in (off[told] / reach[told], away / quantile, away)]
    return Row(str(case), seed, *rounded, f"{found.source}; {run.result.reason}"[:240])


def table(rows: Iterable[Row], cases: Iterable[Case]) -> Iterator[str]:
    """A line for every case: share of the intervals that hold the truth, with its 95 % interval by sets.

    deviations: root mean square of the combinations' errors, in standard deviations. without: sets without intervals.
    """
    rows = list(rows)
    yield f"{'':52s} sets   elements, %            combinations, %        deviations   without"
    for case in cases:
        every = [row for row in rows if row.case == str(case)]
        own = [row for row in every if row.combinations]
        if own:
            errors = np.concatenate([row.deviations for row in own])
            yield (
                f"{case!s:52s} {len(own):4d}   {_share([row.elements for row in own])}   "
                f"{_share([row.combinations for row in own])}   {np.sqrt(np.mean(errors**2)):.2f}         "
                f"{len(every) - len(own):4d}"
            )


def _share(errors: Sequence[Sequence[float]]) -> str:
    """Share of errors within their intervals, %, with its own interval: 1.96 standard errors of a ratio over sets."""
    hits = np.array([sum(abs(each) <= 1 for each in of_set) for of_set in errors], dtype=float)
    sizes = np.array([len(of_set) for of_set in errors], dtype=float)
    if not sizes.any():
        return f"{'none':19s}"
    share = hits.sum() / sizes.sum()
    error = np.sqrt(np.square(hits - share * sizes).sum()) / sizes.sum()
    return f"{100 * share:5.1f} ({100 * (share - 1.96 * error):5.1f} to {100 * (share + 1.96 * error):5.1f})"


def main() -> None:
    """Fit the sets that are missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--sets", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="seed of the first set")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS))
    parser.add_argument("--calibrator", default="map")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="only print the table")
    arguments = parser.parse_args()
    cases = [Case(robot, kind, arguments.calibrator) for robot in arguments.robots for kind in arguments.kinds]
    file = ResultsFile(arguments.out, Row)
    if not arguments.table:
        done = {(row.case, row.seed) for row in file.results}
        seeds = range(arguments.first, arguments.first + arguments.sets)
        missing = [(case, seed) for seed in seeds for case in cases if (str(case), seed) not in done]
        for row in in_processes(covered, missing, arguments.workers):
            file.add(row)
    print("\n".join(table(file.results, cases)))


if __name__ == "__main__":
    main()
