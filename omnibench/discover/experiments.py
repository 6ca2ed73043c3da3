"""Experiments that tell the members of a class of effects apart, as configs for ``omnibench simulate``."""

from __future__ import annotations

from collections.abc import Sequence

from omnibench.config import to_yaml
from omnibench.data.dataset import Dataset
from omnibench.discover.fitting.model_fit import Fit
from omnibench.discover.result import Experiment, NamedEffect
from omnibench.robot.calibration import matrix_rows
from omnibench.simulate.config import FlowerConfig


def experiments_for(dataset: Dataset, effects: Sequence[NamedEffect], fit: Fit) -> tuple[Experiment, ...]:
    """One experiment for each effect that is confusable with others."""
    return tuple(
        Experiment((effect.name, *effect.confusable_with), _WORDS, _config(dataset, effect, fit))
        for effect in effects
        if effect.confusable_with
    )


_WORDS = (
    "Straight runs and curves at two speeds, turns on the spot, random start headings and a random order, each command "
    "five times."
)


def _config(dataset: Dataset, effect: NamedEffect, fit: Fit) -> str:
    speed = max((run.v or 0.0 for run in dataset.trajectories), default=0.0) or 0.2
    turn = max((abs(run.omega or 0.0) for run in dataset.trajectories), default=0.0) or 0.35
    noise = fit.noise.noise.model_dump()
    config = FlowerConfig.model_validate(
        {
            "robot": dataset.robot.model_dump() | {"name": dataset.robot.name or "robot"},
            "sample_period": dataset.sample_period,
            "pose_period": max(0.2, dataset.sample_period),
            "commands": {
                "speeds": [0.0, round(speed / 2, 3), round(speed, 3)],
                "directions_deg": [0, 60, 120, 180, 240, 300] if len(dataset.robot.motions) == 3 else None,
                "turn_rates": [-round(turn, 3), 0.0, round(turn, 3)],
                "ramp": 0.3,
            },
            "start": "random",
            "truth": {
                "matrix": matrix_rows(fit.model.matrix),
                "effects": [{"name": effect.name, "parameters": {each.name: each.value for each in effect.parameters}}],
            },
            "noise": noise,
            "train": {"seed": 1, "distance": max(6 * speed, 0.5)},
        }
    )
    members = ", ".join((effect.name, *effect.confusable_with))
    return to_yaml(
        {
            "name": f"{dataset.name}_experiment",
            "description": f"Tells {members} apart; simulated with the first.",
            "datasets": {"experiment": {"simulate": config.model_dump(mode="json", exclude_none=True)}},
        }
    )
