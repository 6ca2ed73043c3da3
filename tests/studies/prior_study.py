"""How much the constants of the calibrator posterior matter on the real robots: each halved and doubled.

``python tests/studies/prior_study.py [--data DIR] [ROBOT ...]`` prints, for every variant and robot, the geometric
mean over the cells of configs/real_robots.yaml of the error of runs that did not train, as a share of that with the
constants as they are. A cell's error is Eq. (6).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from omnibench.fit import prior
from omnibench.fit.calibrator import run_calibrator
from omnibench.fit.calibrators import posterior
from omnibench.registry import calibrators, load_plugins
from omnibench.robot.kinematics import class_of
from omnibench.study.config import MethodChoice, TrainingChoice
from omnibench.study.study import read_study_config
from omnibench.study.study_plan import StudiedRobot, judge_fits, load_robots, plan_fits
from omnibench.study.study_result import make_cells

CONFIG = Path(__file__).parents[2] / "configs" / "real_robots.yaml"
TOLERANCES: dict[str, Callable[[prior.PhysicalTolerance, float], prior.PhysicalTolerance]] = {
    "radius": lambda given, factor: replace(given, radius=factor * given.radius),
    "rows": lambda given, factor: replace(given, rows=tuple(factor * share for share in given.rows)),  # type: ignore[arg-type]
    "elements": lambda given, factor: replace(given, elements=factor * given.elements),
    "lost rate": lambda given, factor: replace(given, lost_rate=factor * given.lost_rate),
}
CONSTANTS = {"stretches": "_STRETCHES", "Huber's constant": "_HUBER", "least deviation": "_LEAST"}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("robots", nargs="*")
    parser.add_argument("--data", type=Path)
    given = parser.parse_args()
    config = read_study_config(CONFIG, {} if given.data is None else {"": given.data})
    chosen = {name: robot for name, robot in config.robots.items() if name in (given.robots or config.robots)}
    rules = {
        name: tuple(rule for rule in robot.trainings if not rule.runs_per_command) or (TrainingChoice(by="kind"),)
        for name, robot in chosen.items()
    }
    config = config.model_copy(
        update={
            "robots": {n: robot.model_copy(update={"trainings": rules[n]}) for n, robot in chosen.items()},
            "regimes": {},
            "methods": (MethodChoice(name="posterior"),),
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


def errors(config: Any, robot: StudiedRobot) -> list[float]:
    """Mean error of each cell of a robot."""
    fits = plan_fits(config, (robot,))
    calibrator = calibrators.create("posterior")
    results = {i: run_calibrator(calibrator, fit.run.task.problem()) for i, fit in enumerate(fits) if fit.run}
    judged, design = judge_fits(fits, results, config.integration, lambda _: None)
    cells = [cell for cell in make_cells(judged, design) if not cell.key.fitted]
    return [cell.methods["posterior"].mean("cost") or np.nan for cell in cells]


def variants() -> Iterator[tuple[str, Callable[[StudiedRobot], Any]]]:
    """Every constant halved and doubled."""
    for factor in (0.5, 2.0):
        for name, change in TOLERANCES.items():
            yield f"{name} x {factor:g}", lambda robot, change=change, factor=factor: _tolerance(robot, change, factor)
        for name, constant in CONSTANTS.items():
            yield f"{name} x {factor:g}", lambda _, constant=constant, factor=factor: _constant(constant, factor)


@contextmanager
def _tolerance(robot: StudiedRobot, change: Callable[..., Any], factor: float) -> Iterator[None]:
    kind, before = class_of(robot.dataset.robot), dict(prior._TOLERANCES)
    prior._TOLERANCES = before | {kind: change(before[kind], factor)}  # type: ignore[misc]
    try:
        yield
    finally:
        prior._TOLERANCES = before  # type: ignore[misc]


@contextmanager
def _constant(name: str, factor: float) -> Iterator[None]:
    before = getattr(posterior, name)
    setattr(posterior, name, type(before)(before * factor))
    try:
        yield
    finally:
        setattr(posterior, name, before)


if __name__ == "__main__":
    main()
