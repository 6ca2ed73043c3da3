"""Small data sets of two robots (simulated here), and a study on them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from commands import ROOT
from sample_robots import APR_02, DIFFERENTIAL
from wheeled_recordings import path

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.storage import save_dataset
from omnibench.robot.kinematics import Array, Robot, wheel_equations

PERIOD, SAMPLES = 0.1, 40
TWISTS = {"line": ((0.3, 0.0, 0.0), (-0.3, 0.0, 0.0)), "arc": ((0.3, 0.0, 0.5), (0.3, 0.0, -0.5))}
METHODS: tuple[dict[str, Any], ...] = (
    {"name": "theoretical", "label": "design", "family": "baseline"},
    {"name": "closed_form", "label": "default", "family": "ours"},
    {"name": "maddahi", "family": "published"},
)


def robot_dataset(robot: Robot, name: str, seed: int) -> Dataset:
    """Two kinds of path in three sessions each, two commands each, driven twice; every wheel is 5 % off."""
    rng = np.random.default_rng(seed)
    shares = 1 + 0.05 * rng.choice([-1.0, 1.0], len(robot.wheels))
    runs: list[Trajectory] = []
    for kind, twists in TWISTS.items():
        for session in range(3):
            for number, twist in enumerate(twists):
                for repetition in (1, 2):
                    run_id = f"{kind}_{session}_{number}_{repetition}"
                    run = _run(robot, shares, np.array(twist), rng, run_id)
                    runs.append(
                        replace(run, command=f"{kind}{number}", repetition=repetition, session=f"{kind} day {session}")
                    )
    return make_dataset(name, robot, PERIOD, runs, simulated=True)


def _run(robot: Robot, shares: Array, twist: Array, rng: np.random.Generator, name: str) -> Trajectory:
    """Poses by exact arcs of the true twist; wheel rates as a robot whose radii are off counts them."""
    times = PERIOD * np.arange(1, SAMPLES + 1)
    rates = np.tile(wheel_equations(robot.wheels) @ twist / shares, (SAMPLES, 1))
    stamps = np.append(0.0, times[9::10])
    way = path(np.tile(PERIOD * twist, (SAMPLES, 1)))[::10]
    poses = way + rng.normal(0.0, 0.003, way.shape) * (stamps > 0)[:, None]
    return Trajectory(name, "train", times, rates, stamps, poses)


def write_study(folder: Path, change: Callable[[dict[str, Any]], None] | None = None) -> Path:
    """Write the data sets of two robots and a study on them; ``change`` may alter its config."""
    save_dataset(robot_dataset(DIFFERENTIAL, "two wheels", 1), folder / "recordings" / "two")
    save_dataset(robot_dataset(APR_02, "three wheels", 2), folder / "recordings" / "three")
    kinds = {"line": "line_*", "arc": "arc_*"}
    config: dict[str, Any] = {
        "name": "tiny",
        "data": "recordings",
        "plugins": [str(ROOT / "plugins")],
        "robots": {"two": {"path": "two", "kinds": kinds}, "three": {"path": "three", "kinds": kinds}},
        "trainings": ["kind", "session"],
        "methods": [dict(method) for method in METHODS],
        "reference": "default",
        "budget": {"evaluations": 2000, "seconds": 20},
        "timing": False,
        "workers": 2,
    }
    if change is not None:
        change(config)
    file = folder / "study.yaml"
    file.write_text(yaml.safe_dump(config))
    return file
