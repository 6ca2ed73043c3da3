"""How much the constants of the calibrator map matter on the real robots: each halved and doubled.

``python tests/studies/prior_study.py [--data DIR] [ROBOT ...]`` prints, for every variant and robot, the geometric
mean over the cells of configs/real_robots.yaml of the error of runs that did not train, as a share of that with the
constants as they are. A cell's error is Eq. (6).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from omnibench.compare.config import CalibratorEntry, TrainingChoice, read_compare_config
from omnibench.compare.plan import ComparedRobot, load_robots, plan_fits
from omnibench.compare.score import score_fits
from omnibench.compare.statistics import make_cells
from omnibench.fit import estimate, loss
from omnibench.fit.calibrator import run_calibrator
from omnibench.registry import calibrators, load_plugins
from omnibench.robot import physical as geometry
from omnibench.robot.kinematics import class_of

CONFIG = Path(__file__).parents[2] / "configs" / "real_robots.yaml"
TOLERANCES: dict[str, Callable[[geometry.PhysicalTolerance, float], geometry.PhysicalTolerance]] = {
    "radius": lambda given, factor: replace(given, radius=factor * given.radius),
    "rows": lambda given, factor: replace(given, rows=tuple(factor * share for share in given.rows)),  # type: ignore[arg-type]
    "elements": lambda given, factor: replace(given, elements=factor * given.elements),
    "lost rate": lambda given, factor: replace(given, lost_rate=factor * given.lost_rate),
}
CONSTANTS: dict[str, Callable[[float], tuple[Any, str, Any]]] = {  # what is set where, by a factor
    "stretches": lambda factor: (
        estimate,
        "EstimateProblem",
        partial(estimate.EstimateProblem, stretches=round(factor * estimate._STRETCHES)),
    ),
    "poses of a stretch": lambda factor: (estimate, "_POSES", round(factor * estimate._POSES)),
    "first deviation": lambda factor: (estimate, "_FIRST", factor * estimate._FIRST),
    "least deviation": lambda factor: (estimate, "LEAST", factor * estimate.LEAST),
    "Huber's corner": lambda factor: (loss, "CORNERS", {key: factor * value for key, value in loss.CORNERS.items()}),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("robots", nargs="*")
    parser.add_argument("--data", type=Path)
    given = parser.parse_args()
    config = read_compare_config(CONFIG, {} if given.data is None else {"": given.data})
    chosen = {name: robot for name, robot in config.robots.items() if name in (given.robots or config.robots)}
    rules = {
        name: tuple(rule for rule in robot.trainings if not rule.runs_per_command) or (TrainingChoice(by="kind"),)
        for name, robot in chosen.items()
    }
    config = config.model_copy(
        update={
            "robots": {n: robot.model_copy(update={"trainings": rules[n]}) for n, robot in chosen.items()},
            "regimes": {},
            "methods": (CalibratorEntry(name="map"),),
            "reference": None,
        }
    )
    load_plugins(config.plugins)
    robots, _ = load_robots(config, lambda _: None)
    print(f"{'':28s}" + "".join(f"{robot.name:>10s}" for robot in robots))
    usual = [errors(config, robot) for robot in robots]
    for name, variant in variants():
        shares = []
        for robot, before in zip(robots, usual, strict=True):
            with variant(robot):
                after = errors(config, robot)
            shares.append(float(np.exp(np.mean(np.log(np.array(after) / np.array(before))))))
        print(f"{name:28s}" + "".join(f"{share:10.3f}" for share in shares), flush=True)


def errors(config: Any, robot: ComparedRobot) -> list[float]:
    """Mean error of each cell of a robot."""
    fits = plan_fits(config, (robot,))
    calibrator = calibrators.create("map")
    judged, design = score_fits(config, fits, [run_calibrator(calibrator, fit.problem()) for fit in fits])
    cells = [cell for cell in make_cells(judged, design) if not cell.key.fitted]
    return [cell.methods["map"].mean("cost") or np.nan for cell in cells]


def variants() -> Iterator[tuple[str, Callable[[ComparedRobot], Any]]]:
    """Every constant halved and doubled."""
    for factor in (0.5, 2.0):
        for name, change in TOLERANCES.items():
            yield f"{name} x {factor:g}", lambda robot, change=change, factor=factor: _tolerance(robot, change, factor)
        for name, change in CONSTANTS.items():
            yield f"{name} x {factor:g}", lambda _, change=change, factor=factor: _constant(*change(factor))


@contextmanager
def _tolerance(robot: ComparedRobot, change: Callable[..., Any], factor: float) -> Iterator[None]:
    kind, before = class_of(robot.dataset.robot), dict(geometry._TOLERANCES)
    geometry._TOLERANCES = before | {kind: change(before[kind], factor)}  # type: ignore[misc]
    try:
        yield
    finally:
        geometry._TOLERANCES = before  # type: ignore[misc]


@contextmanager
def _constant(holder: Any, name: str, value: Any) -> Iterator[None]:
    before = getattr(holder, name)
    setattr(holder, name, value)
    try:
        yield
    finally:
        setattr(holder, name, before)


if __name__ == "__main__":
    main()
