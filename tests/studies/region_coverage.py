"""How many held-out runs of real robots end within the 95 % error regions that a calibration predicts for their paths.

``python tests/studies/region_coverage.py [DATA]`` fits ``map`` to every training of configs/real_robots.yaml and judges
it on the runs that the study holds out. DATA is the folder of the recordings, by default the config's. Each run is
judged by the region of its own path, with what its start and its reference err by.

A share counts every training > judged kind of a robot alike. Runs of a command err alike, so that the exact binomial
intervals count commands, not runs. factor: that with which 95 % of the runs of all other robots lie in the regions;
each of them counts alike. The last columns are the share with that factor, which the robot itself had no part in.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from omnibench.compare.config import CalibratorEntry, read_compare_config
from omnibench.compare.plan import PlannedFit, load_robots, plan_fits
from omnibench.fit.calibrator import run_calibrator
from omnibench.fit.path_errors import EndErrors, calibration_covariances, error_region, slip_of
from omnibench.registry import calibrators, load_plugins
from omnibench.robot.calibration import Calibration, matrix_rows

CONFIG = Path(__file__).parents[2] / "configs" / "real_robots.yaml"
LEVEL = 0.95


@dataclass(frozen=True, eq=False)
class Judged:
    """A fit judged on one kind of path: errors as shares (Z, 2) of the radii of their regions, by place and heading."""

    robot: str
    cell: str
    commands: tuple[str, ...]
    ratios: NDArray[np.float64]


def main(data: str | None = None) -> None:
    """Print the tables."""
    judged = list(judged_fits(data))
    cells = list(dict.fromkeys((each.robot, each.cell) for each in judged))
    pooled = {
        cell: [each for each in judged if (each.robot, each.cell) == cell] for cell in cells
    }  # a cell has several folds
    print(f"{'training > judged':52} runs  commands  held: place               heading")
    for (robot, name), folds in pooled.items():
        ratios = np.concatenate([fold.ratios for fold in folds])
        commands = len({command for fold in folds for command in fold.commands})
        shares = "   ".join(in_words(float(share), commands) for share in (ratios <= 1).mean(axis=0))
        print(f"{robot + ', ' + name:52} {len(ratios):4d}  {commands:8d}  {shares}")
    robots = list(dict.fromkeys(robot for robot, _ in cells))
    print("\nrobot      cells  held: place               heading             factors     held with them")
    of_robot = {robot: weighted([pooled[cell] for cell in cells if cell[0] == robot]) for robot in robots}
    for robot, (ratios, weights) in of_robot.items():
        commands = len({command for each in judged if each.robot == robot for command in each.commands})
        others = [of_robot[other] for other in robots if other != robot]
        rest, rest_weights = (np.concatenate(parts) for parts in zip(*others, strict=True))
        factors = [quantile(rest[:, side], rest_weights) for side in (0, 1)]
        shares = "   ".join(in_words(float(weights @ (ratios[:, side] <= 1)), commands) for side in (0, 1))
        with_them = "  ".join(f"{100 * float(weights @ (ratios[:, side] <= factors[side])):5.1f} %" for side in (0, 1))
        count = sum(cell[0] == robot for cell in cells)
        print(f"{robot:9} {count:6d}  {shares}   {factors[0]:.2f} {factors[1]:.2f}   {with_them}")
    for side, what in enumerate(("place", "heading")):
        each = [float(weights @ (ratios[:, side] <= 1)) for ratios, weights in of_robot.values()]
        runs = np.concatenate([fit.ratios[:, side] for fit in judged])
        print(f"{what}: {100 * np.mean(each):.1f} % of robots' shares, {100 * (runs <= 1).mean():.1f} % of all runs")


def judged_fits(data: str | None) -> Iterator[Judged]:
    """Every fit, judged on every kind of path that it was not fitted to."""
    config = read_compare_config(CONFIG, {} if data is None else {"": Path(data)})
    methods = (CalibratorEntry(name="map"),)
    config = config.model_copy(update={"regimes": {}, "methods": methods, "reference": None})
    load_plugins(config.plugins)
    robots, _ = load_robots(config, lambda _: None)
    for fit in plan_fits(config, robots):
        if fit.refusal:
            continue
        calibration = calibrated(fit)
        for kind, indices in fit.fold.judged.items():
            if indices:
                runs = [fit.robot.dataset.trajectories[index] for index in indices]
                logs = [run.final_log for run in runs]
                ends = EndErrors.of(calibration, logs)
                errors = ends.ends - np.array([run.final_pose for run in runs])
                covariances = (
                    calibration_covariances(calibration, logs) + ends.of_slip(calibration.slip) + ends.of_reference
                )
                assert calibration.slip is not None  # all runs have poses
                regions = [error_region(each, np.zeros(3), calibration.slip.runs) for each in covariances]
                radii = np.array(regions)[:, [1, 3]]
                sizes = np.column_stack([np.hypot(errors[:, 0], errors[:, 1]), np.abs(errors[:, 2])])
                commands = tuple(run.command or run.id for run in runs)
                yield Judged(fit.robot.name, f"{fit.training.name} > {kind}", commands, sizes / radii)


def calibrated(run: PlannedFit) -> Calibration:
    """The calibration of training runs by map, with their slip."""
    problem = run.problem()
    result = run_calibrator(calibrators.create("map"), problem)
    assert result.matrix is not None and result.extension is not None  # noqa: PT018
    calibration = Calibration(
        name=run.title,
        robot=problem.robot,
        sample_period=problem.sample_period,
        matrix=matrix_rows(result.matrix),
        integration=problem.integration,
        **dict(result.extension),
    )
    return calibration.model_copy(update={"slip": slip_of(calibration, run.training_runs)})


def weighted(cells: list[list[Judged]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ratios (Z, 2) of a robot and weights (Z,) by which each of its cells counts alike."""
    ratios = [np.concatenate([fold.ratios for fold in folds]) for folds in cells]
    weights = [np.full(len(of_cell), 1 / len(of_cell) / len(cells)) for of_cell in ratios]
    return np.concatenate(ratios), np.concatenate(weights)


def quantile(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """The value below which 95 % of the weight lies."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order]) / weights.sum()
    return float(values[order][np.searchsorted(reached, LEVEL)])


def in_words(share: float, count: int) -> str:
    """A share with its exact binomial 95 % interval (Clopper and Pearson 1934) of so many draws, in %."""
    held = share * count
    low = float(beta.ppf(0.025, held, count - held + 1)) if held > 0 else 0.0
    high = float(beta.ppf(0.975, held + 1, count - held)) if held < count else 1.0
    return f"{100 * share:5.1f} ({100 * low:4.1f} to {100 * high:5.1f})"


if __name__ == "__main__":
    main(*sys.argv[1:])
