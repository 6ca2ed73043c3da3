"""Coverage of the 95 % intervals of calibrations from distances, angles, displacements, positions and headings.

    python tests/benchmarks/reference_coverage.py --sets 300

Robots are simulated with exact poses, of which this file makes the references: it shares nothing with what fits them.
Counted are the elements that have an interval, and, of the combinations that the references tell, those that are
independent in the covariance.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.references.run_references import Reference, References
from omnibench.fit.calibrate import calibrate
from omnibench.robot.calibration import matrix_rows
from omnibench.simulate.config import FlowerConfig, Truth
from omnibench.simulate.simulate import simulate_dataset
from omnibench.simulate.source import read_simulation

CONFIGS = Path(__file__).parents[2] / "configs"
TAPE, ANGLE, GPS, COMPASS = 0.003, 0.01, 0.02, 0.03  # m, rad, m, rad: standard deviations of what is measured
OFF = 0.02  # share of a row's largest element by which the true elements are off the design
EVERY = 1.0  # s between positions and headings


@dataclass(frozen=True, eq=False)
class Drive:
    """A run's true path: poses (K, 3) at times (K,), and a source of noise."""

    times: np.ndarray
    poses: np.ndarray
    rng: np.random.Generator

    @property
    def length(self) -> float:
        """The way along the path, m."""
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum())

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


def simulated(robot: str, seed: int, encoder: float = 0.02) -> tuple[Dataset, np.ndarray]:
    """A simulated data set with exact poses, and the robot's true matrix. encoder: noise of each wheel rate, rad/s."""
    name, changes, length = ROBOTS[robot]
    flower = read_simulation(CONFIGS / f"{name}.yaml").config
    assert isinstance(flower, FlowerConfig)
    train = flower.train.model_copy(update={"seed": 30_000 + seed, "noise_scale": 0.0, "distance": length})
    design = flower.robot.inverse_kinematic_matrix
    off = OFF * np.random.default_rng([seed, 7]).normal(size=design.shape) * flower.robot.row_scales[:, None]
    off[1] *= bool(design[1].any())  # a robot on two fixed wheels does not slide
    noise = flower.noise.model_copy(update={"encoder": encoder})
    truth = Truth(matrix=matrix_rows(design + off))
    made = simulate_dataset(flower.model_copy(update={**changes, "train": train, "truth": truth, "noise": noise}))
    return made.dataset, np.array(made.truth.matrix)


@dataclass(frozen=True, eq=False)
class Coverage:
    """One set: which intervals hold the truth, of elements (NaN: no interval) and of independent combinations."""

    elements: np.ndarray
    combinations: np.ndarray
    source: str


def covered(seed: int, kind: str, robot: str, calibrator: str, unidentified: Any) -> Coverage:
    """Calibrate one simulated set of references and compare it with its truth."""
    exact, truth = simulated(robot, seed)
    dataset = reduced(exact, kind, np.random.default_rng([seed, *kind.encode()]))
    run = calibrate(dataset, calibrator, unidentified=unidentified, seed=seed)
    found = run.uncertainty
    assert found is not None, run.warnings
    low, high = found.intervals.low, found.intervals.high
    told = ~np.isnan(low) & (found.standard_deviations > 0)  # a robot that cannot slide has elements that are 0
    elements = np.where(told, (truth >= low) & (truth <= high), np.nan).ravel()
    units = np.repeat(dataset.robot.row_scales, truth.shape[1])
    values, vectors = np.linalg.eigh(found.covariance / np.outer(units, units))
    known = (values > 1e-9 * values.max()) & (values < 0.1**2)
    away = vectors.T @ ((run.calibration.matrix_array - truth).ravel() / units)
    reach = (
        (high - low).ravel()
        / 2
        / np.where(found.standard_deviations.ravel() > 0, found.standard_deviations.ravel(), np.nan)
    )
    quantile = 1.96 if np.isnan(reach).all() else float(np.nanmedian(reach))
    return Coverage(elements, (np.abs(away) <= quantile * np.sqrt(np.maximum(values, 0)))[known], found.source)


def main() -> None:
    """Print the coverage of every kind of reference."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=300)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS))
    parser.add_argument("--calibrator", default="trajectory_ml")
    parser.add_argument("--unidentified", default="keep")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    with ProcessPoolExecutor(arguments.workers) as pool:
        for robot in arguments.robots:
            for kind in arguments.kinds:
                study = partial(
                    covered,
                    kind=kind,
                    robot=robot,
                    calibrator=arguments.calibrator,
                    unidentified=arguments.unidentified,
                )
                found = list(pool.map(study, range(arguments.sets)))
                elements = np.concatenate([each.elements[~np.isnan(each.elements)] for each in found])
                combinations = np.concatenate([each.combinations for each in found])
                words = [f"{robot}, {kind}:"]
                for name, hits in (("elements", elements), ("combinations", combinations)):
                    share = f"{100 * hits.mean():.1f} %" if len(hits) else "none"
                    words.append(f"{name} {share} of {len(hits)};")
                print(*words, found[0].source, flush=True)
    one = binomtest(round(0.95 * arguments.sets), arguments.sets).proportion_ci(0.95, "wilson")
    print(f"95 % interval of the coverage of one number, if it is 95 %: {100 * one.low:.1f} to {100 * one.high:.1f} %")


if __name__ == "__main__":
    main()
